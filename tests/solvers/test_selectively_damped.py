"""Selectively damped least squares against the paper's formulas, written with NumPy's SVD."""

import math

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.goals import PositionGoal
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solvers import make_solver
from robot_ik.solvers.selectively_damped import SelectivelyDamped

CASES = [(r, k) for r in ("puma560", "planar", "tree") for k in ("position", "pose")] + [
    ("tree", "two goals")
]


def clamp_max_abs(v, limit):
    largest = np.abs(v).max()
    return v * limit / largest if largest > limit else v


def buss_kim(jacobian, e, effectors, gamma_max):
    """Δθ for ``effectors``, the rows of each end effector."""
    u, sigma, vt = np.linalg.svd(jacobian, full_matrices=False)
    total = np.zeros(jacobian.shape[1])
    rho = np.array([np.linalg.norm(jacobian[rows], axis=0) for rows in effectors])
    for i in range(len(sigma)):
        if sigma[i] < 1e-12 * sigma[0]:
            continue
        n_i = sum(np.linalg.norm(u[rows, i]) for rows in effectors)
        m_i = (rho * np.abs(vt[i])).sum() / sigma[i]
        gamma = min(1.0, n_i / m_i) * gamma_max
        total += clamp_max_abs(e @ u[:, i] / sigma[i] * vt[i], gamma)
    return clamp_max_abs(total, gamma_max)


def effectors_of(problem):
    sizes = [3 * sum(weight > 0.0 for weight in goal.weights) for goal in problem.goals]
    ends = np.cumsum(sizes)
    return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]


@pytest.mark.parametrize(("robot_name", "kind"), CASES)
@pytest.mark.parametrize("gamma_max", [math.pi / 4, 0.02])
def test_a_step_equals_that_of_the_paper(
    robot_name, kind, gamma_max, near_problems, linear_model, one_step
):
    damped = 0
    for problem, q in near_problems(robot_name, kind):
        jacobian, e = linear_model(problem, q)
        expected = buss_kim(jacobian, e, effectors_of(problem), gamma_max)
        step = one_step(SelectivelyDamped(clamp=1e6, max_step=gamma_max), problem, q)
        np.testing.assert_allclose(step, expected, atol=1e-8)
        assert np.abs(step).max() <= gamma_max * (1 + 1e-12)
        damped += not np.allclose(step, np.linalg.pinv(jacobian, rcond=1e-9) @ e, atol=1e-6)
    assert damped > 0 or gamma_max > 0.5


@pytest.mark.parametrize("kind", ["position", "pose"])
def test_every_step_reduces_the_cost_of_the_linear_model(
    kind, near_problems, linear_model, one_step
):
    compared = 0
    for problem, q in near_problems("puma560", kind, distance=1.0, count=20):
        jacobian, e = linear_model(problem, q)
        step = one_step(SelectivelyDamped(clamp=1e6), problem, q)
        inside = problem.robot.clip(q + step) == q + step
        if inside.all():
            assert e @ jacobian @ step > 0
            compared += 1
    assert compared > 0


def test_a_joint_at_its_limit_does_not_freeze_the_others(robots, linear_model, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(3)
    steps_at_limits = 0
    for _ in range(30):
        q = robot.home + rng.uniform(-0.3, 0.3, 6)
        q[1] = robot.lower[1]
        problem = Problem(
            robot, PositionGoal(None, robot.forward(q).position + rng.uniform(-0.02, 0.02, 3))
        )
        jacobian, e = linear_model(problem, q)
        whole = buss_kim(jacobian, e, [slice(0, 3)], math.pi / 4)
        step = one_step(SelectivelyDamped(), problem, q)
        if jacobian[:, 1] @ e < 0 or whole[1] < 0:
            jacobian[:, 1] = 0.0
            whole = buss_kim(jacobian, e, [slice(0, 3)], math.pi / 4)
            steps_at_limits += 1
            assert step[1] == 0.0 and step.any()
        np.testing.assert_allclose(step, whole, atol=1e-8)
    assert steps_at_limits > 5


@pytest.mark.parametrize("where", [(1.3, 0.9, 0.0), (3.0, 0.0, 0.0)])
def test_it_does_not_oscillate_at_an_unreachable_target(where, robots):
    """The last steps of this method are small. Those of the pseudoinverse are not."""
    robot = robots("planar")
    goal = PositionGoal(None, where)
    last = {}
    for name in ("sdls", "pseudoinverse"):
        solver = make_solver(name, patience=1000, first_steps=1000)
        problem = Problem(
            robot, goal, trace=True, budget=Budget(iterations=200, restarts=1), solver=solver
        )
        last[name] = max(
            row.step for row in problem.solve(np.array([0.4, 0.6, 0.5])).trace[100:200]
        )
    assert last["sdls"] < 0.02 < last["pseudoinverse"]


@pytest.mark.parametrize(
    ("name", "options"),
    [("sdls", {}), ("transpose", {}), ("pseudoinverse", {"aim": "limits"}), ("dls", {"svd": True})],
)
def test_many_goals_on_a_floating_base(name, options):
    robot = load_robot("humanoid")
    rng = np.random.default_rng(4)
    for _ in range(3):
        q = robot.sample(rng)
        frames = ("left_hand", "right_hand", "left_foot", "right_foot")
        problem = Problem(
            robot,
            [PositionGoal(f, robot.forward(q, f).position) for f in frames],
            solver=make_solver(name, **options),
        )
        solution = problem.solve()
        assert solution.converged and not robot.outside(solution.q)
        assert max(error.position for error in solution.errors) <= 1e-4
