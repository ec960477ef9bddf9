"""The three small rotation problems that closed forms are made of, on plain numbers.

After Paden (Kinematics and control of robot manipulators, 1986) and Elias & Wen (IK-Geo: unified robot
inverse kinematics using subproblem decomposition, 2022, subproblems 1, 3 and 4).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import pure

# Cosines beyond 1 by less than this are rounding of an arm that is just stretched (its square root is the
# angle that is lost: 1e-10 -> 1e-5 rad of joint, 1e-10 of reach).
STRETCH = 1e-10


@pure
def turn(kx, ky, kz, c, s, x, y, z):
    """(x, y, z) turned about the unit axis k by the angle with cosine c and sine s (Rodrigues)."""
    d = (kx * x + ky * y + kz * z) * (1.0 - c)
    return (
        c * x + s * (ky * z - kz * y) + d * kx,
        c * y + s * (kz * x - kx * z) + d * ky,
        c * z + s * (kx * y - ky * x) + d * kz,
    )


@pure
def angle_between(kx, ky, kz, px, py, pz, qx, qy, qz):
    """Subproblem 1: the angle about k that turns p towards q, and the product of their distances from k.

    Where that product vanishes every angle does.
    """
    kp = kx * px + ky * py + kz * pz
    kq = kx * qx + ky * qy + kz * qz
    a = px * qx + py * qy + pz * qz - kp * kq
    b = kx * (py * qz - pz * qy) + ky * (pz * qx - px * qz) + kz * (px * qy - py * qx)
    return math.atan2(b, a), math.sqrt(a * a + b * b)


@pure
def angles_to_height(hx, hy, hz, kx, ky, kz, px, py, pz, height, slack):
    """Subproblem 4: the angles θ about k with h · R(k, θ) p = height.

    Returns (centre, half, amplitude, possible): θ = centre ± half.  Where the amplitude vanishes θ is free;
    it is possible where the height is met to ``slack`` (same unit as h·p).
    """
    hk = hx * kx + hy * ky + hz * kz
    kp = kx * px + ky * py + kz * pz
    a = hx * px + hy * py + hz * pz - hk * kp
    b = hx * (ky * pz - kz * py) + hy * (kz * px - kx * pz) + hz * (kx * py - ky * px)
    rest = height - hk * kp
    amplitude = math.sqrt(a * a + b * b)
    if amplitude < 1e-12:
        return 0.0, 0.0, amplitude, abs(rest) <= slack
    if abs(rest) > amplitude + slack:
        return 0.0, 0.0, amplitude, False
    # atan2 of sine and cosine: exact near 0, where acos loses half the digits.
    across = math.sqrt(max(0.0, (amplitude - rest) * (amplitude + rest)))
    return math.atan2(b, a), math.atan2(across, rest), amplitude, True


@pure
def image(angle, start, lower, upper):
    """The angle plus whole turns that is nearest to ``start`` inside the limits; and whether there is one."""
    whole = 2.0 * math.pi
    found = angle + whole * math.floor((start - angle) / whole + 0.5)
    if found > upper + 1e-9:
        found -= whole * math.ceil((found - upper - 1e-9) / whole)
    elif found < lower - 1e-9:
        found += whole * math.ceil((lower - 1e-9 - found) / whole)
    inside = lower - 1e-9 <= found <= upper + 1e-9
    return min(max(found, lower), upper), inside


@pure
def split_inside(total, sign, a, b, lower_a, upper_a, lower_b, upper_b):
    """α, β with α + sign·β = total (mod 2π), as near to a and b as can be inside the limits.

    Where no such pair is inside the limits, the nearest of all.
    """
    whole = 2.0 * math.pi
    rest = total - a - sign * b
    rest -= whole * math.floor(rest / whole + 0.5)
    best_a, best_b, closest = a + 0.5 * rest, b + 0.5 * sign * rest, math.inf
    for k in range(-2, 3):
        turned = rest + whole * k
        # β = b + sign·(turned - (α - a)) inside its limits, as limits of α.
        low = a + turned - sign * ((upper_b if sign > 0.0 else lower_b) - b)
        high = a + turned - sign * ((lower_b if sign > 0.0 else upper_b) - b)
        low, high = max(low, lower_a), min(high, upper_a)
        if low > high + 1e-9:
            continue
        alpha = min(max(a + 0.5 * turned, low), high)
        beta = b + sign * (turned - (alpha - a))
        distance = (alpha - a) * (alpha - a) + (beta - b) * (beta - b)
        if distance < closest:
            best_a, best_b, closest = alpha, beta, distance
    return best_a, best_b
