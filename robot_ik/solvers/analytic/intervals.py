"""Intervals of angles: what is left of a closed form when its target is known only to a tolerance.

An interval is its middle and its radius; a radius of pi or more is everything.  All bounds are outer ones:
the true set lies inside, so that an empty one is a proof.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import pure

# Rounding allowed for: of angles (an arc cosine near 1 loses half the digits) and of metres or cosines.
_ANGLE_PAD, PAD = 1e-6, 1e-9


@pure
def may_fit(middle, radius, lower, upper):
    """Whether an angle of the interval, whole turns aside, may lie inside the limits."""
    radius += _ANGLE_PAD
    whole = 2.0 * math.pi
    if radius >= math.pi or upper - lower >= whole:
        return True
    turns = math.ceil((lower - middle - radius) / whole)
    return middle - radius + whole * turns <= upper


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
def chord(angle, radius):
    """How far a turn by at most ``angle`` moves a point at ``radius`` from its axis."""
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
