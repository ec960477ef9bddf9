"""What a solver is: a frozen dataclass of options, and a compiled kernel.

The options (``option``) become the CLI's flags, the rows of the docs' table and the columns of benchmarks.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import ConfigError, ProblemInUseError, UnsupportedGoalError
from robot_ik.goals import Goal
from robot_ik.kernels import jit, workspace
from robot_ik.kernels.bundle import address_of, named_row
from robot_ik.legacy_problem import Budget, LegacyProblem as Problem
from robot_ik.solution import STATUS_OF, Solution
from robot_ik.solvers.base import BatchResult
from robot_ik.solvers.base import Solver as _NewSolver
from robot_ik.solvers.options import option

Array = NDArray[np.float64]

# With a time budget the kernel runs in slices of about this long between readings of the clock.
_SLICE_SECONDS = 1e-3
_FIRST_SLICE = 16
# Solvers whose tables one problem keeps: a slider makes a new one at each of its stops.
_SOLVERS_KEPT = 16




@dataclass(frozen=True)
class Solver(_NewSolver):
    """A method of inverse kinematics.

    Class attributes:
        name: Its key in ``SOLVERS``.
        title, source: One line for people; where the method is published.
        goals: Kinds of goals it serves.
        partial_goals: Whether it also serves goals that ask for single coordinates or axes only.
        capabilities: What else of a problem it supports: ``couplings``, ``stiffness``, ``priorities``,
            ``soft`` goals.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    source: ClassVar[str] = ""
    goals: ClassVar[tuple[type[Goal], ...]] = (Goal,)
    partial_goals: ClassVar[bool] = False
    capabilities: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        for item in fields(self):
            value, meta, file = getattr(self, item.name), item.metadata, f"solver {self.name}"
            if meta.get("choices") and value not in meta["choices"]:
                allowed = ", ".join(meta["choices"])
                raise ConfigError(f"{value!r} is no choice", file=file, key=item.name, allowed=allowed)
            if type(value) is not type(item.default) and not _is_like(item.default, value):
                allowed = _VALUES[type(item.default)]
                raise ConfigError(f"{value!r} is not right", file=file, key=item.name, allowed=allowed)
            if meta.get("low") is not None and not meta["low"] <= value <= meta["high"]:
                allowed = f"{meta['low']:g} … {meta['high']:g} {meta['unit']}".rstrip()
                raise ConfigError(f"{value} is out of range", file=file, key=item.name, allowed=allowed)

    def supports(self, goal: Goal) -> bool:
        """Whether it serves this kind of goal."""
        return isinstance(goal, self.goals) and (self.partial_goals or goal.rows.whole)

    def applies(self, problem: Problem) -> bool:
        """Whether it can try this problem at all."""
        return not self.unsupported(problem)

    def unsupported(self, problem: Problem) -> str:
        """What of the problem it cannot serve, as text; empty when nothing is."""
        for goal in problem.given:
            if not self.supports(goal):
                part = isinstance(goal, self.goals)
                return goal.with_article + (" that asks for single axes only" if part else "")
        return next((_FEATURES[feature] for feature in sorted(problem.features - self.capabilities)), "")

    def require_support(self, problem: Problem) -> None:
        """Raises ``UnsupportedGoalError``, with the methods that can, unless every goal is served."""
        if unsupported := self.unsupported(problem):
            from robot_ik.solvers import able_solvers  # here: a new row shall not compile every method anew

            raise UnsupportedGoalError(self.name, unsupported, able_solvers(problem))

    def prepare(self, problem: Any) -> "LegacyPrepared":
        return LegacyPrepared(self, problem)

    @abstractmethod
    def attempt(self, problem: Problem, start: ArrayLike | None, budget: Budget) -> Solution:
        """``solve`` within what others left of the budget; the caller holds the problem's token."""

    def attempt_many(
        self, problem: Problem, targets: Array, starts: Array, results: BatchResult, budget: Budget
    ) -> None:
        """One solve, with the budget, for each row of ``targets`` (n, 12) and ``starts`` (n, nq) of one goal.

        The caller holds the problem's token; methods with a compiled batch override this loop.
        """
        for row in range(len(targets)):
            problem.target[0] = targets[row]
            solution = self.attempt(problem, starts[row], budget)
            results.q[row] = solution.q
            results.status[row] = solution.status
            results.miss[row] = solution.miss.position, solution.miss.angle
            results.iterations[row], results.restarts[row] = solution.iterations, solution.restarts

    def load(self, problem: Problem) -> Any:
        """What ``make`` makes, once for a problem; the first ``solve`` does the same, and raises the same."""
        kept = problem.made.get(id(self))
        if kept is None or kept[1] is None:
            self.require_support(problem)
        return self.made_for(problem)

    def made_for(self, problem: Problem) -> Any:
        """What ``make`` makes: once for a problem, which keeps it with this solver, by its ``id``."""
        kept = problem.made.get(id(self))
        if kept is None:
            made = self.make(problem)
            if len(problem.made) >= _SOLVERS_KEPT:
                problem.made.clear()
            kept = problem.made[id(self)] = self, made
        return kept[1]

    @abstractmethod
    def make(self, problem: Problem) -> Any:
        """Compiles, or loads, all that a solve of a problem that it supports may need."""


# What an option with such a default takes, as text.
_VALUES = {bool: "True or False", int: "a whole number", float: "a number", str: "text"}


def _is_like(default: Any, value: Any) -> bool:
    """Whether a value is of the kind of an option's default; defaults of other types say nothing."""
    if type(default) not in _VALUES:
        return True
    if isinstance(default, str) or not isinstance(value, int | float | np.number | np.bool_):
        return False
    if isinstance(default, bool):
        return value in (0, 1)
    return isinstance(default, float) or float(value).is_integer()


# What a problem may ask for beside its goals, as text.
_FEATURES = {
    "couplings": "joints that follow others",
    "priorities": "goals of different priorities",
    "soft": "soft goals",
    "stiffness": "joints of different stiffness",
}


@dataclass(frozen=True)
class IterativeSolver(Solver):
    """A method that takes steps: the shared loop does the rest."""

    restarts: int = option(100, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(30, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(15, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(3, "steps without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.01, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    draws: int = option(1, "random points of which a try takes the best", low=1, high=1000)
    # Whether its steps are taken without evaluating the cost; the last descent then evaluates it.
    unseen: ClassVar[bool] = False

    @abstractmethod
    def kernel(self) -> Callable[..., None]:
        """The compiled loop: takes what ``tables`` gives."""

    def kernel_for(self, problem: Problem) -> Callable[..., None]:
        """The compiled loop that this problem needs, where there are several."""
        return self.kernel()

    @cached_property
    def option_values(self) -> Array:
        """What the kernel takes as its options: ``options_of`` gives them their names."""
        values = [(item, getattr(self, item.name)) for item in fields(self)]
        choices = [item.metadata["choices"].index(v) if isinstance(v, str) else v for item, v in values]
        return np.array(choices, dtype=float)

    def tables(self, problem: Problem) -> tuple[Any, ...]:
        """What the kernel takes for a problem, in its order."""
        return *problem.tables, self.option_values

    def make(self, problem: Problem) -> Run:
        return Run(self, problem)

    def attempt(self, problem: Problem, start: ArrayLike | None, budget: Budget) -> Solution:
        # The hot loop: a warm solve spends as long here as in the kernel, so each line counts.
        kept = problem.made.get(id(self))
        run: Run = self.load(problem) if kept is None else kept[1]
        if run.budget is not budget or run.seed != problem.seed:
            run.renew(budget, problem.seed)
        if start is run.start:
            pass  # ``auto`` has put it there
        elif type(start) is np.ndarray and start.shape == run.shape:
            run.start[...] = start  # the kernel asks whether it is finite
        else:
            run.start[...] = problem.robot.home if start is None else problem.robot.check_q(start, "start")
        began = time.perf_counter()
        run.state[...], run.value[...] = run.fresh
        trace = None
        if run.whole:
            run.entry(*run.arguments)
        else:
            trace = _in_slices(run, problem.arrays["trace"], began)
        status, iterations, restarts, _, any_unreachable = run.outcome.tolist()
        if status == workspace.NUMERICAL:
            problem.robot.check_q(run.start, "start")
        elif any_unreachable and status != workspace.CONVERGED:
            status = workspace.UNREACHABLE
        return Solution(
            run.best.copy(), STATUS_OF[status], iterations, restarts, time.perf_counter() - began,
            self.name, problem.robot, problem.given, run.target.copy(), trace,
        )  # fmt: skip

    def fresh_state(self, budget: Budget, seed: int) -> tuple[NDArray[np.int64], Array]:
        """``work.state`` and ``work.value`` as a solve begins with them."""
        restarts = self.restarts if budget.restarts is None else budget.restarts
        state, value = np.zeros(workspace.STATE_SIZE, dtype=np.int64), np.zeros(workspace.VALUE_SIZE)
        state[workspace.MAX_ITERATIONS] = budget.iterations
        state[workspace.MAX_RESTARTS] = restarts
        state[workspace.FIRST_STEPS] = self.first_steps if restarts else workspace.NO_LIMIT
        state[workspace.TRY_LIMIT] = self.try_steps
        state[workspace.PATIENCE] = self.patience
        state[workspace.DRAWS] = self.draws
        state[workspace.SLICE_END] = workspace.NO_LIMIT
        value[workspace.PROGRESS] = self.progress
        value[workspace.SHARE] = 1.0 if self.unseen else 0.0
        # Any seed, zero included, becomes a nonzero state of the generator.
        state[workspace.SEED] = (seed * 0x9E3779B97F4A7C15 + 0x2545F4914F6CDD1D) % (1 << 63) or 1
        return state, value


def options_of(solver: type[IterativeSolver]) -> Callable[[Any], Any]:
    """What a kernel opens its options with, as a global of its module: then they have their names.

    Those with choices are the number of the choice; raises ``TypeError`` for other fields.
    """
    kinds = {"float": "float", "int": "int", "bool": "bool", "str": "int"}
    names = [(item.name, getattr(item.type, "__name__", item.type)) for item in fields(solver)]
    if wrong := [f"{name}: {kind}" for name, kind in names if kind not in kinds]:
        raise TypeError(f"options of {solver.__name__} must be {', '.join(kinds)}, not {', '.join(wrong)}")
    return named_row(solver.__name__, tuple((name, kinds[str(kind)]) for name, kind in names))


class Run:
    """A solver's compiled loop for one problem: made once, so that the hot loop only copies numbers.

    ``tables`` holds what ``arguments`` has addresses of; ``entry`` is the loop itself; ``fresh`` are the
    state and values that a solve with that budget and seed begins with.
    """

    def __init__(self, solver: IterativeSolver, problem: Problem) -> None:
        kernel, arrays = solver.kernel_for(problem), problem.arrays
        jit.announce(kernel, f"solver {solver.name!r}")
        self.solver, self.tables = solver, solver.tables(problem)
        self.arguments = tuple(address_of(table) for table in self.tables)
        self.entry = jit.entry(kernel, *self.arguments)
        self.state, self.value, self.start = arrays["state"], arrays["value"], arrays["start"]
        self.outcome = self.state[workspace.OUTCOME]
        self.best, self.target, self.shape = arrays["best"], problem.target, self.start.shape
        self.budget, self.seed = problem.budget, problem.seed
        self.fresh = solver.fresh_state(self.budget, self.seed)
        self.traced = problem.trace
        self.whole = not self.traced and self.budget.seconds is None

    def renew(self, budget: Budget, seed: int) -> None:
        """Makes ready for another budget and seed."""
        if budget != self.budget or seed != self.seed:
            self.fresh = self.solver.fresh_state(budget, seed)
        self.budget, self.seed = budget, seed
        self.whole = not self.traced and budget.seconds is None


def _in_slices(run: Run, trace: Array, began: float) -> Array | None:
    """Runs a kernel in pieces, the same to the last bit: between, it reads the clock and the trace."""
    rows: list[Array] = []
    state, longest = run.state, len(trace) or workspace.NO_LIMIT
    seconds = run.budget.seconds
    deadline = math.inf if seconds is None else began + seconds
    steps = longest if seconds is None else _FIRST_SLICE if time.perf_counter() < deadline else 0
    while True:
        state[workspace.SLICE_END] = state[workspace.ITERATIONS] + steps
        before = time.perf_counter()
        run.entry(*run.arguments)
        now = time.perf_counter()
        if len(trace):
            rows.append(trace[: state[workspace.TRACE_ROWS]].copy())
            state[workspace.TRACE_ROWS] = 0
        if state[workspace.STATUS] == workspace.RUNNING and now >= deadline:
            state[workspace.STATUS] = workspace.TIME_LIMIT
        if state[workspace.STATUS] != workspace.RUNNING:
            return np.concatenate(rows) if rows else None
        if seconds is not None:
            pace = steps / max(now - before, 1e-6)
            steps = min(longest, max(1, int(pace * min(_SLICE_SECONDS, deadline - now))))


def take_start(problem: Problem, start: ArrayLike | None) -> None:
    """Puts the start (nq,), default home, where the kernels read it; raises as ``Robot.check_q``."""
    begin = problem.arrays["start"]
    if type(start) is np.ndarray and start.shape == begin.shape:
        if start is not begin:
            begin[...] = start
        if math.isfinite(sum(begin.tolist())):  # quicker than NumPy's for so few
            return
    begin[...] = problem.robot.home if start is None else problem.robot.check_q(start, "start")


class LegacyPrepared:
    """Adapter: an old method behind the new protocol."""

    def __init__(self, solver: Solver, problem: Any) -> None:
        self.name, self.solver = solver.name, solver
        self.problem = problem.legacy
        self.start = problem.search.arrays["start"]
        solver.load(self.problem)

    def _sync(self, new: Any) -> None:
        old = self.problem
        old.seed, old.trace = new.seed, new.trace
        if old.given is not new.given:
            old.exchange(new.given)

    def _rows(self, new: Any) -> None:
        targets = new.search.arrays["target"].reshape(-1, 4, 4)
        self.problem.target[:, :3] = targets[:, :3, 3]
        self.problem.target[:, 3:] = targets[:, :3, :3].reshape(-1, 9)

    def run(self, new: Any, budget: Any) -> Solution:
        self._rows(new)
        if self.problem.given is not new.given or self.problem.seed != new.seed:
            self._sync(new)
        solution = self.solver.attempt(self.problem, self.start, budget)
        solution.targets = new.search.arrays["target"].reshape(-1, 4, 4).copy()
        new.search["best_cost"] = float(self.problem.arrays["value"][workspace.BEST_COST])
        return solution

    def run_many(self, new: Any, targets: Array, starts: Array, results: Any, budget: Any) -> None:
        self._sync(new)
        rows = np.empty((len(targets), 12))
        rows[:, :3], rows[:, 3:] = targets[:, :3, 3], targets[:, :3, :3].reshape(-1, 9)
        targets = rows
        self.solver.attempt_many(self.problem, targets, starts, results, budget)
