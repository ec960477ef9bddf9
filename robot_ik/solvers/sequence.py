"""``PreparedSequence``: prepared methods that are tried in turn.

The first attempt that converges ends the solve. Else a solution with a proven bound of the angle is
kept, or the solution with the lowest cost. All attempts share one budget, and the solution reports
the steps, restarts and time of all of them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_ik.budget import Budget
from robot_ik.geometry import Array
from robot_ik.solution import Solution, Status
from robot_ik.solvers.base import BatchResult, Ints, Prepared

if TYPE_CHECKING:
    from robot_ik.problem import Problem

_CONVERGED = Status.CONVERGED
# Statuses of a method that a budget stopped.
_STOPPED = (Status.ITERATION_LIMIT, Status.TIME_LIMIT)


@dataclass(frozen=True)
class _Progress:
    """The budget used and the best result of the attempts so far."""

    best: Solution
    best_cost: float
    iterations: int
    restarts: int
    unreachable: bool  # proven
    last: Status

    @classmethod
    def of(cls, solution: Solution, cost: float) -> _Progress:
        unreachable = solution.status is Status.UNREACHABLE
        return cls(
            solution, cost, solution.iterations, solution.restarts, unreachable, solution.status
        )

    def after(self, solution: Solution, cost: float) -> _Progress:
        """Return the progress after one more attempt."""
        lower_cost = cost < self.best_cost and self.best.angle_bound is None
        improved = solution.converged or solution.angle_bound is not None or lower_cost
        return _Progress(
            best=solution if improved else self.best,
            best_cost=cost if improved else self.best_cost,
            iterations=self.iterations + solution.iterations,
            restarts=self.restarts + solution.restarts,
            unreachable=self.unreachable or solution.status is Status.UNREACHABLE,
            last=solution.status,
        )

    def status(self) -> Status:
        if self.best.converged:
            return _CONVERGED
        if self.unreachable:
            return Status.UNREACHABLE
        return self.last if self.last in _STOPPED else self.best.status


class PreparedSequence:
    """Prepared methods, tried in turn.

    Args:
        name: Key of the solver in ``SOLVERS``.
        problem: The problem for which the methods are prepared.
        attempts: The methods, in their order.
        hand_over: Each method starts from the best q of the methods before it, not from the start
            of the solve. All but the last make no random restarts.
    """

    def __init__(
        self,
        name: str,
        problem: Problem,
        attempts: Sequence[Prepared],
        *,
        hand_over: bool = False,
    ) -> None:
        self.name = name
        self._search = problem.search
        self._start = problem.search.arrays["start"]
        self._weight = problem.compiled.block.arrays["weight"][0]
        self._attempts = attempts
        self.proves_best = any(attempt.proves_best for attempt in attempts)
        self._hand_over = hand_over and len(attempts) > 1

    def run(self, problem: Problem, budget: Budget) -> Solution:
        """Solve with the first attempt that converges."""
        return self._run(problem, self._attempts, budget)

    def _run(self, problem: Problem, attempts: Sequence[Prepared], budget: Budget) -> Solution:
        first_budget = replace(budget, restarts=0) if self._hand_over else budget
        solution = attempts[0].run(problem, first_budget)
        if solution.status is _CONVERGED:
            return solution
        return self._continue(problem, solution, attempts, budget)

    def _continue(
        self, problem: Problem, first: Solution, attempts: Sequence[Prepared], budget: Budget
    ) -> Solution:
        """Try the other methods after ``first`` has failed, within the remaining budget."""
        if is_proven_best(attempts[0], first):
            return first
        if first.status is Status.UNREACHABLE and not self._later_improves(attempts):
            return first
        began = time.perf_counter() - first.seconds
        traces = [] if first.trace_rows is None else [first.trace_rows]
        progress = _Progress.of(first, self._search["best_cost"])
        one_goal = len(problem.parts) == 1
        for attempt in attempts[1:]:
            seconds = time.perf_counter() - began
            futile = progress.unreachable and one_goal  # other goals may still be met
            if self._hand_over:
                self._start[...] = progress.best.q
                futile = futile or attempt is not attempts[-1]
            rest = remaining(budget, progress.iterations, progress.restarts, seconds, futile)
            solution = attempt.run(problem, rest)
            if solution.trace_rows is not None:
                solution.trace_rows[:, 0] += progress.iterations
                solution.trace_rows[:, 1] += progress.restarts
                traces.append(solution.trace_rows)
            progress = progress.after(solution, self._search["best_cost"])
            if is_proven_best(attempt, solution):
                return self._total(solution, progress, traces, began)
            if solution.converged:
                break
        return self._total(progress.best, progress, traces, began)

    @staticmethod
    def _total(
        best: Solution, progress: _Progress, traces: Sequence[Array], began: float
    ) -> Solution:
        """Return ``best`` with the status, steps and time of all attempts."""
        best.status = progress.status()
        best.iterations = progress.iterations
        best.restarts = progress.restarts
        best.trace_rows = np.concatenate(traces) if traces else None
        best.seconds = time.perf_counter() - began
        return best

    def run_many(
        self,
        problem: Problem,
        targets: Array,
        starts: Array,
        results: BatchResult,
        budget: Budget,
    ) -> None:
        """Run each attempt on all poses that the earlier attempts did not reach."""
        self._run_attempts(problem, self._attempts, targets, starts, results, budget)

    def _run_attempts(
        self,
        problem: Problem,
        attempts: Sequence[Prepared],
        targets: Array,
        starts: Array,
        results: BatchResult,
        budget: Budget,
    ) -> None:
        first_budget = replace(budget, restarts=0) if self._hand_over else budget
        attempts[0].run_many(problem, targets, starts, results, first_budget)
        best_cost = self._costs(results)
        unreachable = results.status == Status.UNREACHABLE
        last = results.status.copy()
        open_rows = np.flatnonzero((results.status != _CONVERGED) & ~proven_best(results))
        if not self._later_improves(attempts):
            open_rows = open_rows[~unreachable[open_rows]]
        for attempt in attempts[1:]:
            futile = unreachable | (self._hand_over and attempt is not attempts[-1])
            for rows, rest in shares(budget, open_rows, results, futile):
                part = BatchResult.empty(len(rows), results.q.shape[1])
                begin = results.q[rows] if self._hand_over else starts[rows]
                attempt.run_many(problem, targets[rows], begin, part, rest)
                cost = self._costs(part)
                better = (cost < best_cost[rows]) & np.isnan(results.angle_bound[rows])
                better |= (part.status == _CONVERGED) | ~np.isnan(part.angle_bound)
                best_cost[rows[better]] = cost[better]
                for name in ("q", "error", "status", "angle_bound"):
                    getattr(results, name)[rows[better]] = getattr(part, name)[better]
                results.iterations[rows] += part.iterations
                results.restarts[rows] += part.restarts
                unreachable[rows] |= part.status == Status.UNREACHABLE
                last[rows] = part.status
            is_open = (results.status != _CONVERGED) & ~proven_best(results)
            open_rows = open_rows[is_open[open_rows]]
        for status in _STOPPED:
            results.status[open_rows[last[open_rows] == status]] = status
        results.status[open_rows[unreachable[open_rows]]] = Status.UNREACHABLE

    @staticmethod
    def _later_improves(attempts: Sequence[Prepared]) -> bool:
        """Return whether a later attempt may improve the point of the first, proven unreachable."""
        same_method = attempts[0].name == attempts[-1].name  # it would find the same point
        return not same_method or any(attempt.proves_best for attempt in attempts)

    def _costs(self, results: BatchResult) -> Array:
        """Return (n,) weighted squares of the errors; below zero for results that converged."""
        costs = ((results.error * self._weight) ** 2).sum(axis=1)
        costs[results.status == _CONVERGED] = -1.0
        return np.asarray(costs)


def is_proven_best(attempt: Prepared, solution: Solution) -> bool:
    """Return whether a solution did not converge and is proven to be the best."""
    return solution.status is Status.UNREACHABLE and attempt.proves_best


def proven_best(results: BatchResult) -> NDArray[np.bool_]:
    """Return which rows did not converge and have a proven bound of the angle."""
    return np.asarray((results.status == Status.UNREACHABLE) & ~np.isnan(results.angle_bound))


def remaining(
    budget: Budget, iterations: int, restarts: int, seconds: float, futile: bool
) -> Budget:
    """Return the rest of a budget; without restarts if they are futile."""
    spare = None if budget.restarts is None else max(0, budget.restarts - restarts)
    return Budget(
        iterations=max(0, budget.iterations - iterations),
        seconds=None if budget.seconds is None else max(0.0, budget.seconds - seconds),
        restarts=0 if futile else spare,
    )


def shares(
    budget: Budget, rows: Ints, results: BatchResult, futile: Array
) -> list[tuple[Ints, Budget]]:
    """Return groups of rows with the same remaining budget, and this budget.

    Args:
        budget: For each row.
        rows: (k,) rows of the batch.
        results: Results with the iterations and restarts that the rows have used.
        futile: (n,) whether restarts are futile.
    """
    if not len(rows):
        return []
    spent = np.column_stack([results.iterations[rows], results.restarts[rows], futile[rows]])
    groups, group_of = np.unique(spent, axis=0, return_inverse=True)
    parts = []
    for group, (iterations, restarts, is_futile) in enumerate(groups.tolist()):
        rest = remaining(budget, iterations, restarts, 0.0, bool(is_futile))
        parts.append((rows[group_of.ravel() == group], rest))
    return parts
