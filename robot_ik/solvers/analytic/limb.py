"""Closed form of a limb: spherical shoulder, elbow hinge, spherical wrist: one axis more than a pose needs.

After Tolani, Goswami & Badler (Real-time inverse kinematics techniques for anthropomorphic limbs,
Graphical Models 62, 2000): the elbow's angle follows from the distance of shoulder and wrist, and each
joint limit cuts the circle of swivel angles at places that are known in closed form (``edges.py``).
Between two cuts either all or none of the angles are inside the limits, so that no such interval is
missed, however narrow; inside them the angle nearest to the start is searched for.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.form import EVERY
from robot_ik.solvers.analytic.geometry import NO_JOINTS
from robot_ik.solvers.analytic.search import ANGLE, GAIN, SAME, VALUE, refine, scan, value_at
from robot_ik.solvers.analytic.six_axes import centre, relative_rotation
from robot_ik.solvers.analytic.subproblems import angles_to_height, image, turn
from robot_ik.solvers.analytic.swivel import WHOLE, apply_back, make_parts, put_column, start_rotation

# Metres by which the reach may be missed through rounding.
_SLACK = 1e-9


@outlined
def take_best(form, lower, upper, elbow, angle, moved, every, nearest):
    """Puts the best of the tally into ``form.best`` (if nearer than ``nearest``), or all into the branches.

    ``angle``: the elbow's, which moved by the square root of ``moved``.  Returns the nearest, squared.
    """
    keep_apart()
    tally, best, trial, branches = form.tally, form.best, form.trial, form.branches
    column = form.groups[1, 1] - 1
    end = trial.shape[1]
    for turn_of in range(4):
        row = types.int64(turn_of)
        if not every:
            for i in range(4):
                if tally[i, VALUE] < tally[row, VALUE]:
                    row = types.int64(i)
        if tally[row, VALUE] == math.inf or (not every and GAIN * tally[row, VALUE] + moved >= nearest):
            if every:
                continue
            break
        refine(form, lower, upper, row, math.inf if every else nearest - moved)
        if every or tally[row, VALUE] + moved < nearest:
            nearest = min(nearest, tally[row, VALUE] + moved)
            value_at(form, lower, upper, tally[row, ANGLE], row)
            for j in range(end):
                number = angle if j == column else trial[row // 2 if j < column else row % 2, j]
                if every:
                    branches[4 * elbow + row, j] = number
                else:
                    best[j] = number
        tally[row, VALUE] = math.inf
    return nearest


@outlined
def limb(form, lower, upper, mode):
    """The nearest solution inside the limits into ``form.best``, or the nearest of each branch.

    Branches are rows 4·elbow + 2·shoulder + wrist of ``form.branches``; those there already are replaced.
    Returns (1 if one is inside the limits else -1, how many elbows reach).
    """
    keep_apart()
    axes, extra, target, start = form.axes, form.extra, form.target, form.start
    every = mode == EVERY
    wx, wy, wz = centre(target, extra)
    sx, sy, sz = axes[0, 3], axes[0, 4], axes[0, 5]
    dx, dy, dz = wx - sx, wy - sy, wz - sz
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    ux, uy, uz = axes[3, 0], axes[3, 1], axes[3, 2]
    fx, fy, fz = sx - axes[3, 3], sy - axes[3, 4], sz - axes[3, 5]  # elbow -> shoulder
    ex, ey, ez = extra[0, 0] - axes[3, 3], extra[0, 1] - axes[3, 4], extra[0, 2] - axes[3, 5]
    height = 0.5 * (ex * ex + ey * ey + ez * ez + fx * fx + fy * fy + fz * fz - r * r)
    middle, half, _, possible = angles_to_height(fx, fy, fz, ux, uy, uz, ex, ey, ez, height, _SLACK)
    if not possible:
        return -1, 0
    start_rotation(form)
    if form.groups[1, 0] != NO_JOINTS:
        for j in range(3):
            x, y, z = relative_rotation(
                target, extra, 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0
            )
            put_column(form.matrices, WHOLE, j, x, y, z)
    column = form.groups[1, 1] - 1
    one, one_fits = image(middle + half, start[column], lower[column], upper[column])
    two, two_fits = image(middle - half, start[column], lower[column], upper[column])
    nearest = math.inf
    for k in range(2):
        other = (abs(two - start[column]) < abs(one - start[column])) == (k == 0)
        angle, fits = (two, two_fits) if other else (one, one_fits)
        moved = (angle - start[column]) * (angle - start[column])
        if not fits or (not every and (moved >= nearest or (k == 1 and half < SAME))):
            continue
        c, s = math.cos(angle), math.sin(angle)
        vx, vy, vz = turn(ux, uy, uz, c, s, ex, ey, ez)
        vx, vy, vz = vx - fx, vy - fy, vz - fz  # shoulder -> wrist, as the elbow makes it
        size = math.sqrt(vx * vx + vy * vy + vz * vz)
        if r > 1e-12 and size > 1e-12:
            make_parts(form, angle, vx / size, vy / size, vz / size, dx / r, dy / r, dz / r)
        else:  # folded onto the shoulder: it may turn as it likes
            vx, vy, vz = apply_back(form.matrices, types.int64(0), 0.0, 0.0, 1.0)
            make_parts(form, angle, vx, vy, vz, 0.0, 0.0, 1.0)
        scan(form, lower, upper, every, nearest - moved)
        nearest = take_best(form, lower, upper, types.int64(1 if other else 0), angle, moved, every, nearest)
    return (1 if nearest < math.inf else -1), 2
