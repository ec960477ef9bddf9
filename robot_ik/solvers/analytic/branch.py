"""``Branch``: one solution of a goal, for arms with a closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.collision.scene import Clearance
from robot_ik.geometry import Array
from robot_ik.robot import Robot
from robot_ik.solution import short_numbers
from robot_ik.solvers.base import FoundBranch

# Branches that differ by less than this in every joint, rad, are the same branch.
_SAME = 1e-6
# Branches whose angles differ by less than this, rad, are ordered by their distance from the start.
_EQUAL_ANGLE = 1.5e-4
# Distance beyond a limit at which a joint still counts as inside, rad or m.
_SLACK = 1e-9
# Distance beyond a limit within which a joint is moved back to the limit, rad or m. At a singular
# pose, such as a stretched elbow at its limit, a rounding error moves the joint by its square root,
# which moves the frame far less.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Branch:
    """One solution of a goal.

    Attributes:
        name: The choice made at each fork, such as ``shoulder+ elbow- wrist+``.
        q: (nq,) joint angles. Multiples of 2π bring each into its limits, near the start.
        inside: Whether all joints are inside their limits.
        angle: Radians between its orientation and the wanted one. 0 except for five joints.
        angle_bound: No configuration of this branch has a smaller angle.
        clearance: The nearest pair of parts, by MuJoCo; None without a condition on collisions.
        free: Whether the clearance is at least the margin; True without a condition on collisions.
    """

    name: str
    q: NDArray[np.float64]
    inside: bool
    angle: float = 0.0
    angle_bound: float = 0.0
    clearance: Clearance | None = None
    free: bool = True

    def __repr__(self) -> str:
        clearance = "" if self.clearance is None else f", {self.clearance!r}"
        return f"Branch({self.name!r}, q={short_numbers(self.q)}, inside={self.inside}{clearance})"


def listed_branches(
    robot: Robot, found: Sequence[FoundBranch], origin: Array, *, limits: bool
) -> tuple[Branch, ...]:
    """Return different branches in order: inside the limits, least angle, nearest to ``origin``.

    Args:
        robot: The robot.
        found: The branches of the closed form.
        origin: Joint angles (nq,).
        limits: Leave out branches outside the joint limits.
    """
    if not found:
        return ()
    qs = np.array([branch.q for branch in found])
    same = np.abs(qs[:, None] - qs).max(axis=2) < _SAME
    far = ((qs - origin) ** 2).sum(axis=1).tolist()
    first = [k for k, row in enumerate(same.tolist()) if row.index(True) == k]
    hinges = robot.nq == robot.nv  # balls and floating bases have limits of their own
    ends = (
        np.clip(qs, robot.lower, robot.upper) if hinges else np.array([robot.clip(q) for q in qs])
    )
    off = np.abs(ends - qs)
    if off.max() > _SLACK:
        qs = np.where(off <= _ROUNDING, ends, qs)
    inside = (np.abs(ends - qs) <= _SLACK).all(axis=1).tolist()
    first.sort(key=lambda k: (not inside[k], round(found[k].angle / _EQUAL_ANGLE), far[k]))
    return tuple(
        Branch(found[k].name, qs[k], inside[k], found[k].angle, found[k].angle_bound)
        for k in first
        if inside[k] or not limits
    )
