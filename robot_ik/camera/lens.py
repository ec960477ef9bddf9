"""Lens distortion models, compiled: forward, Jacobian and inverse.

Coordinates are normalised: (x, y) = (X / Z, Y / Z) of a point in the camera frame (x right, y down,
z forward). ``normalized`` means without distortion, ``distorted`` with it. Pixels are
``(fx x + cx, fy y + cy)`` of distorted coordinates. Coefficients are in OpenCV's order:

* ``plumb_bob`` (0, 4 or 5): k1 k2 p1 p2 k3, Brown 1966
* ``rational_polynomial`` (8): k1 k2 p1 p2 k3 k4 k5 k6, the second three in the denominator
* ``equidistant`` (4): k1 k2 k3 k4 over the angle to the optical axis, Kannala and Brandt 2006
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.kernels.jit import kernel, outlined
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.camera.intrinsics import CameraIntrinsics

#: Allowed numbers of coefficients of each model.
COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}

# Indices in the vector of a camera.
FX = 0  # Focal lengths, px.
FY = 1
CX = 2  # Principal point, px.
CY = 3
_EQUIDISTANT = 4  # 1 for the equidistant model.
LIMIT = 5  # Largest normalised radius at which the model is one to one.
_K = 6  # Coefficients.
_LENGTH = 14

# Residual of the inverse in distorted coordinates: 1e-12 of a focal length is 1e-9 px.
_INVERSE_RESIDUAL = 1e-12
# Residual that is accepted if rounding stops the iteration earlier.
_STALLED_RESIDUAL = 1e-9
# Newton's method doubles the digits in each step. A damped step sometimes costs a few more.
_INVERSE_STEPS = 40
# Smallest absolute determinant that is inverted.
_MIN_DETERMINANT = 1e-12
# Largest normalised radius: 84 degrees from the axis.
_MAX_RADIUS = 10.0
# Number of radii that are tested for a fold.
_RADII = 2000


@lru_cache(maxsize=16)
def lens_vector(intrinsics: CameraIntrinsics) -> Array:
    """Return the vector (14,) of a camera for compiled code. It is cached: do not change it."""
    lens = np.zeros(_LENGTH)
    lens[:_EQUIDISTANT] = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    lens[_EQUIDISTANT] = intrinsics.model == "equidistant"
    lens[_K : _K + len(intrinsics.distortion)] = intrinsics.distortion
    lens[LIMIT] = _fold(lens)
    return lens


@outlined
def radial(lens, r2):
    """Return the radial factor at the squared radius ``r2``, and its derivative by ``r2``."""
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
    bottom = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    bottom_slope = k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7])
    return top / bottom, (top_slope * bottom - top * bottom_slope) / (bottom * bottom)


@outlined
def distort_point(lens, x, y):
    """Return the distorted coordinates of normalised ones and their derivatives.

    Returns:
        bx, by; d(bx)/dx, d(bx)/dy = d(by)/dx, d(by)/dy.
    """
    factor, slope = radial(lens, x * x + y * y)
    bx = x * factor
    by = y * factor
    xx = factor + 2.0 * slope * x * x
    xy = 2.0 * slope * x * y
    yy = factor + 2.0 * slope * y * y
    if lens[_EQUIDISTANT] == 0.0:
        p1 = lens[_K + 2]
        p2 = lens[_K + 3]
        bx += 2.0 * p1 * x * y + p2 * (3.0 * x * x + y * y)
        by += p1 * (x * x + 3.0 * y * y) + 2.0 * p2 * x * y
        xx += 2.0 * p1 * y + 6.0 * p2 * x
        xy += 2.0 * p1 * x + 2.0 * p2 * y
        yy += 6.0 * p1 * y + 2.0 * p2 * x
    return bx, by, xx, xy, yy


@outlined
def from_pixel(lens, px, py):
    """Return the undistorted normalised coordinates of a distorted pixel.

    Newton's method with step halving. NaN where the lens has no inverse.
    """
    bx = (px - lens[CX]) / lens[FX]
    by = (py - lens[CY]) / lens[FY]
    x = bx
    y = by
    error_x = 0.0
    error_y = 0.0
    xx = 1.0
    xy = 0.0
    yy = 1.0
    size = math.inf
    scale = 0.0
    for _ in range(_INVERSE_STEPS):
        determinant = xx * yy - xy * xy
        if abs(determinant) < _MIN_DETERMINANT:
            determinant = _MIN_DETERMINANT
        trial_x = x - scale * (yy * error_x - xy * error_y) / determinant
        trial_y = y - scale * (xx * error_y - xy * error_x) / determinant
        distorted_x, distorted_y, trial_xx, trial_xy, trial_yy = distort_point(
            lens, trial_x, trial_y
        )
        trial_size = math.hypot(distorted_x - bx, distorted_y - by)
        if trial_size < size:
            x = trial_x
            y = trial_y
            error_x = distorted_x - bx
            error_y = distorted_y - by
            xx = trial_xx
            xy = trial_xy
            yy = trial_yy
            size = trial_size
            scale = min(1.0, 2.0 * scale) if scale > 0.0 else 1.0
        else:
            scale *= 0.5
        if size < _INVERSE_RESIDUAL:
            break
    if not size < _STALLED_RESIDUAL or x * x + y * y > lens[LIMIT] * lens[LIMIT]:
        return math.nan, math.nan
    return x, y


@kernel
def _fold(lens):
    """Return the largest normalised radius up to which the distorted radius grows.

    Beyond it the polynomial folds back, and points far outside the view would seem to be inside.
    """
    for k in range(_RADII + 1):
        r = k * _MAX_RADIUS / _RADII
        factor, slope = radial(lens, r * r)
        if not factor + 2.0 * r * r * slope > 0.0:
            return (k - 1) * _MAX_RADIUS / _RADII if k > 0 else _MAX_RADIUS
    return _MAX_RADIUS


@kernel
def distort_points(lens, normalized, pixels):
    """Write the distorted pixels (n, 2) of normalised coordinates (n, 2) to ``pixels``."""
    for k in range(len(normalized)):
        x, y, _, _, _ = distort_point(lens, normalized[k, 0], normalized[k, 1])
        pixels[k, 0] = lens[FX] * x + lens[CX]
        pixels[k, 1] = lens[FY] * y + lens[CY]


@kernel
def undistort_points(lens, pixels, normalized):
    """Write the normalised coordinates (n, 2) of distorted pixels (n, 2) to ``normalized``.

    See ``from_pixel``.
    """
    for k in range(len(pixels)):
        x, y = from_pixel(lens, pixels[k, 0], pixels[k, 1])
        normalized[k, 0] = x
        normalized[k, 1] = y


@kernel
def pixel_jacobians(lens, normalized, jacobian):
    """Write the derivative (n, 2, 2) of pixels by normalised coordinates (n, 2) to ``jacobian``."""
    for k in range(len(normalized)):
        _, _, xx, xy, yy = distort_point(lens, normalized[k, 0], normalized[k, 1])
        jacobian[k, 0, 0] = lens[FX] * xx
        jacobian[k, 0, 1] = lens[FX] * xy
        jacobian[k, 1, 0] = lens[FY] * xy
        jacobian[k, 1, 1] = lens[FY] * yy
