"""Several methods, one after the other: the first that reaches the goal wins, else the best of all is kept.

A00's fallback (a recursive solver where the Jacobian failed), generalised.  ``auto`` is the closed form
where there is one, then Levenberg-Marquardt.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import ConfigError
from robot_ik.kernels import jit
from robot_ik.kernels import workspace as ws
from robot_ik.kernels.bundle import address_of
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.kinematics import forward
from robot_ik.kernels.residuals import evaluate, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.legacy_problem import LegacyProblem as Problem, Budget # Budget, Problem
from robot_ik.solution import Solution, Status
from robot_ik.solvers import make_solver
from robot_ik.solvers.legacy_base import BatchResult, Solver, option, take_start

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Combined(Solver):
    """Tries methods in the order given; each starts from the same start."""

    methods: str = option("analytic lm", "names of methods, in the order in which they are tried")

    name: ClassVar[str] = "combined"
    title: ClassVar[str] = "methods in turn, until one reaches the goal"
    source: ClassVar[str] = "Aho 2000, generalised"

    partial_goals: ClassVar[bool] = True
    # Those of its methods that can.
    capabilities: ClassVar[frozenset[str]] = frozenset({"couplings", "priorities", "soft", "stiffness"})

    @cached_property
    def _members(self) -> tuple[Solver, ...]:
        names = self.methods.replace(",", " ").split()
        if not names or any(name in ("combined", "auto") for name in names):
            raise ConfigError(
                f"{self.methods!r}", file=f"solver {self.name}", key="methods",
                allowed="names of single methods, separated by spaces",
            )  # fmt: skip
        return tuple(make_solver(name) for name in names)

    def unsupported(self, problem: Problem) -> str:
        lacking = [member.unsupported(problem) for member in self._members]
        return lacking[0] if all(lacking) else ""

    def make(self, problem: Problem) -> _Sequences:
        """The methods that can try a problem; and those where its start may be near its goal.

        All are loaded before the first is tried: the first goal that it misses would else stall a loop.
        """
        members, near = self._sequences(problem)
        for member in (*members, *(near.members if near else ())):
            member.load(problem)
        return members, near

    def _sequences(self, problem: Problem) -> _Sequences:
        return tuple(member for member in self._members if member.applies(problem)), None

    def attempt(self, problem: Problem, start: ArrayLike | None, budget: Budget) -> Solution:
        # The hot loop, as in ``IterativeSolver.attempt``: each line counts.
        kept = problem.made.get(id(self))
        sequences: _Sequences = self.load(problem) if kept is None else kept[1]
        members, near = sequences
        if near is not None and budget.iterations:
            begin = near.start
            if type(start) is np.ndarray and start.shape == begin.shape:
                begin[...] = start  # whether it is finite, the method asks: nothing is near that is not
            else:
                take_start(problem, start)
            if near.holds(near.address):
                members = near.members
            start = begin
        solution = members[0].attempt(problem, start, budget)
        if solution.status is _CONVERGED:
            return solution
        return self._go_on(solution, members, problem, start, budget)

    def _go_on(
        self,
        best: Solution,
        members: tuple[Solver, ...],
        problem: Problem,
        start: ArrayLike | None,
        budget: Budget,
    ) -> Solution:
        """The other methods, after the first has failed with ``best``; what all of them took is reported."""
        if len(members) == 1:
            return best
        if best.status is Status.UNREACHABLE and members[0].name == members[-1].name:
            return best  # proven, and the nearest is found: the last would do the same
        began = time.perf_counter() - best.seconds
        iterations, restarts = best.iterations, best.restarts
        rows = [] if best.trace_rows is None else [best.trace_rows]
        last, proven = best.status, best.status is Status.UNREACHABLE
        best_cost = float(problem.arrays["value"][ws.BEST_COST])
        for member in members[1:]:
            futile = proven and len(problem.given) == 1  # of several goals the others may be searched for
            rest = _rest(budget, iterations, restarts, time.perf_counter() - began, futile)
            solution = member.attempt(problem, start, rest)
            if solution.trace_rows is not None:
                solution.trace_rows[:, :2] += iterations, restarts
                rows.append(solution.trace_rows)
            iterations, restarts = iterations + solution.iterations, restarts + solution.restarts
            last, proven = solution.status, proven or solution.status is Status.UNREACHABLE
            cost = float(problem.arrays["value"][ws.BEST_COST])
            if solution.converged or cost < best_cost:
                best, best_cost = solution, cost
            if solution.converged:
                break
        if not best.converged:
            best.status = Status.UNREACHABLE if proven else last if last in _OVER else best.status
        best.trace_rows = np.concatenate(rows) if rows else None
        best.iterations, best.restarts = iterations, restarts
        best.seconds = time.perf_counter() - began
        return best

    def attempt_many(
        self, problem: Problem, targets: Array, starts: Array, results: BatchResult, budget: Budget
    ) -> None:
        """Each method takes all poses that the ones before it missed, with what they left of the budget."""
        if budget.seconds is not None:  # which is for each pose: only Python can read a clock
            super().attempt_many(problem, targets, starts, results, budget)
            return
        sequences: _Sequences = self.load(problem)
        members, near = sequences
        if near is not None and budget.iterations:
            marks = np.zeros(len(targets), dtype=np.int64)
            starts_near_many(near.address, targets, starts, marks)
            count = np.count_nonzero(marks)
            if 0 < count < len(marks):
                for some, here in ((members, marks == 0), (near.members, marks == 1)):
                    part = BatchResult.empty(int(here.sum()), results.q.shape[1])
                    self._run_sequence_many(some, problem, targets[here], starts[here], part, budget)
                    for item in fields(BatchResult):
                        getattr(results, item.name)[here] = getattr(part, item.name)
                return
            members = near.members if count else members
        self._run_sequence_many(members, problem, targets, starts, results, budget)

    def _run_sequence_many(
        self,
        members: tuple[Solver, ...],
        problem: Problem,
        targets: Array,
        starts: Array,
        results: BatchResult,
        budget: Budget,
    ) -> None:
        members[0].attempt_many(problem, targets, starts, results, budget)
        if np.count_nonzero(results.status == ws.CONVERGED) == len(targets):
            return
        left = np.flatnonzero(results.status != ws.CONVERGED)
        if members[0].name == members[-1].name:
            left = left[results.status[left] != Status.UNREACHABLE]
        if not len(left) or len(members) == 1:
            return
        best = _cost(problem, results.miss)
        last, proven = results.status.copy(), results.status == Status.UNREACHABLE
        for member in members[1:]:
            for rows, rest in _shares(budget, left, results, proven):
                part = BatchResult.empty(len(rows), results.q.shape[1])
                member.attempt_many(problem, targets[rows], starts[rows], part, rest)
                cost = _cost(problem, part.miss)
                cost[part.status == Status.CONVERGED] = -1.0
                better = cost < best[rows]
                best[rows[better]] = cost[better]
                for name in ("q", "miss", "status"):
                    getattr(results, name)[rows[better]] = getattr(part, name)[better]
                results.iterations[rows] += part.iterations
                results.restarts[rows] += part.restarts
                proven[rows] |= part.status == Status.UNREACHABLE
                last[rows] = part.status
            left = left[results.status[left] != Status.CONVERGED]
        for status in _OVER:
            results.status[left[last[left] == status]] = status
        results.status[left[proven[left]]] = Status.UNREACHABLE


# Asked in each solve: an enumeration takes a tenth of a microsecond to give it.
_CONVERGED = Status.CONVERGED
# A method that ends so was stopped: it has not failed, nor have all of them together.
_OVER = (Status.ITERATION_LIMIT, Status.TIME_LIMIT)


@dataclass(frozen=True, eq=False)
class _StartNear:
    """The methods that try a problem whose start is near its goal."""

    members: tuple[Solver, ...]
    holds: Callable[[int], bool]  # whether it is: ``starts_near``
    address: int  # of ``table``, which it takes
    table: NDArray[np.int64]
    start: Array  # (nq,) in the work space


_Sequences = tuple[tuple[Solver, ...], _StartNear | None]


def _rest(budget: Budget, iterations: int, restarts: int, seconds: float, proven: bool) -> Budget:
    """What is left of a budget.  Once it is proven that no joint angles do, restarts are of no use."""
    spare = None if budget.restarts is None else max(0, budget.restarts - restarts)
    return Budget(
        iterations=max(0, budget.iterations - iterations),
        seconds=None if budget.seconds is None else max(0.0, budget.seconds - seconds),
        restarts=0 if proven else spare,
    )


def _shares(
    budget: Budget, left: Rows, results: BatchResult, proven: NDArray[np.bool_]
) -> Iterator[tuple[Rows, Budget]]:
    """Those of the rows ``left`` (n,) that have the same rest of the budget, and that rest."""
    if not len(left):
        return
    spent = np.column_stack([results.iterations[left], results.restarts[left], proven[left]])
    if (spent == spent[0]).all():
        yield left, _rest(budget, int(spent[0, 0]), int(spent[0, 1]), 0.0, bool(spent[0, 2]))
        return
    kinds, group = np.unique(spent, axis=0, return_inverse=True)
    for k, (iterations, restarts, known) in enumerate(kinds.tolist()):
        yield left[group.ravel() == k], _rest(budget, iterations, restarts, 0.0, bool(known))


def _cost(problem: Problem, miss: Array) -> Array:
    """Weighted squares of misses (n, 2), as the solvers weigh them."""
    weight = problem.weights[0]
    return np.asarray((miss[:, 0] * weight[0]) ** 2 + (miss[:, 1] * weight[1]) ** 2)


# A start with half the squared residual (rad²) below this is near its goal: ``lm`` takes a few steps.
_NEAR = 0.01


@kernel
def starts_near(run):
    """Whether work.start is near the goal; changes work space only."""
    run = ws.open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), ws.open_work(run.work)
    forward(tree, work.nodes, work.start, work.world, work.scratch)
    cost, _ = evaluate(tree, goal, work)
    return cost < _NEAR


@kernel
def starts_near_many(run, targets, starts, near):
    """The same for each row of targets (n, 12) of the one goal, and starts (n, nq): 1 or 0 into near (n,)."""
    run = ws.open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), ws.open_work(run.work)
    for row in range(targets.shape[0]):
        same = row > 0  # as the start before it, mostly: its pose is known
        for i in range(starts.shape[1]):
            same = same and starts[row, i] == work.start[i]
            work.start[i] = starts[row, i]
        if not same:
            forward(tree, work.nodes, work.start, work.world, work.scratch)
        for i in range(12):
            goal.target[0, i] = targets[row, i]
        cost, _ = evaluate(tree, goal, work)
        near[row] = 1 if cost < _NEAR else 0


# Which method ``auto`` asks first, by the arm's closed form and by whether the start is near the goal; what
# is missing is left to the closed form.  Measured by ``python docs/make/measure_first_choice.py``; nothing is
# timed when a goal is solved.
FIRST_CHOICE: dict[tuple[str, str], str] = {
    ("limb", "cold"): "lm",
    ("limb", "warm"): "lm",
    ("spherical_wrist", "cold"): "analytic",
    ("spherical_wrist", "warm"): "lm",
    ("three_parallel", "cold"): "analytic",
    ("three_parallel", "warm"): "lm",
}
# Restarts of ``lm`` where it comes before the closed form, which knows what cannot be reached.
_FEW_RESTARTS = 8


@dataclass(frozen=True)
class Auto(Combined):
    """The closed form where this robot and goal have one, else Levenberg-Marquardt; the quicker one first."""

    name: ClassVar[str] = "auto"
    title: ClassVar[str] = "closed form where there is one, else Levenberg-Marquardt"

    @cached_property
    def _quick(self) -> Solver:
        """``lm`` before the closed form."""
        return make_solver("lm", restarts=_FEW_RESTARTS)

    @cached_property
    def _local(self) -> Solver:
        """``lm`` from a start near the goal."""
        return make_solver("lm", restarts=0)

    def _sequences(self, problem: Problem) -> _Sequences:
        members, _ = super()._sequences(problem)
        if [member.name for member in members] != ["analytic", "lm"]:
            return members, None
        family = members[0].load(problem).form.family.name.lower()
        if FIRST_CHOICE.get((family, "cold")) == "lm":
            return (self._quick, *members), None
        if FIRST_CHOICE.get((family, "warm")) != "lm":
            return members, None
        table = problem.run_table(np.zeros(0))
        address = address_of(table)
        holds = jit.entry(starts_near, address)
        local = self._local, *members
        return members, _StartNear(local, holds, address, table, problem.arrays["start"])
