"""Subproblems of rotation that make up the closed forms, and their shared arrays.

After Paden (Kinematics and control of robot manipulators, 1986) and Elias & Wen (IK-Geo: unified
robot inverse kinematics using subproblem decomposition, 2022, subproblems 1, 3 and 4).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from typing import Any

from numba import types
from numba.extending import intrinsic

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.kinematics import clip
from robot_ik.kernels.residuals import GOALS
from robot_ik.kernels.search import (
    BLOCKED,
    CONVERGED,
    SEARCH,
    STALLED,
    copy,
    count_all_goals,
    keep_best,
    measure,
)
from robot_ik.kernels.tree import TREE

# m or cosine. Rounding error that is allowed for a reach, or for the plane of a motion.
SLACK = 1e-9


@intrinsic
def noinline(_typing: Any) -> Any:
    """Keep LLVM from inlining the calling function, which would take long to compile."""

    def mark(_context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.function.attributes.add("noinline")
        return _context.get_dummy_value()

    return types.none(), mark


@inlined
def angle_between(k, p, q):
    """Subproblem 1: return the angle about k from p to q, and the product of their distances to k.

    If the product is zero, every angle is a solution. The parts along k are removed first.
    Otherwise the products of vectors nearly parallel to k, as near a singular pose, would cancel
    all digits.
    """
    p = so3.subtract(p, so3.scale(so3.dot(k, p), k))
    q = so3.subtract(q, so3.scale(so3.dot(k, q), k))
    a = so3.dot(p, q)
    b = so3.dot(k, so3.cross(p, q))
    return math.atan2(b, a), math.sqrt(a * a + b * b)


@inlined
def height_terms(h, k, p):
    """Return c, a, centre of h · R(k, θ) p = c + a · cos(θ − centre)."""
    constant = so3.dot(h, k) * so3.dot(k, p)
    a = so3.dot(h, p) - constant
    b = so3.dot(h, so3.cross(k, p))
    return constant, math.sqrt(a * a + b * b), math.atan2(b, a)


@inlined
def angles_to_height(h, k, p, height):
    """Subproblem 4: return the angles θ about k with h · R(k, θ) p = height.

    The result is (centre, half, amplitude, possible), with θ = centre ± half. If the amplitude is
    zero, θ is free. It is possible if the height is met within ``SLACK``, in the unit of h·p.
    """
    constant, amplitude, middle = height_terms(h, k, p)
    rest = height - constant
    if amplitude < 1e-12:
        return 0.0, 0.0, amplitude, abs(rest) <= SLACK
    if abs(rest) > amplitude + SLACK:
        return 0.0, 0.0, amplitude, False
    # atan2 of sine and cosine: exact near 0, where acos loses half the digits.
    across = math.sqrt(max(0.0, (amplitude - rest) * (amplitude + rest)))
    return middle, math.atan2(across, rest), amplitude, True


@inlined
def image(angle, start, lower, upper):
    """Return the angle modulo 2π nearest to ``start`` inside the limits, and whether it exists."""
    revolution = 2.0 * math.pi
    nearest = angle + revolution * math.floor((start - angle) / revolution + 0.5)
    if nearest > upper + 1e-9:
        nearest -= revolution * math.ceil((nearest - upper - 1e-9) / revolution)
    elif nearest < lower - 1e-9:
        nearest += revolution * math.ceil((lower - 1e-9 - nearest) / revolution)
    inside = lower - 1e-9 <= nearest <= upper + 1e-9
    return min(max(nearest, lower), upper), inside


@inlined
def split_inside(total, sign, a, b, lower_a, upper_a, lower_b, upper_b):
    """Return the α, β nearest to a and b inside the limits with α + sign·β = total (mod 2π).

    If no such pair is inside the limits, return the nearest pair.
    """
    revolution = 2.0 * math.pi
    rest = total - a - sign * b
    rest -= revolution * math.floor(rest / revolution + 0.5)
    best_a = a + 0.5 * rest
    best_b = b + 0.5 * sign * rest
    closest = math.inf
    for k in range(-2, 3):
        difference = rest + revolution * k
        # β = b + sign·(difference - (α - a)) inside its limits, as limits of α.
        lower = a + difference - sign * ((upper_b if sign > 0.0 else lower_b) - b)
        upper = a + difference - sign * ((lower_b if sign > 0.0 else upper_b) - b)
        lower = max(lower, lower_a)
        upper = min(upper, upper_a)
        if lower > upper + 1e-9:
            continue
        alpha = min(max(a + 0.5 * difference, lower), upper)
        beta = b + sign * (difference - (alpha - a))
        distance = (alpha - a) * (alpha - a) + (beta - b) * (beta - b)
        if distance < closest:
            best_a = alpha
            best_b = beta
            closest = distance
    return best_a, best_b


# With n joints of the chain.
FORM = Layout(
    "Form",
    family="int",
    qadr="ints",  # (n,) coordinate of each joint in q
    axes="table",  # (n, 6)
    extra="table",  # (5, 3)
    lower="floats",  # (n,) limits
    upper="floats",  # (n,)
    start="floats n",
    best="floats n",
    branches="table 8 n",
    target="table 1 12",  # the goal in the world
    inverse="table 1 12",  # its inverse, for arms that are solved from the tool
)
RUN = Layout("ClosedFormRun", tree=TREE, goals=GOALS, search=SEARCH, form=FORM)
open_run = RUN.open

# Modes of a run: find the solution, find every branch even for a start at the goal, or only measure
# the start.
SOLVE, EVERY, START_ONLY = range(3)


@outlined
def measure_start(tree, goals, search, form, mode):
    """Measure the start; return whether it is no solution, so the closed form is needed."""
    count_all_goals(goals, search)
    search.iterations = 0
    copy(search.start, search.q)
    clip(tree, goals.nodes, search.q)
    within = measure(tree, goals, search)
    keep_best(search)
    search.status = CONVERGED if within else STALLED
    if mode == START_ONLY or (within and mode == SOLVE):
        return False
    for j in range(form.qadr.shape[0]):
        form.start[j] = search.q[form.qadr[j]]
    for i in range(3):
        form.target[0, i] = search.target[i, 3]
        for j in range(3):
            form.target[0, 3 + 3 * i + j] = search.target[i, j]
    search.iterations = 1
    return True


@outlined
def take_branch(tree, goals, search, form, inside, exists):
    """Take ``form.best`` as the solution if a branch that exists is ``inside`` the limits."""
    if not inside:
        search.status = BLOCKED if exists else STALLED
        return
    for j in range(form.qadr.shape[0]):
        search.q[form.qadr[j]] = form.best[j]
    clip(tree, goals.nodes, search.q)
    within = measure(tree, goals, search)
    search.status = CONVERGED if within else STALLED
    if within or search.cost < search.best_cost:
        keep_best(search)
    else:
        copy(search.best, search.q)
        measure(tree, goals, search)  # so that the error is that of the solution


@outlined
def invert(target, inverse):
    """Write the inverse of the pose row target[0] to inverse[0]."""
    x, y, z = so3.apply_inverse(so3.read_rotation(target, 0), so3.read_vector(target, 0, 0))
    inverse[0, 0] = -x
    inverse[0, 1] = -y
    inverse[0, 2] = -z
    for i in range(3):
        for j in range(3):
            inverse[0, 3 + 3 * i + j] = target[0, 3 + 3 * j + i]


@inlined
def clear(branches):
    """Write NaN to all rows: no branch."""
    for row in range(branches.shape[0]):
        for j in range(branches.shape[1]):
            branches[row, j] = math.nan


@outlined
def nearest(form):
    """Write the branch inside the limits nearest to the start, by squared angles, to ``form.best``.

    Multiples of 2π move each angle first, in ``form.branches`` too. Returns whether a branch is
    inside the limits, and whether any branch exists.
    """
    branches = form.branches
    start = form.start
    lower = form.lower
    upper = form.upper
    best = form.best
    exists = False
    closest = math.inf
    for row in range(branches.shape[0]):
        if math.isnan(branches[row, 0]):
            continue
        exists = True
        fits = True
        distance = 0.0
        for j in range(best.shape[0]):
            angle, inside = image(branches[row, j], start[j], lower[j], upper[j])
            branches[row, j] = angle if inside else branches[row, j]
            fits = fits and inside
            distance += (angle - start[j]) * (angle - start[j])
        if fits and distance < closest:
            closest = distance
            for j in range(best.shape[0]):
                best[j] = branches[row, j]
    return closest < math.inf, exists
