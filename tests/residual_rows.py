"""Residual and Jacobian of a problem as the solvers see them, for tests of goals and of couplings."""

from __future__ import annotations

from typing import Any

from robot_ik.kernels.jit import kernel
from robot_ik.kernels.kinematics import forward
from robot_ik.kernels.pose_prior import prior_jacobian, prior_rows
from robot_ik.kernels.residuals import PRIOR, evaluate, goal_jacobian, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.workspace import open_work


@kernel
def residual_and_jacobian(tree: Any, goals: Any, work: Any) -> Any:
    """Residual (m,), miss (g, 2), jacobian (m, nu) at the work space's q; returns the cost."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    forward(tree, work.nodes, work.q, work.world, work.scratch)
    cost, _ = evaluate(tree, goal, work)
    goal_jacobian(tree, goal, work, work.frames)
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] == PRIOR:
            cost += 0.5 * prior_rows(goal, work, g)
            prior_jacobian(tree, goal, work, g)
    return cost
