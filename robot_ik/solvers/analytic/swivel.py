"""Shoulder and wrist of a limb as functions of its swivel angle.

With the shoulder at p, the wrist's centre at w and n the unit vector between them, the elbow's angle is
known and what is left is a turn about n: S(φ) = R(n, φ) S₀.  S₀ is the start's own rotation brought to
the goal by the smallest turn, so that φ = 0 is the swivel of the start.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.geometry import BALL_JOINT
from robot_ik.solvers.analytic.subproblems import turn

# Rows of form.matrices: the start's shoulder, S₀, the goal's rotation of all joints, S₀ with the elbow's
# turn, then the rotations of shoulder and wrist at the swivel angle of the moment.
START, ORIGIN, WHOLE, BENT, TURNED = 0, 1, 2, 3, 4


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
    keep_apart()
    m, axes, start = form.matrices, form.axes, form.start
    if form.groups[0, 0] == BALL_JOINT:
        # A ball joint turns in its own frame; its axes stand in the table.
        w = start[0]
        x, y, z = from_frame(axes, types.int64(0), start[1], start[2], start[3])
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
    keep_apart()
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
    row = TURNED + g
    for i in range(9):
        m[row, i] = parts[g, i] + c * parts[g, 9 + i] + s * parts[g, 18 + i]
