"""Verdicts: bounds against brute force, uncertainty against random draws, limits."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik.camera.goals import worst_sigmas
from robot_ik.camera.targets import Observation
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal, Tolerance
from robot_ik.robot import Robot, load_robot
from robot_ik.workcell.verdict import (
    LARGEST_ANGLE,
    LARGEST_ERROR,
    SIGMAS,
    Bound,
    Judgement,
    decide,
    judge_by_camera,
    judge_read_back,
    quantisation,
)

EXACT = Tolerance(position=1e-9, angle=1e-9)


@pytest.fixture(scope="module")
def puma() -> Robot:
    return load_robot("puma560")


@pytest.mark.parametrize("seed", range(4))
def test_no_rounding_of_the_servos_leaves_the_bound(seed: int, puma: Robot) -> None:
    rng = np.random.default_rng(seed)
    q = puma.sample(rng)
    ticks = rng.uniform(2e-4, 2e-3, puma.nv)
    bound = quantisation(puma, q, ticks, "gripper", EXACT)
    there = puma.forward(q, "gripper")
    corners = rng.choice([-1.0, 1.0], (60, puma.nv)) * ticks
    errors = np.array([puma.forward(q + dq, "gripper").distance(there) for dq in corners])
    assert (errors[:, 0] <= 1.01 * bound.position).all() and (
        errors[:, 1] <= 1.01 * bound.angle
    ).all()
    # The bound is not arbitrarily large: the errors of single joints add up to it.
    alone = sum(puma.forward(q + dq, "gripper").distance(there)[0] for dq in np.diag(ticks))
    assert bound.position == pytest.approx(alone, rel=0.01)


def test_without_servos_only_the_solver_may_be_off(puma: Robot) -> None:
    bound = quantisation(
        puma, puma.home, np.zeros(6), "gripper", Tolerance(position=1e-5, angle=1e-4)
    )
    assert bound == Bound(1e-5, 1e-4)


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_read_back_passes_up_to_its_bound(factor: float, puma: Robot) -> None:
    pose = puma.forward(puma.home, "gripper")
    target = Pose(np.add(pose.position, [0.0, factor * 1e-3, 0.0]), pose.wxyz)
    goal = PoseGoal("gripper", position=target.position, wxyz=target.wxyz)
    judged = judge_read_back(puma, puma.home, goal, "gripper", Bound(1e-3, 1e-3))
    assert judged.position == pytest.approx(factor * 1e-3) and judged.passed is (factor < 1)
    turned = Pose(
        pose.position, pose.compose(Pose((0, 0, 0), rotation_exp([0, 0, factor * 1e-3]))).wxyz
    )
    goal = PoseGoal("gripper", position=turned.position, wxyz=turned.wxyz)
    judged = judge_read_back(puma, puma.home, goal, "gripper", Bound(1e-3, 1e-3))
    assert judged.angle == pytest.approx(factor * 1e-3, rel=1e-6) and judged.passed is (factor < 1)


def test_a_position_goal_has_no_angle(puma: Robot) -> None:
    pose = puma.forward(puma.home, "gripper")
    goal = PositionGoal("gripper", pose.position)
    judged = judge_read_back(puma, puma.home, goal, "gripper", Bound(1e-6, 1e-6))
    assert judged.passed and judged.angle == 0.0


def test_uncertainty_at_the_tool_against_random_draws() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((6, 6)) * np.array([1e-3] * 3 + [4e-3] * 3)[:, None]
    covariance = root @ root.T
    lever = np.array([0.05, -0.1, 0.2])
    twists = rng.multivariate_normal(np.zeros(6), covariance, 40_000)
    moved = twists[:, :3] + np.cross(twists[:, 3:], lever)
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(moved.T))[-1])
    sigma = Bound(*worst_sigmas(covariance, lever))
    assert sigma.position == pytest.approx(worst, rel=0.03)
    assert sigma.angle == pytest.approx(
        np.sqrt(np.linalg.eigvalsh(np.cov(twists[:, 3:].T))[-1]), rel=0.03
    )


def by_camera(error: float, angle: float, sigma: float, bound: Bound):  # type: ignore[no-untyped-def]
    target = Pose((0.3, -0.2, 0.9), rotation_exp([0.3, 1.2, -0.4]))
    pose_world_camera = Pose((1.0, 1.0, 1.5), rotation_exp([2.0, 0.3, 0.1]))
    pose_body_tool = Pose((0.0, 0.01, 0.12), rotation_exp([0.0, 0.2, 0.0]))
    tool = target.compose(Pose((0.0, error, 0.0), rotation_exp([angle, 0.0, 0.0])))
    body = pose_world_camera.inverse().compose(tool).compose(pose_body_tool.inverse())
    covariance = np.diag([sigma**2] * 3 + [1e-18] * 3)
    seen = Observation(np.zeros((4, 3)), np.zeros((4, 2)), body, 0.1, covariance=covariance)
    goal = PoseGoal("gripper", position=target.position, wxyz=target.wxyz)
    return judge_by_camera(
        load_robot("puma560"), seen, pose_world_camera, pose_body_tool, goal, bound
    )


@pytest.mark.parametrize(
    ("error", "sigma", "ticks", "allowed"),
    [
        (0.0012, 1e-4, 1e-3, 3e-4 + 1e-3),
        (0.0014, 1e-4, 1e-3, 3e-4 + 1e-3),
        (0.0049, 3e-3, 1e-3, LARGEST_ERROR),
        (0.0051, 3e-3, 1e-3, LARGEST_ERROR),
    ],
)
def test_the_camera_allows_three_sigma_and_ticks_but_never_more_than_5_mm(
    error: float, sigma: float, ticks: float, allowed: float
) -> None:
    judged = by_camera(error, 0.0, sigma, Bound(ticks, 0.01))
    assert judged.position == pytest.approx(error, rel=1e-6)
    assert judged.allowed.position == pytest.approx(allowed, rel=1e-6)
    assert judged.allowed.position <= SIGMAS * judged.sigma.position + ticks + 1e-12
    assert judged.passed is (error < allowed)


@pytest.mark.parametrize(("angle_deg", "passed"), [(0.9, True), (1.1, False)])
def test_no_more_than_one_degree(angle_deg: float, passed: bool) -> None:
    judged = by_camera(0.0, np.deg2rad(angle_deg), 1e-4, Bound(1e-3, 0.5))
    assert judged.allowed.angle == LARGEST_ANGLE and judged.angle == pytest.approx(
        np.deg2rad(angle_deg)
    )
    assert judged.passed is passed


def test_two_looks_at_a_moving_goal_may_differ_by_what_they_are_worth(puma: Robot) -> None:
    pose = puma.forward(puma.home, "gripper")
    target = Pose(np.add(pose.position, [0.0, 4e-4, 0.0]), pose.wxyz)
    goal = PoseGoal("gripper", position=target.position, wxyz=target.wxyz)
    asked = (puma, puma.home, goal, "gripper", Bound(1e-5, 1e-4))
    assert not judge_read_back(*asked).passed
    assert judge_read_back(*asked, Bound(2e-4, 1e-3)).passed
    wide = judge_read_back(*asked, Bound(1.0, 1.0)).allowed
    # However uncertain the goal is, this is the limit.
    assert wide == Bound(LARGEST_ERROR, LARGEST_ANGLE)


def judged(error: float) -> Judgement:
    return Judgement(error, 0.0, Bound(1e-3, 0.01), Bound(0.0, 0.0), Pose())


@pytest.mark.parametrize(
    ("by_camera", "servos", "blind", "seen_goal", "reached", "says"),
    [
        (judged(0.0), True, "", True, True, "servos' ticks"),
        (judged(0.0), False, "", True, True, "solver's tolerance"),
        (judged(2e-3), True, "", True, False, "zeros, horns"),
        (judged(2e-3), False, "", True, False, "calibration"),
        (None, True, "", True, False, "unproven"),
        (None, True, "", False, True, "servos' registers"),
        (None, False, "", True, True, "model's joint angles"),
        (None, True, "nobody looked", True, True, "nobody looked"),
    ],
)
def test_verdict_and_text_agree(
    by_camera: Judgement | None, servos: bool, blind: str, seen_goal: bool, reached: bool, says: str
) -> None:
    asked = {"servos": servos, "blind": blind, "seen_goal": seen_goal}
    decided, text = decide(judged(0.0), by_camera, **asked)  # type: ignore[arg-type]
    assert decided is reached and says in text
    # Joints that have not arrived fail whatever the camera measures, and the text says so.
    decided, text = decide(judged(3e-3), by_camera, **asked)  # type: ignore[arg-type]
    assert not decided and "3.00 mm" in text and "explain" not in text
    stuck = decide(judged(3e-3), by_camera, **asked, stopped_short="joint2 is 3° off")  # type: ignore[arg-type]
    assert stuck == (False, "joint2 is 3° off")
