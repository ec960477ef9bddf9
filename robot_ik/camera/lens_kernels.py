"""The lens of ``robot_ik.camera.lens`` as compiled code, point by point."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.jit import outlined

if TYPE_CHECKING:
    from robot_ik.camera.intrinsics import CameraIntrinsics

# Places in the vector that stands for a camera: focal lengths, principal point, model, fold, coefficients.
FX, FY, CX, CY, _EQUIDISTANT, _LIMIT, _K = 0, 1, 2, 3, 4, 5, 6
_LENGTH = 14

# As in ``lens``: residual of the inverse, steps, and what a stall at rounding level may leave.
_INVERSE_RESIDUAL = 1e-12
_INVERSE_STEPS = 40
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
def bend_point(lens, x, y):
    """Bent coordinates of ideal ones, and the derivative d(bx)/dx, d(bx)/dy = d(by)/dx, d(by)/dy."""
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
        tx, ty, xx1, xy1, yy1 = bend_point(lens, x1, y1)
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
