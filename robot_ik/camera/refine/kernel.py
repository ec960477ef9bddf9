"""The whole refinement of marker corners as one compiled entry point."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

import numpy as np

from robot_ik.camera.lens_kernels import from_pixel
from robot_ik.camera.refine.edges import (
    BLUR_START,
    DISTANCE,
    PARAMETERS,
    PIXEL_ROWS,
    VALUE,
    WEIGHT,
    WORK_ROWS,
    fit_edge,
)
from robot_ik.camera.refine.sides import (
    ALONG,
    BAND,
    CELL,
    COLUMN_ROWS,
    COLUMNS,
    CORNER_GAP,
    LENGTH,
    MAIN,
    NORMALS,
    SIDE_NUMBERS,
    STATIONS,
    USE,
    bent_side,
    cross_columns,
    take_pixels,
)
from robot_ik.kernels.jit import kernel, outlined

# What a perfect fit still leaves: print, paper, pixel response.
_LEAST_SIGMA = 0.01
# Half widths of the band of pixels, px: first to find the edge, then to measure it.
_FIND_BAND, _FIT_BAND = 5.0, 4.0
# To find an edge fewer columns will do.
_FIND_COLUMNS = 24
# Pixels of a side at most: 45 degrees makes a column of the wider band sqrt(2) longer.
_ROOM = COLUMNS * (2 * math.ceil((_FIND_BAND + 0.5) * 1.5) + 1)
# One pass to find, one to measure; more only while some corner still moves by _STILL px.
_LEAST_PASSES, _MOST_PASSES = 2, 6
_STILL = 0.05
# A fit that after all passes still moves by this much has not found an edge.
_RESTLESS = 0.3
# Gauss-Newton steps at most: when searching, when measuring.
_FIND_STEPS, _FIT_STEPS = 5, 3
# A step so small (px, ln px) is the last one; the noise leaves more.
_FOUND, _FITTED = 0.02, 1e-3
# ln(blur) differs between the sides of a marker by about this (motion blur), and from BLUR_START by that.
_BLUR_ALIKE, _BLUR_UNKNOWN = 0.3, 0.6
# Of an edge that can be believed: contrast and blur in grey levels and px, sum of the pixels' weights.
_LEAST_CONTRAST, _LARGEST_BLUR, _LEAST_WEIGHT = 5.0, 3.9, 24.0
# Two sides that meet at less than three degrees do not tell where.
_LEAST_SINE = 0.05

# What a fit leaves for each side: variances of its two offsets and their covariance, noise, the offsets,
# blur, and how its corner and the next one follow it (x, y each).
_VAR_FIRST, _VAR_LAST, _COVARIANCE, _NOISE, _FIRST, _LAST, _BLUR, _OWN, _NEXT = 0, 1, 2, 3, 4, 5, 6, 7, 9
_FIT_NUMBERS = 11


@kernel
def refine_corners_of(gray, lens, cells, corners, ideal, covariance, good):
    """Refines the corners of m markers in place.

    Args:
        gray: (h, w) uint8, C-contiguous.
        lens: ``lens_vector``.
        cells: Cells along a side with the black border.
        corners: (m, 4, 2) rough corners in, refined ones out (rough ones again where that failed).
        ideal: (m, 4, 2) out: undistorted normalised coordinates.
        covariance: (m, 8, 8) out, px^2.
        good: (m,) int64 out: 1 where the edges were measured.
    """
    pixels, columns = np.empty((PIXEL_ROWS, _ROOM)), np.empty(COLUMNS + 1, np.int64)
    table, curve = np.empty((COLUMN_ROWS, COLUMNS)), np.empty((STATIONS, 3))
    sides, fits = np.empty((4, SIDE_NUMBERS)), np.empty((4, _FIT_NUMBERS))
    work, x = np.empty((WORK_ROWS, PARAMETERS)), np.empty(PARAMETERS)
    rough, shift = np.empty((4, 2)), np.empty((4, 2))
    for m in range(len(corners)):
        one = corners[m]
        for k in range(8):  # number by number: assigning whole arrays costs three seconds of compiling
            rough[k // 2, k % 2] = one[k // 2, k % 2]
        fine, blur, moved = sides_ok(one, gray), BLUR_START, math.inf
        for step in range(_MOST_PASSES):
            find = step == 0
            band = _FIND_BAND if find else _FIT_BAND
            for k in range(4):
                fine = fine and bent_side(lens, one, k, cells, band, curve, sides[k])
                if not fine:
                    break
                n = cross_columns(curve, sides[k], _FIND_COLUMNS if find else COLUMNS, table)
                take_pixels(gray, sides[k], table, n, pixels, columns)
                fine = fit_side(pixels, columns, table, n, x, blur, find, work, sides[k], fits[k])
            if not fine:
                break
            blur = common_blur(fits, sides)
            moved = corner_shifts(fits, sides, shift, covariance[m])
            fine = move_corners(one, rough, shift, sides, step) and sides_ok(one, gray)
            if not fine or (step + 1 >= _LEAST_PASSES and moved < _STILL):
                break
        fine = fine and moved < _RESTLESS
        for k in range(8):
            # Where it has not come to rest, the range it still covers is part of the uncertainty.
            covariance[m, k, k] += (0.0 if moved < _STILL else min(moved, 1.0) ** 2) + _LEAST_SIGMA**2
        good[m] = 1 if fine else 0
        for k in range(4):
            if not fine:
                one[k, 0], one[k, 1] = rough[k, 0], rough[k, 1]
            ideal[m, k, 0], ideal[m, k, 1] = from_pixel(lens, one[k, 0], one[k, 1])


@outlined
def sides_ok(corners, gray):
    """Whether it is a convex quadrilateral in the picture with sides that leave room for a fit."""
    height, width = gray.shape
    left, right = True, True
    for k in range(4):
        i, j = (k + 1) % 4, (k + 2) % 4
        ux, uy = corners[i, 0] - corners[k, 0], corners[i, 1] - corners[k, 1]
        vx, vy = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1]
        turn = ux * vy - uy * vx
        left, right = left and turn > 0.0, right and turn < 0.0
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
    shortest = min(sides[0, LENGTH], sides[1, LENGTH], sides[2, LENGTH], sides[3, LENGTH])
    fine = True
    for k in range(4):
        for i in range(2):
            corners[k, i] += part * shift[k, i]
            fine = fine and abs(corners[k, i] - rough[k, i]) < max(3.0, 0.1 * shortest)
    return fine


@outlined
def fit_side(pixels, columns, table, n, x, blur, find, work, side, fit):
    """Fits one side, ``fit`` out; False when the result cannot be believed."""
    x[0] = x[1] = 0.0
    if find:
        find_edge(pixels, columns, table, n, x)
    spread = _BLUR_UNKNOWN if find else _BLUR_ALIKE
    steps = _FIND_STEPS if find else _FIT_STEPS
    arrived = _FOUND if find else _FITTED
    if not fit_edge(pixels, columns, table[ALONG], n, x, blur, spread, steps, arrived, work, fit):
        return False
    fit[_FIRST], fit[_LAST], fit[_BLUR] = x[0], x[1], math.exp(x[2])
    weight = 0.0
    for p in range(columns[n]):
        weight += pixels[WEIGHT, p]
    return (
        max(abs(x[0]), abs(x[1])) < side[BAND] + 1.0
        and 0.5 * (x[5] + x[6]) > max(_LEAST_CONTRAST, 1.5 * fit[_NOISE])
        and fit[_BLUR] < _LARGEST_BLUR
        and weight >= _LEAST_WEIGHT
    )


@outlined
def common_blur(fits, sides):
    """Blur of a marker: the sides with a wide band know it, those with a narrow one need it."""
    total, weight = 0.0, 0.0
    for k in range(4):
        w = sides[k, BAND] ** 4
        total += w * math.log(fits[k, _BLUR])
        weight += w
    return math.exp(total / weight)


@outlined
def find_edge(pixels, columns, table, n, x):
    """Rough offsets into ``x[:2]``: in each column the steepest rise, then a robust line through them.

    The rises and their places are kept in the table's rows USE and MAIN, which nobody needs any more.
    """
    for i in range(n):
        total, place = 0.0, 0.0
        for p in range(columns[i], columns[i + 1] - 1):
            step = pixels[DISTANCE, p + 1] - pixels[DISTANCE, p]
            rise = max((pixels[VALUE, p + 1] - pixels[VALUE, p]) / step, 0.0) ** 2
            total += rise
            place += rise * 0.5 * (pixels[DISTANCE, p + 1] + pixels[DISTANCE, p])
        table[MAIN, i] = place / max(total, 1e-9)
        table[USE, i] *= math.sqrt(total)
    a, b = 0.0, 0.0
    for turn in range(4):
        uu = tt = 1e-9
        ut = ur = tr = 0.0
        for i in range(n):
            t, edge = table[ALONG, i], table[MAIN, i]
            u = 1.0 - t
            miss = edge - a * u - b * t
            w = table[USE, i] / (1.0 + miss * miss) if turn > 0 else table[USE, i]
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
            shift[k, i] = fits[k, _OWN + i] * fits[k, _FIRST] + fits[j, _NEXT + i] * fits[j, _LAST]
            moved = max(moved, abs(shift[k, i]))
    for k in range(4):
        n, fit = 2 * ((k + 1) % 4), fits[k]
        # Light of the next cell leaks over the border when that is hardly wider than the blur: the tail of a
        # Gaussian at one border width, px.
        leak = fit[_BLUR] * math.exp(-0.5 * (sides[k, CELL] / fit[_BLUR]) ** 2)
        for i in range(2):
            for j in range(2):
                own, following = fit[_OWN + i], fit[_NEXT + i]
                covariance[2 * k + i, 2 * k + j] += (fit[_VAR_FIRST] + leak * leak) * own * fit[_OWN + j]
                covariance[n + i, n + j] += (fit[_VAR_LAST] + leak * leak) * following * fit[_NEXT + j]
                # Both corners lie on this side.
                covariance[2 * k + i, n + j] += fit[_COVARIANCE] * own * fit[_NEXT + j]
                covariance[n + i, 2 * k + j] += fit[_COVARIANCE] * following * fit[_OWN + j]
    return moved
