"""``solve_all``: every solution (branch) with which an arm can meet a goal, where a closed form is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solution import short_numbers
from robot_ik.solvers.analytic import Analytic

# Branches nearer than this in every joint (rad) are one.
_SAME = 1e-6
# rad, m: so far beyond a limit a joint still counts as inside.
_SLACK = 1e-9
# rad, m: so far beyond, it is brought back.  At a singular pose (an arm stretched out, whose elbow has its
# limit there) rounding moves a joint by its own square root, and far less what the joint carries.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Branch:
    """One of the ways in which an arm can meet a goal.

    Attributes:
        name: The choice made at each fork, such as ``shoulder+ elbow- wrist+``.
        q: (nq,) joint angles; each moved by multiples of 2π to lie inside its limits next to the start.
        inside: Whether all joints are inside their limits.
    """

    name: str
    q: NDArray[np.float64]
    inside: bool

    def __repr__(self) -> str:
        return f"Branch({self.name!r}, q={short_numbers(self.q)}, inside={self.inside})"


def solve_all(
    robot: Robot,
    goal: Goal | Pose | NDArray[np.float64],
    *,
    start: ArrayLike | None = None,
    limits: bool = True,
) -> tuple[Branch, ...]:
    """Every branch with which the closed form meets a goal, the nearest to ``start`` first.

    At a singular pose one joint angle is free; it is kept as near to ``start`` as can be.

    Args:
        robot: From ``load_robot``.
        goal: A pose for six axes or a limb of seven (each branch at the swivel nearest to ``start``), a
            position for a planar two-link or the wrist's centre of a limb.  A ``Pose`` or a
            matrix (4, 4) is the tool's.
        start: (nq,); default home.
        limits: Leave out branches outside the joint limits.

    Raises:
        UnsupportedGoalError: No closed form is known for this robot and goal.
    """
    pose = Pose.from_matrix(goal) if isinstance(goal, np.ndarray) else goal
    wanted = PoseGoal.at(None, pose) if isinstance(pose, Pose) else pose
    origin = robot.home if start is None else robot.check_q(start, "start")
    try:
        problem = Problem(robot, wanted, solver="analytic")
    except UnsupportedGoalError as error:
        error.able, error.hint = (), "no other method knows every solution; solve(…) finds one"
        raise
    branches = problem.branches(origin)
    if not branches:
        return ()
    qs = np.array([q for _, q in branches])
    same = np.abs(qs[:, None] - qs).max(axis=2) < _SAME
    far = ((qs - origin) ** 2).sum(axis=1).tolist()
    first = [k for k, row in enumerate(same.tolist()) if row.index(True) == k]
    hinges = robot.nq == robot.nv  # balls and floating bases have limits of their own
    ends = np.clip(qs, robot.lower, robot.upper) if hinges else np.array([robot.clip(q) for q in qs])
    off = np.abs(ends - qs)
    if off.max() > _SLACK:
        qs = np.where(off <= _ROUNDING, ends, qs)
    inside = (np.abs(ends - qs) <= _SLACK).all(axis=1).tolist()
    first.sort(key=lambda k: (not inside[k], far[k]))
    return tuple(Branch(branches[k][0], qs[k], inside=inside[k]) for k in first if inside[k] or not limits)
