"""A MuJoCo model drawn into a camera picture without OpenGL.

Vertices go through the lens model themselves, so a drawing lies on the raw, distorted picture.  Faces are
filled by compiled code that keeps the nearest surface at several samples of every pixel (``rasteriser.py``):
what passes through something else is cut where it passes, and edges are smooth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing import rasteriser
from robot_ik.camera.drawing.meshes import ModelMesh, cached_mesh, geom_rgba, scratch_data, segments_for
from robot_ik.camera.drawing.rasteriser import clip, view_planes
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import lens_vector
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image, Mask

Index = NDArray[np.int64]

EMPTY: Box = (0, 0, 0, 0)


@dataclass(frozen=True)
class Layer:
    """A drawing on the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels of the picture, half open.
        colour: (h, w, 3) BGR times coverage.
        coverage: (h, w) 255 where the drawing is all there is.
    """

    box: Box
    colour: Image
    coverage: Image

    @classmethod
    def empty(cls) -> Layer:
        """Nothing drawn."""
        return cls(EMPTY, np.zeros((0, 0, 3), dtype=np.uint8), np.zeros((0, 0), dtype=np.uint8))

    def over(self, image: Image, alpha: float = 1.0) -> None:
        """Lays the drawing over ``image`` (height, width, 3), in place; ``alpha`` 0 leaves it."""
        if self.coverage.size:
            rasteriser.lay_over(image, self.colour, self.coverage, float(alpha), self.box[0], self.box[1])

    def shifted(self, motion: Array, width: int, height: int) -> Layer:
        """The drawing moved in a picture of this size, and cut off there: Azuma's image shifting.

        ``motion`` (2, 3) says where pixels (x, y, 1) of this drawing go.
        """
        if not self.coverage.size:
            return self
        x0, y0, x1, y1 = self.box
        corners = np.array([[x0, y0, 1], [x1, y0, 1], [x1, y1, 1], [x0, y1, 1]]) @ motion.T
        low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, (width, height))
        high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 2, 0, (width, height))
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        if min(size) <= 0:
            return Layer.empty()
        own = motion.copy()
        own[:, 2] += motion[:, :2] @ (x0, y0) - low
        colour = cv2.warpAffine(self.colour, own, size, flags=cv2.INTER_LINEAR)
        coverage = cv2.warpAffine(self.coverage, own, size, flags=cv2.INTER_LINEAR)
        box = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        return Layer(box, np.asarray(colour, dtype=np.uint8), np.asarray(coverage, dtype=np.uint8))

    def mask(self, width: int, height: int) -> Image:
        """Coverage (height, width) on the whole picture."""
        whole = np.zeros((height, width), dtype=np.uint8)
        x0, y0, x1, y1 = self.box
        whole[y0:y1, x0:x1] = self.coverage
        return whole


# Nothing nearer to the lens is drawn, metres.
NEAR = 0.02
# Faces that reach beyond this part of the radius at which a lens model folds back are clipped.
_SAFE_RADIUS = 0.98
# Direction to the light in the camera frame (x right, y down, z forward): above, left, behind the lens.
LIGHT = np.array([-0.45, -0.75, -0.55]) / np.linalg.norm([-0.45, -0.75, -0.55])
_HALFWAY = (LIGHT - [0.0, 0.0, 1.0]) / np.linalg.norm(LIGHT - [0.0, 0.0, 1.0])
_AMBIENT, _GLOSS = 0.36, 55.0


def _samples(count: int) -> Array:
    """Places (count, 2) in a pixel, its centre at 0: a lattice with no two in one row or column."""
    k = np.arange(count)
    column = np.array([1, 3, 0, 2]) if count == 4 else (k * {8: 3, 16: 7}[count]) % count
    return np.stack([(column + 0.5) / count - 0.5, (k + 0.5) / count - 0.5], axis=1)


#: Sample positions in a pixel by their number.
SAMPLES: dict[int, Array] = {1: np.zeros((1, 2)), 4: _samples(4), 8: _samples(8), 16: _samples(16)}


@dataclass(frozen=True)
class Faces:
    """Faces of a model in a picture.

    Attributes:
        points: (v, 3) vertices in the camera frame, metres.
        pixels: (v, 2) the same through the lens; ``inverse`` (v,) one over depth, 1/m.
        faces: (f, 4) vertices; ``chosen`` which of them to fill; ``geom`` (f,) model geom id.
        lit: (f, 4, 2) diffuse light and highlight at the corners of what shows its outside.
        within: (v,) vertices that the lens can see; the others' pixels mean nothing.
        mesh: The faces before clipping, in geom frames.
    """

    points: Array
    pixels: Array
    inverse: Array
    faces: Index
    chosen: Index
    geom: NDArray[np.int32]
    lit: Float32
    within: Mask
    mesh: ModelMesh


def geom_placement(model: mujoco.MjModel, qpos: ArrayLike, pose_world_camera: Pose) -> tuple[Array, Array]:
    """Rotations (ngeom, 3, 3) and positions (ngeom, 3) of the model's geoms in the camera frame."""
    data = scratch_data(model)
    data.qpos[:] = np.asarray(qpos, dtype=float)
    mujoco.mj_kinematics(model, data)
    camera = pose_world_camera.inverse()
    camera_rotation = camera.rotation
    rotation = camera_rotation @ np.asarray(data.geom_xmat).reshape(-1, 3, 3)
    return rotation, np.asarray(data.geom_xpos) @ camera_rotation.T + camera.position


def surface_points(model: mujoco.MjModel, qpos: ArrayLike) -> Array:
    """Vertices (v, 3) of what is drawn of the model, in its world, metres."""
    rotation, position = geom_placement(model, qpos, Pose())
    mesh = cached_mesh(model)
    points = np.empty_like(mesh.vertices)
    rasteriser.transform_vertices(
        mesh.vertices, mesh.vertex_geom, rotation[mesh.geoms], position[mesh.geoms], points
    )
    return points


def project(points: Array, intrinsics: CameraIntrinsics) -> tuple[Array, Array, Mask]:
    """Pixels (n, 2), one over depth (n,), and which of the points (n, 3) the lens can see."""
    pixels, inverse, within = np.empty((len(points), 2)), np.empty(len(points)), np.empty(len(points), bool)
    limit = _SAFE_RADIUS * intrinsics.radius_limit
    rasteriser.through_lens(points, lens_vector(intrinsics), NEAR, limit, pixels, inverse, within)
    return pixels, inverse, within


def faces_in_picture(
    model: mujoco.MjModel,
    qpos: ArrayLike,
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    *,
    planes: bool = False,
) -> Faces:
    """Faces of the model where this camera sees them; round geoms are cut as finely as they are seen.

    Args:
        model: Any MuJoCo model; geoms of groups 0-2 with a colour that is not fully transparent.
        qpos: (model.nq,) full configuration.
        intrinsics: Lens of the picture to draw on.
        pose_world_camera: OpenCV camera axes (x right, y down, z forward) seen from the world.
        planes: Also draw plane geoms (floors).
    """
    rotation, position = geom_placement(model, qpos, pose_world_camera)
    segments = segments_for(model, rotation[:, :, 2], position, max(intrinsics.fx, intrinsics.fy))
    mesh = cached_mesh(model, planes=planes, segments=segments)
    rotation, position = rotation[mesh.geoms], position[mesh.geoms]
    points = np.empty_like(mesh.vertices)
    rasteriser.transform_vertices(mesh.vertices, mesh.vertex_geom, rotation, position, points)
    pixels, inverse, within = project(points, intrinsics)
    inside = bool(within.all())
    lit = np.empty((len(mesh.faces), 4, 2), dtype=np.float32)
    rasteriser.light_corners(
        mesh.corner_normals, mesh.faces, mesh.face_geom, pixels, not inside, LIGHT @ rotation,
        _HALFWAY @ rotation, _AMBIENT, lit,
    )  # fmt: skip
    every = np.arange(len(mesh.faces))
    whole = Faces(points, pixels, inverse, mesh.faces, every, mesh.face_geom_id, lit, within, mesh)
    return whole if inside else _clipped(whole, points, intrinsics)


def _clipped(whole: Faces, points: Array, intrinsics: CameraIntrinsics) -> Faces:
    """The faces with those replaced that leave the part of space which the lens can see."""
    planes = view_planes(intrinsics, NEAR)
    inside = points @ planes[:, :3].T + planes[:, 3] >= 0.0
    touching = np.logical_and.reduce(np.logical_or.reduce(inside[whole.faces], axis=1), axis=1)
    seen = whole.within[whole.faces].all(axis=1)
    added, fans, origin = (
        [np.zeros((0, 3))],
        [np.zeros((0, 4), dtype=np.int64)],
        [np.zeros(0, dtype=np.int64)],
    )
    count = len(points)
    for f in np.flatnonzero(touching & ~seen):
        cut = clip(points[whole.faces[f]], planes)
        if len(cut) >= 3:
            k = np.arange(1, len(cut) - 1)
            fans.append(count + np.stack([0 * k, k, k + 1, k + 1], axis=1))
            added.append(cut)
            origin.append(np.full(len(k), f))
            count += len(cut)
    extra = np.concatenate(added)
    pixels, inverse, _ = project(extra, intrinsics)
    source, fan = np.concatenate(origin), np.concatenate(fans)
    flat = np.repeat(whole.lit[source].mean(axis=1, keepdims=True), 4, axis=1)
    return Faces(
        np.concatenate([whole.points, extra]),
        np.concatenate([whole.pixels, pixels]),
        np.concatenate([whole.inverse, inverse]),
        np.concatenate([whole.faces, fan]),
        np.concatenate([np.flatnonzero(touching & seen), len(whole.faces) + np.arange(len(fan))]),
        np.concatenate([whole.geom, whole.geom[source]]),
        np.concatenate([whole.lit, flat]).astype(np.float32),
        np.concatenate([whole.within, np.ones(len(extra), dtype=bool)]),
        whole.mesh,
    )


def bounding_box(faces: Faces, width: int, height: int, margin: int = 3) -> Box:
    """Columns and rows (x0, y0, x1, y1), half open, that the faces touch; an empty box when none."""
    every = faces.pixels if faces.within.all() else faces.pixels[faces.within]
    if not len(every) or not len(faces.chosen):
        return EMPTY
    sides = []
    for column, limit in ((every[:, 0], width), (every[:, 1], height)):
        sides.append(max(int(np.floor(column.min())) - margin, 0))
        sides.append(min(int(np.ceil(column.max())) + margin + 1, limit))
    x0, x1, y0, y1 = sides
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else EMPTY


@lru_cache(maxsize=64)
def _cells(count: int, width: int) -> tuple[Float32, Float32, int, int, tuple[float, float]]:
    """Samples in a row of cells, each of one column and so many rows of pixels that they fill the lanes.

    Returns columns (width lanes,), rows off the cell's middle, rows of pixels in a cell, samples in one, and
    the farthest column and row of a sample off the middle of its cell.
    """
    tall = max(rasteriser.LANES // count, 1)
    below = np.arange(tall) - 0.5 * (tall - 1)
    down = (below[:, None] + SAMPLES[count][:, 1]).reshape(-1)
    across_offset = np.tile(SAMPLES[count][:, 0], tall)
    across = (np.arange(width)[:, None] + across_offset).reshape(-1)
    reach = (float(np.abs(across_offset).max()), float(np.abs(down).max()))
    return across.astype(np.float32), np.tile(down, width).astype(np.float32), tall, tall * count, reach


class SurfaceSamples:
    """The nearest surface at each sample of the pixels of ``box``; fill it with things, then look.

    Attributes:
        box: (x0, y0, x1, y1) pixels, half open.
    """

    def __init__(self, box: Box, count: int = 4) -> None:
        self.box, self._count = box, count
        height, width = box[3] - box[1], box[2] - box[0]
        self._cells = _cells(count, width)
        self._tall = self._cells[2]
        shape = (-(-height // self._tall), width * self._cells[3])
        self._depth = np.zeros(shape, dtype=np.float32)
        self._whose = np.zeros(shape, dtype=np.int32)
        self._light = np.zeros((1, 12), dtype=np.float32)
        self._owner = np.full(1, -1)
        self._extent = np.zeros((shape[0], 2), dtype=np.int64)
        self._extent[:, 0] = width

    def fill(self, faces: Faces, *, occluders: Mask | bool = False) -> None:
        """Adds faces; ``occluders`` (ngeom,) or all: they hide what is behind them and are not drawn.

        Only one model may be there that is not all occluders: the last.
        """
        hidden = occluders[faces.geom] if isinstance(occluders, np.ndarray) else occluders
        before = len(self._owner) - 1
        self._owner = np.concatenate([self._owner, np.where(hidden, -1, faces.geom)])
        light = np.empty((len(faces.faces) + 1, 12), dtype=np.float32)
        light[0] = 0.0
        across, down, tall, lanes, reach = self._cells
        rasteriser.fill_faces(
            faces.pixels, faces.inverse, faces.lit, faces.faces, faces.chosen, before, *self.box[:2],
            across, down, tall, lanes, reach, self._depth.view(np.int32), self._whose, light, self._extent,
        )  # fmt: skip
        self._light = np.concatenate([self._light, light[1:]]) if before else light

    def _pixels(self, cells: NDArray[Any]) -> NDArray[Any]:
        """Cells as (h, w, n): each pixel's samples; no copy for one sample of them."""
        x0, y0, x1, y1 = self.box
        each = cells.reshape(len(cells), x1 - x0, self._tall, self._count)
        return each.transpose(0, 2, 1, 3).reshape(-1, x1 - x0, self._count)[: y1 - y0]

    @property
    def depth(self) -> Float32:
        """(h, w, n) one over depth at each sample, 0 where nothing is."""
        return self._pixels(self._depth)

    def geoms(self) -> Index:
        """Geom id at each sample (h, w, n); -1 where nothing is, or an occluder."""
        return self._owner[self._pixels(self._whose)]

    def layer(self, base: Array) -> Layer:
        """What is seen, in colours ``base`` (ngeom, 3) of 0..255."""
        shape = (self.box[3] - self.box[1], self.box[2] - self.box[0])
        colour, coverage = np.zeros((*shape, 3), dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
        rasteriser.resolve(
            self._whose, self._tall, (0,) * self._count, self._light, self._extent, self._owner,
            base.astype(np.float32), np.float32(_GLOSS), colour, coverage,
        )  # fmt: skip
        return Layer(self.box, colour, coverage)


def base_colours(model: mujoco.MjModel, tint: tuple[float, float, float] | None = None) -> Array:
    """BGR (ngeom, 3) of 0..255: each geom's own colour, or ``tint``."""
    own = geom_rgba(model)[:, 2::-1] * 255.0
    return np.ascontiguousarray(
        own if tint is None else np.broadcast_to(np.array(tint, dtype=float), own.shape)
    )


def lit_colours(base: Array, normals: Array) -> Array:
    """Colours (n, 3) of surfaces of colour ``base`` (n, 3) with ``normals`` (n, 3) in the camera frame."""
    wrapped = 0.5 + 0.5 * normals @ LIGHT
    shine = np.maximum(normals @ _HALFWAY, 0.0) ** 32
    light = np.maximum(_AMBIENT + (1.0 - _AMBIENT) * wrapped**2, 0.0)
    return np.minimum(base * light[:, None] + (_GLOSS * shine)[:, None], 255.0)


def paint_mask(
    shape: tuple[int, int], faces: Faces, corner: tuple[int, int] = (0, 0), count: int = 4
) -> Image:
    """Silhouette (h, w), 255 inside, smooth; its pixel (0, 0) is ``corner`` of the picture."""
    samples = SurfaceSamples((corner[0], corner[1], corner[0] + shape[1], corner[1] + shape[0]), count)
    samples.fill(faces)
    return np.rint((samples.depth > 0).mean(axis=2) * 255).astype(np.uint8)
