"""A synthetic photograph: the robot, its shadows and the markers put into a still scene, by rays.

Values are reflectance times light in 0..1, blended linearly in the picture's own 8-bit scale (no gamma):
so an edge between print and paper has its half value exactly on the edge, as marker refinement assumes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.raycast import Caster, ray_field
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.lights import Lights
from robot_ik.camera.made_up.printed import PaintedMarker, Sheet, nearer, paint_marker
from robot_ik.camera.made_up.robot_layer import RobotLayer, RobotRenderer
from robot_ik.camera.made_up.stage import Stage, Table
from robot_ik.camera.made_up.view import Quality, View, enlarged, lattice, softened, tiles
from robot_ik.geometry import Pose

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

# The robot's shadow is not looked for on things farther than this, metres.
_SHADOW_REACH = 8.0


@dataclass(frozen=True)
class PlacedSheet:
    """A printed sheet at a place: side and white margin in metres, pose in the world."""

    sheet: Sheet
    size: float
    margin: float
    pose_world: Pose
    on_robot: bool


class Photographer:
    """Takes pictures of one model on one stage with one camera."""

    def __init__(
        self,
        model: mujoco.MjModel,
        intrinsics: CameraIntrinsics,
        pose_world_camera: Pose,
        table: Table | None,
        lights: Lights,
        subject: Array,
    ) -> None:
        stage = Stage(intrinsics, pose_world_camera, table, lights, subject).picture
        self._view = View(ray_field(intrinsics), pose_world_camera, lights, Caster(model), stage)
        self._renderer = RobotRenderer(self._view, model)

    def expose(
        self, qpos: ArrayLike, sheets: list[PlacedSheet], quality: Quality
    ) -> tuple[Float32, list[PaintedMarker | None]]:
        """The light on the sensor (h, w, 3), 1 is white, and each sheet as it fell on the pixels.

        Args:
            qpos: (model.nq,) true configuration.
            sheets: Markers to paint.
            quality: How finely.
        """
        self._view.robot.place(qpos)
        lit = self._stage_visibility(quality)
        stage = self._view.stage
        lamp, ceiling = (cv2.merge([share] * 3) for share in cv2.split(lit))
        picture = np.asarray(cv2.multiply(stage.lamp, lamp, dst=lamp), dtype=np.float32)
        picture += stage.ambient
        picture += cv2.multiply(stage.ceiling, ceiling, dst=ceiling)
        empty = picture.copy() if sheets else picture
        layer = self._renderer.render(qpos, quality)
        if layer is not None:
            x0, y0, x1, y1 = layer.box
            view = picture[y0:y1, x0:x1]
            view *= 1.0 - layer.coverage[..., None]
            view += layer.colour
            front = layer.coverage > 0.5
            lit[y0:y1, x0:x1][front] = layer.lit[front]
        painted = [self._add_sheet(picture, empty, layer, lit, sheet) for sheet in sheets]
        return picture, painted

    def _stage_visibility(self, quality: Quality) -> Float32:
        """Light (h, w, 2) that the robot leaves to table and floor."""
        w, h = self._view.field.intrinsics.size
        stride = quality.stage_stride
        x, y = lattice((0, 0, w, h), stride)
        rays = self._view.world(self._view.field.grid(x, y).reshape(-1, 2))
        rows, columns = np.minimum(np.rint(y).astype(int), h - 1), np.minimum(np.rint(x).astype(int), w - 1)
        depth = self._view.stage.depth[np.ix_(rows, columns)].reshape(-1).astype(float)
        seen = np.full((len(rays), 2), 1.0, dtype=np.float32)
        near = np.flatnonzero(depth < _SHADOW_REACH)
        points = self._view.camera.position + rays[near] * depth[near, None]
        seen[near] = self._view.visibility(
            points, tiles((len(y), len(x))).reshape(-1)[near], quality.stage_spots
        )
        return enlarged(softened(seen.reshape(len(y), len(x), 2)), stride, (h, w))

    def _add_sheet(
        self, picture: Float32, empty: Float32, layer: RobotLayer | None, lit: Float32, placed: PlacedSheet
    ) -> PaintedMarker | None:
        """Paints one sheet over the picture where nothing hides it."""
        pose = self._view.camera.inverse().compose(placed.pose_world)

        def blocked(rays: Array, depth: Array) -> Mask:
            pixels = self._view.field.intrinsics.distort(rays)
            w, h = self._view.field.intrinsics.size
            column = np.clip(np.rint(pixels[:, 0]).astype(int), 0, w - 1)
            row = np.clip(np.rint(pixels[:, 1]).astype(int), 0, h - 1)
            hidden = nearer(self._view.stage.depth[row, column], depth)
            if layer is not None:
                x0, y0, x1, y1 = layer.box
                ask = np.flatnonzero((column >= x0) & (column < x1) & (row >= y0) & (row < y1))
                hits = self._view.robot.cast(
                    self._view.camera.position, self._view.world(rays[ask]), normals=False
                )
                hidden[ask] |= nearer(hits.depth, depth[ask])
            return hidden

        painted = paint_marker(placed.sheet, placed.size, placed.margin, pose, self._view.field, blocked)
        if painted is None:
            return None
        x0, y0, x1, y1 = painted.box
        ideal = self._view.field.box(*painted.box).reshape(-1, 2)
        depth = np.nan_to_num(painted.depth.reshape(-1, 1), nan=1.0)
        points = self._view.camera.position + self._view.world(ideal) * depth
        normals = np.broadcast_to(placed.pose_world.rotation[:, 2], points.shape)
        lamp, ceiling, ambient = self._view.lights.terms(points, normals)
        view, seen = picture[y0:y1, x0:x1], lit[y0:y1, x0:x1].reshape(-1, 2)
        light = (ambient + lamp * seen[:, 0] + ceiling * seen[:, 1]).reshape(painted.tone.shape)
        cover = painted.coverage[..., None].astype(np.float32)
        behind = self._behind(view, empty, layer, painted, placed.on_robot)
        view[:] = behind * (1 - cover) + cover * (painted.tone * light)[..., None].astype(np.float32)
        return painted

    def _behind(
        self, view: Float32, empty: Float32, layer: RobotLayer | None, painted: PaintedMarker, on_robot: bool
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
