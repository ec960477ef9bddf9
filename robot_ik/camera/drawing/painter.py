"""Paint faces of MuJoCo models into pictures, without OpenGL.

A ``SurfaceBuffer`` keeps the nearest surface at several samples of each pixel. Surfaces that
intersect are cut at their intersection, and outlines are smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np

from robot_ik.camera.drawing import zbuffer
from robot_ik.camera.drawing.faces import EMPTY, Faces
from robot_ik.camera.drawing.meshes import geom_rgba
from robot_ik.camera.image import Box, Float32
from robot_ik.ports import Array, Image, Mask

# Samples per pixel along each axis. Drawn spheres are then exact to 0.02 px (RMS).
SAMPLES = 2
# Strength of highlights, of 255.
GLOSS = 55.0
# Reflectance of a black surface, 0 to 1. A robot that absorbs all light would show no shape.
_DARKEST = 0.18


@dataclass(frozen=True)
class Layer:
    """A drawing on the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels of the picture, half open.
        colour: (h, w, 3) BGR times coverage.
        coverage: (h, w) 255 where the drawing hides the picture.
    """

    box: Box
    colour: Image
    coverage: Image

    @classmethod
    def empty(cls) -> Layer:
        """Return a layer without pixels."""
        return cls(EMPTY, np.zeros((0, 0, 3), dtype=np.uint8), np.zeros((0, 0), dtype=np.uint8))

    def over(self, image: Image, alpha: float = 1.0) -> None:
        """Lay the drawing over ``image`` (height, width, 3), in place, with opacity ``alpha``."""
        if self.coverage.size:
            x0, y0, _, _ = self.box
            zbuffer.lay_over(image, self.colour, self.coverage, float(alpha), x0, y0)

    def shifted(self, motion: Array, width: int, height: int) -> Layer:
        """Return the drawing moved in a picture of this size: image shifting (Azuma 1997).

        Args:
            motion: (2, 3) maps pixels (x, y, 1) of this drawing to new pixels.
            width: Of the picture, px.
            height: Of the picture, px.
        """
        if not self.coverage.size:
            return self
        x0, y0, x1, y1 = self.box
        corners = np.array([[x0, y0, 1], [x1, y0, 1], [x1, y1, 1], [x0, y1, 1]]) @ motion.T
        lower = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, (width, height))
        upper = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 2, 0, (width, height))
        size = (int(upper[0] - lower[0]), int(upper[1] - lower[1]))
        if min(size) <= 0:
            return Layer.empty()
        local = motion.copy()
        local[:, 2] += motion[:, :2] @ (x0, y0) - lower
        colour = cv2.warpAffine(self.colour, local, size, flags=cv2.INTER_LINEAR)
        coverage = cv2.warpAffine(self.coverage, local, size, flags=cv2.INTER_LINEAR)
        box = (int(lower[0]), int(lower[1]), int(upper[0]), int(upper[1]))
        return Layer(box, np.asarray(colour, dtype=np.uint8), np.asarray(coverage, dtype=np.uint8))

    def mask(self, width: int, height: int) -> Image:
        """Return the coverage (height, width) on the whole picture."""
        picture = np.zeros((height, width), dtype=np.uint8)
        x0, y0, x1, y1 = self.box
        picture[y0:y1, x0:x1] = self.coverage
        return picture


class SurfaceBuffer:
    """The nearest surface at each sample of the pixels of a box.

    Args:
        box: (x0, y0, x1, y1) pixels of the picture, half open.
        samples: Per pixel, along each axis.

    Attributes:
        box: As given.
        samples: As given.
        depth: (h samples, w samples) inverse depth of the nearest surface, 1 / m; 0 for none.
        colour: (h samples, w samples, 4) BGR and opacity of that surface, 0 to 255.
    """

    def __init__(self, box: Box, samples: int = SAMPLES) -> None:
        self.box = box
        self.samples = samples
        shape = ((box[3] - box[1]) * samples, (box[2] - box[0]) * samples)
        self.depth: Float32 = np.zeros(shape, dtype=np.float32)
        self.colour: Image = np.zeros((*shape, 4), dtype=np.uint8)

    def fill(self, faces: Faces, paint: Float32) -> None:
        """Add faces in the colours ``paint`` (ngeom, 4), as ``geom_paint`` returns them."""
        zbuffer.fill_faces(
            faces.pixels,
            faces.inverse,
            faces.faces,
            faces.chosen,
            faces.geom,
            faces.lit,
            paint,
            np.float32(GLOSS),
            np.array(self.box[:2], dtype=float),
            float(self.samples),
            self.depth,
            self.colour,
        )

    def layer(self) -> Layer:
        """Return the mean of the samples of each pixel."""
        size = (self.box[2] - self.box[0], self.box[3] - self.box[1])
        mean = cv2.resize(self.colour, size, interpolation=cv2.INTER_AREA)
        colour = np.asarray(cv2.cvtColor(mean, cv2.COLOR_BGRA2BGR), dtype=np.uint8)
        return Layer(self.box, colour, np.asarray(cv2.extractChannel(mean, 3), dtype=np.uint8))


def geom_paint(
    model: mujoco.MjModel,
    tint: tuple[float, float, float] | None = None,
    *,
    occluders: Mask | bool = False,
) -> Float32:
    """Return the colours (ngeom, 4) in which a model is filled: BGR and opacity, 0 to 255.

    Args:
        model: Its geoms have the colours of their materials. Black becomes dark grey.
        tint: One BGR colour for all geoms instead.
        occluders: (ngeom,) geoms, or all of them, that hide other surfaces and are not drawn.
    """
    paint = np.full((model.ngeom, 4), 255.0, dtype=np.float32)
    colours = geom_rgba(model)[:, 2::-1]
    lifted = colours + _DARKEST * (1.0 - colours.max(axis=1, keepdims=True, initial=0.0))
    paint[:, :3] = 255.0 * lifted if tint is None else tint
    paint[np.broadcast_to(occluders, model.ngeom)] = 0.0
    return paint


def paint_mask(
    shape: tuple[int, int], faces: Faces, corner: tuple[int, int] = (0, 0), samples: int = SAMPLES
) -> Image:
    """Return the silhouette (h, w) of faces: 255 inside, with smooth edges.

    Pixel (0, 0) of the silhouette is pixel ``corner`` of the picture.
    """
    box = (corner[0], corner[1], corner[0] + shape[1], corner[1] + shape[0])
    buffer = SurfaceBuffer(box, samples)
    count = int(faces.geom.max(initial=0)) + 1
    buffer.fill(faces, np.full((count, 4), 255.0, dtype=np.float32))
    return buffer.layer().coverage
