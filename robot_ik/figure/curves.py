"""Curves over time: splines, quintics, smoothing and decaying offsets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robot_ik.motion.keyframes import monotone_slope
from robot_ik.ports import Array


def smooth(values: Array, sigma: float) -> Array:
    """Return values filtered by a Gaussian along the first axis.

    Args:
        values: (n, …) samples.
        sigma: Standard deviation of the Gaussian, samples.

    Returns:
        (n, …) filtered samples. The first and the last value continue beyond the ends.
    """
    radius = int(4 * sigma + 0.5)
    if radius == 0:
        return values
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    weights /= weights.sum()
    padding = [(radius, radius)] + [(0, 0)] * (values.ndim - 1)
    padded = np.pad(values, padding, mode="edge")
    columns = padded.reshape(len(padded), -1).T
    filtered = np.stack([np.convolve(column, weights, mode="valid") for column in columns], axis=1)
    return filtered.reshape(values.shape)


def monotone_curve(knots: Array, values: Array, t: Array) -> Array:
    """Return a cubic curve through knots. It overshoots no knot and is flat at both ends.

    Args:
        knots: (k,) increasing times.
        values: (k,) values at the knots.
        t: (n,) times.
    """
    spans = np.diff(knots)
    slopes = np.zeros(len(knots))
    secants = np.diff(values) / spans
    slopes[1:-1] = monotone_slope(secants[:-1], secants[1:], spans[:-1], spans[1:])
    return _hermite(knots, values, slopes, t)


def clamped_curve(knots: Array, values: Array, t: Array, end_slope: float = 0.0) -> Array:
    """Return a cubic spline through knots with two continuous derivatives.

    Args:
        knots: (k,) increasing times.
        values: (k,) values at the knots.
        t: (n,) times.
        end_slope: Slope at the last knot. The slope at the first knot is zero.
    """
    spans = np.diff(knots)
    count = len(knots)
    matrix = np.eye(count)
    right = np.zeros(count)
    right[-1] = end_slope
    for i in range(1, count - 1):
        before = spans[i - 1]
        after = spans[i]
        matrix[i, i - 1 : i + 2] = 1 / before, 2 / before + 2 / after, 1 / after
        rise_before = (values[i] - values[i - 1]) / before**2
        rise_after = (values[i + 1] - values[i]) / after**2
        right[i] = 3 * (rise_before + rise_after)
    slopes = np.asarray(np.linalg.solve(matrix, right), dtype=float)
    return _hermite(knots, values, slopes, t)


def quintic(
    x0: Array, v0: Array, a0: Array, x1: Array, v1: Array, a1: Array, duration: float
) -> Array:
    """Return the quintic that meets position, speed and acceleration at both ends.

    Args:
        x0: (...) position at time 0.
        v0: (...) speed at time 0.
        a0: (...) acceleration at time 0.
        x1: (...) position at the end.
        v1: (...) speed at the end.
        a1: (...) acceleration at the end.
        duration: Time of the end, s.

    Returns:
        (6, ...) coefficients, the highest power first.
    """
    T = duration
    matrix = np.array(
        [
            [T**5, T**4, T**3],
            [5 * T**4, 4 * T**3, 3 * T**2],
            [20 * T**3, 12 * T**2, 6 * T],
        ]
    )
    right = np.stack([x1 - x0 - v0 * T - a0 * T * T / 2, v1 - v0 - a0 * T, a1 - a0])
    return np.concatenate([np.linalg.solve(matrix, right), np.stack([a0 / 2, v0, x0])])


def decay(
    x0: Array, v0: Array, duration: float, a0: Array | float = 0.0
) -> Callable[[Array], Array]:
    """Return an offset that comes to rest at zero, as a function of time.

    This is the quintic of inertialisation (Bollo, *Inertialization*, GDC 2018).

    Args:
        x0: (k,) offset at time 0.
        v0: (k,) its speed at time 0.
        duration: Time at which the offset is zero, s.
        a0: (k,) its acceleration at time 0.

    Returns:
        A function of times (n,) that returns offsets (n, k).
    """
    rest = np.zeros_like(x0)
    coefficients = quintic(x0, v0, rest + a0, rest, rest, rest, duration)
    return lambda t: np.where(t[:, None] >= duration, 0.0, np.polyval(coefficients, t[:, None]))


def _hermite(knots: Array, values: Array, slopes: Array, t: Array) -> Array:
    """Return the cubic Hermite curve through knots with given slopes, at times (n,)."""
    t = np.clip(t, knots[0], knots[-1])
    k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    h = knots[k + 1] - knots[k]
    s = (t - knots[k]) / h
    start = (1 + 2 * s) * (1 - s) ** 2 * values[k] + s * (1 - s) ** 2 * h * slopes[k]
    return np.asarray(
        start + s * s * (3 - 2 * s) * values[k + 1] + s * s * (s - 1) * h * slopes[k + 1]
    )
