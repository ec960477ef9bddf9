"""``solve``, and the problems that it, ``solve_all`` and ``solve_batch`` keep."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from numpy.typing import ArrayLike

from robot_ik.goals import Goal, PoseGoal, Tolerance
from robot_ik.problem import Budget, Problem, checked_goals, goal_kind, require_options
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import Solver

# Kinds of problems that are kept for a robot, and problems of a kind: one for each thread that asks at once.
_KINDS_KEPT, _EACH_KEPT = 16, 8
_BUDGET = Budget()
ORIGIN = (0.0, 0.0, 0.0)


@contextmanager
def borrowed_problem(
    robot: Robot,
    goal: Goal | Sequence[Goal],
    solver: str | Solver,
    options: Mapping[str, Any],
    tolerance: Tolerance | None,
    budget: Budget | None,
    seed: int,
) -> Iterator[tuple[Solver, Problem]]:
    """A method, and a problem for the goals: one that is at hand, or a new one.

    Targets, weights, budget and seed are set each time.  Where something is raised, it is not used again.
    """
    require_options(robot, tolerance, budget, seed)
    goals = checked_goals(goal)
    method = make_solver(solver, **options) if options else solver
    # For each kind of problems those that are idle, with their methods: calls of several threads share none.
    pools = robot.memory.get("problems")
    if pools is None:
        pools = robot.memory.setdefault("problems", functools.lru_cache(_KINDS_KEPT)(lambda *kind: []))
    try:
        pool: list[tuple[Solver, Problem]] = pools(method, tolerance, *map(goal_kind, goals))
    except TypeError:  # a method or goal of somebody's own that cannot be a key
        pool = []
    try:
        pair = pool.pop()
    except IndexError:
        pair = make_solver(method), Problem(robot, goals, tolerance=tolerance, budget=budget, seed=seed)
    else:
        problem = pair[1]
        problem.exchange(goals)
        problem.budget, problem.seed = budget or _BUDGET, int(seed)
    yield pair
    if len(pool) < _EACH_KEPT:
        pool.append(pair)


def warm_up(
    robot: Robot,
    goal: Goal | Sequence[Goal] | None = None,
    *,
    solver: str | Solver = "auto",
    tolerance: Tolerance | None = None,
    **options: Any,
) -> None:
    """Loads, or on a new machine compiles, all that solving such goals may need.

    For loops that must not stall: after it, not even the first goal out of reach does.  The first solve of a
    kind does the same.  Arguments and errors as of ``solve``; of ``goal`` (default: a pose of the tool) only
    kinds and frames matter.
    """
    goals = PoseGoal(None, ORIGIN) if goal is None else goal
    with borrowed_problem(robot, goals, solver, options, tolerance, None, 0) as (method, problem):
        method.load(problem)
        _ = problem.mover


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

    What it compiles for a kind of goal it keeps for the next call with this robot: a loop of calls costs
    little more than one over a ``Problem``.

    Args:
        robot: From ``load_robot``.
        goal: One goal, or several at once on any frames.
        solver: A name of ``SOLVERS``, ``"auto"``, or a solver instance.
        start: (nq,) where to begin; default ``robot.home``.  The solution tends to stay near it.
        tolerance: Default 0.1 mm and 1 mrad.
        budget: Iterations, seconds, restarts.
        seed: Of the random restarts; the same seed gives bit-equal results.
        trace: Keep a row for every step in ``solution.trace``.
        **options: Of the solver, by field name.

    Returns:
        A ``Solution``; whether it converged is in its status, never an exception.

    Raises:
        GoalError, UnknownFrameError: The goal makes no sense for this robot.
        UnsupportedGoalError: The solver cannot serve this kind of goal; names those that can.
        UnknownSolverError, ConfigError: No such solver or option.
    """
    if trace:  # rows for a whole budget are not kept for the next call
        problem = Problem(robot, goal, tolerance=tolerance, budget=budget, seed=seed, trace=True)
        return make_solver(solver, **options).solve(problem, start)
    with borrowed_problem(robot, goal, solver, options, tolerance, budget, seed) as (method, problem):
        return method.solve(problem, start)
