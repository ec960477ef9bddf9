"""A00's tests for ``aho_update.py``: starts and goals.

Each chain begins bent on an arc. In tests 1-5 the arc is in the plane of the goal, and all joints
rotate about its normal. In tests 6-10 it is in the XY plane, and the links are along z if all
joints are at zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from aho_update import DIAGONAL, Array, Chain, Frame, Update, X, Y, Z, follow, rotation_matrix


@dataclass(eq=False)
class Course:
    """A start and the goals of one of the tests.

    Attributes:
        link: Axis of the links when all joints are at zero.
        start: Local rotations of the joints.
        at: Angle of each goal in degrees, or its distance in length units for lines.
        goals: One pose for each frame.
        oriented: Whether the goals have an orientation.
    """

    number: int
    link: Array
    start: list[Array]
    at: Array
    goals: list[Frame]
    oriented: bool = False

    def lost_at(self, update: Update) -> float | None:
        """Return the place at which this version of the update lost the goal; None: never."""
        lost, _ = follow(self.chain, self.goals, update, oriented=self.oriented)
        return None if lost is None else float(self.at[lost])

    @property
    def chain(self) -> Chain:
        """The chain at its start."""
        return Chain(self.link, self.start)


def bent(joints: int, link: Array, tip: Array, normal: Array) -> list[Array]:
    """Return local rotations that put the links on an arc to ``tip``, bent about ``normal``.

    The first joint rotates the link's axis to the tip by the smallest angle.
    """
    along = tip / np.linalg.norm(tip)
    across = np.cross(link, along)
    sine = float(np.linalg.norm(across))
    first = (
        rotation_matrix(across / sine, math.degrees(math.atan2(sine, link @ along)))
        if sine > 1e-12
        else np.eye(3)
    )
    bend = math.degrees(arc_joint_angle(joints, float(np.linalg.norm(tip))))
    worlds = [
        np.eye(3),
        *(
            rotation_matrix(normal, 0.5 * bend * (joints - 1 - 2 * k)) @ first
            for k in range(joints)
        ),
    ]
    return [before.T @ after for before, after in pairwise(worlds)]


def arc_joint_angle(links: int, chord: float) -> float:
    """Angle from one link to the next, rad, for which the arc's ends are ``chord`` metres apart."""
    if links == 1:
        if abs(chord - 1.0) > 1e-9:
            raise ValueError(f"one link of 1 m cannot span {chord:.6g} m")
        return 0.0
    if chord > links + 1e-9:
        raise ValueError(f"{links} links of 1 m cannot span {chord:.6g} m")
    low = 0.0
    high = 2.0 * math.pi / links  # from a straight chain to a closed polygon
    for _ in range(54):  # one more halving than a double has bits
        middle = 0.5 * (low + high)
        spanned = (
            math.sin(0.5 * links * middle) / math.sin(0.5 * middle)
            if middle > 0.0
            else float(links)
        )
        low, high = (middle, high) if spanned > chord else (low, middle)
    return 0.5 * (low + high)


def circle(
    number: int,
    joints: int,
    link: Array,
    start: Array,
    axis: Array,
    *,
    normal: Array | None = None,
    step: float = 1.0,
    spin: float | None = None,
    still: bool = False,
    middle: Array | None = None,
) -> Course:
    """A goal on one circle about ``axis``. Its orientation rotates ``spin`` times as fast."""
    rotations = bent(joints, link, start, axis if normal is None else normal)
    tip = np.linalg.multi_dot([np.eye(3), *rotations])
    at = np.arange(0.0, 360.0 + 0.5 * step, step)
    centre = np.zeros(3) if middle is None else middle
    goals = [
        (
            start if still else centre + rotation_matrix(axis, a) @ (start - centre),
            rotation_matrix(axis, (spin or 0.0) * a) @ tip,
        )
        for a in at
    ]
    return Course(number, link, rotations, at, goals, spin is not None)


def lines(number: int, joints: int) -> Course:
    """Straight lines through ten random points, 0.02 units a frame."""
    rng = np.random.default_rng(number)
    corners: list[Array] = []
    while len(corners) < 10:
        point = rng.uniform(-joints, joints, 3)
        if np.linalg.norm(point) < 0.8 * joints:
            corners.append(point)
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, far[-1], 0.02)
    path = np.column_stack([np.interp(at, far, np.array(corners)[:, k]) for k in range(3)])
    normal = np.cross(corners[0], Y)
    rotations = bent(joints, Z, corners[0], normal / np.linalg.norm(normal))
    return Course(number, Z, rotations, at, [(point, np.eye(3)) for point in path])


def square() -> Course:
    """Return test 13: two balls rotate about (1,1,0), the elbow bends from 30° to 90° and back."""
    at = np.arange(0.0, 361.0)
    goals = []
    start = []
    for a in at:
        elbow = rotation_matrix(X, 60.0 - 30.0 * math.cos(math.radians(a)))
        rotations = [rotation_matrix(DIAGONAL, a), elbow]
        start = start or rotations
        goals.append(((rotations[0] + rotations[0] @ elbow) @ Z, rotations[0] @ elbow))
    return Course(13, Z, start, at, goals, oriented=True)


def course(number: int) -> Course:
    """Return a test of the thesis by its number."""
    far = 2.5
    near = 1.5
    diagonal = {"joints": 5, "link": Z, "start": far * X, "axis": DIAGONAL, "normal": Z}
    rows = {
        1: lambda: circle(1, 3, X, near * X, Z),
        2: lambda: circle(2, 5, X, far * X, Z),
        3: lambda: circle(3, 5, X, far * X, Z, spin=0.25),
        4: lambda: circle(4, 5, X, far * X, Y),
        5: lambda: circle(5, 5, Z, far * Z, X),
        6: lambda: circle(6, **diagonal, step=0.1),
        7: lambda: circle(7, **diagonal, step=0.1, spin=1.0),
        8: lambda: circle(8, **diagonal, spin=1.0, still=True),
        9: lambda: circle(9, **diagonal, step=5.0),
        10: lambda: circle(10, **diagonal, spin=1.0, middle=(far - 1.0) * X),
        11: lambda: lines(11, 3),
        12: lambda: lines(12, 5),
        13: square,
    }
    return rows[number]()


STARTS = {
    "links z, from x, bent in XY": (Z, X, Z),
    "links z, from z, bent in XZ": (Z, Z, Y),
    "links z, from z, bent in YZ": (Z, Z, X),
    "links x, from x, bent in XY": (X, X, Z),
    "links x, from x, bent in XZ": (X, X, Y),
    "links x, from z, bent in XZ": (X, Z, Y),
    "links x, from z, bent in YZ": (X, Z, X),
}
"""Starts of test 6: axis of the links at zero, direction of the goal, normal of the plane."""


def start_of_six(name: str, step: float = 0.1) -> Course:
    """Test 6 from another start."""
    link, start, normal = STARTS[name]
    return circle(6, 5, link, 2.5 * start, DIAGONAL, normal=normal, step=step)
