"""Aims an axis of the hand at a point in space by turning it about one point: shoulder or wrist.

Let the axis start at o and point along a, both seen from the centre of the turn, and let what it is aimed
at be d away from there.  Then the place on the axis that comes to lie there is o + t a with

    |o + t a| = d,  t > 0:   t = -o·a ± √((o·a)² - |o|² + d²)

The turn must bring that place to the goal's direction u; what is left free is a turn about u.  That is the
swivel angle once more, so that its ranges inside the joint limits are known exactly (``search.py``).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.form import EVERY
from robot_ik.solvers.analytic.geometry import HINGES, NO_JOINTS
from robot_ik.solvers.analytic.hand import AXIS, HELD_AXIS, HELD_POINT, POINT, carry_hand
from robot_ik.solvers.analytic.search import ANGLE, GAIN, VALUE, refine, scan, value_at
from robot_ik.solvers.analytic.subproblems import turn
from robot_ik.solvers.analytic.swivel import START, apply_back, make_parts, put_column, start_rotation

# Nearer than this (m) to the goal an axis hardly has a direction, and a centre cannot be turned about.
_NEAR = 1e-5
# Square metres of rounding in the root above.
_SLACK = 1e-13


@outlined
def take_turns(form, g, side, lower, upper, mode, nearest):
    """The best turns of shoulder (g = 0) or wrist (1) into ``form.best``, or the flips into the branches."""
    keep_apart()
    tally, best, trial, branches = form.tally, form.best, form.trial, form.branches
    every = mode == EVERY
    scan(form, lower, upper, every, nearest)
    other = types.int64(2 if g == 0 else 1)
    swapped = tally[other, VALUE] < tally[0, VALUE]  # the better first: the other is then seldom refined
    for turn_of in range(2):
        flip = types.int64(1 - turn_of if swapped else turn_of)
        row = other * flip
        if tally[row, VALUE] == math.inf or (not every and GAIN * tally[row, VALUE] >= nearest):
            continue
        refine(form, lower, upper, row, math.inf if every else nearest)
        if not every and tally[row, VALUE] >= nearest:
            continue
        nearest = min(nearest, tally[row, VALUE])
        value_at(form, lower, upper, tally[row, ANGLE], row)
        for j in range(trial.shape[1]):
            if every:
                branches[4 * g + 2 * side + flip, j] = trial[flip, j]
            else:
                best[j] = trial[flip, j]
    return nearest


@outlined
def turn_about(form, g, lower, upper, mode, nearest, ux, uy, uz):
    """Turns the held point and axis, seen from the centre, so that it aims at u; returns the nearest."""
    keep_apart()
    extra, parts, spin, groups = form.extra, form.parts, form.spin, form.groups
    ox, oy, oz = extra[HELD_POINT, 0], extra[HELD_POINT, 1], extra[HELD_POINT, 2]
    ax, ay, az = extra[HELD_AXIS, 0], extra[HELD_AXIS, 1], extra[HELD_AXIS, 2]
    d2 = ux * ux + uy * uy + uz * uz
    along = ox * ax + oy * ay + oz * az
    root2 = along * along - (ox * ox + oy * oy + oz * oz) + d2
    if root2 < -_SLACK or d2 < _NEAR * _NEAR:
        return nearest
    d, root = math.sqrt(d2), math.sqrt(max(0.0, root2))
    other = 1 - g
    joined = groups[other, 0]
    groups[other, 0] = NO_JOINTS
    for side in range(2):
        t = -along + (root if side == 0 else -root)
        if t < _NEAR:
            continue
        px, py, pz = ox + t * ax, oy + t * ay, oz + t * az
        s = 1.0 / math.sqrt(px * px + py * py + pz * pz)
        make_parts(form, 0.0, px * s, py * s, pz * s, ux / d, uy / d, uz / d)
        for i in range(27):  # they were made as if of a shoulder
            parts[g, i] = parts[0, i]
            parts[other, i] = 0.0
        for i in range(3):
            spin[g, i] = spin[0, i]
        nearest = take_turns(form, g, side, lower, upper, mode, nearest)
    groups[other, 0] = joined
    return nearest


@outlined
def turn_shoulder(form, lower, upper, mode, nearest):
    """Aims by the shoulder, the other joints as in ``trial``; the squared way, where below ``nearest``."""
    keep_apart()
    extra, axes, target = form.extra, form.axes, form.target
    carry_hand(form, types.int64(0))
    for i in range(3):
        extra[HELD_POINT, i] -= axes[0, 3 + i]
    start_rotation(form)
    return turn_about(
        form, types.int64(0), lower, upper, mode, nearest,
        target[0, 0] - axes[0, 3], target[0, 1] - axes[0, 4], target[0, 2] - axes[0, 5],
    )  # fmt: skip


@outlined
def turn_wrist(form, lower, upper, mode, nearest):
    """Aims by a wrist of three hinges, shoulder and elbow as at the start."""
    keep_apart()
    extra, axes, target, start, m = form.extra, form.axes, form.target, form.start, form.matrices
    if form.groups[1, 0] != HINGES:
        return nearest
    start_rotation(form)
    x, y, z = target[0, 0] - axes[0, 3], target[0, 1] - axes[0, 4], target[0, 2] - axes[0, 5]
    x, y, z = apply_back(m, types.int64(START), x, y, z)
    x, y, z = x + axes[0, 3] - axes[3, 3], y + axes[0, 4] - axes[3, 4], z + axes[0, 5] - axes[3, 5]
    elbow = start[form.groups[1, 1] - 1]
    x, y, z = turn(axes[3, 0], axes[3, 1], axes[3, 2], math.cos(elbow), -math.sin(elbow), x, y, z)
    x, y, z = x + axes[3, 3] - axes[4, 3], y + axes[3, 4] - axes[4, 4], z + axes[3, 5] - axes[4, 5]
    for i in range(3):
        extra[HELD_POINT, i] = extra[POINT, i] - axes[4, 3 + i]
        extra[HELD_AXIS, i] = extra[AXIS, i]
    for j in range(3):  # what the start makes of the wrist, in the shoulder's place
        vx, vy, vz = 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0
        for back in range(3):
            k = 6 - back
            angle = start[form.groups[1, 1] + k - 4]
            vx, vy, vz = turn(
                axes[k, 0], axes[k, 1], axes[k, 2], math.cos(angle), math.sin(angle), vx, vy, vz
            )
        put_column(m, START, j, vx, vy, vz)
    return turn_about(form, types.int64(1), lower, upper, mode, nearest, x, y, z)
