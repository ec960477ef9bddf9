"""Verdict on a reach: two independent measurements and one decision.

The servos' registers give the joint angles, and MuJoCo's forward kinematics the pose of the tool. A
camera measures the pose of the tool itself. A servo with a slipped horn passes the first and fails
the second. ``decide`` combines both. Text and exit code follow from its result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.goals import worst_sigmas
from robot_ik.camera.targets import Observation
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, Tolerance, frame_error
from robot_ik.ports import Array
from robot_ik.robot import Robot

#: Largest position error of a reached goal, however uncertain the camera is, metres.
LARGEST_ERROR = 0.005
#: Largest angle error, likewise, rad.
LARGEST_ANGLE = np.deg2rad(1.0)
#: Tolerance of the solve. It is far below the resolution of servos, so its error does not count.
SOLVE_TOLERANCE = Tolerance(position=1e-5, angle=1e-4)
#: Number of standard deviations by which a measurement may be wrong.
SIGMAS = 3.0


@dataclass(frozen=True)
class Bound:
    """A largest error, or a standard deviation.

    Attributes:
        position: Metres.
        angle: Rad.
    """

    position: float
    angle: float

    def combined(self, other: Bound) -> Bound:
        """Return the standard deviation of the sum of two independent errors."""
        return Bound(math.hypot(self.position, other.position), math.hypot(self.angle, other.angle))

    def widened(self, sigma: Bound) -> Bound:
        """Return the bound plus three standard deviations of a measurement.

        They widen it to at most ``LARGEST_ERROR`` and ``LARGEST_ANGLE``.
        """
        return Bound(
            max(self.position, min(LARGEST_ERROR, self.position + SIGMAS * sigma.position)),
            max(self.angle, min(LARGEST_ANGLE, self.angle + SIGMAS * sigma.angle)),
        )


EXACT = Bound(0.0, 0.0)


@dataclass(frozen=True)
class Judgement:
    """A measured error and its limit.

    Attributes:
        position: Position error, metres. 0 if the goal leaves the position free.
        angle: Angle error, rad. 0 if the goal leaves the orientation free.
        allowed: Largest accepted error.
        sigma: Standard deviation of the measurement. Zeros for an exact one.
        pose: Measured pose of the tool in the world.
    """

    position: float
    angle: float
    allowed: Bound
    sigma: Bound
    pose: Pose

    @property
    def passed(self) -> bool:
        """Whether both errors are within the limit."""
        return bool(self.position <= self.allowed.position and self.angle <= self.allowed.angle)


def quantisation(
    robot: Robot, q: Array, resolution: Array, frame: str, tolerance: Tolerance
) -> Bound:
    """Return the largest error of a frame if every servo is right to a tick.

    The command is rounded by up to half a tick of each joint, and so is the reading. The bound
    assumes that all errors have their worst sign: sum of |J_j| tick_j, plus the tolerance of the
    solve.

    Args:
        robot: The robot.
        q: (nq,) joint angles.
        resolution: (nv,) rad per tick of each joint. Zeros without servos.
        frame: The frame.
        tolerance: Tolerance of the solve.
    """
    jacobian = robot.jacobian(q, frame)
    return Bound(
        float(np.linalg.norm(jacobian[:3], axis=0) @ resolution) + tolerance.position,
        float(np.linalg.norm(jacobian[3:], axis=0) @ resolution) + tolerance.angle,
    )


def judge_read_back(
    robot: Robot,
    q: Array,
    goal: Goal,
    frame: str,
    bound: Bound,
    goal_sigma: Bound = EXACT,
    best_angle: float = 0.0,
) -> Judgement:
    """Return the error of a frame at the joint angles read back, by MuJoCo's forward kinematics.

    Args:
        robot: The robot.
        q: (nq,) joint angles read back.
        goal: The goal.
        frame: The frame that should reach it.
        bound: Result of ``quantisation``.
        goal_sigma: Standard deviation of the goal relative to the pose to which the arm was sent.
            Zeros if both are the same.
        best_angle: Predicted angle between both axes, rad. It is added to the allowed angle.
    """
    pose = robot.measure(q, frame)
    position, angle = frame_error(goal.rows(robot), goal.weights, pose, goal.target)
    allowed = bound.widened(goal_sigma)
    allowed = Bound(allowed.position, best_angle + allowed.angle)
    return Judgement(position, angle, allowed, goal_sigma, pose)


def judge_by_camera(
    robot: Robot,
    observation: Observation,
    pose_world_camera: Pose,
    pose_body_tool: Pose,
    goal: Goal,
    bound: Bound,
    goal_sigma: Bound = EXACT,
    best_angle: float = 0.0,
) -> Judgement:
    """Return the error of the tool measured by a camera.

    The limit is three standard deviations of the measurement plus the quantisation of the servos,
    and at most ``LARGEST_ERROR`` and ``LARGEST_ANGLE``.

    Args:
        robot: The robot.
        observation: Observation of the markers on the tool.
        pose_world_camera: Pose of the camera.
        pose_body_tool: Pose of the tool in the frame of the markers.
        goal: The goal.
        bound: Result of ``quantisation``.
        goal_sigma: See ``judge_read_back``.
        best_angle: See ``judge_read_back``.
    """
    pose = pose_world_camera.compose(observation.pose).compose(pose_body_tool)
    position, angle = frame_error(goal.rows(robot), goal.weights, pose, goal.target)
    lever = observation.pose.rotation @ pose_body_tool.position
    sigma = Bound(*worst_sigmas(observation.covariance, lever)).combined(goal_sigma)
    allowed = Bound(
        min(LARGEST_ERROR, SIGMAS * sigma.position + bound.position),
        best_angle + min(LARGEST_ANGLE, SIGMAS * sigma.angle + bound.angle),
    )
    return Judgement(position, angle, allowed, sigma, pose)


def decide(
    read_back: Judgement,
    by_camera: Judgement | None,
    *,
    servos: bool,
    blind: str,
    seen_goal: bool,
    stopped_short: str = "",
    followed: bool = False,
) -> tuple[bool, str]:
    """Decide whether the goal is reached.

    Without servos the joint angles are known, so a camera that does not see the gripper leaves
    nothing unproven.

    Args:
        read_back: Error by the joint angles.
        by_camera: Error by the camera. None if no picture shows the tool.
        servos: Whether there are servos. Their registers may disagree with the arm.
        blind: Why no camera was used. Empty if one was used.
        seen_goal: Whether the goal is a marker, so that a camera is available.
        stopped_short: Servo that is far from its command, and its distance. Empty without one.
        followed: Whether the goal moved.

    Returns:
        Whether the goal is reached, and the reason in one sentence.
    """
    source = "by the servos' registers" if servos else "by the model's joint angles"
    explained = ("the servos' ticks" if servos else "the solver's tolerance") + " and the camera"
    if not read_back.passed:
        if stopped_short:
            return False, stopped_short
        reason = "the arm is not at the solution"
        if followed:
            reason = "the marker moved further, or the arm is too slow"
        distance = f"the tool is {1e3 * read_back.position:.2f} mm from the goal {source}"
        return False, f"{distance}: {reason}"
    if by_camera is not None:
        if by_camera.passed:
            return True, f"within what {explained} explain"
        hint = "check the camera's calibration and place"
        if servos:
            hint = "check zeros, horns and limits"
        return False, f"the error is larger than {explained} explain: {hint}"
    if blind:
        return True, f"{source}: {blind}"
    if servos and seen_goal:
        return False, "no marker of the gripper is in view, so the pose of the tool is unproven"
    return True, f"{source}: no marker of the gripper is in view"
