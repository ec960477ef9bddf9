"""What is drawn into a picture: a robot that stands on a board, and a virtual ball beside it."""

from __future__ import annotations

import mujoco
import numpy as np

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.errors import ModelError
from robot_ik.geometry import Pose
from robot_ik.model import compiled, read_spec
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import BALL_RADIUS, GOAL_COLOUR

DRAWN_HEIGHT = 0.40
"""Height of a drawn robot in metres. A figure of true size does not fit on a table."""

_BALL = "virtual_ball"
_SMALLEST_HEIGHT = 1e-6
"""Metres. A robot without visible geoms has no height."""


class ArScene:
    """A robot and its virtual ball on a board.

    The ball is part of the drawn model, so it is hidden and throws a shadow as the robot does.

    Args:
        robot: The robot. Its world has the axes of the board: x right, y up, z out of the print.
        height: Height of the robot at home in metres, as drawn.

    Attributes:
        robot: The robot.
        radius: Radius of the ball, in metres of the robot's world.
        drawn: The robot with its ball, at its place on the board.

    Raises:
        ModelError: The robot was not loaded from a file.
    """

    def __init__(self, robot: Robot, height: float = DRAWN_HEIGHT) -> None:
        if not robot.path.is_file():
            raise ModelError(
                f"{robot.name} was not loaded from a file, so it cannot be drawn into a picture",
                path=robot.path,
                hint="choose a robot of the catalogue, or load a model from a file",
            )
        self.robot = robot
        self.radius = BALL_RADIUS * float(robot.model.stat.extent)
        model = _with_ball(robot, self.radius)
        self._address = int(model.jnt_qposadr[model.body(_BALL).jntadr[0]])
        heights = surface_points(robot.model, robot.qpos(robot.home))[:, 2]
        lowest = float(heights.min(initial=0.0))
        scale = height / max(float(heights.max(initial=0.0)) - lowest, _SMALLEST_HEIGHT)
        self.drawn = DrawnRobot(model, Pose((0.0, 0.0, -scale * lowest)), scale)

    def qpos(self, q: Array, ball: Array) -> Array:
        """Return the configuration (model.nq,) of the robot at ``q`` (nq,) and the ball (3,)."""
        qpos = np.array(self.drawn.model.qpos0)
        robot = self.robot.qpos(q)
        qpos[: len(robot)] = robot
        qpos[self._address : self._address + 3] = ball
        return qpos

    def world_point(self, point: Array) -> Array:
        """Return a point (3,) of the board's frame in the robot's world, metres of that world."""
        return np.asarray(self.drawn.pose_board_base.inverse().apply(point) / self.drawn.scale)


def _with_ball(robot: Robot, radius: float) -> mujoco.MjModel:
    """Return the robot's model with a ball on three slides."""
    spec, _ = read_spec(robot.path, robot.path)
    for key in list(spec.keys):
        spec.delete(key)  # a key has a value for each joint: the ball has new ones
    ball = spec.worldbody.add_body(name=_BALL)
    for axis in np.eye(3):
        ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    ball.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius, 0.0, 0.0],
        rgba=[*(np.array(GOAL_COLOUR) / 255.0), 1.0],
    )
    return compiled(spec)
