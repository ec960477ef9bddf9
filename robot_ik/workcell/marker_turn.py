"""The axis error of an arm with five joints in front of a marker, before the motion.

Such an arm reaches the position with the smallest axis error that the joint limits allow.
``AxisPrediction`` holds this error, and a turn of the marker after which the error is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.errors import NotConvergedError
from robot_ik.geometry import Pose, rotation_exp, rotation_log
from robot_ik.goals import BEST, Goal, PoseGoal
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.workcell.verdict import LARGEST_ANGLE, SOLVE_TOLERANCE

if TYPE_CHECKING:
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution

TURN_STEPS = 12
"""Turns of the marker that are tried. Each follows the axis that the arm reached before."""

PROVEN_GAP = math.radians(0.01)
"""rad. Accuracy to which the closed form proves an angle."""

SHOWN_ANGLE = math.radians(0.5)
"""rad. Smaller parts of a turn are not named, and a smaller axis error counts as zero."""

COLUMNS = {"x": 0, "y": 1, "z": 2}
"""Axis of a frame -> column of its rotation matrix."""


@dataclass(frozen=True)
class AxisPrediction:
    """How near an arm brings its tool axis to the axis of a goal.

    Attributes:
        angle: Angle between both axes at the solution, rad.
        proven: Whether no configuration with this position has a smaller angle.
        turn: (3,) rotation vector of the marker about its own axes, rad, after which the arm meets
            its axis. None without a marker, or if no such turn was found.
    """

    angle: float
    proven: bool
    turn: Array | None

    @property
    def is_met(self) -> bool:
        """Whether the angle is within what a reached goal may have."""
        return self.angle <= LARGEST_ANGLE

    def sentence(self) -> str:
        """Return the angle and the turn of the marker, for a person."""
        text = f"The tool reaches the point. Its axis stays {math.degrees(self.angle):.1f}° off"
        text += ", and no configuration does better." if self.proven else "."
        directions = [] if self.turn is None else turn_directions(self.turn)
        if directions:
            text += f" To meet the axis, turn the marker: {', '.join(directions)}."
        return text


def predict_axis(
    robot: Robot, goal: Goal, solution: Solution, pose_world_marker: Pose | None
) -> AxisPrediction | None:
    """Return the axis error of the solution of a goal with ``orientation="best"``.

    Args:
        robot: The robot.
        goal: Goal of the solution.
        solution: Solution whose position is met.
        pose_world_marker: Marker that gave the goal. None without a marker.

    Returns:
        None for other goals.
    """
    if not isinstance(goal, PoseGoal) or goal.orientation != BEST:
        return None
    angle = solution.error.angle
    bound = solution.angle_bound
    proven = bound is not None and angle - bound <= PROVEN_GAP
    turn = None
    if angle > LARGEST_ANGLE and pose_world_marker is not None:
        turn = marker_turn(robot, goal, solution.q, pose_world_marker)
    return AxisPrediction(angle, proven, turn)


def require_angle(
    prediction: AxisPrediction | None, max_angle: float | None, solution: Solution
) -> None:
    """Check the predicted angle before anything moves.

    Args:
        prediction: See ``predict_axis``.
        max_angle: Largest accepted angle, rad. None: any.
        solution: Solution, for the error.

    Raises:
        NotConvergedError: The angle is larger.
    """
    if prediction is None or max_angle is None or prediction.angle <= max_angle:
        return
    raise NotConvergedError(
        f"{prediction.sentence()} Allowed are {math.degrees(max_angle):g}°; nothing was moved",
        solution=solution,
    )


def marker_turn(
    robot: Robot, goal: PoseGoal, start: Array, pose_world_marker: Pose
) -> Array | None:
    """Return the turn of a marker after which the arm meets its axis; None if none is found.

    The tool keeps its pose relative to the marker, so the point moves while the marker is turned
    about its middle. Each step turns the marker by the angle that is left.

    Args:
        robot: The robot.
        goal: Goal with a free axis in front of the marker.
        start: (nq,) joint angles.
        pose_world_marker: Pose of the marker.

    Returns:
        (3,) rotation vector about the marker's own axes, rad.
    """
    column = COLUMNS.get(str(goal.free_axis))
    if column is None:
        return None
    pose_marker_tool = pose_world_marker.inverse().compose(goal.target)
    problem = Problem(robot, goal, tolerance=SOLVE_TOLERANCE)
    marker = pose_world_marker
    q = start
    for _ in range(TURN_STEPS):
        target = marker.compose(pose_marker_tool)
        solution = problem.solve(q, target=target)
        if not solution.converged:
            return None
        q = solution.q
        if solution.error.angle < SHOWN_ANGLE:
            turned = pose_world_marker.inverse().compose(marker)
            return np.array(rotation_log(turned.wxyz))
        target_axis = target.rotation[:, column]
        tool_axis = robot.measure(q, goal.frame).rotation[:, column]
        turn = Pose((0.0, 0.0, 0.0), rotation_exp(_rotation_between(target_axis, tool_axis)))
        marker = Pose(marker.position, turn.compose(marker).wxyz)
    return None


def turn_directions(turn: Array) -> list[str]:
    """Return the parts of a small turn of a printed marker in words, largest first.

    The viewer looks at the printed side. The marker's x axis points to its right edge, y to its
    upper edge, and z to the viewer.

    Args:
        turn: (3,) rotation vector about these axes, rad.
    """
    names = (
        ("upper edge towards the viewer", "upper edge away from the viewer"),
        ("right edge away from the viewer", "right edge towards the viewer"),
        ("counter-clockwise in its plane", "clockwise in its plane"),
    )
    parts = []
    for index in np.argsort(-np.abs(turn)).tolist():
        angle = float(turn[index])
        if abs(angle) >= SHOWN_ANGLE:
            text = names[index][0] if angle > 0.0 else names[index][1]
            parts.append(f"{text} by {math.degrees(abs(angle)):.0f}°")
    return parts


def _rotation_between(first: Array, second: Array) -> Array:
    """Return the rotation vector (3,) of the shortest turn between two unit vectors, rad."""
    axis = np.cross(first, second)
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return np.zeros(3)
    angle = math.atan2(sine, float(first @ second))
    return np.asarray(axis * (angle / sine))
