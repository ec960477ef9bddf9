"""The front door: ``solve``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from robot_ik.goals import Goal
from robot_ik.problem import Budget, Problem, Tolerance
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import Solver


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
