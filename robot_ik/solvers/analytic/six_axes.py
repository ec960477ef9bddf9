"""Closed forms of six hinges: a spherical wrist on two parallel axes, and three parallel axes.

Both work on the product of exponentials T(q) = e₁(q₁) … e₆(q₆) M at the zero configuration: a table
``axes`` (6, 6) of unit direction and a point of each joint axis, world frame, and ``extra`` (5, 3):
the wrist centre in the world at q = 0, the same seen from the tool, and the rows of M's rotation.
Nothing else of the model counts, so names, link frames, base and tool are free.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import noinline, outlined, pure
from robot_ik.solvers.analytic.subproblems import angle_between, angles_to_height, rotate, split_inside

# Sine below which two axes count as parallel in a pose (a singular one): the free angle is then kept.
ALIGNED = 1e-7
# Metres by which a reach may be missed through rounding.
SLACK = 1e-9
# Places at which a free angle is tried.
_FREE_TRIES = 64


@pure
def relative_rotation(target, extra, x, y, z):
    """R_target · R_Mᵀ · v: what the joints' rotation makes of v (v as at q = 0)."""
    a = extra[2, 0] * x + extra[3, 0] * y + extra[4, 0] * z
    b = extra[2, 1] * x + extra[3, 1] * y + extra[4, 1] * z
    c = extra[2, 2] * x + extra[3, 2] * y + extra[4, 2] * z
    return (
        target[0, 3] * a + target[0, 4] * b + target[0, 5] * c,
        target[0, 6] * a + target[0, 7] * b + target[0, 8] * c,
        target[0, 9] * a + target[0, 10] * b + target[0, 11] * c,
    )


@pure
def relative_back(target, extra, x, y, z):
    """R_M · R_targetᵀ · v: the inverse of ``relative_rotation``."""
    a = target[0, 3] * x + target[0, 6] * y + target[0, 9] * z
    b = target[0, 4] * x + target[0, 7] * y + target[0, 10] * z
    c = target[0, 5] * x + target[0, 8] * y + target[0, 11] * z
    return (
        extra[2, 0] * a + extra[2, 1] * b + extra[2, 2] * c,
        extra[3, 0] * a + extra[3, 1] * b + extra[3, 2] * c,
        extra[4, 0] * a + extra[4, 1] * b + extra[4, 2] * c,
    )


@pure
def centre(target, extra):
    """Where the wrist centre must be, world."""
    x, y, z = extra[1, 0], extra[1, 1], extra[1, 2]
    return (
        target[0, 0] + target[0, 3] * x + target[0, 4] * y + target[0, 5] * z,
        target[0, 1] + target[0, 6] * x + target[0, 7] * y + target[0, 8] * z,
        target[0, 2] + target[0, 9] * x + target[0, 10] * y + target[0, 11] * z,
    )


@pure
def back(axes, j, c, s, x, y, z):
    """v rotated about axis j by minus the angle with cosine c and sine s."""
    return rotate(axes[j, 0], axes[j, 1], axes[j, 2], c, -s, x, y, z)


@pure
def wrist_angles(axes, target, extra, start, lower, upper, flip, c1, s1, c2, s2, c3, s3):
    """q4, q5, q6 of the rotation that is left after joints 1 to 3; and whether there are any.

    R₄ R₅ R₆ = Q = (R₁ R₂ R₃)ᵀ R_target R_Mᵀ.  What Q makes of h₆, and its inverse of h₄, is all
    that is needed.
    """
    x, y, z = relative_rotation(target, extra, axes[5, 0], axes[5, 1], axes[5, 2])
    x, y, z = back(axes, 0, c1, s1, x, y, z)
    x, y, z = back(axes, 1, c2, s2, x, y, z)
    x, y, z = back(axes, 2, c3, s3, x, y, z)  # Q h6
    h4x, h4y, h4z = axes[3, 0], axes[3, 1], axes[3, 2]
    h6x, h6y, h6z = axes[5, 0], axes[5, 1], axes[5, 2]
    k5x, k5y, k5z = axes[4, 0], axes[4, 1], axes[4, 2]
    mid, half, amplitude, possible = angles_to_height(
        h4x, h4y, h4z, k5x, k5y, k5z, h6x, h6y, h6z, h4x * x + h4y * y + h4z * z, SLACK
    )
    if not possible or amplitude < 1e-12:
        return 0.0, 0.0, 0.0, False
    q5 = mid + half if flip == 0 else mid - half
    c5, s5 = math.cos(q5), math.sin(q5)
    ax, ay, az = rotate(k5x, k5y, k5z, c5, s5, h6x, h6y, h6z)  # R5 h6
    # Qᵀ h4, for q6.
    bx, by, bz = rotate(axes[2, 0], axes[2, 1], axes[2, 2], c3, s3, h4x, h4y, h4z)
    bx, by, bz = rotate(axes[1, 0], axes[1, 1], axes[1, 2], c2, s2, bx, by, bz)
    bx, by, bz = rotate(axes[0, 0], axes[0, 1], axes[0, 2], c1, s1, bx, by, bz)
    bx, by, bz = relative_back(target, extra, bx, by, bz)
    gx, gy, gz = rotate(k5x, k5y, k5z, c5, -s5, h4x, h4y, h4z)  # R5ᵀ h4
    q4, weight = angle_between(h4x, h4y, h4z, ax, ay, az, x, y, z)
    if weight > ALIGNED * ALIGNED:
        q6, _ = angle_between(h6x, h6y, h6z, gx, gy, gz, bx, by, bz)
        return q4, q5, -q6, True
    # Axes 4 and 6 in line: only q4 ± q6 counts.  The rotation of any vector across them gives it.
    sign = 1.0 if ax * h4x + ay * h4y + az * h4z > 0.0 else -1.0
    px, py, pz = h4y * k5z - h4z * k5y, h4z * k5x - h4x * k5z, h4x * k5y - h4y * k5x
    tx, ty, tz = rotate(k5x, k5y, k5z, c5, -s5, px, py, pz)  # R5ᵀ p: what p was before joint 5
    vx, vy, vz = relative_rotation(target, extra, tx, ty, tz)
    vx, vy, vz = back(axes, 0, c1, s1, vx, vy, vz)
    vx, vy, vz = back(axes, 1, c2, s2, vx, vy, vz)
    vx, vy, vz = back(axes, 2, c3, s3, vx, vy, vz)
    total, _ = angle_between(h4x, h4y, h4z, px, py, pz, vx, vy, vz)
    q4, q6 = split_inside(total, sign, start[3], start[5], lower[3], upper[3], lower[5], upper[5])
    return q4, q5, q6, True


@outlined
def spherical_wrist(axes, extra, target, start, lower, upper, branches):
    """All branches of an arm whose axes 2 and 3 are parallel and whose last three meet.

    Fills ``branches`` (8, 6), row = 4·shoulder + 2·elbow + flip; a row that does not exist gets NaN.
    Returns how many exist.
    """
    noinline()
    found = 0
    wx, wy, wz = centre(target, extra)
    h1x, h1y, h1z = axes[0, 0], axes[0, 1], axes[0, 2]
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    along3 = 1.0 if ux * axes[2, 0] + uy * axes[2, 1] + uz * axes[2, 2] > 0.0 else -1.0
    p2x, p2y, p2z = axes[1, 3], axes[1, 4], axes[1, 5]
    ex, ey, ez = extra[0, 0] - axes[2, 3], extra[0, 1] - axes[2, 4], extra[0, 2] - axes[2, 5]  # p3 -> centre
    fx, fy, fz = p2x - axes[2, 3], p2y - axes[2, 4], p2z - axes[2, 5]  # p3 -> p2
    offset = ux * (extra[0, 0] - p2x) + uy * (extra[0, 1] - p2y) + uz * (extra[0, 2] - p2z)
    height = offset + ux * (p2x - axes[0, 3]) + uy * (p2y - axes[0, 4]) + uz * (p2z - axes[0, 5])
    dx, dy, dz = wx - axes[0, 3], wy - axes[0, 4], wz - axes[0, 5]
    # h · R(h1, -q1) d = height: the sign of the axis makes it subproblem 4.
    mid1, half1, amplitude1, possible = angles_to_height(
        ux, uy, uz, -h1x, -h1y, -h1z, dx, dy, dz, height, SLACK
    )
    for row in range(8):
        for j in range(6):
            branches[row, j] = math.nan
    if not possible:
        return 0
    fe = fx * ux + fy * uy + fz * uz
    ee = ex * ux + ey * uy + ez * uz
    reach = (ex * ex + ey * ey + ez * ez - ee * ee) + (fx * fx + fy * fy + fz * fz - fe * fe)
    for shoulder in range(2):
        # On axis 1 every q1 will do: keep it.
        q1 = start[0] if amplitude1 < 1e-12 else (mid1 + half1 if shoulder == 0 else mid1 - half1)
        c1, s1 = math.cos(q1), math.sin(q1)
        gx, gy, gz = rotate(h1x, h1y, h1z, c1, -s1, dx, dy, dz)
        gx, gy, gz = gx + axes[0, 3] - p2x, gy + axes[0, 4] - p2y, gz + axes[0, 5] - p2z  # p2 -> centre
        gu = gx * ux + gy * uy + gz * uz
        far = gx * gx + gy * gy + gz * gz - gu * gu
        # (R(u, a) e)·f across u = (|e|² + |f|² − far) / 2
        mid3, half3, amplitude3, possible = angles_to_height(
            fx, fy, fz, ux, uy, uz, ex, ey, ez, 0.5 * (reach - far) + fe * ee, SLACK
        )
        if not possible:
            continue
        for elbow in range(2):
            a3 = along3 * start[2] if amplitude3 < 1e-12 else (mid3 + half3 if elbow == 0 else mid3 - half3)
            c3, s3 = math.cos(a3), math.sin(a3)
            vx, vy, vz = rotate(ux, uy, uz, c3, s3, ex, ey, ez)
            q2, weight = angle_between(ux, uy, uz, vx - fx, vy - fy, vz - fz, gx, gy, gz)
            if weight < 1e-14:
                q2 = start[1]  # folded onto axis 2: every q2 will do
            c2, s2 = math.cos(q2), math.sin(q2)
            for flip in range(2):
                q4, q5, q6, possible = wrist_angles(
                    axes, target, extra, start, lower, upper, flip, c1, s1, c2, s2, c3, along3 * s3
                )
                if not possible:
                    continue
                row = 4 * shoulder + 2 * elbow + flip
                branches[row, 0], branches[row, 1], branches[row, 2] = q1, q2, along3 * a3
                branches[row, 3], branches[row, 4], branches[row, 5] = q4, q5, q6
                found += 1
    return found


@outlined
def three_parallel(axes, extra, target, start, branches):
    """All branches of an arm whose axes 2, 3 and 4 are parallel and whose last two meet (Universal Robots).

    Fills ``branches`` (8, 6), row = 4·shoulder + 2·flip + elbow; a row that does not exist gets NaN.
    Returns how many exist.
    """
    noinline()
    found = 0
    for row in range(8):
        for j in range(6):
            branches[row, j] = math.nan
    wx, wy, wz = centre(target, extra)
    h1x, h1y, h1z = axes[0, 0], axes[0, 1], axes[0, 2]
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    along3 = 1.0 if ux * axes[2, 0] + uy * axes[2, 1] + uz * axes[2, 2] > 0.0 else -1.0
    along4 = 1.0 if ux * axes[3, 0] + uy * axes[3, 1] + uz * axes[3, 2] > 0.0 else -1.0
    p1x, p1y, p1z = axes[0, 3], axes[0, 4], axes[0, 5]
    height = ux * (extra[0, 0] - p1x) + uy * (extra[0, 1] - p1y) + uz * (extra[0, 2] - p1z)
    dx, dy, dz = wx - p1x, wy - p1y, wz - p1z
    mid1, half1, amplitude1, possible = angles_to_height(
        ux, uy, uz, -h1x, -h1y, -h1z, dx, dy, dz, height, SLACK
    )
    if not possible:
        return 0
    h5x, h5y, h5z = axes[4, 0], axes[4, 1], axes[4, 2]
    h6x, h6y, h6z = axes[5, 0], axes[5, 1], axes[5, 2]
    ex, ey, ez = axes[3, 3] - axes[2, 3], axes[3, 4] - axes[2, 4], axes[3, 5] - axes[2, 5]  # p3 -> p4
    fx, fy, fz = axes[1, 3] - axes[2, 3], axes[1, 4] - axes[2, 4], axes[1, 5] - axes[2, 5]  # p3 -> p2
    ee, fe = ex * ux + ey * uy + ez * uz, fx * ux + fy * uy + fz * uz
    reach = (ex * ex + ey * ey + ez * ez - ee * ee) + (fx * fx + fy * fy + fz * fz - fe * fe)
    rx, ry, rz = relative_rotation(target, extra, h6x, h6y, h6z)
    for shoulder in range(2):
        q1 = start[0] if amplitude1 < 1e-12 else (mid1 + half1 if shoulder == 0 else mid1 - half1)
        c1, s1 = math.cos(q1), math.sin(q1)
        ax, ay, az = back(axes, 0, c1, s1, rx, ry, rz)  # Q1 h6
        mid5, half5, amplitude5, possible = angles_to_height(
            ux, uy, uz, h5x, h5y, h5z, h6x, h6y, h6z, ux * ax + uy * ay + uz * az, SLACK
        )
        if not possible or amplitude5 < 1e-12:
            continue
        gx, gy, gz = rotate(h1x, h1y, h1z, c1, -s1, dx, dy, dz)
        gx, gy, gz = gx + p1x - axes[1, 3], gy + p1y - axes[1, 4], gz + p1z - axes[1, 5]  # p2 -> centre
        ox, oy, oz = rotate(h1x, h1y, h1z, c1, s1, ux, uy, uz)
        ox, oy, oz = relative_back(target, extra, ox, oy, oz)  # Q1ᵀ u
        for flip in range(2):
            q5 = mid5 + half5 if flip == 0 else mid5 - half5
            c5, s5 = math.cos(q5), math.sin(q5)
            bx, by, bz = rotate(h5x, h5y, h5z, c5, s5, h6x, h6y, h6z)  # R5 h6
            tx, ty, tz = rotate(h5x, h5y, h5z, c5, -s5, ux, uy, uz)  # R5ᵀ u
            theta, weight = angle_between(ux, uy, uz, bx, by, bz, ax, ay, az)
            q6, _ = angle_between(h6x, h6y, h6z, tx, ty, tz, ox, oy, oz)
            q6 = -q6
            # With axis 6 parallel to the three only θ ± q6 counts: try q6 as it is, then ever farther off,
            # until the elbow reaches.
            tries = 1 if weight > ALIGNED * ALIGNED else _FREE_TRIES
            mid3, half3, amplitude3, possible = 0.0, 0.0, 0.0, False
            vx, vy, vz = 0.0, 0.0, 0.0
            for k in range(tries):
                if tries > 1:
                    q6 = start[5] + (k + 1) // 2 * (2.0 * math.pi / _FREE_TRIES) * (
                        1.0 if k % 2 == 1 else -1.0
                    )
                    # Across u lies h5; what the joints before 6 make of it gives θ.
                    mx, my, mz = rotate(h6x, h6y, h6z, math.cos(q6), -math.sin(q6), h5x, h5y, h5z)
                    mx, my, mz = relative_rotation(target, extra, mx, my, mz)
                    mx, my, mz = back(axes, 0, c1, s1, mx, my, mz)
                    theta, _ = angle_between(ux, uy, uz, h5x, h5y, h5z, mx, my, mz)
                lx, ly, lz = rotate(
                    ux, uy, uz, math.cos(theta), math.sin(theta),
                    extra[0, 0] - axes[3, 3], extra[0, 1] - axes[3, 4], extra[0, 2] - axes[3, 5],
                )  # fmt: skip
                vx, vy, vz = gx - lx, gy - ly, gz - lz  # p2 -> p4
                vu = vx * ux + vy * uy + vz * uz
                far = vx * vx + vy * vy + vz * vz - vu * vu
                mid3, half3, amplitude3, possible = angles_to_height(
                    fx, fy, fz, ux, uy, uz, ex, ey, ez, 0.5 * (reach - far) + fe * ee, SLACK
                )
                if possible:
                    break
            if not possible:
                continue
            for elbow in range(2):
                a3 = (
                    along3 * start[2]
                    if amplitude3 < 1e-12
                    else (mid3 + half3 if elbow == 0 else mid3 - half3)
                )
                kx, ky, kz = rotate(ux, uy, uz, math.cos(a3), math.sin(a3), ex, ey, ez)
                q2, weight = angle_between(ux, uy, uz, kx - fx, ky - fy, kz - fz, vx, vy, vz)
                if weight < 1e-14:
                    q2 = start[1]
                row = 4 * shoulder + 2 * flip + elbow
                branches[row, 0], branches[row, 1], branches[row, 2] = q1, q2, along3 * a3
                branches[row, 3], branches[row, 4], branches[row, 5] = along4 * (theta - q2 - a3), q5, q6
                found += 1
    return found


# Metres off the plane of motion, or beyond the reach, that still are rounding.
_SLACK = 1e-9


@outlined
def planar_two_link(axes, extra, target, start, slack, branches):
    """Both elbows of a two-link arm for a position; ``extra`` row 0 is the tool at q = 0.

    Fills ``branches`` (8, n), rows 0 and 1; returns how many exist.  ``slack`` (m): how far the target may
    lie off the plane in which the tool moves.
    """
    noinline()
    for row in range(branches.shape[0]):
        for j in range(branches.shape[1]):
            branches[row, j] = math.nan
    ux, uy, uz = axes[0, 0], axes[0, 1], axes[0, 2]
    along = 1.0 if ux * axes[1, 0] + uy * axes[1, 1] + uz * axes[1, 2] > 0.0 else -1.0
    gx, gy, gz = target[0, 0] - axes[0, 3], target[0, 1] - axes[0, 4], target[0, 2] - axes[0, 5]
    ex, ey, ez = extra[0, 0] - axes[1, 3], extra[0, 1] - axes[1, 4], extra[0, 2] - axes[1, 5]
    fx, fy, fz = axes[0, 3] - axes[1, 3], axes[0, 4] - axes[1, 4], axes[0, 5] - axes[1, 5]
    gu = gx * ux + gy * uy + gz * uz
    ee, fe = ex * ux + ey * uy + ez * uz, fx * ux + fy * uy + fz * uz
    if abs(gu - (ee - fe)) > slack:
        return 0
    reach = (ex * ex + ey * ey + ez * ez - ee * ee) + (fx * fx + fy * fy + fz * fz - fe * fe)
    far = gx * gx + gy * gy + gz * gz - gu * gu
    mid, half, amplitude, possible = angles_to_height(
        fx, fy, fz, ux, uy, uz, ex, ey, ez, 0.5 * (reach - far) + fe * ee, _SLACK
    )
    if not possible:
        return 0
    for elbow in range(2):
        a2 = along * start[1] if amplitude < 1e-12 else (mid + half if elbow == 0 else mid - half)
        vx, vy, vz = rotate(ux, uy, uz, math.cos(a2), math.sin(a2), ex, ey, ez)
        q1, weight = angle_between(ux, uy, uz, vx - fx, vy - fy, vz - fz, gx, gy, gz)
        if weight < 1e-14:
            q1 = start[0]  # folded onto the first axis: every angle will do
        branches[elbow, 0], branches[elbow, 1] = q1, along * a2
    return 2
