"""Observations become goals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.camera.corners import unrefined
from robot_ik.camera.goals import (
    MAX_AMBIGUITY,
    MIN_WEIGHT,
    goal_weight,
    observed_goal,
    worst_sigmas,
)
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA as CAMERA
from robot_ik.camera.targets import Observation, marker, marker_points
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal

FACING = np.array([0.0, 1.0, 0.0, 0.0])
WORLD_CAMERA = Pose((0.3, 0.1, 4.0), FACING)
HOVER = Pose((0.0, 0.0, 0.12), FACING)


def observed(distance: float, tilt_deg: float) -> tuple[Observation, Pose]:
    """A marker of 50 mm, and its true pose in the world. Far away both poses fit."""
    lean = rotation_exp([np.deg2rad(tilt_deg), 0, 0])
    pose = Pose((0.0, 0.0, distance), quat_multiply(FACING, lean))
    rng = np.random.default_rng(1)
    pixels = CAMERA.project(pose.apply(marker_points(0.05))) + rng.normal(0, 0.1, (4, 2))
    fits = marker(7, 0.05).fit({7: unrefined(pixels, CAMERA, 0.1)}, CAMERA)
    assert fits is not None
    return fits.observation(), WORLD_CAMERA.compose(pose)


def test_a_certain_observation_becomes_a_pose_goal() -> None:
    observation, pose_world_marker = observed(0.4, 35.0)
    goal = observed_goal(observation, WORLD_CAMERA, HOVER, "gripper")
    assert isinstance(goal, PoseGoal)
    assert goal.frame == "gripper"
    position, angle = goal.target.distance(pose_world_marker.compose(HOVER))
    assert position < 2e-3
    assert angle < np.deg2rad(1.0)


def test_an_ambiguous_orientation_is_not_passed_on() -> None:
    """The tool is beside the marker: its position depends on the orientation."""
    observation, _ = observed(4.0, 25.0)
    assert observation.ambiguity > MAX_AMBIGUITY
    assert observed_goal(observation, WORLD_CAMERA, HOVER) is None


def test_where_both_orientations_agree_the_position_is_a_goal() -> None:
    observation, pose_world_marker = observed(4.0, 25.0)
    goal = observed_goal(observation, WORLD_CAMERA, Pose((0, 0, 0), FACING))
    assert isinstance(goal, PositionGoal)
    assert goal.position == pytest.approx(pose_world_marker.position, abs=0.1)


@settings(max_examples=30)
@given(st.floats(1e-6, 1.0), st.floats(1e-6, 1.0))
def test_the_weight_of_a_goal_falls_with_its_uncertainty(sigma: float, trusted: float) -> None:
    weight = goal_weight(sigma, trusted)
    assert MIN_WEIGHT <= weight <= 1.0
    assert weight <= goal_weight(0.5 * sigma, trusted)
    if MIN_WEIGHT < weight < 1.0:
        assert weight == pytest.approx(trusted / sigma)
    assert goal_weight(0.0, trusted) == 1.0


def test_the_worst_sigma_of_a_point_is_that_of_its_scatter() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(0, [1e-3] * 3 + [1e-2] * 3, (6, 6))
    covariance = root.T @ root
    lever = np.array([0.1, -0.05, 0.2])
    steps = rng.multivariate_normal(np.zeros(6), covariance, 20000)
    moves = steps[:, :3] + np.cross(steps[:, 3:], lever)
    position, angle = worst_sigmas(covariance, lever)
    assert position == pytest.approx(np.sqrt(np.linalg.eigvalsh(np.cov(moves.T))[-1]), rel=0.05)
    assert angle == pytest.approx(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
