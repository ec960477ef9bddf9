"""Who says whether a solve succeeded: MuJoCo's forward pass and the model's own joint ranges."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.robot import Robot

Array = NDArray[np.float64]

#: Beyond a limit or a tolerance by so little is rounding, not a miss (rad, m, or share of the tolerance).
SLACK = 1e-9


class Judge:
    """Measures answers for one frame of a robot; nothing of the solvers' own code is asked."""

    def __init__(self, robot: Robot, frame: str | None = None) -> None:
        self._robot, self._at = robot, robot.frame(frame)
        self._data = mujoco.MjData(robot.model)
        self._local = self._at.local.matrix

    def pose(self, q: Array) -> Array:
        """(4, 4) pose of the frame in the world at ``q`` (nq,)."""
        self._data.qpos[:] = self._robot.qpos(q)
        mujoco.mj_kinematics(self._robot.model, self._data)
        body = np.eye(4)
        body[:3, :3] = self._data.xmat[self._at.body].reshape(3, 3)
        body[:3, 3] = self._data.xpos[self._at.body]
        return np.asarray(body @ self._local)

    def jacobian(self, q: Array) -> Array:
        """(6, nv) of the whole model: linear over angular velocity of the frame, by ``mj_jac``."""
        model, pose = self._robot.model, self.pose(q)
        mujoco.mj_comPos(model, self._data)
        found = np.zeros((6, model.nv))
        mujoco.mj_jac(model, self._data, found[:3], found[3:], pose[:3, 3], self._at.body)
        return found

    def miss(self, q: Array, target: Array) -> tuple[float, float]:
        """Metres and radians between the frame at ``q`` (nq,) and a target (4, 4)."""
        here = self.pose(q)
        # The chord between the rotations: exact near zero, where an arc cosine is not.
        chord = float(np.linalg.norm(here[:3, :3] - target[:3, :3])) / (2.0 * math.sqrt(2.0))
        return float(np.linalg.norm(here[:3, 3] - target[:3, 3])), 2.0 * math.asin(min(1.0, chord))

    def inside(self, q: Array) -> bool:
        """Whether every active joint is inside the range that the model gives it."""
        model, qpos = self._robot.model, self._robot.qpos(q)
        for joint in self._robot.tree.joint_ids:
            if not model.jnt_limited[joint]:
                continue
            low, high = model.jnt_range[joint]
            start = int(model.jnt_qposadr[joint])
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
                turn = 2.0 * math.atan2(float(np.linalg.norm(qpos[start + 1 : start + 4])), abs(qpos[start]))
                outside = turn > high + SLACK
            else:
                outside = not low - SLACK <= qpos[start] <= high + SLACK
            if outside:
                return False
        return True
