"""The tool of an arm in teleoperation, moved by inverse kinematics."""

from __future__ import annotations

import numpy as np

from robot_ik.budget import Budget
from robot_ik.geometry import Pose
from robot_ik.goals import BEST, EXACT, PoseGoal
from robot_ik.hardware.config import ArmConfig
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.robot_arm import robot_named_in
from robot_ik.workcell.operator import Angles

BUDGET = Budget(iterations=30, restarts=0)
"""Budget of one solve.  An arm that follows must not jump, so there are no restarts."""

JOINTS_FOR_ANY_POSE = 6
"""Number of degrees of freedom with which a tool can have any pose in its reach."""

POSITION_TOLERANCE = 1e-3
"""m. Largest position error of the tool after a step."""

ANGLE_TOLERANCE = 1e-2
"""rad. Largest angle error of the tool after a step."""


class ToolFollower:
    """Moves the tool of a follower from the pose of the last command to the next pose.

    An arm with fewer than six degrees of freedom reaches the position with the best orientation.

    Args:
        config: Arm file of the follower.

    Attributes:
        names: Joints that carry the tool.
        pose: Pose of the last command.
    """

    def __init__(self, config: ArmConfig) -> None:
        robot = load_robot(robot_named_in(config))
        chain = config.chain
        self.names = chain.names
        self._columns = [robot.joints.index(name) for name in chain.names]
        lower = np.full(robot.nv, -np.inf)
        upper = np.full(robot.nv, np.inf)
        lower[self._columns] = chain.lower
        upper[self._columns] = chain.upper
        self._robot = robot.with_limits(lower, upper)
        self._q = self._robot.home.copy()
        self.pose = self._robot.forward(self._q)
        self._reaches_any_pose = self._robot.nv >= JOINTS_FOR_ANY_POSE
        orientation = EXACT if self._reaches_any_pose else BEST
        self._problem = Problem(
            self._robot,
            PoseGoal(None, self.pose.position, self.pose.wxyz, orientation=orientation),
            solver="lm" if self._reaches_any_pose else "auto",
            budget=BUDGET,
            keep_branch=True,
        )

    def engage(self, angles: Angles) -> Pose:
        """Begin to lead the tool at joint values, and return its pose there."""
        self._q = self._robot.home.copy()
        self._q[self._columns] = [angles[name] for name in self.names]
        self._q = self._robot.clip(self._q)
        self.pose = self._robot.forward(self._q)
        return self.pose

    def go(self, pose: Pose, *, exactly: bool = False) -> dict[str, float]:
        """Return joint -> value that bring the tool to a pose, or as near as possible.

        Args:
            pose: Target in the world.
            exactly: Keep the last command if the tool cannot reach the pose.  Steps that add up
                must neither drift, nor rotate the tool at the end of its reach.
        """
        q = self._problem.solve(self._q, target=pose).q
        if np.isfinite(q).all():
            reached = self._robot.forward(q)
            distance, angle = reached.distance(pose)
            meets_angle = angle < ANGLE_TOLERANCE or not self._reaches_any_pose
            is_reached = distance < POSITION_TOLERANCE and meets_angle
            if is_reached or not exactly:
                self._q = q
                self.pose = reached
                if exactly:
                    wxyz = pose.wxyz if self._reaches_any_pose else reached.wxyz
                    self.pose = Pose(pose.position, wxyz)
        return dict(zip(self.names, self._q[self._columns].tolist(), strict=True))
