"""A robot photographed in an empty studio: rays and soft shadows on a seamless floor, no OpenGL."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.mesh import visible_geoms
from robot_ik.camera.drawing.primitives import triangulate
from robot_ik.camera.drawing.raycast import Caster, RayField, ray_field
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.lights import Lights
from robot_ik.camera.made_up.robot_layer import RobotRenderer
from robot_ik.camera.made_up.stage import StillPicture
from robot_ik.camera.made_up.synthetic import look_at
from robot_ik.camera.made_up.view import Quality, View, enlarged, lattice, softened, tiles
from robot_ik.geometry import Pose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# The studio's one tone, BGR, and how much of its light on the floor comes from the lamp and the ceiling.
TONE = (0.945, 0.94, 0.935)
_LAMP_SHARE, _CEILING_SHARE = 0.22, 0.30
# Of lamp, ceiling, window, ambient from above, ambient from below: a robot in front of a bright wall.
_STRENGTH = (0.34, 0.16, 0.34, 0.34, 0.30)
# Focal length in picture heights: a long lens, so that limbs near to it do not look swollen.
_FOCAL = 2.4
# Part of the picture left free on every side of the robot.
_MARGIN = 0.06
# A plain floor shows every fault of a shadow: more points of each light than for a table of wood.
_QUALITY = Quality(stride=1, self_stride=2, self_spots=2, stage_stride=4, stage_spots=8)
# Steps of the search for a place from which the robot fills the picture; each settles most of the rest.
_FIT_STEPS = 40


@dataclass(frozen=True)
class Photo:
    """A finished picture and what was needed to draw over it.

    Attributes:
        image: (h, w, 3) BGR.
        coverage: (h, w) part of each pixel that shows the robot.
        intrinsics, camera: The lens, and ``pose_world_camera``.
    """

    image: Image
    coverage: NDArray[np.float32]
    intrinsics: CameraIntrinsics
    camera: Pose


def lens(width: int, height: int) -> CameraIntrinsics:
    """The studio's lens for pictures of that size."""
    focal = _FOCAL * height
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def surface(model: mujoco.MjModel, qpos: ArrayLike) -> Array:
    """Vertices (n, 3) of all that is visible of a model, world."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(qpos, dtype=float)
    mujoco.mj_kinematics(model, data)
    parts = [np.zeros((0, 3))]
    for g in visible_geoms(model):
        mesh = triangulate(model, g)
        if mesh is not None:
            parts.append(mesh.vertices @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
    return np.concatenate(parts)


def fitted_camera(points: Array, view_deg: tuple[float, float], intrinsics: CameraIntrinsics) -> Pose:
    """From where ``points`` (n, 3) just fill the picture: ``pose_world_camera``.

    Args:
        points: What has to be seen, world.
        view_deg: Direction from which to look: azimuth from x towards y, and elevation.
        intrinsics: The lens.
    """
    azimuth, elevation = np.radians(view_deg)
    back = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    turn = look_at(back, np.zeros(3)).rotation
    seen = points @ turn  # camera axes, origin in the world's
    low, high = seen.min(axis=0), seen.max(axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    room = np.array(intrinsics.size) * (1 - 2 * _MARGIN)
    distance = 2.0 * size * intrinsics.fx / float(room.min())
    for _ in range(_FIT_STEPS):
        depth = seen[:, 2] - centre[2] + distance
        pixels = (seen[:, :2] - centre[:2]) / depth[:, None] * intrinsics.fx
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        centre[:2] += (low + high) / 2 * distance / intrinsics.fx
        # Half of what it takes: what reaches far towards the camera grows much faster than it comes nearer.
        distance = max(distance * math.sqrt(float(((high - low) / room).max())), 0.51 * size)
    return Pose.from_rotation(turn, turn @ centre + distance * back)


def photograph(
    model: mujoco.MjModel, qpos: ArrayLike, camera: Pose, intrinsics: CameraIntrinsics, floor: float
) -> Photo:
    """Takes one picture.

    Args:
        model: Any MuJoCo model without floor planes.
        qpos: (model.nq,).
        camera: ``pose_world_camera``.
        intrinsics: The lens.
        floor: Height of the floor, world, metres.
    """
    field = ray_field(intrinsics)
    subject = np.asarray(surface(model, qpos).mean(axis=0))
    distance = float(np.linalg.norm(subject - camera.position))
    lights = Lights.beside(camera, distance)
    lights = Lights(
        lights.lamp, lights.lamp_radius, lights.ceiling, lights.ceiling_radius, lights.window, _STRENGTH
    )
    view = View(field, camera, lights, Caster(model), _seamless(field, camera, floor))
    view.robot.place(qpos)
    lit = _floor_light(view)
    picture = view.stage.ambient + view.stage.lamp * lit[..., :1] + view.stage.ceiling * lit[..., 1:]
    coverage = np.zeros(picture.shape[:2], dtype=np.float32)
    layer = RobotRenderer(view, model).render(qpos, _QUALITY)
    if layer is not None:
        x0, y0, x1, y1 = layer.box
        coverage[y0:y1, x0:x1] = layer.coverage
        picture *= 1.0 - coverage[..., None]
        picture[y0:y1, x0:x1] += layer.colour
    image = np.clip(np.rint(255.0 * picture), 0, 255).astype(np.uint8)
    return Photo(image, coverage, intrinsics, camera)


def _seamless(field: RayField, camera: Pose, floor: float) -> StillPicture:
    """Floor and wall of one tone; only shadows tell where the floor is."""
    w, h = field.intrinsics.size
    rise = field.box(0, 0, w, h) @ camera.rotation[2, :2] + camera.rotation[2, 2]
    with np.errstate(divide="ignore"):
        depth = (floor - camera.position[2]) / rise
    depth = np.where(depth > 0, depth, np.inf).astype(np.float32)
    tone = np.broadcast_to(np.array(TONE, dtype=np.float32), (h, w, 3))
    rest = 1.0 - _LAMP_SHARE - _CEILING_SHARE
    return StillPicture(tone * rest, tone * _LAMP_SHARE, tone * _CEILING_SHARE, depth)


def _floor_light(view: View) -> NDArray[np.float32]:
    """Part (h, w, 2) of lamp and ceiling that the robot leaves to the floor."""
    w, h = view.field.intrinsics.size
    stride = _QUALITY.stage_stride
    x, y = lattice((0, 0, w, h), stride)
    rays = view.world(view.field.grid(x, y).reshape(-1, 2))
    rows, columns = np.minimum(np.rint(y).astype(int), h - 1), np.minimum(np.rint(x).astype(int), w - 1)
    depth = view.stage.depth[np.ix_(rows, columns)].reshape(-1).astype(float)
    seen = np.ones((len(rays), 2), dtype=np.float32)
    near = np.flatnonzero(np.isfinite(depth))
    points = view.camera.position + rays[near] * depth[near, None]
    place = tiles((len(y), len(x))).reshape(-1)[near]
    seen[near] = view.visibility(points, place, _QUALITY.stage_spots)
    return enlarged(softened(seen.reshape(len(y), len(x), 2)), stride, (h, w))
