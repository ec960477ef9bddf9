"""Pictures of models on an empty floor: for films, the gallery and the synthetic camera.

The floor fades into a wall. It shows the soft shadows of the bodies on it.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.drawing.drawn_robot import SHADOW_STRENGTH, cast_shadow
from robot_ik.camera.drawing.faces import EMPTY, bounding_box, faces_in_picture
from robot_ik.camera.drawing.painter import Layer, SurfaceBuffer, geom_paint
from robot_ik.camera.drawing.rays import ray_field
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.kernels.jit import inlined, kernel
from robot_ik.ports import Image

Tone = tuple[float, float, float]

# Smallest height of the camera above or below the floor for the width of borders of tiles, metres.
_MIN_HEIGHT = 1e-3


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
        fade_end: Distance beyond which only the wall is visible, metres.
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
        extent: Size of the filmed bodies, metres. The floor reaches several times as far.
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
        bodies: They hide each other, and each casts a shadow on the floor.
        intrinsics: Lens of the picture.
        pose_world_camera: OpenCV camera axes seen from the world of the studio.
        room: Floor and wall behind the bodies.
        floor: Height of the floor, metres.
        subject: (x, y) of the middle of the floor.
    """
    light = empty_room(intrinsics, pose_world_camera, room, floor, subject)
    image = np.rint(255.0 * light).astype(np.uint8)
    pose_camera_floor = pose_world_camera.inverse().compose(Pose((0.0, 0.0, floor)))
    visible = []
    boxes: list[Box] = []
    dark = np.zeros(image.shape[:2], dtype=np.uint8)
    for body in bodies:
        camera = body.pose.inverse().compose(pose_world_camera)
        faces = faces_in_picture(body.model, body.qpos, intrinsics, camera)
        box = bounding_box(faces, *intrinsics.size)
        shadow = cast_shadow(faces, intrinsics, pose_camera_floor)
        np.maximum(dark, shadow.mask(*intrinsics.size), out=dark)
        if box != EMPTY:
            visible.append((faces, geom_paint(body.model, body.tint)))
            boxes.append(box)
    Layer((0, 0, *intrinsics.size), np.zeros_like(image), dark).over(image, SHADOW_STRENGTH)
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
    """Return the (cached) light (h, w, 3), 0 to 1, of a room without bodies."""
    width, height = intrinsics.size
    light = np.empty((height, width, 3), dtype=np.float32)
    _paint_room(
        ray_field(intrinsics).box(0, 0, width, height),
        pose_world_camera.rotation,
        pose_world_camera.position,
        np.array([*subject, floor]),
        np.array([room.floor, room.tile, room.wall]),
        room.tile_side,
        np.array([room.fade_start, room.fade_end]),
        intrinsics.fy,
        light,
    )
    light.setflags(write=False)
    return light


@kernel
def _paint_room(rays, rotation, eye, middle, tones, tile_side, fade, focal, light):
    """Write the light (h, w, 3) of floor and wall.

    Args:
        rays: (h, w, 2) normalized coordinates of the pixels.
        rotation: (3, 3) of the camera in the world.
        eye: (3,) the camera, metres.
        middle: (3,) of the floor, metres.
        tones: (3, 3) of floor, tile and wall.
        tile_side: Metres; 0 for no tiles.
        fade: (2,) distances from the middle between which the floor fades into the wall, metres.
        focal: Focal length, px.
        light: Written.
    """
    drop = middle[2] - eye[2]
    for row in range(light.shape[0]):
        for column in range(light.shape[1]):
            u = rays[row, column, 0]
            v = rays[row, column, 1]
            fall = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
            wall = 1.0
            tile = 0.0
            if drop * fall > 0.0:
                depth = drop / fall
                x = eye[0] + depth * (rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2])
                y = eye[1] + depth * (rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2])
                away = math.sqrt((x - middle[0]) ** 2 + (y - middle[1]) ** 2)
                wall = min(max((away - fade[0]) / (fade[1] - fade[0]), 0.0), 1.0)
                wall *= wall * (3.0 - 2.0 * wall)
                if tile_side > 0.0 and wall < 1.0:
                    # Length of the pixel on the floor along the view. Borders are that soft.
                    width = depth * depth / (max(abs(drop), _MIN_HEIGHT) * focal)
                    tile = _tile_share(x, y, tile_side, width)
            for k in range(3):
                tone = tones[0, k] + tile * (tones[1, k] - tones[0, k])
                light[row, column, k] = tone + wall * (tones[2, k] - tone)


@inlined
def _tile_share(x, y, side, width):
    """Return 1 on every second tile and 0 on the others, smoothed over ``width`` metres."""
    # Distance to the nearest border, positive in every second row and column of tiles.
    across = abs((x / side) % 2.0 - 1.0) - 0.5
    along = abs((y / side) % 2.0 - 1.0) - 0.5
    sharpness = 2.0 * side / width
    across = min(max(across * sharpness, -1.0), 1.0)
    along = min(max(along * sharpness, -1.0), 1.0)
    contrast = min(max(side / width - 1.0, 0.0), 1.0)
    return 0.5 + 0.5 * contrast * across * along
