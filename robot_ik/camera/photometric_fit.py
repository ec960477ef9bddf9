"""The fit of one marker's print, compiled: its pixels, its unknowns, and whether it can be believed.

``photometric_equations`` has the model and Gauss and Newton's steps.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.camera.lens import CX, CY, FX, FY, distort_point
from robot_ik.camera.photometric_equations import (
    ANY_NOISE,
    BLUR,
    BY_UNKNOWN,
    CAUCHY,
    CONTRAST,
    CONVERGED,
    DARK,
    DROP_FLAT,
    EQUATION_ROWS,
    EVERY,
    FIXED_INFORMATION,
    HALO,
    HALO_WIDTH,
    HALOED,
    HOMOGRAPHY,
    LEAST_NOISE,
    NOISE,
    PIXEL_ROWS,
    PLAIN,
    PRIOR_INFORMATION,
    PRIOR_MEAN,
    SHIFT,
    SIZE,
    STEP,
    SYSTEM,
    TO_PRINT,
    UNKNOWNS,
    USED,
    X,
    collect_pixels,
    gauss_newton,
    photometric_equations,
    system,
)
from robot_ik.camera.photometric_equations import NUMBERS as FIT_NUMBERS
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.linalg import eliminate

# Further rows of a fit's table: (9,) from the print, where it was found, to undistorted coordinates and to
# pixels; the corners, one a row: pixel x, y, and the same undistorted; what is reported; (8, 8) covariance,
# px^2; the model.
FROM_PRINT, SEEN, CORNERS, REPORT, COVARIANCE, MODEL = (EQUATION_ROWS + k for k in (0, 1, 2, 6, 7, 15))
# Work space: corners that are not believed yet; how they move by the homography; sums over cells, and from
# column 32 on how many pixels; a part of the system.
_FOUND, _SLOPES, _SUMS, _PART = (EQUATION_ROWS + k for k in (16, 20, 28, 44))
FIT_ROWS = _PART + UNKNOWNS
_COUNTS = 32
# The report: part of the variance that is explained, and cells that are misread.
EXPLAINED, MISREAD = 0, 1
# A model as the next picture's fit starts from it: noise (0: there is none), unknowns, halo, and x from BLUR.
MODEL_NUMBERS = 3 + UNKNOWNS - BLUR
# What ``fit_photometric`` returns.
NO_PRINT, NOT_FITTED, BY_PRINT = 0, 1, 2
#: Of a print that is believed: contrast in grey levels, and part of the variance that the model explains.
LEAST_CONTRAST, LEAST_EXPLAINED = 5.0, 0.75
#: Least standard deviation of a corner, px.
LEAST_SIGMA = 0.01

# Blur that sharpening subtracts, px: unsharp masks of webcams and telephones are narrow, those of programs
# wider.
_HALO_BLURS = (1.2, 2.0, 3.0)
# So many pixels say whether the model needs more unknowns.
_ASKED = 800
# Steps at most.
_STEPS = 14
# The detector's corners are a pixel off, so the print is first fitted roughly, to say which pixels see its
# edges: with one in four or five pixels, where a box has so many that are looked at.
_ROUGHLY = 3000
# Pixels of a fit at least: twice the unknowns.
_LEAST_PIXELS = 2 * HALOED
# A corner may go so far from where it was found: px, part of the side.  The detector's sharp corners of a
# strongly tilted marker are off by a tenth; a print that is shifted by a cell explains nothing.
_FARTHEST, _FARTHEST_PART = 3.0, 0.2
# Quadratic light and a halo are taken where they lessen the sum of squares by these parts: by chance it is a
# hundredth.  Mild sharpening (0.6) gives 0.01 to 0.04 and does no harm; strong (1.5) gives 0.06 to 0.13.
_LIGHT_ASKED, _HALO_ASKED = 0.03, 0.05
# Corners of the print.
_U, _V = (-0.5, 0.5, 0.5, -0.5), (-0.5, -0.5, 0.5, 0.5)


@kernel
def fit_photometric(gray, lens, box, reach, black, fit, pixels, residuals, most):
    """Fits one print: roughly from corners that are a pixel off, then with the pixels that see its edges.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: (5,) as in ``collect_pixels``, with ``reach``.
        reach: See ``box``.
        black: (n, n) 1 where the print is black.
        fit: (FIT_ROWS, 64) with PRIOR_INFORMATION, PRIOR_MEAN, FROM_PRINT, SEEN, CORNERS and MODEL in; the
            latter two, REPORT and COVARIANCE out.
        pixels: (8, k) work space.
        residuals: (5, k) work space.
        most: So many pixels are fitted at most.

    Returns:
        NO_PRINT: nothing is to be seen of it; NOT_FITTED: EXPLAINED and MISREAD say how it looks from where
        it was found; BY_PRINT.
    """
    numbers, model, report = fit[FIT_NUMBERS], fit[MODEL], fit[REPORT]
    corner_slopes(fit[SEEN], fit[BY_UNKNOWN:])
    count, before, resumed, every = 0, -math.inf, model[0] > 0.0, box[4]
    for roughly in (True, False):
        if numbers[CONVERGED] == 0.0 and not start_fit(fit):
            return NO_PRINT
        many = (box[2] - box[0]) * (box[3] - box[1]) > _ROUGHLY * every
        box[4] = 4 * every + 1 if roughly and many else every
        count = collect_pixels(gray, lens, box, reach, fit, pixels)
        if resumed:
            numbers[DROP_FLAT] = 1.0
        else:
            noise = numbers[NOISE] if numbers[CONVERGED] > 0.0 else ANY_NOISE
            count = fit_light(pixels, count, black, fit, residuals, most)
            if count < _LEAST_PIXELS:
                return NO_PRINT
            numbers[NOISE] = noise
        numbers[EVERY] = 1.0
        if roughly:
            gauss_newton(pixels, count, black, fit, residuals, _STEPS)
            if numbers[CONVERGED] > 0.0:
                fit[PRIOR_MEAN, BLUR] = fit[X, BLUR]
    state = NOT_FITTED
    for more in range(2):
        if more == 1:
            select_model(pixels, count, black, fit, residuals)
            if numbers[SIZE] == PLAIN:
                break
            numbers[EVERY] = 1.0
        gauss_newton(pixels, count, black, fit, residuals, _STEPS)
        count = int(numbers[USED])
        before = max(before, explained(pixels, count, fit, residuals[3]))
        fine = count >= _LEAST_PIXELS and numbers[CONVERGED] > 0.0
        if fine and accept_fit(lens, black, fit, pixels, count, residuals):
            state = BY_PRINT
            model[0], model[1], model[2] = numbers[NOISE], numbers[SIZE], numbers[HALO_WIDTH]
            for i in range(BLUR, UNKNOWNS):
                model[3 + i - BLUR] = fit[X, i]
        if count < _LEAST_PIXELS or resumed:
            break
    if state == NOT_FITTED:
        if count < _LEAST_PIXELS:
            return NO_PRINT
        report[EXPLAINED] = max(before, explained(pixels, count, fit, residuals[0]))
        report[MISREAD], _ = cell_residuals(black, fit, residuals)
    return state


@outlined
def start_fit(fit):
    """The unknowns before the first step: from what is believed, or from the MODEL; False: no homography."""
    numbers, model, x = fit[FIT_NUMBERS], fit[MODEL], fit[X]
    x[BLUR], x[SHIFT] = fit[PRIOR_MEAN, BLUR], fit[PRIOR_MEAN, SHIFT]
    if model[0] > 0.0:
        numbers[NOISE], numbers[SIZE], numbers[HALO_WIDTH] = model[0], model[1], model[2]
        fit[PRIOR_INFORMATION, HALO] = 0.0 if model[2] > 0.0 else FIXED_INFORMATION
        for i in range(BLUR, UNKNOWNS):
            x[i] = model[3 + i - BLUR]
    return invert(fit[FROM_PRINT], fit[TO_PRINT])


@outlined
def corner_slopes(h, slopes):
    """(8, 8) how the corners move by the unknowns of the homography (9,) from the print."""
    for k in range(4):
        u, v = _U[k], _V[k]
        depth = h[6] * u + h[7] * v + h[8]
        for i in range(2):
            a, b, row = h[3 * i], h[3 * i + 1], slopes[2 * k + i]
            position = (a * u + b * v + h[3 * i + 2]) / depth
            by_u, by_v = (position * h[6] - a) / depth, (position * h[7] - b) / depth
            row[0], row[1], row[2], row[3], row[4], row[5] = (
                by_u,
                by_u * u,
                by_u * v,
                by_v,
                by_v * u,
                by_v * v,
            )
            row[6] = (by_u * u + by_v * v) * u
            row[7] = (by_u * u + by_v * v) * v


@outlined
def fit_light(pixels, count, black, fit, residuals, most):
    """Fits dark and contrast, which are linear, and keeps ``most`` of the pixels that carry information.

    Returns:
        How many are kept.
    """
    numbers = fit[FIT_NUMBERS]
    for i in range(DARK, PLAIN):
        fit[X, i] = 0.0
    numbers[NOISE], numbers[EVERY], numbers[DROP_FLAT], numbers[SIZE] = 0.0, 1.0, 1.0, PLAIN
    count = photometric_equations(pixels, count, black, fit, residuals)
    numbers[DROP_FLAT], numbers[NOISE] = 0.0, ANY_NOISE
    if count < _LEAST_PIXELS:
        return count
    system(fit)
    # Without noise the rows of the other unknowns are empty.  A literal number would be compiled for itself.
    if solve_part(fit, types.int64(PLAIN), types.int64(0)):
        for i in range(DARK, PLAIN):
            fit[X, i] = fit[STEP, i]
    for k in range(most if count > most else 0):
        for i in range(PIXEL_ROWS):
            pixels[i, k] = pixels[i, k * count // most]
    return min(count, most)


@outlined
def solve_part(fit, n, skipped):
    """Solves for n unknowns, without the ``skipped`` ones after PLAIN; False where there is no solution.

    The right side is in STEP, and so is the solution.  The system stays.
    """
    part, step = fit[_PART:], fit[STEP]
    for i in range(n):
        row = i if i < PLAIN else i + skipped
        step[i] = step[row]
        for j in range(i + 1):
            part[i, j] = fit[SYSTEM + row, j if j < PLAIN else j + skipped]
    return eliminate(part, step, n)


@outlined
def select_model(pixels, count, black, fit, residuals):
    """Whether the residuals ask for uneven light or for a halo, which are then part of the model."""
    numbers, right = fit[FIT_NUMBERS], fit[SYSTEM + UNKNOWNS]
    numbers[EVERY], numbers[SIZE] = (count + _ASKED - 1) // _ASKED, UNKNOWNS
    most, width, curved, fit[PRIOR_INFORMATION, HALO] = 0.0, 0.0, False, 0.0
    for halo in _HALO_BLURS:
        numbers[HALO_WIDTH] = halo
        numbers[USED] = photometric_equations(pixels, count, black, fit, residuals)
        system(fit)
        squares, plain, by_halo, by_light = sum_of_squares(fit, residuals), 0.0, 0.0, 0.0
        for model in range(3):  # by how much each lessens the sum of squares
            n, skipped, gain = PLAIN + model if model < 2 else UNKNOWNS - 1, model // 2, 0.0
            for i in range(UNKNOWNS):
                fit[STEP, i] = right[i]
            if solve_part(fit, n, skipped):
                for i in range(n):
                    gain += fit[STEP, i] * right[i if i < PLAIN else i + skipped]
            if model == 0:
                plain = gain
            elif model == 1:
                by_halo = gain - plain
            else:
                by_light = gain - plain
        curved = by_light > _LIGHT_ASKED * squares
        if by_halo > max(most, _HALO_ASKED * squares):
            most, width = by_halo, halo
        if width == 0.0:
            break  # where a narrow one lessens nothing a wide one does not either
    numbers[HALO_WIDTH] = width
    fit[PRIOR_INFORMATION, HALO] = 0.0 if width > 0.0 else FIXED_INFORMATION
    numbers[SIZE] = UNKNOWNS if curved else (HALOED if width > 0.0 else PLAIN)


@outlined
def sum_of_squares(fit, residuals):
    """Of the residuals; what is far off counts as four standard deviations."""
    total, most = 0.0, (CAUCHY * fit[FIT_NUMBERS, NOISE]) ** 2
    for p in range(int(fit[FIT_NUMBERS, USED])):
        total += min(residuals[0, p] ** 2, most)
    return total


@outlined
def explained(pixels, count, fit, residuals):
    """Part of the variance of the grey values that the model explains with ``residuals``."""
    every, total, mean = int(fit[FIT_NUMBERS, EVERY]), 0.0, 0.0
    for p in range(0, count, every):
        total += pixels[7, p]
        mean += pixels[7, p] * pixels[6, p]
    mean /= max(total, 1e-9)
    spread, missed = 0.0, 0.0
    for p in range(0, count, every):
        spread += pixels[7, p] * (pixels[6, p] - mean) ** 2
        missed += pixels[7, p] * residuals[p // every] ** 2
    # Where hardly anything is to be seen nothing is there.
    return 1.0 - missed / spread if spread > LEAST_CONTRAST * total else 0.0


@outlined
def cell_residuals(black, fit, residuals):
    """How many cells the picture shows otherwise; squares of cells' residuals over those of noise."""
    n = black.shape[0]
    for row in range(n):
        for column in range(_COUNTS + n):
            fit[_SUMS + row, column] = 0.0
    for p in range(int(fit[FIT_NUMBERS, USED])):
        column, row = math.floor(n * (residuals[1, p] + 0.5)), math.floor(n * (residuals[2, p] + 0.5))
        if 0 <= column < n and 0 <= row < n:
            fit[_SUMS + row, column] += residuals[0, p]
            fit[_SUMS + row, _COUNTS + column] += 1.0
    misread, seen, squares, contrast = 0.0, 1e-9, 0.0, 0.5 * abs(fit[X, CONTRAST])
    for row in range(n):
        for column in range(n):
            total, count = fit[_SUMS + row, column], fit[_SUMS + row, _COUNTS + column]
            if count > 0.0:
                seen += 1.0
                squares += total * total / count
                misread += 1.0 if abs(total) > contrast * count else 0.0
    return misread, squares / (seen * fit[FIT_NUMBERS, NOISE] ** 2)


@outlined
def accept_fit(lens, black, fit, pixels, count, residuals):
    """Fills CORNERS, COVARIANCE and REPORT; False, and nothing is changed, if they are not to be believed."""
    share, x, found, h = explained(pixels, count, fit, residuals[0]), fit[X], fit[_FOUND:], fit[TO_PRINT]
    if not (x[CONTRAST] > max(LEAST_CONTRAST, 1.5 * fit[FIT_NUMBERS, NOISE]) and share >= LEAST_EXPLAINED):
        return False
    back = fit[SEEN]
    if not invert(h, back):
        return False
    corner_slopes(back, fit[_SLOPES:])
    for k in range(4):
        u, v = _U[k], _V[k]
        depth = back[6] * u + back[7] * v + back[8]
        if not depth > 0.0:
            return False
        nx = (back[0] * u + back[1] * v + back[2]) / depth
        ny = (back[3] * u + back[4] * v + back[5]) / depth
        bx, by, xx, xy, yy = distort_point(lens, nx, ny)
        found[k, 0], found[k, 1] = lens[FX] * bx + lens[CX], lens[FY] * by + lens[CY]
        found[k, 2], found[k, 3] = nx, ny
        for i in range(8):
            a, b = fit[_SLOPES + 2 * k, i], fit[_SLOPES + 2 * k + 1, i]
            fit[_SLOPES + 2 * k, i] = lens[FX] * (xx * a + xy * b)
            fit[_SLOPES + 2 * k + 1, i] = lens[FY] * (xy * a + yy * b)
    ax, ay = found[2, 0] - found[0, 0], found[2, 1] - found[0, 1]
    bx, by = found[3, 0] - found[1, 0], found[3, 1] - found[1, 1]
    farthest = max(_FARTHEST, _FARTHEST_PART * math.sqrt(0.5 * abs(ax * by - ay * bx)))
    for k in range(8):
        if not abs(found[k // 2, k % 2] - fit[CORNERS + k // 2, k % 2]) < farthest:
            return False
    misread, uneven = cell_residuals(black, fit, residuals)
    if not uncertainty(fit, uneven, residuals):
        return False
    for k in range(16):
        fit[CORNERS + k // 4, k % 4] = found[k // 4, k % 4]
    report = fit[REPORT]
    report[EXPLAINED], report[MISREAD] = share, misread
    return True


@outlined
def invert(m, inverse):
    """Inverse of a (3, 3) matrix, both (9,); False where there is none."""
    a, b, c = m[4] * m[8] - m[5] * m[7], m[5] * m[6] - m[3] * m[8], m[3] * m[7] - m[4] * m[6]
    determinant = m[0] * a + m[1] * b + m[2] * c
    if not abs(determinant) > 0.0:
        return False
    scale = 1.0 / determinant
    inverse[0], inverse[3], inverse[6] = a * scale, b * scale, c * scale
    inverse[1] = (m[2] * m[7] - m[1] * m[8]) * scale
    inverse[4] = (m[0] * m[8] - m[2] * m[6]) * scale
    inverse[7] = (m[1] * m[6] - m[0] * m[7]) * scale
    inverse[2] = (m[1] * m[5] - m[2] * m[4]) * scale
    inverse[5] = (m[2] * m[3] - m[0] * m[5]) * scale
    inverse[8] = (m[0] * m[4] - m[1] * m[3]) * scale
    return True


@outlined
def uncertainty(fit, uneven, residuals):
    """Fills COVARIANCE, px^2; False where there is none."""
    n, found, slopes = int(fit[FIT_NUMBERS, SIZE]), fit[_FOUND:], fit[_SLOPES:]
    variance = sum_of_squares(fit, residuals) / (fit[FIT_NUMBERS, USED] - n)
    # Residuals that are alike all over a cell are no noise but a shadow's hard edge, glare, dirt: usual
    # pictures give 0.4 to 5 times what noise leaves of a cell's mean, squared; hard shadows 7 to 36.
    variance = max(variance, LEAST_NOISE**2) * max(1.0, uneven - 1.0)
    system(fit)
    x0, y0 = 0.0, 0.0
    for k in range(4):
        x0, y0 = x0 + 0.25 * found[k, 0], y0 + 0.25 * found[k, 1]
    for k in range(4):  # unit vectors outwards
        x, y = found[k, 0] - x0, found[k, 1] - y0
        found[k, 4], found[k, 5] = x / math.hypot(x, y), y / math.hypot(x, y)
    for i in range(8):
        for j in range(n):
            fit[STEP, j] = slopes[i, j] if j < HOMOGRAPHY else 0.0
        if not solve_part(fit, n, types.int64(0)):
            return False
        for k in range(8):
            total = 0.0
            for j in range(HOMOGRAPHY):
                total += slopes[k, j] * fit[STEP, j]
            least = found[i // 2, 4 + i % 2] * found[k // 2, 4 + k % 2] + (0.5 if i == k else 0.0)
            fit[COVARIANCE + i, k] = variance * total + LEAST_SIGMA**2 * least
    return True
