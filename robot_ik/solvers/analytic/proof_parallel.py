"""The proof of ``proof.py`` for arms with three parallel axes (Universal Robots)."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import outlined
from robot_ik.solvers.analytic.apart import keep_apart
from robot_ik.solvers.analytic.intervals import (
    PAD,
    across,
    arc,
    cap,
    centre_error,
    chord,
    height_terms,
    length,
    may_fit,
    polar_angle,
    spread,
)
from robot_ik.solvers.analytic.six_axes import back, centre, relative_back, relative_rotation
from robot_ik.solvers.analytic.subproblems import angle_between, turn


@outlined
def parallel_is_out_of_reach(axes, extra, target, lower, upper, tolerance):
    """Of six axes of which the second to fourth are parallel and the last two meet."""
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
        gx, gy, gz = turn(hx, hy, hz, c1, -s1, dx, dy, dz)
        gx, gy, gz = gx + p1x - axes[1, 3], gy + p1y - axes[1, 4], gz + p1z - axes[1, 5]
        bx, by, bz = turn(hx, hy, hz, c1, s1, ux, uy, uz)
        bx, by, bz = relative_back(target, extra, bx, by, bz)  # Q1^T u
        off = error + chord(radius, across(hx, hy, hz, dx, dy, dz))
        turned = min(math.pi, tolerance[0, 1] + radius + PAD)
        polar = polar_angle(ux, uy, uz, x, y, z)
        half5, radius5, some = arc(
            math.cos(min(math.pi, polar + turned)) - constant5 - PAD,
            math.cos(max(0.0, polar - turned)) - constant5 + PAD,
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
                x, y, z, bx, by, bz, gx, gy, gz, off, turned, polar,
            ):  # fmt: skip
                return False
    return True


@outlined
def three_may_fit(
    axes, extra, lower, upper, c5, s5, radius5, x, y, z, bx, by, bz, gx, gy, gz, off, turned, polar
):  # fmt: skip
    """Whether joints 6 and 2 to 4 of three parallel axes may follow joints 1 and 5."""
    keep_apart()
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    along3 = 1.0 if ux * axes[2, 0] + uy * axes[2, 1] + uz * axes[2, 2] > 0.0 else -1.0
    along4 = 1.0 if ux * axes[3, 0] + uy * axes[3, 1] + uz * axes[3, 2] > 0.0 else -1.0
    kx, ky, kz = axes[4, 0], axes[4, 1], axes[4, 2]
    ox, oy, oz = axes[5, 0], axes[5, 1], axes[5, 2]
    tx, ty, tz = turn(kx, ky, kz, c5, -s5, ux, uy, uz)  # R5^T u
    q6, _ = angle_between(ox, oy, oz, tx, ty, tz, bx, by, bz)
    wide = cap(turned, polar) + cap(radius5, polar_angle(ox, oy, oz, tx, ty, tz))
    if not may_fit(-q6, wide, lower[5], upper[5]):
        return False
    ax, ay, az = turn(kx, ky, kz, c5, s5, ox, oy, oz)  # R5 h6
    theta, _ = angle_between(ux, uy, uz, ax, ay, az, x, y, z)
    around = cap(turned, polar) + cap(radius5, polar_angle(ux, uy, uz, ax, ay, az))
    lx, ly, lz = extra[0, 0] - axes[3, 3], extra[0, 1] - axes[3, 4], extra[0, 2] - axes[3, 5]
    off += chord(around, across(ux, uy, uz, lx, ly, lz))
    lx, ly, lz = turn(ux, uy, uz, math.cos(theta), math.sin(theta), lx, ly, lz)
    vx, vy, vz = gx - lx, gy - ly, gz - lz
    far = across(ux, uy, uz, vx, vy, vz)
    ex, ey, ez = axes[3, 3] - axes[2, 3], axes[3, 4] - axes[2, 4], axes[3, 5] - axes[2, 5]
    fx, fy, fz = axes[1, 3] - axes[2, 3], axes[1, 4] - axes[2, 4], axes[1, 5] - axes[2, 5]
    lf, le = across(ux, uy, uz, fx, fy, fz), across(ux, uy, uz, ex, ey, ez)
    _, reach, bend = height_terms(fx, fy, fz, ux, uy, uz, ex, ey, ez)
    near_side, far_side = max(0.0, far - off), far + off
    sides = lf * lf + le * le
    half, radius, some = arc(
        0.5 * (sides - far_side * far_side) - PAD, 0.5 * (sides - near_side * near_side) + PAD, reach
    )
    if not some:
        return False
    for elbow in range(2):
        a3 = bend + half if elbow == 0 else bend - half
        if not may_fit(along3 * a3, radius, lower[2], upper[2]):
            continue
        mx, my, mz = turn(ux, uy, uz, math.cos(a3), math.sin(a3), ex, ey, ez)
        mx, my, mz = mx - fx, my - fy, mz - fz
        q2, _ = angle_between(ux, uy, uz, mx, my, mz, vx, vy, vz)
        wide = spread(off, far) + spread(chord(radius, le), across(ux, uy, uz, mx, my, mz))
        if may_fit(q2, wide, lower[1], upper[1]) and may_fit(
            along4 * (theta - q2 - a3), around + wide + radius, lower[3], upper[3]
        ):
            return True
    return False
