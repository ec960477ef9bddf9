"""A camera that shows all of a robot, as large as the picture allows."""

from __future__ import annotations

import math

import numpy as np

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array

FOCAL = 2.4
"""Focal length in picture heights. With a long lens, limbs near the camera do not look swollen."""

MARGIN = 0.06
"""Share of the picture that stays free at each border."""

FIT_STEPS = 40
"""Steps of the search for the viewpoint. Each step removes most of the remaining error."""

FIRST_DISTANCE = 2.0
"""First distance of the search, as a multiple of the distance at which the robot fits."""

SHORTEST_DISTANCE = 0.51
"""Shortest distance, in diagonals of the box around the points. All points are in front of it."""


def portrait_lens(width: int, height: int) -> CameraIntrinsics:
    """Return the lens for pictures of robots.

    Args:
        width: Width of the picture, px.
        height: Height of the picture, px.
    """
    focal = FOCAL * height
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def fitted_camera(
    points: Array, view_deg: tuple[float, float], intrinsics: CameraIntrinsics
) -> Pose:
    """Return the ``pose_world_camera`` from which points just fill the picture.

    Args:
        points: Points (n, 3) in the world, m.
        view_deg: Direction from the points to the camera: azimuth from x to y, and elevation.
        intrinsics: Lens of the picture.
    """
    azimuth, elevation = np.radians(view_deg)
    direction = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    rotation = Pose.look_at(direction, np.zeros(3)).rotation
    # Along the axes of the camera, from the origin of the world.
    in_camera = points @ rotation
    lower = in_camera.min(axis=0)
    upper = in_camera.max(axis=0)
    centre = (lower + upper) / 2
    diagonal = float(np.linalg.norm(upper - lower))

    space = np.array(intrinsics.size) * (1 - 2 * MARGIN)
    distance = FIRST_DISTANCE * diagonal * intrinsics.fx / float(space.min())
    for _ in range(FIT_STEPS):
        depth = in_camera[:, 2] - centre[2] + distance
        pixels = (in_camera[:, :2] - centre[:2]) / depth[:, None] * intrinsics.fx
        lower = pixels.min(axis=0)
        upper = pixels.max(axis=0)
        centre[:2] += (lower + upper) / 2 * distance / intrinsics.fx
        # The square root is half of the correction. A limb that points to the camera grows faster
        # than the distance shrinks, so the full correction oscillates.
        correction = math.sqrt(float(((upper - lower) / space).max()))
        distance = max(distance * correction, SHORTEST_DISTANCE * diagonal)
    return Pose.from_rotation(rotation, rotation @ centre + distance * direction)
