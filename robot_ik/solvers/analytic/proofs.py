"""Proofs that no joint angles inside the limits bring the frame within tolerance of its target.

The formulas of the closed forms are followed with intervals in place of numbers: the
wrist's centre is known to the tolerance of the position and what that of the angle makes of the tool's
length.  Where every branch ends in an empty set or beyond a limit, nothing within tolerance can be reached.
Near singular poses the intervals grow until nothing is proven; they never grow too little.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.vectors import cross, dot, length, minus, plus, rotate, scaled, three
from robot_ik.solvers.analytic.recognise import Family
from robot_ik.solvers.analytic.six_axes import (
    after_arm,
    back,
    before_arm,
    centre,
    relative_back,
    relative_rotation,
    same_way,
)  # fmt: skip
from robot_ik.solvers.analytic.subproblems import angle_between, height_terms, invert, noinline, open_form

# Intervals of angles: what is left of a closed form when its target is known only to a tolerance.
# An interval is its middle and its radius; a radius of pi or more is everything.  All bounds are outer ones:
# the true set lies inside, so that an empty one is a proof.

# Rounding allowed for: of angles (an arc cosine near 1 loses half the digits) and of metres or cosines.
_ANGLE_PAD, PAD = 1e-6, 1e-9


@pure
def may_fit(middle, radius, lower, upper):
    """Whether an angle of the interval, up to multiples of 2π, may lie inside the limits."""
    radius += _ANGLE_PAD
    whole = 2.0 * math.pi
    if radius >= math.pi or upper - lower >= whole:
        return True
    revolutions = math.ceil((lower - middle - radius) / whole)
    return middle - radius + whole * revolutions <= upper


@pure
def arc(low, high, amplitude):
    """The half-angles h in [0, pi] with amplitude · cos h in [low, high]: middle, radius, whether any."""
    if amplitude <= PAD:
        return 0.5 * math.pi, 0.5 * math.pi, low <= 2.0 * PAD and high >= -2.0 * PAD
    if low > amplitude + PAD or high < -amplitude - PAD:
        return 0.0, 0.0, False
    first = math.acos(min(max(high / amplitude, -1.0), 1.0))
    last = math.acos(min(max(low / amplitude, -1.0), 1.0))
    return 0.5 * (first + last), 0.5 * (last - first) + _ANGLE_PAD, True


@pure
def third_side(squares, far, error, amplitude):
    """``arc`` of the angle between sides whose squares add up to that, where the third is far ± error."""
    near_side, far_side = max(0.0, far - error), far + error
    low, high = 0.5 * (squares - far_side * far_side), 0.5 * (squares - near_side * near_side)
    return arc(low - PAD, high + PAD, amplitude)


@pure
def chord(angle, radius):
    """How far a rotation by at most ``angle`` moves a point at ``radius`` from its axis."""
    return 2.0 * radius * math.sin(0.5 * min(angle, math.pi))


@pure
def spread(error, length):
    """How far the direction of a plane vector of that length may turn when its end errs by ``error``."""
    return math.asin(error / length) if error < length else math.pi


@pure
def azimuth_spread(error, polar):
    """How far the azimuth of a direction at ``polar`` from the pole may turn when it errs by ``error``."""
    if error >= min(polar, math.pi - polar):
        return math.pi
    return math.asin(min(1.0, math.sin(error) / math.sin(polar)))


@pure
def polar_angle(h, v):
    """Angle between two vectors."""
    return math.atan2(length(cross(h, v)), dot(h, v))


@pure
def off_axis(k, v):
    """Distance of v from the line along the unit vector k through the origin."""
    return length(cross(k, v))


@pure
def centre_error(tolerance, lever):
    """How far the wrist's centre may be off, at ``lever`` metres from the frame."""
    return tolerance[0, 0] + chord(tolerance[0, 1], lever) + PAD


@pure
def heights(h, k, p, low, high):
    """Angles θ about k with h · R(k, θ) p in [low, high] (padded): centre, half, radius, whether any."""
    constant, amplitude, middle = height_terms(h, k, p)
    half, radius, some = arc(low - constant, high - constant, amplitude)
    return middle, half, radius, some


@pure
def tilts(h, k, p, polar, error):
    """``heights`` at which R(k, θ) p is off h by ``polar`` ± ``error``."""
    low, high = math.cos(min(math.pi, polar + error)), math.cos(max(0.0, polar - error))
    return heights(h, k, p, low - PAD, high + PAD)


@pure
def elbows(u, f, e, far, error):
    """Elbow angles about u that bring the end far ± error from the first axis: as ``heights``.

    f and e lead from the elbow to the first axis and to the end, at q = 0.
    """
    lf, le = off_axis(u, f), off_axis(u, e)
    _, amplitude, middle = height_terms(f, u, e)
    half, radius, some = third_side(lf * lf + le * le, far, error, amplitude)
    return middle, half, radius, some


@pure
def first_link_range(u, f, e, elbow, radius, g, error):
    """Angle of the first link that brings the end to g ± error, for an elbow ± radius; and its radius."""
    v = minus(rotate(u, math.cos(elbow), math.sin(elbow), e), f)
    angle, _ = angle_between(u, v, g)
    return angle, spread(error, off_axis(u, g)) + spread(chord(radius, off_axis(u, e)), off_axis(u, v))


@kernel
def prove_planar(goals, form):
    """Whether no joint angles bring the form's target within tolerance: two parallel hinges, a position."""
    form, tolerance = open_form(form), open_goals(goals).tolerance
    axes, lower, upper = form.axes, form.lower, form.upper
    u, p1, p2 = three(axes, 0, 0), three(axes, 0, 3), three(axes, 1, 3)
    along = same_way(u, axes, 1)
    g, e, f = minus(three(form.target, 0, 0), p1), minus(three(form.extra, 0, 0), p2), minus(p1, p2)
    error = tolerance[0, 0] + PAD
    if abs(dot(plus(minus(g, e), f), u)) > error:
        return True
    middle, half, radius, some = elbows(u, f, e, off_axis(u, g), error)
    if not some:
        return True
    for a in (middle + half, middle - half):
        if may_fit(along * a, radius, lower[1], upper[1]):
            first, wide = first_link_range(u, f, e, a, radius, g, error)
            if may_fit(first, wide, lower[0], upper[0]):
                return False
    return True


@kernel
def prove_limb(goals, form):
    """The same for a limb: only by the distance of shoulder and wrist, and the limits of the elbow."""
    form, tolerance = open_form(form), open_goals(goals).tolerance
    axes, extra = form.axes, form.extra
    error = centre_error(tolerance, length(three(extra, 1, 0)))
    shoulder, elbow = three(axes, 0, 3), three(axes, 3, 3)
    r = length(minus(centre(form.target, extra), shoulder))
    f, e = minus(shoulder, elbow), minus(three(extra, 0, 0), elbow)
    constant, amplitude, middle = height_terms(f, three(axes, 3, 0), e)
    half, radius, some = third_side(dot(e, e) + dot(f, f) - 2.0 * constant, r, error, amplitude)
    if not some:
        return True
    low, high = form.lower[form.groups[1, 1] - 1], form.upper[form.groups[1, 1] - 1]
    return not (may_fit(middle + half, radius, low, high) or may_fit(middle - half, radius, low, high))


@outlined
def wrist_may_fit(form, target, c, s, error):
    """Whether joints 4 to 6 may make what rotation is left after joints 1 to 3, known to ``error`` rad."""
    noinline()
    if error >= math.pi:
        return True
    axes, extra, lower, upper = form.axes, form.extra, form.lower, form.upper
    h4, h5, h6 = three(axes, 3, 0), three(axes, 4, 0), three(axes, 5, 0)
    wanted = before_arm(axes, c, s, relative_rotation(target, extra, h6))  # Q h6
    held = relative_back(target, extra, after_arm(axes, c, s, h4))  # Q^T h4
    polar = polar_angle(h4, wanted)
    middle, half, radius, some = tilts(h4, h5, h6, polar, error)
    if not some:
        return False
    for q5 in (middle + half, middle - half):
        if not may_fit(q5, radius, lower[4], upper[4]):
            continue
        c5, s5 = math.cos(q5), math.sin(q5)
        a = rotate(h5, c5, s5, h6)  # R5 h6
        q4, _ = angle_between(h4, a, wanted)
        wide = azimuth_spread(error, polar) + azimuth_spread(radius, polar_angle(h4, a))
        if not may_fit(q4, wide, lower[3], upper[3]):
            continue
        b = rotate(h5, c5, -s5, h4)  # R5^T h4
        q6, _ = angle_between(h6, b, held)
        wide = azimuth_spread(error, polar) + azimuth_spread(radius, polar_angle(h6, b))
        if may_fit(-q6, wide, lower[5], upper[5]):
            return True
    return False


@outlined
def wrist_is_out_of_reach(form, target, tolerance, lever):
    """Of six axes with a spherical wrist; ``lever`` (m) from the frame to its centre."""
    axes, extra, lower, upper = form.axes, form.extra, form.lower, form.upper
    error = centre_error(tolerance, lever)
    h, u, end = three(axes, 0, 0), three(axes, 1, 0), three(extra, 0, 0)
    p1, p2, p3 = three(axes, 0, 3), three(axes, 1, 3), three(axes, 2, 3)
    along = same_way(u, axes, 2)
    e, f = minus(end, p3), minus(p2, p3)
    height = dot(u, minus(end, p1))
    d = minus(centre(target, extra), p1)
    middle, half, radius, some = heights(u, scaled(-1.0, h), d, height - error, height + error)
    if not some:
        return True
    for q1 in (middle + half, middle - half):
        if not may_fit(q1, radius, lower[0], upper[0]):
            continue
        c1, s1 = math.cos(q1), math.sin(q1)
        g = minus(plus(rotate(h, c1, -s1, d), p1), p2)
        off = error + chord(radius, off_axis(h, d))
        middle3, half3, radius3, some = elbows(u, f, e, off_axis(u, g), off)
        if not some:
            continue
        for a3 in (middle3 + half3, middle3 - half3):
            if not may_fit(along * a3, radius3, lower[2], upper[2]):
                continue
            q2, wide = first_link_range(u, f, e, a3, radius3, g, off)
            if not may_fit(q2, wide, lower[1], upper[1]):
                continue
            tilt = tolerance[0, 1] + radius + radius3 + wide + PAD
            c, s = (c1, math.cos(q2), math.cos(a3)), (s1, math.sin(q2), along * math.sin(a3))
            if wrist_may_fit(form, target, c, s, tilt):
                return False
    return True


@kernel
def prove_wrist(goals, form):
    """The same for six axes with a spherical wrist."""
    form = open_form(form)
    lever = length(three(form.extra, 1, 0))
    return wrist_is_out_of_reach(form, form.target, open_goals(goals).tolerance, lever)


@kernel
def prove_shoulder(goals, form):
    """The same for a spherical shoulder: the lever is from the goal to it."""
    form = open_form(form)
    invert(form.target, form.inverse)
    lever = length(centre(form.inverse, form.extra))
    return wrist_is_out_of_reach(form, form.inverse, open_goals(goals).tolerance, lever)


@kernel
def prove_parallel(goals, form):
    """The same for six axes of which the second to fourth are parallel and the last two meet."""
    form, tolerance = open_form(form), open_goals(goals).tolerance
    axes, extra, target, lower, upper = form.axes, form.extra, form.target, form.lower, form.upper
    error = centre_error(tolerance, length(three(extra, 1, 0)))
    h, u, h5, h6 = three(axes, 0, 0), three(axes, 1, 0), three(axes, 4, 0), three(axes, 5, 0)
    p1, p2 = three(axes, 0, 3), three(axes, 1, 3)
    height = dot(u, minus(three(extra, 0, 0), p1))
    d = minus(centre(target, extra), p1)
    middle, half, radius, some = heights(u, scaled(-1.0, h), d, height - error, height + error)
    if not some:
        return True
    relative = relative_rotation(target, extra, h6)
    tilt = min(math.pi, tolerance[0, 1] + radius + PAD)
    for q1 in (middle + half, middle - half):
        if not may_fit(q1, radius, lower[0], upper[0]):
            continue
        c1, s1 = math.cos(q1), math.sin(q1)
        wanted = back(axes, 0, c1, s1, relative)  # Q1 h6
        g = minus(plus(rotate(h, c1, -s1, d), p1), p2)
        held = relative_back(target, extra, rotate(h, c1, s1, u))  # Q1^T u
        off = error + chord(radius, off_axis(h, d))
        middle5, half5, radius5, some = tilts(u, h5, h6, polar_angle(u, wanted), tilt)
        if not some:
            continue
        for q5 in (middle5 + half5, middle5 - half5):
            if may_fit(q5, radius5, lower[4], upper[4]) and three_may_fit(
                form, q5, radius5, wanted, held, g, off, tilt
            ):
                return False
    return True


@outlined
def three_may_fit(form, q5, radius5, wanted, held, g, off, tilt):
    """Whether joints 6 and 2 to 4 of three parallel axes may follow joints 1 and 5."""
    noinline()
    axes, lower, upper = form.axes, form.lower, form.upper
    u, h5, h6 = three(axes, 1, 0), three(axes, 4, 0), three(axes, 5, 0)
    p2, p3, p4 = three(axes, 1, 3), three(axes, 2, 3), three(axes, 3, 3)
    along3, along4 = same_way(u, axes, 2), same_way(u, axes, 3)
    c5, s5, polar = math.cos(q5), math.sin(q5), polar_angle(u, wanted)
    b = rotate(h5, c5, -s5, u)  # R5^T u
    q6, _ = angle_between(h6, b, held)
    radius6 = azimuth_spread(tilt, polar) + azimuth_spread(radius5, polar_angle(h6, b))
    if not may_fit(-q6, radius6, lower[5], upper[5]):
        return False
    a = rotate(h5, c5, s5, h6)  # R5 h6
    theta, _ = angle_between(u, a, wanted)
    around = azimuth_spread(tilt, polar) + azimuth_spread(radius5, polar_angle(u, a))
    hand = minus(three(form.extra, 0, 0), p4)
    off += chord(around, off_axis(u, hand))
    v = minus(g, rotate(u, math.cos(theta), math.sin(theta), hand))
    e, f = minus(p4, p3), minus(p2, p3)
    middle3, half, radius, some = elbows(u, f, e, off_axis(u, v), off)
    if not some:
        return False
    for a3 in (middle3 + half, middle3 - half):
        if not may_fit(along3 * a3, radius, lower[2], upper[2]):
            continue
        q2, wide = first_link_range(u, f, e, a3, radius, v, off)
        if may_fit(q2, wide, lower[1], upper[1]) and may_fit(
            along4 * (theta - q2 - a3), around + wide + radius, lower[3], upper[3]
        ):
            return True
    return False


# Compiled when a goal is first missed.
PROOFS: dict[Family, Callable[[Any, Any], bool]] = {
    Family.PLANAR_TWO_LINK: prove_planar,
    Family.SPHERICAL_WRIST: prove_wrist,
    Family.SPHERICAL_SHOULDER: prove_shoulder,
    Family.THREE_PARALLEL: prove_parallel,
    Family.LIMB: prove_limb,
}
