"""What the hot loop needs, made once for each problem."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.kernels import jit, work
from robot_ik.problem import Problem

if TYPE_CHECKING:
    from robot_ik.solvers.base import IterativeSolver


def take_start(problem: Problem, start: ArrayLike | None) -> None:
    """Puts the start (nq,) of a solve, default home, where the kernels look for it.

    Raises:
        ModelError: Wrong length, or a number that is not finite.
    """
    begin = problem.arrays["start"]
    if type(start) is np.ndarray and start.shape == begin.shape:
        begin[...] = start
        if math.isfinite(sum(begin.tolist())):  # quicker than NumPy's for so few
            return
    begin[...] = problem.robot.home if start is None else problem.robot.check_q(start, "start")


class Ready:
    """What a solver needs for every solve of one problem, made once: the hot loop only copies it.

    Attributes:
        solver, budget, seed: What it was made for.
        run, arguments: The compiled loop's entry, and what it takes.
        fresh: State and values that a solve begins with.
    """

    __slots__ = (
        "arguments", "best", "budget", "fresh", "outcome", "run", "seed", "shape", "solver", "start",
        "state", "target", "value",
    )  # fmt: skip

    def __init__(self, solver: IterativeSolver, problem: Problem) -> None:
        kernel, arrays = solver.kernel_for(problem), problem.arrays
        jit.announce(kernel, f"solver {solver.name!r}")
        self.solver, self.budget, self.seed = solver, problem.budget, problem.seed
        self.arguments = solver.arguments(problem)
        self.run = jit.entry(kernel, *self.arguments)
        self.state, self.value, self.start = arrays["state"], arrays["value"], arrays["start"]
        self.fresh = self.state.copy(), self.value.copy()
        self.outcome = self.state[work.OUTCOME]
        self.best, self.target, self.shape = arrays["best"], problem.target, self.start.shape
