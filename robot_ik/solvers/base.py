"""What a solver is: a frozen dataclass of options, and a compiled kernel.

The options (with default, range, unit and one line of help) become the CLI's flags, the rows of the
docs' table and the columns of benchmarks; ``option`` declares them.
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

from robot_ik.errors import ConfigError, UnsupportedGoalError
from robot_ik.goals import GOALS, Goal
from robot_ik.kernels import work
from robot_ik.problem import Problem
from robot_ik.solution import STATUS_OF, Solution
from robot_ik.solvers.ready import Ready

Array = NDArray[np.float64]

# With a time budget the kernel runs in slices of about this long between looks at the clock.
_SLICE_SECONDS = 1e-3
_FIRST_SLICE = 16


def option(
    default: Any,
    help: str,
    *,
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
    choices: tuple[str, ...] = (),
) -> Any:
    """A field of a solver: its default, range (numbers only) or choices, unit and one line of help."""
    metadata = {"help": help, "low": low, "high": high, "unit": unit, "choices": choices}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, eq=False)
class Answers:
    """Where a batch puts its answers: q (n, nq), status (n,), miss (n, 2) in metres and radians."""

    q: Array
    status: NDArray[np.int64]
    miss: Array

    @classmethod
    def empty(cls, count: int, nq: int) -> Answers:
        """Room for ``count`` answers."""
        return cls(np.zeros((count, nq)), np.zeros(count, dtype=np.int64), np.zeros((count, 2)))

    def part(self, rows: slice) -> Answers:
        """A view of some rows: what is written there is written here."""
        return Answers(self.q[rows], self.status[rows], self.miss[rows])


@dataclass(frozen=True)
class Solver(ABC):
    """A method of inverse kinematics.

    Class attributes:
        name: Its key in ``SOLVERS``.
        title, source: One line for people; where the method is published.
        goals: Kinds of goals it serves.
        parts: Whether it also serves goals that ask for single coordinates or axes only.
        honours: What else of a problem it heeds: ``couplings``, ``stiffness``, ``priorities``,
            ``soft`` goals.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    source: ClassVar[str] = ""
    goals: ClassVar[tuple[type[Goal], ...]] = GOALS
    parts: ClassVar[bool] = False
    honours: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        for item in fields(self):
            value, meta = getattr(self, item.name), item.metadata
            if meta.get("choices") and value not in meta["choices"]:
                raise ConfigError(
                    f"{value!r} is no choice", file=f"solver {self.name}", key=item.name,
                    allowed=", ".join(meta["choices"]),
                )  # fmt: skip
            if meta.get("low") is not None and not meta["low"] <= value <= meta["high"]:
                raise ConfigError(
                    f"{value} is out of range", file=f"solver {self.name}", key=item.name,
                    allowed=f"{meta['low']:g} … {meta['high']:g} {meta['unit']}".rstrip(),
                )  # fmt: skip

    def supports(self, goal: Goal) -> bool:
        """Whether it serves this kind of goal."""
        return isinstance(goal, self.goals) and (self.parts or goal.rows.whole)

    def applies(self, problem: Problem) -> bool:
        """Whether it can try this problem at all."""
        return not self.beyond(problem)

    def worthwhile(self, problem: Problem) -> bool:
        """Whether it is a better first choice than a numeric method where it applies; asked by ``auto``."""
        return True

    def beyond(self, problem: Problem) -> str:
        """What of the problem it cannot serve, in words; empty when nothing is."""
        for goal in problem.goals:
            if not self.supports(goal):
                part = isinstance(goal, self.goals)
                return f"a {goal.name}" + (" that asks for single axes only" if part else "")
        for feature in sorted(problem.features - self.honours):
            return _FEATURES[feature]
        return ""

    def require_support(self, problem: Problem) -> None:
        """Raises ``UnsupportedGoalError``, with the methods that can, unless every goal is served."""
        if beyond := self.beyond(problem):
            from robot_ik.solvers import able_solvers

            raise UnsupportedGoalError(self.name, beyond, able_solvers(problem))

    @abstractmethod
    def solve(self, problem: Problem, start: ArrayLike | None = None) -> Solution:
        """Solves from ``start`` (nq,), default home.  No solution is a result, never an exception."""

    def solve_many(self, problem: Problem, targets: Array, starts: Array, answers: Answers) -> None:
        """One solve for each row of ``targets`` (n, 12) and ``starts`` (n, nq) of a problem with one goal.

        Methods with a compiled batch override this loop.
        """
        for row in range(len(targets)):
            problem.target[0] = targets[row]
            solution = self.solve(problem, starts[row])
            answers.q[row] = solution.q
            answers.status[row] = solution.status
            answers.miss[row] = solution.miss.position, solution.miss.angle


# What a problem may ask for beside its goals, in words.
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
    # Whether its steps are taken without a look at the cost; the last descent then looks for it.
    unseen: ClassVar[bool] = False

    draws: int = option(1, "random points of which a try takes the best", low=1, high=1000)

    @abstractmethod
    def kernel(self) -> Callable[..., None]:
        """The compiled loop: takes tree, goals, work, options."""

    def kernel_for(self, problem: Problem) -> Callable[..., None]:
        """The compiled loop that this problem needs, where there are several."""
        return self.kernel()

    @abstractmethod
    def parameters(self) -> tuple[float, ...]:
        """What the kernel takes as its options, in its order."""

    @cached_property
    def _options(self) -> Array:
        return np.array(self.parameters(), dtype=float)

    def arguments(self, problem: Problem) -> tuple[Any, ...]:
        """What the kernel takes for a problem."""
        return problem.robot.tree.handle, problem.handle, problem.work, self._options

    def solve(self, problem: Problem, start: ArrayLike | None = None) -> Solution:
        # The hot loop: a warm solve spends as long here as in the kernel, so each line counts.
        ready: Ready | None = problem.prepared.get("steps")
        if (
            ready is None
            or ready.solver is not self
            or ready.budget is not problem.budget
            or ready.seed != problem.seed
        ):
            ready = self._get_ready(problem)
        if type(start) is np.ndarray and start.shape == ready.shape:
            ready.start[...] = start  # the kernel asks whether it is finite
        else:
            ready.start[...] = problem.robot.home if start is None else problem.robot.check_q(start, "start")
        began = time.perf_counter()
        ready.state[...], ready.value[...] = ready.fresh
        trace = None
        if ready.budget.seconds is None and not problem.trace:
            ready.run(*ready.arguments)
        else:
            trace = _in_slices(ready, problem.arrays["trace"], began)
        status, iterations, restarts, _, beyond = ready.outcome.tolist()
        if status == work.NUMERICAL:
            problem.robot.check_q(ready.start, "start")
        elif beyond and status != work.CONVERGED:
            status = work.UNREACHABLE
        return Solution(
            ready.best.copy(), STATUS_OF[status], iterations, restarts, time.perf_counter() - began,
            self.name, problem.robot, tuple(problem.goals), ready.target.copy(),
            trace,
        )  # fmt: skip

    def _get_ready(self, problem: Problem) -> Ready:
        self.require_support(problem)
        self._set_state(problem)
        ready = Ready(self, problem)
        problem.prepared["steps"] = ready
        return ready

    def _set_state(self, problem: Problem) -> None:
        """The state a solve begins with."""
        arrays, budget = problem.arrays, problem.budget
        restarts = self.restarts if budget.restarts is None else budget.restarts
        state, value = arrays["state"], arrays["value"]
        state[:] = 0
        state[work.MAX_ITERATIONS] = budget.iterations
        state[work.MAX_RESTARTS] = restarts
        state[work.FIRST_STEPS] = self.first_steps if restarts else work.NO_LIMIT
        state[work.TRY_LIMIT] = self.try_steps
        state[work.PATIENCE] = self.patience
        state[work.DRAWS] = self.draws
        state[work.SLICE_END] = work.NO_LIMIT
        value[:] = 0.0
        value[work.PROGRESS] = self.progress
        value[work.SHARE] = 1.0 if self.unseen else 0.0
        # Any seed, zero included, becomes a nonzero state of the generator.
        state[work.SEED] = (problem.seed * 0x9E3779B97F4A7C15 + 0x2545F4914F6CDD1D) % (1 << 63) or 1


def _in_slices(ready: Ready, trace: Array, began: float) -> Array | None:
    """Runs a kernel piece by piece, with looks at the clock between; takes the rows of the trace away, if any.

    A solve in pieces is the same to the last bit.
    """
    state, rows, longest = ready.state, [], len(trace) or work.NO_LIMIT
    seconds = ready.budget.seconds
    deadline = math.inf if seconds is None else began + seconds
    steps = longest if seconds is None else _FIRST_SLICE if time.perf_counter() < deadline else 0
    while True:
        state[work.SLICE_END] = state[work.ITERATIONS] + steps
        before = time.perf_counter()
        ready.run(*ready.arguments)
        now = time.perf_counter()
        if len(trace):
            rows.append(trace[: state[work.TRACE_ROWS]].copy())
            state[work.TRACE_ROWS] = 0
        if state[work.STATUS] == work.RUNNING and now >= deadline:
            state[work.STATUS] = work.TIME_LIMIT
        if state[work.STATUS] != work.RUNNING:
            return np.concatenate(rows) if rows else None
        if seconds is not None:
            pace = steps / max(now - before, 1e-6)
            steps = min(longest, max(1, int(pace * min(_SLICE_SECONDS, deadline - now))))


@dataclass(frozen=True)
class JacobianSolver(IterativeSolver):
    """A method whose step is made from the Jacobian and the residual: options that all of them share."""

    parts: ClassVar[bool] = True
    unseen: ClassVar[bool] = True
    honours: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness"})

    first_steps: int = option(100, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(60, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(8, "steps without progress before a try is given up", low=1, high=1000)
    clamp: float = option(0.5, "longest residual of a goal taken in one step", low=1e-3, high=1e6, unit="rad")
    max_step: float = option(0.4, "largest change of one joint in a step", low=1e-4, high=1e6, unit="rad")
    gain: float = option(1.0, "share of each step that is taken", low=1e-6, high=2.0)
    alternative: bool = option(False, "Jacobian at the target in place of the frame (alternative Jacobian)")

    def common(self) -> tuple[float, ...]:
        """The shared options in the order of ``kernels/jacobian_step.py``."""
        return (self.clamp, float(self.alternative), self.gain, self.max_step)
