"""The thirteen test courses of A00: goals that move a little in each frame.

M. Aho, *Implementation of articulated mechanisms in computer animation*, University of Helsinki
2000, section 7.2. The base is at the origin of the world. The links lie along z at home. Values
that the thesis does not state are chosen here. ``Course.moves`` begins with the stated motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robot_ik.chain import make_chain
from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.ports import Array
from robot_ik.robot import Robot

NUMBERS = tuple(range(1, 14))
"""Numbers of the tests."""

X, Y, Z = np.eye(3)

DIAGONAL = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
"""Axis of tests 6 to 9, stated."""

SKEW = np.array([1.0, -1.0, 1.0]) / math.sqrt(3.0)
"""Axis about which the orientation of test 10 rotates, chosen."""

CIRCLE_STEP = 1.0
"""Degrees a frame of tests 1 to 5, 8, 10 and 13, chosen."""

SMALL_STEP = 0.1
"""Degrees a frame of tests 6 and 7, stated."""

LARGE_STEP = 5.0
"""Degrees a frame of test 9, chosen; the thesis states that it is larger."""

SLOWNESS = 4.0
"""Test 3: the orientation rotates this many times slower than the goal moves, chosen."""

SIDE = 2.0 * X
"""Test 10: centre of its circle of 1 m, chosen."""

POINTS = 10
"""Random points of tests 11 and 12, chosen."""

LINE_STEP = 0.02
"""Metres a frame of tests 11 and 12, chosen."""

BEND = 75.0
"""Degrees. The elbow of test 13 bends to twice this angle, chosen."""

TO_X = rotation_exp(Y * math.pi / 2.0)
"""Orientation (4,) of a last link along x."""

THESIS_RESULTS = {
    1: "ok",
    2: "ok",
    3: "ok",
    4: "ok",
    5: "ok",
    6: "lost after some 20°, cause never found",
    7: "failed sooner than 6",
    8: "drifts off",
    9: "not stated",
    10: "failed",
    11: "sometimes",
    12: "as 11",
    13: "unsolved: J is square and singular",
}
"""Results of the thesis, by test."""


@dataclass(frozen=True, eq=False)
class Course:
    """One of the thirteen tests.

    Attributes:
        number: Its number in the thesis.
        robot: The chain.
        goal: The kind of goal, with the first target.
        moves: Description of the motion of the goal.
        unit: Unit of ``at``: ``"°"`` of the goal's rotation, or ``"m"`` along its path.
        at: (frames,) distance or angle that the goal has moved.
        targets: One pose a frame.
    """

    number: int
    robot: Robot
    goal: Goal
    moves: str
    unit: str
    at: Array
    targets: tuple[Pose, ...]

    def place(self, frame: int) -> str:
        """Return the distance or angle of the goal at a frame, such as ``"20.1°"``."""
        return f"{self.at[frame]:.4g}{self.unit}"


def make_course(number: int, seed: int = 0, frames: int | None = None) -> Course:
    """Return one of the tests.

    Args:
        number: Its number, 1 to 13.
        seed: Seed of the random points of tests 11 and 12.
        frames: Largest number of frames. None for the whole course.

    Raises:
        ConfigError: There is no such test.
    """
    if number not in NUMBERS:
        raise ConfigError(
            f"there is no test {number}", file="course", key="number", allowed="1 to 13"
        )
    if number in (11, 12):
        return _lines(number, 3 if number == 11 else 5, seed, frames)
    return _square(frames) if number == 13 else _circle(number, frames)


def _course(
    number: int,
    joints: int,
    *,
    oriented: bool,
    moves: str,
    unit: str,
    at: Array,
    targets: Sequence[Pose],
) -> Course:
    goal: Goal = PositionGoal("tip", targets[0].position)
    if oriented:
        goal = PoseGoal.at("tip", targets[0])
    return Course(number, make_chain(joints), goal, moves, unit, at, tuple(targets))


def _rotated(axis: Array, degrees: float, point: Array) -> Array:
    return Pose((0.0, 0.0, 0.0), rotation_exp(axis * math.radians(degrees))).apply(point)


def _turned(axis: Array, degrees: float, wxyz: Array | None = None) -> Array:
    """Return ``wxyz`` (4,) turned about an axis of the world."""
    rotation = rotation_exp(axis * math.radians(degrees))
    return rotation if wxyz is None else quat_multiply(rotation, wxyz)


def _lines(number: int, joints: int, seed: int, frames: int | None) -> Course:
    """Return straight lines through the tips of random configurations, at constant speed."""
    robot = make_chain(joints)
    rng = np.random.default_rng([seed, number])
    corners = np.array([robot.forward(robot.sample(rng)).position for _ in range(POINTS)])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    distances = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.arange(0.0, distances[-1], LINE_STEP)[:frames]
    path = np.column_stack([np.interp(at, distances, corners[:, k]) for k in range(3)])
    moves = (
        f"straight lines to random points: {POINTS} points where random joint angles put the tip, "
        f"{100 * LINE_STEP:g} cm a frame"
    )
    targets = [Pose(point) for point in path]
    return _course(number, joints, oriented=False, moves=moves, unit="m", at=at, targets=targets)


def _square(frames: int | None) -> Course:
    """Return test 13: a chain of six degrees of freedom with a pose goal.

    The Jacobian of two ball joints has rank 5 at every pose, so joint angles define the goals.
    """

    def q(at: float) -> Array:
        elbow = math.radians(BEND * (1.0 - math.cos(math.radians(at))))
        axis = _rotated(Z, 2.0 * at, X)
        return np.concatenate([_turned(DIAGONAL, at), rotation_exp(elbow * axis)])

    robot = make_chain(2)
    at = _circle_angles(CIRCLE_STEP)[:frames]
    moves = (
        "not stated: the tip of joint angles that turn about (1,1,0) while the elbow bends from "
        f"straight to {2 * BEND:g}° and back, its axis turning twice as fast; the first and last "
        "goal can be met by the straight chain alone"
    )
    targets = [robot.measure(q(a)) for a in at]
    return _course(13, 2, oriented=True, moves=moves, unit="°", at=at, targets=targets)


def _circle_angles(step: float) -> Array:
    return np.arange(0.0, 360.0 + 0.5 * step, step)


@dataclass(frozen=True, eq=False)
class _Circle:
    """A goal on a circle.

    Attributes:
        joints: Links of the chain.
        moves: As in ``Course``.
        axis: (3,) axis of the circle.
        start: (3,) first position, seen from the centre, m.
        step: Degrees a frame.
        centre: (3,) m.
        rotation: (3,) axis about which the orientation rotates. None: the goal is a position.
        wxyz: (4,) first orientation. None for that of the world.
        slowness: The orientation rotates this many times slower than the position.
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
        """Return the target after ``at`` degrees."""
        position = self.centre + _rotated(self.axis, at, self.start)
        if self.rotation is None:
            return Pose(position)
        return Pose(position, _turned(self.rotation, at / self.slowness, self.wxyz))


_DIAGONALLY = "about (1,1,0) from the z axis"

_CIRCLES = {
    1: _Circle(3, "circle about the origin in XY", Z, 1.5 * X),
    2: _Circle(5, "circle in XY", Z, 2.5 * X),
    3: _Circle(
        5,
        f"circle in XY, the orientation turning {SLOWNESS:g} times slower about z, from the last "
        "link pointing outwards",
        Z,
        2.5 * X,
        rotation=Z,
        wxyz=TO_X,
        slowness=SLOWNESS,
    ),
    4: _Circle(5, "circle in XZ", Y, 2.5 * X),
    5: _Circle(5, "circle in YZ", X, 2.5 * Y),
    6: _Circle(5, f"{_DIAGONALLY} in {SMALL_STEP:g}° steps", DIAGONAL, 2.5 * Z, step=SMALL_STEP),
    7: _Circle(
        5,
        f"{_DIAGONALLY} in {SMALL_STEP:g}° steps, the orientation turning as much, from the last "
        "link pointing outwards",
        DIAGONAL,
        2.5 * Z,
        step=SMALL_STEP,
        rotation=DIAGONAL,
    ),
    8: _Circle(
        5,
        "fixed at (0, 0, 2.5) m, the orientation turning about (1,1,0)",
        DIAGONAL,
        0.0 * Z,
        centre=2.5 * Z,
        rotation=DIAGONAL,
    ),
    9: _Circle(5, f"{_DIAGONALLY} in {LARGE_STEP:g}° steps", DIAGONAL, 2.5 * Z, step=LARGE_STEP),
    10: _Circle(
        5,
        "on one side of the origin: circle of 1 m about (2, 0, 0) m and the axis (1,1,0), the "
        "orientation turning about (1,-1,1)",
        DIAGONAL,
        Z,
        centre=SIDE,
        rotation=SKEW,
        wxyz=TO_X,
    ),
}


def _circle(number: int, frames: int | None) -> Course:
    row = _CIRCLES[number]
    at = _circle_angles(row.step)[:frames]
    return _course(
        number,
        row.joints,
        oriented=row.rotation is not None,
        moves=row.moves,
        unit="°",
        at=at,
        targets=[row.pose(float(a)) for a in at],
    )
