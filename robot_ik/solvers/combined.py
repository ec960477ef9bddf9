"""Several methods in turn: the first that reaches the goal wins, else the best of all is kept.

A00's fallback (a recursive solver where the Jacobian failed), generalised.  ``auto`` is the closed form
where there is one, then Levenberg-Marquardt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import ConfigError, UnsupportedGoalError
from robot_ik.kernels.work import BEST_COST
from robot_ik.problem import Budget, Problem
from robot_ik.solution import Solution, Status
from robot_ik.solvers import able_solvers, make_solver
from robot_ik.solvers.base import Answers, Solver, option

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Combined(Solver):
    """Tries methods in the order given; each starts from the same start."""

    methods: str = option("analytic lm", "names of methods, in the order in which they are tried")

    name: ClassVar[str] = "combined"
    title: ClassVar[str] = "methods in turn, until one reaches the goal"
    source: ClassVar[str] = "Aho 2000, generalised"

    parts: ClassVar[bool] = True
    # Those of its methods that can.
    honours: ClassVar[frozenset[str]] = frozenset({"couplings", "priorities", "soft", "stiffness"})

    @cached_property
    def _members(self) -> tuple[Solver, ...]:
        names = self.methods.replace(",", " ").split()
        if not names or any(name in ("combined", "auto") for name in names):
            raise ConfigError(
                f"{self.methods!r}", file=f"solver {self.name}", key="methods",
                allowed="names of single methods, separated by spaces",
            )  # fmt: skip
        return tuple(make_solver(name) for name in names)

    def applies(self, problem: Problem) -> bool:
        return any(member.applies(problem) for member in self._members)

    def _takes(self, member: Solver, problem: Problem) -> bool:
        """Whether a member gets its turn."""
        return member.applies(problem)

    def solve(self, problem: Problem, start: ArrayLike | None = None) -> Solution:
        turns = self._turns(problem)
        solution = turns[0].solve(problem, start)
        if solution.status is Status.CONVERGED or len(turns) == 1:
            return solution
        return self._go_on(problem, start, solution)

    def _turns(self, problem: Problem) -> tuple[Solver, ...]:
        """The methods that can try a problem, asked once."""
        asked = problem.prepared.get("turns")
        if asked is None or asked[0] is not self:
            turns = tuple(member for member in self._members if self._takes(member, problem))
            if not turns:
                goal = problem.goals[0]
                beyond = [member.beyond(problem) for member in self._members]
                what = next(filter(None, beyond), f"a {goal.name}")
                raise UnsupportedGoalError(self.name, what, able_solvers(problem))
            asked = problem.prepared["turns"] = self, turns
        found: tuple[Solver, ...] = asked[1]
        return found

    def _go_on(self, problem: Problem, start: ArrayLike | None, best: Solution) -> Solution:
        """The other methods, after the first has failed with ``best``."""
        whole, used, spent = problem.budget, best.iterations, best.seconds
        proven = best.status is Status.UNREACHABLE
        best_cost = float(problem.arrays["value"][BEST_COST])
        try:
            for member in self._turns(problem)[1:]:
                problem.budget = _rest(problem, whole, used, spent, proven)
                solution = member.solve(problem, start)
                used, spent = used + solution.iterations, spent + solution.seconds
                proven = proven or solution.status is Status.UNREACHABLE
                cost = float(problem.arrays["value"][BEST_COST])
                if solution.converged or cost < best_cost:
                    best, best_cost = solution, cost
                if solution.converged:
                    break
        finally:
            problem.budget = whole
        if proven and not best.converged:
            best.status = Status.UNREACHABLE
        best.iterations = used
        return best

    def solve_many(self, problem: Problem, targets: Array, starts: Array, answers: Answers) -> None:
        """Each method takes all poses that the ones before it missed."""
        left, whole = np.arange(len(targets)), problem.budget
        best = np.full(len(targets), np.inf)
        proven = np.zeros(len(targets), dtype=bool)
        for member in self._members:
            if not len(left) or not self._takes(member, problem):
                continue
            for rows, known in ((left[~proven[left]], False), (left[proven[left]], True)):
                part = Answers.empty(len(rows), answers.q.shape[1])
                problem.budget = _rest(problem, whole, 0, 0.0, known)
                try:
                    member.solve_many(problem, targets[rows], starts[rows], part)
                finally:
                    problem.budget = whole
                cost = _cost(problem, part.miss)
                cost[part.status == Status.CONVERGED] = 0.0
                better = cost < best[rows]
                best[rows[better]] = cost[better]
                for mine, its in (
                    (answers.q, part.q),
                    (answers.miss, part.miss),
                    (answers.status, part.status),
                ):
                    mine[rows[better]] = its[better]
                proven[rows] |= part.status == Status.UNREACHABLE
            left = left[answers.status[left] != Status.CONVERGED]
        answers.status[proven & (answers.status != Status.CONVERGED)] = Status.UNREACHABLE


def _rest(problem: Problem, whole: Budget, used: int, seconds: float, proven: bool) -> Budget:
    """What is left of a budget.  Once it is proven that no joint angles do, restarts are of no use.

    Kept from one solve to the next, so that a method that is ready for it stays ready.
    """
    asked = whole, used, proven
    kept = problem.prepared.get("rest")
    if whole.seconds is None and kept is not None and kept[0] == asked:
        known: Budget = kept[1]
        return known
    rest = Budget(
        iterations=max(0, whole.iterations - used),
        seconds=None if whole.seconds is None else max(0.0, whole.seconds - seconds),
        # Of several goals the others may still be searched for.
        restarts=0 if proven and len(problem.goals) == 1 else whole.restarts,
    )
    problem.prepared["rest"] = asked, rest
    return rest


def _cost(problem: Problem, miss: Array) -> Array:
    """Weighted squares of misses (n, 2), as the solvers weigh them."""
    weight = problem.weights[0]
    return np.asarray((miss[:, 0] * weight[0]) ** 2 + (miss[:, 1] * weight[1]) ** 2)


@dataclass(frozen=True)
class Auto(Combined):
    """The closed form where this robot and goal have one, else Levenberg-Marquardt."""

    name: ClassVar[str] = "auto"
    title: ClassVar[str] = "closed form where there is one, else Levenberg-Marquardt"

    def _takes(self, member: Solver, problem: Problem) -> bool:
        return member.worthwhile(problem) and member.applies(problem)
