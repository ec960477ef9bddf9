"""The turn that brings vectors nearest to where they are wished, from their 3 x 3 correlation.

With M = Σ w d pᵀ over vectors p that are wished along d, a turn by φ about a unit axis u gains
A cos φ + B sin φ, where A = tr M − uᵀ M u and B = u · Σ w p × d (Wang & Chen, IEEE T-RA 7(4), 1991).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined, pure

# ``sums``: M row by row, and how many vectors there are; then how much a hinge heeds the goals themselves
# beside the next points (0 = not at all), and how much a ball does.
# In KEPT, the pose of a joint before it turns.
AIMS, PULL, BALL_PULL, KEPT, SUM_SIZE = 9, 10, 11, 12, 24


@pure
def add_aim(sums, weight, dx, dy, dz, px, py, pz):
    """One more vector p that is wished along d."""
    sums[0] += weight * dx * px
    sums[1] += weight * dx * py
    sums[2] += weight * dx * pz
    sums[3] += weight * dy * px
    sums[4] += weight * dy * py
    sums[5] += weight * dy * pz
    sums[6] += weight * dz * px
    sums[7] += weight * dz * py
    sums[8] += weight * dz * pz
    sums[AIMS] += 1.0


@pure
def turn_terms(sums, x, y, z):
    """A, B of the gain A cos φ + B sin φ of a turn by φ about the unit axis (x, y, z)."""
    across = (
        x * (sums[0] * x + sums[1] * y + sums[2] * z)
        + y * (sums[3] * x + sums[4] * y + sums[5] * z)
        + z * (sums[6] * x + sums[7] * y + sums[8] * z)
    )
    b = x * (sums[7] - sums[5]) + y * (sums[2] - sums[6]) + z * (sums[3] - sums[1])
    return sums[0] + sums[4] + sums[8] - across, b


@pure
def best_angle(a, b, low, high):
    """The φ in [low, high] that maximises A cos φ + B sin φ; 0 where nothing depends on it."""
    if a * a + b * b < 1e-24:
        return 0.0
    angle = math.atan2(b, a)
    for turned in (angle, angle - 2.0 * math.pi, angle + 2.0 * math.pi):
        if low <= turned <= high:
            return turned
    at_low = a * math.cos(low) + b * math.sin(low)
    at_high = a * math.cos(high) + b * math.sin(high)
    return low if at_low > at_high else high


@outlined
def turn_axis(sums):
    """The axis about which a free rotation helps most, not normalised: zero when nothing helps."""
    x, y, z = sums[7] - sums[5], sums[2] - sums[6], sums[3] - sums[1]
    size = abs(sums[0]) + abs(sums[4]) + abs(sums[8])
    trace = sums[0] + sums[4] + sums[8]
    if x * x + y * y + z * z > 1e-24 * size * size or size == 0.0:
        return x, y, z
    # Aligned, or half a turn off: then any axis across will do, the coordinate axis most across first.
    g0, g1, g2 = sums[0] - trace, sums[4] - trace, sums[8] - trace
    gain = max(g0, g1, g2)
    if not gain > 1e-9 * size:
        return 0.0, 0.0, 0.0
    i = 0 if g0 == gain else (1 if g1 == gain else 2)
    x, y, z = -sums[i] / trace, -sums[3 + i] / trace, -sums[6 + i] / trace
    return x + (1.0 if i == 0 else 0.0), y + (1.0 if i == 1 else 0.0), z + (1.0 if i == 2 else 0.0)
