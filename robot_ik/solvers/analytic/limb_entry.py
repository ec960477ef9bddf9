"""The entry points of a limb's closed form; compiled only for robots that have one."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import ITERATIONS, STATUS, open_work
from robot_ik.solvers.analytic.form import EVERY, SOLVE, look, open_form, settle
from robot_ik.solvers.analytic.limb import limb


@outlined
def answer_limb(tree, goal, work, form, mode):
    """Solves from work.start; fills best and status, and the branches if they are asked for."""
    if not look(tree, goal, work, form, mode):
        return
    if mode == EVERY:
        branches = form.branches
        for row in range(branches.shape[0]):
            for j in range(branches.shape[1]):
                branches[row, j] = math.nan
        # First without limits: a branch that is nowhere inside them is still a branch.
        limb(form, form.least, form.most, mode)
    row, found = limb(form, form.lower, form.upper, mode)
    if mode == EVERY:
        return
    settle(tree, goal, work, form, row, found)


@kernel
def closed_limb(tree, goals, work, form, _family, mode):
    """One solve."""
    answer_limb(open_tree(tree), open_goals(goals), open_work(work), open_form(form), mode)


@kernel
def closed_limb_many(tree, goals, work, form, _family, targets, starts, q, status, miss, iterations):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q, status, miss (n, 2), iterations."""
    tree, goal, work, form = open_tree(tree), open_goals(goals), open_work(work), open_form(form)
    target, start, best, state, now = goal.target, work.start, work.best, work.state, work.miss
    for row in range(targets.shape[0]):
        for i in range(12):
            target[0, i] = targets[row, i]
        for i in range(start.shape[0]):
            start[i] = starts[row, i]
        answer_limb(tree, goal, work, form, SOLVE)
        for i in range(start.shape[0]):
            q[row, i] = best[i]
        status[row] = state[STATUS]
        miss[row, 0], miss[row, 1] = now[0, 0], now[0, 1]
        iterations[row] = state[ITERATIONS]
