"""The rotation that brings vectors closest to their targets.

Vectors p with targets along d and weights w have the correlation M = Σ w d pᵀ, a tuple of three
rows. A rotation by φ about the unit axis u changes Σ w d · p to

    uᵀ M u + A cos φ + B sin φ        A = tr M − uᵀ M u        B = u · Σ w p × d

so the best angle is atan2(B, A). Wang & Chen, A combined optimization method for solving the
inverse kinematics problem of mechanical manipulators, IEEE Trans. Robotics and Automation 7(4),
1991.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.jit import inlined, outlined

# The correlation of an empty set of vectors.
NO_VECTORS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

# A² + B² below this: no angle is better than another.
_NO_GAIN = 1e-24
# |Σ w p × d| below this share of the correlation: the vectors are aligned, or a half turn away.
_ALIGNED = 1e-12
# Share of the correlation that a half turn must gain.
_MIN_GAIN = 1e-9


@inlined
def add_vector(correlation, weight, target, vector):
    """Return the correlation with one more vector."""
    x, y, z = so3.scale(weight, target)
    return (
        so3.add(correlation[0], so3.scale(x, vector)),
        so3.add(correlation[1], so3.scale(y, vector)),
        so3.add(correlation[2], so3.scale(z, vector)),
    )


@outlined
def add_axes(correlation, weight, target_rotation, rotation):
    """Return the correlation with the three axes of a frame, and those of its target as targets.

    ‖R_target − R‖² / 2 = 3 − Σ of the products of their columns, so the rotation that is best for
    the axes is best for the frame.
    """
    first_target, second_target, third_target = so3.transpose(target_rotation)
    first, second, third = so3.transpose(rotation)
    correlation = add_vector(correlation, weight, first_target, first)
    correlation = add_vector(correlation, weight, second_target, second)
    return add_vector(correlation, weight, third_target, third)


@inlined
def trace(correlation):
    """Return tr M."""
    return correlation[0][0] + correlation[1][1] + correlation[2][2]


@inlined
def moment(correlation):
    """Return Σ w p × d."""
    return (
        correlation[2][1] - correlation[1][2],
        correlation[0][2] - correlation[2][0],
        correlation[1][0] - correlation[0][1],
    )


@inlined
def rotation_terms(correlation, axis):
    """Return A and B for a rotation about the unit vector ``axis``."""
    along = so3.dot(axis, so3.apply(correlation, axis))
    return trace(correlation) - along, so3.dot(axis, moment(correlation))


@outlined
def best_angle(a, b, lower, upper):
    """Return the φ in [lower, upper] that maximises A cos φ + B sin φ; 0 if no angle is better."""
    if a * a + b * b < _NO_GAIN:
        return 0.0
    angle = math.atan2(b, a)
    for candidate in (angle, angle - 2.0 * math.pi, angle + 2.0 * math.pi):
        if lower <= candidate <= upper:
            return candidate
    at_lower = a * math.cos(lower) + b * math.sin(lower)
    at_upper = a * math.cos(upper) + b * math.sin(upper)
    return lower if at_lower > at_upper else upper


@outlined
def best_axis(correlation):
    """Return an axis about which a rotation helps most, of any length; zero if none helps."""
    total = trace(correlation)
    diagonal = correlation[0][0], correlation[1][1], correlation[2][2]
    size = abs(diagonal[0]) + abs(diagonal[1]) + abs(diagonal[2])
    axis = moment(correlation)
    if so3.dot(axis, axis) > _ALIGNED * _ALIGNED * size * size or size == 0.0:
        return axis
    # The vectors are aligned, or a half turn away. Then an axis perpendicular to them is best: the
    # coordinate axis with the largest perpendicular part, without its part along them.
    gains = diagonal[0] - total, diagonal[1] - total, diagonal[2] - total
    gain = max(gains[0], max(gains[1], gains[2]))
    if not gain > _MIN_GAIN * size:
        return 0.0, 0.0, 0.0
    columns = so3.transpose(correlation)
    if gains[0] == gain:
        return so3.subtract((1.0, 0.0, 0.0), so3.scale(1.0 / total, columns[0]))
    if gains[1] == gain:
        return so3.subtract((0.0, 1.0, 0.0), so3.scale(1.0 / total, columns[1]))
    return so3.subtract((0.0, 0.0, 1.0), so3.scale(1.0 / total, columns[2]))
