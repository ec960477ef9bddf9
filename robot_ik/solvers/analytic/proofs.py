"""Proofs that no joint angles inside the limits bring the frame within tolerance of its target.

The formulas of the closed forms are followed with intervals in place of numbers: the
wrist's centre is known to the tolerance of the position and what that of the angle makes of the tool's
length.  Where every branch ends in an empty set or beyond a limit, nothing within tolerance can be reached.
Near singular poses the intervals grow until nothing is proven; they never grow too little.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import noinline, outlined, pure
from robot_ik.solvers.analytic.six_axes import back, centre, relative_back, relative_rotation
from robot_ik.solvers.analytic.subproblems import angle_between, rotate

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
def cap(error, polar):
    """How far the azimuth of a direction at ``polar`` from the pole may turn when it errs by ``error``."""
    if error >= min(polar, math.pi - polar):
        return math.pi
    return math.asin(min(1.0, math.sin(error) / math.sin(polar)))


@pure
def polar_angle(hx, hy, hz, x, y, z):
    """Angle between two vectors."""
    a, b, c = hy * z - hz * y, hz * x - hx * z, hx * y - hy * x
    return math.atan2(math.sqrt(a * a + b * b + c * c), hx * x + hy * y + hz * z)


@pure
def height_terms(hx, hy, hz, kx, ky, kz, px, py, pz):
    """h · R(k, θ) p = constant + amplitude · cos(θ - middle): constant, amplitude, middle."""
    constant = (hx * kx + hy * ky + hz * kz) * (kx * px + ky * py + kz * pz)
    even = hx * px + hy * py + hz * pz - constant
    odd = hx * (ky * pz - kz * py) + hy * (kz * px - kx * pz) + hz * (kx * py - ky * px)
    return constant, math.sqrt(even * even + odd * odd), math.atan2(odd, even)


@pure
def across(kx, ky, kz, x, y, z):
    """Distance of (x, y, z) from the line along the unit vector k through the origin."""
    a, b, c = ky * z - kz * y, kz * x - kx * z, kx * y - ky * x
    return math.sqrt(a * a + b * b + c * c)


@pure
def length(x, y, z):
    """Of a vector."""
    return math.sqrt(x * x + y * y + z * z)


@pure
def centre_error(tolerance, lever):
    """How far the wrist's centre may be off, at ``lever`` metres from the frame."""
    return tolerance[0, 0] + chord(tolerance[0, 1], lever) + PAD


@outlined
def planar_is_out_of_reach(form, tolerance):
    """Of two parallel hinges and a position."""
    axes, extra, target, lower, upper = form.axes, form.extra, form.target, form.lower, form.upper
    ux, uy, uz = axes[0, 0], axes[0, 1], axes[0, 2]
    along = 1.0 if ux * axes[1, 0] + uy * axes[1, 1] + uz * axes[1, 2] > 0.0 else -1.0
    gx, gy, gz = target[0, 0] - axes[0, 3], target[0, 1] - axes[0, 4], target[0, 2] - axes[0, 5]
    ex, ey, ez = extra[0, 0] - axes[1, 3], extra[0, 1] - axes[1, 4], extra[0, 2] - axes[1, 5]
    fx, fy, fz = axes[0, 3] - axes[1, 3], axes[0, 4] - axes[1, 4], axes[0, 5] - axes[1, 5]
    error = tolerance[0, 0] + PAD
    if abs((gx - ex + fx) * ux + (gy - ey + fy) * uy + (gz - ez + fz) * uz) > error:
        return True
    return not two_links_may_fit(
        ux, uy, uz, along, ex, ey, ez, fx, fy, fz, gx, gy, gz, error,
        lower[0], upper[0], lower[1], upper[1],
    )  # fmt: skip


@pure
def two_links_may_fit(
    ux, uy, uz, along, ex, ey, ez, fx, fy, fz, gx, gy, gz, error, lower_a, upper_a, lower_b, upper_b
):  # fmt: skip
    """Whether two hinges about u may bring the end to g ± error, seen from the first.

    f and e: the first axis and the end seen from the second, at q = 0.
    """
    far = across(ux, uy, uz, gx, gy, gz)
    lf, le = across(ux, uy, uz, fx, fy, fz), across(ux, uy, uz, ex, ey, ez)
    _, amplitude, middle = height_terms(fx, fy, fz, ux, uy, uz, ex, ey, ez)
    half, radius, some = third_side(lf * lf + le * le, far, error, amplitude)
    if not some:
        return False
    for elbow in range(2):
        a = middle + half if elbow == 0 else middle - half
        if not may_fit(along * a, radius, lower_b, upper_b):
            continue
        vx, vy, vz = rotate(ux, uy, uz, math.cos(a), math.sin(a), ex, ey, ez)
        vx, vy, vz = vx - fx, vy - fy, vz - fz
        first, _ = angle_between(ux, uy, uz, vx, vy, vz, gx, gy, gz)
        wide = spread(error, far) + spread(chord(radius, le), across(ux, uy, uz, vx, vy, vz))
        if may_fit(first, wide, lower_a, upper_a):
            return True
    return False


@outlined
def limb_is_out_of_reach(form, tolerance):
    """Of a limb: only by the distance of shoulder and wrist, and the limits of the elbow."""
    axes, extra = form.axes, form.extra
    error = centre_error(tolerance, length(extra[1, 0], extra[1, 1], extra[1, 2]))
    wx, wy, wz = centre(form.target, extra)
    r = length(wx - axes[0, 3], wy - axes[0, 4], wz - axes[0, 5])
    fx, fy, fz = axes[0, 3] - axes[3, 3], axes[0, 4] - axes[3, 4], axes[0, 5] - axes[3, 5]
    ex, ey, ez = extra[0, 0] - axes[3, 3], extra[0, 1] - axes[3, 4], extra[0, 2] - axes[3, 5]
    constant, amplitude, middle = height_terms(fx, fy, fz, axes[3, 0], axes[3, 1], axes[3, 2], ex, ey, ez)
    sides = 0.5 * (ex * ex + ey * ey + ez * ez + fx * fx + fy * fy + fz * fz) - constant
    near_side, far_side = max(0.0, r - error), r + error
    half, radius, some = arc(
        sides - 0.5 * far_side * far_side - PAD, sides - 0.5 * near_side * near_side + PAD, amplitude
    )
    if not some:
        return True
    low, high = form.lower[form.groups[1, 1] - 1], form.upper[form.groups[1, 1] - 1]
    return not (may_fit(middle + half, radius, low, high) or may_fit(middle - half, radius, low, high))


@outlined
def wrist_may_fit(axes, extra, target, lower, upper, c1, s1, c2, s2, c3, s3, error):
    """Whether joints 4 to 6 may make what rotation is left after joints 1 to 3, known to ``error`` rad."""
    noinline()
    if error >= math.pi:
        return True
    hx, hy, hz = axes[3, 0], axes[3, 1], axes[3, 2]
    kx, ky, kz = axes[4, 0], axes[4, 1], axes[4, 2]
    ex, ey, ez = axes[5, 0], axes[5, 1], axes[5, 2]
    x, y, z = relative_rotation(target, extra, ex, ey, ez)
    x, y, z = back(axes, 0, c1, s1, x, y, z)
    x, y, z = back(axes, 1, c2, s2, x, y, z)
    x, y, z = back(axes, 2, c3, s3, x, y, z)  # Q h6
    bx, by, bz = rotate(axes[2, 0], axes[2, 1], axes[2, 2], c3, s3, hx, hy, hz)
    bx, by, bz = rotate(axes[1, 0], axes[1, 1], axes[1, 2], c2, s2, bx, by, bz)
    bx, by, bz = rotate(axes[0, 0], axes[0, 1], axes[0, 2], c1, s1, bx, by, bz)
    bx, by, bz = relative_back(target, extra, bx, by, bz)  # Q^T h4
    polar = polar_angle(hx, hy, hz, x, y, z)
    constant, amplitude, middle = height_terms(hx, hy, hz, kx, ky, kz, ex, ey, ez)
    half, radius, some = arc(
        math.cos(min(math.pi, polar + error)) - constant - PAD,
        math.cos(max(0.0, polar - error)) - constant + PAD,
        amplitude,
    )
    if not some:
        return False
    for flip in range(2):
        q5 = middle + half if flip == 0 else middle - half
        if not may_fit(q5, radius, lower[4], upper[4]):
            continue
        c5, s5 = math.cos(q5), math.sin(q5)
        ax, ay, az = rotate(kx, ky, kz, c5, s5, ex, ey, ez)  # R5 h6
        q4, _ = angle_between(hx, hy, hz, ax, ay, az, x, y, z)
        wide = cap(error, polar) + cap(radius, polar_angle(hx, hy, hz, ax, ay, az))
        if not may_fit(q4, wide, lower[3], upper[3]):
            continue
        gx, gy, gz = rotate(kx, ky, kz, c5, -s5, hx, hy, hz)  # R5^T h4
        q6, _ = angle_between(ex, ey, ez, gx, gy, gz, bx, by, bz)
        wide = cap(error, polar) + cap(radius, polar_angle(ex, ey, ez, gx, gy, gz))
        if may_fit(-q6, wide, lower[5], upper[5]):
            return True
    return False


@outlined
def wrist_is_out_of_reach(form, target, tolerance, lever):
    """Of six axes with a spherical wrist; ``lever`` (m) from the frame to its centre."""
    axes, extra, lower, upper = form.axes, form.extra, form.lower, form.upper
    error = centre_error(tolerance, lever)
    wx, wy, wz = centre(target, extra)
    hx, hy, hz = axes[0, 0], axes[0, 1], axes[0, 2]
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    along = 1.0 if ux * axes[2, 0] + uy * axes[2, 1] + uz * axes[2, 2] > 0.0 else -1.0
    px, py, pz = axes[0, 3] - axes[1, 3], axes[0, 4] - axes[1, 4], axes[0, 5] - axes[1, 5]
    ex, ey, ez = extra[0, 0] - axes[2, 3], extra[0, 1] - axes[2, 4], extra[0, 2] - axes[2, 5]
    fx, fy, fz = axes[1, 3] - axes[2, 3], axes[1, 4] - axes[2, 4], axes[1, 5] - axes[2, 5]
    height = (ex - fx - px) * ux + (ey - fy - py) * uy + (ez - fz - pz) * uz
    dx, dy, dz = wx - axes[0, 3], wy - axes[0, 4], wz - axes[0, 5]
    constant, amplitude, middle = height_terms(ux, uy, uz, -hx, -hy, -hz, dx, dy, dz)
    half, radius, some = arc(height - constant - error, height - constant + error, amplitude)
    if not some:
        return True
    lf, le = across(ux, uy, uz, fx, fy, fz), across(ux, uy, uz, ex, ey, ez)
    _, reach, middle3 = height_terms(fx, fy, fz, ux, uy, uz, ex, ey, ez)
    for shoulder in range(2):
        q1 = middle + half if shoulder == 0 else middle - half
        if not may_fit(q1, radius, lower[0], upper[0]):
            continue
        c1, s1 = math.cos(q1), math.sin(q1)
        gx, gy, gz = rotate(hx, hy, hz, c1, -s1, dx, dy, dz)
        gx, gy, gz = gx + px, gy + py, gz + pz
        far = across(ux, uy, uz, gx, gy, gz)
        off = error + chord(radius, across(hx, hy, hz, dx, dy, dz))
        half3, radius3, some = third_side(lf * lf + le * le, far, off, reach)
        if not some:
            continue
        for elbow in range(2):
            a3 = middle3 + half3 if elbow == 0 else middle3 - half3
            if not may_fit(along * a3, radius3, lower[2], upper[2]):
                continue
            c3, s3 = math.cos(a3), math.sin(a3)
            vx, vy, vz = rotate(ux, uy, uz, c3, s3, ex, ey, ez)
            vx, vy, vz = vx - fx, vy - fy, vz - fz
            q2, _ = angle_between(ux, uy, uz, vx, vy, vz, gx, gy, gz)
            wide = spread(off, far) + spread(chord(radius3, le), across(ux, uy, uz, vx, vy, vz))
            if not may_fit(q2, wide, lower[1], upper[1]):
                continue
            tilt = tolerance[0, 1] + radius + radius3 + wide + PAD
            c2, s2 = math.cos(q2), math.sin(q2)
            if wrist_may_fit(axes, extra, target, lower, upper, c1, s1, c2, s2, c3, along * s3, tilt):
                return False
    return True


@outlined
def parallel_is_out_of_reach(form, tolerance):
    """Of six axes of which the second to fourth are parallel and the last two meet."""
    axes, extra, target, lower, upper = form.axes, form.extra, form.target, form.lower, form.upper
    error = centre_error(tolerance, length(extra[1, 0], extra[1, 1], extra[1, 2]))
    wx, wy, wz = centre(target, extra)
    hx, hy, hz = axes[0, 0], axes[0, 1], axes[0, 2]
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    kx, ky, kz = axes[4, 0], axes[4, 1], axes[4, 2]
    ox, oy, oz = axes[5, 0], axes[5, 1], axes[5, 2]
    p1x, p1y, p1z = axes[0, 3], axes[0, 4], axes[0, 5]
    height = ux * (extra[0, 0] - p1x) + uy * (extra[0, 1] - p1y) + uz * (extra[0, 2] - p1z)
    dx, dy, dz = wx - p1x, wy - p1y, wz - p1z
    constant, amplitude, middle = height_terms(ux, uy, uz, -hx, -hy, -hz, dx, dy, dz)
    half, radius, some = arc(height - constant - error, height - constant + error, amplitude)
    if not some:
        return True
    constant5, amplitude5, middle5 = height_terms(ux, uy, uz, kx, ky, kz, ox, oy, oz)
    rx, ry, rz = relative_rotation(target, extra, ox, oy, oz)
    for shoulder in range(2):
        q1 = middle + half if shoulder == 0 else middle - half
        if not may_fit(q1, radius, lower[0], upper[0]):
            continue
        c1, s1 = math.cos(q1), math.sin(q1)
        x, y, z = back(axes, 0, c1, s1, rx, ry, rz)  # Q1 h6
        gx, gy, gz = rotate(hx, hy, hz, c1, -s1, dx, dy, dz)
        gx, gy, gz = gx + p1x - axes[1, 3], gy + p1y - axes[1, 4], gz + p1z - axes[1, 5]
        bx, by, bz = rotate(hx, hy, hz, c1, s1, ux, uy, uz)
        bx, by, bz = relative_back(target, extra, bx, by, bz)  # Q1^T u
        off = error + chord(radius, across(hx, hy, hz, dx, dy, dz))
        tilt = min(math.pi, tolerance[0, 1] + radius + PAD)
        polar = polar_angle(ux, uy, uz, x, y, z)
        half5, radius5, some = arc(
            math.cos(min(math.pi, polar + tilt)) - constant5 - PAD,
            math.cos(max(0.0, polar - tilt)) - constant5 + PAD,
            amplitude5,
        )
        if not some:
            continue
        for flip in range(2):
            q5 = middle5 + half5 if flip == 0 else middle5 - half5
            if not may_fit(q5, radius5, lower[4], upper[4]):
                continue
            if three_may_fit(
                axes, extra, lower, upper, math.cos(q5), math.sin(q5), radius5,
                x, y, z, bx, by, bz, gx, gy, gz, off, tilt, polar,
            ):  # fmt: skip
                return False
    return True


@outlined
def three_may_fit(
    axes, extra, lower, upper, c5, s5, radius5, x, y, z, bx, by, bz, gx, gy, gz, off, tilt, polar
):  # fmt: skip
    """Whether joints 6 and 2 to 4 of three parallel axes may follow joints 1 and 5."""
    noinline()
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    along3 = 1.0 if ux * axes[2, 0] + uy * axes[2, 1] + uz * axes[2, 2] > 0.0 else -1.0
    along4 = 1.0 if ux * axes[3, 0] + uy * axes[3, 1] + uz * axes[3, 2] > 0.0 else -1.0
    kx, ky, kz = axes[4, 0], axes[4, 1], axes[4, 2]
    ox, oy, oz = axes[5, 0], axes[5, 1], axes[5, 2]
    tx, ty, tz = rotate(kx, ky, kz, c5, -s5, ux, uy, uz)  # R5^T u
    q6, _ = angle_between(ox, oy, oz, tx, ty, tz, bx, by, bz)
    wide = cap(tilt, polar) + cap(radius5, polar_angle(ox, oy, oz, tx, ty, tz))
    if not may_fit(-q6, wide, lower[5], upper[5]):
        return False
    ax, ay, az = rotate(kx, ky, kz, c5, s5, ox, oy, oz)  # R5 h6
    theta, _ = angle_between(ux, uy, uz, ax, ay, az, x, y, z)
    around = cap(tilt, polar) + cap(radius5, polar_angle(ux, uy, uz, ax, ay, az))
    lx, ly, lz = extra[0, 0] - axes[3, 3], extra[0, 1] - axes[3, 4], extra[0, 2] - axes[3, 5]
    off += chord(around, across(ux, uy, uz, lx, ly, lz))
    lx, ly, lz = rotate(ux, uy, uz, math.cos(theta), math.sin(theta), lx, ly, lz)
    vx, vy, vz = gx - lx, gy - ly, gz - lz
    far = across(ux, uy, uz, vx, vy, vz)
    ex, ey, ez = axes[3, 3] - axes[2, 3], axes[3, 4] - axes[2, 4], axes[3, 5] - axes[2, 5]
    fx, fy, fz = axes[1, 3] - axes[2, 3], axes[1, 4] - axes[2, 4], axes[1, 5] - axes[2, 5]
    lf, le = across(ux, uy, uz, fx, fy, fz), across(ux, uy, uz, ex, ey, ez)
    _, reach, middle3 = height_terms(fx, fy, fz, ux, uy, uz, ex, ey, ez)
    half, radius, some = third_side(lf * lf + le * le, far, off, reach)
    if not some:
        return False
    for elbow in range(2):
        a3 = middle3 + half if elbow == 0 else middle3 - half
        if not may_fit(along3 * a3, radius, lower[2], upper[2]):
            continue
        mx, my, mz = rotate(ux, uy, uz, math.cos(a3), math.sin(a3), ex, ey, ez)
        mx, my, mz = mx - fx, my - fy, mz - fz
        q2, _ = angle_between(ux, uy, uz, mx, my, mz, vx, vy, vz)
        wide = spread(off, far) + spread(chord(radius, le), across(ux, uy, uz, mx, my, mz))
        if may_fit(q2, wide, lower[1], upper[1]) and may_fit(
            along4 * (theta - q2 - a3), around + wide + radius, lower[3], upper[3]
        ):
            return True
    return False
