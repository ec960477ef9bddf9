"""Closed forms of a limb for less than a pose: a point of the hand to a place, an axis of the hand aimed.

After Tolani, Goswami & Badler (Graphical Models 62, 2000).  With the joints of the wrist held, a point of
the hand is one of the forearm: elbow and swivel follow as for the wrist's centre (``limb.py``).  With all
joints but the shoulder's or the wrist's held, these aim (``aim.py``).  The rest is held where the least
motion of all joints would bring it, as seen from the start (one linear step inside the limits), so that no
joint must do all the work.  Where that is impossible inside the limits or leads far astray, it is held as
at the start, or one more joint is moved: a search along one number, the closed form at each of its values.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined
from robot_ik.kernels.linalg import box_step, normal_equations
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.kernels.room import room
from robot_ik.solvers.analytic.aim import turn_shoulder, turn_wrist
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.form import EVERY, SOLVE
from robot_ik.solvers.analytic.geometry import BALL_JOINT
from robot_ik.solvers.analytic.hand import carry_hand, keep_rest
from robot_ik.solvers.analytic.limb import limb

# Damping of the least motion, as a share of the largest entry of JᵀJ.
_DAMPING = 1e-6
# An answer farther than this many times the least motion (squared) leads astray.
_ASTRAY = 2.0
# Least motion (squared, rad) up to which the start counts as near, so that an answer must be near too.
_NEAR = 0.3
# The least motion is believed for so many rad.
_BELIEVED = 1.0
# Places on the way to a limit at which another joint is tried; from there halves, down to this share of the
# distance to the start.
_TRIED, _FINEST = 6, 1e-3
# Rows of form.branches, which a single answer leaves unused: the best so far, the least motion.
_BEST, _TOWARD = 0, 1


@outlined
def least_motion(tree, goal, work, form):
    """Where the joints beyond the shoulder go in the shortest step to the goal; its squared length."""
    keep_apart()
    normal, gradient, step, toward = work.normal, work.gradient, work.step, form.branches
    goal_jacobian(tree, goal, work, work.frames)
    normal_equations(work.jacobian, work.residual, normal, gradient)
    room(tree, goal, work)
    largest, n = 0.0, toward.shape[1]
    for u in range(step.shape[0]):
        largest = max(largest, normal[u, u])
    for u in range(step.shape[0]):
        normal[u, u] += _DAMPING * largest + 1e-30
    box_step(normal, gradient, work.low, work.high, step, work.free, work.side, work.factor)
    square = 0.0
    for u in range(step.shape[0]):
        square += step[u] * step[u]
    more = n - step.shape[0]  # a ball joint has a number more than it has freedoms
    for j in range(n):
        toward[_TOWARD, j] = step[j - more] if j >= form.groups[1, 1] - 1 else 0.0
    return square


@outlined
def moved_squared(form):
    """Squared distance of shoulder and elbow in ``form.best`` to the start; of a ball joint its turn."""
    best, start, column = form.best, form.start, form.groups[1, 1] - 1
    total, j = 0.0, types.int64(0)
    if form.groups[0, 0] == BALL_JOINT:
        cosine = best[0] * start[0] + best[1] * start[1] + best[2] * start[2] + best[3] * start[3]
        half = math.acos(min(1.0, abs(cosine)))
        total, j = 4.0 * half * half, column
    while j <= column:
        total += (best[j] - start[j]) * (best[j] - start[j])
        j += 1
    return total


@outlined
def attempt(form, aimed, share, joint, angle, nearest):
    """Tries the rest at a share of its least motion, one joint (of column >= 0) at an angle.

    What is nearer than ``nearest`` goes into the best row.  Returns the nearest.
    """
    keep_apart()
    trial, start, best, kept, lower, upper = (
        form.trial, form.start, form.best, form.branches, form.lower, form.upper,
    )  # fmt: skip
    first = form.groups[1, 1] - (1 if aimed else 0)
    spent, value = 0.0, math.inf
    for j in range(first, start.shape[0]):
        number = min(max(start[j] + share * kept[_TOWARD, j], lower[j]), upper[j])
        if j == joint:
            number = angle
        trial[0, j] = trial[1, j] = number
        spent += (number - start[j]) * (number - start[j])
    left = nearest - spent
    if not left > 0.0:
        return nearest
    if aimed:
        value = turn_shoulder(form, lower, upper, types.int64(SOLVE), left)
    else:
        carry_hand(form, types.int64(1))
        row, _ = limb(form, lower, upper, types.int64(SOLVE))
        if row > 0:
            value = moved_squared(form)
    if not value < left:
        return nearest
    for j in range(best.shape[0]):
        kept[_BEST, j] = best[j]
    return value + spent


@outlined
def search_along(form, aimed, nearest):
    """The nearest answer in which one joint more moves, if nearer than ``nearest``; which it returns."""
    keep_apart()
    start, lower, upper = form.start, form.lower, form.upper
    first = form.groups[1, 1] - (1 if aimed else 0)
    place, joint, width = 0.0, types.int64(-1), 0.0
    for j in range(first, start.shape[0]):
        for side in range(2):
            way = min(upper[j] - start[j], math.pi) if side == 0 else max(lower[j] - start[j], -math.pi)
            for k in range(1, _TRIED + 1):
                step = way * (k / _TRIED) ** 2
                if step * step >= nearest:
                    break
                value = attempt(form, aimed, 0.0, j, start[j] + step, nearest)
                if value < nearest:
                    nearest, place, joint, width = value, start[j] + step, j, abs(way) / _TRIED
    if joint < 0:
        return nearest
    while width > _FINEST * math.sqrt(nearest):  # downhill by halves; where the limits end, to their very end
        width *= 0.5
        for side in range(2):
            angle = min(max(place + (width if side == 0 else -width), lower[joint]), upper[joint])
            value = attempt(form, aimed, 0.0, joint, angle, nearest)
            if value < nearest:
                nearest, place = value, angle
                break
    return nearest


@outlined
def wrist_alone(form, nearest):
    """``attempt`` of the wrist, all other joints held as at the start."""
    keep_apart()
    best, kept = form.best, form.branches
    keep_rest(form)
    value = turn_wrist(form, form.lower, form.upper, types.int64(SOLVE), nearest)
    if value < nearest:
        for j in range(best.shape[0]):
            kept[_BEST, j] = best[j]
    return value


@outlined
def part_of_limb(tree, goal, work, form, aimed):
    """The answer into ``form.best``; 1 if there is one inside the limits, else -1."""
    keep_apart()
    best, kept = form.best, form.branches
    none = types.int64(-1)
    least = least_motion(tree, goal, work, form)
    share = min(1.0, _BELIEVED / math.sqrt(max(least, 1e-30)))
    nearest = attempt(form, aimed, share, none, 0.0, math.inf)
    if nearest > _ASTRAY * least:
        if aimed:
            nearest = wrist_alone(form, nearest)
        nearest = attempt(form, aimed, 0.5 * share, none, 0.0, nearest)
        nearest = attempt(form, aimed, 0.0, none, 0.0, nearest)
    if nearest == math.inf or (least < _NEAR and nearest > _ASTRAY * least):
        nearest = search_along(form, aimed, nearest)
    if nearest == math.inf:
        return -1
    for j in range(best.shape[0]):
        best[j] = kept[_BEST, j]
    return 1


@outlined
def branches_of_part(form, aimed, lower, upper):
    """The branches, what is not needed being held as at the start."""
    keep_apart()
    every = types.int64(EVERY)  # not as a constant, for which all would be compiled once more
    keep_rest(form)
    if aimed:
        turn_wrist(form, lower, upper, every, math.inf)
        keep_rest(form)
        turn_shoulder(form, lower, upper, every, math.inf)
    else:
        carry_hand(form, types.int64(1))
        limb(form, lower, upper, every)
