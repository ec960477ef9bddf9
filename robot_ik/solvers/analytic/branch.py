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
        name: The solution taken at each choice, such as ``shoulder+ elbow- wrist+``.
        q: (nq,) joint angles, rad. Each is shifted by a multiple of 2π into its limits, near the
            start.
        inside: Whether all joints are inside their limits.
        angle: Angle between its orientation and the target, rad. 0 except for arms with five
            joints.
        angle_bound: Lower bound of the angle of all configurations of this branch, rad.
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
    robot: Robot, branches: Sequence[FoundBranch], origin: Array, *, limits: bool
) -> tuple[Branch, ...]:
    """Return the different branches in order of preference.

    Branches inside the limits are first, then those with a smaller angle, then those nearer to
    ``origin``.

    Args:
        robot: The robot.
        branches: The branches of the closed form.
        origin: Joint angles (nq,).
        limits: Leave out branches outside the joint limits.
    """
    if not branches:
        return ()
    qs = np.array([branch.q for branch in branches])
    same = np.abs(qs[:, None] - qs).max(axis=2) < _SAME
    square_distance = ((qs - origin) ** 2).sum(axis=1).tolist()
    distinct = [k for k, row in enumerate(same.tolist()) if row.index(True) == k]
    is_scalar = robot.nq == robot.nv  # other joints need robot.clip
    clipped = (
        np.clip(qs, robot.lower, robot.upper)
        if is_scalar
        else np.array([robot.clip(q) for q in qs])
    )
    excess = np.abs(clipped - qs)
    if excess.max() > _SLACK:
        qs = np.where(excess <= _ROUNDING, clipped, qs)
    inside = (np.abs(clipped - qs) <= _SLACK).all(axis=1).tolist()
    distinct.sort(
        key=lambda k: (not inside[k], round(branches[k].angle / _EQUAL_ANGLE), square_distance[k])
    )
    return tuple(
        Branch(branches[k].name, qs[k], inside[k], branches[k].angle, branches[k].angle_bound)
        for k in distinct
        if inside[k] or not limits
    )
