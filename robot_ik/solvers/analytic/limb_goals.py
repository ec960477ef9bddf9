"""Closed forms of a limb for less than a pose: a point of the hand to a place, an axis of the hand aimed.

After Tolani, Goswami & Badler (Graphical Models 62, 2000).  With the joints of the wrist held, a point of
the hand is one of the forearm: elbow and swivel follow as for the wrist's centre (``limb.py``).  With all
joints but the shoulder's or the wrist's held, these aim.  The rest is held where the least
motion of all joints would bring it, as seen from the start (one linear step inside the limits), so that no
joint must do all the work.  Where that is impossible inside the limits or leads far astray, it is held as
at the start, or one more joint is moved: a search along one number, the closed form at each of its values.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import noinline, outlined
from robot_ik.kernels.linalg import box_step, normal_equations
from robot_ik.kernels.loop import step_bounds
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.solvers.analytic.limb import ANGLE, GAIN, VALUE, limb, refine, scan, value_at
from robot_ik.solvers.analytic.recognise import BALL_JOINT, HINGES, NO_JOINTS
from robot_ik.solvers.analytic.subproblems import EVERY, SOLVE, turn
from robot_ik.solvers.analytic.swivel import START, apply_back, make_parts, put_column, start_rotation

# ------------------------------------------------------------------------------------------
# Where the joints beyond a limb's shoulder hold the hand's point and axis.


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
    noinline()
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


# ------------------------------------------------------------------------------------------
# Aims an axis of the hand at a point in space by turning it about one point: shoulder or wrist.
#
# Let the axis start at o and point along a, both seen from the centre of the turn, and let what it is aimed
# at be d away from there.  Then the place on the axis that comes to lie there is o + t a with
#
#     |o + t a| = d,  t > 0:   t = -o·a ± √((o·a)² - |o|² + d²)
#
# The turn must bring that place to the goal's direction u; what is left free is a turn about u.  That is the
# swivel angle once more, so that its ranges inside the joint limits are known exactly (``limb.py``).


# Nearer than this (m) to the goal an axis hardly has a direction, and a centre cannot be turned about.
_NEAR_AIM = 1e-5
# Square metres of rounding in the root above.
_SLACK = 1e-13


@outlined
def take_turns(form, g, side, lower, upper, mode, nearest):
    """The best turns of shoulder (g = 0) or wrist (1) into ``form.best``, or the flips into the branches."""
    noinline()
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
    noinline()
    extra, parts, spin, groups = form.extra, form.parts, form.spin, form.groups
    ox, oy, oz = extra[HELD_POINT, 0], extra[HELD_POINT, 1], extra[HELD_POINT, 2]
    ax, ay, az = extra[HELD_AXIS, 0], extra[HELD_AXIS, 1], extra[HELD_AXIS, 2]
    d2 = ux * ux + uy * uy + uz * uz
    along = ox * ax + oy * ay + oz * az
    root2 = along * along - (ox * ox + oy * oy + oz * oz) + d2
    if root2 < -_SLACK or d2 < _NEAR_AIM * _NEAR_AIM:
        return nearest
    d, root = math.sqrt(d2), math.sqrt(max(0.0, root2))
    other = 1 - g
    joined = groups[other, 0]
    groups[other, 0] = NO_JOINTS
    for side in range(2):
        t = -along + (root if side == 0 else -root)
        if t < _NEAR_AIM:
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
    noinline()
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
    noinline()
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


# Damping of the least motion, as a share of the largest entry of JᵀJ.
_DAMPING = 1e-6
# An answer farther than this many times the least motion (squared) leads astray.
_ASTRAY = 2.0
# Least motion (squared, rad) up to which the start counts as near, so that an answer must be near too.
_NEAR = 0.3
# The linear model of the least motion holds for so many rad.
_BELIEVED = 1.0
# Places on the way to a limit at which another joint is tried; from there halves, down to this share of the
# distance to the start.
_TRIED, _FINEST = 6, 1e-3
# Rows of form.branches, which a single answer leaves unused: the best so far, the least motion.
_BEST, _TOWARD = 0, 1


@outlined
def least_motion(tree, goal, work, form):
    """Where the joints beyond the shoulder go in the shortest step to the goal; its squared length."""
    noinline()
    normal, gradient, step, toward = work.normal, work.gradient, work.step, form.branches
    goal_jacobian(tree, goal, work, work.frames)
    normal_equations(work.jacobian, work.residual, normal, gradient)
    step_bounds(tree, goal, work)
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
    noinline()
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
    noinline()
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
    noinline()
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
    noinline()
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
    noinline()
    every = types.int64(EVERY)  # not as a constant, for which all would be compiled once more
    keep_rest(form)
    if aimed:
        turn_wrist(form, lower, upper, every, math.inf)
        keep_rest(form)
        turn_shoulder(form, lower, upper, every, math.inf)
    else:
        carry_hand(form, types.int64(1))
        limb(form, lower, upper, every)
