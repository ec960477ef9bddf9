"""Where the joints beyond a limb's shoulder hold the hand's point and axis."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import outlined
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.subproblems import turn

# Rows of form.extra: the point as the joints of the moment hold it, the point and the axis at q = 0, the
# axis as the joints hold it.
HELD_POINT, POINT, AXIS, HELD_AXIS = 0, 2, 3, 4


@outlined
def keep_rest(form):
    """All joints as at the start, in both rows of ``trial``."""
    trial, start = form.trial, form.start
    for j in range(start.shape[0]):
        trial[0, j] = trial[1, j] = start[j]


@outlined
def carry_hand(form, left_out):
    """The hand's point and axis as the joints beyond the shoulder hold them, but for the first few.

    Their angles stand in ``trial[0]``; by their axes at q = 0, the shoulder not yet turned.
    """
    keep_apart()
    axes, extra, trial = form.axes, form.extra, form.trial
    base = form.groups[1, 1] - 1
    px, py, pz = extra[POINT, 0], extra[POINT, 1], extra[POINT, 2]
    ax, ay, az = extra[AXIS, 0], extra[AXIS, 1], extra[AXIS, 2]
    for back in range(trial.shape[1] - base - left_out):
        j = trial.shape[1] - 1 - back
        k = 3 + j - base
        c, s = math.cos(trial[0, j]), math.sin(trial[0, j])
        hx, hy, hz = axes[k, 0], axes[k, 1], axes[k, 2]
        ox, oy, oz = axes[k, 3], axes[k, 4], axes[k, 5]
        px, py, pz = turn(hx, hy, hz, c, s, px - ox, py - oy, pz - oz)
        px, py, pz = px + ox, py + oy, pz + oz
        ax, ay, az = turn(hx, hy, hz, c, s, ax, ay, az)
    extra[HELD_POINT, 0], extra[HELD_POINT, 1], extra[HELD_POINT, 2] = px, py, pz
    extra[HELD_AXIS, 0], extra[HELD_AXIS, 1], extra[HELD_AXIS, 2] = ax, ay, az
