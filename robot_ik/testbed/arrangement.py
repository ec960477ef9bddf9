"""Positions of instances and of the camera, the same on every front end."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.gallery_scene import gallery_scene

Colour = tuple[int, int, int]

INSTANCE_COLOURS: tuple[Colour, ...] = (
    (37, 99, 235),
    (13, 148, 136),
    (147, 51, 234),
    (219, 39, 119),
)
"""Colours of plate, trail, card, plot line and joint mark of each instance.

Colour-blind people can distinguish them.
"""

GOAL_COLOUR: Colour = (245, 130, 32)
"""Orange, as in the gallery. No instance has this colour."""

LIMIT_COLOUR: Colour = (220, 38, 38)
"""Colour of a joint at its limit and of an obstacle that touches the robot."""

BALL_RADIUS = 0.03
"""Radius of the ball, in extents of the model."""

FIELD_OF_VIEW = math.radians(38.0)
"""Vertical, radians."""

_DOWN = 0.42
"""Tangent of the camera's elevation: about 23 degrees."""

_PLATE_DISTANCE = 0.24
"""Distance of the label in front of the base, in extents of the model."""

_MARGIN = 0.9
"""Part of the picture that is used. Bodies extend beyond the points that are fitted."""

_BOUND_PART = 0.7
"""Part of a geom's bounding radius that is fitted.

The bounding ball of a long geom is much larger than the geom. With this part the bundled robots are
in the picture.
"""


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Positions of the instances of a robot and of their labels.

    Attributes:
        robot: The robot.
        offsets: (n, 3) of each instance from the world's origin, m.
        labels: (n, 3) on the floor in front of each instance, m.
        forward: (2,) unit vector on the floor, away from the camera.
        right: (2,) unit vector on the floor, to the right of the camera.
        extent: Extent of the model, m.
    """

    robot: Robot
    offsets: Array
    labels: Array
    forward: Array
    right: Array
    extent: float

    def camera(self, path: Array, aspect: float) -> Array:
        """Return position and look-at (2, 3) of a camera in front of the robots and above them.

        Args:
            path: (m, 3) positions of the ball.
            aspect: Width of the picture over its height.
        """
        forward = np.array((*self.forward, -_DOWN)) / math.hypot(1.0, _DOWN)
        right = np.array((*self.right, 0.0))
        up = np.cross(right, forward)
        points = self._corners(path)
        x = points @ right
        y = points @ up
        z = points @ forward
        tall = _MARGIN * math.tan(FIELD_OF_VIEW / 2.0)
        wide = tall * aspect
        middle = np.array(((x.min() + x.max()) / 2.0, (y.min() + y.max()) / 2.0))
        needed_width = (np.abs(x - middle[0]) / wide - z).max()
        needed_height = (np.abs(y - middle[1]) / tall - z).max()
        away = float(max(needed_width, needed_height))
        depth = float(z.mean())
        target = middle[0] * right + middle[1] * up + depth * forward
        return np.array([target - (away + depth) * forward, target])

    def _corners(self, path: Array) -> Array:
        """Return corners (n, 3) of boxes around the robots at home and the path (m, 3)."""
        model = self.robot.model
        data = self.robot.data_at(self.robot.home)
        solid = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
        reach = _BOUND_PART * model.geom_rbound[solid][:, None]
        positions = data.geom_xpos[solid]
        lower = np.vstack([positions - reach, path]).min(axis=0)
        upper = np.vstack([positions + reach, path]).max(axis=0)
        lower[2] = max(lower[2], min(0.0, float(path[:, 2].min())))
        box = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
        return (self.offsets[:, None] + box).reshape(-1, 3)


def arranged(robot: Robot, count: int) -> Arrangement:
    """Return the positions of ``count`` instances: 1 and 2 behind, 3 and 4 in front."""
    azimuth = math.radians(gallery_scene(robot).view_deg[0])
    forward = -np.array((math.cos(azimuth), math.sin(azimuth)))
    right = np.array((-math.sin(azimuth), math.cos(azimuth)))
    extent = float(robot.model.stat.extent)
    grid: Sequence[tuple[float, float]] = {
        1: [(0.0, 0.0)],
        2: [(-1.0, 0.0), (1.0, 0.0)],
        4: [(-1.0, 1.25), (1.0, 1.25), (-1.0, -1.25), (1.0, -1.25)],
    }[count]
    flat = np.array([0.5 * extent * (x * right + y * forward) for x, y in grid])
    offsets = np.column_stack([flat, np.zeros(count)])
    labels = offsets - np.array((*(_PLATE_DISTANCE * extent * forward), 0.0))
    return Arrangement(robot, offsets, labels, forward, right, extent)


def hexadecimal(colour: Colour) -> str:
    """Return a colour as CSS has it."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def linear(colour: Colour) -> NDArray[np.uint8]:
    """Return a screen colour (sRGB) as the linear light that batched meshes expect."""
    share = np.array(colour) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)
