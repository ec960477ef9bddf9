"""``solve_all``: every solution (branch) of a goal, for arms with a closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.problem import Problem
from robot_ik.robot import Robot, require_robot
from robot_ik.solution import short_numbers
from robot_ik.solvers.analytic import SERVED

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
    """

    name: str
    q: NDArray[np.float64]
    inside: bool
    angle: float = 0.0
    angle_bound: float = 0.0

    def __repr__(self) -> str:
        return f"Branch({self.name!r}, q={short_numbers(self.q)}, inside={self.inside})"


def solve_all(
    robot: Robot,
    goal: Goal | Pose | ArrayLike,
    *,
    start: ArrayLike | None = None,
    limits: bool = True,
) -> tuple[Branch, ...]:
    """Return every branch with which the closed form meets a goal, nearest to ``start`` first.

    It serves arms of two parallel hinges for a position, arms of five hinges (pan, three parallel
    pitch axes, roll) for a pose, and arms of six hinges with a spherical wrist or shoulder, or with
    three parallel axes, for a pose. At a singular pose one joint angle
    is free; it stays as near to ``start`` as possible.

    An arm of five joints meets a position in infinitely many ways and a pose almost never. Each of
    its up to four branches has the best orientation at the position, and the smallest angle comes
    first.

    Args:
        robot: From ``load_robot``.
        goal: A pose goal, or a position goal for a planar arm. A ``Pose``, a matrix (4, 4) or a
            position (3,) is a goal of the tool.
        start: (nq,); default home.
        limits: Leave out branches outside the joint limits.

    Raises:
        UnsupportedGoalError: No closed form is known for this robot and goal.
    """
    require_robot(robot)
    origin = robot.home if start is None else robot.check_q(start, "start")
    try:
        problem = Problem(robot, goal, solver="analytic")
    except UnsupportedGoalError as error:
        error.able = ()
        error.hint = f"solve_all serves {SERVED}; solve(…) finds one solution for any arm"
        raise
    branches = problem.branches(origin)
    if not branches:
        return ()
    qs = np.array([branch.q for branch in branches])
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
    first.sort(key=lambda k: (not inside[k], round(branches[k].angle / _EQUAL_ANGLE), far[k]))
    return tuple(
        Branch(branches[k].name, qs[k], inside[k], branches[k].angle, branches[k].angle_bound)
        for k in first
        if inside[k] or not limits
    )
