"""auto: the method that it tries first, and the measurement of this choice."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Problem
from robot_ik.solution import Status
from robot_ik.solvers.analytic.recognise import Family
from robot_ik.solvers.auto import LM_FIRST_WHEN_NEAR


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


def poses_of(robot, count, seed=1):
    rng = np.random.default_rng(seed)
    return [robot.forward(robot.sample(rng)) for _ in range(count)]


def near_starts(robot, count, seed=3):
    """Poses, and starts near joint angles that reach them."""
    rng = np.random.default_rng(seed)
    span = robot.upper - robot.lower
    inside = [robot.lower + span * rng.uniform(0.2, 0.8, robot.nq) for _ in range(count)]
    starts = [q + rng.uniform(-0.01, 0.01, robot.nq) for q in inside]
    return [robot.forward(q) for q in inside], starts


def test_the_closed_form_is_used_if_there_is_one_and_lm_otherwise(puma):
    pose = poses_of(puma, 1)[0]
    goal = PoseGoal.at(None, pose)
    assert rik.solve(puma, goal).solver == "analytic"
    assert rik.solve(puma, PositionGoal(None, pose.position)).solver == "lm"
    assert rik.solve(puma, [goal, OrientationGoal(None, pose.wxyz)]).solver == "lm"


@pytest.mark.parametrize("name", ["puma560", "ur5e"])
def test_near_its_goal_lm_is_first_and_far_from_it_the_closed_form(name):
    robot = rik.load_robot(name)
    for pose, start in zip(*near_starts(robot, 20), strict=True):
        warm = rik.solve(robot, PoseGoal.at(None, pose), start=start)
        assert warm.converged
        assert warm.solver == "lm"
        assert warm.restarts == 0
        assert np.abs(warm.q - start).max() < 0.1  # the branch of the start
    for pose in poses_of(robot, 20):
        cold = rik.solve(robot, PoseGoal.at(None, pose))
        assert cold.converged
        assert cold.solver == "analytic"


def test_a_limb_is_solved_by_lm_and_keeps_its_proof():
    arm = rik.load_robot("srs_arm")
    problem = Problem(arm, PoseGoal(None, (0.4, 0.1, 0.5)))
    for pose in poses_of(arm, 300):
        solution = problem.solve(target=pose)
        assert solution.converged
        assert solution.solver == "lm"
    # The target is inside the ball of the sum of all links, but the wrist would be too far from the
    # shoulder.
    center, radius = arm.reach(arm.tool)
    proven = PoseGoal(None, center + np.array([0, 0, 0.97 * radius]), (0, 1, 0, 0))
    assert Problem(arm, proven).solve().status is Status.UNREACHABLE


@pytest.mark.parametrize("name", ["puma560", "srs_arm"])
def test_a_batch_chooses_the_same_method_as_a_single_solve(name):
    robot = rik.load_robot(name)
    near, starts = near_starts(robot, 12)
    poses = [*near, *poses_of(robot, 12)]
    starts = np.array([*starts, *([robot.home] * 12)])
    batch = rik.solve_batch(robot, np.array([pose.matrix for pose in poses]), starts=starts)
    problem = Problem(robot, PoseGoal.at(None, poses[0]))
    for row, (pose, start) in enumerate(zip(poses, starts, strict=True)):
        alone = problem.solve(start, target=pose)
        # Two compiled versions of one source may differ in the last bits. Solutions of lm and of
        # the closed form differ by more.
        assert batch.status[row] == alone.status
        assert batch.iterations[row] == alone.iterations
        np.testing.assert_allclose(batch.q[row], alone.q, atol=1e-7)


@pytest.mark.parametrize(
    "budget", [Budget(0), Budget(1), Budget(8, restarts=0), Budget(300, restarts=2)]
)
def test_a_batch_shares_the_budget_as_single_solves_do(puma, budget):
    behind_the_limits = PoseGoal(None, (0.02, 0.03, -0.5), (0.5, 0.5, -0.5, 0.5)).target
    out_of_reach = PoseGoal(None, (3.0, 1.0, 1.0)).target
    poses = [*poses_of(puma, 6), behind_the_limits, behind_the_limits, out_of_reach]
    batch = rik.solve_batch(puma, poses, budget=budget)
    problem = Problem(puma, PoseGoal.at(None, poses[0]), budget=budget)
    for row, pose in enumerate(poses):
        alone = problem.solve(target=pose)
        assert batch.status[row] == alone.status
        assert batch.iterations[row] == alone.iterations
        assert batch.restarts[row] == alone.restarts
    assert batch.iterations.max() <= budget.iterations


@pytest.fixture(scope="module")
def measure():
    """The script that measures which method should be first."""
    file = Path(__file__).parents[2] / "docs" / "make" / "measure_first_choice.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_choice_follows_the_times(measure):
    times = {
        ("wrist", "one", "cold"): {"lm": 12.0, "analytic": 36.0, "auto": 12.5},
        ("wrist", "one", "warm"): {"lm": 9.5, "analytic": 10.0, "auto": 13.0},
        ("other", "one", "warm"): {"lm": 7.0, "analytic": 9.0, "auto": 7.5},
        ("other", "two", "warm"): {"lm": 14.0, "analytic": 9.0, "auto": 9.5},
    }
    # Both arms of a family count.
    expected = {
        ("wrist", "cold"): "lm",
        ("wrist", "warm"): "analytic",
        ("other", "warm"): "analytic",
    }
    assert measure.choose(times) == expected
    assert measure.over_best(times["wrist", "one", "warm"]) == pytest.approx(13.0 / 9.5)


def test_the_choice_is_measured_on_arms_of_every_family_that_it_names(measure):
    families = {measure.family_of(arm) for arm in measure.arms()}
    assert {family.name.lower() for family in LM_FIRST_WHEN_NEAR} <= families
    assert set(measure.choice_of_auto()) == {
        (family.name.lower(), kind) for family in Family for kind in ("cold", "warm")
    }
