"""Shoulder and wrist of a limb as functions of its swivel angle.

With the shoulder at p, the wrist's centre at w and n the unit vector between them, the elbow's angle is
known and what is left is a rotation about n: S(φ) = R(n, φ) S₀.  S₀ is the start's own rotation brought to
the goal by the smallest rotation, so that φ = 0 is the swivel of the start.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import noinline, outlined, pure
from robot_ik.kernels.kinematics import unit
from robot_ik.solvers.analytic.recognise import BALL_JOINT, HINGES
from robot_ik.solvers.analytic.subproblems import angle_between, image, rotate, split_inside

# Rows of form.matrices: the start's shoulder, S₀, the goal's rotation of all joints, S₀ with the elbow's
# rotation, then the rotations of shoulder and wrist at the swivel angle of the moment.
START, ORIGIN, WHOLE, BENT, ROTATED = 0, 1, 2, 3, 4


@pure
def apply(m, r, x, y, z):
    """The matrix in row r of m, times (x, y, z)."""
    return (
        m[r, 0] * x + m[r, 1] * y + m[r, 2] * z,
        m[r, 3] * x + m[r, 4] * y + m[r, 5] * z,
        m[r, 6] * x + m[r, 7] * y + m[r, 8] * z,
    )


@pure
def apply_back(m, r, x, y, z):
    """The transpose of the matrix in row r of m, times (x, y, z)."""
    return (
        m[r, 0] * x + m[r, 3] * y + m[r, 6] * z,
        m[r, 1] * x + m[r, 4] * y + m[r, 7] * z,
        m[r, 2] * x + m[r, 5] * y + m[r, 8] * z,
    )


@pure
def put_column(m, r, j, x, y, z):
    """Column j of the matrix in row r of m."""
    m[r, j], m[r, 3 + j], m[r, 6 + j] = x, y, z


@pure
def from_frame(axes, k, x, y, z):
    """A vector by the axes in rows k to k + 2 of the table, in the world."""
    return (
        axes[k, 0] * x + axes[k + 1, 0] * y + axes[k + 2, 0] * z,
        axes[k, 1] * x + axes[k + 1, 1] * y + axes[k + 2, 1] * z,
        axes[k, 2] * x + axes[k + 1, 2] * y + axes[k + 2, 2] * z,
    )


@pure
def into_frame(axes, k, x, y, z):
    """The inverse of ``from_frame``."""
    return (
        axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z,
        axes[k + 1, 0] * x + axes[k + 1, 1] * y + axes[k + 1, 2] * z,
        axes[k + 2, 0] * x + axes[k + 2, 1] * y + axes[k + 2, 2] * z,
    )


@outlined
def start_rotation(form):
    """What the start makes of the shoulder, into matrices[START]."""
    noinline()
    m, axes, start = form.matrices, form.axes, form.start
    if form.groups[0, 0] == BALL_JOINT:
        # A ball joint rotates in its own frame; its axes stand in the table.
        w = start[0]
        x, y, z = from_frame(axes, types.int64(0), start[1], start[2], start[3])
        s = 2.0 / max(w * w + x * x + y * y + z * z, 1e-30)
        put_column(m, START, 0, 1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y))
        put_column(m, START, 1, s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x))
        put_column(m, START, 2, s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y))
        return
    for j in range(3):
        x, y, z = unit(j)
        for k in range(2, -1, -1):
            c, s = math.cos(start[k]), math.sin(start[k])
            x, y, z = rotate(axes[k, 0], axes[k, 1], axes[k, 2], c, s, x, y, z)
        put_column(m, START, j, x, y, z)


@outlined
def make_parts(form, angle, vx, vy, vz, nx, ny, nz):
    """Rotations of shoulder and wrist as functions of the swivel angle, for an elbow at ``angle``.

    v and n are unit vectors from the shoulder to the wrist's centre: as the elbow makes it, and wanted.
    """
    noinline()
    m, parts, axes = form.matrices, form.parts, form.axes
    ax, ay, az = apply(m, START, vx, vy, vz)
    kx, ky, kz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
    c = ax * nx + ay * ny + az * nz
    scale = 1.0
    if c < -1.0 + 1e-12:  # by π, about any axis across n
        if abs(nx) < 0.6:
            kx, ky, kz = 0.0, nz, -ny
        else:
            kx, ky, kz = -nz, 0.0, nx
        c, scale = -1.0, 2.0 / (kx * kx + ky * ky + kz * kz)
    else:
        scale = 1.0 / (1.0 + c)
    opposite = c == -1.0
    ux, uy, uz = axes[3, 0], axes[3, 1], axes[3, 2]
    ce, se = math.cos(angle), math.sin(angle)
    for j in range(3):
        x, y, z = m[START, j], m[START, 3 + j], m[START, 6 + j]
        d = (kx * x + ky * y + kz * z) * scale
        sx, sy, sz = (0.0, 0.0, 0.0) if opposite else (ky * z - kz * y, kz * x - kx * z, kx * y - ky * x)
        put_column(m, ORIGIN, j, c * x + sx + d * kx, c * y + sy + d * ky, c * z + sz + d * kz)
    for j in range(3):
        x, y, z = m[ORIGIN, j], m[ORIGIN, 3 + j], m[ORIGIN, 6 + j]
        along = nx * x + ny * y + nz * z
        for i in range(3):
            n = nx if i == 0 else ny if i == 1 else nz
            parts[0, 3 * i + j] = n * along
            parts[0, 9 + 3 * i + j] = m[ORIGIN, 3 * i + j] - n * along
        parts[0, 18 + j], parts[0, 21 + j] = ny * z - nz * y, nz * x - nx * z
        parts[0, 24 + j] = nx * y - ny * x
        x, y, z = unit(j)
        x, y, z = rotate(ux, uy, uz, ce, se, x, y, z)
        x, y, z = apply(m, ORIGIN, x, y, z)
        put_column(m, BENT, j, x, y, z)
    # Wrist: W(φ) = BENTᵀ R(n, -φ) WHOLE.
    bx, by, bz = apply_back(m, BENT, nx, ny, nz)
    spin = form.spin
    spin[0, 0], spin[0, 1], spin[0, 2] = nx, ny, nz
    spin[1, 0], spin[1, 1], spin[1, 2] = -bx, -by, -bz
    for j in range(3):
        x, y, z = m[WHOLE, j], m[WHOLE, 3 + j], m[WHOLE, 6 + j]
        along = nx * x + ny * y + nz * z
        wx, wy, wz = apply_back(m, BENT, x, y, z)
        sx, sy, sz = apply_back(m, BENT, ny * z - nz * y, nz * x - nx * z, nx * y - ny * x)
        put_column(parts, 1, j, bx * along, by * along, bz * along)
        parts[1, 9 + j], parts[1, 12 + j], parts[1, 15 + j] = (
            wx - bx * along,
            wy - by * along,
            wz - bz * along,
        )
        parts[1, 18 + j], parts[1, 21 + j], parts[1, 24 + j] = -sx, -sy, -sz


@outlined
def swing(form, g, c, s):
    """The rotation of shoulder (g = 0) or wrist (1) at the swivel angle of this cosine and sine."""
    parts, m = form.parts, form.matrices
    row = ROTATED + g
    for i in range(9):
        m[row, i] = parts[g, i] + c * parts[g, 9 + i] + s * parts[g, 18 + i]


# Sine below which axes 1 and 3 are nearly in line, and the formulas take more care of digits.
_NEARLY = 1e-3
# Volume of three axes from which they count as lying in a plane: the joints' speeds are then without bound.
_FLAT = 1e-6
# Sine below which two axes count as one (a singular pose): the free angle then stays near the start.
ALIGNED = 1e-8


@outlined
def score(form, g, first_flip, last_flip, lower, upper):
    """Joint angles of the rotation made by ``swing``, into trial; their squared distances to the start.

    Flips are the two solutions of three hinges.  The distances go into scores[2 g + flip]; infinite where
    there is no solution inside the limits.  Returns the smallest.
    """
    scores, how = form.scores, form.groups[g, 0]
    for flip in range(first_flip, last_flip + 1):
        scores[2 * g + flip] = math.inf
    if how == HINGES:
        three_hinges(form, g, first_flip, last_flip, lower, upper)
    elif first_flip == 0:
        scores[2 * g] = ball(form, g, upper) if how == BALL_JOINT else 0.0
    return min(scores[2 * g + first_flip], scores[2 * g + last_flip])


@outlined
def three_hinges(form, g, first_flip, last_flip, lower, upper):
    """``score`` of three hinges that meet: R₁ R₂ R₃ = matrices[ROTATED + g]."""
    noinline()
    axes, m, start, trial, scores = form.axes, form.matrices, form.start, form.trial, form.scores
    k, row, j = 4 * g, ROTATED + g, form.groups[g, 1]
    hx, hy, hz = axes[k, 0], axes[k, 1], axes[k, 2]
    kx, ky, kz = axes[k + 1, 0], axes[k + 1, 1], axes[k + 1, 2]
    ex, ey, ez = axes[k + 2, 0], axes[k + 2, 1], axes[k + 2, 2]
    x, y, z = apply(m, row, ex, ey, ez)
    amplitude, middle = form.middle_rotations[g, 1], form.middle_rotations[g, 2]
    rest = hx * x + hy * y + hz * z - form.middle_rotations[g, 0]
    if abs(rest) > amplitude + 1e-9:
        return
    # 1 - cos is exact only by way of the sine, and counts where axes 1 and 3 come in line.
    above, below, cosine = amplitude - rest, amplitude + rest, rest + form.middle_rotations[g, 0]
    sx, sy, sz = hy * z - hz * y, hz * x - hx * z, hx * y - hy * x
    sine2 = sx * sx + sy * sy + sz * sz
    if cosine > 0.0 and abs(form.middle_rotations[g, 0] + amplitude - 1.0) < 1e-12:
        above = sine2 / (1.0 + cosine)
    elif cosine < 0.0 and abs(form.middle_rotations[g, 0] - amplitude + 1.0) < 1e-12:
        below = sine2 / (1.0 - cosine)
    side = math.sqrt(max(0.0, above * below))
    half = math.atan2(side, rest)
    bx, by, bz = apply_back(m, row, hx, hy, hz)  # R₃ᵀ R₂ᵀ h₁
    for flip in range(first_flip, last_flip + 1):
        second = middle + (half if flip == 0 else -half)
        two, inside = image(second, start[j + 1], lower[j + 1], upper[j + 1])
        if not inside:
            continue
        c, s = math.cos(second), math.sin(second)
        ax, ay, az = rotate(kx, ky, kz, c, s, ex, ey, ez)  # R₂ h₃
        one, weight = angle_between(hx, hy, hz, ax, ay, az, x, y, z)
        if weight > ALIGNED * ALIGNED:
            one, inside = image(one, start[j], lower[j], upper[j])
            if not inside:
                continue
            cx, cy, cz = rotate(kx, ky, kz, c, -s, hx, hy, hz)  # R₂ᵀ h₁
            three, _ = angle_between(ex, ey, ez, bx, by, bz, cx, cy, cz)
            if weight < _NEARLY * _NEARLY:  # what q₁ lacks in digits q₃ must make up for
                px, py, pz = ey * kz - ez * ky, ez * kx - ex * kz, ex * ky - ey * kx
                cx, cy, cz = apply(m, row, px, py, pz)
                cx, cy, cz = rotate(hx, hy, hz, math.cos(one), -math.sin(one), cx, cy, cz)
                cx, cy, cz = rotate(kx, ky, kz, c, -s, cx, cy, cz)
                three, _ = angle_between(ex, ey, ez, px, py, pz, cx, cy, cz)
        else:  # axes 1 and 3 in line: only q₁ ± q₃ counts; the rotation of a vector across them gives it
            px, py, pz = hy * kz - hz * ky, hz * kx - hx * kz, hx * ky - hy * kx
            cx, cy, cz = rotate(kx, ky, kz, c, -s, px, py, pz)
            cx, cy, cz = apply(m, row, cx, cy, cz)
            total, _ = angle_between(hx, hy, hz, px, py, pz, cx, cy, cz)
            one, three = split_inside(
                total, 1.0 if ax * hx + ay * hy + az * hz > 0.0 else -1.0, start[j], start[j + 2],
                lower[j], upper[j], lower[j + 2], upper[j + 2],
            )  # fmt: skip
            one, inside = image(one, start[j], lower[j], upper[j])
            if not inside:
                continue
        three, inside = image(three, start[j + 2], lower[j + 2], upper[j + 2])
        if not inside:
            continue
        trial[flip, j], trial[flip, j + 1], trial[flip, j + 2] = one, two, three
        one, two, three = one - start[j], two - start[j + 1], three - start[j + 2]
        scores[2 * g + flip] = one * one + two * two + three * three


@outlined
def ball(form, g, upper):
    """``score`` of a ball joint: its quaternion, of the two the one nearer to the start's."""
    noinline()
    m, start, trial = form.matrices, form.start, form.trial
    row, first, t = ROTATED + g, form.groups[g, 1], types.int64(0)
    trace = m[row, 0] + m[row, 4] + m[row, 8]
    xx, yy, zz = m[row, 0], m[row, 4], m[row, 8]
    wx, wy, wz = m[row, 7] - m[row, 5], m[row, 2] - m[row, 6], m[row, 3] - m[row, 1]
    xy, xz, yz = m[row, 1] + m[row, 3], m[row, 2] + m[row, 6], m[row, 5] + m[row, 7]
    # Of the four ways to the quaternion the one that divides by its largest number (Shepperd 1978).
    if trace >= max(xx, yy, zz):
        w, x, y, z = 1.0 + trace, wx, wy, wz
    elif xx >= yy and xx >= zz:
        w, x, y, z = wx, 1.0 + xx - yy - zz, xy, xz
    elif yy >= zz:
        w, x, y, z = wy, xy, 1.0 + yy - xx - zz, yz
    else:
        w, x, y, z = wz, xz, yz, 1.0 + zz - xx - yy
    x, y, z = into_frame(form.axes, 4 * g, x, y, z)
    a, b, c, d = start[first], start[first + 1], start[first + 2], start[first + 3]
    size = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if a * w + b * x + c * y + d * z < 0.0:
        size = -size
    w, x, y, z = w * size, x * size, y * size, z * size
    angle = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))
    if angle > upper[first] + 1e-9:
        return math.inf
    trial[t, first], trial[t, first + 1], trial[t, first + 2], trial[t, first + 3] = w, x, y, z
    # The rotation from the start to here, and how it grows with the swivel.
    px, py, pz = a * x - b * w - d * y + c * z, a * y - c * w - b * z + d * x, a * z - d * w - c * x + b * y
    px, py, pz = from_frame(form.axes, 4 * g, px, py, pz)
    sine = math.sqrt(px * px + py * py + pz * pz)
    between = 2.0 * math.atan2(sine, a * w + b * x + c * y + d * z)
    spin = form.spin
    form.speeds[g] = (px * spin[g, 0] + py * spin[g, 1] + pz * spin[g, 2]) / max(sine, 1e-30)
    return between * between


@outlined
def add_slope(form, g, flip):
    """Adds what ``score`` just found to scores[4] (half its slope by the swivel angle) and scores[5].

    Those are Σ (q - start) q' and Σ q'² of the joints' speeds q', from the axes a: Σ aᵢ q'ᵢ = the spin.
    Where the axes lie in a plane the second is infinite.
    """
    noinline()
    scores, axes, trial, start, spin = form.scores, form.axes, form.trial, form.start, form.spin
    how = form.groups[g, 0]
    if how == BALL_JOINT:
        scores[4] += math.sqrt(scores[2 * g + flip]) * form.speeds[g]
        scores[5] += 1.0
    if how != HINGES:
        return
    k, j = 4 * g, form.groups[g, 1]
    ax, ay, az = axes[k, 0], axes[k, 1], axes[k, 2]
    one = trial[flip, j]
    bx, by, bz = rotate(
        ax, ay, az, math.cos(one), math.sin(one), axes[k + 1, 0], axes[k + 1, 1], axes[k + 1, 2]
    )
    cx, cy, cz = apply(form.matrices, ROTATED + g, axes[k + 2, 0], axes[k + 2, 1], axes[k + 2, 2])
    nx, ny, nz = spin[g, 0], spin[g, 1], spin[g, 2]
    ux, uy, uz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    volume = ax * ux + ay * uy + az * uz
    if abs(volume) < _FLAT:
        scores[5] = math.inf
        return
    vx, vy, vz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    wx, wy, wz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    d1 = (nx * ux + ny * uy + nz * uz) / volume
    d2 = (nx * vx + ny * vy + nz * vz) / volume
    d3 = (nx * wx + ny * wy + nz * wz) / volume
    scores[4] += (one - start[j]) * d1
    scores[4] += (trial[flip, j + 1] - start[j + 1]) * d2 + (trial[flip, j + 2] - start[j + 2]) * d3
    scores[5] += d1 * d1 + d2 * d2 + d3 * d3
