"""Least-squares fit of a straight edge to pixels, compiled.

Model of the grey value near one edge, for a pixel at signed distance d (px, positive on the light side) from
the current line and at the fraction t of the way along it:

    I(d, t) = middle(t) + contrast(t) * erf((d - offset(t)) / (sqrt(2) blur))

with ``middle``, ``contrast`` and ``offset`` linear in t: uneven light is part of the model.  Pixels are used
as they are, never resampled, so their noise is independent and the covariance consistent.

All pixels of one column (or row) across the edge share t, so the normal equations are sums over a column of
products of three numbers, spread over the seven parameters once a column instead of once a pixel.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

import numpy as np
from numba import types

from robot_ik.camera.lens import CX, CY, FX, FY, distort_point
from robot_ik.kernels.jit import outlined
from robot_ik.kernels.linalg import eliminate

# What is known of an edge.  Fitted: offset at both ends, ln blur, middle at both ends, contrast at both ends;
# then the variances of the two offsets and their covariance (px^2), and the noise (grey levels).
FIRST, LAST, LOG_BLUR, CONTRAST = 0, 1, 2, 5
PARAMETERS = 7
VAR_FIRST, VAR_LAST, COVARIANCE, NOISE = 7, 8, 9, 10
EDGE_NUMBERS = 11
# Blur in px.  The pixel's own width alone gives 0.29, but a model sharper than a third has a minimum between
# any two pixels (sharpened pictures show it); beyond 4 px no cell of a marker could be read.
BLUR_START = 0.8
_LOG_SHARPEST, _LOG_SOFTEST = math.log(0.33), math.log(4.0)
# ln(blur) differs between the sides of a marker by about this (motion blur), and from BLUR_START by that.
_BLUR_SIGMA, _START_BLUR_SIGMA = 0.3, 0.6
# Gauss-Newton steps at most, to find an edge and to measure it; a step of offsets (px) and ln blur that is
# smaller than this is the last one.
_FIND_STEPS, _FIT_STEPS = 5, 3
_FIND_TOLERANCE, _FIT_TOLERANCE = 0.02, 2e-3
# Residuals beyond this many standard deviations lose weight (Cauchy's function): dirt, glare, occlusion.
_CAUCHY = 2.4
# Keeps weights meaningful in pictures without noise: quantisation to whole grey levels.
_LEAST_NOISE = 0.3
_DENSITY_FACTOR = -2.0 / math.sqrt(math.pi)

# Rows of the table of pixels; SHARE is the fraction of the way along the edge.
DISTANCE, VALUE, WEIGHT, SHARE, RESIDUAL, RISE, DENSITY, SCALED, SPARE = 0, 1, 2, 3, 4, 5, 6, 7, 8
PIXEL_ROWS = 9
# Rows of the work space: system and right side, a copy of the system, sums over a column, its factors.
SYSTEM, RIGHT, KEPT, GRAM, FACTOR = 0, 7, 8, 15, 19
WORK_ROWS = 20
# Which of (density, density z, 1, erf) each parameter's derivative has.
_BASIS = (0, 0, 1, 2, 2, 3, 3)
# The error function to 3e-7 without an exponential: Abramowitz and Stegun 7.1.28.
_A1, _A2, _A3, _A4, _A5, _A6 = 0.0705230784, 0.0422820123, 0.0092705272, 1.520143e-4, 2.765672e-4, 4.30638e-5
_DENSITY_SCALE = 8.0 * math.sqrt(math.pi)


@outlined
def linearise(pixels, count, x):
    """Fills SCALED (z), RISE (erf z), DENSITY (its slope, to 1e-5) and RESIDUAL of every pixel at ``x``.

    Loop by loop, so that the compiler can do four pixels at a time.
    """
    root = math.exp(-x[2]) / math.sqrt(2.0)
    offset, offset_slope = x[0], x[1] - x[0]
    middle, middle_slope, contrast, contrast_slope = x[3], x[4] - x[3], x[5], x[6] - x[5]
    for p in range(count):
        pixels[SCALED, p] = (pixels[DISTANCE, p] - offset - offset_slope * pixels[SHARE, p]) * root
    for p in range(count):
        z = abs(pixels[SCALED, p])
        series = 1.0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * (_A5 + z * _A6)))))
        slope = _A1 + z * (2.0 * _A2 + z * (3.0 * _A3 + z * (4.0 * _A4 + z * (5.0 * _A5 + z * 6.0 * _A6))))
        inverse = 1.0 / series
        power = inverse * inverse
        power *= power
        power *= power
        power *= power
        pixels[RISE, p] = math.copysign(1.0 - power, pixels[SCALED, p])
        pixels[DENSITY, p] = _DENSITY_SCALE * slope * power * inverse
    for p in range(count):
        t = pixels[SHARE, p]
        model = middle + middle_slope * t + (contrast + contrast_slope * t) * pixels[RISE, p]
        pixels[RESIDUAL, p] = pixels[VALUE, p] - model


@outlined
def median_of(values, count):
    """Median of the first ``count`` values, which lose their order: Hoare's selection (1961)."""
    low, high, k = 0, count - 1, count // 2
    while low < high:  # the part that holds it is parted again
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        low, high = low if k <= j else (i if k >= i else k), j if k <= j else (high if k >= i else k)
    return values[k]


@outlined
def spread(pixels, count):
    """Robust standard deviation: median of the residuals' sizes, corrected for the parameters used up."""
    if count == 0:
        return _LEAST_NOISE
    values = pixels[SPARE]
    for p in range(count):
        values[p] = abs(pixels[RESIDUAL, p])
    freedom = max(count - PARAMETERS, 1) / count
    return max(1.4826 * median_of(values, count) / math.sqrt(freedom), _LEAST_NOISE)


@outlined
def normal_equations(pixels, columns, used, x, noise, work):
    """SYSTEM: lower triangle of JᵀWJ, and RIGHT: JᵀWr, with Cauchy's weights (``noise`` 0: without)."""
    gram, factor = work[GRAM : GRAM + 4], work[FACTOR]
    for i in range(SYSTEM, RIGHT + 1):
        for j in range(PARAMETERS):
            work[i, j] = 0.0
    root = math.exp(-x[2]) / math.sqrt(2.0)
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    for p in range(columns[used]):
        pixels[SPARE, p] = pixels[WEIGHT, p] / (1.0 + cauchy * pixels[RESIDUAL, p] * pixels[RESIDUAL, p])
    for i in range(used):
        if columns[i] == columns[i + 1]:
            continue
        bb = bq = b1 = bs = qq = q1 = qs = one = s1 = ss = br = qr = r1 = sr = 0.0
        for p in range(columns[i], columns[i + 1]):
            w, r, s, b = pixels[SPARE, p], pixels[RESIDUAL, p], pixels[RISE, p], pixels[DENSITY, p]
            q = b * pixels[SCALED, p]
            wb, wq, ws = w * b, w * q, w * s
            bb, bq, b1, bs, br = bb + wb * b, bq + wb * q, b1 + wb, bs + wb * s, br + wb * r
            qq, q1, qs, qr = qq + wq * q, q1 + wq, qs + wq * s, qr + wq * r
            one, s1, ss, r1, sr = one + w, s1 + ws, ss + ws * s, r1 + w * r, sr + ws * r
        gram[0, 0], gram[1, 0], gram[2, 0], gram[3, 0], gram[0, 4] = bb, bq, b1, bs, br
        gram[1, 1], gram[2, 1], gram[3, 1], gram[1, 4] = qq, q1, qs, qr
        gram[2, 2], gram[3, 2], gram[3, 3], gram[2, 4], gram[3, 4] = one, s1, ss, r1, sr
        t = pixels[SHARE, columns[i]]
        slope = _DENSITY_FACTOR * (x[5] + (x[6] - x[5]) * t)
        # The derivative by each parameter is one of (density, density z, 1, erf) times a column factor.
        factor[0], factor[1], factor[2] = slope * root * (1.0 - t), slope * root * t, slope
        factor[3] = factor[5] = 1.0 - t
        factor[4] = factor[6] = t
        for j in range(PARAMETERS):
            for k in range(j + 1):
                work[j, k] += factor[j] * factor[k] * gram[_BASIS[j], _BASIS[k]]
            work[RIGHT, j] += factor[j] * gram[_BASIS[j], 4]


@outlined
def solve(work):
    """Solves SYSTEM x = RIGHT in place; False when it is not positive definite."""
    return eliminate(work, work[RIGHT], types.int64(PARAMETERS))


@outlined
def fit_edge(pixels, columns, used, edge, blur, find, work):
    """Fits one edge by Gauss-Newton with Cauchy weights.

    Args:
        pixels: (9, n) DISTANCE, VALUE, WEIGHT, SHARE of the pixels; the other rows are work space.
        columns: (used + 1,) where each column's pixels begin.
        used: Number of columns.
        edge: (EDGE_NUMBERS,) offsets to start from, and levels unless ``find``; the fit afterwards.
        blur: To start from and to believe in where the pixels do not say, px.
        find: Roughly, from offsets that are known roughly.
        work: (WORK_ROWS, 7) work space.

    Returns:
        False when there is nothing to fit.
    """
    count, log_blur, noise = columns[used], math.log(blur), 0.0
    steps, arrived = (_FIND_STEPS, _FIND_TOLERANCE) if find else (_FIT_STEPS, _FIT_TOLERANCE)
    blur_spread = _START_BLUR_SIGMA if find else _BLUR_SIGMA
    edge[2] = log_blur
    if find:
        edge[3] = edge[4] = edge[5] = edge[6] = 0.0
    # First the levels alone, which are linear: with no contrast the rows of offset and blur are empty.
    for step in range(-1 if find else 0, steps + 1):
        linearise(pixels, count, edge)
        noise = spread(pixels, count) if step >= 0 else 0.0
        normal_equations(pixels, columns, used, edge, noise, work)
        trust = (noise / blur_spread) ** 2
        work[2, 2] += trust
        work[RIGHT, 2] += trust * (log_blur - edge[2])
        keep_system(work, step < 0)
        if step == steps or not solve(work) or take_step(edge, work[RIGHT], step < 0) < arrived:
            break
    edge[NOISE] = noise
    return noise > 0.0 and variances(work, noise * noise, edge)


@outlined
def keep_system(work, levels):
    """Copies the system, with a trace of damping: an edge without contrast must not make it singular."""
    trace = 0.0
    for k in range(PARAMETERS):
        trace += work[k, k]
    for k in range(PARAMETERS):
        work[k, k] += 1e-9 * trace + (1e-9 if not levels else (1.0 if k < 3 else 1e-6))
        for j in range(k + 1):
            work[KEPT + k, j] = work[k, j]


@outlined
def take_step(x, move, levels):
    """Moves the parameters, or the levels alone; how far at most (offsets and ln blur)."""
    # Far from the edge the model is flat and a step can be anything: keep it in sight.
    most = 0.0
    for k in range(3):
        limit = 0.5 if k == 2 else 1.5
        move[k] = 0.0 if levels else min(max(move[k], -limit), limit)
        most = max(most, abs(move[k]))
    for k in range(PARAMETERS):
        x[k] += move[k]
    x[2] = min(max(x[2], _LOG_SHARPEST), _LOG_SOFTEST)
    return math.inf if levels else most


@outlined
def variances(work, variance, edge):
    """Variances of the two offsets and their covariance: the corner of the inverse; False: singular."""
    for k in range(2):
        for i in range(PARAMETERS):
            work[RIGHT, i] = variance if i == k else 0.0
            for j in range(i + 1):
                work[i, j] = work[KEPT + i, j]
        if not solve(work):
            return False
        edge[VAR_FIRST + k] = work[RIGHT, k]
        edge[COVARIANCE] = work[RIGHT, 1 - k]
    return True


# ------------------------------------------------------------------------------------------
# The sides of a marker as bent curves in the picture, and the pixels beside them, compiled.
#
# A side that runs more along x than along y is crossed by picture columns, the others by rows; below ``main``
# is the coordinate along and ``cross`` the one across.


# Pixels per edge are limited by taking at most this many columns (or rows) across it.
COLUMNS = 64
# Places along an edge at which its bent curve is computed; in between it is straight enough.
STATIONS = 17
# The band is also kept inside the outer cell: fraction of the cell used.
_CELL_PART = 0.75
_LEAST_BAND = 1.6
# Pixels within this distance of a corner see two edges at once.
CORNER_GAP = 2.5

# Rows of the table of columns: place along the picture, share of the way, crossing, cosine of the slope,
# weight.
MAIN, ALONG, CROSS, COSINE, USE = 0, 1, 2, 3, 4
COLUMN_ROWS = 5
# What is known of a side: crossed by rows or not, sign of the light, cell, band and length in px, outward
# normals (x, y) where it begins and where it ends.
STEEP, SIGN, CELL, BAND, LENGTH, NORMALS = 0, 1, 2, 3, 4, 5
SIDE_NUMBERS = 9


@outlined
def distorted_side(lens, corners, normalized, k, cells, band, curve, side):
    """Fills ``curve`` and ``side``: the side from corner k to the next, straight without the lens.

    Args:
        lens: ``lens_vector``.
        corners: (4, 2) pixels.
        normalized: (4, 2) the same without the lens.
        k: Which side.
        cells: Cells along a side with the black border.
        band: Half width of the band of pixels at most, px.
        curve: (17, 3) out: main, cross, fraction of the way; main ascends.
        side: (SIDE_NUMBERS,) out.

    Returns:
        False when the lens has no inverse there.
    """
    n, last = (k + 1) % 4, STATIONS - 1
    x0, y0, x1, y1 = normalized[k, 0], normalized[k, 1], normalized[n, 0], normalized[n, 1]
    if not abs(x0 + x1) < math.inf:
        return False
    ax, ay = corners[n, 0] - corners[k, 0], corners[n, 1] - corners[k, 1]
    steep = abs(ay) > abs(ax)
    own = 1 if steep else 0
    ascending = ay > 0.0 if steep else ax > 0.0
    mean = 0.0
    for i in range(STATIONS):
        t = i / last if ascending else 1.0 - i / last
        bx, by, _, _, _ = distort_point(lens, x0 + t * (x1 - x0), y0 + t * (y1 - y0))
        px, py = lens[FX] * bx + lens[CX], lens[FY] * by + lens[CY]
        curve[i, 0], curve[i, 1], curve[i, 2] = (py, px, t) if steep else (px, py, t)
        mean += curve[i, 1] / STATIONS
    main = 0.25 * (corners[0, own] + corners[1, own] + corners[2, own] + corners[3, own])
    cross = 0.25 * (corners[0, 1 - own] + corners[1, 1 - own] + corners[2, 1 - own] + corners[3, 1 - own])
    along, across = curve[last, 0] - curve[0, 0], curve[last, 1] - curve[0, 1]
    length = max(math.hypot(along, across), 1e-9)
    # Height of the marker over the side: twice the area of the triangle to the centre, over the side.
    height = 2.0 * abs((curve[0, 0] - main) * across - (curve[0, 1] - cross) * along) / length
    side[STEEP], side[LENGTH], side[CELL] = 1.0 if steep else 0.0, length, height / cells
    # Light lies outside the black square: away from its centre.
    side[SIGN] = 1.0 if mean > cross else -1.0
    side[BAND] = min(max(_CELL_PART * side[CELL], _LEAST_BAND), band)
    for end in range(2):  # outward normals where the side begins and where it ends
        i = 1 if (end == 0) == ascending else last
        along, across = curve[i, 0] - curve[i - 1, 0], curve[i, 1] - curve[i - 1, 1]
        size = side[SIGN] * max(math.hypot(along, across), 1e-12)
        side[NORMALS + 2 * end + own] = -across / size
        side[NORMALS + 2 * end + 1 - own] = along / size
    return True


@outlined
def cross_columns(curve, side, most, table):
    """Fills ``table`` (5, 64): up to ``most`` whole columns along a side and its crossings; how many."""
    last = STATIONS - 1
    gap = CORNER_GAP * (curve[last, 0] - curve[0, 0]) / side[LENGTH]
    low, high = curve[0, 0] + gap, curve[last, 0] - gap
    first, length = math.ceil(low), math.floor(high) - math.ceil(low)
    n, i, previous = 0, 1, first - 1.0
    for column in range(most):
        position = np.rint(first + column * length / (most - 1))
        # Columns at the ends, and pixels at the border of the band, fade in over one pixel: with a hard
        # border the fit can jump between two sets of pixels for ever.
        use = min(min(position - low, high - position), 1.0)
        if not (position > previous and use > 0.0):
            continue
        previous = position
        while i < last - 1 and curve[i, 0] < position:
            i += 1
        step = max(curve[i, 0] - curve[i - 1, 0], 1e-9)
        part = (position - curve[i - 1, 0]) / step
        slope = (curve[i, 1] - curve[i - 1, 1]) / step
        table[MAIN, n] = position
        table[ALONG, n] = curve[i - 1, 2] + part * (curve[i, 2] - curve[i - 1, 2])
        table[CROSS, n] = curve[i - 1, 1] + part * (curve[i, 1] - curve[i - 1, 1])
        table[COSINE, n] = 1.0 / math.sqrt(1.0 + slope * slope)
        table[USE, n] = use
        n += 1
    return n


@outlined
def take_pixels(gray, side, table, n, pixels, columns):
    """The pixels of the band as they are in the picture; ``columns`` says where each column's begin."""
    height, width = gray.shape
    steep = side[STEEP] > 0.0
    across, wide = (width, height) if steep else (height, width)
    count, capacity = 0, pixels.shape[1]
    columns[0] = 0
    for i in range(n):
        main, cross = int(table[MAIN, i]), table[CROSS, i]
        reach = (side[BAND] + 0.5) / table[COSINE, i]
        first = max(math.ceil(cross - reach), 0)
        last = min(math.floor(cross + reach), across - 1)
        if 0 <= main < wide:
            for j in range(first, last + 1):
                distance = (j - cross) * table[COSINE, i]
                weight = min(side[BAND] + 0.5 - abs(distance), 1.0) * table[USE, i]
                if weight > 0.0 and count < capacity:
                    pixels[DISTANCE, count] = distance * side[SIGN]
                    pixels[VALUE, count] = gray[main, j] if steep else gray[j, main]
                    pixels[WEIGHT, count] = weight
                    pixels[SHARE, count] = table[ALONG, i]
                    count += 1
        columns[i + 1] = count
    return count
