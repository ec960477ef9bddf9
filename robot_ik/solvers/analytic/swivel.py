"""Shoulder and wrist of a limb at one swivel angle: their rotations, joint angles, distance to the start.

With the shoulder at p, the wrist's centre at w and n the unit vector between them, the elbow's angle is
known and what is left is a turn about n: S(φ) = R(n, φ) S₀.  S₀ is the start's own rotation brought to
the goal by the smallest turn, so that φ = 0 is the swivel of the start.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure
from robot_ik.solvers.analytic.geometry import BALL_JOINT, HINGES
from robot_ik.solvers.analytic.subproblems import angle_between, image, split_inside, turn

# Rows of form.matrices: the start's shoulder, S₀, the goal's rotation of all joints, S₀ with the elbow's
# turn, then the rotations of shoulder and wrist at the swivel angle of the moment.
START, ORIGIN, WHOLE, BENT, TURNED = 0, 1, 2, 3, 4

# Sine below which two axes count as one (a singular pose): the free angle then stays near the start.
ALIGNED = 1e-7


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


@outlined
def start_rotation(form):
    """What the start makes of the shoulder, into matrices[START]."""
    m, axes, start = form.matrices, form.axes, form.start
    if form.groups[0, 0] == BALL_JOINT:
        w, x, y, z = start[0], start[1], start[2], start[3]
        s = 2.0 / max(w * w + x * x + y * y + z * z, 1e-30)
        put_column(m, START, 0, 1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y))
        put_column(m, START, 1, s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x))
        put_column(m, START, 2, s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y))
        return
    for j in range(3):
        x, y, z = 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0
        for k in range(2, -1, -1):
            c, s = math.cos(start[k]), math.sin(start[k])
            x, y, z = turn(axes[k, 0], axes[k, 1], axes[k, 2], c, s, x, y, z)
        put_column(m, START, j, x, y, z)


@outlined
def make_parts(form, angle, vx, vy, vz, nx, ny, nz):
    """Rotations of shoulder and wrist as functions of the swivel angle, for an elbow at ``angle``.

    v and n are unit vectors from the shoulder to the wrist's centre: as the elbow makes it, and wanted.
    """
    m, parts, axes = form.matrices, form.parts, form.axes
    ax, ay, az = apply(m, START, vx, vy, vz)
    kx, ky, kz = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
    c = ax * nx + ay * ny + az * nz
    scale = 1.0
    if c < -1.0 + 1e-12:  # half a turn, about any axis across n
        if abs(nx) < 0.6:
            kx, ky, kz = 0.0, nz, -ny
        else:
            kx, ky, kz = -nz, 0.0, nx
        c, scale = -1.0, 2.0 / (kx * kx + ky * ky + kz * kz)
    else:
        scale = 1.0 / (1.0 + c)
    half_turn = c == -1.0
    ux, uy, uz = axes[3, 0], axes[3, 1], axes[3, 2]
    ce, se = math.cos(angle), math.sin(angle)
    for j in range(3):
        x, y, z = m[START, j], m[START, 3 + j], m[START, 6 + j]
        d = (kx * x + ky * y + kz * z) * scale
        sx, sy, sz = (0.0, 0.0, 0.0) if half_turn else (ky * z - kz * y, kz * x - kx * z, kx * y - ky * x)
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
        x, y, z = 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0
        x, y, z = turn(ux, uy, uz, ce, se, x, y, z)
        x, y, z = apply(m, ORIGIN, x, y, z)
        put_column(m, BENT, j, x, y, z)
    # Wrist: W(φ) = BENTᵀ R(n, -φ) WHOLE.
    bx, by, bz = apply_back(m, BENT, nx, ny, nz)
    for j in range(3):
        x, y, z = m[WHOLE, j], m[WHOLE, 3 + j], m[WHOLE, 6 + j]
        along = nx * x + ny * y + nz * z
        wx, wy, wz = apply_back(m, BENT, x, y, z)
        sx, sy, sz = apply_back(m, BENT, ny * z - nz * y, nz * x - nx * z, nx * y - ny * x)
        put_column(parts, 1, j, bx * along, by * along, bz * along)
        parts[1, 9 + j], parts[1, 12 + j], parts[1, 15 + j] = wx - bx * along, wy - by * along, wz - bz * along
        parts[1, 18 + j], parts[1, 21 + j], parts[1, 24 + j] = -sx, -sy, -sz


@outlined
def swing(form, g, c, s):
    """The rotation of shoulder (g = 0) or wrist (1) at the swivel angle of this cosine and sine."""
    parts, m = form.parts, form.matrices
    row = TURNED + g
    for i in range(9):
        m[row, i] = parts[g, i] + c * parts[g, 9 + i] + s * parts[g, 18 + i]


@outlined
def score(form, g, flip, lower, upper):
    """Joint angles of the rotation made by ``swing``, into trial[flip]; their squared distance to the start.

    ``flip``: which of the two solutions of three hinges.  Infinite where there is none inside the limits.
    """
    how = form.groups[g, 0]
    if how == HINGES:
        return three_hinges(form, g, flip, lower, upper)
    if flip == 1:
        return math.inf
    return ball(form, g, upper) if how == BALL_JOINT else 0.0


@outlined
def three_hinges(form, g, flip, lower, upper):
    """``score`` of three hinges that meet: R₁ R₂ R₃ = matrices[TURNED + g]."""
    axes, m, start, trial = form.axes, form.matrices, form.start, form.trial
    k, row, first = 4 * g, TURNED + g, form.groups[g, 1]
    hx, hy, hz = axes[k, 0], axes[k, 1], axes[k, 2]
    kx, ky, kz = axes[k + 1, 0], axes[k + 1, 1], axes[k + 1, 2]
    ex, ey, ez = axes[k + 2, 0], axes[k + 2, 1], axes[k + 2, 2]
    x, y, z = apply(m, row, ex, ey, ez)
    amplitude = form.turns[g, 1]
    rest = hx * x + hy * y + hz * z - form.turns[g, 0]
    if abs(rest) > amplitude + 1e-9:
        return math.inf
    half = math.atan2(math.sqrt(max(0.0, (amplitude - rest) * (amplitude + rest))), rest)
    second = form.turns[g, 2] + (half if flip == 0 else -half)
    c, s = math.cos(second), math.sin(second)
    ax, ay, az = turn(kx, ky, kz, c, s, ex, ey, ez)  # R₂ h₃
    one, weight = angle_between(hx, hy, hz, ax, ay, az, x, y, z)
    if weight > ALIGNED * ALIGNED:
        bx, by, bz = turn(kx, ky, kz, c, -s, hx, hy, hz)  # R₂ᵀ h₁
        x, y, z = apply_back(m, row, hx, hy, hz)
        three, _ = angle_between(ex, ey, ez, bx, by, bz, x, y, z)
        three = -three
    else:  # axes 1 and 3 in line: only q₁ ± q₃ counts; the turn of a vector across them tells it
        px, py, pz = hy * kz - hz * ky, hz * kx - hx * kz, hx * ky - hy * kx
        x, y, z = turn(kx, ky, kz, c, -s, px, py, pz)
        x, y, z = apply(m, row, x, y, z)
        total, _ = angle_between(hx, hy, hz, px, py, pz, x, y, z)
        one, three = split_inside(
            total, 1.0 if ax * hx + ay * hy + az * hz > 0.0 else -1.0, start[first], start[first + 2],
            lower[first], upper[first], lower[first + 2], upper[first + 2],
        )  # fmt: skip
    distance = 0.0
    for j in range(3):
        angle = one if j == 0 else second if j == 1 else three
        angle, inside = image(angle, start[first + j], lower[first + j], upper[first + j])
        if not inside:
            return math.inf
        trial[flip, first + j] = angle
        distance += (angle - start[first + j]) * (angle - start[first + j])
    return distance


@outlined
def ball(form, g, upper):
    """``score`` of a ball joint: its quaternion, of the two the one nearer to the start's."""
    m, start, trial = form.matrices, form.start, form.trial
    row, first, t = TURNED + g, form.groups[g, 1], types.int64(0)
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
    a, b, c, d = start[first], start[first + 1], start[first + 2], start[first + 3]
    size = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if a * w + b * x + c * y + d * z < 0.0:
        size = -size
    w, x, y, z = w * size, x * size, y * size, z * size
    angle = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))
    if angle > upper[first] + 1e-9:
        return math.inf
    trial[t, first], trial[t, first + 1], trial[t, first + 2], trial[t, first + 3] = w, x, y, z
    # The turn between the two, of the conjugate start times this.
    sine = (
        (a * x - b * w - c * z + d * y) ** 2
        + (a * y + b * z - c * w - d * x) ** 2
        + (a * z - b * y + c * x - d * w) ** 2
    )
    between = 2.0 * math.atan2(math.sqrt(sine), a * w + b * x + c * y + d * z)
    return between * between
