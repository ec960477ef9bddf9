"""Strict priorities: a later goal never worsens an earlier goal, and uses the remaining freedom."""

import itertools

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.errors import UnsupportedGoalError
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
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
from robot_ik.solvers import SOLVERS

FINE = Tolerance(1e-6, 1e-6)


@pytest.fixture(scope="module")
def arm():
    return load_robot("srs_arm")


def remaining_slope(robot, q, frame, wanted):
    """Return the possible motion towards ``wanted`` within pose and limits: zero at the optimum."""
    jacobian = robot.jacobian(q, frame)
    way = wanted - q
    held = np.zeros(robot.nv, dtype=bool)
    for _ in range(robot.nv):
        free = ~held
        part = np.zeros(robot.nv)
        part[free] = way[free] - np.linalg.pinv(jacobian[:, free], rcond=1e-6) @ (
            jacobian[:, free] @ way[free]
        )
        outward = ((q <= robot.lower + 1e-9) & (part < 0)) | (
            (q >= robot.upper - 1e-9) & (part > 0)
        )
        if not (outward & ~held).any():
            break
        held |= outward
    return float(np.linalg.norm(part))


def test_the_pose_is_met_and_the_posture_uses_all_remaining_freedom(arm):
    rng = np.random.default_rng(0)
    for _ in range(12):
        pose = PoseGoal.at(None, arm.forward(arm.sample(rng)))
        result = solve(arm, [pose, PostureGoal(q=arm.home, priority=1)], solver="lm")
        assert result.errors[0].position < 1e-4 and result.errors[0].angle < 1e-3
        assert not arm.outside(result.q)
        assert remaining_slope(arm, result.q, None, arm.home) < 2e-3


def test_an_unreachable_first_priority_is_as_near_as_without_other_goals(arm):
    for k in range(4):
        far = PositionGoal(None, (2.5 * np.cos(k), 2.5 * np.sin(k), 0.5))
        alone = solve(arm, far, solver="lm")
        both = solve(arm, [far, PostureGoal(q=arm.home + 0.3, priority=1)], solver="lm")
        assert both.status is Status.UNREACHABLE
        assert both.errors[0].position == pytest.approx(alone.error.position, rel=2e-5)


@pytest.mark.parametrize("far", [0.35, 5.0])
def test_a_later_goal_does_not_worsen_an_earlier_goal(arm, far):
    elbow = "elbow"
    tool = arm.tool
    there = arm.forward(arm.home + 0.2, tool).position
    first = PositionGoal(tool, there, tolerance=FINE)
    gains = []
    for away in itertools.product((-far, far), repeat=2):
        second = PositionGoal(elbow, (*away, 0.4), priority=1)
        strict = solve(arm, [first, second], solver="lm")
        assert strict.errors[0].position <= 1e-6
        mixed = solve(
            arm, [first, PositionGoal(elbow, (*away, 0.4))], solver="lm", budget=Budget(restarts=0)
        )
        if far > 1.0:  # without priorities the distant goal dominates
            gains.append(strict.errors[1].position - mixed.errors[1].position)
            assert gains[-1] > -1e-4
        alone = solve(arm, second, solver="lm")
        assert strict.errors[1].position >= alone.error.position - 1e-4
    assert far < 1.0 or max(gains) > 1e-3


def test_the_priorities_count_and_the_order_of_the_list_does_not(arm):
    pose = arm.forward(arm.home + 0.25)
    goals = [
        PositionGoal(None, pose.position, priority=2, tolerance=FINE),
        PlaneGoal("elbow", (0, 0, 0.3), "z", priority=7),
        PositionGoal("elbow", (0.1, 0.9, 0.9), priority=40),
    ]
    results = [solve(arm, list(order), solver="lm") for order in itertools.permutations(goals)]
    for result in results:
        by_goal = dict(zip(result.goals, result.errors, strict=True))
        assert [by_goal[g].position for g in goals] == pytest.approx(
            [results[0].errors[k].position for k in range(3)], abs=1e-6
        )
    reversed_order = solve(
        arm, [PositionGoal("elbow", (0.1, 0.9, 0.9)), PositionGoal(None, pose.position, priority=1)]
    )
    assert reversed_order.errors[0].position < results[0].errors[2].position - 0.01


def test_a_figure_stands_balances_reaches_and_looks_in_that_order():
    figure = load_robot("humanoid")
    hand = figure.forward(figure.home, "right_hand").position
    for out, reached in ((0.3, True), (1.3, False)):
        ball = hand + np.array([out, 0.1, -0.2])
        goals = [
            PoseGoal.at("left_foot", figure.forward(figure.home, "left_foot")),
            PoseGoal.at("right_foot", figure.forward(figure.home, "right_foot")),
            CenterOfMassGoal(None, figure.center_of_mass(figure.home), axes="xy", priority=1),
            PositionGoal("right_hand", ball, priority=2),
            AimGoal("gaze", ball, axis="x", priority=3),
            PostureGoal(q=figure.home, priority=4),
        ]
        result = solve(figure, goals)
        errors = result.errors
        assert (
            max(m.position for m in errors[:3]) < 1e-4 and max(m.angle for m in errors[:2]) < 1e-3
        )
        assert (errors[3].position < 1e-4) is reached
        assert errors[4].angle < 1e-3 or not reached
        assert not figure.outside(result.q)


@pytest.mark.parametrize("seed", range(3))
def test_a_figure_at_full_stretch_keeps_its_feet(seed):
    """Where nearly all joints are at limits a level may not be restored. The step is undone."""
    figure = load_robot("humanoid")
    home = figure.home
    ball = (0.2, 0.2, 2.5)  # 0.3 m too high
    rng = np.random.default_rng(seed)
    goals = [
        PoseGoal.at("left_foot", figure.forward(home, "left_foot")),
        PoseGoal.at("right_foot", figure.forward(home, "right_foot")),
        CenterOfMassGoal(None, figure.center_of_mass(home), axes="xy", priority=1),
        PositionGoal("right_hand", ball, priority=2),
        AimGoal("gaze", ball, axis="x", priority=3),
        PostureGoal(q=home, joints={"root": 0.0}, priority=4),
    ]
    start = figure.integrate(
        home, np.concatenate([np.zeros(6), rng.uniform(-0.3, 0.3, figure.model.nv - 6)])
    )
    errors = solve(figure, goals, start=start, solver="lm").errors
    assert max(m.position for m in errors[:3]) < 1e-4 and max(m.angle for m in errors[:2]) < 1e-3
    assert errors[3].position == pytest.approx(0.283, abs=0.002)


def test_the_laws_hold_with_priorities(arm):
    rng = np.random.default_rng(4)
    q = arm.sample(rng)
    goals = [PoseGoal.at(None, arm.forward(q)), PostureGoal(q=q, priority=1)]
    at_goal = solve(arm, goals, start=q, solver="lm")
    assert at_goal.converged and at_goal.iterations == 0 and np.array_equal(at_goal.q, q)
    near = arm.clip(q + 0.1)
    once, twice = (solve(arm, goals, start=near, solver="lm", seed=5) for _ in range(2))
    assert once.q.tobytes() == twice.q.tobytes() and once.converged
    short = solve(arm, goals, solver="lm", budget=Budget(iterations=2))
    assert short.iterations == 2 and short.status is Status.ITERATION_LIMIT
    late = solve(arm, goals, solver="lm", budget=Budget(seconds=0.0))
    assert late.status is Status.TIME_LIMIT and late.iterations == 0
    traced = solve(arm, goals, solver="lm", trace=True)
    assert len(traced.trace) == traced.iterations > 0


def test_methods_without_priorities_refuse_them_with_their_name(arm):
    goals = [PositionGoal(None, (0.3, 0.3, 0.5)), PositionGoal("elbow", (0, 0, 1), priority=1)]
    able = {name for name in SOLVERS if "priorities" in SOLVERS[name].capabilities}
    assert {"auto", "lm"} <= able
    for name in sorted(set(SOLVERS) - able):
        with pytest.raises(UnsupportedGoalError, match=f"'{name}' does not support") as caught:
            solve(arm, goals, solver=name)
        assert "lm" in caught.value.able


def test_a_problem_with_priorities_does_not_depend_on_earlier_solves(arm):
    rng = np.random.default_rng(8)
    goals = [PoseGoal.at(None, arm.forward(arm.sample(rng))), PostureGoal(q=arm.home, priority=1)]
    problem = Problem(arm, goals, solver="lm")
    poses = [arm.forward(arm.sample(rng)) for _ in range(4)]
    first = [problem.solve(target=pose) for pose in poses]
    again = [problem.solve(target=pose) for pose in reversed(poses)]
    for one, two in zip(first, reversed(again), strict=True):
        assert one.q.tobytes() == two.q.tobytes()
        assert (one.status, one.iterations) == (two.status, two.iterations)


def test_the_trace_has_the_length_of_each_step(arm):
    goals = [PoseGoal.at(None, arm.forward(arm.home + 0.3)), PostureGoal(q=arm.home, priority=1)]
    traced = Problem(arm, goals, solver="lm", trace=True).solve()
    assert all(step.step > 0.0 for step in traced.trace)


def test_reachable_goals_are_met_beside_an_unreachable_goal(arm):
    """The goals of the first level that are proven out of reach are left out of its search."""
    rng = np.random.default_rng(3)
    elbow = PositionGoal("elbow", arm.forward(arm.sample(rng), "elbow").position, weight=5.0)
    goals = [PositionGoal(None, (3.0, 0.0, 0.5)), elbow, PostureGoal(q=arm.home, priority=1)]
    result = solve(arm, goals, solver="lm")
    assert result.status is Status.UNREACHABLE
    alone = solve(arm, goals[:2], solver="lm")
    assert result.errors[0].position == pytest.approx(alone.errors[0].position, abs=0.01)


@pytest.mark.parametrize("option", [{"clamp": 0.5}, {"gain": 0.5}, {"alternative": True}])
def test_options_of_a_single_level_are_refused_with_priorities(arm, option):
    goals = [PositionGoal(None, (0.3, 0.3, 0.5)), PostureGoal(q=arm.home, priority=1)]
    with pytest.raises(UnsupportedGoalError, match="clamp, gain or alternative"):
        Problem(arm, goals, solver="lm", **option)
