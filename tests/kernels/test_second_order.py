"""The exact Hessian against finite differences of the cost, and where it is not asked for."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.workspace import open_work
from robot_ik.problem import Problem
from robot_ik.solvers.levenberg_marquardt import has_second_order, second_order
from tests.residual_rows import residual_and_jacobian

# Slides before and after hinges, a branch that the second goal alone hangs on.
MIXED = """<mujoco><compiler angle="radian"/><worldbody>
<body name="base"><joint name="rail" type="slide" axis="1 0.2 0"/><geom size="0.1"/>
 <body name="arm" pos="0 0 0.3"><joint name="shoulder" axis="0 1 0.1"/><geom size="0.1"/>
  <body name="column" pos="0.4 0 0"><joint name="column" type="slide" axis="0 0.1 1"/><geom size="0.1"/>
   <body name="hand" pos="0.3 0.1 0"><joint name="wrist" axis="1 0 0.3"/><joint name="roll" axis="0 0 1"/>
    <geom size="0.1"/><site name="tool" pos="0.1 0.05 0" quat="0.7 0.2 0.7 0.1"/></body></body></body>
 <body name="branch" pos="0 0.2 0"><joint name="swing" axis="0 0 1"/><geom size="0.1"/>
  <site name="lamp" pos="0.2 0.3 0"/></body></body></worldbody></mujoco>"""
BALL = """<mujoco><worldbody><body name="b"><joint name="ball" type="ball"/><geom size="0.1"/>
<site name="tool" pos="0 0 1"/></body></worldbody></mujoco>"""


@kernel
def hessian_parts(tree, goals, work, out):
    """Whether it is known, and ``second_order`` at the work space's q."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    known = has_second_order(tree, goal)
    if known:
        second_order(tree, goal, work, out)
    return known


def parts(problem, q):
    """The cost at q, JᵀJ and what it lacks (nu, nu), and whether that is known."""
    tables, n = problem.tables, len(problem.dofs)
    problem.arrays["q"][:] = q
    cost, lacking = residual_and_jacobian(*tables), np.zeros((n, n))
    jacobian = problem.arrays["jacobian"].copy()
    known = hessian_parts(*tables, lacking)
    lower = np.tril(lacking)
    return cost, jacobian.T @ jacobian, lower + np.tril(lower, -1).T, known


def by_differences(problem, q, scale, h=1e-4):
    n = len(problem.dofs)
    step, hessian = np.zeros((n, len(q))), np.zeros((n, n))
    step[np.arange(n), problem.dofs] = h * scale  # hinges and slides: q has one number for each
    for i in range(n):
        for j in range(n):
            signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
            costs = [a * b * parts(problem, q + a * step[i] + b * step[j])[0] for a, b in signs]
            hessian[i, j] = sum(costs) / (4 * h * h)
    return hessian


GOALS = [
    [rik.PositionGoal("tool", (1, 2, 0.5), weight=1.7)],
    [rik.OrientationGoal("tool", (1, 2, 0.5, 0.3), weight=2.0)],
    [rik.PoseGoal("tool", (1, 2, 0.5), (0.5, 0.5, 0.1, 0.4), angle_weight=0.6)],
    [rik.PoseGoal("tool", (1, 2, 0.5)), rik.PoseGoal("lamp", (3, 0, 1), (1, 1, 0, 0))],
    [rik.PoseGoal("tool", (1, 2, 0.5), angle_weight=0.0)],
]  # fmt: skip


@pytest.mark.parametrize("goals", GOALS, ids=lambda goals: "+".join(goal.name.split()[0] for goal in goals))
@pytest.mark.parametrize("stiff", [False, True])
def test_it_is_what_gauss_newton_lacks(load_xml, goals, stiff):
    robot = load_xml(MIXED)
    problem = Problem(robot, goals)
    scale = problem.goal_arrays["joint_scale"]
    if stiff:
        scale[:] = np.linspace(0.5, 1.0, len(scale))
    rng = np.random.default_rng(1)
    for _ in range(3):
        q = rng.uniform(-1, 1, robot.nq)
        wanted = by_differences(problem, q, scale)
        _, first, second, known = parts(problem, q)
        assert known
        np.testing.assert_allclose(first + second, wanted, atol=2e-5 * max(1.0, np.abs(wanted).max()))


def test_balls_parts_of_goals_and_coupled_joints_go_without(load_xml):
    assert not parts(Problem(load_xml(BALL), rik.PositionGoal("tool", (0, 0, 2))), [1.0, 0, 0, 0])[3]
    robot = load_xml(MIXED)
    assert not parts(Problem(robot, rik.PositionGoal("tool", (0, 0, 2), axes="xy")), np.zeros(robot.nq))[3]
