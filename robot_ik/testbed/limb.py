"""The limb of a figure that holds its tool: for methods that cannot keep feet, balance and gaze."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array
from robot_ik.robot import Robot


def limb_base(robot: Robot) -> str:
    """Return the body that carries the limb of the tool and other limbs: trunk, or spine.

    Empty: no body of the robot carries several limbs.
    """
    model = robot.model
    joint_count = np.zeros(model.nbody, dtype=np.int64)
    for body in model.jnt_bodyid.tolist():
        while body > 0:
            joint_count[body] += 1
            body = int(model.body_parentid[body])
    body = robot.frame(robot.tool).body
    while body > 0:
        parent = int(model.body_parentid[body])
        siblings = np.flatnonzero(model.body_parentid == parent)
        if parent > 0 and joint_count[body] and (joint_count[siblings] > 0).sum() > 1:
            return str(model.body(parent).name)
        body = parent
    return ""


class Limb:
    """A figure of which only the limb that holds the tool moves. The other joints stay at home.

    Args:
        robot: The figure.

    Attributes:
        robot: The figure with the joints of the limb alone active.

    Raises:
        RobotIkError: No body carries the limb of the tool and others.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot.with_base(limb_base(robot))
        self._figure_addresses = _addresses(robot)
        self._limb_addresses = _addresses(self.robot)
        self._figure = robot

    def limb_q(self, q: Array) -> Array:
        """Return the joint vector of the limb for one of the figure (nq,)."""
        return np.asarray(self._figure.qpos(q)[self._limb_addresses])

    def figure_q(self, q: Array) -> Array:
        """Return the joint vector (nq,) of the figure for one of the limb."""
        return np.asarray(self.robot.qpos(q)[self._figure_addresses])


def _addresses(robot: Robot) -> NDArray[np.int64]:
    """Return the index in ``qpos`` of each number of ``q``."""
    numbers = np.arange(robot.model.nq)
    widths = {int(mujoco.mjtJoint.mjJNT_FREE): 7, int(mujoco.mjtJoint.mjJNT_BALL): 4}
    parts = []
    for joint in robot.joints:
        j = robot.model.joint(joint).id
        first = int(robot.model.jnt_qposadr[j])
        parts.append(numbers[first : first + widths.get(int(robot.model.jnt_type[j]), 1)])
    return np.concatenate(parts)
