"""Lens distortion models as pure numpy: forward, Jacobian and inverse, vectorised over points.

Coordinates are normalised: (x, y) = (X / Z, Y / Z) of a point in the camera frame (x right, y down,
z forward).  ``normalized`` means without distortion, ``distorted`` with it; pixels are
``(fx x + cx, fy y + cy)`` of distorted coordinates.  Coefficients are in OpenCV's order:

* ``plumb_bob`` (0, 4 or 5): k1 k2 p1 p2 k3, Brown 1966
* ``rational_polynomial`` (8): k1 k2 p1 p2 k3 k4 k5 k6, the second three in the denominator
* ``equidistant`` (4): k1 k2 k3 k4 over the angle to the optical axis, Kannala and Brandt 2006
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.jit import outlined

if TYPE_CHECKING:
    from robot_ik.camera.intrinsics import CameraIntrinsics


Array = NDArray[np.float64]

COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}

# Residual of the inverse in bent coordinates: 1e-12 of a focal length is 1e-9 px.
_INVERSE_RESIDUAL = 1e-12
# Newton doubles the digits each step; a damped step now and then costs a few more.
_INVERSE_STEPS = 40
# Beyond this (84 degrees off the axis) a pinhole picture says nothing.
_LARGEST_RADIUS = 10.0


def _radial(model: str, k: Array, r2: Array) -> tuple[Array, Array]:
    """Radial factor and its derivative with respect to r^2."""
    if model == "equidistant":
        r = np.sqrt(np.maximum(r2, 1e-18))
        theta = np.arctan(r)
        t2 = theta * theta
        distorted = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
        factor = distorted / r
        # d(bent / r) / d(r^2) = (bent' - bent / r) / (2 r^2); its limit at r = 0 is k1 - 1/3.
        derivative = (slope / (1 + r2) - factor) / (2 * np.maximum(r2, 1e-18))
        return factor, np.where(r2 < 1e-8, k[0] - 1.0 / 3.0, derivative)
    top = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    top_slope = k[0] + r2 * (2 * k[1] + r2 * 3 * k[4])
    if model == "plumb_bob":
        return top, top_slope
    low = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    low_slope = k[5] + r2 * (2 * k[6] + r2 * 3 * k[7])
    return top / low, (top_slope * low - top * low_slope) / (low * low)


def _padded(model: str, coefficients: Array) -> Array:
    size = 4 if model == "equidistant" else 8
    k = np.zeros(size)
    k[: len(coefficients)] = coefficients
    return k


def distort(model: str, coefficients: Array, normalized: Array) -> Array:
    """Normalized (n, 2) -> distorted (n, 2) coordinates."""
    k = _padded(model, coefficients)
    x, y = normalized[:, 0], normalized[:, 1]
    r2 = x * x + y * y
    factor, _ = _radial(model, k, r2)
    if model == "equidistant":
        return normalized * factor[:, None]
    p1, p2 = k[2], k[3]
    return np.stack(
        [
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def distort_jacobian(model: str, coefficients: Array, normalized: Array) -> Array:
    """Derivative of ``distort``: (n, 2, 2), rows distorted, columns normalized."""
    k = _padded(model, coefficients)
    x, y = normalized[:, 0], normalized[:, 1]
    factor, slope = _radial(model, k, x * x + y * y)
    jacobian = np.empty((len(normalized), 2, 2))
    jacobian[:, 0, 0] = factor + 2 * slope * x * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = 2 * slope * x * y
    jacobian[:, 1, 1] = factor + 2 * slope * y * y
    if model != "equidistant":
        p1, p2 = k[2], k[3]
        jacobian[:, 0, 0] += 2 * p1 * y + 6 * p2 * x
        jacobian[:, 0, 1] += 2 * p1 * x + 2 * p2 * y
        jacobian[:, 1, 0] += 2 * p1 * x + 2 * p2 * y
        jacobian[:, 1, 1] += 6 * p1 * y + 2 * p2 * x
    return jacobian


def undistort(model: str, coefficients: Array, distorted: Array, limit: float) -> Array:
    """Inverse of ``distort`` by Newton's method with step halving.

    Args:
        model: One of ``COEFFICIENTS``.
        coefficients: In OpenCV's order.
        distorted: (n, 2).
        limit: ``radius_limit`` of the model.

    Returns:
        (n, 2) normalized coordinates, exact to about 1e-12; NaN where the lens model has no inverse
        (beyond the radius at which its polynomial folds back).
    """
    normalized = distorted.copy()
    if not np.any(coefficients) and model != "equidistant":
        return normalized
    error = distort(model, coefficients, normalized) - distorted
    size = np.hypot(error[:, 0], error[:, 1])
    active = np.flatnonzero(~(size < _INVERSE_RESIDUAL))
    scale = np.ones(len(distorted))
    for _ in range(_INVERSE_STEPS):
        if active.size == 0:
            break
        step = _solve2(distort_jacobian(model, coefficients, normalized[active]), error[active])
        trial = normalized[active] - scale[active, None] * step
        trial_error = distort(model, coefficients, trial) - distorted[active]
        trial_size = np.hypot(trial_error[:, 0], trial_error[:, 1])
        better = trial_size < size[active]
        chosen = active[better]
        normalized[chosen], error[chosen], size[chosen] = (
            trial[better],
            trial_error[better],
            trial_size[better],
        )
        scale[chosen] = np.minimum(1.0, 2.0 * scale[chosen])
        scale[active[~better]] *= 0.5
        active = active[~(size[active] < _INVERSE_RESIDUAL)]
    # A stall at rounding level is an answer; anything larger, or a folded sheet, is none.
    lost = ~(size < 1e3 * _INVERSE_RESIDUAL)
    lost |= np.hypot(normalized[:, 0], normalized[:, 1]) > limit
    normalized[lost] = np.nan
    return normalized


def _solve2(matrix: Array, right: Array) -> Array:
    """Solves n systems of two equations; a singular one gives a step that the halving rejects."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    determinant = a * d - b * c
    determinant = np.where(np.abs(determinant) < 1e-12, 1e-12, determinant)
    x = (d * right[:, 0] - b * right[:, 1]) / determinant
    y = (a * right[:, 1] - c * right[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def radius_limit(model: str, coefficients: Array) -> float:
    """Largest normalized radius up to which a larger angle means a larger distorted radius.

    Beyond it the polynomial folds back, and points far outside the view would seem to be inside.
    """
    k = _padded(model, coefficients)
    r = np.linspace(0.0, _LARGEST_RADIUS, 2001)
    factor, slope = _radial(model, k, r * r)
    folding = np.flatnonzero(~(factor + 2 * r * r * slope > 0))
    return float(r[folding[0] - 1]) if folding.size and folding[0] > 0 else _LARGEST_RADIUS


# ------------------------------------------------------------------------------------------
# The lens of ``robot_ik.camera.lens`` as compiled code, point by point.


# mypy: disallow-untyped-defs = false, check-untyped-defs = false


# Places in the vector that stands for a camera: focal lengths, principal point, model, fold, coefficients.
FX, FY, CX, CY, _EQUIDISTANT, _LIMIT, _K = 0, 1, 2, 3, 4, 5, 6
_LENGTH = 14

# As in ``lens``: residual of the inverse, steps, and what a stall at rounding level may leave.
_STALLED = 1e-9


@lru_cache(maxsize=16)
def lens_vector(intrinsics: CameraIntrinsics) -> NDArray[np.float64]:
    """(14,) all that compiled code needs to know of a camera; kept, so not to be changed."""
    lens = np.zeros(_LENGTH)
    lens[:_EQUIDISTANT] = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    lens[_EQUIDISTANT] = intrinsics.model == "equidistant"
    lens[_LIMIT] = intrinsics.radius_limit
    lens[_K : _K + len(intrinsics.distortion)] = intrinsics.distortion
    return lens


@outlined
def radial(lens, r2):
    """Radial factor and its derivative with respect to r^2."""
    k = lens[_K:]
    if lens[_EQUIDISTANT] > 0.0:
        r = math.sqrt(max(r2, 1e-18))
        angle = math.atan(r)
        t2 = angle * angle
        factor = angle * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
        if r2 < 1e-8:
            return factor, k[0] - 1.0 / 3.0
        slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        return factor, (slope / (1.0 + r2) - factor) / (2.0 * r2)
    top = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    top_slope = k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4])
    low = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    low_slope = k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7])
    return top / low, (top_slope * low - top * low_slope) / (low * low)


@outlined
def distort_point(lens, x, y):
    """Distorted coordinates of normalized ones; their derivative d(bx)/dx, d(bx)/dy = d(by)/dx, d(by)/dy."""
    factor, slope = radial(lens, x * x + y * y)
    bx, by = x * factor, y * factor
    xx, xy, yy = factor + 2.0 * slope * x * x, 2.0 * slope * x * y, factor + 2.0 * slope * y * y
    if lens[_EQUIDISTANT] == 0.0:
        p1, p2 = lens[_K + 2], lens[_K + 3]
        bx += 2.0 * p1 * x * y + p2 * (3.0 * x * x + y * y)
        by += p1 * (x * x + 3.0 * y * y) + 2.0 * p2 * x * y
        xx += 2.0 * p1 * y + 6.0 * p2 * x
        xy += 2.0 * p1 * x + 2.0 * p2 * y
        yy += 6.0 * p1 * y + 2.0 * p2 * x
    return bx, by, xx, xy, yy


@outlined
def from_pixel(lens, px, py):
    """Undistorted normalised coordinates of a distorted pixel: Newton's method with step halving.

    NaN where the lens has no inverse.
    """
    bx, by = (px - lens[CX]) / lens[FX], (py - lens[CY]) / lens[FY]
    x, y, ex, ey, xx, xy, yy = bx, by, 0.0, 0.0, 1.0, 0.0, 1.0
    size, scale = math.inf, 0.0
    for _ in range(_INVERSE_STEPS):
        determinant = xx * yy - xy * xy
        if abs(determinant) < 1e-12:
            determinant = 1e-12
        x1 = x - scale * (yy * ex - xy * ey) / determinant
        y1 = y - scale * (xx * ey - xy * ex) / determinant
        tx, ty, xx1, xy1, yy1 = distort_point(lens, x1, y1)
        size1 = math.hypot(tx - bx, ty - by)
        if size1 < size:
            x, y, ex, ey, size, xx, xy, yy = x1, y1, tx - bx, ty - by, size1, xx1, xy1, yy1
            scale = min(1.0, 2.0 * scale) if scale > 0.0 else 1.0
        else:
            scale *= 0.5
        if size < _INVERSE_RESIDUAL:
            break
    if not size < _STALLED or x * x + y * y > lens[_LIMIT] * lens[_LIMIT]:
        return math.nan, math.nan
    return x, y
