"""Lens distortion models, compiled: forward, Jacobian and inverse.

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

from robot_ik.kernels.jit import kernel, outlined
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.camera.intrinsics import CameraIntrinsics


COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}

# Places in the vector that stands for a camera: focal lengths, principal point, model, fold, coefficients.
FX, FY, CX, CY, _EQUIDISTANT, LIMIT, _K = 0, 1, 2, 3, 4, 5, 6
_LENGTH = 14
# Residual of the inverse in distorted coordinates: 1e-12 of a focal length is 1e-9 px; and what a stall at
# rounding level may leave.
_INVERSE_RESIDUAL, _STALLED = 1e-12, 1e-9
# Newton doubles the digits each step; a damped step now and then costs a few more.
_INVERSE_STEPS = 40
# Beyond this (84 degrees off the axis) a pinhole picture says nothing; radii that are tried below it.
_LARGEST_RADIUS, _RADII = 10.0, 2000


@lru_cache(maxsize=16)
def lens_vector(intrinsics: CameraIntrinsics) -> Array:
    """(14,) all that compiled code needs to know of a camera; kept, so not to be changed."""
    lens = np.zeros(_LENGTH)
    lens[:_EQUIDISTANT] = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    lens[_EQUIDISTANT] = intrinsics.model == "equidistant"
    lens[_K : _K + len(intrinsics.distortion)] = intrinsics.distortion
    lens[LIMIT] = _fold(lens)
    return lens


# mypy: disallow-untyped-defs = false, check-untyped-defs = false


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
    if not size < _STALLED or x * x + y * y > lens[LIMIT] * lens[LIMIT]:
        return math.nan, math.nan
    return x, y


@kernel
def _fold(lens):
    """Largest normalized radius, of those tried, up to which a larger angle means a larger distorted radius.

    Beyond it the polynomial folds back, and points far outside the view would seem to be inside.
    """
    for k in range(_RADII + 1):
        r = k * _LARGEST_RADIUS / _RADII
        factor, slope = radial(lens, r * r)
        if not factor + 2.0 * r * r * slope > 0.0:
            return (k - 1) * _LARGEST_RADIUS / _RADII if k > 0 else _LARGEST_RADIUS
    return _LARGEST_RADIUS


@kernel
def distort_points(lens, normalized, pixels):
    """Normalized coordinates (n, 2) -> distorted pixels (n, 2)."""
    for k in range(len(normalized)):
        x, y, _, _, _ = distort_point(lens, normalized[k, 0], normalized[k, 1])
        pixels[k, 0], pixels[k, 1] = lens[FX] * x + lens[CX], lens[FY] * y + lens[CY]


@kernel
def undistort_points(lens, pixels, normalized):
    """The way back; see ``from_pixel``."""
    for k in range(len(pixels)):
        normalized[k, 0], normalized[k, 1] = from_pixel(lens, pixels[k, 0], pixels[k, 1])


@kernel
def pixel_jacobians(lens, normalized, jacobian):
    """Derivative (n, 2, 2) of pixels by normalized coordinates (n, 2)."""
    for k in range(len(normalized)):
        _, _, xx, xy, yy = distort_point(lens, normalized[k, 0], normalized[k, 1])
        jacobian[k, 0, 0], jacobian[k, 0, 1] = lens[FX] * xx, lens[FX] * xy
        jacobian[k, 1, 0], jacobian[k, 1, 1] = lens[FY] * xy, lens[FY] * yy
