"""The robot in a synthetic photograph: its surface by rays, smooth edges, its own soft shadows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.painter import bounding_box, faces_in_picture, paint_mask
from robot_ik.camera.made_up.view import Box, Quality, View, enlarged, lattice, softened, tiles

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Gloss of painted metal: strength and sharpness of the highlight (Blinn 1977).
_GLOSS, _SHARPNESS = 0.16, 40.0
# Subrays of a pixel on a geom's edge: five rooks on a chess board of pixel fifths.
_ROOKS = (np.array([[0, 1], [1, 3], [2, 0], [3, 2], [4, 4]]) + 0.5) / 5.0 - 0.5


@dataclass(frozen=True)
class RobotLayer:
    """The robot on the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels, half open.
        colour: (h, w, 3) BGR times coverage, 1 is white.
        coverage: (h, w) part of each pixel that shows the robot.
        lit: (h, w, 2) part of lamp and ceiling that reaches it.
    """

    box: Box
    colour: Float32
    coverage: Float32
    lit: Float32


class RobotRenderer:
    """Renders one model in one view."""

    def __init__(self, view: View, model: mujoco.MjModel) -> None:
        self._view, self._model = view, model
        # planes and height fields are not bounded by the painter's faces: then look everywhere
        endless = [int(k) for k in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)]
        self._bounded = not np.isin(np.asarray(model.geom_type), endless).any()

    def _region(self, qpos: ArrayLike) -> tuple[Box, Mask] | None:
        """Pixels (box, mask) that the robot can touch."""
        w, h = self._view.field.intrinsics.size
        if not self._bounded:
            return (0, 0, w, h), np.ones((h, w), dtype=bool)
        faces = faces_in_picture(self._model, qpos, self._view.field.intrinsics, self._view.camera)
        box = bounding_box(faces, w, h, margin=6)
        if box[2] <= box[0]:
            return None
        mask = paint_mask((box[3] - box[1], box[2] - box[0]), faces, box[:2])
        return box, cv2.dilate(mask, np.ones((5, 5), np.uint8)) > 0

    def render(self, qpos: ArrayLike, quality: Quality) -> RobotLayer | None:
        region = self._region(qpos)
        if region is None:
            return None
        box, mask = region
        stride = quality.stride
        x, y = lattice(box, stride)
        ideal = self._view.field.box(*box) if stride == 1 else self._view.field.grid(x, y)
        size = (box[3] - box[1], box[2] - box[0])
        rows = np.clip(np.rint(y).astype(int) - box[1], 0, size[0] - 1)
        columns = np.clip(np.rint(x).astype(int) - box[0], 0, size[1] - 1)
        asked = np.flatnonzero(mask[np.ix_(rows, columns)])
        rays = self._view.world(ideal.reshape(-1, 2)[asked])
        hits = self._view.robot.cast(self._view.camera.position, rays)
        behind = self._view.stage.depth[box[1] : box[3], box[0] : box[2]][np.ix_(rows, columns)].reshape(-1)[
            asked
        ]
        on = np.flatnonzero(hits.depth < behind)
        points = self._view.camera.position + rays[on] * hits.depth[on, None]
        shape = (len(y), len(x))
        geom = np.full(shape, -1)
        geom.reshape(-1)[asked[on]] = hits.geom[on]
        normal = np.zeros((*shape, 3))
        normal.reshape(-1, 3)[asked[on]] = hits.normal[on]
        seen = self._own_shadows(
            points, asked[on], shape, max(1, quality.self_stride // stride), quality.self_spots
        )
        colour = np.zeros((*shape, 3), dtype=np.float32)
        visible = seen.reshape(-1, 2)[asked[on]]
        colour.reshape(-1, 3)[asked[on]] = self._shade(
            hits.geom[on], points, hits.normal[on], rays[on], visible
        )
        coverage = (geom >= 0).astype(np.float32)
        if stride == 1:
            self._smooth_edges(box, geom, normal, seen, colour, coverage)
        else:
            both = enlarged(np.dstack([colour, coverage, seen]), stride, size)
            colour, coverage, seen = both[..., :3], both[..., 3], both[..., 4:]
        return RobotLayer(box, colour, coverage, seen)

    def _own_shadows(
        self, points: Array, places: NDArray[np.int64], shape: tuple[int, int], stride: int, spots: int
    ) -> Float32:
        """Light (h, w, 2) on the robot: asked on a lattice, smoothed over the robot's pixels only."""
        row, column = np.unravel_index(places, shape)
        chosen = np.flatnonzero((row % stride == 0) & (column % stride == 0))
        small = (-(-shape[0] // stride), -(-shape[1] // stride))
        packed = np.zeros((*small, 3), dtype=np.float32)
        i, j = row[chosen] // stride, column[chosen] // stride
        packed[i, j, :2] = self._view.visibility(points[chosen], tiles(small)[i, j], spots)
        packed[i, j, 2] = 1.0
        # pixels beside the lattice borrow from further away
        soft = softened(packed) + 1e-3 * cv2.GaussianBlur(packed, (0, 0), 4.0)
        seen = soft[..., :2] / np.maximum(soft[..., 2:], 1e-9)
        return np.ascontiguousarray(np.clip(enlarged(seen, stride, shape), 0.0, 1.0))

    def _shade(
        self, geom: NDArray[np.int32], points: Array, normals: Array, rays: Array, visible: ArrayLike
    ) -> Array:
        """Colour (n, 3) of robot surfaces: flat reflectance plus a highlight of the lamp."""
        seen = np.asarray(visible, dtype=float)
        lamp, ceiling, ambient = self._view.lights.terms(points, normals)
        light = ambient + lamp * seen[:, 0] + ceiling * seen[:, 1]
        way = self._view.lights.lamp - points
        half = way / np.linalg.norm(way, axis=1, keepdims=True) - rays / np.linalg.norm(
            rays, axis=1, keepdims=True
        )
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        shine = np.maximum(np.einsum("ij,ij->i", half, normals), 0.0) ** _SHARPNESS
        return np.asarray(
            self._view.robot.colours[geom] * light[:, None] + (_GLOSS * shine * seen[:, 0])[:, None]
        )

    def _smooth_edges(
        self,
        box: Box,
        geom: NDArray[np.int64],
        normal: Array,
        seen: Float32,
        colour: Float32,
        coverage: Float32,
    ) -> None:
        """Replaces pixels on edges of geoms by the mean of five subrays each, in place."""
        kernel = np.ones((3, 3), np.uint8)
        edge = cv2.morphologyEx(geom.astype(np.int16), cv2.MORPH_GRADIENT, kernel) > 0
        for k in range(3):
            edge |= cv2.morphologyEx(normal[..., k].astype(np.float32), cv2.MORPH_GRADIENT, kernel) > 0.35
        rows, columns = np.nonzero(edge)
        if not len(rows):
            return
        pixels = np.stack([columns + box[0], rows + box[1]], axis=1)[:, None, :] + _ROOKS
        rays = self._view.world(self._view.field.points(pixels.reshape(-1, 2)))
        hits = self._view.robot.cast(self._view.camera.position, rays)
        behind = np.repeat(self._view.stage.depth[rows + box[1], columns + box[0]], len(_ROOKS))
        on = np.flatnonzero(hits.depth < behind)
        points = self._view.camera.position + rays[on] * hits.depth[on, None]
        total = np.zeros((len(rays), 4))
        visible = np.repeat(seen[rows, columns], len(_ROOKS), axis=0)[on]
        total[on, :3] = self._shade(hits.geom[on], points, hits.normal[on], rays[on], visible)
        total[on, 3] = 1.0
        mean = total.reshape(len(rows), len(_ROOKS), 4).mean(axis=1)
        colour[rows, columns], coverage[rows, columns] = mean[:, :3], mean[:, 3]
