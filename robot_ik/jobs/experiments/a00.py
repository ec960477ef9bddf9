"""A00's tests 1-13 run by the methods of today: which frames each meets, and where it loses the goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from robot_ik.errors import ConfigError
from robot_ik.jobs.experiments.courses import NUMBERS, Course, make_course
from robot_ik.jobs.experiments.tracking import Gauge, Progress, Track, track
from robot_ik.problem import Problem, Tolerance
from robot_ik.solvers import SOLVERS, make_solver

TOLERANCE = Tolerance(position=1e-4, angle=1e-3)
MUST_PASS = ("lm", "dls", "bfgs", "auto")
"""Methods that have to meet every frame; the others are reported."""

# A witness is exact but for rounding: a circular arc is found by halving, rotations are multiplied.
WITNESS_MISS = 1e-9

HIS = {
    1: "ok", 2: "ok", 3: "ok", 4: "ok", 5: "ok",
    6: "lost after some 20°, cause never found", 7: "failed sooner than 6", 8: "drifts off", 9: "not stated",
    10: "failed", 11: "sometimes", 12: "as 11", 13: "unsolved: J is square and singular",
}  # fmt: skip
"""What A00 reports of his own solver."""


@dataclass(eq=False)
class A00Report:
    """What there is so far; filled while the job runs, so that an interruption loses nothing.

    Attributes:
        numbers, solvers, frames, seed: What was asked; ``frames`` is None for whole courses.
        courses: The courses begun, by number.
        tracks: How a method fared on a course, by (solver, number).
        complete: All that was asked has been run.
    """

    numbers: tuple[int, ...]
    solvers: tuple[str, ...]
    frames: int | None
    seed: int
    courses: dict[int, Course] = field(default_factory=dict)
    witness_miss: dict[int, tuple[float, float]] = field(default_factory=dict)
    tracks: dict[tuple[str, int], Track] = field(default_factory=dict)
    complete: bool = False

    @property
    def failures(self) -> list[tuple[str, int]]:
        """(solver, test) that had to pass and did not."""
        return [
            key for key, track in self.tracks.items() if key[0] in MUST_PASS and not track.passed
        ]  # a refusal is no pass either

    @property
    def passed(self) -> bool:
        """All that had to pass did, and every goal can be met."""
        return (
            self.complete and not self.failures and max(map(max, self.witness_miss.values())) <= WITNESS_MISS
        )

    def lost_at(self, solver: str, number: int) -> str:
        """Where a method first lost the goal, such as ``"20.1°"``; empty where it never did."""
        lost = self.tracks[solver, number].lost
        if lost is None:
            return ""
        course = self.courses[number]
        return f"{course.at[lost]:.4g}{course.unit}"


def ask_a00(
    numbers: Sequence[int] = (), solvers: Sequence[str] = (), frames: int | None = None, seed: int = 0
) -> A00Report:
    """An empty report for what is wanted; nothing named means all.

    Raises:
        ConfigError: No such test, or less than one frame.
        UnknownSolverError: No such method.
    """
    for number in numbers:
        if number not in NUMBERS:
            raise ConfigError(f"{number}", file="command line", key="--tests", allowed="1 … 13")
    for name in solvers:
        SOLVERS[name]  # says which are close where there is none
    return A00Report(
        tuple(sorted(set(numbers))) or NUMBERS, tuple(dict.fromkeys(solvers)) or tuple(SOLVERS), frames, seed
    )


def run_a00(report: A00Report, progress: Progress = lambda stage, share: None) -> A00Report:
    """Runs what the report asks for and has not yet, and fills it in."""
    gauge = Gauge(progress, len(report.numbers) * len(report.solvers))
    for number in report.numbers:
        course = make_course(number, report.seed, report.frames)
        # In this order: whoever is interrupted in between has no course without its witnesses' miss.
        report.witness_miss[number] = course.witness_miss()
        report.courses[number] = course
        for name in report.solvers:
            gauge.begin(f"test {number}: {name}", len(course.at))
            problem = Problem(course.robot, course.goal, tolerance=TOLERANCE, seed=report.seed)
            solver, start = make_solver(name), course.robot.home
            report.tracks[name, number] = track(problem, solver, course.targets, start, gauge.tick)
    report.complete = True
    return report
