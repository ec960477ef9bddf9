"""Closed form of a limb: spherical shoulder, elbow hinge, spherical wrist: one axis more than a pose needs.

After Tolani, Goswami & Badler (Real-time inverse kinematics techniques for anthropomorphic limbs,
Graphical Models 62, 2000): the elbow's angle follows from the distance of shoulder and wrist, and each
joint limit cuts the circle of swivel angles at points that are known in closed form (``recognise.py``).
Between two cuts either all or none of the angles are inside the limits, so that no such interval is
missed, however narrow; inside them the angle nearest to the start is searched for.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import unit
from robot_ik.kernels.vectors import apply, apply_back, dot, length, minus, over, rotate, three
from robot_ik.solvers.analytic import swivel
from robot_ik.solvers.analytic.recognise import HINGES, NO_JOINTS
from robot_ik.solvers.analytic.six_axes import centre, relative_rotation
from robot_ik.solvers.analytic.subproblems import EVERY, angles_to_height, image, noinline

# Angles at which a range of swivel angles is evaluated, besides its cuts: a wide one, and one near the start.
_WIDE, _NEAR, _NEAR_RANGE = 12, 2, 0.3
# Cuts nearer than this (rad) are one.
SAME = 1e-12
# Cosine from which two axes are so nearly in line that this very angle is evaluated.
_IN_LINE = 1.0 - 1e-12
# Columns of the tally.
VALUE, ANGLE, LOW, HIGH = 0, 1, 2, 3
# Refining a sample seldom brings its squared distance below this share.
GAIN = 0.6
# Swivel angles (rad) nearer than this are one to the search, which takes at most so many steps.
_REFINED, _MOST_STEPS = 1e-7, 15


@pure
def sinusoid(parts, g, y, x):
    """a, b, c of yᵀ R(φ) x = a + b cos φ + c sin φ; R of the shoulder (g = 0) or the wrist (1)."""
    return dot(y, apply(parts, g, 0, x)), dot(y, apply(parts, g, 9, x)), dot(y, apply(parts, g, 18, x))


@outlined
def add_cut(cuts, count, angle, widest):
    """One more cut, in order of size, if it lies within ±widest; returns how many there are."""
    noinline()
    angle -= 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
    if abs(angle) >= widest or count >= cuts.shape[0]:
        return count
    i = count
    while i > 0 and cuts[i - 1] > angle:
        cuts[i] = cuts[i - 1]
        i -= 1
    cuts[i] = angle
    return count + 1


@pure
def smallest(tally):
    """The squared distance of the best combination."""
    return min(tally[0, VALUE], tally[1, VALUE], tally[2, VALUE], tally[3, VALUE])


@outlined
def evaluate_angle(form, lower, upper, angle, low, high, nearest):
    """Looks at one swivel angle: notes in the tally where a combination of flips is nearer; whether any fits.

    What cannot come nearer than the squared distance ``nearest`` is not evaluated to the end.
    """
    noinline()
    tally, scores = form.tally, form.scores
    c, s = math.cos(angle), math.sin(angle)
    for g in range(2):
        swivel.swing(form, g, c, s)
        closest = swivel.score(form, g, 0, 1, lower, upper)
        if closest == math.inf:
            return False
        if g == 0 and GAIN * closest > nearest:
            return True
    for i in range(4):
        value = scores[i // 2] + scores[2 + i % 2]
        if value < tally[i, VALUE]:
            tally[i, VALUE], tally[i, ANGLE], tally[i, LOW], tally[i, HIGH] = value, angle, low, high
    return True


@outlined
def find_cuts(form, lower, upper, widest):
    """All swivel angles within ±widest at which a joint meets a limit; returns how many."""
    noinline()
    parts, edges, cuts, axes = form.parts, form.edges, form.cuts, form.axes
    cuts[0], cuts[1] = -widest, widest
    count = types.int64(2)
    for e in range(edges.shape[0]):
        g = types.int64(edges[e, 0])
        if g >= 2:
            g -= 2
            a = parts[g, 0] + parts[g, 4] + parts[g, 8]
            b = parts[g, 9] + parts[g, 13] + parts[g, 17]
            c = parts[g, 18] + parts[g, 22] + parts[g, 26]
        else:
            a, b, c = sinusoid(parts, g, three(edges, e, 1), three(edges, e, 4))
        rest, amplitude = edges[e, 7] - a, math.sqrt(b * b + c * c)
        if amplitude < 1e-12 or abs(rest) > amplitude + 1e-12:
            continue
        middle = math.atan2(c, b)
        half = math.atan2(math.sqrt(max(0.0, (amplitude - rest) * (amplitude + rest))), rest)
        count = add_cut(cuts, count, middle + half, widest)
        count = add_cut(cuts, count, middle - half, widest)
    for g in range(2):
        if form.groups[g, 0] != HINGES:
            continue
        k = 4 * g
        a, b, c = sinusoid(parts, g, three(axes, k, 0), three(axes, k + 2, 0))
        amplitude = math.sqrt(b * b + c * c)
        if amplitude < 1e-12:
            continue
        for end in range(2):  # where axes 1 and 3 are most nearly in line
            if abs(a + amplitude * (1 - 2 * end)) > _IN_LINE:  # an angle more is free, just there
                angle = math.atan2(c, b) + math.pi * end
                evaluate_angle(form, lower, upper, angle, angle, angle, math.inf)
    return count


@outlined
def value_at(form, lower, upper, angle, row):
    """Squared distance to the start at one swivel angle, for the flips of ``row`` of the tally.

    Half its slope and the squared speed of the joints go into scores[4], scores[5].
    """
    noinline()
    c, s, value, scores = math.cos(angle), math.sin(angle), 0.0, form.scores
    scores[4] = scores[5] = 0.0
    for g in range(2):
        swivel.swing(form, g, c, s)
        flip = row // 2 if g == 0 else row % 2
        value += swivel.score(form, g, flip, flip, lower, upper)
        if value == math.inf:
            break
        swivel.add_slope(form, g, flip)
    return value


@outlined
def refine(form, lower, upper, row, nearest):
    """Improves the angle of a row of the tally inside its cell: secants on the slope of the distance.

    Gives up where the distance is not likely to fall below ``nearest``.
    """
    noinline()
    tally, scores = form.tally, form.scores
    low, high = tally[row, LOW], tally[row, HIGH]
    x = tally[row, ANGLE]
    value = value_at(form, lower, upper, x, row)
    if scores[5] == math.inf:  # where two flips meet: begin a little beside it
        for side in range(2):
            u = x + 0.1 * ((high if side == 0 else low) - x)
            value = value_at(form, lower, upper, u, row)
            if value < math.inf and scores[5] < math.inf:
                low, high, x = (x, high, u) if side == 0 else (low, x, u)
                break
    slope, curve = scores[4], max(scores[5], 1e-12)
    if value - 1.5 * slope * slope / curve >= nearest:
        return
    step = -slope / curve
    width = high - low
    for k in range(_MOST_STEPS):
        if slope < 0.0:
            low = x
        else:
            high = x
        u = min(max(x + step, low), high)
        if abs(u - x) < _REFINED:
            break
        if k > 3 and high - low > 0.6 * width:  # where two flips meet, slopes say little
            u = 0.5 * (low + high)
        width = high - low
        value = value_at(form, lower, upper, u, row)
        if value < tally[row, VALUE]:
            tally[row, VALUE], tally[row, ANGLE] = value, u
        if value == math.inf or scores[5] == math.inf:  # the very end of the cell
            low, high = (low, u) if u > x else (u, high)
            step = 0.5 * (u - x)
            continue
        curve = (scores[4] - slope) / (u - x)
        if not curve > 1e-3 * scores[5]:
            curve = max(scores[5], 1e-12)
        x, slope = u, scores[4]
        step = -slope / curve


@outlined
def around_start(form, count, spacing):
    """Where the start's own swivel leads the tally: the cell round it, in which it may be improved."""
    tally, cuts = form.tally, form.cuts
    low, high = -spacing, spacing
    for j in range(count):
        if low < cuts[j] < -SAME:
            low = cuts[j]
        if SAME < cuts[j] < high:
            high = cuts[j]
    for i in range(4):
        if tally[i, ANGLE] == 0.0:
            tally[i, LOW], tally[i, HIGH] = low, high


@outlined
def scan(form, lower, upper, every, nearest):
    """Fills the tally: the best swivel angle of each combination of flips, within reach of ``nearest``.

    A shoulder turned by φ more than need be has turned by φ at least, so its joints (of three hinges) have
    moved by φ/√3: an angle beyond that cannot be nearer than ``nearest``, a squared distance.
    """
    noinline()
    tally, cuts = form.tally, form.cuts
    for i in range(4):
        tally[i, VALUE] = math.inf
    evaluate_angle(form, lower, upper, 0.0, 0.0, 0.0, math.inf)
    widest = math.pi
    if not every:
        nearest = min(nearest, smallest(tally))
        widest = min(math.pi, math.sqrt(3.0 * nearest) + 1e-6)
    spacing = widest / _WIDE * 2.0 if widest > _NEAR_RANGE else widest / _NEAR * 2.0
    count = find_cuts(form, lower, upper, widest)
    around_start(form, count, spacing)
    right = 0
    while right < count - 1 and cuts[right + 1] <= 0.0:
        right += 1
    left = right - 1
    while left >= 0 or right < count - 1:  # the cells, from the start outwards
        if left < 0 or (right < count - 1 and cuts[right] < -cuts[left + 1]):
            i, right = right, right + 1
        else:
            i, left = left, left - 1
        low, high = cuts[i], cuts[i + 1]
        if high - low < SAME:
            continue
        samples = math.ceil((high - low) / spacing)
        step = (high - low) / samples
        for k in range(samples):
            angle = low + (k + 0.5) * step
            fits = evaluate_angle(
                form, lower, upper, angle, max(low, angle - step), min(high, angle + step),
                math.inf if every else min(nearest, smallest(tally)),
            )  # fmt: skip
            if not fits:
                break  # nor will any other in this cell
    # A goal at the very corner of the limits may have a single angle, which is a cut: searched for near the
    # start, so that a path along the limits does not leap, and everywhere where nothing else was found.
    alone = every or smallest(tally) == math.inf
    for j in range(count):
        if alone or abs(cuts[j]) < _NEAR_RANGE:
            low = max(cuts[max(j - 1, 0)], cuts[j] - spacing)
            high = min(cuts[min(j + 1, count - 1)], cuts[j] + spacing)
            evaluate_angle(form, lower, upper, cuts[j], low, high, math.inf)


@outlined
def take_best(form, lower, upper, elbow, angle, moved, every, nearest):
    """Puts the best of the tally into ``form.best`` (if nearer than ``nearest``), or all into the branches.

    ``angle``: the elbow's, which moved by the square root of ``moved``.  Returns the nearest, squared.
    """
    noinline()
    tally, best, trial, branches = form.tally, form.best, form.trial, form.branches
    column = form.groups[1, 1] - 1
    end = trial.shape[1]
    for attempt in range(4):
        row = types.int64(attempt)
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
    Returns whether one is inside the limits, and whether the elbow reaches.
    """
    noinline()
    axes, extra, target, start = form.axes, form.extra, form.target, form.start
    every = mode == EVERY
    shoulder, elbow, u = three(axes, 0, 3), three(axes, 3, 3), three(axes, 3, 0)
    d = minus(centre(target, extra), shoulder)
    r = length(d)
    f, e = minus(shoulder, elbow), minus(three(extra, 0, 0), elbow)
    middle, half, _, possible = angles_to_height(f, u, e, 0.5 * (dot(e, e) + dot(f, f) - r * r))
    if not possible:
        return False, False
    swivel.start_rotation(form)
    if form.groups[1, 0] != NO_JOINTS:
        for j in range(3):
            swivel.put_column(form.matrices, swivel.WHOLE, j, relative_rotation(target, extra, unit(j)))
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
        # Shoulder -> wrist, as the elbow makes it.
        v = minus(rotate(u, math.cos(angle), math.sin(angle), e), f)
        size = length(v)
        if r > 1e-12 and size > 1e-12:
            swivel.make_parts(form, angle, over(v, size), over(d, r))
        else:  # folded onto the shoulder: it may rotate freely
            z = 0.0, 0.0, 1.0
            swivel.make_parts(form, angle, apply_back(form.matrices, swivel.START, 0, z), z)
        scan(form, lower, upper, every, nearest - moved)
        row = types.int64(1 if other else 0)
        nearest = take_best(form, lower, upper, row, angle, moved, every, nearest)
    return nearest < math.inf, True
