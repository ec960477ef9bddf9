"""Robots drawn as wire: a line from each joint to the next, as the figure of thesis P11."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import INSTANCE_COLOURS, linear

_WIDTH = 4.0
"""Pixels."""


def wire_points(robot: Robot, xpos: Array, xquat: Array) -> Array:
    """Return the lines (n, 2, 3) of a robot whose bodies are at given poses.

    A line goes from the origin of each body to that of its parent. A body without children has a
    line to beyond its centre of mass.

    Args:
        robot: The robot.
        xpos: (nbody, 3) positions of the bodies.
        xquat: (nbody, 4) their orientations, wxyz.
    """
    model = robot.model
    parents = np.array(model.body_parentid)
    bodies = np.arange(1, model.nbody)
    linked = bodies[parents[bodies] > 0]
    between = np.stack([xpos[parents[linked]], xpos[linked]], axis=1)
    leaves = np.setdiff1d(bodies, parents)
    rotations = viser.transforms.SO3(np.asarray(xquat[leaves], dtype=float)).as_matrix()
    tips = xpos[leaves] + 2.0 * np.einsum("nij,nj->ni", rotations, model.body_ipos[leaves])
    return np.concatenate([between, np.stack([xpos[leaves], tips], axis=1)])


class Wire:
    """The lines of all instances of a robot."""

    def __init__(self, server: viser.ViserServer, robot: Robot, count: int) -> None:
        self._robot = robot
        rest = robot.data_at(robot.home)
        lines = wire_points(robot, rest.xpos, rest.xquat)
        colours = [linear(colour) for colour in INSTANCE_COLOURS[:count]]
        tones = np.repeat(colours, len(lines), axis=0)
        self._lines: Any = server.scene.add_line_segments(
            "/robot/wire",
            np.tile(lines, (count, 1, 1)).astype(np.float32),
            np.stack([tones, tones], axis=1),
            thickness=_WIDTH,
            thickness_units="screen",
        )

    def draw(self, xpos: Array, xquat: Array) -> None:
        """Show bodies at positions (count, nbody, 3) and quaternions (count, nbody, 4)."""
        pairs = zip(xpos, xquat, strict=True)
        lines = [wire_points(self._robot, *pose) for pose in pairs]
        self._lines.points = np.concatenate(lines).astype(np.float32)

    def remove(self) -> None:
        """Remove the lines."""
        self._lines.remove()
