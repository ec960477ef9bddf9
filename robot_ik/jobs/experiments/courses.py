"""A00's thirteen courses: what he states of each, and what is chosen here where he states nothing.

M. Aho, *Implementation of articulated mechanisms in computer animation*, University of Helsinki 2000,
tests 1-13.  The base is at the origin of the world; at home the links lie along z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.chain import make_chain
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.jobs.experiments.tracking import Judge
from robot_ik.jobs.experiments.witnesses import chain_witness
from robot_ik.robot import Robot

Array = NDArray[np.float64]

DIAGONAL = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
SKEW = np.array([1.0, -1.0, 1.0]) / math.sqrt(3.0)
X, Y, Z = np.eye(3)

CIRCLE_STEP = 1.0  # degrees a frame
SMALL_STEP, LARGE_STEP = 0.1, 5.0  # tests 6, 7 and 9
SLOWNESS = 4.0  # test 3: the orientation turns this many times slower than the goal
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
        unit: Of ``at``: ``"°"`` of the goal's turn, or ``"m"`` along its path.
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
        judge = Judge(self.robot, self.goal)
        metres, radians = np.max(list(map(judge.miss, self.witnesses, self.targets)), axis=0)
        return float(metres), float(radians)


def _turned(axis: Array, degrees: float, point: Array) -> Array:
    return Pose((0.0, 0.0, 0.0), rotation_exp(axis * math.radians(degrees))).apply(point)


def _about(axis: Array, degrees: float, wxyz: Array | None = None) -> Array:
    turn = rotation_exp(axis * math.radians(degrees))
    return turn if wxyz is None else quat_multiply(turn, wxyz)


TO_X = rotation_exp(Y * math.pi / 2.0)  # the last link along x


def _circle(axis: Array, start: Array, at: float) -> Pose:
    return Pose(_turned(axis, at, start))


def _slow(at: float) -> Pose:
    return Pose(_turned(Z, at, 2.5 * X), _about(Z, at / SLOWNESS, TO_X))


def _along(at: float) -> Pose:
    return Pose(_turned(DIAGONAL, at, 2.5 * Z), _about(DIAGONAL, at))


def _in_place(at: float) -> Pose:
    return Pose(2.5 * Z, _about(DIAGONAL, at))


def _one_side(at: float) -> Pose:
    return Pose(SIDE + _turned(DIAGONAL, at, Z), _about(SKEW, at, TO_X))


def _make(
    number: int, joints: int, oriented: bool, moves: str, at: Array, pose: Callable[[float], Pose]
) -> Course:
    targets = tuple(pose(float(a)) for a in at)
    witnesses = np.array([chain_witness(joints, target, oriented=oriented) for target in targets])
    return _with_goal(number, joints, oriented, moves, "°", at, targets, witnesses)


def _with_goal(
    number: int, joints: int, oriented: bool, moves: str, unit: str,
    at: Array, targets: tuple[Pose, ...], witnesses: Array,
) -> Course:  # fmt: skip
    first = targets[0]
    goal = PoseGoal.at("tip", first) if oriented else PositionGoal("tip", first.position)
    return Course(number, make_chain(joints), goal, moves, unit, at, targets, witnesses)


def _lines(number: int, joints: int, seed: int, frames: int | None) -> Course:
    """Straight lines through the tips of random configurations, at an even pace."""
    robot, rng = make_chain(joints), np.random.default_rng([seed, number])
    corners = np.array([robot.forward(robot.sample(rng)).position for _ in range(POINTS)])
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, far[-1], LINE_STEP)[:frames]
    path = np.column_stack([np.interp(at, far, corners[:, k]) for k in range(3)])
    targets = tuple(Pose(point) for point in path)
    witnesses = np.array([chain_witness(joints, target, oriented=False) for target in targets])
    moves = (
        f"straight lines to random points: {POINTS} points where random joint angles put the tip, "
        f"{100 * LINE_STEP:g} cm a frame"
    )
    return _with_goal(number, joints, False, moves, "m", at, targets, witnesses)


def _square(number: int, frames: int | None) -> Course:
    """Two balls: six freedoms and six numbers wanted; goals can only be made from joint angles."""
    robot, at = make_chain(2), _turns(CIRCLE_STEP)[:frames]
    witnesses = np.array([_two_balls(a) for a in at])
    targets = tuple(robot.measure(q) for q in witnesses)
    moves = (
        "not stated: the tip of joint angles that turn about (1,1,0) while the elbow bends from straight "
        f"to {2 * BEND:g}° and back, its axis turning twice as fast; the first and last goal can be met "
        "by the straight chain alone"
    )
    return _with_goal(number, 2, True, moves, "°", at, targets, witnesses)


def _two_balls(at: float) -> Array:
    bend = math.radians(BEND * (1.0 - math.cos(math.radians(at))))
    axis = _turned(Z, 2.0 * at, X)
    return np.concatenate([_about(DIAGONAL, at), rotation_exp(bend * axis)])


def _turns(step: float) -> Array:
    return np.arange(0.0, 360.0 + 0.5 * step, step)


def _circles(number: int, frames: int | None) -> Course:
    degrees, small = _turns(CIRCLE_STEP), _turns(SMALL_STEP)
    diagonal = "about (1,1,0) from the z axis"
    rows: dict[int, tuple[int, bool, str, Array, Callable[[float], Pose]]] = {
        1: (3, False, "circle about the origin in XY", degrees, lambda a: _circle(Z, 1.5 * X, a)),
        2: (5, False, "circle in XY", degrees, lambda a: _circle(Z, 2.5 * X, a)),
        3: (5, True, f"circle in XY, the orientation turning {SLOWNESS:g} times slower about z, from the "
            "last link pointing outwards", degrees, _slow),
        4: (5, False, "circle in XZ", degrees, lambda a: _circle(Y, 2.5 * X, a)),
        5: (5, False, "circle in YZ", degrees, lambda a: _circle(X, 2.5 * Y, a)),
        6: (5, False, f"{diagonal} in {SMALL_STEP:g}° steps", small, lambda a: _circle(DIAGONAL, 2.5 * Z, a)),
        7: (5, True, f"{diagonal} in {SMALL_STEP:g}° steps, the orientation turning as much, from the "
            "last link pointing outwards", small, _along),
        8: (5, True, "fixed at (0, 0, 2.5) m, the orientation turning about (1,1,0)", degrees, _in_place),
        9: (5, False, f"{diagonal} in {LARGE_STEP:g}° steps", _turns(LARGE_STEP),
            lambda a: _circle(DIAGONAL, 2.5 * Z, a)),
        10: (5, True, "on one side of the origin: circle of 1 m about (2, 0, 0) m and the axis (1,1,0), the "
             "orientation turning about (1,-1,1)", degrees, _one_side),
    }  # fmt: skip
    joints, oriented, moves, at, pose = rows[number]
    return _make(number, joints, oriented, moves, at[:frames], pose)


NUMBERS = tuple(range(1, 14))


def make_course(number: int, seed: int = 0, frames: int | None = None) -> Course:
    """A00's test ``number`` (1 … 13).

    Args:
        number: His.
        seed: Draws the points of 11 and 12.
        frames: No more than so many; None: the whole course.
    """
    if number in (11, 12):
        return _lines(number, 3 if number == 11 else 5, seed, frames)
    return _square(number, frames) if number == 13 else _circles(number, frames)
