"""Unusual goals: refused, or with the result that docs/reference/goals.md defines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.batch import solve_batch
from robot_ik.budget import Budget
from robot_ik.errors import (
    GoalError,
    InvalidGoalError,
    ModelError,
    OptionError,
    RobotIkError,
    UnknownSolverError,
    UnsupportedGoalError,
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
from robot_ik.solvers import SOLVERS, make_solver
from tests.solvers.law_cases import supported_problem

SHORT = Budget(iterations=300)
FEW = settings(max_examples=50)
names = pytest.mark.parametrize("name", list(SOLVERS))

# Values from a division by zero, a truncated file, a wrong column and so on.
ODD = st.one_of(
    st.sampled_from(
        [
            None,
            "abc",
            b"\0",
            object(),
            1.5,
            True,
            {},
            {"x": 1},
            [[1, 2], [3]],
            [None] * 3,
            ["1", "a"],
        ]
    ),
    st.lists(st.floats(), max_size=8),
    st.lists(st.lists(st.floats(allow_nan=False), max_size=4), max_size=4),
)


@pytest.fixture(scope="module")
def puma():
    return load_robot("puma560")


# Refused with a message


@FEW
@given(
    odd=ODD,
    makes=st.sampled_from(
        [PositionGoal, AimGoal, LineGoal, PlaneGoal, HalfSpaceGoal, CenterOfMassGoal]
    ),
)
def test_any_position_argument_is_accepted_or_refused(odd, makes):
    try:
        goal = makes(None, odd)
    except InvalidGoalError as error:
        assert len(str(error)) < 2000
    else:
        assert np.shape(odd) == (3,) and np.isfinite(goal.target.position).all()


@FEW
@given(odd=ODD)
def test_any_orientation_posture_or_axis_argument_is_accepted_or_refused(odd):
    for make in (
        lambda: OrientationGoal(None, odd),
        lambda: PoseGoal(None, (0, 0, 0), odd),
        lambda: PostureGoal(q=odd),
        lambda: PostureGoal(q=(0, 0), joints=odd),
        lambda: LineGoal(None, (0, 0, 0), odd),
        lambda: AimGoal(None, (0, 0, 0), axis=odd),
        lambda: PositionGoal(None, (0, 0, 0), weight=odd),
        lambda: PositionGoal(None, (0, 0, 0), length=odd),
        lambda: PositionGoal(None, (0, 0, 0), axes=odd),
        lambda: PositionGoal(None, (0, 0, 0), priority=odd),
        lambda: PositionGoal(None, (0, 0, 0), tolerance=odd),
        lambda: Tolerance(odd, 1.0),
        lambda: Budget(iterations=odd),
        lambda: Budget(seconds=odd),
        lambda: Budget(restarts=odd),
    ):
        try:
            make()
        except (InvalidGoalError, OptionError):
            continue


@FEW
@given(odd=ODD)
def test_any_start_or_batch_argument_is_accepted_or_refused(puma, odd):
    goal = PositionGoal(None, (0.3, 0.3, 0.5))
    poses = np.tile(np.eye(4), (2, 1, 1))
    for ask, error in (
        (lambda: solve(puma, goal, start=odd, budget=SHORT), ModelError),
        (lambda: solve_batch(puma, odd, budget=SHORT), InvalidGoalError),
        (lambda: solve_batch(puma, poses, starts=odd, budget=SHORT), InvalidGoalError),
    ):
        try:
            result = ask()
        except error:
            continue
        assert np.isfinite(result.q).all()


KINDS = [
    PositionGoal(None, (0.3, 0.3, 0.5)),
    PoseGoal(None, (0.3, 0.3, 0.5)),
    PoseGoal(None, (0.3, 0.3, 0.5), free_axis="z"),
    AimGoal(None, (0.3, 0.3, 0.5)),
    LineGoal(None, (0.3, 0.3, 0.5)),
    HalfSpaceGoal(None, (0.3, 0.3, 0.5)),
    CenterOfMassGoal(None, (0.3, 0.3, 0.5)),
    PostureGoal(q=np.zeros(6)),
]


@FEW
@given(odd=ODD, kind=st.sampled_from(KINDS))
def test_any_new_target_is_accepted_or_refused_without_a_change(puma, odd, kind):
    problem = Problem(puma, kind)
    before = problem.search.arrays["target"].copy(), problem.goals[0]
    try:
        problem.retarget(odd)
    except InvalidGoalError:
        assert (
            np.array_equal(problem.search.arrays["target"], before[0])
            and problem.goals[0] is before[1]
        )
    else:
        assert np.isfinite(problem.search.arrays["target"]).all()


@pytest.mark.parametrize("kind", KINDS[2:-1])
@pytest.mark.parametrize(
    "matrix", [np.zeros((4, 4)), np.diag([2.0, 2, 2, 1]), np.diag([1.0, 1, -1, 1])]
)
def test_a_target_matrix_that_is_not_a_rotation_is_refused(puma, kind, matrix):
    problem = Problem(puma, kind)
    with pytest.raises(InvalidGoalError, match="is not a rotation"):
        problem.retarget(matrix)
    assert problem.goals[0] is kind


@pytest.mark.parametrize("nothing", [[], (), None, 5, "abc", np.zeros(4), [None], [[]]])
def test_an_empty_list_of_goals_is_refused(puma, nothing):
    with pytest.raises(GoalError, match="one or more goals"):
        solve(puma, nothing)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda robot, goal: solve("puma560", goal), "load_robot"),
        (lambda robot, goal: solve(robot, goal, tolerance=1e-3), "Tolerance"),
        (lambda robot, goal: solve(robot, goal, budget=100), "Budget"),
        (lambda robot, goal: solve(robot, goal, budget=Budget(iterations=10**30)), "2\\^62"),
        (lambda robot, goal: solve(robot, goal, seed="lucky"), "whole number"),
        (lambda robot, goal: solve_batch(robot, [[0, 0, 1]], threads=0), "threads"),
        (lambda robot, goal: solve_batch(robot, [np.zeros((4, 4))]), "is not a rotation"),
        (
            lambda robot, goal: solve_batch(robot, [np.eye(4), np.diag([1, 1, -1, 1])]),
            "pose 1 is not a rotation",
        ),
        (lambda robot, goal: solve(robot, PositionGoal(None, (1e200, 0, 0))), "below 1e\\+100"),
        (lambda robot, goal: solve(robot, PostureGoal(q=[1, 2])), "has 6 numbers"),
    ],
)
def test_likely_mistakes_get_a_clear_message(puma, ask, message):
    with pytest.raises(RobotIkError, match=message):
        ask(puma, PositionGoal(None, (0.3, 0.3, 0.5)))


def test_none_is_an_unknown_solver(puma):
    with pytest.raises(UnknownSolverError, match="unknown solver None"):
        solve(puma, KINDS[0], solver=None)


def test_a_solver_class_is_refused_with_its_name(puma):
    with pytest.raises(
        OptionError, match=r"LevenbergMarquardt is a class.*\n.*LevenbergMarquardt\(\)"
    ):
        solve(puma, KINDS[0], solver=SOLVERS["lm"])


# Weights, duplicates


@names
def test_a_goal_with_weight_zero_is_met_at_the_start(puma, name):
    goals = [
        PositionGoal(None, (1e9, 0, 0), weight=0),
        PoseGoal(None, (5, 5, 5), (0, 1, 0, 0), position_weight=0, angle_weight=0),
        AimGoal(None, (5, 5, 5), weight=0),
        HalfSpaceGoal(None, (5, 5, 5), weight=0),
        CenterOfMassGoal(None, (5, 5, 5), weight=0),
        PostureGoal(q=np.ones(6), weight=0),
    ]
    solver = make_solver(name)
    for asked in [*goals, goals]:
        problem = supported_problem(puma, asked, solver=solver)
        if problem is None:
            continue
        solution = problem.solve(np.full(6, 0.1))
        assert (
            solution.converged
            and solution.iterations == 0
            and solution.error == rik.solution.Deviation(0, 0)
        )
        assert np.array_equal(solution.q, puma.clip(np.full(6, 0.1)))


@names
def test_a_repeated_goal_equals_a_single_goal(puma, name):
    solver = make_solver(name)
    rng = np.random.default_rng(1)
    for kind in ("position", "pose"):
        pose = puma.forward(puma.clip(puma.home + rng.uniform(-0.3, 0.3, 6)))
        goal = PositionGoal(None, pose.position) if kind == "position" else PoseGoal.at(None, pose)
        if supported_problem(puma, goal, solver=solver) is None:
            continue
        once = Problem(puma, goal, solver=solver).solve()
        if supported_problem(puma, [goal] * 3, solver=solver) is None:
            with pytest.raises(UnsupportedGoalError, match=name):
                Problem(puma, [goal] * 3, solver=solver)
            continue
        thrice = Problem(puma, [goal] * 3, solver=solver).solve()
        assert once.converged and thrice.converged and len(thrice.errors) == 3
        assert len(set(thrice.errors)) == 1
        np.testing.assert_allclose(thrice.q, once.q, atol=2e-3)
