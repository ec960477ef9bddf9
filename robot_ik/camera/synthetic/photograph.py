"""A synthetic photograph: the robot, its shadows and the markers put into a still scene, by rays.

Values are reflectance times light in 0..1, blended linearly in the picture's own 8-bit scale (no gamma):
so an edge between print and paper has its half value exactly on the edge, as marker refinement assumes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.painter import bounding_box, faces_in_picture, paint_mask
from robot_ik.camera.drawing.prints import Print, SeenPrint, see_print
from robot_ik.camera.drawing.raycast import Caster, ray_field, world_directions
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.scene import Lights, StillPicture, enlarged, lattice
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Mask

# Neighbouring points ask different points of a light, in a repeating tile of this side; a blur over the
# tile then gives soft shadows from few rays (interleaved sampling, Keller and Heidrich 2001).
_TILE = 4


@dataclass(frozen=True)
class Quality:
    """How much work a picture is worth.

    Attributes:
        stride: Robot rays every so many pixels; markers are exact always.
        self_stride, self_spots: Shadows on the robot: every so many pixels, so many points of each light.
        ground_stride, ground_spots: The same for shadows of the robot on table and floor.
        same_noise: Pictures share their noise, each moved to another place.
    """

    stride: int
    self_stride: int
    self_spots: int
    ground_stride: int
    ground_spots: int
    same_noise: bool = False


QUALITIES = {"full": Quality(1, 2, 2, 4, 2), "fast": Quality(3, 6, 1, 8, 1, same_noise=True)}


def tiles(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Place (h, w) of each lattice point in its tile."""
    i, j = np.indices(shape)
    return np.asarray((i % _TILE) * _TILE + j % _TILE)


def softened(picture: Float32) -> Float32:
    """Mean over one tile, then a little more, so that no pattern is left."""
    return np.asarray(cv2.GaussianBlur(cv2.blur(picture, (_TILE, _TILE)), (0, 0), 0.8), dtype=np.float32)


# ------------------------------------------------------------------------------------------
# The robot in a synthetic photograph: its surface by rays, smooth edges, its own soft shadows.


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


# Reflectances of print and paper: a laser print in a lit room.
INK, PAPER = 0.07, 0.93
# Depth in metres by which something must be nearer than the paper to hide it: paper lies on objects.
_SLACK = 1.5e-3


def _nearer(depth: Array, than: Array) -> Mask:
    """Whether objects at ``depth`` hide paper at depth ``than``."""
    return np.asarray(depth < than - _SLACK)


@dataclass(frozen=True)
class PlacedPrint:
    """A print, in metres, at a place in the world: x right, y down, z into the paper."""

    sheet: Print
    pose_world: Pose
    on_robot: bool


class Photographer:
    """Takes pictures of one model in one still scene with one camera.

    Args:
        model: The robot, without what is in the scene.
        intrinsics: The lens.
        pose_world_camera: OpenCV camera axes seen from the world.
        lights: That light the scene.
        still: The empty scene.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        intrinsics: CameraIntrinsics,
        pose_world_camera: Pose,
        lights: Lights,
        still: StillPicture,
    ) -> None:
        self._model, self._robot, self._camera = model, Caster(model), pose_world_camera
        self._field, self._lights, self._still = ray_field(intrinsics), lights, still
        # planes and height fields are not bounded by the painter's faces: then look everywhere
        endless = [int(k) for k in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)]
        self._bounded = not np.isin(np.asarray(model.geom_type), endless).any()

    def expose(
        self, qpos: ArrayLike, quality: Quality, sheets: Sequence[PlacedPrint] = ()
    ) -> tuple[Float32, RobotLayer | None, list[SeenPrint | None]]:
        """The light on the sensor (h, w, 3), 1 is white; the robot in it; each sheet as it fell on pixels.

        ``qpos`` is the true configuration (model.nq,).
        """
        self._robot.place(qpos)
        lit = self._ground_light(quality)
        still = self._still
        lamp, ceiling = (cv2.merge([share] * 3) for share in cv2.split(lit))
        picture = np.asarray(cv2.multiply(still.lamp, lamp, dst=lamp), dtype=np.float32)
        picture += still.ambient
        picture += cv2.multiply(still.ceiling, ceiling, dst=ceiling)
        empty = picture.copy() if sheets else picture
        layer = self._render_robot(qpos, quality)
        if layer is not None:
            x0, y0, x1, y1 = layer.box
            view = picture[y0:y1, x0:x1]
            view *= 1.0 - layer.coverage[..., None]
            view += layer.colour
            front = layer.coverage > 0.5
            lit[y0:y1, x0:x1][front] = layer.lit[front]
        painted = [self._add_sheet(picture, empty, layer, lit, sheet) for sheet in sheets]
        return picture, layer, painted

    def _add_sheet(
        self, picture: Float32, empty: Float32, layer: RobotLayer | None, lit: Float32, placed: PlacedPrint
    ) -> SeenPrint | None:
        """Paints one sheet over the picture where nothing hides it."""
        pose = self._camera.inverse().compose(placed.pose_world)

        def blocked(rays: Array, depth: Array) -> Mask:
            pixels = self._field.intrinsics.distort(rays)
            w, h = self._field.intrinsics.size
            column = np.clip(np.rint(pixels[:, 0]).astype(int), 0, w - 1)
            row = np.clip(np.rint(pixels[:, 1]).astype(int), 0, h - 1)
            hidden = _nearer(self._still.depth[row, column], depth)
            if layer is not None:
                x0, y0, x1, y1 = layer.box
                ask = np.flatnonzero((column >= x0) & (column < x1) & (row >= y0) & (row < y1))
                hits = self._robot.cast(
                    self._camera.position, world_directions(self._camera, rays[ask]), normals=False
                )
                hidden[ask] |= _nearer(hits.depth, depth[ask])
            return hidden

        painted = see_print(placed.sheet, pose, self._field, blocked)
        if painted is None:
            return None
        x0, y0, x1, y1 = painted.box
        normalized = self._field.box(*painted.box).reshape(-1, 2)
        depth = np.nan_to_num(painted.depth.reshape(-1, 1), nan=1.0)
        points = self._camera.position + world_directions(self._camera, normalized) * depth
        normals = np.broadcast_to(-placed.pose_world.rotation[:, 2], points.shape)
        lamp, ceiling, ambient = self._lights.terms(points, normals)
        view, seen = picture[y0:y1, x0:x1], lit[y0:y1, x0:x1].reshape(-1, 2)
        light = (ambient + lamp * seen[:, 0] + ceiling * seen[:, 1]).reshape(painted.ink.shape)
        tone = PAPER + (INK - PAPER) * painted.ink
        cover = painted.coverage[..., None].astype(np.float32)
        behind = self._behind(view, empty, layer, painted, placed.on_robot)
        view[:] = behind * (1 - cover) + cover * (tone * light)[..., None].astype(np.float32)
        return painted

    def _behind(
        self, view: Float32, empty: Float32, layer: RobotLayer | None, painted: SeenPrint, on_robot: bool
    ) -> Float32:
        """What shows in the part of a pixel that the sheet leaves.

        At the robot's outline that part is the robot alone for a sheet behind it, and the surroundings
        alone for a sheet that ends where the robot ends.
        """
        if layer is None:
            return view
        x0, y0, x1, y1 = painted.box
        edge = np.zeros(view.shape[:2], dtype=np.float32)
        robot = np.zeros_like(view)
        a0, b0 = max(x0, layer.box[0]), max(y0, layer.box[1])
        a1, b1 = min(x1, layer.box[2]), min(y1, layer.box[3])
        if a1 <= a0 or b1 <= b0:
            return view
        here = (slice(b0 - y0, b1 - y0), slice(a0 - x0, a1 - x0))
        there = (slice(b0 - layer.box[1], b1 - layer.box[1]), slice(a0 - layer.box[0], a1 - layer.box[0]))
        edge[here], robot[here] = layer.coverage[there], layer.colour[there]
        mixed = (edge > 0) & (edge < 1) & (painted.coverage > 0)
        behind = view.copy()
        if on_robot:
            behind[mixed] = empty[y0:y1, x0:x1][mixed]
        else:
            behind[mixed] = robot[mixed] / edge[mixed][:, None]
        return behind

    def _visibility(self, points: Array, tile: NDArray[np.int64], spots: int) -> Array:
        """Part (n, 2) of lamp and ceiling that each point sees past the robot.

        Args:
            points: (n, 3) world.
            tile: (n,) place of each point in its tile, 0 .. _TILE**2 - 1: which points of a light it asks.
            spots: How many it asks.
        """
        classes = _TILE * _TILE
        result = np.zeros((len(points), 2))
        for c, source in enumerate(("lamp", "ceiling")):
            for k, spot in enumerate(self._lights.spots(source, classes)):
                asking = np.flatnonzero((k - tile * 7) % classes < spots)
                result[asking, c] += self._robot.lit(spot, points[asking]) / spots
        return result

    def _ground_light(self, quality: Quality) -> Float32:
        """Part (h, w, 2) of lamp and ceiling that the robot leaves to table and floor."""
        w, h = self._field.intrinsics.size
        normalized, x, y = lattice(self._field, (0, 0, w, h), quality.ground_stride)
        rays = world_directions(self._camera, normalized.reshape(-1, 2))
        rows, columns = np.minimum(np.rint(y).astype(int), h - 1), np.minimum(np.rint(x).astype(int), w - 1)
        depth = self._still.depth[np.ix_(rows, columns)].reshape(-1).astype(float)
        seen = np.ones((len(rays), 2), dtype=np.float32)
        near = np.flatnonzero(np.isfinite(depth))
        points = self._camera.position + rays[near] * depth[near, None]
        tile = tiles((len(y), len(x))).reshape(-1)[near]
        seen[near] = self._visibility(points, tile, quality.ground_spots)
        return enlarged(softened(seen.reshape(len(y), len(x), 2)), quality.ground_stride, (h, w))

    def _region(self, qpos: ArrayLike) -> tuple[Box, Mask] | None:
        """Pixels (box, mask) that the robot can touch."""
        w, h = self._field.intrinsics.size
        if not self._bounded:
            return (0, 0, w, h), np.ones((h, w), dtype=bool)
        faces = faces_in_picture(self._model, qpos, self._field.intrinsics, self._camera)
        box = bounding_box(faces, w, h, margin=6)
        if box[2] <= box[0]:
            return None
        mask = paint_mask((box[3] - box[1], box[2] - box[0]), faces, box[:2])
        return box, cv2.dilate(mask, np.ones((5, 5), np.uint8)) > 0

    def _render_robot(self, qpos: ArrayLike, quality: Quality) -> RobotLayer | None:
        region = self._region(qpos)
        if region is None:
            return None
        box, mask = region
        stride = quality.stride
        normalized, x, y = lattice(self._field, box, stride)
        size = (box[3] - box[1], box[2] - box[0])
        rows = np.clip(np.rint(y).astype(int) - box[1], 0, size[0] - 1)
        columns = np.clip(np.rint(x).astype(int) - box[0], 0, size[1] - 1)
        asked = np.flatnonzero(mask[np.ix_(rows, columns)])
        rays = world_directions(self._camera, normalized.reshape(-1, 2)[asked])
        hits = self._robot.cast(self._camera.position, rays)
        behind = self._still.depth[box[1] : box[3], box[0] : box[2]][np.ix_(rows, columns)].reshape(-1)[asked]
        on = np.flatnonzero(hits.depth < behind)
        points = self._camera.position + rays[on] * hits.depth[on, None]
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
        self, points: Array, indices: NDArray[np.int64], shape: tuple[int, int], stride: int, spots: int
    ) -> Float32:
        """Light (h, w, 2) on the robot: asked on a lattice, smoothed over the robot's pixels only."""
        row, column = np.unravel_index(indices, shape)
        chosen = np.flatnonzero((row % stride == 0) & (column % stride == 0))
        small = (-(-shape[0] // stride), -(-shape[1] // stride))
        packed = np.zeros((*small, 3), dtype=np.float32)
        i, j = row[chosen] // stride, column[chosen] // stride
        packed[i, j, :2] = self._visibility(points[chosen], tiles(small)[i, j], spots)
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
        lamp, ceiling, ambient = self._lights.terms(points, normals)
        light = ambient + lamp * seen[:, 0] + ceiling * seen[:, 1]
        to_lamp = self._lights.lamp - points
        half = to_lamp / np.linalg.norm(to_lamp, axis=1, keepdims=True) - rays / np.linalg.norm(
            rays, axis=1, keepdims=True
        )
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        shine = np.maximum(np.einsum("ij,ij->i", half, normals), 0.0) ** _SHARPNESS
        return np.asarray(self._robot.colours[geom] * light[:, None] + (_GLOSS * shine * seen[:, 0])[:, None])

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
        rays = world_directions(self._camera, self._field.points(pixels.reshape(-1, 2)))
        hits = self._robot.cast(self._camera.position, rays)
        behind = np.repeat(self._still.depth[rows + box[1], columns + box[0]], len(_ROOKS))
        on = np.flatnonzero(hits.depth < behind)
        points = self._camera.position + rays[on] * hits.depth[on, None]
        total = np.zeros((len(rays), 4))
        visible = np.repeat(seen[rows, columns], len(_ROOKS), axis=0)[on]
        total[on, :3] = self._shade(hits.geom[on], points, hits.normal[on], rays[on], visible)
        total[on, 3] = 1.0
        mean = total.reshape(len(rows), len(_ROOKS), 4).mean(axis=1)
        colour[rows, columns], coverage[rows, columns] = mean[:, :3], mean[:, 3]
