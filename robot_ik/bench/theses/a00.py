"""A00's tests 1-13 run by the methods of today: which frames each meets, and where it loses the goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from robot_ik.bench.theses.tracking import SCHEMA, Track, track
from robot_ik.chain import make_chain
from robot_ik.errors import ConfigError, GoalError, UnsupportedJointError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.jobs import Progress, share_of
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers import SOLVERS

# ------------------------------------------------------------------------------------------
# A00's thirteen courses: what he states of each, and what is chosen here where he states nothing.
#
# M. Aho, *Implementation of articulated mechanisms in computer animation*, University of Helsinki 2000,
# tests 1-13.  The base is at the origin of the world; at home the links lie along z.


DIAGONAL = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
SKEW = np.array([1.0, -1.0, 1.0]) / math.sqrt(3.0)
X, Y, Z = np.eye(3)

CIRCLE_STEP = 1.0  # degrees a frame
SMALL_STEP, LARGE_STEP = 0.1, 5.0  # tests 6, 7 and 9
SLOWNESS = 4.0  # test 3: the orientation rotates this many times slower than the goal
SIDE = 2.0 * X  # test 10: middle of its circle of 1 m
POINTS, LINE_STEP = 10, 0.02  # tests 11, 12: random points; metres a frame
BEND = 75.0  # test 13: the elbow bends to twice this, degrees


@dataclass(frozen=True, eq=False)
class Course:
    """One of the thirteen: goals that move a little each frame.

    Attributes:
        robot: The chain.
        goal: The kind of goal, with the first target.
        moves: What the goal does; what A00 states first, then what is chosen.
        unit: Of ``at``: ``"°"`` of the goal's rotation, or ``"m"`` along its path.
        at: (frames,) how far the goal has gone.
        targets: One pose a frame.
    """

    robot: Robot
    goal: Goal
    moves: str
    unit: str
    at: Array
    targets: tuple[Pose, ...]


def _rotated(axis: Array, degrees: float, point: Array) -> Array:
    return Pose((0.0, 0.0, 0.0), rotation_exp(axis * math.radians(degrees))).apply(point)


def _about(axis: Array, degrees: float, wxyz: Array | None = None) -> Array:
    rotation = rotation_exp(axis * math.radians(degrees))
    return rotation if wxyz is None else quat_multiply(rotation, wxyz)


TO_X = rotation_exp(Y * math.pi / 2.0)  # the last link along x


def _course(joints: int, oriented: bool, moves: str, unit: str, at: Array, targets: Sequence[Pose]) -> Course:
    goal = PoseGoal.at("tip", targets[0]) if oriented else PositionGoal("tip", targets[0].position)
    return Course(make_chain(joints), goal, moves, unit, at, tuple(targets))


def _lines(number: int, joints: int, seed: int, frames: int | None) -> Course:
    """Straight lines through the tips of random configurations, at an even pace."""
    robot, rng = make_chain(joints), np.random.default_rng([seed, number])
    corners = np.array([robot.forward(robot.sample(rng)).position for _ in range(POINTS)])
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, far[-1], LINE_STEP)[:frames]
    path = np.column_stack([np.interp(at, far, corners[:, k]) for k in range(3)])
    moves = (
        f"straight lines to random points: {POINTS} points where random joint angles put the tip, "
        f"{100 * LINE_STEP:g} cm a frame"
    )
    return _course(joints, False, moves, "m", at, [Pose(point) for point in path])


def _square(frames: int | None) -> Course:
    """Two balls: six freedoms and six numbers wanted; goals can only be made from joint angles."""

    def balls(at: float) -> Array:
        elbow = math.radians(BEND * (1.0 - math.cos(math.radians(at))))
        return np.concatenate([_about(DIAGONAL, at), rotation_exp(elbow * _rotated(Z, 2.0 * at, X))])

    robot, at = make_chain(2), _circle_angles(CIRCLE_STEP)[:frames]
    moves = (
        "not stated: the tip of joint angles that turn about (1,1,0) while the elbow bends from straight "
        f"to {2 * BEND:g}° and back, its axis turning twice as fast; the first and last goal can be met "
        "by the straight chain alone"
    )
    return _course(2, True, moves, "°", at, [robot.measure(balls(a)) for a in at])


def _circle_angles(step: float) -> Array:
    return np.arange(0.0, 360.0 + 0.5 * step, step)


@dataclass(frozen=True, eq=False)
class _Circle:
    """A goal on a circle: ``start`` is rotated about ``axis`` through ``centre``, a step of degrees a frame.

    Its orientation begins as ``wxyz`` and is rotated about the axis ``rotation``, ``slowness`` times slower;
    None: it has none.
    """

    joints: int
    moves: str
    axis: Array
    start: Array
    step: float = CIRCLE_STEP
    centre: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array | None = None
    wxyz: Array | None = None
    slowness: float = 1.0

    def pose(self, at: float) -> Pose:
        position = self.centre + _rotated(self.axis, at, self.start)
        if self.rotation is None:
            return Pose(position)
        return Pose(position, _about(self.rotation, at / self.slowness, self.wxyz))


_DIAGONALLY = "about (1,1,0) from the z axis"
_CIRCLES = {
    1: _Circle(3, "circle about the origin in XY", Z, 1.5 * X),
    2: _Circle(5, "circle in XY", Z, 2.5 * X),
    3: _Circle(5, f"circle in XY, the orientation turning {SLOWNESS:g} times slower about z, from the last "
               "link pointing outwards", Z, 2.5 * X, rotation=Z, wxyz=TO_X, slowness=SLOWNESS),
    4: _Circle(5, "circle in XZ", Y, 2.5 * X),
    5: _Circle(5, "circle in YZ", X, 2.5 * Y),
    6: _Circle(5, f"{_DIAGONALLY} in {SMALL_STEP:g}° steps", DIAGONAL, 2.5 * Z, SMALL_STEP),
    7: _Circle(5, f"{_DIAGONALLY} in {SMALL_STEP:g}° steps, the orientation turning as much, from the last "
               "link pointing outwards", DIAGONAL, 2.5 * Z, SMALL_STEP, rotation=DIAGONAL),
    8: _Circle(5, "fixed at (0, 0, 2.5) m, the orientation turning about (1,1,0)", DIAGONAL, 0.0 * Z,
               centre=2.5 * Z, rotation=DIAGONAL),
    9: _Circle(5, f"{_DIAGONALLY} in {LARGE_STEP:g}° steps", DIAGONAL, 2.5 * Z, LARGE_STEP),
    10: _Circle(5, "on one side of the origin: circle of 1 m about (2, 0, 0) m and the axis (1,1,0), the "
                "orientation turning about (1,-1,1)", DIAGONAL, Z, centre=SIDE, rotation=SKEW, wxyz=TO_X),
}  # fmt: skip


def _circles(number: int, frames: int | None) -> Course:
    row = _CIRCLES[number]
    at = _circle_angles(row.step)[:frames]
    targets = [row.pose(float(a)) for a in at]
    return _course(row.joints, row.rotation is not None, row.moves, "°", at, targets)


NUMBERS = tuple(range(1, 14))


def make_course(number: int, seed: int = 0, frames: int | None = None) -> Course:
    """A00's test ``number`` (1 … 13), of no more than so many frames; ``seed`` is for 11 and 12."""
    if number in (11, 12):
        return _lines(number, 3 if number == 11 else 5, seed, frames)
    return _square(frames) if number == 13 else _circles(number, frames)


TOLERANCE = Tolerance(position=1e-4, angle=1e-3)
MUST_PASS = ("lm", "dls", "bfgs", "auto")
"""Methods that have to meet every frame; the others are reported."""

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
        frames: None for whole courses.
        courses: The courses begun, by number.
        tracks: How a method fared on a course, by (solver, number).
        complete: All that was asked has been run.
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
        """(solver, test) that had to pass and did not; a refusal is no pass either."""
        return [key for key, track in self.tracks.items() if key[0] in MUST_PASS and not track.passed]

    @property
    def passed(self) -> bool:
        """All that had to pass did."""
        return self.complete and not self.failures

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
        ConfigError: No such test.
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


def run_a00(report: A00Report, progress: Progress = lambda phase, share: None) -> A00Report:
    """Runs what the report asks for and has not yet, and fills it in."""
    jobs, done = len(report.numbers) * len(report.solvers), 0
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
                report.tracks[name, number] = track(problem, course.targets, course.robot.home, show)
            done += 1
    report.complete = True
    return report


def a00_summary(report: A00Report) -> dict[str, Any]:
    """The content of ``a00.json``: metres, radians, shares of 1, milliseconds."""
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
                "his_result": HIS[number],
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
