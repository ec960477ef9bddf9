"""The Jacobian transpose against its formula."""

from itertools import pairwise

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.goals import PositionGoal
from robot_ik.problem import Problem
from robot_ik.solvers.jacobian_transpose import JacobianTranspose

FREE_STEP = {"clamp": 1e6, "max_step": 1e6, "gain": 1.0}
CASES = [(r, k) for r in ("puma560", "planar", "tree") for k in ("position", "orientation", "pose")]
CASES += [("tree", "two goals")]
cases = pytest.mark.parametrize(("robot_name", "kind"), CASES)


def buss(jacobian, e):
    moved = jacobian @ jacobian.T @ e
    return (e @ moved) / (moved @ moved) * jacobian.T @ e


@cases
def test_a_step_equals_the_formula_of_buss(robot_name, kind, near_problems, linear_model, one_step):
    for problem, q in near_problems(robot_name, kind):
        jacobian, e = linear_model(problem, q)
        step = one_step(JacobianTranspose(**FREE_STEP), problem, q)
        np.testing.assert_allclose(step, buss(jacobian, e), atol=1e-9)
        # The best length on the linear model: any other leaves more.
        left = np.linalg.norm(e - jacobian @ step)
        for other in (0.9, 1.1):
            assert left <= np.linalg.norm(e - other * jacobian @ step) + 1e-12


@cases
def test_every_step_reduces_the_cost_near_a_goal(robot_name, kind, near_problems):
    for problem, q in near_problems(robot_name, kind):
        budget = Budget(iterations=30, restarts=0)
        traced = Problem(
            problem.robot, problem.goals, solver="transpose", trace=True, budget=budget
        )
        costs = [row.cost for row in traced.solve(q).trace]
        assert len(costs) > 1 and all(b <= a for a, b in pairwise(costs))


def test_the_fixed_alpha(near_problems, linear_model, one_step):
    for problem, q in near_problems("puma560", "pose"):
        jacobian, e = linear_model(problem, q)
        step = one_step(JacobianTranspose(fixed_alpha=0.03, **FREE_STEP), problem, q)
        np.testing.assert_allclose(step, 0.03 * jacobian.T @ e, atol=1e-9)


def test_the_shared_options(near_problems, linear_model, one_step):
    for problem, q in near_problems("tree", "two goals", distance=0.3):
        jacobian, e = linear_model(problem, q)
        clamped = np.concatenate(
            [part * min(1.0, 0.1 / np.linalg.norm(part)) for part in (e[:3], e[3:])]
        )
        assert not np.allclose(clamped, e)
        step = one_step(JacobianTranspose(clamp=0.1, max_step=1e6, gain=0.5), problem, q)
        np.testing.assert_allclose(step, 0.5 * buss(jacobian, clamped), atol=1e-9)
        step = one_step(JacobianTranspose(clamp=1e6, max_step=1e-3, gain=1.0), problem, q)
        whole = buss(jacobian, e)
        np.testing.assert_allclose(step, whole * 1e-3 / np.abs(whole).max(), atol=1e-12)


@pytest.mark.parametrize(
    ("robot_name", "kind"), [("puma560", "position"), ("puma560", "pose"), ("tree", "two goals")]
)
def test_the_alternative_jacobian(robot_name, kind, near_problems, linear_model, one_step):
    for problem, q in near_problems(robot_name, kind, distance=0.2):
        jacobian, e = linear_model(problem, q, alternative=True)
        assert not np.allclose(jacobian, linear_model(problem, q)[0])
        step = one_step(JacobianTranspose(alternative=True, **FREE_STEP), problem, q)
        np.testing.assert_allclose(step, buss(jacobian, e), atol=1e-9)


def test_a_joint_at_its_limit_does_not_freeze_the_others(robots, linear_model, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(3)
    steps_at_limits = 0
    for _ in range(20):
        q = robot.home + rng.uniform(-0.3, 0.3, 6)
        q[1] = robot.lower[1]
        q[2] = robot.upper[2]
        problem = Problem(
            robot, PositionGoal(None, robot.forward(q).position + rng.uniform(-0.02, 0.02, 3))
        )
        jacobian, e = linear_model(problem, q)
        slope = jacobian.T @ e
        gone = ((q <= robot.lower) & (slope < 0)) | ((q >= robot.upper) & (slope > 0))
        jacobian[:, gone] = 0.0
        step = one_step(JacobianTranspose(**FREE_STEP), problem, q)
        np.testing.assert_allclose(step, buss(jacobian, e), atol=1e-9)
        assert not step[gone].any() and step[~gone].any()
        steps_at_limits += int(gone.any())
    assert steps_at_limits > 5


def test_stretched_out_with_the_goal_on_the_line_the_step_is_zero(robots, one_step):
    robot = robots("planar")
    problem = Problem(robot, PositionGoal(None, (0.8, 0, 0)), solver=JacobianTranspose())
    assert not one_step(JacobianTranspose(), problem, np.zeros(3)).any()
    assert problem.solve(np.zeros(3)).converged  # by a restart
