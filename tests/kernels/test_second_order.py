"""The exact Hessian against finite differences of the cost, and the goals without it."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.residuals import GOALS
from robot_ik.kernels.search import SEARCH
from robot_ik.kernels.tree import TREE
from robot_ik.problem import Problem
from robot_ik.solvers.levenberg_marquardt import curvature_of_goals, has_curvature
from tests.residual_rows import rows_at

# Slides before and after hinges, and a branch that carries only the second goal.
MIXED = """<mujoco><compiler angle="radian"/><worldbody>
<body name="base"><joint name="rail" type="slide" axis="1 0.2 0"/><geom size="0.1"/>
 <body name="arm" pos="0 0 0.3"><joint name="shoulder" axis="0 1 0.1"/><geom size="0.1"/>
  <body name="column" pos="0.4 0 0"><joint name="column" type="slide" axis="0 0.1 1"/>
  <geom size="0.1"/>
   <body name="hand" pos="0.3 0.1 0"><joint name="wrist" axis="1 0 0.3"/>
   <joint name="roll" axis="0 0 1"/>
    <geom size="0.1"/><site name="tool" pos="0.1 0.05 0" quat="0.7 0.2 0.7 0.1"/></body></body>
    </body>
 <body name="branch" pos="0 0.2 0"><joint name="swing" axis="0 0 1"/><geom size="0.1"/>
  <site name="lamp" pos="0.2 0.3 0"/></body></body></worldbody></mujoco>"""
BALL = """<mujoco><worldbody><body name="b"><joint name="ball" type="ball"/><geom size="0.1"/>
<site name="tool" pos="0 0 1"/></body></worldbody></mujoco>"""


RUN = Layout("Curvature", tree=TREE, goals=GOALS, search=SEARCH)
open_run = RUN.open


@kernel
def write_curvature(address, jacobian, out):
    """Write ``curvature_of_goals`` at the last measured point; return whether it is known."""
    run = open_run(address)
    known = has_curvature(run.tree, run.goals)
    if known:
        curvature_of_goals(run.tree, run.goals, run.search, jacobian, out)
    return known


def parts(problem, q):
    """Return the cost at q, JᵀJ, the rest of the Hessian (u, u), and whether the rest is known."""
    rows = rows_at(problem, q)
    blocks = {
        "tree": problem.robot.tree.block,
        "goals": problem.compiled.block,
        "search": problem.search,
    }
    run = RUN.allocate(given=blocks)
    lacking = np.zeros((len(rows.dofs), len(rows.dofs)))
    known = write_curvature(run.address, rows.jacobian, lacking)
    lower = np.tril(lacking)
    return rows.cost, rows.jacobian.T @ rows.jacobian, lower + np.tril(lower, -1).T, known


def by_differences(problem, q, scale, h=1e-4):
    dofs = problem.compiled.block.arrays["dofs"]
    n = len(dofs)
    step = np.zeros((n, len(q)))
    hessian = np.zeros((n, n))
    step[np.arange(n), dofs] = h * scale  # hinges and slides: q has one number for each
    for i in range(n):
        for j in range(n):
            signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
            costs = [a * b * parts(problem, q + a * step[i] + b * step[j])[0] for a, b in signs]
            hessian[i, j] = sum(costs) / (4 * h * h)
    return hessian


CASES = [
    [rik.PositionGoal("tool", (1, 2, 0.5), weight=1.7)],
    [rik.OrientationGoal("tool", (1, 2, 0.5, 0.3), weight=2.0)],
    [rik.PoseGoal("tool", (1, 2, 0.5), (0.5, 0.5, 0.1, 0.4), angle_weight=0.6)],
    [rik.PoseGoal("tool", (1, 2, 0.5)), rik.PoseGoal("lamp", (3, 0, 1), (1, 1, 0, 0))],
    [rik.PoseGoal("tool", (1, 2, 0.5), angle_weight=0.0)],
]


@pytest.mark.parametrize(
    "goals", CASES, ids=lambda goals: "+".join(goal.name.split()[0] for goal in goals)
)
@pytest.mark.parametrize("stiff", [False, True])
def test_it_is_the_part_of_the_hessian_without_gauss_newton(load_xml, goals, stiff):
    robot = load_xml(MIXED)
    problem = Problem(robot, goals)
    scale = problem.compiled.block.arrays["joint_scale"]
    if stiff:
        scale[:] = np.linspace(0.5, 1.0, len(scale))
    rng = np.random.default_rng(1)
    for _ in range(3):
        q = rng.uniform(-1, 1, robot.nq)
        wanted = by_differences(problem, q, scale)
        _, first, second, known = parts(problem, q)
        assert known
        np.testing.assert_allclose(
            first + second, wanted, atol=2e-5 * max(1.0, np.abs(wanted).max())
        )


def test_balls_partial_goals_and_coupled_joints_have_no_curvature(load_xml):
    assert not parts(Problem(load_xml(BALL), rik.PositionGoal("tool", (0, 0, 2))), [1.0, 0, 0, 0])[
        3
    ]
    robot = load_xml(MIXED)
    assert not parts(
        Problem(robot, rik.PositionGoal("tool", (0, 0, 2), axes="xy")), np.zeros(robot.nq)
    )[3]
