"""Pictures of models on an empty floor: for films, the gallery and the synthetic camera.

The floor fades into a wall. It shows the soft shadows of what stands on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.drawing.drawn_robot import SHADOW_STRENGTH, cast_shadow
from robot_ik.camera.drawing.faces import EMPTY, bounding_box, faces_in_picture
from robot_ik.camera.drawing.painter import Layer, SurfaceBuffer, geom_paint
from robot_ik.camera.drawing.rays import RayField, ray_field, world_directions
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

Tone = tuple[float, float, float]

# A floor without tiles is smooth. It is computed for blocks of this many pixels along each axis.
_COARSE = 4
# A ray meets the floor at most this far away, metres.
_HORIZON = 200.0


@dataclass(frozen=True)
class Room:
    """The tones of an empty room, BGR reflectance of 0 to 1.

    Attributes:
        wall: Of the wall.
        floor: Of the floor.
        tile: Of every second tile of the floor.
        tile_side: Side of a tile, metres; 0 for a floor without tiles.
        fade_start: Distance from the subject at which the floor begins to fade into the wall,
            metres.
        fade_end: Distance at which only the wall is left, metres.
    """

    wall: Tone
    floor: Tone
    tile: Tone = (0.0, 0.0, 0.0)
    tile_side: float = 0.0
    fade_start: float = 1.6
    fade_end: float = 4.2


#: Floor and wall of one tone. Only the shadows show where the floor is.
SEAMLESS = Room(wall=(0.945, 0.94, 0.935), floor=(0.945, 0.94, 0.935))


def tiled_room(extent: float, tile_side: float) -> Room:
    """Return the room of films.

    Args:
        extent: Size of what is filmed, metres. The floor reaches several times as far.
        tile_side: Side of a tile, metres.
    """
    return Room(
        wall=(0.95, 0.94, 0.925),
        floor=(0.90, 0.895, 0.885),
        tile=(0.83, 0.82, 0.805),
        tile_side=tile_side,
        fade_start=2.0 * extent,
        fade_end=7.0 * extent,
    )


@dataclass(frozen=True, eq=False)
class Body:
    """A model in the studio.

    Attributes:
        model: Any MuJoCo model. Its planes (floors) are not drawn.
        qpos: (model.nq,) full configuration.
        pose: Of the model's world in that of the studio.
        tint: One BGR colour of 0 to 255 for all geoms, instead of their own.
    """

    model: mujoco.MjModel
    qpos: ArrayLike
    pose: Pose = Pose()
    tint: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Photo:
    """A finished picture.

    Attributes:
        image: (h, w, 3) BGR.
        coverage: (h, w) uint8, 255 where bodies hide the room.
        intrinsics: Lens of the picture.
        camera: ``pose_world_camera``.
    """

    image: Image
    coverage: Image
    intrinsics: CameraIntrinsics
    camera: Pose


def photograph(
    bodies: Sequence[Body],
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    room: Room,
    *,
    floor: float = 0.0,
    subject: tuple[float, float] = (0.0, 0.0),
) -> Photo:
    """Take a picture of bodies in a room.

    Args:
        bodies: They hide each other, and each throws a shadow on the floor.
        intrinsics: Lens of the picture.
        pose_world_camera: OpenCV camera axes seen from the world of the studio.
        room: What is behind the bodies.
        floor: Height of the floor, metres.
        subject: (x, y) of the middle of the floor.
    """
    light = empty_room(intrinsics, pose_world_camera, room, floor, subject)
    image = np.rint(255.0 * light).astype(np.uint8)
    pose_camera_floor = pose_world_camera.inverse().compose(Pose((0.0, 0.0, floor)))
    visible = []
    boxes: list[Box] = []
    for body in bodies:
        camera = body.pose.inverse().compose(pose_world_camera)
        faces = faces_in_picture(body.model, body.qpos, intrinsics, camera)
        box = bounding_box(faces, *intrinsics.size)
        cast_shadow(faces, intrinsics, pose_camera_floor).over(image, SHADOW_STRENGTH)
        if box != EMPTY:
            visible.append((faces, geom_paint(body.model, body.tint)))
            boxes.append(box)
    layer = Layer.empty()
    if boxes:
        corners = np.array(boxes)
        x0, y0 = corners[:, :2].min(axis=0).tolist()
        x1, y1 = corners[:, 2:].max(axis=0).tolist()
        buffer = SurfaceBuffer((x0, y0, x1, y1))
        for faces, paint in visible:
            buffer.fill(faces, paint)
        layer = buffer.layer()
        layer.over(image)
    return Photo(image, layer.mask(*intrinsics.size), intrinsics, pose_world_camera)


@lru_cache(maxsize=32)
def ball_model(radius: float, rgba: tuple[float, float, float, float]) -> mujoco.MjModel:
    """Return a model of one ball round the origin of its world."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], rgba=rgba)
    return spec.compile()


@lru_cache(maxsize=2)
def empty_room(
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    room: Room,
    floor: float,
    subject: tuple[float, float],
) -> Float32:
    """Return the (cached) light (h, w, 3), 0 to 1, of a room without anything in it."""
    field = ray_field(intrinsics)
    width, height = intrinsics.size
    stride = 1 if room.tile_side > 0.0 else _COARSE
    x, y, depth = _on_floor(field, pose_world_camera, floor, stride)
    away = np.hypot(x - subject[0], y - subject[1])
    fade = np.clip((away - room.fade_start) / (room.fade_end - room.fade_start), 0.0, 1.0)
    fade = np.where(depth < _HORIZON, fade * fade * (3.0 - 2.0 * fade), 1.0)
    tone = np.broadcast_to(np.array(room.floor, dtype=np.float32), (*x.shape, 3))
    if room.tile_side > 0.0:
        other = _checker(x, y, room.tile_side, _footprint(depth, pose_world_camera, floor, field))
        tone = tone + other[..., None] * (np.array(room.tile) - np.array(room.floor))
    wall = np.array(room.wall)
    light = (tone + fade[..., None] * (wall - tone)).astype(np.float32)
    if stride > 1:
        size = (light.shape[1] * stride, light.shape[0] * stride)
        light = cv2.resize(light, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
    light = np.ascontiguousarray(light)
    light.setflags(write=False)
    return light


def _on_floor(
    field: RayField, pose_world_camera: Pose, floor: float, stride: int
) -> tuple[Array, Array, Array]:
    """Return where the rays of every ``stride``-th pixel meet the floor: x, y, depth (h, w)."""
    width, height = field.intrinsics.size
    rows = -(-height // stride)
    columns = -(-width // stride)
    middle = (stride - 1) / 2
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) * stride + middle
    pixels = np.minimum(pixels.reshape(-1, 2), (width - 1, height - 1))
    rays = field.box(0, 0, width, height) if stride == 1 else field.points(pixels)
    directions = world_directions(pose_world_camera, rays.reshape(rows, columns, 2))
    eye = pose_world_camera.position
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (floor - eye[2]) / directions[..., 2]
    depth = np.where((depth > 0.0) & (depth < _HORIZON), depth, _HORIZON)
    x = eye[0] + depth * directions[..., 0]
    y = eye[1] + depth * directions[..., 1]
    return x, y, depth


def _footprint(depth: Array, pose_world_camera: Pose, floor: float, field: RayField) -> Array:
    """Return the length (h, w) of a pixel on the floor, metres, along the view."""
    rise = abs(float(pose_world_camera.position[2]) - floor)
    return depth**2 / (max(rise, 1e-3) * field.intrinsics.fy)


def _checker(x: Array, y: Array, side: float, width: Array) -> Array:
    """Return 1 (h, w) on every second tile and 0 on the others, smoothed over ``width`` metres."""

    def sign(value: Array) -> Array:
        # Distance to the nearest border, positive in every second row of tiles.
        distance = np.abs(np.mod(value, 2.0 * side) - side) - 0.5 * side
        return np.clip(2.0 * distance / np.maximum(width, 1e-9), -1.0, 1.0)

    blurred = np.clip(side / np.maximum(width, 1e-9) - 1.0, 0.0, 1.0)
    return np.asarray(0.5 + 0.5 * blurred * sign(x) * sign(y))
