"""The front door: ``solve``, ``solve_all``, and the problems that they and ``batch`` keep."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, Tolerance
from robot_ik.problem import Budget, Problem, checked_goals, goal_kind, require_options
from robot_ik.robot import Robot
from robot_ik.solution import Solution, short_numbers
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import Solver

Array = NDArray[np.float64]

# Branches nearer than this in every joint (rad) are one.
_SAME = 1e-6
# rad, m: so far beyond a limit a joint still counts as inside.
_SLACK = 1e-9
# Kinds of problems that are kept for a robot, and problems of a kind: one for each thread that asks at once.
_KINDS_KEPT, _EACH_KEPT = 16, 8
_BUDGET = Budget()
ORIGIN = (0.0, 0.0, 0.0)


class _Shelf:
    """Compiled problems of one kind that wait for their next use, each with its method."""

    __slots__ = ("idle", "used")

    def __init__(self) -> None:
        self.idle: list[tuple[Solver, Problem]] = []
        self.used = 0


class _Shelves:
    """The problems that were compiled for one robot, by their kind; of too many the oldest goes.

    A problem is on its shelf or in one call's hands: calls of several threads never meet in one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shelves: dict[Hashable, _Shelf] = {}
        self._uses = itertools.count(1)

    def __getitem__(self, kind: Hashable) -> _Shelf:
        shelf = self._shelves.get(kind)
        if shelf is None:
            with self._lock:
                while len(self._shelves) >= _KINDS_KEPT:
                    del self._shelves[min(self._shelves, key=lambda k: self._shelves[k].used)]
                shelf = self._shelves.setdefault(kind, _Shelf())
        shelf.used = next(self._uses)
        return shelf


@contextmanager
def lent(
    robot: Robot,
    goal: Goal | Sequence[Goal],
    solver: str | Solver,
    options: Mapping[str, Any],
    tolerance: Tolerance | None,
    budget: Budget | None,
    seed: int,
) -> Iterator[tuple[Solver, Problem]]:
    """A method, and a problem for the goals: one that is at hand, or a new one.

    Targets, weights, budget and seed are set each time, and answers are not remembered.  A problem in whose
    use something is raised is not used again.
    """
    require_options(robot, tolerance, budget, seed)
    goals = checked_goals(goal)
    method = make_solver(solver, **options) if options else solver
    shelves: _Shelves | None = robot.memory.get("problems")
    if shelves is None:
        shelves = robot.memory.setdefault("problems", _Shelves())
    try:
        shelf = shelves[method, tolerance, tuple(map(goal_kind, goals))]
    except TypeError:  # a method or goal of somebody's own that cannot be a key
        shelf = _Shelf()
    try:
        lent = shelf.idle.pop()
    except IndexError:
        lent = make_solver(method), Problem(robot, goals, tolerance=tolerance, budget=budget, seed=seed)
    else:
        problem = lent[1]
        problem.exchange(goals)
        problem.budget, problem.seed = budget or _BUDGET, int(seed)
    yield lent
    if len(shelf.idle) < _EACH_KEPT:
        shelf.idle.append(lent)


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
    kind does the same.

    Args:
        robot: From ``load_robot``.
        goal: One goal or several at once, as the loop will ask for them; only their kinds and frames matter.
            Default: a pose of the tool.
        solver: As in ``solve``.
        tolerance: As in ``solve``.
        **options: As in ``solve``.

    Raises:
        As ``solve``.
    """
    goals = PoseGoal(None, ORIGIN) if goal is None else goal
    with lent(robot, goals, solver, options, tolerance, None, 0) as (method, problem):
        method.load(problem)
        _ = problem.mover


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

    def __repr__(self) -> str:
        return f"Branch({self.name!r}, q={short_numbers(self.q)}, inside={self.inside})"


Branches = tuple[Branch, ...]


@overload
def solve_all(
    robot: Robot, goal: Goal | Pose, *, start: ArrayLike | None = None, limits: bool = True
) -> Branches: ...


@overload
def solve_all(
    robot: Robot, goal: Sequence[Goal | Pose], *, start: ArrayLike | None = None, limits: bool = True
) -> tuple[Branches, ...]: ...


@overload
def solve_all(
    robot: Robot, goal: NDArray[np.float64], *, start: ArrayLike | None = None, limits: bool = True
) -> Branches | tuple[Branches, ...]: ...


def solve_all(
    robot: Robot,
    goal: Goal | Pose | NDArray[np.float64] | Sequence[Goal | Pose],
    *,
    start: ArrayLike | None = None,
    limits: bool = True,
) -> Branches | tuple[Branches, ...]:
    """Every way of meeting a goal that the closed form knows, the nearest to ``start`` first.

    At a singular pose one joint angle is free; it is kept as near to ``start`` as can be.

    Args:
        robot: From ``load_robot``.
        goal: A pose for six axes or a limb of seven (each branch at the swivel nearest to ``start``), a
            position for a planar two-link or the wrist's centre of a limb.  A ``Pose`` or a
            matrix (4, 4) is the tool's.  Of a list, or of matrices (n, 4, 4), each on its own.
        start: (nq,); default home.
        limits: Leave out branches outside the joint limits.

    Returns:
        The branches; for a list, those of each.

    Raises:
        UnsupportedGoalError: No closed form is known for this robot and goal.
    """
    if isinstance(goal, Goal | Pose) or (isinstance(goal, np.ndarray) and goal.ndim == 2):
        return _branches(robot, goal, start, limits)
    return tuple(_branches(robot, one, start, limits) for one in goal)


def _branches(
    robot: Robot, goal: Goal | Pose | NDArray[np.float64], start: ArrayLike | None, limits: bool
) -> Branches:
    """``solve_all`` for one."""
    from robot_ik.solvers.analytic import Analytic

    wanted = goal if isinstance(goal, Goal) else PoseGoal.at(None, _pose_of(goal))
    with lent(robot, wanted, "analytic", {}, None, None, 0) as (solver, problem):
        origin = robot.home if start is None else robot.check_q(start, "start")
        branches = cast(Analytic, solver).branches(problem, origin)
    if not branches:
        return ()
    qs = np.array([q for _, q in branches])
    same = np.abs(qs[:, None] - qs).max(axis=2) < _SAME
    far = ((qs - origin) ** 2).sum(axis=1).tolist()
    first = [k for k, row in enumerate(same.tolist()) if row.index(True) == k]
    inside = _inside(robot, qs)
    found = [(far[k], Branch(*branches[k], inside=inside[k])) for k in first]
    ordered = sorted(found, key=lambda one: (not one[1].inside, one[0]))
    return tuple(branch for _, branch in ordered if branch.inside or not limits)


def _inside(robot: Robot, qs: NDArray[np.float64]) -> list[bool]:
    """Which rows of ``qs`` (n, nq) are inside the limits, as ``Robot.outside`` has it."""
    if robot.nq > robot.nv:  # balls and floating bases have limits of their own
        return [not robot.outside(q) for q in qs]
    near = (qs >= robot.lower - _SLACK) & (qs <= robot.upper + _SLACK)
    return cast(list[bool], near.all(axis=1).tolist())


def _pose_of(pose: Pose | NDArray[np.float64]) -> Pose:
    return pose if isinstance(pose, Pose) else Pose.from_matrix(pose)


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
    if trace:  # rows for a whole budget are not kept for the next call
        problem = Problem(robot, goal, tolerance=tolerance, budget=budget, seed=seed, trace=True)
        return make_solver(solver, **options).solve(problem, start)
    with lent(robot, goal, solver, options, tolerance, budget, seed) as (method, problem):
        return method.solve(problem, start)
