"""Proofs that no joint angles inside the limits bring the frame within tolerance of its target.

The proofs evaluate the formulas of the closed forms with intervals in place of numbers. The centre
of the wrist is known to the tolerance of the position, plus the tolerance of the angle times the
length of the tool. If every branch ends in an empty set or beyond a limit, the goal is unreachable.
Near singular poses the intervals grow until nothing can be proven. They are never too small.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from robot_ik.kernels import so3
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.solvers.analytic.recognise import Family
from robot_ik.solvers.analytic.six_axes import (
    after_arm,
    axis_sign,
    before_arm,
    centre,
    relative_back,
    relative_rotation,
    rotate_back,
)
from robot_ik.solvers.analytic.subproblems import (
    angle_between,
    height_terms,
    invert,
    noinline,
    open_run,
)

# An interval of angles is its middle and its radius. A radius of pi or more is the whole circle.
# All bounds are outer bounds: the true set lies inside, so an empty interval is a proof.

# Allowance for rounding, of angles (an arc cosine near 1 loses half the digits), and of metres or
# cosines.
_ANGLE_PAD = 1e-6
PAD = 1e-9


@inlined
def may_fit(middle, radius, lower, upper):
    """Return whether an angle of the interval, up to multiples of 2π, may lie inside the limits."""
    radius += _ANGLE_PAD
    revolution = 2.0 * math.pi
    if radius >= math.pi or upper - lower >= revolution:
        return True
    revolutions = math.ceil((lower - middle - radius) / revolution)
    return middle - radius + revolution * revolutions <= upper


@inlined
def arc(lower, upper, amplitude):
    """Return middle, radius, existence of h in [0, π] with lower <= amplitude · cos h <= upper."""
    if amplitude <= PAD:
        return 0.5 * math.pi, 0.5 * math.pi, lower <= 2.0 * PAD and upper >= -2.0 * PAD
    if lower > amplitude + PAD or upper < -amplitude - PAD:
        return 0.0, 0.0, False
    first = math.acos(min(max(upper / amplitude, -1.0), 1.0))
    last = math.acos(min(max(lower / amplitude, -1.0), 1.0))
    return 0.5 * (first + last), 0.5 * (last - first) + _ANGLE_PAD, True


@inlined
def third_side(squares, distance, error, amplitude):
    """Return ``arc`` of the angle between two sides, if the third side is ``distance`` ± ``error``.

    ``squares`` is the sum of the squares of the two sides.
    """
    shortest = max(0.0, distance - error)
    longest = distance + error
    lower = 0.5 * (squares - longest * longest)
    upper = 0.5 * (squares - shortest * shortest)
    return arc(lower - PAD, upper + PAD, amplitude)


@inlined
def chord(angle, radius):
    """Return the largest motion, m, of a point at ``radius`` by a rotation up to ``angle``."""
    return 2.0 * radius * math.sin(0.5 * min(angle, math.pi))


@inlined
def spread(error, length):
    """Return the largest rotation of a plane vector whose end moves by ``error``, rad."""
    return math.asin(error / length) if error < length else math.pi


@inlined
def azimuth_spread(error, polar):
    """Return the largest change of azimuth of a direction ``polar`` from the pole, rad."""
    if error >= min(polar, math.pi - polar):
        return math.pi
    return math.asin(min(1.0, math.sin(error) / math.sin(polar)))


@inlined
def polar_angle(h, v):
    """Return the angle between two vectors."""
    return math.atan2(so3.norm(so3.cross(h, v)), so3.dot(h, v))


@inlined
def distance_to_axis(k, v):
    """Return the distance of v from the line along the unit vector k through the origin."""
    return so3.norm(so3.cross(k, v))


@inlined
def centre_error(tolerance, lever):
    """Return the tolerance of the wrist's centre at ``lever`` metres from the frame, m."""
    return tolerance[0, 0] + chord(tolerance[0, 1], lever) + PAD


@inlined
def heights(h, k, p, lower, upper):
    """Return centre, half, radius and existence of θ with h · R(k, θ) p in [lower, upper]."""
    constant, amplitude, middle = height_terms(h, k, p)
    half, radius, possible = arc(lower - constant, upper - constant, amplitude)
    return middle, half, radius, possible


@inlined
def tilts(h, k, p, polar, error):
    """Return the ``heights`` at which the angle of R(k, θ) p and h is ``polar`` ± ``error``."""
    lower = math.cos(min(math.pi, polar + error))
    upper = math.cos(max(0.0, polar - error))
    return heights(h, k, p, lower - PAD, upper + PAD)


@inlined
def elbows(u, f, e, distance, error):
    """Return the elbow angles about u that bring the end to distance ± error from the first axis.

    Returns what ``heights`` returns. f and e lead from the elbow to the first axis and to the end,
    at q = 0.
    """
    lf = distance_to_axis(u, f)
    le = distance_to_axis(u, e)
    _, amplitude, middle = height_terms(f, u, e)
    half, radius, possible = third_side(lf * lf + le * le, distance, error, amplitude)
    return middle, half, radius, possible


@inlined
def first_link_range(u, f, e, elbow, radius, g, error):
    """Return angle and radius of the first link for an end at g ± error and an elbow ± radius."""
    v = so3.subtract(so3.rotate(u, math.cos(elbow), math.sin(elbow), e), f)
    angle, _ = angle_between(u, v, g)
    return angle, spread(error, distance_to_axis(u, g)) + spread(
        chord(radius, distance_to_axis(u, e)), distance_to_axis(u, v)
    )


@kernel
def prove_planar(address):
    """Return whether a position is out of reach of two parallel hinges, within tolerance."""
    run = open_run(address)
    form = run.form
    tolerance = run.goals.tolerance
    axes = form.axes
    lower = form.lower
    upper = form.upper
    u = so3.read_vector(axes, 0, 0)
    p1 = so3.read_vector(axes, 0, 3)
    p2 = so3.read_vector(axes, 1, 3)
    along = axis_sign(u, axes, 1)
    g = so3.subtract(so3.read_vector(form.target, 0, 0), p1)
    e = so3.subtract(so3.read_vector(form.extra, 0, 0), p2)
    f = so3.subtract(p1, p2)
    error = tolerance[0, 0] + PAD
    if abs(so3.dot(so3.add(so3.subtract(g, e), f), u)) > error:
        return True
    middle, half, radius, possible = elbows(u, f, e, distance_to_axis(u, g), error)
    if not possible:
        return True
    for a in (middle + half, middle - half):
        if may_fit(along * a, radius, lower[1], upper[1]):
            first, wide = first_link_range(u, f, e, a, radius, g, error)
            if may_fit(first, wide, lower[0], upper[0]):
                return False
    return True


@outlined
def wrist_may_fit(form, target, c, s, error):
    """Return whether joints 4 to 6 may produce the remaining rotation, known to ``error`` rad."""
    noinline()
    if error >= math.pi:
        return True
    axes = form.axes
    extra = form.extra
    lower = form.lower
    upper = form.upper
    h4 = so3.read_vector(axes, 3, 0)
    h5 = so3.read_vector(axes, 4, 0)
    h6 = so3.read_vector(axes, 5, 0)
    wanted = before_arm(axes, c, s, relative_rotation(target, extra, h6))  # Q h6
    base_axis = relative_back(target, extra, after_arm(axes, c, s, h4))  # Q^T h4
    polar = polar_angle(h4, wanted)
    middle, half, radius, possible = tilts(h4, h5, h6, polar, error)
    if not possible:
        return False
    for q5 in (middle + half, middle - half):
        if not may_fit(q5, radius, lower[4], upper[4]):
            continue
        c5 = math.cos(q5)
        s5 = math.sin(q5)
        a = so3.rotate(h5, c5, s5, h6)  # R5 h6
        q4, _ = angle_between(h4, a, wanted)
        wide = azimuth_spread(error, polar) + azimuth_spread(radius, polar_angle(h4, a))
        if not may_fit(q4, wide, lower[3], upper[3]):
            continue
        b = so3.rotate(h5, c5, -s5, h4)  # R5^T h4
        q6, _ = angle_between(h6, b, base_axis)
        wide = azimuth_spread(error, polar) + azimuth_spread(radius, polar_angle(h6, b))
        if may_fit(-q6, wide, lower[5], upper[5]):
            return True
    return False


@outlined
def wrist_is_out_of_reach(form, target, tolerance, lever):
    """Return whether a pose is out of reach of six axes with a spherical wrist.

    ``lever`` is the distance from the frame to the centre of the wrist, m.
    """
    axes = form.axes
    extra = form.extra
    lower = form.lower
    upper = form.upper
    error = centre_error(tolerance, lever)
    h = so3.read_vector(axes, 0, 0)
    u = so3.read_vector(axes, 1, 0)
    end = so3.read_vector(extra, 0, 0)
    p1 = so3.read_vector(axes, 0, 3)
    p2 = so3.read_vector(axes, 1, 3)
    p3 = so3.read_vector(axes, 2, 3)
    along = axis_sign(u, axes, 2)
    e = so3.subtract(end, p3)
    f = so3.subtract(p2, p3)
    height = so3.dot(u, so3.subtract(end, p1))
    d = so3.subtract(centre(target, extra), p1)
    middle, half, radius, possible = heights(
        u, so3.scale(-1.0, h), d, height - error, height + error
    )
    if not possible:
        return True
    for q1 in (middle + half, middle - half):
        if not may_fit(q1, radius, lower[0], upper[0]):
            continue
        c1 = math.cos(q1)
        s1 = math.sin(q1)
        g = so3.subtract(so3.add(so3.rotate(h, c1, -s1, d), p1), p2)
        g_error = error + chord(radius, distance_to_axis(h, d))
        middle3, half3, radius3, possible = elbows(u, f, e, distance_to_axis(u, g), g_error)
        if not possible:
            continue
        for a3 in (middle3 + half3, middle3 - half3):
            if not may_fit(along * a3, radius3, lower[2], upper[2]):
                continue
            q2, wide = first_link_range(u, f, e, a3, radius3, g, g_error)
            if not may_fit(q2, wide, lower[1], upper[1]):
                continue
            tilt = tolerance[0, 1] + radius + radius3 + wide + PAD
            c = (c1, math.cos(q2), math.cos(a3))
            s = (s1, math.sin(q2), along * math.sin(a3))
            if wrist_may_fit(form, target, c, s, tilt):
                return False
    return True


@kernel
def prove_wrist(address):
    """Return whether a pose is out of reach of six axes with a spherical wrist."""
    run = open_run(address)
    form = run.form
    lever = so3.norm(so3.read_vector(form.extra, 1, 0))
    return wrist_is_out_of_reach(form, form.target, run.goals.tolerance, lever)


@kernel
def prove_shoulder(address):
    """Return whether a pose is out of reach of six axes with a spherical shoulder.

    The lever is the distance from the goal to the centre of the shoulder.
    """
    run = open_run(address)
    form = run.form
    invert(form.target, form.inverse)
    lever = so3.norm(centre(form.inverse, form.extra))
    return wrist_is_out_of_reach(form, form.inverse, run.goals.tolerance, lever)


@kernel
def prove_parallel(address):
    """Return whether a pose is out of reach of six axes with three parallel axes.

    The second to fourth axes are parallel, and the last two meet.
    """
    run = open_run(address)
    form = run.form
    tolerance = run.goals.tolerance
    axes = form.axes
    extra = form.extra
    target = form.target
    lower = form.lower
    upper = form.upper
    error = centre_error(tolerance, so3.norm(so3.read_vector(extra, 1, 0)))
    h = so3.read_vector(axes, 0, 0)
    u = so3.read_vector(axes, 1, 0)
    h5 = so3.read_vector(axes, 4, 0)
    h6 = so3.read_vector(axes, 5, 0)
    p1 = so3.read_vector(axes, 0, 3)
    p2 = so3.read_vector(axes, 1, 3)
    height = so3.dot(u, so3.subtract(so3.read_vector(extra, 0, 0), p1))
    d = so3.subtract(centre(target, extra), p1)
    middle, half, radius, possible = heights(
        u, so3.scale(-1.0, h), d, height - error, height + error
    )
    if not possible:
        return True
    relative = relative_rotation(target, extra, h6)
    tilt = min(math.pi, tolerance[0, 1] + radius + PAD)
    for q1 in (middle + half, middle - half):
        if not may_fit(q1, radius, lower[0], upper[0]):
            continue
        c1 = math.cos(q1)
        s1 = math.sin(q1)
        wanted = rotate_back(axes, 0, c1, s1, relative)  # Q1 h6
        g = so3.subtract(so3.add(so3.rotate(h, c1, -s1, d), p1), p2)
        base_axis = relative_back(target, extra, so3.rotate(h, c1, s1, u))  # Q1^T u
        g_error = error + chord(radius, distance_to_axis(h, d))
        middle5, half5, radius5, possible = tilts(u, h5, h6, polar_angle(u, wanted), tilt)
        if not possible:
            continue
        for q5 in (middle5 + half5, middle5 - half5):
            if may_fit(q5, radius5, lower[4], upper[4]) and three_may_fit(
                form, q5, radius5, wanted, base_axis, g, g_error, tilt
            ):
                return False
    return True


@outlined
def three_may_fit(form, q5, radius5, wanted, base_axis, g, g_error, tilt):
    """Return whether joints 6 and 2 to 4 of three parallel axes may follow joints 1 and 5."""
    noinline()
    axes = form.axes
    lower = form.lower
    upper = form.upper
    u = so3.read_vector(axes, 1, 0)
    h5 = so3.read_vector(axes, 4, 0)
    h6 = so3.read_vector(axes, 5, 0)
    p2 = so3.read_vector(axes, 1, 3)
    p3 = so3.read_vector(axes, 2, 3)
    p4 = so3.read_vector(axes, 3, 3)
    along3 = axis_sign(u, axes, 2)
    along4 = axis_sign(u, axes, 3)
    c5 = math.cos(q5)
    s5 = math.sin(q5)
    polar = polar_angle(u, wanted)
    b = so3.rotate(h5, c5, -s5, u)  # R5^T u
    q6, _ = angle_between(h6, b, base_axis)
    radius6 = azimuth_spread(tilt, polar) + azimuth_spread(radius5, polar_angle(h6, b))
    if not may_fit(-q6, radius6, lower[5], upper[5]):
        return False
    a = so3.rotate(h5, c5, s5, h6)  # R5 h6
    theta, _ = angle_between(u, a, wanted)
    around = azimuth_spread(tilt, polar) + azimuth_spread(radius5, polar_angle(u, a))
    hand = so3.subtract(so3.read_vector(form.extra, 0, 0), p4)
    g_error += chord(around, distance_to_axis(u, hand))
    v = so3.subtract(g, so3.rotate(u, math.cos(theta), math.sin(theta), hand))
    e = so3.subtract(p4, p3)
    f = so3.subtract(p2, p3)
    middle3, half, radius, possible = elbows(u, f, e, distance_to_axis(u, v), g_error)
    if not possible:
        return False
    for a3 in (middle3 + half, middle3 - half):
        if not may_fit(along3 * a3, radius, lower[2], upper[2]):
            continue
        q2, wide = first_link_range(u, f, e, a3, radius, v, g_error)
        if may_fit(q2, wide, lower[1], upper[1]) and may_fit(
            along4 * (theta - q2 - a3), around + wide + radius, lower[3], upper[3]
        ):
            return True
    return False


@kernel
def prove_crossed(address):
    """Return whether a pose is out of reach of a spherical shoulder with a crossed wrist.

    Only the elbow is evaluated: it alone changes the distance of shoulder and wrist.
    """
    run = open_run(address)
    form = run.form
    extra = form.extra
    axis = so3.read_vector(form.axes, 3, 0)
    elbow = so3.read_vector(form.axes, 3, 3)
    to_shoulder = so3.subtract(so3.read_vector(extra, 5, 0), elbow)
    to_wrist = so3.subtract(so3.read_vector(extra, 0, 0), elbow)
    between = so3.subtract(centre(form.target, extra), so3.read_vector(extra, 5, 0))
    error = centre_error(run.goals.tolerance, so3.norm(so3.read_vector(extra, 1, 0)))
    constant, amplitude, middle = height_terms(to_shoulder, axis, to_wrist)
    squares = so3.dot(to_wrist, to_wrist) + so3.dot(to_shoulder, to_shoulder)
    half, radius, possible = third_side(
        squares - 2.0 * constant, so3.norm(between), error, amplitude
    )
    if not possible:
        return True
    lower = form.lower[3]
    upper = form.upper[3]
    return not (
        may_fit(middle + half, radius, lower, upper) or may_fit(middle - half, radius, lower, upper)
    )


# Each proof is compiled when a solve first does not converge.
PROOFS: dict[Family, Callable[[Any], bool]] = {
    Family.PLANAR_TWO_LINK: prove_planar,
    Family.SPHERICAL_WRIST: prove_wrist,
    Family.SPHERICAL_SHOULDER: prove_shoulder,
    Family.THREE_PARALLEL: prove_parallel,
    Family.CROSSED_WRIST: prove_crossed,
}
