"""The entry points of the closed forms of two and of six hinges."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import STATUS, open_work
from robot_ik.solvers.analytic.choose import nearest
from robot_ik.solvers.analytic.form import SOLVE, look, open_form, settle
from robot_ik.solvers.analytic.geometry import Family
from robot_ik.solvers.analytic.intervals import length
from robot_ik.solvers.analytic.planar import planar_two_link
from robot_ik.solvers.analytic.proof import planar_is_out_of_reach, wrist_is_out_of_reach
from robot_ik.solvers.analytic.proof_parallel import parallel_is_out_of_reach
from robot_ik.solvers.analytic.six_axes import centre, spherical_wrist, three_parallel

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
    settle(tree, goal, work, form, row, found, row < 0 and out_of_reach(form, goal.tolerance, family))


@outlined
def out_of_reach(form, tolerance, family):
    """Whether it is proven that nothing within tolerance can be reached inside the limits."""
    axes, extra, target, lower, upper = form.axes, form.extra, form.target, form.lower, form.upper
    if family == _PLANAR:
        return planar_is_out_of_reach(axes, extra, target, lower, upper, tolerance)
    if family == _WRIST:
        lever = length(extra[1, 0], extra[1, 1], extra[1, 2])
        return wrist_is_out_of_reach(axes, extra, target, lower, upper, tolerance, lever)
    if family == _SHOULDER:
        x, y, z = centre(form.inverse, extra)  # the shoulder, seen from the goal
        lever = length(x, y, z)
        return wrist_is_out_of_reach(axes, extra, form.inverse, lower, upper, tolerance, lever)
    return parallel_is_out_of_reach(axes, extra, target, lower, upper, tolerance)


@outlined
def invert(target, inverse):
    """The inverse of the pose row target[0] into inverse[0]."""
    for i in range(3):
        inverse[0, i] = -(
            target[0, 3 + i] * target[0, 0]
            + target[0, 6 + i] * target[0, 1]
            + target[0, 9 + i] * target[0, 2]
        )
        for j in range(3):
            inverse[0, 3 + 3 * i + j] = target[0, 3 + 3 * j + i]


@kernel
def closed_form(tree, goals, work, form, family, mode):
    """One solve."""
    answer(open_tree(tree), open_goals(goals), open_work(work), open_form(form), family, mode)


@kernel
def closed_form_many(tree, goals, work, form, family, targets, starts, q, status, miss):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q (n, nq), status, miss (n, 2)."""
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
