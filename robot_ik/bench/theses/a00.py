"""A00's tests 1 to 13 by the methods of this library: the frames that each method meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from robot_ik.bench.theses.tracking import SCHEMA, Track, track
from robot_ik.errors import GoalError, OptionError, UnsupportedJointError
from robot_ik.goals import Tolerance
from robot_ik.problem import Problem
from robot_ik.solvers import SOLVERS
from robot_ik.theses.courses import NUMBERS, THESIS_RESULTS, Course, make_course
from robot_ik.workcell.progress import Progress, share_of

TOLERANCE = Tolerance(position=1e-4, angle=1e-3)
MUST_PASS = ("lm", "dls", "bfgs", "auto")
"""Methods that must meet every frame. The others are reported."""


@dataclass(eq=False)
class A00Report:
    """Results so far. They are written while the job runs, so an interruption loses no results.

    Attributes:
        numbers: Numbers of the tests.
        solvers: Methods.
        frames: Frames of a course. None for whole courses.
        seed: Seed of courses and restarts.
        courses: Courses that were begun, by number.
        tracks: Results by (solver, number).
        complete: Whether everything was run.
    """

    numbers: tuple[int, ...]
    solvers: tuple[str, ...]
    frames: int | None
    seed: int
    courses: dict[int, Course] = field(default_factory=dict)
    tracks: dict[tuple[str, int], Track] = field(default_factory=dict)
    complete: bool = False

    @property
    def failures(self) -> list[tuple[str, int]]:
        """Pairs (solver, test) that must pass and did not. A refusal is a failure."""
        return [
            key for key, track in self.tracks.items() if key[0] in MUST_PASS and not track.passed
        ]

    @property
    def passed(self) -> bool:
        """Whether all methods that must pass did."""
        return self.complete and not self.failures

    def lost_at(self, solver: str, number: int) -> str:
        """Return the place at which a method first lost the goal: ``"20.1°"``. Empty if never."""
        lost = self.tracks[solver, number].lost
        if lost is None:
            return ""
        course = self.courses[number]
        return f"{course.at[lost]:.4g}{course.unit}"


def ask_a00(
    numbers: Sequence[int] = (),
    solvers: Sequence[str] = (),
    frames: int | None = None,
    seed: int = 0,
) -> A00Report:
    """Return an empty report for the chosen tests and methods.

    Args:
        numbers: Numbers of the tests. Empty for all.
        solvers: Methods. Empty for all.
        frames: Frames of a course. None for whole courses.
        seed: Seed of courses and restarts.

    Raises:
        OptionError: No such test.
        UnknownSolverError: No such method.
    """
    for number in numbers:
        if number not in NUMBERS:
            raise OptionError("--test", f"there is no test {number}", "1 … 13")
    for name in solvers:
        SOLVERS[name]  # an unknown name raises an error with close names
    return A00Report(
        numbers=tuple(sorted(set(numbers))) or NUMBERS,
        solvers=tuple(dict.fromkeys(solvers)) or tuple(SOLVERS),
        frames=frames,
        seed=seed,
    )


def no_progress(_phase: str, _share: float) -> None:
    """Show no progress."""


def run_a00(report: A00Report, progress: Progress = no_progress) -> A00Report:
    """Run the tests of a report and write the results into it."""
    jobs = len(report.numbers) * len(report.solvers)
    done = 0
    for number in report.numbers:
        course = report.courses[number] = make_course(number, report.seed, report.frames)
        for name in report.solvers:
            show = share_of(progress, f"test {number}: {name}", done, jobs)
            try:
                problem = Problem(
                    course.robot, course.goal, solver=name, tolerance=TOLERANCE, seed=report.seed
                )
            except (GoalError, UnsupportedJointError):
                show(1.0)
                report.tracks[name, number] = Track(len(course.targets), refused=True)
            else:
                report.tracks[name, number] = track(
                    problem, course.targets, course.robot.home, show
                )
            done += 1
    report.complete = True
    return report


def a00_summary(report: A00Report) -> dict[str, Any]:
    """Return the content of ``a00.json``: metres, radians, shares of 1, milliseconds."""
    return {
        "schema": SCHEMA,
        "experiment": "a00",
        "complete": report.complete,
        "passed": report.passed,
        "seed": report.seed,
        "tolerance_position_m": TOLERANCE.position,
        "tolerance_angle_rad": TOLERANCE.angle,
        "must_pass": [name for name in MUST_PASS if name in report.solvers],
        "tests": [
            {
                "test": number,
                "joints": len(course.robot.joints),
                "goal": course.goal.name,
                "moves": course.moves,
                "frames": len(course.at),
                "his_result": THESIS_RESULTS[number],
            }
            for number, course in report.courses.items()
        ],
        "tracks": [
            {
                "solver": name,
                "test": number,
                **asdict(track),
                "share": None if track.refused else track.share,
                "lost_at": report.lost_at(name, number) or None,
            }
            for (name, number), track in report.tracks.items()
        ],
    }
