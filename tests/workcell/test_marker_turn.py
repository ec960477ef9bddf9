"""The predicted axis error of a five-joint arm, and the turn of the marker that removes it."""

from __future__ import annotations

import math

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import NotConvergedError
from robot_ik.geometry import rotation_exp
from robot_ik.workcell.marker_turn import (
    SHOWN_ANGLE,
    marker_turn,
    predict_axis,
    require_angle,
    turn_directions,
)
from robot_ik.workcell.verdict import SOLVE_TOLERANCE
from tests.five_joint_arms import load

IN_FRONT = rik.Pose((0.0, 0.0, 0.03), (0.0, 1.0, 0.0, 0.0))
"""Pose of the tool in the frame of the marker: 3 cm above it, looking at it."""


def turned(pose, rotation_vector):
    """Return a pose that is turned about its own axes."""
    return pose.compose(rik.Pose((0.0, 0.0, 0.0), rotation_exp(rotation_vector)))


def reachable_marker(robot, rng):
    """Return a marker before which the arm can stand exactly."""
    return robot.forward(robot.sample(rng)).compose(IN_FRONT.inverse())


def solved(robot, marker):
    target = marker.compose(IN_FRONT)
    goal = rik.PoseGoal(robot.tool, target.position, target.wxyz, free_axis="z", orientation="best")
    return goal, rik.solve(robot, goal, tolerance=SOLVE_TOLERANCE)


@pytest.mark.parametrize("name", ["koch_v11", "so101"])
def test_the_arm_meets_the_axis_of_a_marker_that_is_turned_as_predicted(name):
    robot = load(name)
    rng = np.random.default_rng(3)
    tried = 0
    while tried < 10:
        marker = turned(reachable_marker(robot, rng), rng.uniform(-0.3, 0.3, 3))
        goal, solution = solved(robot, marker)
        if not solution.converged or solution.error.angle < math.radians(3.0):
            continue
        prediction = predict_axis(robot, goal, solution, marker)
        assert prediction.proven
        assert prediction.angle == solution.error.angle
        if prediction.turn is None:
            continue
        tried += 1
        after, meets = solved(robot, turned(marker, prediction.turn))
        assert meets.converged
        pose = robot.measure(meets.q)
        cosine = float(pose.rotation[:, 2] @ after.target.rotation[:, 2])
        assert math.acos(min(1.0, cosine)) < SHOWN_ANGLE
        assert "turn the marker: " in prediction.sentence()


def test_a_marker_that_the_arm_meets_needs_no_turn():
    robot = load("so101")
    marker = reachable_marker(robot, np.random.default_rng(4))
    goal, solution = solved(robot, marker)
    prediction = predict_axis(robot, goal, solution, marker)
    assert prediction.is_met
    assert prediction.turn is None
    require_angle(prediction, 0.01, solution)


def test_a_larger_angle_than_allowed_is_refused_with_the_turn():
    robot = load("so101")
    marker = turned(reachable_marker(robot, np.random.default_rng(5)), (0.2, 0.3, 0.0))
    goal, solution = solved(robot, marker)
    prediction = predict_axis(robot, goal, solution, marker)
    assert prediction.angle > math.radians(2.0)
    require_angle(prediction, None, solution)
    require_angle(prediction, prediction.angle + 1e-6, solution)
    with pytest.raises(NotConvergedError, match="nothing was moved") as caught:
        require_angle(prediction, math.radians(1.0), solution)
    assert f"{math.degrees(prediction.angle):.1f}° off" in str(caught.value)


def test_other_goals_have_no_promise():
    robot = load("so101")
    goal = rik.PositionGoal(robot.tool, robot.forward(robot.home).position)
    assert predict_axis(robot, goal, rik.solve(robot, goal), None) is None


def test_a_turn_without_a_free_axis_is_not_named():
    robot = load("so101")
    pose = robot.forward(robot.home)
    goal = rik.PoseGoal(robot.tool, pose.position, pose.wxyz, orientation="best")
    assert marker_turn(robot, goal, robot.home, pose) is None


def test_directions_are_those_of_the_edges():
    marker = rik.Pose((0.0, 0.0, 0.0))
    # Middles of the upper and the right edge; z points to the viewer.
    upper = np.array([0.0, 1.0, 0.0])
    right = np.array([1.0, 0.0, 0.0])
    about_x = turned(marker, (0.2, 0.0, 0.0)).rotation
    assert (about_x @ upper)[2] > 0.0
    assert turn_directions(np.array([0.2, 0.0, 0.0])) == ["upper edge towards the viewer by 11°"]
    about_y = turned(marker, (0.0, 0.2, 0.0)).rotation
    assert (about_y @ right)[2] < 0.0
    assert turn_directions(np.array([0.001, -0.1, 0.2])) == [
        "counter-clockwise in its plane by 11°",
        "right edge towards the viewer by 6°",
    ]
