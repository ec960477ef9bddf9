"""Residual and Jacobian of a problem as the solvers see them, for tests of goals and of couplings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.residuals import GOALS, goal_jacobian
from robot_ik.kernels.search import SEARCH, count_all_goals, measure
from robot_ik.kernels.tree import TREE
from robot_ik.problem import Problem

Array = NDArray[np.float64]

RUN = Layout("ResidualRun", tree=TREE, goals=GOALS, search=SEARCH)
open_run = RUN.open


@kernel
def residual_and_jacobian(address: Any, jacobian: Any) -> Any:
    """Write residual, miss and Jacobian (m, u) at search.q; return the cost."""
    run = open_run(address)
    count_all_goals(run.goals, run.search)
    measure(run.tree, run.goals, run.search)
    goal_jacobian(run.tree, run.goals, run.search, False, jacobian)
    return run.search.cost


def columns_of(problem: Problem) -> NDArray[np.int64]:
    """Return the degree of freedom of each column of the Jacobian (u,)."""
    dofs: NDArray[np.int64] = problem.compiled.block.arrays["dofs"]
    return dofs


def evaluate(problem: Problem, q: Any) -> tuple[float, Array, Array, Array]:
    """Return cost, residual (m,), miss (g, 2) and Jacobian (m, u) of a problem at q."""
    blocks = {
        "tree": problem.robot.tree.block,
        "goals": problem.compiled.block,
        "search": problem.search,
    }
    run = RUN.allocate(given=blocks)
    arrays = problem.search.arrays
    arrays["q"][:] = q
    jacobian = np.zeros((problem.compiled.rows, problem.compiled.columns))
    cost = residual_and_jacobian(run.address, jacobian)
    return cost, arrays["residual"].copy(), arrays["miss"].copy(), jacobian
