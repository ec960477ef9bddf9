"""Sub-pixel marker corners: straight lines fitted to the marker's edges in undistorted coordinates.

A printed edge is straight in the world, bent in the picture and straight again after the lens has been
undone.  So each side of the black square is one line in undistorted coordinates; its place is fitted to the
pixels along the bent curve that this line makes in the picture; the corners are where neighbouring lines
meet.  Unlike corner operators, which look at the rounded corner itself, this has no inward bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.detect import Image, to_gray
from robot_ik.camera.edges import BLUR_START, EdgeFit, EdgePixels, fit_edges
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sides import CORNER_GAP, Sides

Array = NDArray[np.float64]

# Corners straight from the detector scatter by 0.8 px (measured on the standard set, all distances).
DETECTOR_SIGMA = 0.85
# What a perfect fit still leaves: print, paper, pixel response.
_LEAST_SIGMA = 0.01
# Half widths of the band of pixels, px: first to find the edge, then to measure it.
_FIND_BAND, _FIT_BAND = 5.0, 4.0
# One pass to find, one to measure; more only while some corner still moves by _STILL px.
_LEAST_PASSES, _MOST_PASSES = 2, 6
_STILL = 0.03
# A fit that after all passes still moves by this much has not found an edge.
_RESTLESS = 0.3
# ln(blur) differs between the sides of a marker by about this (motion blur), and from BLUR_START by that.
_BLUR_ALIKE, _BLUR_UNKNOWN = 0.3, 0.6


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Corners of one marker.

    Attributes:
        corners: (4, 2) distorted pixels.
        ideal: (4, 2) undistorted normalised coordinates.
        covariance: (8, 8) of the corners in px^2, order x0 y0 x1 y1 ….  Neighbours are correlated, for
            they share an edge.
        sigma: Root mean square of the standard deviations of the eight numbers, px.
        refined: False: the fit failed and these are the detector's corners with their large sigma.
    """

    corners: Array
    ideal: Array
    covariance: Array
    sigma: float
    refined: bool


def unrefined(
    corners: ArrayLike, intrinsics: CameraIntrinsics, sigma: float = DETECTOR_SIGMA
) -> RefinedCorners:
    """Corners (4, 2) in distorted pixels taken as they are, with the standard deviation ``sigma`` in px."""
    pixels = np.array(corners, dtype=float).reshape(4, 2)
    return RefinedCorners(pixels, intrinsics.undistort(pixels), np.eye(8) * sigma**2, sigma, False)


def refine_corners(
    gray: Image, corners: ArrayLike, intrinsics: CameraIntrinsics, *, cells: int = 8
) -> tuple[Array, float]:
    """Refines the corners of one marker.

    Args:
        gray: (h, w) or (h, w, 3) uint8, raw picture.
        corners: (4, 2) rough corners in distorted pixels, right to about 2 px.
        intrinsics: Of this picture's size.
        cells: Cells along a side with the black border, so that the next cell is not taken for the edge.

    Returns:
        Corners (4, 2) in distorted pixels and their standard deviation in px.  When the edges cannot be
        fitted, the rough corners and ``DETECTOR_SIGMA``.
    """
    result = refine_markers(gray, [corners], intrinsics, cells=cells)[0]
    return result.corners, result.sigma


def refine_markers(
    image: Image, markers: Sequence[ArrayLike], intrinsics: CameraIntrinsics, *, cells: int = 8
) -> list[RefinedCorners]:
    """Refines the corners of several markers at once; arguments as in ``refine_corners``."""
    if not len(markers):
        return []
    gray = to_gray(image)
    rough = np.array([np.asarray(m, dtype=float).reshape(4, 2) for m in markers])
    corners = rough.copy()
    good = _sides_ok(corners, gray)
    blur = np.full(4 * len(rough), BLUR_START)
    covariance = np.zeros((len(rough), 8, 8))
    moved = np.full(len(rough), np.inf)
    for step in range(_MOST_PASSES):
        search = step == 0
        sides = Sides(corners, intrinsics, cells, _FIND_BAND if search else _FIT_BAND)
        pixels = sides.pixels(gray)
        start = _find(pixels, sides) if search else np.zeros((len(blur), 2))
        spread = _BLUR_UNKNOWN if search else _BLUR_ALIKE
        fit = fit_edges(pixels, start, blur, spread, steps=5 if search else 3)
        blur = _common_blur(fit, sides)
        good &= _edges_ok(fit, pixels, sides)
        shift, covariance = sides.move_corners(fit)
        moved = np.abs(np.nan_to_num(shift, nan=np.inf)).max(axis=(1, 2))
        good &= np.isfinite(moved)
        # Half steps settle the rare fit that jumps to and fro (sharpened pictures).
        corners[good] += shift[good] * (1.0 if step < _LEAST_PASSES else 0.5)
        good &= np.abs(corners - rough).max(axis=(1, 2)) < np.maximum(3.0, 0.1 * sides.shortest)
        good &= _sides_ok(corners, gray)
        corners[~good] = rough[~good]
        if step + 1 >= _LEAST_PASSES and (moved[good] < _STILL).all():
            break
    good &= moved < _RESTLESS
    # Where it has not come to rest, the range it still covers is part of the uncertainty.
    covariance += np.eye(8) * np.where(moved < _STILL, 0.0, np.minimum(moved, 1.0) ** 2)[:, None, None]
    return [
        _result(corners[i] if good[i] else rough[i], covariance[i], bool(good[i]), intrinsics)
        for i in range(len(rough))
    ]


def _result(corners: Array, covariance: Array, good: bool, intrinsics: CameraIntrinsics) -> RefinedCorners:
    if not good:
        return unrefined(corners, intrinsics)
    total = covariance + np.eye(8) * _LEAST_SIGMA**2
    sigma = float(np.sqrt(np.trace(total) / 8))
    return RefinedCorners(corners.copy(), intrinsics.undistort(corners), total, sigma, True)


def _sides_ok(corners: Array, gray: Image) -> NDArray[np.bool_]:
    """(m,) convex quadrilaterals with sides that leave room for a fit, inside the picture."""
    side = np.roll(corners, -1, axis=1) - corners
    following = np.roll(side, -1, axis=1)
    turn = side[..., 0] * following[..., 1] - side[..., 1] * following[..., 0]
    convex = (turn > 0).all(axis=1) | (turn < 0).all(axis=1)
    long = np.linalg.norm(side, axis=2).min(axis=1) > 2 * CORNER_GAP + 4
    limit = np.array(gray.shape[::-1]) - 1.0
    inside = ((corners >= 0) & (corners <= limit)).all(axis=(1, 2))
    return np.asarray(convex & long & inside)


def _edges_ok(fit: EdgeFit, pixels: EdgePixels, sides: Sides) -> NDArray[np.bool_]:
    """(m,) markers all of whose four fits can be believed."""
    ok = np.isfinite(fit.offset).all(axis=1) & (np.abs(fit.offset) < sides.band[:, None] + 1.0).all(axis=1)
    ok &= fit.contrast > np.maximum(5.0, 1.5 * fit.noise)
    ok &= fit.blur < 3.9
    ok &= pixels.weight.sum(axis=1) >= 24
    return np.asarray(ok.reshape(-1, 4).all(axis=1))


def _common_blur(fit: EdgeFit, sides: Sides) -> Array:
    """(4m,) blur of each marker: the sides with a wide band know it, those with a narrow one need it."""
    weight = (sides.band**4).reshape(-1, 4)
    mean = (weight * np.log(fit.blur).reshape(-1, 4)).sum(axis=1) / weight.sum(axis=1)
    return np.repeat(np.exp(mean), 4)


def _find(pixels: EdgePixels, sides: Sides) -> Array:
    """(4m, 2) rough offsets: in each column the steepest rise, then a robust line through them."""
    shape = (*sides.columns.shape, -1)
    value, distance = pixels.value.reshape(shape), pixels.distance.reshape(shape)
    used = pixels.weight.reshape(shape) > 0
    rise = np.diff(value, axis=2) / np.where(np.diff(distance, axis=2) == 0, 1.0, np.diff(distance, axis=2))
    rise = np.where(used[..., 1:] & used[..., :-1], np.maximum(rise, 0.0), 0.0) ** 2
    place = 0.5 * (distance[..., 1:] + distance[..., :-1])
    total = rise.sum(axis=2)
    edge = (rise * place).sum(axis=2) / np.maximum(total, 1e-9)
    t = sides.along
    basis = np.stack([1 - t, t], axis=2)
    weight = np.sqrt(total) * sides.use
    line = np.zeros((len(t), 2))
    for _ in range(4):
        normal = np.einsum("sn,snp,snq->spq", weight, basis, basis) + 1e-9 * np.eye(2)
        line = np.linalg.solve(normal, np.einsum("sn,snp,sn->sp", weight, basis, edge)[..., None])[..., 0]
        miss = edge - np.einsum("snp,sp->sn", basis, line)
        weight = np.sqrt(total) * sides.use / (1.0 + miss**2)
    return np.asarray(line)
