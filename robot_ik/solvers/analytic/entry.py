"""The entry points of the closed forms of two and of six hinges."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import ITERATIONS, STATUS, open_work
from robot_ik.solvers.analytic.choose import nearest
from robot_ik.solvers.analytic.form import SOLVE, invert, look, open_form, settle
from robot_ik.solvers.analytic.geometry import Family
from robot_ik.solvers.analytic.planar import planar_two_link
from robot_ik.solvers.analytic.six_axes import spherical_wrist, three_parallel

_PLANAR, _WRIST = int(Family.PLANAR_TWO_LINK), int(Family.SPHERICAL_WRIST)
_SHOULDER = int(Family.SPHERICAL_SHOULDER)


@outlined
def answer(tree, goal, work, form, family, mode):
    """Solves from work.start, which is the answer if it is at the goal; fills best, status and branches."""
    if not look(tree, goal, work, form, mode):
        return
    axes, extra, target, start, branches = form.axes, form.extra, form.target, form.start, form.branches
    lower, upper = form.lower, form.upper
    if family == _PLANAR:
        found = planar_two_link(axes, extra, target, start, goal.tolerance[0, 0], branches)
    elif family == _WRIST:
        found = spherical_wrist(axes, extra, target, start, lower, upper, branches)
    elif family == _SHOULDER:
        invert(target, form.inverse)
        found = spherical_wrist(axes, extra, form.inverse, start, lower, upper, branches)
    else:
        found = three_parallel(axes, extra, target, start, branches)
    row = nearest(branches, start, lower, upper, form.best)
    settle(tree, goal, work, form, row, found)


@kernel
def closed_form(tree, goals, work, form, family, mode):
    """One solve."""
    answer(open_tree(tree), open_goals(goals), open_work(work), open_form(form), family, mode)


@kernel
def closed_form_many(tree, goals, work, form, family, targets, starts, q, status, miss, iterations):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q, status, miss (n, 2), iterations."""
    tree, goal, work, form = open_tree(tree), open_goals(goals), open_work(work), open_form(form)
    target, start, best, state, now = goal.target, work.start, work.best, work.state, work.miss
    for row in range(targets.shape[0]):
        for i in range(12):
            target[0, i] = targets[row, i]
        for i in range(start.shape[0]):
            start[i] = starts[row, i]
        answer(tree, goal, work, form, family, SOLVE)
        for i in range(start.shape[0]):
            q[row, i] = best[i]
        status[row] = state[STATUS]
        miss[row, 0], miss[row, 1] = now[0, 0], now[0, 1]
        iterations[row] = state[ITERATIONS]
