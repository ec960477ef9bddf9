"""A painted scene: table, floor, robot with its shadow, and exact printed sheets.

Light is reflectance times illumination, 0 to 1, and is blended linearly. The edge between print
and paper then has its half value exactly on the edge, as the fit of corners assumes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.drawing.drawn_robot import SHADOW_STRENGTH, cast_shadow
from robot_ik.camera.drawing.faces import (
    EMPTY,
    Faces,
    bounding_box,
    faces_in_picture,
    light_on,
)
from robot_ik.camera.drawing.painter import Layer, SurfaceBuffer, geom_paint
from robot_ik.camera.drawing.prints import (
    PRINT_MARKER,
    SUBPIXELS,
    Blocker,
    Print,
    ProjectedPrint,
    print_box,
    project_print,
)
from robot_ik.camera.drawing.rays import ray_field, world_directions
from robot_ik.camera.drawing.studio import Room, empty_room
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Mask

#: Reflectance of toner and of paper.
INK = 0.07
PAPER = 0.93
# An object hides paper if it is nearer by this, metres. Paper lies on other surfaces.
_SLACK = 1.5e-3
# A sheet lies on the table if it is this near to it, metres, and this level (cosine).
_ON_TABLE = 5e-3
_LEVEL = 0.999

_ROOM = Room(wall=(0.62, 0.60, 0.58), floor=(0.55, 0.535, 0.52))
# Standard deviation of the edge of the robot's shadow, in heights of the robot in the picture. A
# round light of diameter D at the distance L blurs the shadow of an edge at the height h by
# D / 4 / L * h / c. D / 4 is the standard deviation of a uniform disc along one axis. c is the
# cosine between the light and the vertical, 0.86 to 0.89 in the scenes of puma560, so101, ur5e and
# panda. A window of 1.75 m at 2 m gives 0.25 for the top of the robot. Lower parts are blurred as
# much: there is one blur for the whole shadow.
_ROOM_SOFTNESS = 0.25
_TABLE_RGBA = (0.66, 0.54, 0.40, 1.0)
_LEG_RGBA = (0.20, 0.21, 0.22, 1.0)
# Thickness of the top of the table, and half the side of its legs, metres.
_TOP_THICKNESS = 0.03
_LEG_HALF = 0.02
# Distance of the middle of a leg from the edges of the table, metres.
_LEG_INSET = 0.03
# Height of the table's top above the floor where the top is the origin plane, metres.
_TABLE_HEIGHT = 0.7
# A table whose top is higher than this stands on the origin plane, metres.
_RAISED = 0.2


@dataclass(frozen=True)
class SceneTable:
    """A rectangular table on the floor; world frame, metres.

    Attributes:
        height: Of its top above the origin plane.
        x: Where its top begins and ends.
        y: Where its top begins and ends.
    """

    height: float = 0.0
    x: tuple[float, float] = (-0.6, 0.6)
    y: tuple[float, float] = (-0.6, 0.6)

    @property
    def floor_height(self) -> float:
        """Height of the floor: the origin plane below a raised table, else 0.7 m below the top."""
        return 0.0 if self.height > _RAISED else self.height - _TABLE_HEIGHT


@dataclass(frozen=True)
class PlacedPrint:
    """A print, in metres, at a place in the world.

    Attributes:
        sheet: The print.
        pose_world: Of the print: x right, y down, z into the paper.
        on_robot: Whether the robot carries it.
    """

    sheet: Print
    pose_world: Pose
    on_robot: bool


@dataclass(frozen=True, eq=False)
class Exposure:
    """The light on the sensor.

    Attributes:
        light: (h, w, 3) BGR, 1 is white in full light.
        sheets: Each projected print; None if it is turned away or outside the picture.
    """

    light: Float32
    sheets: list[ProjectedPrint | None]


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """The static part of the picture of a camera at rest. The arrays must not be changed.

    Attributes:
        light: (h, w, 3) of floor, wall and table.
        table: (h, w) part of each pixel that shows the table, 0 to 1.
        buffer: Depth of the table at the samples of the whole picture; None without a table.
    """

    light: Float32
    table: Float32
    buffer: SurfaceBuffer | None


class PaintedScene:
    """A model in static surroundings, in the picture of one camera.

    Args:
        model: The robot or the objects.
        intrinsics: The lens.
        pose_world_camera: OpenCV camera axes seen from the world.
        table: None for no table: then the robot stands on the floor.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        intrinsics: CameraIntrinsics,
        pose_world_camera: Pose,
        table: SceneTable | None,
    ) -> None:
        self._model = model
        self._lens = intrinsics
        self._camera = pose_world_camera
        self._table = table
        self._field = ray_field(intrinsics)
        self._surroundings = _surroundings(intrinsics, pose_world_camera, table)
        self._paint = geom_paint(model)
        self._ground = Pose((0.0, 0.0, table.height if table is not None else 0.0))

    def expose(self, qpos: ArrayLike, sheets: Sequence[PlacedPrint] = ()) -> Exposure:
        """Paint the robot at its true configuration ``qpos`` (model.nq,) and the sheets."""
        light = self._surroundings.light.copy()
        faces = faces_in_picture(self._model, qpos, self._lens, self._camera)
        shadow = cast_shadow(faces, self._lens, self._in_camera(self._ground), _ROOM_SOFTNESS)
        self._shade_ground(light, shadow)
        box = bounding_box(faces, *self._lens.size)
        robot = Layer.empty()
        behind = light[:0, :0]
        if box != EMPTY:
            x0, y0, x1, y1 = box
            behind = light[y0:y1, x0:x1].copy()
            robot = self._painted_robot(faces, box)
            view = light[y0:y1, x0:x1]
            view *= 1.0 - _share(robot.coverage)[..., None]
            view += _share(robot.colour)
        projected = [self._add(light, sheet, faces, robot, behind, shadow) for sheet in sheets]
        return Exposure(light, projected)

    def _in_camera(self, pose_world: Pose) -> Pose:
        """Return a world pose in the frame of the camera."""
        return self._camera.inverse().compose(pose_world)

    def _shade_ground(self, light: Float32, shadow: Layer) -> None:
        """Darken table, or floor, by the robot's shadow, in place."""
        if not shadow.coverage.size:
            return
        x0, y0, x1, y1 = shadow.box
        dark = SHADOW_STRENGTH * _share(shadow.coverage)
        if self._table is not None:
            dark *= self._surroundings.table[y0:y1, x0:x1]
        light[y0:y1, x0:x1] *= 1.0 - dark[..., None]

    def _painted_robot(self, faces: Faces, box: Box) -> Layer:
        """Return the robot where the table does not hide it."""
        buffer = SurfaceBuffer(box)
        still = self._surroundings.buffer
        if still is not None:
            x0, y0, x1, y1 = (buffer.samples * v for v in box)
            buffer.depth[:] = still.depth[y0:y1, x0:x1]
        buffer.fill(faces, self._paint)
        return buffer.layer()

    def _add(
        self,
        light: Float32,
        placed: PlacedPrint,
        faces: Faces,
        robot: Layer,
        behind: Float32,
        shadow: Layer,
    ) -> ProjectedPrint | None:
        """Paint one sheet over the light, in place, where nothing hides it."""
        pose = self._in_camera(placed.pose_world)
        box = print_box(placed.sheet, pose, self._field)
        if box is None:
            return None
        blocker = self._blocker(faces, _intersection(box, robot.box))
        projected = project_print(placed.sheet, pose, self._field, blocker)
        if projected is None:
            return None
        x0, y0, x1, y1 = projected.box
        tone = (PAPER + (INK - PAPER) * projected.ink) * float(light_on(-pose.rotation[:, 2]))
        if not placed.on_robot:
            tone *= 1.0 - SHADOW_STRENGTH * self._shadow_on(placed, faces, shadow, projected.box)
        cover = projected.coverage[..., None].astype(np.float32)
        view = light[y0:y1, x0:x1]
        beside = _beside(view, projected, robot, behind, on_robot=placed.on_robot)
        view[:] = beside * (1.0 - cover) + cover * tone[..., None].astype(np.float32)
        return projected

    def _shadow_on(
        self, placed: PlacedPrint, faces: Faces, ground_shadow: Layer, box: Box
    ) -> Float32:
        """Return the robot's shadow (h, w), 0 to 1, on the pixels of a sheet."""
        plane = placed.pose_world.compose(PRINT_MARKER.inverse())
        height = float(plane.position[2] - self._ground.position[2])
        shadow = ground_shadow
        if not (abs(height) < _ON_TABLE and plane.rotation[2, 2] > _LEVEL):
            shadow = cast_shadow(faces, self._lens, self._in_camera(plane), _ROOM_SOFTNESS)
        return _cropped(_share(shadow.coverage), shadow.box, box)

    def _blocker(self, faces: Faces, box: Box) -> Blocker:
        """Return a function that returns the points of paper that the robot or the table hides."""
        buffer = SurfaceBuffer(box, SUBPIXELS)
        if box != EMPTY:
            buffer.fill(faces, self._paint)
        rows, columns = buffer.depth.shape

        def blocked(pixels: Array, depth: Array) -> Mask:
            hidden = self._below_table(pixels, depth)
            column, row = np.rint((pixels - box[:2] + 0.5) * SUBPIXELS - 0.5).astype(int).T
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            inverse = buffer.depth[row[inside], column[inside]]
            hidden[inside] |= inverse * (depth[inside] - _SLACK) > 1.0
            return hidden

        return blocked

    def _below_table(self, pixels: Array, depth: Array) -> Mask:
        """Return whether the table's top is in front of points at pixels (n, 2) and depths (n,)."""
        if self._table is None:
            return np.zeros(len(pixels), dtype=bool)
        directions = world_directions(self._camera, self._field.points(pixels))
        eye = self._camera.position
        with np.errstate(divide="ignore", invalid="ignore"):
            top = (self._table.height - eye[2]) / directions[:, 2]
            x = eye[0] + top * directions[:, 0]
            y = eye[1] + top * directions[:, 1]
            nearer = (top > 0.0) & (top < depth - _SLACK)
        left, right = self._table.x
        near, far = self._table.y
        return np.asarray(nearer & (x > left) & (x < right) & (y > near) & (y < far))


def _beside(
    view: Float32, projected: ProjectedPrint, robot: Layer, behind: Float32, *, on_robot: bool
) -> Float32:
    """Return the light (h, w, 3) in the part of each pixel that a sheet does not cover.

    At the outline of the robot that is the robot alone for a sheet behind it, and the background of
    the robot for a sheet that ends where the robot ends.
    """
    box = _intersection(projected.box, robot.box)
    if box == EMPTY:
        return view
    edge = _cropped(_share(robot.coverage), robot.box, projected.box)
    mixed = (edge > 0) & (edge < 1) & (projected.coverage > 0) & (projected.coverage < 1)
    if not mixed.any():
        return view
    result = view.copy()
    if on_robot:
        result[mixed] = _cropped(behind, robot.box, projected.box)[mixed]
    else:
        colour = _cropped(_share(robot.colour), robot.box, projected.box)
        result[mixed] = colour[mixed] / edge[mixed][:, None]
    return result


def _share(values: ArrayLike) -> Float32:
    """Return bytes as float32 of 0 to 1."""
    return np.multiply(values, np.float32(1.0 / 255.0), dtype=np.float32)


def _intersection(a: Box, b: Box) -> Box:
    """Return the pixels that two boxes share."""
    box = (max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3]))
    return box if box[2] > box[0] and box[3] > box[1] else EMPTY


def _cropped(values: Float32, box: Box, wanted: Box) -> Float32:
    """Return the values on the pixels of another box, 0 where there are none."""
    x0, y0, x1, y1 = wanted
    result = np.zeros((y1 - y0, x1 - x0, *values.shape[2:]), dtype=np.float32)
    a0, b0, a1, b1 = _intersection(box, wanted)
    if a1 > a0:
        part = values[b0 - box[1] : b1 - box[1], a0 - box[0] : a1 - box[0]]
        result[b0 - y0 : b1 - y0, a0 - x0 : a1 - x0] = part
    return result


# The surroundings of a picture of 1280x720 take 37 MB.
@lru_cache(maxsize=2)
def _surroundings(
    intrinsics: CameraIntrinsics, pose_world_camera: Pose, table: SceneTable | None
) -> _Surroundings:
    """Return the (cached) surroundings that a camera sees."""
    width, height = intrinsics.size
    if table is None:
        light = empty_room(intrinsics, pose_world_camera, _ROOM, 0.0, (0.0, 0.0))
        return _Surroundings(light, np.zeros((height, width), dtype=np.float32), None)
    middle = (float(np.mean(table.x)), float(np.mean(table.y)))
    floor = table.floor_height
    light = empty_room(intrinsics, pose_world_camera, _ROOM, floor, middle).copy()
    model = _table_model(table)
    faces = faces_in_picture(model, [], intrinsics, pose_world_camera)
    pose_camera_floor = pose_world_camera.inverse().compose(Pose((0.0, 0.0, floor)))
    shadow = cast_shadow(faces, intrinsics, pose_camera_floor)
    if shadow.coverage.size:
        x0, y0, x1, y1 = shadow.box
        light[y0:y1, x0:x1] *= 1.0 - SHADOW_STRENGTH * _share(shadow.coverage)[..., None]
    buffer = SurfaceBuffer((0, 0, width, height))
    buffer.fill(faces, geom_paint(model))
    layer = buffer.layer()
    cover = _share(layer.coverage)
    light *= 1.0 - cover[..., None]
    light += _share(layer.colour)
    return _Surroundings(light, cover, buffer)


@lru_cache(maxsize=4)
def _table_model(table: SceneTable) -> mujoco.MjModel:
    """Return the table as a model: a top and four legs."""
    spec = mujoco.MjSpec()
    x0, x1 = table.x
    y0, y1 = table.y
    floor = table.floor_height
    middle_x = 0.5 * (x0 + x1)
    middle_y = 0.5 * (y0 + y1)
    half_x = 0.5 * (x1 - x0)
    half_y = 0.5 * (y1 - y0)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[middle_x, middle_y, table.height - 0.5 * _TOP_THICKNESS],
        size=[half_x, half_y, 0.5 * _TOP_THICKNESS],
        rgba=_TABLE_RGBA,
    )
    leg = 0.5 * (table.height - _TOP_THICKNESS - floor)
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            x = middle_x + side_x * (half_x - _LEG_INSET)
            y = middle_y + side_y * (half_y - _LEG_INSET)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[x, y, floor + leg],
                size=[_LEG_HALF, _LEG_HALF, leg],
                rgba=_LEG_RGBA,
            )
    return spec.compile()
