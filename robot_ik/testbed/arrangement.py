"""Where instances stand, and from where they are seen: the same on every front end."""

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

INSTANCE_COLOURS: tuple[Colour, ...] = ((37, 99, 235), (13, 148, 136), (147, 51, 234), (219, 39, 119))
"""Of plate, trail, table row, plot line and joint mark: distinguishable for the colour-blind, too."""
GOAL_COLOUR: Colour = (245, 130, 32)
"""Orange, as in the gallery; no instance has it."""
LIMIT_COLOUR: Colour = (220, 38, 38)
BALL_RADIUS = 0.03
"""Of the model's extent."""
FIELD_OF_VIEW = math.radians(38.0)
_DOWN = 0.42  # tangent of the elevation: about 23 degrees
_PLATE_DISTANCE = 0.24  # of the extent: where the label stands in front of the base
_MARGIN = 0.9  # part of the picture that is used: balls and hands reach beyond their middles
_SHEET = 0.56, 0.42  # on a phone the panel covers the lower half: part that is left, and how far it is up


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Where instances of a robot and their labels stand."""

    robot: Robot
    offsets: Array  # (n, 3) of each instance from the world's origin, metres
    labels: Array  # (n, 3) on the floor in front of each instance
    forward: Array  # (2,) unit vectors on the floor as the first view sees them
    right: Array
    extent: float  # of the model, metres

    def camera(self, path: Array, aspect: float, *, phone: bool = False) -> Array:
        """(2, 3) position and look-at of a camera that sees all, from the front and a little above.

        Args:
            path: (m, 3) where the ball will be.
            aspect: Width of the picture over its height.
            phone: Keep the lower half of the picture free.
        """
        forward = np.array((*self.forward, -_DOWN)) / math.hypot(1.0, _DOWN)
        right = np.array((*self.right, 0.0))
        up = np.cross(right, forward)
        points = self._corners(path)
        x, y, z = points @ right, points @ up, points @ forward
        wide = _MARGIN * math.tan(FIELD_OF_VIEW / 2.0) * aspect
        tall = _MARGIN * math.tan(FIELD_OF_VIEW / 2.0) * (_SHEET[0] if phone else 1.0)
        middle = np.array(((x.min() + x.max()) / 2.0, (y.min() + y.max()) / 2.0))
        away = float(max((np.abs(x - middle[0]) / wide - z).max(), (np.abs(y - middle[1]) / tall - z).max()))
        depth = float(z.mean())
        drop = _SHEET[1] * math.tan(FIELD_OF_VIEW / 2.0) * (away + depth) if phone else 0.0
        target = middle[0] * right + (middle[1] - drop) * up + depth * forward
        return np.array([target - (away + depth) * forward, target])

    def _corners(self, path: Array) -> Array:
        """(n, 3) what has to be seen: boxes round the robots at home and round the path (m, 3)."""
        model, data = self.robot.model, self.robot.data_at(self.robot.home)
        solid = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
        # A ball round a long geom is much larger than the geom: 0.7 of it holds the robots that ship.
        reach, positions = 0.7 * model.geom_rbound[solid][:, None], data.geom_xpos[solid]
        low = np.vstack([positions - reach, path]).min(axis=0)
        high = np.vstack([positions + reach, path]).max(axis=0)
        low[2] = max(low[2], min(0.0, float(path[:, 2].min())))
        box = np.array(list(itertools.product(*zip(low, high, strict=True))))
        return (self.offsets[:, None] + box).reshape(-1, 3)


def arranged(robot: Robot, count: int) -> Arrangement:
    """The positions of ``count`` instances: 1 2 behind, 3 4 in front, as the first view sees them."""
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
    """As CSS has it."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def linear(colour: Colour) -> NDArray[np.uint8]:
    """A screen colour (sRGB) as linear light, which is what batched meshes take theirs for."""
    share = np.array(colour) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)
