"""Closed form of two parallel hinges that bring a point to a place: the law of cosines."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import outlined
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.subproblems import angle_between, angles_to_height, turn

# Metres off the plane of motion, or beyond the reach, that still are rounding.
_SLACK = 1e-9


@outlined
def planar_two_link(axes, extra, target, start, slack, branches):
    """Both elbows of a two-link arm for a position; ``extra`` row 0 is the tool at q = 0.

    Fills ``branches`` (8, n), rows 0 and 1; returns how many exist.  ``slack`` (m): how far the target may
    lie off the plane in which the tool moves.
    """
    keep_apart()
    for row in range(branches.shape[0]):
        for j in range(branches.shape[1]):
            branches[row, j] = math.nan
    ux, uy, uz = axes[0, 0], axes[0, 1], axes[0, 2]
    along = 1.0 if ux * axes[1, 0] + uy * axes[1, 1] + uz * axes[1, 2] > 0.0 else -1.0
    gx, gy, gz = target[0, 0] - axes[0, 3], target[0, 1] - axes[0, 4], target[0, 2] - axes[0, 5]
    ex, ey, ez = extra[0, 0] - axes[1, 3], extra[0, 1] - axes[1, 4], extra[0, 2] - axes[1, 5]
    fx, fy, fz = axes[0, 3] - axes[1, 3], axes[0, 4] - axes[1, 4], axes[0, 5] - axes[1, 5]
    gu = gx * ux + gy * uy + gz * uz
    ee, fe = ex * ux + ey * uy + ez * uz, fx * ux + fy * uy + fz * uz
    if abs(gu - (ee - fe)) > slack:
        return 0
    reach = (ex * ex + ey * ey + ez * ez - ee * ee) + (fx * fx + fy * fy + fz * fz - fe * fe)
    far = gx * gx + gy * gy + gz * gz - gu * gu
    mid, half, amplitude, possible = angles_to_height(
        fx, fy, fz, ux, uy, uz, ex, ey, ez, 0.5 * (reach - far) + fe * ee, _SLACK
    )
    if not possible:
        return 0
    for elbow in range(2):
        a2 = along * start[1] if amplitude < 1e-12 else (mid + half if elbow == 0 else mid - half)
        vx, vy, vz = turn(ux, uy, uz, math.cos(a2), math.sin(a2), ex, ey, ez)
        q1, weight = angle_between(ux, uy, uz, vx - fx, vy - fy, vz - fz, gx, gy, gz)
        if weight < 1e-14:
            q1 = start[0]  # folded onto the first axis: every angle will do
        branches[elbow, 0], branches[elbow, 1] = q1, along * a2
    return 2
