"""The variable metric against SciPy's minimisers, finite differences and MuJoCo; exact limits."""

import itertools

import mujoco
import numpy as np
import pytest
from scipy.optimize import minimize

from robot_ik.budget import Budget
from robot_ik.compiled_goals import length_scale
from robot_ik.errors import UnsupportedGoalError
from robot_ik.goals import (
    GOALS,
    AimGoal,
    CenterOfMassGoal,
    HalfSpaceGoal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PosePriorGoal,
    PositionGoal,
    PostureGoal,
    Tolerance,
)
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers.minimization import Minimization
from tests.residual_rows import columns_of

ONE_TRY = Budget(restarts=0)
FINE = Tolerance(1e-6, 1e-6)


def half_square(problem, q):
    """G(q) = ½ |r|² of positions and poses, from MuJoCo's forward pass alone."""
    total = 0.0
    for goal in problem.goals:
        metres, radians = problem.robot.measure(q, goal.frame).distance(goal.target)
        total += (goal.weights[0] * metres / length_scale(problem.robot, goal)) ** 2
        total += (goal.weights[1] * radians) ** 2
    return 0.5 * total


def slope_by_differences(problem, q, step=1e-5):
    robot = problem.robot
    slope = []
    for v in columns_of(problem):
        way = np.zeros(robot.nv)
        way[v] = step
        forward = robot.integrate(q, way)
        backward = robot.integrate(q, -way)
        slope.append((half_square(problem, forward) - half_square(problem, backward)) / (2 * step))
    return np.array(slope)


@pytest.mark.parametrize(("robot_name", "kind"), [("puma560", "pose"), ("planar", "position")])
def test_the_first_step_descends_along_the_gradient_by_differences(
    robot_name, kind, near_problems, one_step
):
    for problem, q in near_problems(robot_name, kind):
        slope = slope_by_differences(problem, q)
        step = one_step(Minimization(curvature=0.999), problem, q)
        cosine = -slope @ step / np.linalg.norm(slope) / np.linalg.norm(step)
        assert cosine == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize(
    ("robot_name", "position"), [("puma560", (0.85, 0.6, 0.9)), ("planar", (0.6, 0.4, 0.05))]
)
def test_the_cost_never_rises_within_a_try(robot_name, position, robots, reachable):
    robot = robots(robot_name)
    goal = PoseGoal(None, position, (0.5, 0.5, -0.5, 0.5))
    for start in reachable(robot, 5):
        problem = Problem(robot, goal, trace=True, budget=Budget(restarts=6), solver=Minimization())
        solution = problem.solve(start)
        assert not solution.converged and solution.restarts == 6
        for restart, rows in itertools.groupby(solution.trace, key=lambda row: row.restart):
            if restart == 6:  # after the last restart comes the polish of the best point
                break
            costs = [row.cost for row in rows]
            assert all(after <= before * (1 + 1e-13) for before, after in itertools.pairwise(costs))
        first = [row.cost for row in solution.trace if row.restart == 0]
        assert first[0] < half_square(problem, start)


# Against SciPy


def scipy_minimum(problem, linear_model, start):
    """Return the cost at which L-BFGS-B ends in the same box, with gradient and cost by MuJoCo."""
    robot = problem.robot

    def cost_and_slope(x):
        q = robot.home.copy()
        q[:] = start
        q[columns_of(problem)] = x
        jacobian, e = linear_model(problem, q)
        return 0.5 * e @ e, -jacobian.T @ e

    box = list(zip(robot.lower[columns_of(problem)], robot.upper[columns_of(problem)], strict=True))
    options = {"ftol": 1e-15, "gtol": 1e-9, "maxiter": 5000, "maxls": 50}
    x = np.asarray(start)[columns_of(problem)]
    return minimize(cost_and_slope, x, jac=True, bounds=box, method="L-BFGS-B", options=options).fun


@pytest.mark.parametrize("robot_name", ["puma560", "planar"])
@pytest.mark.parametrize("what", ["out of reach", "goals that disagree"])
def test_it_ends_at_the_minimum_of_scipy(robot_name, what, robots, reachable, linear_model):
    robot = robots(robot_name)
    same = 0
    count = 5
    for start, there in zip(reachable(robot, count, 31), reachable(robot, count, 32), strict=True):
        pose = robot.forward(there)
        if what == "out of reach":
            goals = [PoseGoal(None, 1.6 * pose.position + [0, 0, 0.1], pose.wxyz)]
        else:
            frames = ("link3", "link5") if robot_name == "puma560" else ("lower", "hand")
            goals = [
                PositionGoal(f, robot.forward(there, f).position + 0.2 * i)
                for i, f in enumerate(frames)
            ]
            goals.append(OrientationGoal(None, pose.wxyz, weight=0.5))
        near = robot.clip(there + 0.3 * (start - there))
        problem = Problem(robot, goals, budget=ONE_TRY, tolerance=FINE, solver=Minimization())
        q = problem.solve(near).q
        cost = half_square(problem, q)
        assert scipy_minimum(problem, linear_model, q) >= cost - 1e-8 * (
            1 + cost
        )  # no lower cost is possible
        same += abs(scipy_minimum(problem, linear_model, near) - cost) <= 1e-6 * cost
    assert same >= 0.8 * count  # two methods may find different local minima


# Limits and laws of joints

COUPLED = """<mujoco><compiler angle="radian"/><worldbody>
<body name="a"><joint name="j1" axis="0 0 1" range="-2 2"/><geom size="0.05"/>
 <body name="b" pos="0.4 0 0"><joint name="j2" axis="0 1 0" ref="0.2" range="-1.5 1.5"/>
 <geom size="0.05"/>
  <body name="c" pos="0.4 0 0"><joint name="j3" axis="0 1 0" range="-0.9 1.2"/><geom size="0.05"/>
   <site name="tip" pos="0.3 0 0.1"/></body></body></body>
</worldbody><equality><joint joint1="j3" joint2="j2" polycoef="0.1 -0.6 0 0 0"/></equality>
</mujoco>"""


def test_linear_equalities_hold_at_every_step(tmp_path):
    (tmp_path / "arm.xml").write_text(COUPLED)
    robot = load_robot(tmp_path / "arm.xml", tool="tip")
    data = mujoco.MjData(robot.model)
    rng = np.random.default_rng(1)
    for _ in range(3):
        start = robot.sample(rng)
        there = robot.sample(rng)
        problem = Problem(
            robot,
            PositionGoal(None, 1.3 * robot.forward(there).position),
            tolerance=FINE,
            solver=Minimization(),
        )
        for steps in range(1, 15):
            problem.budget = Budget(iterations=steps, restarts=0)
            q = problem.solve(start).q
            data.qpos[:] = robot.qpos(q)
            mujoco.mj_forward(robot.model, data)
            assert np.abs(data.efc_pos[: data.ne]).max() < 1e-12 and not robot.outside(q)


def test_limits_hold_at_every_step(robots, reachable):
    robot = robots("puma560")
    for start, there in zip(reachable(robot, 9, 50), reachable(robot, 9, 51), strict=True):
        goal = PoseGoal.at(None, robot.forward(there))
        problem = Problem(robot, goal, tolerance=FINE, solver=Minimization())
        for steps in range(1, 20):
            problem.budget = Budget(iterations=steps, restarts=0)
            q = problem.solve(start).q
            np.testing.assert_allclose(robot.clip(q), q, atol=1e-14)


def test_a_limited_ball_joint_is_refused(robots):
    with pytest.raises(UnsupportedGoalError, match="limited ball joint 'shoulder'") as caught:
        solve(robots("tree"), PositionGoal(None, (0.3, 0.0, 0.5)), solver="bfgs")
    assert "lm" in caught.value.able


# Every goal


def every_kind(robot, q, frame, other):
    """A goal of every kind, met at q."""
    pose = robot.forward(q, frame)
    there = robot.forward(q, other).position
    position = pose.position
    aimed_at = position + 0.7 * pose.rotation[:, 2]
    return [
        PositionGoal(frame, position),
        PositionGoal(frame, position, axes="xz"),
        OrientationGoal(frame, pose.wxyz),
        OrientationGoal(frame, pose.wxyz, free_axis="y"),
        PoseGoal.at(frame, pose),
        PoseGoal(frame, position, pose.wxyz, free_axis="x"),
        AimGoal(frame, aimed_at, axis="z"),
        LineGoal(frame, position, (1, 2, 3)),
        PlaneGoal(frame, position, (3, 2, 1)),
        HalfSpaceGoal(frame, position, (0, 0, -1)),
        CenterOfMassGoal(None, robot.center_of_mass(q)),
        PostureGoal(q=q),
        [PositionGoal(frame, position), PlaneGoal(other, there, (1, 1, 0))],
    ]


@pytest.mark.parametrize(
    ("name", "frame", "other"),
    [("srs_arm", None, "elbow"), ("humanoid", "left_hand", "right_hand")],
)
def test_goals_of_every_kind_are_met(name, frame, other):
    robot = load_robot(name)
    rng = np.random.default_rng(6)
    for _ in range(2):
        q = robot.sample(rng)
        goals = every_kind(robot, q, frame, other)
        assert {type(goal) for goal in goals if not isinstance(goal, list)} == set(GOALS) - {
            PosePriorGoal
        }
        for goal in goals:
            result = solve(robot, goal, solver="bfgs", tolerance=FINE)
            assert result.converged and not robot.outside(result.q), goal


def test_the_figure_stands_reaches_and_looks_at_once():
    robot = load_robot("humanoid")
    rng = np.random.default_rng(8)
    for _ in range(3):
        q = robot.clip(robot.integrate(robot.home, rng.uniform(-0.4, 0.4, robot.nv)))
        goals = [
            PoseGoal.at(f, robot.forward(q, f)) for f in ("left_foot", "right_foot", "left_hand")
        ]
        goals += [PositionGoal("right_hand", robot.forward(q, "right_hand").position)]
        goals += [CenterOfMassGoal(None, robot.center_of_mass(q), axes="xy")]
        result = solve(robot, goals, solver="bfgs", tolerance=FINE)
        assert result.converged and not robot.outside(result.q)


@pytest.mark.parametrize("kind", ["position", "pose"])
def test_cold_poses_are_met_to_a_micrometre(kind, robots, reachable):
    robot = robots("puma560")
    poses = [robot.forward(q) for q in reachable(robot, 200, 60)]
    goal = PoseGoal.at(None, poses[0]) if kind == "pose" else PositionGoal(None, poses[0].position)
    problem = Problem(robot, goal, tolerance=FINE, solver="bfgs")
    for pose in poses:
        problem.retarget(pose if kind == "pose" else pose.position)
        assert problem.solve().converged


def test_priorities_are_refused_with_the_name_of_the_method(robots):
    goals = [PositionGoal(None, (0.3, 0.3, 0)), PositionGoal("hand", (0.1, 0.1, 0), priority=1)]
    with pytest.raises(
        UnsupportedGoalError, match="'bfgs' does not support goals of different priorities"
    ) as caught:
        solve(robots("planar"), goals, solver="bfgs")
    assert "lm" in caught.value.able


def test_a_minimum_at_the_limits_has_its_own_status(robots):
    far = solve(robots("planar"), PositionGoal(None, (4.0, 0, 0)), solver="bfgs")
    assert far.status is Status.UNREACHABLE and far.error.position == pytest.approx(4.0 - 1.1)
    # The goal is beyond the joint limits, so the solution is at the limits.
    shut = robots("planar").with_limits(np.array([-0.1, 0.1, 0.1]), np.array([0.1, 0.2, 0.2]))
    blocked = solve(shut, PositionGoal(None, (0, -0.9, 0)), solver="bfgs")
    assert blocked.status is Status.BLOCKED_BY_LIMITS
