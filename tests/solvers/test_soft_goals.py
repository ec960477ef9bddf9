"""Soft goals use the freedom that needed goals leave, and do not decide convergence."""

import dataclasses
import pickle

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.errors import InvalidGoalError, UnsupportedGoalError
from robot_ik.goals import AimGoal, CenterOfMassGoal, PoseGoal, PositionGoal, PostureGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import SOLVERS

FRAMES = 600
FORMS = {
    "fourth priority": ((0, 0, 1, 2), {"priority": 3}),
    "beside the hand": ((0, 1, 2, 2), {"priority": 2}),
    "weighted beside all": ((0, 0, 0, 0), {"weight": 0.05}),
}


@pytest.fixture(scope="module")
def arm():
    return load_robot("srs_arm")


@pytest.fixture(scope="module")
def figure():
    return load_robot("humanoid")


def whole_body(figure, ball, priorities, posture):
    """Goals for feet, balance, the hand at the ball, the gaze at the ball, and a rest posture."""
    home = figure.home
    left, right = (
        PoseGoal.at(foot, figure.forward(home, foot)) for foot in ("left_foot", "right_foot")
    )
    feet, balance, hand, gaze = priorities
    return [
        dataclasses.replace(left, priority=feet),
        dataclasses.replace(right, priority=feet),
        CenterOfMassGoal(None, figure.center_of_mass(home), axes="xy", priority=balance),
        PositionGoal("right_hand", ball, priority=hand),
        AimGoal("gaze", ball, axis="x", priority=gaze),
        PostureGoal(q=home, joints={"root": 0.0}, **posture),
    ]


def ball_path(figure):
    hand = figure.forward(figure.home, "right_hand").position
    phase = np.linspace(0, 2 * np.pi, FRAMES)
    return hand + np.stack(
        [0.2 + 0.15 * np.sin(phase), 0.05 + 0.1 * np.cos(2 * phase), -0.1 + 0.15 * np.cos(phase)],
        axis=1,
    )


def posture_cost(figure, q):
    """Return half the sum of squares of the joints' distances from home, without the root."""
    return 0.5 * float(np.sum(figure.difference(q, figure.home)[6:] ** 2))


def long_minimisation(figure, path):
    """Return the optimal joint angles of a weighted sum; other goals are met to micrometres."""
    goals = whole_body(figure, path[0], (0, 0, 0, 0), {"weight": 1e-3})
    budget = Budget(iterations=400, restarts=0)
    tolerance = Tolerance(1e-12, 1e-12)
    problem = Problem(figure, goals, solver="lm", tolerance=tolerance, budget=budget)
    q = figure.home
    for ball in path:
        q = problem.solve(q, target={3: ball, 4: ball}).q
        yield q


@pytest.fixture(scope="module")
def least_posture_costs(figure):
    """Results of the long minimisation of each frame, the same for every form."""
    return list(long_minimisation(figure, ball_path(figure)))


@pytest.mark.parametrize("form", FORMS)
def test_a_figure_tracks_with_a_soft_posture_and_meets_all_other_goals(
    figure, least_posture_costs, form
):
    """In each frame hand, feet, balance and gaze are met, and the posture is near its optimum."""
    priorities, posture = FORMS[form]
    path = ball_path(figure)
    problem = Problem(figure, whole_body(figure, path[0], priorities, posture | {"soft": True}))
    q = figure.home
    near = []
    for ball, best in zip(path, least_posture_costs, strict=True):
        result = problem.solve(q, target={3: ball, 4: ball})
        q = result.q
        assert result.status is Status.CONVERGED
        error = result.error
        assert error.position <= 1e-4 and error.angle <= 1e-3
        assert not figure.outside(q)
        near.append(posture_cost(figure, q) <= 1.05 * posture_cost(figure, best) + 1e-6)
    assert np.mean(near) >= 0.95


def test_a_needed_posture_in_the_same_place_is_never_met(figure):
    """The purpose of soft goals: as a hard goal it would prevent convergence."""
    ball = ball_path(figure)[0]
    needed = solve(figure, whole_body(figure, ball, (0, 0, 1, 2), {"priority": 3}))
    soft = solve(figure, whole_body(figure, ball, (0, 0, 1, 2), {"priority": 3, "soft": True}))
    assert not needed.converged
    assert soft.require() is soft
    assert posture_cost(figure, soft.q) <= 1.05 * posture_cost(figure, needed.q)


def test_a_soft_goal_does_not_decide_convergence_and_has_an_error(arm):
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = PoseGoal.at(None, arm.forward(arm.sample(rng)))
        away = PostureGoal(q=arm.home + 0.4, soft=True)
        result = solve(arm, [away, pose])
        assert result.converged and result.restarts <= solve(arm, pose, solver="lm").restarts + 5
        assert result.error == result.errors[1] and result.errors[0].angle > 0.0


def test_a_soft_goal_uses_the_remaining_freedom(arm):
    """The result is as near as that of a strict priority."""
    rng = np.random.default_rng(1)
    for _ in range(12):
        pose = PoseGoal.at(None, arm.forward(arm.sample(rng)))
        away = arm.home + 0.2
        start = solve(arm, pose, solver="lm").q
        soft = solve(arm, [pose, PostureGoal(q=away, soft=True)], start=start)
        strict = solve(arm, [pose, PostureGoal(q=away, priority=1)], start=start)
        assert np.sum((soft.q - away) ** 2) <= 1.02 * np.sum((strict.q - away) ** 2) + 1e-9


def test_soft_goals_alone_are_minimised_and_converge(arm):
    wanted = arm.clip(arm.home + 0.3)
    result = solve(arm, PostureGoal(q=wanted, soft=True))
    assert result.converged and np.abs(result.q - wanted).max() < 1e-3
    assert (result.error.position, result.error.angle) == (0.0, 0.0)
    far = solve(arm, PositionGoal(None, (9.0, 0, 0), soft=True))
    assert far.converged and far.restarts == 0
    assert np.linalg.norm(arm.forward(far.q).position - (9.0, 0, 0)) < np.linalg.norm(
        arm.forward(arm.home).position - (9.0, 0, 0)
    )


def test_several_soft_goals_have_priorities_among_themselves(arm):
    position = arm.forward(arm.home + 0.2).position
    elbow = PositionGoal("elbow", arm.forward(arm.home + 0.25, "elbow").position, soft=True)
    rest = PostureGoal(q=arm.home, soft=True, priority=1)
    result = solve(arm, [rest, elbow, PositionGoal(None, position)])
    without = solve(arm, [elbow, PositionGoal(None, position)])
    assert result.converged and result.errors[2].position < 1e-4
    assert result.errors[1].position <= without.errors[0].position + 2e-3


def test_an_unreachable_goal_is_reported_beside_a_soft_goal(arm):
    far = [PositionGoal(None, (9.0, 0, 0)), PostureGoal(q=arm.home, soft=True)]
    assert solve(arm, far).status is Status.UNREACHABLE


def test_tracking_a_soft_posture_comes_to_rest(figure):
    ball = ball_path(figure)[0]
    for priorities, posture in FORMS.values():
        goals = whole_body(figure, ball, priorities, posture | {"soft": True})
        problem = Problem(figure, goals, solver="lm")
        q = figure.home
        steps = []
        for _ in range(20):
            result = problem.solve(q)
            steps.append(float(np.abs(result.q - q).max()))
            q = result.q
        assert max(steps[-5:]) <= 1e-3 and result.iterations == 0


def test_the_trace_counts_needed_goals_only(arm):
    pose = PoseGoal.at(None, arm.forward(arm.home + 0.3))
    result = solve(arm, [pose, PostureGoal(q=arm.home + 1.0, soft=True)], trace=True)
    assert len(result.trace) == result.iterations > 0
    assert result.trace[-1].position <= 1e-4 and result.trace[-1].angle <= 1e-3
    assert result.trace[-1].cost > 0.01  # the weighted sum is of all


def test_the_laws_hold_with_soft_goals(arm):
    pose = PoseGoal.at(None, arm.forward(arm.home + 0.25))
    goals = [pose, PostureGoal(q=arm.home, soft=True)]
    once, twice = (solve(arm, goals, seed=3) for _ in range(2))
    assert once.q.tobytes() == twice.q.tobytes()
    assert solve(arm, goals, start=once.q).iterations <= 1
    at_rest = solve(
        arm, [PoseGoal.at(None, arm.forward(arm.home)), PostureGoal(q=arm.home, soft=True)]
    )
    assert at_rest.iterations == 0 and np.array_equal(at_rest.q, arm.home)
    short = solve(arm, goals, start=arm.home - 0.5, budget=Budget(iterations=1))
    assert short.iterations <= 1
    assert pickle.loads(pickle.dumps(goals[1])).soft


def test_methods_without_levels_refuse_soft_goals_with_their_name(arm):
    goals = [PositionGoal(None, (0.3, 0.3, 0.5)), PostureGoal(q=arm.home, soft=True)]
    able = {name for name in SOLVERS if "soft" in SOLVERS[name].capabilities}
    assert {"auto", "lm"} <= able
    for name in sorted(set(SOLVERS) - able):
        with pytest.raises(UnsupportedGoalError, match=f"'{name}' does not support") as caught:
            solve(arm, goals, solver=name)
        assert "lm" in caught.value.able


def test_soft_is_true_or_false():
    with pytest.raises(InvalidGoalError, match="soft must be True or False"):
        PositionGoal(None, (0, 0, 0), soft="yes")


def test_retargeting_keeps_softness(arm):
    problem = Problem(
        arm, [PositionGoal(None, (0.3, 0.3, 0.5)), PostureGoal(q=arm.home, soft=True)]
    )
    problem.retarget(arm.home + 0.1, 1)
    assert problem.goals[1].soft
    problem.retarget(PostureGoal(q=arm.home + 0.2, soft=True), 1)
    assert np.array_equal(problem.goals[1].q, arm.home + 0.2)
    with pytest.raises(InvalidGoalError, match="is a posture goal, not PostureGoal"):
        problem.retarget(PostureGoal(q=arm.home), 1)
