"""The front door: ``solve``, ``solve_all``, ``solve_batch``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.batch import BatchSolution, solve_batch
from robot_ik.goals import Goal
from robot_ik.problem import Budget, Problem, Tolerance
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import Solver

__all__ = ["BatchSolution", "Branch", "solve", "solve_all", "solve_batch"]

# Branches nearer than this in every joint (rad) are one.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Branch:
    """One of the ways in which an arm can meet a goal.

    Attributes:
        name: The choice made at each fork, such as ``shoulder+ elbow- wrist+``.
        q: (nq,) joint angles; each turned by whole turns to lie inside its limits next to the start.
        inside: Whether all joints are inside their limits.
    """

    name: str
    q: NDArray[np.float64]
    inside: bool


def solve_all(
    robot: Robot, goal: Goal, *, start: ArrayLike | None = None, limits: bool = True
) -> tuple[Branch, ...]:
    """Every way of meeting a goal that the closed form knows, the nearest to ``start`` first.

    At a singular pose one joint angle is free; it is kept as near to ``start`` as can be.

    Args:
        robot: From ``load_robot``.
        goal: A pose for six axes or a limb of seven (each branch at the swivel nearest to ``start``), a
            position for a planar two-link or the wrist's centre of a limb.
        start: (nq,); default home.
        limits: Leave out branches outside the joint limits.

    Raises:
        UnsupportedGoalError: No closed form is known for this robot and goal.
    """
    from robot_ik.solvers.analytic import Analytic

    problem = Problem(robot, goal)
    origin = robot.home if start is None else robot.check_q(start, "start")
    solver = cast(Analytic, make_solver("analytic"))
    found: list[Branch] = []
    for name, q in solver.branches(problem, origin):
        if not any(np.abs(q - other.q).max() < _SAME for other in found):
            found.append(Branch(name, q, not robot.outside(q)))
    ordered = sorted(found, key=lambda b: (not b.inside, float(np.sum((b.q - origin) ** 2))))
    return tuple(b for b in ordered if b.inside or not limits)


def solve(
    robot: Robot,
    goal: Goal | Sequence[Goal],
    *,
    solver: str | Solver = "auto",
    start: ArrayLike | None = None,
    tolerance: Tolerance | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    trace: bool = False,
    **options: Any,
) -> Solution:
    """Joint angles that bring the robot's frames to the goals, inside the joint limits.

    Args:
        robot: From ``load_robot``.
        goal: One goal, or several at once on any frames.
        solver: A name of ``SOLVERS``, ``"auto"``, or a solver instance.
        start: (nq,) where to begin; default ``robot.home``.  The answer tends to stay near it.
        tolerance: Default 0.1 mm and 1 mrad.
        budget: Iterations, seconds, restarts.
        seed: Of the random restarts; the same seed gives bit-equal answers.
        trace: Keep a row for every step in ``solution.trace``.
        **options: Of the solver, by field name.

    Returns:
        A ``Solution``; whether it converged is in its status, never an exception.

    Raises:
        GoalError, UnknownFrameError: The goal makes no sense for this robot.
        UnsupportedGoalError: The solver cannot serve this kind of goal; names those that can.
        UnknownSolverError, ConfigError: No such solver or option.
    """
    method = make_solver(solver, **options)
    problem = Problem(robot, goal, tolerance=tolerance, budget=budget, seed=seed, trace=trace)
    return method.solve(problem, start)
