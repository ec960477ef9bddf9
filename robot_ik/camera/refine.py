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

Array = NDArray[np.float64]

# Corners straight from the detector scatter by 0.8 px (measured on the standard set, all distances).
DETECTOR_SIGMA = 0.85
# What a perfect fit still leaves: print, paper, pixel response.
_LEAST_SIGMA = 0.01
# Pixels per edge are limited by taking at most this many columns (or rows) across it.
_COLUMNS = 64
# Places along an edge at which its bent curve is computed; in between it is straight enough.
_STATIONS = 17
# Half widths of the band of pixels, px: first to find the edge, then to measure it.
_FIND_BAND, _FIT_BAND = 5.0, 4.0
# The band is also kept inside the outer cell: fraction of the cell used.
_CELL_PART = 0.75
_LEAST_BAND = 1.6
# Pixels within this distance of a corner see two edges at once.
_CORNER_GAP = 2.5
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
        sides = _Sides(corners, intrinsics, cells, _FIND_BAND if search else _FIT_BAND)
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
    long = np.linalg.norm(side, axis=2).min(axis=1) > 2 * _CORNER_GAP + 4
    limit = np.array(gray.shape[::-1]) - 1.0
    inside = ((corners >= 0) & (corners <= limit)).all(axis=(1, 2))
    return np.asarray(convex & long & inside)


def _edges_ok(fit: EdgeFit, pixels: EdgePixels, sides: _Sides) -> NDArray[np.bool_]:
    """(m,) markers all of whose four fits can be believed."""
    ok = np.isfinite(fit.offset).all(axis=1) & (np.abs(fit.offset) < sides.band[:, None] + 1.0).all(axis=1)
    ok &= fit.contrast > np.maximum(5.0, 1.5 * fit.noise)
    ok &= fit.blur < 3.9
    ok &= pixels.weight.sum(axis=1) >= 24
    return np.asarray(ok.reshape(-1, 4).all(axis=1))


def _common_blur(fit: EdgeFit, sides: _Sides) -> Array:
    """(4m,) blur of each marker: the sides with a wide band know it, those with a narrow one need it."""
    weight = (sides.band**4).reshape(-1, 4)
    mean = (weight * np.log(fit.blur).reshape(-1, 4)).sum(axis=1) / weight.sum(axis=1)
    return np.repeat(np.exp(mean), 4)


def _find(pixels: EdgePixels, sides: _Sides) -> Array:
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


class _Sides:
    """The 4m sides of m markers as bent curves in the picture, crossed by columns (or rows) of pixels.

    A side that runs more along x than along y is crossed by picture columns, the others by rows; in the
    arrays below ``main`` is the coordinate along and ``cross`` the one across.
    """

    def __init__(self, corners: Array, intrinsics: CameraIntrinsics, cells: int, band: float) -> None:
        m = len(corners)
        ideal = intrinsics.undistort(corners.reshape(-1, 2)).reshape(m, 4, 2)
        t = np.linspace(0.0, 1.0, _STATIONS)
        line = ideal[:, :, None] + t[:, None] * (np.roll(ideal, -1, axis=1) - ideal)[:, :, None]
        curve = intrinsics.distort(line.reshape(-1, 2)).reshape(4 * m, _STATIONS, 2)
        chord = curve[:, -1] - curve[:, 0]
        self.steep = np.abs(chord[:, 1]) > np.abs(chord[:, 0])
        curve = np.where(self.steep[:, None, None], curve[:, :, ::-1], curve)
        centre = np.repeat(corners.mean(axis=1), 4, axis=0)
        length = np.linalg.norm(chord, axis=1)
        self.shortest = length.reshape(m, 4).min(axis=1)
        # Height of the marker over each side: twice the area of the triangle to the centre, over the side.
        reach = curve[:, 0] - np.where(self.steep[:, None], centre[:, ::-1], centre)
        along = curve[:, -1] - curve[:, 0]
        height = 2 * np.abs(reach[:, 0] * along[:, 1] - reach[:, 1] * along[:, 0]) / np.maximum(length, 1e-9)
        self.cell = height / cells
        self.band = np.clip(_CELL_PART * self.cell, _LEAST_BAND, band)
        self._cross_columns(curve, t, np.where(self.steep, centre[:, 0], centre[:, 1]), length)
        self._corner_normals(curve, m)

    def _cross_columns(self, curve: Array, t: Array, centre: Array, length: Array) -> None:
        """Whole columns along each side, and where the curve crosses them."""
        s = len(curve)
        gap = _CORNER_GAP * np.abs(curve[:, -1, 0] - curve[:, 0, 0]) / np.maximum(length, 1e-9)
        first = np.minimum(curve[:, 0, 0], curve[:, -1, 0]) + gap
        last = np.maximum(curve[:, 0, 0], curve[:, -1, 0]) - gap
        low, high = np.ceil(first), np.floor(last)
        columns = np.rint(low[:, None] + np.linspace(0, 1, _COLUMNS) * (high - low)[:, None])
        self.use = np.ones((s, _COLUMNS))
        self.use[:, 1:] = np.diff(columns, axis=1) > 0
        # Columns at the ends, and pixels at the border of the band below, fade in over one pixel: with a hard
        # border the fit can jump between two sets of pixels for ever.
        self.use *= np.clip(np.minimum(columns - first[:, None], last[:, None] - columns), 0.0, 1.0)
        self.columns = columns
        self.along, self.cross, slope = (np.empty((s, _COLUMNS)) for _ in range(3))
        for i in range(s):
            order = slice(None) if curve[i, -1, 0] > curve[i, 0, 0] else slice(None, None, -1)
            main, cross = curve[i, order, 0], curve[i, order, 1]
            self.along[i] = np.interp(columns[i], main, t[order])
            self.cross[i] = np.interp(columns[i], main, cross)
            middle = 0.5 * (main[1:] + main[:-1])
            slope[i] = np.interp(columns[i], middle, np.diff(cross) / np.maximum(np.diff(main), 1e-9))
        # Light lies outside the black square: away from its centre.
        self.sign = np.where(curve[:, :, 1].mean(axis=1) > centre, 1.0, -1.0)
        self.cosine = 1.0 / np.sqrt(1.0 + slope**2)

    def _corner_normals(self, curve: Array, m: int) -> None:
        """Outward unit normals (m, 4, 2, 2) of the two sides that meet in each corner: own, previous."""
        ends = np.stack([curve[:, 1] - curve[:, 0], curve[:, -1] - curve[:, -2]], axis=1)
        normal = np.stack([-ends[..., 1], ends[..., 0]], axis=2)
        normal *= np.sign(normal[..., 1] * self.sign[:, None])[..., None]
        normal /= np.maximum(np.linalg.norm(normal, axis=2), 1e-12)[..., None]
        normal = np.where(self.steep[:, None, None], normal[..., ::-1], normal).reshape(m, 4, 2, 2)
        self.normals = np.stack([normal[:, :, 0], np.roll(normal[:, :, 1], 1, axis=1)], axis=2)

    def pixels(self, gray: Image) -> EdgePixels:
        """The pixels of the band, as they are in the picture."""
        reach = int(((self.band[:, None] + 0.5) / self.cosine).max() + 0.5)
        rows = np.rint(self.cross)[:, :, None] + np.arange(-reach, reach + 1)
        columns = np.broadcast_to(self.columns[:, :, None], rows.shape)
        distance = (rows - self.cross[:, :, None]) * (self.cosine * self.sign[:, None])[:, :, None]
        steep = self.steep[:, None, None]
        x, y = np.where(steep, rows, columns), np.where(steep, columns, rows)
        h, w = gray.shape
        use = np.clip(self.band[:, None, None] + 0.5 - np.abs(distance), 0.0, 1.0) * self.use[:, :, None]
        use = use * ((x >= 0) & (x < w) & (y >= 0) & (y < h))
        x = np.clip(np.nan_to_num(x), 0, w - 1).astype(np.intp)
        y = np.clip(np.nan_to_num(y), 0, h - 1).astype(np.intp)
        flat = (len(rows), -1)
        along = np.broadcast_to(self.along[:, :, None], rows.shape)
        return EdgePixels(
            np.nan_to_num(distance).reshape(flat),
            np.nan_to_num(along).reshape(flat),
            gray[y, x].astype(float).reshape(flat),
            np.nan_to_num(use).reshape(flat),
        )

    def move_corners(self, fit: EdgeFit) -> tuple[Array, Array]:
        """Shift (m, 4, 2) of the corners in px, and the covariance (m, 8, 8) of all eight numbers.

        A corner moves so that it lies on both of its displaced sides: normal . shift = offset, twice.
        """
        m = len(self.normals)
        offset = fit.offset.reshape(m, 4, 2)
        both = np.stack([offset[:, :, 0], np.roll(offset[:, :, 1], 1, axis=1)], axis=2)
        determinant = np.linalg.det(self.normals)
        safe = np.where((np.abs(determinant) > 0.05)[..., None, None], self.normals, np.nan * np.eye(2))
        inverse = np.full_like(self.normals, np.nan)
        fine = np.isfinite(safe).all(axis=(1, 2, 3))
        if fine.any():
            inverse[fine] = np.linalg.inv(safe[fine])
        shift = np.einsum("mkij,mkj->mki", inverse, both)
        # Linear map (8, 8) from the offsets (side k: first end, second end) to the corners.
        to_corner = np.zeros((m, 8, 8))
        for k in range(4):
            to_corner[:, 2 * k : 2 * k + 2, 2 * k] = inverse[:, k, :, 0]
            to_corner[:, 2 * k : 2 * k + 2, (2 * k - 1) % 8] = inverse[:, k, :, 1]
        ends = np.zeros((m, 8, 8))
        # Light of the next cell leaks over the border when that is hardly wider than the blur; the leak at
        # one border width is the tail of a Gaussian.
        leak = fit.blur * np.exp(-0.5 * (self.cell / fit.blur) ** 2)
        per_side = (fit.covariance + np.eye(2) * (leak**2)[:, None, None]).reshape(m, 4, 2, 2)
        for k in range(4):
            ends[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = per_side[:, k]
        return shift, to_corner @ ends @ to_corner.transpose(0, 2, 1)
