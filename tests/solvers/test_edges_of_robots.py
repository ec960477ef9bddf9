"""Unusual limits, sizes and joints, as docs/reference/goals.md defines, for every method."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.errors import (
    ModelError,
)
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    HalfSpaceGoal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
    Tolerance,
)
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import SOLVERS, make_solver
from tests.solvers.law_cases import supported_problem

SHORT = Budget(iterations=300)
FEW = settings(max_examples=50)
names = pytest.mark.parametrize("name", list(SOLVERS))


@pytest.fixture(scope="module")
def puma():
    return load_robot("puma560")


@pytest.fixture(scope="module")
def make_robot(tmp_path_factory):
    """``make_robot(xml)``: a robot of MJCF text."""
    folder = tmp_path_factory.mktemp("edges")

    def make(body, joints=None, tool=None):
        path = folder / "model.xml"
        path.write_text(f'<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody></mujoco>')
        return load_robot(path, joints=joints, tool=tool)

    return make


def chain(scale=1.0, ranges=("-2 2",) * 3):
    """Three hinges. The masses are stated, because MuJoCo needs them even for a tiny arm."""
    bodies = ""
    inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    for offset, axis, limits in zip(
        (0, 0.5, 0.4), ("0 0 1", "0 1 0", "0 1 0"), ranges, strict=True
    ):
        bodies += (
            f'<body pos="{offset * scale} 0 0"><joint axis="{axis}" range="{limits}"/>{inertia}'
        )
    return f'{bodies}<site name="tip" pos="{0.3 * scale} 0 0"/>' + "</body>" * 3


def one_joint(kind='type="hinge" axis="0 0 1" range="-1 1"'):
    return (
        f'<body name="a"><joint name="j" {kind}/><geom size="0.02"/>'
        '<site name="tip" pos="0.5 0 0"/></body>'
        '<site name="nail" pos="0.3 0.3 0"/>'
    )


def assert_status_is_true(robot, solution, tolerance):
    """Assert that q is finite and inside the limits, and that the status agrees with MuJoCo."""
    assert np.isfinite(solution.q).all() and not robot.outside(solution.q)
    within = (
        solution.error.position <= tolerance.position and solution.error.angle <= tolerance.angle
    )
    assert solution.converged == within, (solution, solution.error)


# Limits


@pytest.mark.parametrize(
    "joint",
    [
        'type="hinge" axis="0 0 1" range="1 -1"',  # MuJoCo reads this as no limit
        'type="hinge" axis="0 0 1" range="1 -1" limited="true"',
        'type="hinge" axis="0 0 1" range="0.5 0.5"',
        'type="slide" axis="0 0 1" range="2 1"',
        'type="ball" range="0 -1" limited="true"',
    ],
)
def test_a_range_whose_lower_end_is_above_its_upper_is_refused(make_robot, joint):
    with pytest.raises(ModelError, match="range") as caught:
        make_robot(one_joint(joint))
    assert "'j'" in str(caught.value) and "model.xml" in str(caught.value)


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        ([1], [-1], "lower <= upper"),
        ([2], [3], "no range is left for joint 'j'"),
        (1, -1, "lower <= upper"),
        ([np.inf], [np.inf], "no range is left"),
        ([np.nan], [1], "must be numbers"),
        ([-1, 0], [1, 1], "1 numbers each"),
        ([], [], "1 numbers each"),
        ("low", "high", "1 numbers each"),
    ],
)
def test_limits_that_are_empty_or_malformed_are_refused(make_robot, lower, upper, message):
    with pytest.raises(ModelError, match=message):
        make_robot(one_joint()).with_limits(lower, upper)


@names
def test_equal_limits_hold_a_joint(make_robot, name):
    robot = make_robot(chain(), tool="tip")
    held = robot.with_limits([-2, 0.3, -2], [2, 0.3, 2])
    goal = PositionGoal(None, held.forward([0.4, 0.3, 0.6]).position)
    if supported_problem(held, goal, solver=name) is None:
        return
    solution = solve(held, goal, solver=name)
    assert solution.q[1] == 0.3
    assert_status_is_true(held, solution, Tolerance())
    assert solution.converged or name == "recursive"


@FEW
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_a_start_outside_the_limits_is_clipped(puma, data, seed):
    name = data.draw(st.sampled_from(["auto", "lm", "dls", "sdls", "ccd", "fabrik"]))
    rng = np.random.default_rng(seed)
    outside = rng.normal(size=6) * 10 ** rng.uniform(0, 200)
    goal = PoseGoal.at(None, puma.forward(puma.sample(rng)))
    far, near = (
        solve(puma, goal, start=q, solver=name, seed=3) for q in (outside, puma.clip(outside))
    )
    assert far.status is near.status and np.array_equal(far.q, near.q)
    assert not puma.outside(
        solve(puma, goal, start=outside, budget=Budget(iterations=0), solver="lm").q
    )


# Sizes


@names
def test_very_distant_targets_are_unreachable_and_finite(puma, name):
    solver = make_solver(name)
    for far in (1e9, 1e99):
        for goal in (
            PositionGoal(None, (far, far / 3, -far)),
            PoseGoal(None, (0, 0, far)),
            LineGoal(None, (0, 0, far), "x"),
            PlaneGoal(None, (0, 0, far), "z"),
            HalfSpaceGoal(None, (0, 0, far), "z"),
            CenterOfMassGoal(None, (0, far, 0)),
            PostureGoal(q=np.full(6, far)),
        ):
            problem = supported_problem(puma, goal, budget=SHORT, solver=solver)
            if problem is None:
                continue
            solution = problem.solve()
            assert_status_is_true(puma, solution, Tolerance())
            assert not solution.converged
            if not isinstance(goal, CenterOfMassGoal | PostureGoal):
                assert solution.status is Status.UNREACHABLE
    problem = supported_problem(puma, AimGoal(None, (1e9, 1e9, 1e9)), solver=solver)
    if problem is not None:
        assert_status_is_true(puma, problem.solve(), Tolerance())


@names
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_size_of_a_robot_does_not_change_the_result(make_robot, name, scale):
    solver = make_solver(name)
    results = []
    for size in (1.0, scale):
        robot = make_robot(chain(size), tool="tip")
        tolerance = Tolerance(1e-6 * size, 1e-6)
        here = robot.forward([0.3, 0.5, 0.4])
        for goal in (
            PositionGoal(None, here.position),
            PoseGoal.at(None, here),
            AimGoal(None, here.position + size * here.rotation[:, 2]),
        ):
            problem = supported_problem(
                robot, goal, tolerance=tolerance, budget=Budget(iterations=3000), solver=solver
            )
            if problem is not None:
                solution = problem.solve([0, 0.1, 0.1])
                assert_status_is_true(robot, solution, tolerance)
                results.append((solution.status, solution.q))
    half = len(results) // 2
    assert (half >= 1) == (name != "analytic")  # it has no closed form for this chain
    for (status, q), (other, there) in zip(results[:half], results[half:], strict=True):
        assert status is other
        np.testing.assert_allclose(q, there, atol=1e-5)


@names
@pytest.mark.parametrize("fine", [1e-12, 1e-15, 1e-300])
def test_a_tolerance_below_rounding_ends_with_its_status(puma, name, fine):
    tolerance = Tolerance(fine, fine)
    solver = make_solver(name)
    there = puma.forward(puma.home + 0.2)
    for goal in (PositionGoal(None, there.position), PoseGoal.at(None, there)):
        problem = supported_problem(puma, goal, tolerance=tolerance, budget=SHORT, solver=solver)
        if problem is None:
            continue
        solution = problem.solve()
        assert np.isfinite(solution.q).all() and not puma.outside(solution.q)
        if solution.converged:  # by the compiled forward pass; MuJoCo's differs by some rounding
            assert max(solution.error.position, solution.error.angle) <= fine + 4e-15
        elif name != "recursive":
            assert max(solution.error.position, solution.error.angle) < 1e-7


# Few joints, still frames


@names
def test_a_robot_with_one_joint_is_solved(make_robot, name):
    robot = make_robot(one_joint(), tool="tip")
    solver = make_solver(name)
    goals = {
        0.7: PositionGoal(None, (0.5 * np.cos(0.7), 0.5 * np.sin(0.7), 0)),
        0.3: PoseGoal.at(None, robot.forward([0.3])),
        0.2: AimGoal(None, robot.forward([0.2]).apply([9, 0, 0]), axis="x"),
        -0.4: PostureGoal(q=[-0.4]),
    }
    able = {
        q: goal
        for q, goal in goals.items()
        if supported_problem(robot, goal, solver=solver) is not None
    }
    for q, goal in able.items():
        solution = Problem(robot, goal, solver=solver).solve()
        assert solution.converged and solution.q == pytest.approx([q], abs=2e-3)
    assert bool(able) == (name != "analytic")  # it has no closed form for one joint
    for goal in (
        PositionGoal(None, (0, 0.5, 0)),
        PositionGoal(None, (0, 0, 0)),
        PositionGoal(None, (-0.5, 0, 0)),
    ):
        if supported_problem(robot, goal, solver=solver) is not None:
            assert_status_is_true(robot, Problem(robot, goal, solver=solver).solve(), Tolerance())


@names
@pytest.mark.parametrize("frame", ["base", "link2"])  # fixed to the world; behind no active joint
def test_a_goal_for_a_fixed_frame_is_met_at_once_or_never(name, frame):
    robot = load_robot("puma560", joints=["joint4", "joint5"])
    solver = make_solver(name)
    here = robot.forward(robot.home, frame)
    for moved, met in ((0.0, True), (0.2, False)):
        world = np.array([moved, 0, 0])
        for goal in (
            PositionGoal(frame, here.position + world),
            OrientationGoal(frame, (here @ rik.Pose((0, 0, 0), (1, 0, 0, moved))).wxyz),
            PlaneGoal(frame, here.position + world, "x"),
            AimGoal(frame, here.apply([moved, 0, 1])),
            LineGoal(frame, here.position + world, "z"),
        ):
            problem = supported_problem(robot, goal, solver=solver)
            if problem is None:
                continue
            solution = problem.solve()
            assert solution.converged is met
            assert np.array_equal(solution.q, robot.home)
            if met:
                assert solution.iterations == 0


@names
def test_frozen_joints_stay_and_the_active_joints_reach_the_goal(puma, name):
    robot = load_robot("puma560", joints=["joint1", "joint2", "joint3"])
    q = robot.home + np.array([0.4, 0.2, -0.3])
    goal = PositionGoal(None, robot.forward(q).position)
    solution = (
        solve(robot, goal, solver=name)
        if supported_problem(robot, goal, solver=name) is not None
        else None
    )
    if solution is not None and name != "recursive":
        assert solution.converged and solution.q.shape == (3,)
        whole = robot.qpos(solution.q)
        assert np.array_equal(whole[3:], puma.home[3:])
        assert puma.measure(whole).position == pytest.approx(goal.target.position, abs=1e-4)
