"""Residual and Jacobian of a problem as the solvers see them, for tests of goals and couplings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.pose_prior import PRIOR_WORK, prior_jacobian, prior_residual
from robot_ik.kernels.residuals import GOALS, goal_jacobian
from robot_ik.kernels.search import SEARCH, count_all_goals, measure
from robot_ik.kernels.tree import TREE
from robot_ik.problem import Problem

Array = NDArray[np.float64]

RUN = Layout(
    "Rows",
    jacobian="table m u",
    tree=TREE,
    goals=GOALS,
    search=SEARCH,
    prior=PRIOR_WORK,
)
open_run = RUN.open


@kernel
def measure_rows(address: Any) -> None:
    """Write residual, error, cost and Jacobian at q."""
    run = open_run(address)
    goals = run.goals
    search = run.search
    count_all_goals(goals, search)
    measure(run.tree, goals, search)
    goal_jacobian(run.tree, goals, search, False, run.jacobian)
    if goals.prior_goal >= 0:
        search.cost += 0.5 * prior_residual(goals, search, run.prior, goals.prior_goal)
        prior_jacobian(run.tree, goals, search, run.prior, goals.prior_goal, run.jacobian)


@dataclass(frozen=True)
class Rows:
    """Cost ½ |r|², residual (m,), error (g, 2), Jacobian (m, u), dofs (u,) of its columns."""

    cost: float
    residual: Array
    error: Array
    jacobian: Array
    dofs: NDArray[np.int64]


def rows_at(problem: Problem, q: ArrayLike) -> Rows:
    """Return the rows of a problem at q (nq,)."""
    blocks = {
        "tree": problem.robot.tree.block,
        "goals": problem.compiled.block,
        "search": problem.search,
    }
    run = RUN.allocate(problem.sizes, blocks)
    arrays = problem.search.arrays
    arrays["q"][:] = q
    measure_rows(run.address)
    return Rows(
        problem.search["cost"],
        arrays["residual"].copy(),
        arrays["error"].copy(),
        run.arrays["jacobian"],
        problem.compiled.block.arrays["dofs"],
    )


def columns_of(problem: Problem) -> NDArray[np.int64]:
    """Return the degree of freedom of each column of the Jacobian (u,)."""
    dofs: NDArray[np.int64] = problem.compiled.block.arrays["dofs"]
    return dofs
