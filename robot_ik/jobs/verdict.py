"""Did the arm reach its goal?  Two measurements that know nothing of each other, and one decision.

The servos' registers say where the joints are (through MuJoCo's forward pass); a camera says where the
tool really is.  A servo with a slipped horn passes the first and fails the second.  ``decide`` makes the
verdict of both; text and exit code are its.
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

# However uncertain the camera, a larger error than this is no success.
LARGEST_MISS = 0.005  # metres
LARGEST_ANGLE = np.deg2rad(1.0)
# A solve is asked for far more than the servos can do, so that its error does not count.
SOLVE_TOLERANCE = Tolerance(position=1e-5, angle=1e-4)
# Standard deviations within which a measurement is believed.
SIGMAS = 3.0


@dataclass(frozen=True)
class Bound:
    """Largest error that is explained, or a standard deviation: metres and radians."""

    position: float
    angle: float

    def combined(self, other: Bound) -> Bound:
        """The standard deviation of the sum of two that are independent."""
        return Bound(math.hypot(self.position, other.position), math.hypot(self.angle, other.angle))

    def widened(self, sigma: Bound) -> Bound:
        """With three standard deviations of a measurement, which take it to 5 mm and 1 degree at most."""
        return Bound(
            max(self.position, min(LARGEST_MISS, self.position + SIGMAS * sigma.position)),
            max(self.angle, min(LARGEST_ANGLE, self.angle + SIGMAS * sigma.angle)),
        )


EXACT = Bound(0.0, 0.0)


@dataclass(frozen=True)
class Judgement:
    """A measured error and what was allowed, metres and radians; 0 for the part that the goal leaves free.

    ``sigma`` is the standard deviation of the measurement, zeros where it is exact; ``pose``: where the tool
    was measured, in the world.
    """

    position: float
    angle: float
    allowed: Bound
    sigma: Bound
    pose: Pose

    @property
    def passed(self) -> bool:
        return bool(self.position <= self.allowed.position and self.angle <= self.allowed.angle)


def quantisation(robot: Robot, q: Array, resolution: Array, frame: str, tolerance: Tolerance) -> Bound:
    """How far the tool may be off although every servo is right to a tick.

    Half a tick of each joint for rounding the command, half for rounding what is read back, all in the
    worst direction at once: Σ ‖J_j‖ · tick_j at ``q`` (nq,), plus the tolerance of the solve.
    ``resolution`` (nv,) are rad per tick of each joint, zeros without servos.
    """
    jacobian = robot.jacobian(q, frame)
    return Bound(
        float(np.linalg.norm(jacobian[:3], axis=0) @ resolution) + tolerance.position,
        float(np.linalg.norm(jacobian[3:], axis=0) @ resolution) + tolerance.angle,
    )


def judge_read_back(
    robot: Robot, q: Array, goal: Goal, frame: str, bound: Bound, goal_sigma: Bound = EXACT
) -> Judgement:
    """The error of ``frame`` at the joint angles read back (nq,), by MuJoCo's own forward pass.

    ``bound`` comes from ``quantisation``; ``goal_sigma`` says how well the goal is known beside where the arm
    was sent, zeros where both are one.
    """
    pose = robot.measure(q, frame)
    metres, radians = frame_error(goal.rows(robot), goal.weights, pose, goal.target)
    return Judgement(metres, radians, bound.widened(goal_sigma), goal_sigma, pose)


def judge_by_camera(
    robot: Robot,
    seen: Observation,
    pose_world_camera: Pose,
    pose_body_tool: Pose,
    goal: Goal,
    bound: Bound,
    goal_sigma: Bound = EXACT,
) -> Judgement:
    """The error as a camera sees it: the tool carries the marker body that was ``seen``.

    Allowed is three standard deviations of the measurement plus the quantisation of the servos (``bound``),
    and never more than 5 mm and 1 degree; ``goal_sigma`` as in ``judge_read_back``.
    """
    pose = pose_world_camera.compose(seen.pose).compose(pose_body_tool)
    metres, radians = frame_error(goal.rows(robot), goal.weights, pose, goal.target)
    lever = seen.pose.rotation @ pose_body_tool.position
    sigma = Bound(*worst_sigmas(seen.covariance, lever)).combined(goal_sigma)
    allowed = Bound(
        min(LARGEST_MISS, SIGMAS * sigma.position + bound.position),
        min(LARGEST_ANGLE, SIGMAS * sigma.angle + bound.angle),
    )
    return Judgement(metres, radians, allowed, sigma, pose)


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
    """The one decision of a reach: whether the goal is reached, and why so in one sentence.

    Without servos the joint angles are known, so a camera that sees no gripper leaves nothing unproven.

    Args:
        read_back: By the joint angles.
        by_camera: None: no picture shows where the tool is.
        servos: There are any, so the registers may be wrong about the arm.
        blind: Why no camera looked at the arm; empty: one looked.
        seen_goal: The goal is a marker, so a camera is at hand.
        stopped_short: What servo is how far from its command; empty: none is.
        followed: The goal moved.
    """
    account = "by the servos' own account" if servos else "by the model's joint angles"
    explained = ("the servos' ticks" if servos else "the solver's tolerance") + " and the camera"
    if not read_back.passed:
        if stopped_short:
            return False, stopped_short
        off = f"the tool is {1e3 * read_back.position:.2f} mm from the goal {account}"
        why = "the marker moved on, or the arm is too slow" if followed else "the solution was not kept to"
        return False, f"{off}: {why}"
    if by_camera is not None:
        if by_camera.passed:
            return True, f"within what {explained} explain"
        hint = "check zeros, horns and limits" if servos else "check the camera's calibration and place"
        return False, f"farther off than {explained} can explain: {hint}"
    if blind:
        return True, f"{account}: {blind}"
    if servos and seen_goal:
        missing = "no marker of the gripper is in view, so where the tool is remains unproven"
        return False, missing
    return True, f"{account}: no marker of the gripper is in view"
