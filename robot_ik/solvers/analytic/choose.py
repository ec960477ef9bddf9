"""Which branch: the one inside the limits that is nearest to the start."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import outlined
from robot_ik.solvers.analytic.subproblems import image


@outlined
def nearest(branches, start, lower, upper, best):
    """The branch inside the limits nearest to ``start`` (least squares of the angles), into ``best``.

    Each angle is first moved by whole turns.  Rewrites ``branches`` so; returns the row, or -1.
    """
    chosen = -1
    closest = math.inf
    n = branches.shape[1]
    for row in range(branches.shape[0]):
        if math.isnan(branches[row, 0]):
            continue
        distance = 0.0
        fits = True
        for j in range(n):
            angle, inside = image(branches[row, j], start[j], lower[j], upper[j])
            branches[row, j] = angle if inside else branches[row, j]
            fits = fits and inside
            distance += (angle - start[j]) * (angle - start[j])
        if fits and distance < closest:
            closest = distance
            chosen = row
    if chosen >= 0:
        for j in range(n):
            best[j] = branches[chosen, j]
    return chosen
