"""The runner measures success by MuJoCo, and keeps its measurements when it is interrupted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from robot_ik.bench.methods.problems import make_set
from robot_ik.bench.methods.results import Settings
from robot_ik.bench.methods.runner import Bench, prepare
from robot_ik.budget import Budget
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Solution, Status
from robot_ik.solvers.base import Solver

SETTINGS = Settings(
    command="", count=12, seed=0, position_tolerance=1e-4, angle_tolerance=1e-3, seconds=60.0
)


@dataclass(frozen=True)
class Scripted(Solver):
    """Returns given joint angles in sequence, with the status CONVERGED."""

    solutions: tuple[tuple[float, ...], ...] = ()
    name: ClassVar[str] = "scripted"

    def __post_init__(self) -> None:
        """No options to check."""

    def prepare(self, problem: Problem) -> Scripted:  # type: ignore[override]
        return self

    def run(self, problem: Problem, budget: Budget) -> Solution:
        calls.append(problem.search.arrays["start"].copy())
        q = np.array(self.solutions[(len(calls) - 1) % len(self.solutions)])
        targets = problem.search.arrays["target"].reshape(-1, 4, 4).copy()
        return Solution(
            q, Status.CONVERGED, 3, 1, 1e-6, self.name, problem.robot, problem.goals, targets
        )


calls: list[np.ndarray] = []


def bench(kind: str, solutions: np.ndarray, count: int = 12) -> Bench:
    arm = load_robot("puma560")
    made = prepare(
        Scripted(tuple(map(tuple, solutions))), arm, make_set(kind, arm, count), SETTINGS
    )
    calls.clear()  # the warm-up does not count
    return made


def test_a_false_converged_status_is_detected() -> None:
    problems = make_set("cold", load_robot("puma560"), 12)
    right = problems.witnesses.copy()
    wrong = right.copy()
    wrong[3, 0] += 1e-2
    # Multiples of 2π more: the pose is met, the limits are not.
    beyond = right.copy()
    beyond[5, 0] += 2 * np.pi
    for solutions, missed in ((right, []), (wrong, [3]), (beyond, [5])):
        one = bench("cold", solutions)
        one.run(SETTINGS)
        assert np.flatnonzero(~np.array(one.cell.success)).tolist() == missed
        assert set(one.cell.status) == {"CONVERGED"}
        assert one.cell.iterations == [3] * 12 and one.cell.restarts == [1] * 12
        assert all((start == load_robot("puma560").home).all() for start in calls)


def test_tracking_starts_at_the_last_solution_and_counts_jumps() -> None:
    problems = make_set("warm", load_robot("puma560"), 12)
    solutions = problems.witnesses.copy()
    solutions[4] += 0.5  # an error: the next start is back on the path
    wrist = solutions[8, 3:]  # the same pose with the wrist flipped
    wrist[:] = wrist[0] - np.pi * np.sign(wrist[0]), -wrist[1], wrist[2] - np.pi * np.sign(wrist[2])
    one = bench("warm", solutions)
    one.run(SETTINGS)
    assert np.flatnonzero(~np.array(one.cell.success)).tolist() == [4]
    np.testing.assert_array_equal(calls[0], problems.first)
    np.testing.assert_array_equal(calls[4], solutions[3])
    np.testing.assert_array_equal(calls[5], problems.witnesses[4])
    np.testing.assert_array_equal(calls[9], solutions[8])
    assert one.cell.jumps == 2  # there and back
    assert one.cell.largest_step == pytest.approx(np.pi, abs=0.1)


def test_at_least_ten_problems_are_run_when_time_is_over() -> None:
    one = bench("cold", make_set("cold", load_robot("puma560"), 40).witnesses, 40)
    one.run(SETTINGS.model_copy(update={"seconds": 0.0}))
    assert one.cell.count == 10 and one.cell.asked == 40 and one.cell.rate == 1.0


def test_an_interrupted_run_keeps_whole_rows() -> None:
    one = bench("cold", make_set("cold", load_robot("puma560"), 12).witnesses)

    def stop(share: float) -> None:
        if share >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        one.run(SETTINGS, stop)
    cell = one.cell
    lists = (
        cell.microseconds,
        cell.success,
        cell.status,
        cell.position_error,
        cell.angle_error,
        cell.iterations,
    )
    assert {len(x) for x in lists} == {6}


def test_a_method_without_poses_gets_positions() -> None:
    arm = load_robot("puma560")
    from robot_ik.solvers import make_solver

    bones = make_solver("triangulation")
    steps = make_solver("dls")
    problems = make_set("cold", arm, 3)
    assert prepare(bones, arm, problems, SETTINGS).cell.goal == "position"
    assert prepare(steps, arm, problems, SETTINGS).cell.goal == "pose"
