"""Marker corners by their sides: what the fit of the whole print starts from, and falls back to.

``refine_markers`` is what others call; all of it is compiled.  ``edge_fit`` fits one straight edge.  An edge
is where grey is half way between black and white: to hundredths of a pixel for a camera whose grey values are
proportional to light, and up to half a pixel in the black for others; see ``photometric_corners``.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.edge_fit import (
    ALONG,
    BAND,
    BLUR_START,
    CELL,
    COLUMN_ROWS,
    COLUMNS,
    CONTRAST,
    CORNER_GAP,
    COVARIANCE,
    DISTANCE,
    EDGE_NUMBERS,
    FIRST,
    LAST,
    LENGTH,
    LOG_BLUR,
    MAIN,
    NOISE,
    NORMALS,
    PARAMETERS,
    PIXEL_ROWS,
    SIDE_NUMBERS,
    STATIONS,
    USE,
    VALUE,
    VAR_FIRST,
    VAR_LAST,
    WEIGHT,
    WORK_ROWS,
    cross_columns,
    distorted_side,
    fit_edge,
    take_pixels,
)
from robot_ik.camera.image import from_reduced, reduced, to_gray, to_reduced
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, from_pixel, lens_vector
from robot_ik.kernels.jit import announce, kernel, outlined
from robot_ik.ports import Array, Image

# ------------------------------------------------------------------------------------------
# The whole refinement of marker corners as one compiled entry point.


# What a perfect fit still leaves: print, paper, pixel response.
_LEAST_SIGMA = 0.01
# Half widths of the band of pixels, px: first to find the edge, then to measure it.
_FIND_BAND, _FIT_BAND = 5.0, 4.0
# To find an edge fewer columns will do.
_FIND_COLUMNS = 24
# Pixels of a side at most: 45 degrees makes a column of the wider band sqrt(2) longer.
_CAPACITY = COLUMNS * (2 * math.ceil((_FIND_BAND + 0.5) * 1.5) + 1)
# One pass to find, one to measure; more only while some corner still moves by _STILL px.
_LEAST_PASSES, _MOST_PASSES = 2, 6
_CONVERGED_STEP = 0.05
# A fit that after all passes still moves by this much has not found an edge.
_LARGEST_LAST_STEP = 0.3
# Of an edge that can be believed: contrast in grey levels, ln of the blur in px, sum of the pixels' weights.
_LEAST_CONTRAST, _LARGEST_LOG_BLUR, _LEAST_WEIGHT = 5.0, math.log(3.9), 24.0
# Two sides that meet at less than three degrees do not tell where.
_LEAST_SINE = 0.05

# Beside its edge is written of each side how its corner and the next one follow it (x, y each).
_OWN, _NEXT = EDGE_NUMBERS, EDGE_NUMBERS + 2
_FIT_NUMBERS = EDGE_NUMBERS + 4


@kernel
def refine_corners_of(gray, lens, cells, corners, normalized, covariance, good, blurs):
    """Refines the corners of m markers in place.

    Args:
        gray: (h, w) uint8, C-contiguous.
        lens: ``lens_vector``.
        cells: Cells along a side with the black border.
        corners: (m, 4, 2) rough corners in, refined ones out (rough ones again where that failed).
        normalized: (m, 4, 2) out: undistorted normalised coordinates.
        covariance: (m, 8, 8) out, px^2.
        good: (m,) int64 out: 1 where the edges were measured.
        blurs: (m,) out: sigma of the blur of the edges, px.
    """
    pixels, columns = np.empty((PIXEL_ROWS, _CAPACITY)), np.empty(COLUMNS + 1, np.int64)
    table, curve = np.empty((COLUMN_ROWS, COLUMNS)), np.empty((STATIONS, 3))
    sides, fits = np.empty((4, SIDE_NUMBERS)), np.empty((4, _FIT_NUMBERS))
    work, rough, shift = np.empty((WORK_ROWS, PARAMETERS)), np.empty((4, 2)), np.empty((4, 2))
    for m in range(len(corners)):
        one = corners[m]
        for k in range(8):  # number by number: assigning whole arrays costs three seconds of compiling
            rough[k // 2, k % 2] = one[k // 2, k % 2]
        undistort(lens, one, normalized[m])
        fine, blur, moved = sides_ok(one, gray), BLUR_START, math.inf
        for step in range(_MOST_PASSES):
            find = step == 0
            band = _FIND_BAND if find else _FIT_BAND
            for k in range(4):
                fine = fine and distorted_side(lens, one, normalized[m], k, cells, band, curve, sides[k])
                if not fine:
                    break
                n = cross_columns(curve, sides[k], _FIND_COLUMNS if find else COLUMNS, table)
                take_pixels(gray, sides[k], table, n, pixels, columns)
                rough_offsets(pixels, columns, table, n if find else 0, fits[k])
                fine = fit_edge(pixels, columns, n, fits[k], blur, find, work) and believable(
                    pixels, columns[n], sides[k], fits[k]
                )
            if not fine:
                break
            blur = common_blur(fits, sides)
            moved = corner_shifts(fits, sides, shift, covariance[m])
            fine = move_corners(one, rough, shift, sides, step) and sides_ok(one, gray)
            undistort(lens, one, normalized[m])
            if not fine or (step + 1 >= _LEAST_PASSES and moved < _CONVERGED_STEP):
                break
        fine = fine and moved < _LARGEST_LAST_STEP
        for k in range(8):
            # Where it has not come to rest, the range it still covers is part of the uncertainty.
            covariance[m, k, k] += (
                0.0 if moved < _CONVERGED_STEP else min(moved, 1.0) ** 2
            ) + _LEAST_SIGMA**2
        good[m], blurs[m] = 1 if fine else 0, blur
        if not fine:
            for k in range(4):
                one[k, 0], one[k, 1] = rough[k, 0], rough[k, 1]
            undistort(lens, one, normalized[m])


@outlined
def undistort(lens, corners, normalized):
    """Undistorted normalised coordinates (4, 2) of four corners."""
    for k in range(4):
        normalized[k, 0], normalized[k, 1] = from_pixel(lens, corners[k, 0], corners[k, 1])


@outlined
def sides_ok(corners, gray):
    """Whether it is a convex quadrilateral in the picture with sides that leave space for a fit."""
    height, width = gray.shape
    left, right = True, True
    for k in range(4):
        i, j = (k + 1) % 4, (k + 2) % 4
        ux, uy = corners[i, 0] - corners[k, 0], corners[i, 1] - corners[k, 1]
        vx, vy = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1]
        cross = ux * vy - uy * vx
        left, right = left and cross > 0.0, right and cross < 0.0
        long = ux * ux + uy * uy > (2.0 * CORNER_GAP + 4.0) ** 2
        inside = 0.0 <= corners[k, 0] <= width - 1.0 and 0.0 <= corners[k, 1] <= height - 1.0
        if not (long and inside):
            return False
    return left or right


@outlined
def move_corners(corners, rough, shift, sides, step):
    """Moves the corners; False when that takes them far from where the detector saw them."""
    # Half steps settle the rare fit that jumps to and fro (sharpened pictures).
    part = 1.0 if step < _LEAST_PASSES else 0.5
    shortest = min(min(sides[0, LENGTH], sides[1, LENGTH]), min(sides[2, LENGTH], sides[3, LENGTH]))
    fine = True
    for k in range(4):
        for i in range(2):
            corners[k, i] += part * shift[k, i]
            fine = fine and abs(corners[k, i] - rough[k, i]) < max(3.0, 0.1 * shortest)
    return fine


@outlined
def believable(pixels, count, side, fit):
    """Whether a fit has seen an edge, and where it was looked for."""
    weight = 0.0
    for p in range(count):
        weight += pixels[WEIGHT, p]
    return (
        max(abs(fit[FIRST]), abs(fit[LAST])) < side[BAND] + 1.0
        and 0.5 * (fit[CONTRAST] + fit[CONTRAST + 1]) > max(_LEAST_CONTRAST, 1.5 * fit[NOISE])
        and fit[LOG_BLUR] < _LARGEST_LOG_BLUR
        and weight >= _LEAST_WEIGHT
    )


@outlined
def common_blur(fits, sides):
    """Blur of a marker: the sides with a wide band know it, those with a narrow one need it."""
    total, weight = 0.0, 0.0
    for k in range(4):
        w = sides[k, BAND] ** 4
        total += w * fits[k, LOG_BLUR]
        weight += w
    return math.exp(total / weight)


@outlined
def rough_offsets(pixels, columns, table, n, x):
    """Rough offsets into ``x[:2]``: in each column the steepest rise, then a robust line through them.

    Without columns, zero: where the corners are is known well enough.

    The rises and their positions are kept in the table's rows USE and MAIN, which nobody needs any more.
    """
    for i in range(n):
        total, position = 0.0, 0.0
        for p in range(columns[i], columns[i + 1] - 1):
            step = pixels[DISTANCE, p + 1] - pixels[DISTANCE, p]
            rise = max((pixels[VALUE, p + 1] - pixels[VALUE, p]) / step, 0.0) ** 2
            total += rise
            position += rise * 0.5 * (pixels[DISTANCE, p + 1] + pixels[DISTANCE, p])
        table[MAIN, i] = position / max(total, 1e-9)
        table[USE, i] *= math.sqrt(total)
    a, b = 0.0, 0.0
    for iteration in range(4):
        uu = tt = 1e-9
        ut = ur = tr = 0.0
        for i in range(n):
            t, edge = table[ALONG, i], table[MAIN, i]
            u = 1.0 - t
            miss = edge - a * u - b * t
            w = table[USE, i] / (1.0 + miss * miss) if iteration > 0 else table[USE, i]
            uu, ut, tt = uu + w * u * u, ut + w * u * t, tt + w * t * t
            ur, tr = ur + w * u * edge, tr + w * t * edge
        determinant = uu * tt - ut * ut
        a, b = (tt * ur - ut * tr) / determinant, (uu * tr - ut * ur) / determinant
    x[0], x[1] = a, b


@outlined
def corner_shifts(fits, sides, shift, covariance):
    """Shift (4, 2) of the corners in px, and the covariance (8, 8) of all eight numbers; the largest shift.

    A corner moves so that it lies on both of its displaced sides: normal . shift = offset, twice.
    Infinity when two sides hardly meet.
    """
    moved = 0.0
    for i in range(8):
        for j in range(8):
            covariance[i, j] = 0.0
    for k in range(4):
        j = (k + 3) % 4
        ax, ay = sides[k, NORMALS], sides[k, NORMALS + 1]
        bx, by = sides[j, NORMALS + 2], sides[j, NORMALS + 3]
        determinant = ax * by - ay * bx
        if not abs(determinant) > _LEAST_SINE:
            return math.inf
        # How the corner follows its own side and the one before: columns of the inverse.
        fits[k, _OWN], fits[k, _OWN + 1] = by / determinant, -bx / determinant
        fits[j, _NEXT], fits[j, _NEXT + 1] = -ay / determinant, ax / determinant
        for i in range(2):
            shift[k, i] = fits[k, _OWN + i] * fits[k, FIRST] + fits[j, _NEXT + i] * fits[j, LAST]
            moved = max(moved, abs(shift[k, i]))
    for k in range(4):
        n, fit = 2 * ((k + 1) % 4), fits[k]
        # Light of the next cell leaks over the border when that is hardly wider than the blur: the tail of a
        # Gaussian at one border width, px.
        blur = math.exp(fit[LOG_BLUR])
        leak = blur * math.exp(-0.5 * (sides[k, CELL] / blur) ** 2)
        for i in range(2):
            for j in range(2):
                own, following = fit[_OWN + i], fit[_NEXT + i]
                covariance[2 * k + i, 2 * k + j] += (fit[VAR_FIRST] + leak * leak) * own * fit[_OWN + j]
                covariance[n + i, n + j] += (fit[VAR_LAST] + leak * leak) * following * fit[_NEXT + j]
                # Both corners lie on this side.
                covariance[2 * k + i, n + j] += fit[COVARIANCE] * own * fit[_NEXT + j]
                covariance[n + i, 2 * k + j] += fit[COVARIANCE] * following * fit[_OWN + j]
    return moved


# ------------------------------------------------------------------------------------------
# Sub-pixel marker corners: straight lines fitted to the marker's edges in undistorted coordinates.
#
# A printed edge is straight in the world, bent in the picture and straight again after the lens has been
# undone.  So each side of the black square is one line in undistorted coordinates; its place is fitted to the
# pixels along the bent curve that this line makes in the picture; the corners are where neighbouring lines
# meet.  Unlike corner operators, which look at the rounded corner itself, this has no inward bias.


# What cannot be fitted may be too soft: it is tried in a smaller picture, while cells keep this width, px.
# With smaller cells it may be too sharp for its pixels: it is tried in a larger one.
_LEAST_CELL = 5.0
# Corners straight from the detector scatter by 0.8 px (measured on the standard set, all distances).
DETECTOR_SIGMA = 0.85


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Corners of one marker.

    Attributes:
        corners: (4, 2) distorted pixels.
        normalized: (4, 2) undistorted normalised coordinates.
        covariance: (8, 8) of the corners in px^2, order x0 y0 x1 y1 ….  Neighbours are correlated, for
            they share an edge.
        sigma: Root mean square of the standard deviations of the eight numbers, px.
        refined: False: the fit failed and these are the detector's corners with their large sigma.
        blur: Sigma of the blur of the edges, px; NaN where they were not measured.
        edge_shift: How far edges seem to lie in the black, in sigmas of the blur (``photometric_corners``).
        edge_shift_sigma: Its standard deviation.
        explained: Part of the variance of the grey values that the marker's print explains; NaN: not asked.
        misread: Cells that the picture shows otherwise than the print, beyond what its dictionary allows.
        by_print: Whether the corners are those of the whole print, not of the four sides alone.
        model: Numbers of the fit of the print, for that of the next picture to start from.
    """

    corners: Array
    normalized: Array
    covariance: Array
    sigma: float
    refined: bool
    blur: float = float("nan")
    edge_shift: float = 0.0
    edge_shift_sigma: float = float("inf")
    explained: float = float("nan")
    misread: int = 0
    by_print: bool = False
    model: tuple[float, ...] | None = None


def unrefined(
    corners: ArrayLike, intrinsics: CameraIntrinsics, sigma: float = DETECTOR_SIGMA
) -> RefinedCorners:
    """Corners (4, 2) in distorted pixels taken as they are, with the standard deviation ``sigma`` in px."""
    pixels = np.array(corners, dtype=float).reshape(4, 2)
    return RefinedCorners(pixels, intrinsics.undistort(pixels), np.eye(8) * sigma**2, sigma, False)


def refine_markers(
    image: Image,
    markers: Sequence[ArrayLike],
    intrinsics: CameraIntrinsics,
    *,
    cells: int = 8,
    origin: tuple[int, int] = (0, 0),
) -> list[RefinedCorners]:
    """Refines the corners of several markers at once; where edges cannot be fitted they are ``unrefined``.

    Args:
        image: (h, w) or (h, w, 3) uint8, raw; or a part of the picture that holds the markers.
        markers: Rough corners (4, 2) of each, in distorted pixels of the whole picture, right to about 2 px.
        intrinsics: Of the whole picture.
        cells: Cells along a side with the black border, so that the next cell is not taken for the edge.
        origin: Pixel (x, y) of the whole picture at which the part begins.
    """
    if not len(markers):
        return []
    announce(refine_corners_of, "the refinement of marker corners")
    gray = to_gray(image)
    corners = np.array(markers, dtype=float).reshape(-1, 4, 2)
    normalized, covariance = np.empty_like(corners), np.empty((len(corners), 8, 8))
    good, blurs = np.zeros(len(corners), np.int64), np.empty(len(corners))
    lens = lens_vector(intrinsics)
    if origin != (0, 0):
        lens = lens.copy()
        lens[CX] -= origin[0]
        lens[CY] -= origin[1]
        corners -= origin
    refine_corners_of(gray, lens, cells, corners, normalized, covariance, good, blurs)
    for k in np.flatnonzero(good == 0):
        other = _refine_in_another_size(gray, lens, cells, corners[k])
        if other is not None:
            corners[k], normalized[k], covariance[k], blurs[k], good[k] = *other, 1
    corners += origin
    return [
        RefinedCorners(c, i, v, math.sqrt(v.trace() / 8), True, float(b))
        if fine
        else unrefined(c, intrinsics)
        for c, i, v, b, fine in zip(corners, normalized, covariance, blurs, good, strict=True)
    ]


def _refine_in_another_size(
    gray: Image, lens: Array, cells: int, corners: Array
) -> tuple[Array, Array, Array, float] | None:
    """Corners, normalized ones, covariance and blur from a larger picture, or one reduced until it is sharp.

    Arguments are as for the kernel; ``corners`` (4, 2) are rough ones.
    """
    x, y = corners.T
    side = math.sqrt(abs(0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))))
    sizes = [2.0**k for k in range(1, 8) if side / 2.0**k > _LEAST_CELL * cells]
    for times in sizes or [0.5]:
        # A part with the white round the marker is enough; it begins at a pixel of the smaller picture.
        grid = max(round(times), 1)
        low = np.maximum(np.floor((corners.min(axis=0) - 0.5 * side) / grid), 0.0).astype(int) * grid
        high = np.maximum(np.ceil(corners.max(axis=0) + 0.5 * side), -1.0).astype(int)
        if (np.minimum(high + 1, gray.shape[::-1]) - low < grid).any():
            return None  # none of it is in the picture
        part = gray[low[1] : high[1] + 1, low[0] : high[0] + 1]
        small = lens.copy()
        small[[FX, FY]] /= times
        small[[CX, CY]] = to_reduced(lens[[CX, CY]] - low, times)
        found = to_reduced(corners - low, times)[None]
        normalized, covariance = np.empty_like(found), np.empty((1, 8, 8))
        good, blurs = np.zeros(1, np.int64), np.empty(1)
        resized = np.ascontiguousarray(reduced(part, times))
        refine_corners_of(resized, small, cells, found, normalized, covariance, good, blurs)
        if good[0]:
            # Pixels between pixels know nothing new: the covariance stays that of as many as there are.
            known = max(times, 1.0)
            there = from_reduced(found[0], times) + low
            return there, normalized[0], covariance[0] * known**2, times * float(blurs[0])
    return None
