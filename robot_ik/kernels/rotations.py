"""Residuals of turning, and how they shrink while a frame turns: whole orientations, and single axes."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined, pure

# Nearer than this (sine of the angle) two axes are one, or opposite.
_PARALLEL = 1e-9


@outlined
def rotation_error(target, current, g, out, at):
    """Rotation vector, world axes, that turns current[g] into target[g] (pose rows), into out[at:at+3].

    Returns its angle in [0, pi].  Exact at both ends: near pi the axis comes from the symmetric part.
    """
    # M = R_target · R_currentᵀ, of which only what is needed is formed.
    m00 = target[g, 3] * current[g, 3] + target[g, 4] * current[g, 4] + target[g, 5] * current[g, 5]
    m01 = target[g, 3] * current[g, 6] + target[g, 4] * current[g, 7] + target[g, 5] * current[g, 8]
    m02 = target[g, 3] * current[g, 9] + target[g, 4] * current[g, 10] + target[g, 5] * current[g, 11]
    m10 = target[g, 6] * current[g, 3] + target[g, 7] * current[g, 4] + target[g, 8] * current[g, 5]
    m11 = target[g, 6] * current[g, 6] + target[g, 7] * current[g, 7] + target[g, 8] * current[g, 8]
    m12 = target[g, 6] * current[g, 9] + target[g, 7] * current[g, 10] + target[g, 8] * current[g, 11]
    m20 = target[g, 9] * current[g, 3] + target[g, 10] * current[g, 4] + target[g, 11] * current[g, 5]
    m21 = target[g, 9] * current[g, 6] + target[g, 10] * current[g, 7] + target[g, 11] * current[g, 8]
    m22 = target[g, 9] * current[g, 9] + target[g, 10] * current[g, 10] + target[g, 11] * current[g, 11]
    x, y, z = 0.5 * (m21 - m12), 0.5 * (m02 - m20), 0.5 * (m10 - m01)
    sine = math.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (m00 + m11 + m22 - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > -0.9:
        scale = 1.0 + sine * sine / 6.0 if sine < 1e-6 else angle / sine
        out[at], out[at + 1], out[at + 2] = scale * x, scale * y, scale * z
        return angle
    # u uᵀ (1 − cos) = symmetric part of M − cos·1: take its largest column as the axis.
    s00, s11, s22 = m00 - cosine, m11 - cosine, m22 - cosine
    s01, s02, s12 = 0.5 * (m01 + m10), 0.5 * (m02 + m20), 0.5 * (m12 + m21)
    if s00 >= s11 and s00 >= s22:
        u, v, w = s00, s01, s02
    elif s11 >= s22:
        u, v, w = s01, s11, s12
    else:
        u, v, w = s02, s12, s22
    norm = math.sqrt(u * u + v * v + w * w)
    if u * x + v * y + w * z < 0.0:
        norm = -norm
    scale = angle / norm
    out[at], out[at + 1], out[at + 2] = scale * u, scale * v, scale * w
    return angle


@pure
def curvature(x, y, z):
    """The k of ``bent``, which depends on φ = (x, y, z) alone."""
    square = x * x + y * y + z * z
    if square < 1e-6:
        return 1.0 / 12.0 + square / 720.0
    half = 0.5 * math.sqrt(square)
    return (1.0 - half / math.tan(half)) / square


@pure
def bent(x, y, z, k, a, b, c):
    """J_r⁻¹(φ) ω for φ = (x, y, z), ω = (a, b, c): ω + ½ φ×ω + k φ×(φ×ω).

    How φ = log(R_target R_currentᵀ) shrinks while the current frame turns with ω; J_r is the right
    Jacobian of SO(3) (Solà et al., A micro Lie theory for state estimation, 2018, eq. 144).
    """
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        a + 0.5 * p + k * (y * r - z * q),
        b + 0.5 * q + k * (z * p - x * r),
        c + 0.5 * r + k * (x * q - y * p),
    )


@pure
def inverse_right_jacobian(x, y, z, a, b, c):
    """``bent`` for a single ω."""
    return bent(x, y, z, curvature(x, y, z), a, b, c)


@pure
def rotation_back(q, a, rw, rx, ry, rz):
    """Rotation vector, body axes, that turns the quaternion q[a:a+4] into (rw, rx, ry, rz), the short way."""
    w = q[a] * rw + q[a + 1] * rx + q[a + 2] * ry + q[a + 3] * rz
    x = q[a] * rx - q[a + 1] * rw - q[a + 2] * rz + q[a + 3] * ry
    y = q[a] * ry + q[a + 1] * rz - q[a + 2] * rw - q[a + 3] * rx
    z = q[a] * rz - q[a + 1] * ry + q[a + 2] * rx - q[a + 3] * rw
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z


@pure
def across(x, y, z):
    """A unit vector at right angles to the unit vector: its cross product with the farthest world axis."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        ux, uy, uz = 0.0, z, -y
    elif abs(y) <= abs(z):
        ux, uy, uz = -z, 0.0, x
    else:
        ux, uy, uz = y, -x, 0.0
    inverse = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
    return inverse * ux, inverse * uy, inverse * uz


@pure
def axis_error(ax, ay, az, dx, dy, dz):
    """Rotation vector, world axes, that turns the unit vector a the short way onto the unit vector d.

    Returns it with its angle in [0, pi]; at half a turn any axis across a will do.
    """
    nx, ny, nz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
    sine = math.sqrt(nx * nx + ny * ny + nz * nz)
    cosine = ax * dx + ay * dy + az * dz
    angle = math.atan2(sine, cosine)
    if sine > _PARALLEL:
        scale = angle / sine
        return scale * nx, scale * ny, scale * nz, angle
    if cosine > 0.0:
        return nx, ny, nz, angle
    ux, uy, uz = across(ax, ay, az)
    return angle * ux, angle * uy, angle * uz, angle


@pure
def axis_error_rate(ax, ay, az, dx, dy, dz, px, py, pz, qx, qy, qz):
    """Minus the derivative of ``axis_error`` while a moves with the velocity p and d with q.

    With n = a × d, s = |n|, c = a·d and θ the angle, the error is (θ/s) n; its derivative is
    (θ/s) n' − ((s − θ c)/s³) c' n, since s θ' = −c'.
    """
    nx, ny, nz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
    sine = math.sqrt(nx * nx + ny * ny + nz * nz)
    cosine = ax * dx + ay * dy + az * dz
    angle = math.atan2(sine, cosine)
    if sine < 1e-3 and cosine > 0.0:
        ratio, slope = 1.0 + angle * angle / 6.0, 1.0 / 3.0 + 2.0 * angle * angle / 15.0
    elif sine > _PARALLEL:
        ratio, slope = angle / sine, (sine - angle * cosine) / (sine * sine * sine)
    else:  # half a turn: only the way about the axis that ``axis_error`` takes counts
        ux, uy, uz = across(ax, ay, az)
        wx = (ay * pz - az * py) - (dy * qz - dz * qy)
        wy = (az * px - ax * pz) - (dz * qx - dx * qz)
        wz = (ax * py - ay * px) - (dx * qy - dy * qx)
        turned = ux * wx + uy * wy + uz * wz
        return turned * ux, turned * uy, turned * uz
    along = (px * dx + py * dy + pz * dz) + (ax * qx + ay * qy + az * qz)
    rx = (py * dz - pz * dy) + (ay * qz - az * qy)
    ry = (pz * dx - px * dz) + (az * qx - ax * qz)
    rz = (px * dy - py * dx) + (ax * qy - ay * qx)
    return (
        slope * along * nx - ratio * rx,
        slope * along * ny - ratio * ry,
        slope * along * nz - ratio * rz,
    )
