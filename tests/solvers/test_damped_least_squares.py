"""Both forms of damped least squares against their formulas."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from robot_ik.goals import PositionGoal
from robot_ik.problem import Problem
from robot_ik.solvers.damped_least_squares import DampedLeastSquares

FREE_STEP = {"clamp": 1e6, "max_step": 1e6}
CASES = [(r, k) for r in ("puma560", "planar", "tree") for k in ("position", "pose")] + [
    ("tree", "two goals")
]
cases = pytest.mark.parametrize(("robot_name", "kind"), CASES)


def damped(jacobian, e, damping):
    return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping**2 * np.eye(len(e)), e)


@cases
@pytest.mark.parametrize("svd", [False, True])
def test_a_step_equals_the_formula(robot_name, kind, svd, near_problems, linear_model, one_step):
    for problem, q in near_problems(robot_name, kind):
        jacobian, e = linear_model(problem, q)
        step = one_step(DampedLeastSquares(damping=0.3, svd=svd, **FREE_STEP), problem, q)
        np.testing.assert_allclose(step, damped(jacobian, e, 0.3), atol=1e-9)


@pytest.mark.parametrize("svd", [False, True])
def test_at_a_singular_pose_steps_stay_small(svd, robots, one_step):
    robot = robots("planar")
    solver = DampedLeastSquares(svd=svd, **FREE_STEP)
    for bend in (0.0, 1e-12, 1e-9, 1e-6, 1e-3):
        problem = Problem(robot, PositionGoal(None, (0.9, 0.1, 0)))
        step = one_step(solver, problem, np.array([0.0, bend, bend]))
        assert np.abs(step).max() < 5.0


def test_the_box_step_is_the_bounded_minimum(robots, linear_model, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(5)
    met = 0
    for _ in range(20):
        q = robot.sample(rng)
        near = rng.integers(6)
        q[near] = robot.upper[near] - rng.uniform(0.0, 0.01)
        problem = Problem(
            robot, PositionGoal(None, robot.forward(q).position + rng.uniform(-0.1, 0.1, 3))
        )
        jacobian, e = linear_model(problem, q)
        step = one_step(DampedLeastSquares(damping=0.1, **FREE_STEP), problem, q)
        rows = np.vstack([jacobian, 0.1 * np.eye(6)])
        exact = lsq_linear(
            rows, np.concatenate([e, np.zeros(6)]), (robot.lower - q, robot.upper - q + 1e-15)
        )
        np.testing.assert_allclose(step, exact.x, atol=1e-5)
        met += abs(q[near] + step[near] - robot.upper[near]) < 1e-12
    assert met > 3


def test_a_joint_at_its_limit_does_not_freeze_the_others(robots, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(3)
    stood = 0
    for _ in range(20):
        q = robot.home + rng.uniform(-0.3, 0.3, 6)
        q[1] = robot.lower[1]
        problem = Problem(
            robot, PositionGoal(None, robot.forward(q).position + rng.uniform(-0.02, 0.02, 3))
        )
        step = one_step(DampedLeastSquares(svd=True), problem, q)
        assert step[1] >= 0.0 and step.any()
        stood += step[1] == 0.0
    assert stood > 3
