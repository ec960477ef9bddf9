"""Least-squares fit of a straight edge to pixels, compiled.

Model of the grey value near one edge, for a pixel at signed distance d (px, positive on the light side) from
the current line and at the fraction t of the way along it:

    I(d, t) = middle(t) + contrast(t) * erf((d - offset(t)) / (sqrt(2) blur))

with ``middle``, ``contrast`` and ``offset`` linear in t: uneven light is part of the model.  Pixels are used
as they are, never resampled, so their noise is independent and the covariance is honest.

All pixels of one column (or row) across the edge share t, so the normal equations are sums over a column of
products of three numbers, spread over the seven parameters once a column instead of once a pixel.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import outlined

# Parameters: offset at both ends, ln blur, middle at both ends, contrast at both ends.
PARAMETERS = 7
# Blur in px.  The pixel's own width alone gives 0.29, but a model sharper than a third has a minimum between
# any two pixels (sharpened pictures show it); beyond 4 px no cell of a marker could be read.
BLUR_START = 0.8
_LOG_SHARPEST, _LOG_SOFTEST = math.log(0.33), math.log(4.0)
# Residuals beyond this many standard deviations lose weight (Cauchy's function): dirt, glare, occlusion.
_CAUCHY = 2.4
# Keeps weights meaningful in pictures without noise: quantisation to whole grey levels.
_LEAST_NOISE = 0.3
_BELL = -2.0 / math.sqrt(math.pi)

# Rows of the table of pixels.
DISTANCE, VALUE, WEIGHT, RESIDUAL, RISE, BELL, SHIFTED, SIZE = 0, 1, 2, 3, 4, 5, 6, 7
PIXEL_ROWS = 8
# Rows of the work space: system and right side, a copy of the system, sums over a column, its factors.
SYSTEM, RIGHT, KEPT, GRAM, FACTOR = 0, 7, 8, 15, 19
WORK_ROWS = 20
# Which of (bell, bell z, 1, erf) each parameter's derivative has.
_BASIS = (0, 0, 1, 2, 2, 3, 3)


@outlined
def linearise(pixels, columns, along, used, x):
    """Fills RISE, BELL, SHIFTED (erf, its slope, slope times place) and RESIDUAL of every pixel at ``x``."""
    root = math.exp(-x[2]) / math.sqrt(2.0)
    for i in range(used):
        t = along[i]
        offset = x[0] + (x[1] - x[0]) * t
        middle, contrast = x[3] + (x[4] - x[3]) * t, x[5] + (x[6] - x[5]) * t
        for p in range(columns[i], columns[i + 1]):
            z = (pixels[DISTANCE, p] - offset) * root
            # The error function to 1.5e-7: Abramowitz and Stegun 7.1.26.
            r = 1.0 / (1.0 + 0.3275911 * abs(z))
            bell = math.exp(-z * z)
            series = r * (-0.284496736 + r * (1.421413741 + r * (-1.453152027 + r * 1.061405429)))
            rise = math.copysign(1.0 - r * (0.254829592 + series) * bell, z)
            pixels[RISE, p] = rise
            pixels[BELL, p] = bell
            pixels[SHIFTED, p] = bell * z
            pixels[RESIDUAL, p] = pixels[VALUE, p] - middle - contrast * rise


@outlined
def spread(pixels, count):
    """Robust standard deviation: median of the residuals' sizes, corrected for the parameters used up."""
    values = pixels[SIZE]
    for p in range(count):
        values[p] = abs(pixels[RESIDUAL, p])
    # The median by Hoare's selection (1961): the part that holds it is parted again.
    low, high, k = 0, count - 1, count // 2
    while low < high:
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
    freedom = max(count - PARAMETERS, 1) / max(count, 1)
    return max(1.4826 * values[k] / math.sqrt(freedom), _LEAST_NOISE) if count > 0 else _LEAST_NOISE


@outlined
def normal_equations(pixels, columns, along, used, x, noise, work):
    """SYSTEM: lower triangle of JᵀWJ, and RIGHT: JᵀWr, with Cauchy's weights (``noise`` 0: without)."""
    gram, factor = work[GRAM : GRAM + 4], work[FACTOR]
    for i in range(SYSTEM, RIGHT + 1):
        for j in range(PARAMETERS):
            work[i, j] = 0.0
    root = math.exp(-x[2]) / math.sqrt(2.0)
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    for i in range(used):
        bb = bq = b1 = bs = qq = q1 = qs = one = s1 = ss = br = qr = r1 = sr = 0.0
        for p in range(columns[i], columns[i + 1]):
            r, s, b, q = pixels[RESIDUAL, p], pixels[RISE, p], pixels[BELL, p], pixels[SHIFTED, p]
            w = pixels[WEIGHT, p] / (1.0 + cauchy * r * r)
            wb, wq, ws = w * b, w * q, w * s
            bb, bq, b1, bs, br = bb + wb * b, bq + wb * q, b1 + wb, bs + wb * s, br + wb * r
            qq, q1, qs, qr = qq + wq * q, q1 + wq, qs + wq * s, qr + wq * r
            one, s1, ss, r1, sr = one + w, s1 + ws, ss + ws * s, r1 + w * r, sr + ws * r
        gram[0, 0], gram[1, 0], gram[2, 0], gram[3, 0], gram[0, 4] = bb, bq, b1, bs, br
        gram[1, 1], gram[2, 1], gram[3, 1], gram[1, 4] = qq, q1, qs, qr
        gram[2, 2], gram[3, 2], gram[3, 3], gram[2, 4], gram[3, 4] = one, s1, ss, r1, sr
        t = along[i]
        slope = _BELL * (x[5] + (x[6] - x[5]) * t)
        # The derivative by each parameter is one of (bell, bell z, 1, erf) times a factor of the column.
        factor[0], factor[1], factor[2] = slope * root * (1.0 - t), slope * root * t, slope
        factor[3] = factor[5] = 1.0 - t
        factor[4] = factor[6] = t
        for j in range(PARAMETERS):
            for k in range(j + 1):
                work[j, k] += factor[j] * factor[k] * gram[_BASIS[j], _BASIS[k]]
            work[RIGHT, j] += factor[j] * gram[_BASIS[j], 4]


@outlined
def solve(work):
    """Solves SYSTEM x = RIGHT in place by L D Lᵀ; False when it is not positive definite."""
    x = work[RIGHT]
    for k in range(PARAMETERS):
        if not work[k, k] > 0.0:
            return False
        inverse = 1.0 / work[k, k]
        for i in range(k + 1, PARAMETERS):
            share = work[i, k] * inverse
            for j in range(k + 1, i + 1):
                work[i, j] -= share * work[j, k]
            x[i] -= share * x[k]
        work[k, k] = inverse
    for k in range(PARAMETERS - 1, -1, -1):
        for i in range(k + 1, PARAMETERS):
            x[k] -= work[i, k] * x[i]
        x[k] *= work[k, k]
    return True


@outlined
def fit_edge(pixels, columns, along, used, x, expected_blur, blur_spread, steps, arrived, work, result):
    """Fits one edge by Gauss-Newton with Cauchy weights.

    Args:
        pixels: (8, n) DISTANCE, VALUE, WEIGHT of the pixels; the other rows are work space.
        columns: (used + 1,) where each column's pixels begin.
        along: (used,) fraction of the way along the edge.
        used: Number of columns.
        x: (7,) offsets to start from in the first two places; the fitted parameters afterwards.
        expected_blur: Blur to start from and to believe in where the pixels do not say, px.
        blur_spread: How far ln(blur) is believed to be from that.
        steps: Gauss-Newton steps at most.
        arrived: A step of the offsets (px) and of ln(blur) smaller than this is the last one.
        work: (WORK_ROWS, 7) work space.
        result: (4,) variance of the offset at the first end, at the second, their covariance (px^2), noise
            (grey levels).

    Returns:
        False when there is nothing to fit.
    """
    count, log_blur = columns[used], math.log(expected_blur)
    noise = 0.0
    x[2] = log_blur
    x[3] = x[4] = x[5] = x[6] = 0.0
    # First the levels alone, which are linear: with no contrast the rows of offset and blur are empty.
    for step in range(-1, steps + 1):
        linearise(pixels, columns, along, used, x)
        noise = spread(pixels, count) if step >= 0 else 0.0
        normal_equations(pixels, columns, along, used, x, noise, work)
        work[2, 2] += (noise / blur_spread) ** 2
        work[RIGHT, 2] += (noise / blur_spread) ** 2 * (log_blur - x[2])
        # A trace of damping: an edge without contrast must not make the system singular.
        trace = 0.0
        for k in range(PARAMETERS):
            trace += work[k, k]
        for k in range(PARAMETERS):
            work[k, k] += 1e-9 * trace + (1e-9 if step >= 0 else (1.0 if k < 3 else 1e-6))
            for j in range(k + 1):
                work[KEPT + k, j] = work[k, j]
        if step == steps or not solve(work):
            break
        if step >= 0 and take_step(x, work[RIGHT]) < arrived:
            break
        for k in range(3 if step < 0 else PARAMETERS, PARAMETERS):
            x[k] = work[RIGHT, k]
    result[3] = noise
    return noise > 0.0 and variances(work, noise * noise, result)


@outlined
def take_step(x, move):
    """Moves the parameters; how far at most (offsets and ln blur)."""
    # Far from the edge the model is flat and a step can be anything: keep it in sight.
    for k in range(2):
        move[k] = min(max(move[k], -1.5), 1.5)
    move[2] = min(max(move[2], -0.5), 0.5)
    for k in range(PARAMETERS):
        x[k] += move[k]
    x[2] = min(max(x[2], _LOG_SHARPEST), _LOG_SOFTEST)
    return max(abs(move[0]), abs(move[1]), abs(move[2]))


@outlined
def variances(work, variance, result):
    """Variances of the two offsets and their covariance: the corner of the inverse; False: singular."""
    for k in range(2):
        for i in range(PARAMETERS):
            work[RIGHT, i] = variance if i == k else 0.0
            for j in range(i + 1):
                work[i, j] = work[KEPT + i, j]
        if not solve(work):
            return False
        result[k] = work[RIGHT, k]
        result[2] = work[RIGHT, 1 - k]
    return True
