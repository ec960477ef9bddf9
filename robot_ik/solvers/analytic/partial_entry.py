"""The entry points for a point to a place and for an aim; compiled only where they are asked for."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import kernel
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import ITERATIONS, STATUS, open_work
from robot_ik.solvers.analytic.form import EVERY, SOLVE, look, open_form, settle
from robot_ik.solvers.analytic.geometry import Family
from robot_ik.solvers.analytic.partial import branches_of_part, part_of_limb

_AIM = int(Family.LIMB_AIM)


@kernel
def closed_part(tree, goals, work, form, family, mode):
    """One solve from work.start; fills best and status, and the branches if they are asked for."""
    tree, goal, work, form = open_tree(tree), open_goals(goals), open_work(work), open_form(form)
    aimed = family == _AIM
    if not look(tree, goal, work, form, mode):
        return
    if mode == EVERY:
        form.branches[:, :] = math.nan
        # First without limits: a branch that is nowhere inside them is still a branch.
        branches_of_part(form, aimed, form.least, form.most)
        branches_of_part(form, aimed, form.lower, form.upper)
        return
    settle(tree, goal, work, form, part_of_limb(tree, goal, work, form, aimed), types.int64(0))


@kernel
def closed_part_many(tree, goals, work, form, family, targets, starts, q, status, miss, iterations):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q, status, miss (n, 2), iterations."""
    tree, goal, work, form = open_tree(tree), open_goals(goals), open_work(work), open_form(form)
    none = types.int64(0)
    target, start, best, state, now = goal.target, work.start, work.best, work.state, work.miss
    for row in range(targets.shape[0]):
        for i in range(12):
            target[0, i] = targets[row, i]
        for i in range(start.shape[0]):
            start[i] = starts[row, i]
        if look(tree, goal, work, form, SOLVE):
            settle(tree, goal, work, form, part_of_limb(tree, goal, work, form, family == _AIM), none)
        for i in range(start.shape[0]):
            q[row, i] = best[i]
        status[row] = state[STATUS]
        miss[row, 0], miss[row, 1] = now[0, 0], now[0, 1]
        iterations[row] = state[ITERATIONS]
