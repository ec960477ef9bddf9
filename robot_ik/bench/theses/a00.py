"""A00's tests 1-13 run by the methods of today: which frames each meets, and where it loses the goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from robot_ik.bench.theses.tracking import Track, track
from robot_ik.chain import make_chain
from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.jobs import Progress, share_of
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers import SOLVERS, make_solver

# ------------------------------------------------------------------------------------------
# Witnesses: joint angles of a ball-joint chain that meet a goal, made by drawing the chain, not by solving.
#
# All links but those that an orientation fixes are laid on one circular arc from the base to where they
# have to end; each joint then rotates its link from the direction of the one before.


_UP = np.array([0.0, 0.0, 1.0])
# Nearer than this (metres) a point is the base itself and has no direction.
_AT_BASE = 1e-9


def chain_witness(links: int, target: Pose, *, oriented: bool) -> Array:
    """q (4 · links,) of a chain of links of 1 m whose tip is at ``target``, world.

    The orientation of ``target`` counts only where the last link has to be ``oriented`` so.

    Raises:
        ValueError: The links cannot get there.
    """
    if not oriented:
        return chain_from_world([_rotation_up_to(d) for d in _arc(links, target.position)])
    wrist = target.position - target.rotation @ _UP
    rotations = [_rotation_up_to(d) for d in _arc(links - 1, wrist)]
    return chain_from_world([*rotations, target.wxyz])


def chain_from_world(rotations: Sequence[Array]) -> Array:
    """q of the chain whose links are oriented in the world as the unit quaternions ``rotations`` (4,) say."""
    q, before = [], np.array([1.0, 0.0, 0.0, 0.0])
    for rotation in rotations:
        q.append(quat_multiply(before * [1.0, -1.0, -1.0, -1.0], rotation))
        before = rotation
    return np.concatenate(q)


def _arc(links: int, end: Array) -> list[Array]:
    """Directions (3,) of links of 1 m on a circular arc from the origin to ``end`` (3,)."""
    chord = float(np.linalg.norm(end))
    joint_angle = arc_joint_angle(links, chord)
    along = end / chord if chord > _AT_BASE else np.array([1.0, 0.0, 0.0])
    # The arc lies in the upright plane through its end; where that end is right above, in the xz plane.
    lateral = np.cross(np.cross(along, _UP), along)
    if float(np.linalg.norm(lateral)) < 1e-6:
        lateral = np.array([1.0, 0.0, 0.0])
    lateral = lateral - along * (lateral @ along)
    lateral /= np.linalg.norm(lateral)
    angles = [0.5 * joint_angle * (links - 1 - 2 * k) for k in range(links)]
    return [math.cos(a) * along + math.sin(a) * lateral for a in angles]


def arc_joint_angle(links: int, chord: float) -> float:
    """Angle from one link to the next, rad, for which the arc's ends are ``chord`` metres apart."""
    if links == 1:
        if abs(chord - 1.0) > _AT_BASE:
            raise ValueError(f"one link of 1 m cannot span {chord:.6g} m")
        return 0.0
    if chord > links + _AT_BASE:
        raise ValueError(f"{links} links of 1 m cannot span {chord:.6g} m")
    low, high = 0.0, 2.0 * math.pi / links  # straight … closed to a polygon
    for _ in range(54):  # as many halvings as a double has bits, and one
        middle = 0.5 * (low + high)
        spanned = math.sin(0.5 * links * middle) / math.sin(0.5 * middle) if middle > 0.0 else float(links)
        low, high = (middle, high) if spanned > chord else (low, middle)
    return 0.5 * (low + high)


def _rotation_up_to(direction: Array) -> Array:
    """Shortest rotation, wxyz, of the z axis to a unit vector (3,)."""
    rotation = np.empty(4)
    mujoco.mju_quatZ2Vec(rotation, direction)
    return rotation


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

SHARED = (
    "links 1 m, base at the origin, every course begun from the straight chain along z (as his links lie, "
    "and singular), each next frame from the last answer",
    "radius of the circles: half of what the chain spans (1.5 m for 3 joints, 2.5 m for 5)",
    f"steps: {CIRCLE_STEP:g}° where he states none; a whole turn each",
)
"""What is chosen for all courses alike."""


@dataclass(frozen=True, eq=False)
class Course:
    """One of the thirteen: goals that move a little each frame, each with joint angles that meet it.

    Attributes:
        number: A00's.
        robot: The chain.
        goal: The kind of goal, with the first target.
        moves: What the goal does; what A00 states first, then what is chosen.
        unit: Of ``at``: ``"°"`` of the goal's rotation, or ``"m"`` along its path.
        at: (frames,) how far the goal has gone.
        targets: One pose a frame.
        witnesses: (frames, nq) joint angles that meet them.
    """

    number: int
    robot: Robot
    goal: Goal
    moves: str
    unit: str
    at: Array
    targets: tuple[Pose, ...]
    witnesses: Array

    def witness_miss(self) -> tuple[float, float]:
        """Farthest that a witness is from its goal by MuJoCo's forward pass: metres, radians."""
        there = (self.robot.measure(q, self.goal.frame) for q in self.witnesses)
        metres, radians = np.max(list(map(self.goal.off, there, self.targets)), axis=0)
        return float(metres), float(radians)


def _rotated(axis: Array, degrees: float, point: Array) -> Array:
    return Pose((0.0, 0.0, 0.0), rotation_exp(axis * math.radians(degrees))).apply(point)


def _about(axis: Array, degrees: float, wxyz: Array | None = None) -> Array:
    rotation = rotation_exp(axis * math.radians(degrees))
    return rotation if wxyz is None else quat_multiply(rotation, wxyz)


TO_X = rotation_exp(Y * math.pi / 2.0)  # the last link along x


def _course(
    number: int, joints: int, oriented: bool, moves: str, unit: str,
    at: Array, targets: Sequence[Pose], witnesses: Array | None = None,
) -> Course:  # fmt: skip
    goal = PoseGoal.at("tip", targets[0]) if oriented else PositionGoal("tip", targets[0].position)
    if witnesses is None:
        witnesses = np.array([chain_witness(joints, target, oriented=oriented) for target in targets])
    return Course(number, make_chain(joints), goal, moves, unit, at, tuple(targets), witnesses)


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
    return _course(number, joints, False, moves, "m", at, [Pose(point) for point in path])


def _square(number: int, frames: int | None) -> Course:
    """Two balls: six freedoms and six numbers wanted; goals can only be made from joint angles."""
    robot, at = make_chain(2), _circle_angles(CIRCLE_STEP)[:frames]
    witnesses = np.array([_two_balls(a) for a in at])
    moves = (
        "not stated: the tip of joint angles that turn about (1,1,0) while the elbow bends from straight "
        f"to {2 * BEND:g}° and back, its axis turning twice as fast; the first and last goal can be met "
        "by the straight chain alone"
    )
    return _course(number, 2, True, moves, "°", at, [robot.measure(q) for q in witnesses], witnesses)


def _two_balls(at: float) -> Array:
    elbow = math.radians(BEND * (1.0 - math.cos(math.radians(at))))
    axis = _rotated(Z, 2.0 * at, X)
    return np.concatenate([_about(DIAGONAL, at), rotation_exp(elbow * axis)])


def _circle_angles(step: float) -> Array:
    return np.arange(0.0, 360.0 + 0.5 * step, step)


@dataclass(frozen=True, eq=False)
class _Circle:
    """A goal on a circle: ``start`` is rotated about ``axis`` through ``centre``, a step of degrees a frame.

    Its orientation begins as ``wxyz`` and is rotated about ``turn``, ``slowness`` times slower; None: it has
    none.
    """

    joints: int
    moves: str
    axis: Array
    start: Array
    step: float = CIRCLE_STEP
    centre: Array = field(default_factory=lambda: np.zeros(3))
    turn: Array | None = None
    wxyz: Array | None = None
    slowness: float = 1.0

    def pose(self, at: float) -> Pose:
        position = self.centre + _rotated(self.axis, at, self.start)
        if self.turn is None:
            return Pose(position)
        return Pose(position, _about(self.turn, at / self.slowness, self.wxyz))


_DIAGONALLY = "about (1,1,0) from the z axis"
_CIRCLES = {
    1: _Circle(3, "circle about the origin in XY", Z, 1.5 * X),
    2: _Circle(5, "circle in XY", Z, 2.5 * X),
    3: _Circle(5, f"circle in XY, the orientation turning {SLOWNESS:g} times slower about z, from the last "
               "link pointing outwards", Z, 2.5 * X, turn=Z, wxyz=TO_X, slowness=SLOWNESS),
    4: _Circle(5, "circle in XZ", Y, 2.5 * X),
    5: _Circle(5, "circle in YZ", X, 2.5 * Y),
    6: _Circle(5, f"{_DIAGONALLY} in {SMALL_STEP:g}° steps", DIAGONAL, 2.5 * Z, SMALL_STEP),
    7: _Circle(5, f"{_DIAGONALLY} in {SMALL_STEP:g}° steps, the orientation turning as much, from the last "
               "link pointing outwards", DIAGONAL, 2.5 * Z, SMALL_STEP, turn=DIAGONAL),
    8: _Circle(5, "fixed at (0, 0, 2.5) m, the orientation turning about (1,1,0)", DIAGONAL, 0.0 * Z,
               centre=2.5 * Z, turn=DIAGONAL),
    9: _Circle(5, f"{_DIAGONALLY} in {LARGE_STEP:g}° steps", DIAGONAL, 2.5 * Z, LARGE_STEP),
    10: _Circle(5, "on one side of the origin: circle of 1 m about (2, 0, 0) m and the axis (1,1,0), the "
                "orientation turning about (1,-1,1)", DIAGONAL, Z, centre=SIDE, turn=SKEW, wxyz=TO_X),
}  # fmt: skip


def _circles(number: int, frames: int | None) -> Course:
    row = _CIRCLES[number]
    at = _circle_angles(row.step)[:frames]
    targets = [row.pose(float(a)) for a in at]
    return _course(number, row.joints, row.turn is not None, row.moves, "°", at, targets)


NUMBERS = tuple(range(1, 14))


def make_course(number: int, seed: int = 0, frames: int | None = None) -> Course:
    """A00's test ``number`` (1 … 13), of no more than so many frames; ``seed`` is for 11 and 12."""
    if number in (11, 12):
        return _lines(number, 3 if number == 11 else 5, seed, frames)
    return _square(number, frames) if number == 13 else _circles(number, frames)


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
        course = make_course(number, report.seed, report.frames)
        # In this order: whoever is interrupted in between has no course without its witnesses' miss.
        report.witness_miss[number] = course.witness_miss()
        report.courses[number] = course
        for name in report.solvers:
            show = share_of(progress, f"test {number}: {name}", done, jobs)
            problem = Problem(course.robot, course.goal, tolerance=TOLERANCE, seed=report.seed)
            solver, start = make_solver(name), course.robot.home
            report.tracks[name, number] = track(problem, solver, course.targets, start, show)
            done += 1
    report.complete = True
    return report
