"""Weights that change between solves: no new problem, and the solutions of a new problem."""

from collections.abc import Iterator

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import InvalidGoalError
from robot_ik.motion import RecorderSink
from robot_ik.problem import Problem

BUDGET = rik.Budget(iterations=60, restarts=0)
# Distance of the targets of two conflicting goals from home, m.
SHIFT = np.array([0.1, 0.0, 0.0])


@pytest.fixture(scope="module")
def puma() -> rik.Robot:
    return rik.load_robot("puma560")


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[Problem]:
    """The problems that are built during a test."""
    problems: list[Problem] = []
    initialise = Problem.__init__

    def record(problem: Problem, *arguments: object, **options: object) -> None:
        problems.append(problem)
        initialise(problem, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Problem, "__init__", record)
    return problems


def conflicting_goals(robot: rik.Robot, weight: float) -> list[rik.Goal]:
    """Return positions of two frames that exclude each other, the first with a weight."""
    tool = robot.forward(robot.home).position
    flange = robot.forward(robot.home, "flange").position
    return [
        rik.PositionGoal("gripper", tool + SHIFT, weight=weight),
        rik.PositionGoal("flange", flange - SHIFT),
    ]


def weighted_goals(robot: rik.Robot, weights: tuple[float, float]) -> dict[str, list[rik.Goal]]:
    """Return goals of each kind that exclude a position goal beside them."""
    tool = robot.forward(robot.home)
    first, second = weights
    aside = tool.position + np.array([0.1, 0.05, -0.1])
    turned = (0.9, 0.1, -0.2, 0.3)
    goals: dict[str, rik.Goal] = {
        "position": rik.PositionGoal("flange", aside, weight=first),
        "orientation": rik.OrientationGoal("flange", turned, weight=first),
        "axis": rik.OrientationGoal("flange", turned, free_axis="x", weight=first),
        "pose": rik.PoseGoal("flange", aside, turned, position_weight=first, angle_weight=second),
        "best": rik.PoseGoal(
            "flange", aside, turned, position_weight=first, angle_weight=second, orientation="best"
        ),
        "aim": rik.AimGoal("flange", (2.0, 1.0, 0.0), weight=first),
        "line": rik.LineGoal("flange", aside, "x", weight=first),
        "plane": rik.PlaneGoal("flange", aside, "z", weight=first),
        "wall": rik.HalfSpaceGoal("flange", aside + 10.0 * SHIFT, "x", weight=first),
        "mass": rik.CenterOfMassGoal(None, (0.3, 0.3, 0.5), weight=first),
        "posture": rik.PostureGoal(q=robot.home + 0.4, weight=first),
        "joints": rik.PostureGoal(
            q=robot.home + 0.4, joints={"joint1": first, "joint3": second}, only_named=True
        ),
    }
    return {
        kind: [goal, rik.PositionGoal("gripper", tool.position)] for kind, goal in goals.items()
    }


KINDS = tuple(weighted_goals(rik.load_robot("puma560"), (1.0, 1.0)))


@pytest.mark.parametrize("kind", KINDS)
def test_other_weights_give_the_solution_of_a_new_problem(puma: rik.Robot, kind: str) -> None:
    first, second = (weighted_goals(puma, weights)[kind] for weights in ((1.0, 1.0), (3.0, 0.2)))
    assert [goal.kind for goal in first] == [goal.kind for goal in second]
    expected = [
        Problem(puma, goals, solver="lm", budget=BUDGET).solve() for goals in (first, second)
    ]
    assert not np.array_equal(expected[0].q, expected[1].q), "the weights make no difference"

    problem = Problem(puma, first, solver="lm", budget=BUDGET)
    for goals, solution in ((second, expected[1]), (first, expected[0])):
        problem.retarget(goals[0])
        assert np.array_equal(problem.solve().q, solution.q)
        assert problem.goals == tuple(goals) == problem.solve().goals


def test_a_pose_as_target_keeps_the_weights(puma: rik.Robot) -> None:
    first, second = (conflicting_goals(puma, weight) for weight in (1.0, 4.0))
    problem = Problem(puma, first, solver="lm", budget=BUDGET)
    problem.retarget(second[0])
    problem.retarget(second[0].target)
    expected = Problem(puma, second, solver="lm", budget=BUDGET).solve()
    assert np.array_equal(problem.solve().q, expected.q)


def test_weights_of_a_refused_mapping_are_not_used(puma: rik.Robot) -> None:
    first, second = (conflicting_goals(puma, weight) for weight in (1.0, 4.0))
    problem = Problem(puma, first, solver="lm", budget=BUDGET)
    expected = problem.solve().q
    with pytest.raises(InvalidGoalError):
        problem.retarget({0: second[0], 1: (np.nan, 0.0, 0.0)})
    assert np.array_equal(problem.solve().q, expected)
    problem.retarget({0: second[0]})
    assert not np.array_equal(problem.solve().q, expected)


def test_a_weight_that_becomes_zero_is_another_kind(puma: rik.Robot) -> None:
    tool = puma.forward(puma.home)
    problem = Problem(puma, rik.PoseGoal.at("gripper", tool))
    point = rik.PoseGoal("gripper", tool.position, tool.wxyz, angle_weight=0.0)
    with pytest.raises(InvalidGoalError, match="weight that becomes zero"):
        problem.retarget(point)


def test_solve_keeps_its_problem_for_other_weights(puma: rik.Robot, builds: list[Problem]) -> None:
    fresh = {
        weight: Problem(puma, conflicting_goals(puma, weight), solver="lm", budget=BUDGET).solve()
        for weight in (0.5, 1.0, 4.0)
    }
    rik.solve(puma, conflicting_goals(puma, 2.0), solver="lm", budget=BUDGET)
    builds.clear()
    for weight, expected in fresh.items():
        solution = rik.solve(puma, conflicting_goals(puma, weight), solver="lm", budget=BUDGET)
        assert np.array_equal(solution.q, expected.q)
    assert not builds


def test_a_batch_after_a_weighted_solve_has_the_usual_weights(puma: rik.Robot) -> None:
    far = rik.Pose((3.0, 0.5, 0.5))
    expected = rik.solve_batch(puma, [far], solver="dls", budget=BUDGET, threads=1)
    heavy = rik.PoseGoal(None, far.position, far.wxyz, angle_weight=5.0)
    rik.solve(puma, heavy, solver="dls", budget=BUDGET)
    again = rik.solve_batch(puma, [far], solver="dls", budget=BUDGET, threads=1)
    assert np.array_equal(again.q, expected.q)


class ShiftingWeights:
    """A source of goals whose target and weight change with every poll."""

    def __init__(self, robot: rik.Robot, weights: Iterator[float]) -> None:
        self._robot = robot
        self._weights = weights

    def poll(self, now: float) -> list[rik.Goal]:
        """Return two positions that exclude each other."""
        weighted, other = conflicting_goals(self._robot, next(self._weights))
        assert isinstance(weighted, rik.PositionGoal)
        moved = rik.PositionGoal(
            "gripper", weighted.position + np.array([0.0, 0.01 * now, 0.0]), weight=weighted.weight
        )
        return [moved, other]


def test_follow_builds_one_problem_for_weights_that_change_every_tick(
    puma: rik.Robot, builds: list[Problem]
) -> None:
    errors = {}
    for name, weights in (("rising", np.linspace(0.2, 8.0, 200)), ("equal", np.full(200, 0.2))):
        builds.clear()
        report = rik.follow(
            puma,
            ShiftingWeights(puma, iter(weights)),
            sinks=[RecorderSink(puma.joints)],
            solver="lm",
            start=puma.home,
            clock=rik.VirtualClock(),
            duration=2.0,
        )
        assert report.ticks == 200
        assert len(builds) == 1
        final = conflicting_goals(puma, 1.0)[0].target.position + np.array([0.0, 0.0199, 0.0])
        errors[name] = np.linalg.norm(puma.measure(report.q).position - final)
    assert errors["rising"] < 0.5 * errors["equal"]
