"""Kinematics with the interface of LeRobot's ``RobotKinematics``.

    kinematics = Kinematics("so101.urdf", "gripper_frame_link")
    pose = kinematics.forward_kinematics(degrees)
    degrees = kinematics.inverse_kinematics(degrees, pose)

It imports neither LeRobot nor placo. LeRobot's processor steps take it as their ``kinematics``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ModelError, UnknownJointError
from robot_ik.geometry import Pose
from robot_ik.goals import BEST, EXACT, PoseGoal, PositionGoal
from robot_ik.kernels.tree import HINGE, SLIDE
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solution import Solution

POSE_JOINTS = 6
"""Number of joints that a full pose needs. With fewer joints the position has priority."""

FAR_POSITION = 0.05
"""m between start and target. A nearer target is followed on the branch of the start."""

FAR_ANGLE = 0.5
"""rad between start and target. A nearer target is followed on the branch of the start."""

BETTER_ANGLE = np.radians(1.0)
"""rad. For a far target another branch is taken if its orientation error is smaller by this."""

UNIT = {HINGE: np.radians(1.0), SLIDE: 1e-3}
"""Joint value of one unit: degrees for hinges, millimetres for slides."""


class Kinematics:
    """Kinematics of one frame of a robot, in degrees and 4x4 matrices.

    The position of the target is met exactly if the arm reaches it. An arm with six or more joints
    meets the orientation too. With fewer joints the orientation error is the smallest possible at
    this position. Targets that move in small steps are followed without jumps.

    Args:
        urdf_path: Path of a URDF or MJCF, name of a bundled robot, or a ``Robot``.
        target_frame_name: Frame that is moved. None: the robot's tool.
        joint_names: Order of the joint values. None: the robot's active joints. A joint that does
            not move the frame, such as a gripper, keeps its value.

    Attributes:
        robot: The robot.
        frame: Frame that is moved.
        joint_names: As given.
        last: Result of the last ``inverse_kinematics``, with status and error. None before the
            first call.

    Raises:
        UnknownRobotError, UnknownFrameError: The model or the frame does not exist.
        ModelError: A ball joint or a floating base moves the frame.
        UnknownJointError: A joint that moves the frame is missing from ``joint_names``.
    """

    def __init__(
        self,
        urdf_path: str | os.PathLike[str] | Robot,
        target_frame_name: str | None = None,
        joint_names: Sequence[str] | None = None,
    ) -> None:
        robot = urdf_path if isinstance(urdf_path, Robot) else load_robot(urdf_path)
        self.robot = robot
        self.frame = robot.tool if target_frame_name is None else target_frame_name
        self.joint_names = list(robot.joints if joint_names is None else joint_names)
        self.last: Solution | None = None
        moving = _joints_that_move(robot, self.frame)
        for name in moving:
            if name not in self.joint_names:
                raise UnknownJointError(name, tuple(self.joint_names))
        self._columns = [self.joint_names.index(name) for name in moving]
        indices = [robot.joints.index(name) for name in moving]
        self._qadr = robot.tree.qadr[indices]
        self._units = np.array([UNIT[int(robot.tree.kind[k])] for k in indices])
        self._is_whole = len(moving) >= POSE_JOINTS
        home = robot.forward(robot.home, self.frame)
        goal = PoseGoal(
            self.frame,
            home.position,
            home.wxyz,
            orientation=EXACT if self._is_whole else BEST,
        )
        self._position = Problem(robot, PositionGoal(self.frame, home.position))
        self._near = Problem(robot, goal, keep_branch=True)
        self._far = Problem(robot, goal)

    def forward_kinematics(self, joint_pos_deg: ArrayLike) -> Array:
        """Return the pose of the frame as a 4x4 matrix."""
        return self.robot.forward(self._q(joint_pos_deg), self.frame).matrix

    def inverse_kinematics(
        self,
        current_joint_pos: ArrayLike,
        desired_ee_pose: ArrayLike,
        position_weight: float = 1.0,  # noqa: ARG002  # of LeRobot's interface
        orientation_weight: float = 0.01,
    ) -> Array:
        """Return joint values in degrees that bring the frame to a pose, inside the joint limits.

        A position out of reach gives the nearest point. ``last.converged`` is False then.

        Args:
            current_joint_pos: Joint values in degrees to start from. Values outside the limits are
                moved inside. Entries that do not move the frame are returned unchanged.
            desired_ee_pose: 4x4 matrix.
            position_weight: Not used: the position always has priority.
            orientation_weight: 0: only the position counts. Any other value: the orientation
                counts too.

        Raises:
            ModelError: The joint values have the wrong number or are not finite.
            InvalidGoalError: The matrix is not a pose.
        """
        values = np.array(current_joint_pos, dtype=float)
        start = self.robot.clip(self._q(values))
        target = Pose.from_matrix(desired_ee_pose)
        self.last = self._solve(start, target, orientation_weight > 0.0)
        values[self._columns] = self.last.q[self._qadr] / self._units
        return values

    def _q(self, joint_values: ArrayLike) -> Array:
        """Return joint positions (nq,); joints that do not move the frame are at home."""
        values = np.asarray(joint_values, dtype=float)
        if values.ndim != 1 or len(values) <= max(self._columns):
            raise ModelError(
                f"joint values of shape {values.shape}",
                hint=f"give {len(self.joint_names)} numbers: {', '.join(self.joint_names)}",
            )
        q = self.robot.home.copy()
        q[self._qadr] = values[self._columns] * self._units
        return self.robot.check_q(q)

    def _solve(self, start: Array, target: Pose, with_orientation: bool) -> Solution:
        if not with_orientation:
            return self._position.solve(start, target=target.position)
        near = self._near.solve(start, target=target)
        if self._is_whole or not self._is_far(start, target):
            return near
        far = self._far.solve(start, target=target)
        near_position, near_angle = self._distance(near.q, target)
        far_position, far_angle = self._distance(far.q, target)
        is_nearer = far_position < near_position - FAR_POSITION
        is_better = far_angle < near_angle - BETTER_ANGLE
        return far if is_nearer or is_better else near

    def _is_far(self, start: Array, target: Pose) -> bool:
        metres, radians = self._distance(start, target)
        return metres > FAR_POSITION or radians > FAR_ANGLE

    def _distance(self, q: Array, target: Pose) -> tuple[float, float]:
        """Return the metres and radians between the frame at ``q`` (nq,) and a target."""
        # Arrays instead of a `Pose`, which would take as long as the solve.
        position = np.empty((1, 3))
        wxyz = np.empty((1, 4))
        self.robot.forward_rows(q[None], self.frame, position, wxyz)
        cosine = min(1.0, abs(float(wxyz[0] @ target.wxyz)))  # of half the angle
        return math.dist(position[0], target.position), 2.0 * math.acos(cosine)


def _joints_that_move(robot: Robot, frame: str | None) -> tuple[str, ...]:
    """Return the names of the joints that move a frame; raise ``ModelError`` for balls."""
    node, _ = robot.attachment(frame)
    nodes = robot.tree.ancestors(node)
    for k in nodes:
        if int(robot.tree.kind[k]) not in UNIT:
            raise ModelError(
                f"{robot.joints[k]!r} of {robot.name} is a ball joint or a floating base",
                hint="Kinematics has one number for each joint",
            )
    return tuple(robot.joints[k] for k in nodes)
