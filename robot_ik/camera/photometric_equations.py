"""A marker's print in grey values, and the equations of its fit over the pixels that see it, compiled.

Model of the grey value of a pixel that sees the print at (u, v), in sides of the marker, rows downwards:

    I = dark(u, v) + contrast(u, v) * G_k(S(u, v)),        G_k(S) = N(N^-1(S) + k)

S is the print, 0 black and 1 white, blurred by a Gaussian of the picture; N is the normal distribution; k is
the shift of an edge into the black, in sigmas of the blur.  Light and contrast are linear, or quadratic where
the residuals ask for it.  Where they ask for that, the picture has been sharpened by a share a:

    (1 + a) G_k(S) - a G_k'(S'),        S' of the blur s'^2 = s^2 + h^2,     k' = k s / s'

A cell's share of S is an integral of a Gaussian over a rectangle.  Seen aslant, the Gaussian's u and v are
correlated; the integral is then a series in the correlation r, whose terms are products of differences along
u and v: of error functions, of r times densities, of r^2 / 2 times densities times their positions, ….
Source: Pearson, Mathematical contributions to the theory of evolution VII, Phil. Trans. R. Soc. A 195, 1900.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

import numpy as np
from numba import types

from robot_ik.camera.lens import CX, CY, FX, FY, distort_point, from_pixel
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.linalg import eliminate

# Unknowns: eight of the homography, ln blur (px), edge shift, three each of dark and contrast; then halo, and
# three more each of dark and contrast where light is quadratic.  A fit has the first 16, 17 or 23 of them.
HOMOGRAPHY, BLUR, SHIFT, DARK, CONTRAST, HALO, CURVED = 8, 8, 9, 10, 13, 16, 17
PLAIN, HALOED, UNKNOWNS = 16, 17, 23
# What is kept of a pixel: undistorted coordinates, their derivative by pixels (symmetric but for the focal
# lengths), grey value, how many pixels it stands for.
PIXEL_ROWS = 8
# What is kept of a residual: its size in grey levels, u and v, what it was before the first step, work space.
RESIDUAL_ROWS = 5
# Trust in what stays as it is.
FIXED_INFORMATION = 1e15
# A fit is one table of numbers.  Its rows: equations of some pixels, so many at a time; the system and its
# right side; shares of cells along u and v; the print with and without the halo's blur; (1, u, v, uu, uv,
# vv); the step.
BLOCK = 64
SYSTEM, _CELLS, _PRINT, _WIDER, _BASIS, STEP = 24, 48, 54, 55, 56, 57
# The unknowns (the first eight are not read: TO_PRINT has them); their prior: one over its variance,
# and its mean; (9,) from (x, y, 1), undistorted, to (u, v, 1) over the depth; the
# numbers of NOISE.
X, PRIOR_INFORMATION, PRIOR_MEAN, TO_PRINT, NUMBERS = 58, 59, 60, 61, 62
# (8, 8) how the corners move, px, by the unknowns of the homography; (24, 24) sums: lower triangle, and the
# right side in the row after the unknowns.
BY_UNKNOWN, NORMAL, EQUATION_ROWS = 63, 71, 95
# Noise in grey levels (0: dark and contrast alone); one pixel in EVERY is used; whether pixels without
# information are left out; blur that sharpening subtracts, px (0: no halo); how many unknowns there are.
# Out: how many pixels were used, whether the fit converged.
NOISE, EVERY, DROP_FLAT, HALO_WIDTH, SIZE, USED, CONVERGED = 0, 1, 2, 3, 4, 5, 6
# Beyond so many standard deviations an edge has no effect.
_EDGE_REACH = 3.2
# Residuals beyond this many standard deviations lose weight (Cauchy's function).
CAUCHY = 4.0
# Where hardly anything changes (parts of the contrast a pixel), light is all there is to see: of such pixels
# one in so many is enough.
_FLAT, _SLOPE = 6, 0.06
# Of a blur of so many sigmas nothing is left that is steeper.
_NO_SLOPE = 2.4
# Least share of black or white: beyond, the inverse of the normal distribution says nothing.
_LEAST_SHARE = 1e-5
# A step so small, in standard deviations, is the last; a fit that does not come below the second is none.
_STEP_TOLERANCE, _LARGEST_LAST_STEP = 0.2, 0.5
# So is one that moves no corner by more than this, px, and ln blur, edge shift and halo not more than that:
# the model is straight enough there for the place where it ends.
_CORNER_TOLERANCE, _PARAMETER_TOLERANCE = 0.05, 0.05
# Where noise grows by more than this, the fit is not yet where it should be.
_GROWN = 1.3
# Rounds in which noise is still estimated anew: later it would keep the fit from coming to rest.
_NOISE_ROUNDS = 5
# A step at most: px at a corner, ln blur, edge shift.
_CORNER_STEP, _BLUR_STEP, _SHIFT_STEP = 1.5, 0.4, 0.5
# ln of an edge's least blur, px: the pixel's own width.
LEAST_LN_BLUR = math.log(0.29)
# Noise of a pixel, grey levels: quantisation; and so much that all pixels weigh the same.
LEAST_NOISE, ANY_NOISE = 0.3, 1e4
# Halo of the strongest sharpening; beyond any edge shift that the model is good for.
_LARGEST_HALO, _LARGEST_SHIFT = 3.0, 2.0


# The normal distribution and its density at so many positions a sigma: Taylor's series from the nearest one
# is exact to 1e-7, and takes a third of the time of an error function and an exponential.
_SAMPLES_A_SIGMA, _REACH = 64, 8.0
_AT = np.arange(-_REACH * _SAMPLES_A_SIGMA, _REACH * _SAMPLES_A_SIGMA + 1) / _SAMPLES_A_SIGMA
_DENSITY = np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
_CUMULATIVE = np.array([0.5 * math.erfc(-z * math.sqrt(0.5)) for z in _AT])


@inlined
def normal_at(z):
    """The normal distribution and its density at z, -8 to 8."""
    i = int(z * _SAMPLES_A_SIGMA + _REACH * _SAMPLES_A_SIGMA + 0.5)
    position = i / _SAMPLES_A_SIGMA - _REACH
    h, density = z - position, _DENSITY[i]
    second = 0.5 * h * h * (position * position - 1.0)
    return _CUMULATIVE[i] + h * density * (1.0 - 0.5 * h * position + second / 3.0), density * (
        1.0 - h * position + second
    )


@inlined
def cell_shares(position, width, count, shares, row):
    """Differences over the cells that count: of the normal distribution, density, position times density.

    They are written into three rows of ``shares``, from ``row`` on.

    Returns:
        The first of those cells and the one after the last.
    """
    inverse = 1.0 / width
    at, margin, pitch = (position + 0.5) * count, _EDGE_REACH * width * count, inverse / count
    first, last = max(math.floor(at - margin), 0), min(math.floor(at + margin) + 1, count)
    before, before_density, before_z = 0.0, 0.0, 0.0
    for i in range(first, last + 1):
        z = (at - i) * pitch
        below, density = (1.0 if z > 0.0 else 0.0), 0.0
        if abs(z) < _EDGE_REACH:
            below, density = normal_at(z)
        if i > first:
            shares[row, i - 1] = before - below
            shares[row + 1, i - 1] = before_density - density
            shares[row + 2, i - 1] = before_z * before_density - z * density
        before, before_density, before_z = below, density, z
    return first, last


@outlined
def normal_quantile(p):
    """Inverse of the normal distribution to 1e-7: Wichura, Applied Statistics 37, 1988, AS 241 (PPND7)."""
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = ((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179
        return q * top / (((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0)
    r = math.sqrt(-math.log(min(p, 1.0 - p))) - 1.6
    top = ((0.17023821103 * r + 1.3067284816) * r + 2.7568153900) * r + 1.4234372777
    return math.copysign(top / ((0.12021132975 * r + 0.73700164250) * r + 1.0), q)


@inlined
def print_intensity(u, v, wide, high, r, k, black, least, space, seen):
    """Fills ``seen`` (6,): G_k(S) at (u, v), its derivatives by u, v, ln blur and k; how steep S is, a sigma.

    ``wide`` is the sigma of the blur along u, ``high`` along v, ``r`` their correlation; ``black`` (n, n) is
    1 where the print is black, ``space`` work space.  Where S is less steep than ``least``, nothing but that
    is wanted; False there.
    """
    n = black.shape[0]
    if least > 0.0:
        # Far from every border between cells, which most pixels are.
        x, y = (u + 0.5) * n, (v + 0.5) * n
        if abs(x - math.floor(x + 0.5)) > _NO_SLOPE * wide * n and abs(y - math.floor(y + 0.5)) > (
            _NO_SLOPE * high * n
        ):
            return False
    # A literal number as an argument would be compiled for itself.
    left, right = cell_shares(u, wide, n, space, types.int64(_CELLS))
    top, bottom = cell_shares(v, high, n, space, _CELLS + 3)
    white, by_u, by_v, by_blur = 1.0, 0.0, 0.0, 0.0
    for j in range(top, bottom):
        d0, d1, d2 = space[_CELLS + 3, j], space[_CELLS + 4, j], space[_CELLS + 5, j]
        for i in range(left, right):
            if black[j, i] > 0.0:
                a0, a1, a2 = space[_CELLS, i], space[_CELLS + 1, i], space[_CELLS + 2, i]
                white -= a0 * d0 + r * (a1 * d1 + 0.5 * r * a2 * d2)
                by_u -= a1 * d0 - r * a2 * d1
                by_v -= a0 * d1 - r * a1 * d2
                by_blur += a2 * d0 + a0 * d2
    seen[5] = abs(by_u) + abs(by_v)
    if seen[5] < least:
        return False
    value, slope, by_k = 1.0, 0.0, 0.0
    if white <= _LEAST_SHARE:
        value = 0.0
    elif white < 1.0 - _LEAST_SHARE:
        t = normal_quantile(white)
        _, density = normal_at(t)
        value, by_k = normal_at(t + k)
        slope = by_k / density
    seen[0], seen[1], seen[2] = value, slope * by_u / wide, slope * by_v / high
    seen[3], seen[4] = slope * by_blur, by_k
    return True


@outlined
def collect_pixels(gray, lens, box, reach, fit, pixels):
    """Collects the pixels of a box that see the print; how many.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: (5,) whole pixels x0, y0, x1, y1; 2 or odd: one pixel in so many is taken, on a lattice.
        reach: Pixels beyond ± this (u and v) are not taken.
        fit: With TO_PRINT.
        pixels: (8, k) out; what exceeds the table is left out.
    """
    h, count, fx, fy, every = fit[TO_PRINT], 0, 1.0 / lens[FX], 1.0 / lens[FY], box[4]
    lattice = 1 if every == 2 else 2
    for py in range(box[1], box[3]):
        by, first = (py - lens[CY]) * fy, box[0] + (-box[0] - lattice * py) % every
        x, y = from_pixel(lens, float(first), float(py))
        for px in range(first, box[2], every):
            # One step of Newton's method from a pixel near by is exact to 1e-7.
            tx, ty, xx, xy, yy = distort_point(lens, x, y)
            area = 1.0 / (xx * yy - xy * xy)
            xx, xy, yy = xx * area, xy * area, yy * area
            ex, ey = tx - (px - lens[CX]) * fx, ty - by
            x, y = x - (yy * ex - xy * ey), y - (xx * ey - xy * ex)
            w = h[6] * x + h[7] * y + h[8]
            u, v = h[0] * x + h[1] * y + h[2], h[3] * x + h[4] * y + h[5]
            if w > 0.0 and max(abs(u), abs(v)) < reach * w and count < pixels.shape[1]:
                pixels[0, count], pixels[1, count] = x, y
                pixels[2, count], pixels[3, count] = yy * fx, -xy * fy
                pixels[4, count], pixels[5, count] = -xy * fx, xx * fy
                pixels[6, count], pixels[7, count] = gray[py, px], 1.0
                count += 1
            x, y = x + every * yy * fx, y - every * xy * fx
    return count


@outlined
def photometric_equations(pixels, count, black, fit, residuals):
    """Sums the normal equations of one marker; how many pixels were used.

    Args:
        pixels: (8, k) of ``collect_pixels``.  With DROP_FLAT those without information are left out.
        count: How many of them.
        black: (n, n) 1 where the print is black.
        fit: Its table; NORMAL out.
        residuals: (5, k) out: residuals of the pixels that were used, and where on the print these are.
    """
    x, h, numbers, normal = fit[X], fit[TO_PRINT], fit[NUMBERS], fit[NORMAL:]
    n, noise, every = int(numbers[SIZE]), numbers[NOISE], int(numbers[EVERY])
    seen, wider, basis = fit[_PRINT], fit[_WIDER], fit[_BASIS]
    cauchy = 1.0 / (CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    blur, k, alpha, halo = math.exp(x[BLUR]), x[SHIFT], x[HALO], numbers[HALO_WIDTH]
    blur2 = math.sqrt(blur * blur + halo * halo)
    part, dropping, flat = blur / blur2, numbers[DROP_FLAT] > 0.0, _SLOPE * blur
    for i in range(n + 1):
        for j in range(n + 1):
            normal[i, j] = 0.0
    used, first = 0, DARK if noise == 0.0 else 0
    h0, h1, h3, h4, h6, h7 = h[0], h[1], h[3], h[4], h[6], h[7]
    for p in range(0, count, every):
        ix, iy = pixels[0, p], pixels[1, p]
        xx, xy, yx, yy = pixels[2, p], pixels[3, p], pixels[4, p], pixels[5, p]
        w = 1.0 / (h6 * ix + h7 * iy + h[8])
        u, v = (h0 * ix + h1 * iy + h[2]) * w, (h3 * ix + h4 * iy + h[5]) * w
        # (u, v) by undistorted coordinates, then by pixels.
        ux, uy, vx, vy = (h0 - u * h6) * w, (h1 - u * h7) * w, (h3 - v * h6) * w, (h4 - v * h7) * w
        gux, guy, gvx, gvy = ux * xx + uy * yx, ux * xy + uy * yy, vx * xx + vy * yx, vx * xy + vy * yy
        wide, high = math.sqrt(gux * gux + guy * guy), math.sqrt(gvx * gvx + gvy * gvy)
        r = (gux * gvx + guy * gvy) / (wide * high)
        least = flat if dropping and p % _FLAT else 0.0
        if not print_intensity(u, v, wide * blur, high * blur, r, k, black, least, fit, seen):
            continue
        if dropping:
            for i in range(PIXEL_ROWS - 1):
                pixels[i, used] = pixels[i, p]
            pixels[7, used] = _FLAT if seen[5] < flat else 1.0
        white, by_u, by_v, by_blur, by_shift, by_halo = seen[0], seen[1], seen[2], seen[3], seen[4], 0.0
        if halo > 0.0:
            print_intensity(u, v, wide * blur2, high * blur2, r, k * part, black, 0.0, fit, wider)
            by_halo = white - wider[0]
            white += alpha * by_halo
            by_u += alpha * (by_u - wider[1])
            by_v += alpha * (by_v - wider[2])
            by_blur2 = wider[3] * part * part + wider[4] * k * part * (1.0 - part * part)
            by_blur += alpha * (by_blur - by_blur2)
            by_shift += alpha * (by_shift - wider[4] * part)
        basis[0], basis[1], basis[2], basis[3], basis[4], basis[5] = 1.0, u, v, u * u, u * v, v * v
        dark, contrast = 0.0, 0.0
        for i in range(3):
            dark += x[DARK + i] * basis[i]
            contrast += x[CONTRAST + i] * basis[i]
        if n > HALOED:
            for i in range(3):
                dark += x[CURVED + i] * basis[3 + i]
                contrast += x[CURVED + 3 + i] * basis[3 + i]
        residual = pixels[6, p] - dark - contrast * white
        at = used % BLOCK
        root = 1.0 / math.sqrt(1.0 + cauchy * residual * residual)
        light, pale = root * contrast, root * white
        gu, gv = light * by_u, light * by_v
        radial = gu * u + gv * v
        for i in range(3):
            b = basis[i]
            fit[i, at], fit[3 + i, at] = gu * b, gv * b
            fit[DARK + i, at], fit[CONTRAST + i, at] = root * b, pale * b
            if n > HALOED:
                b = basis[3 + i]
                fit[CURVED + i, at], fit[CURVED + 3 + i, at] = root * b, pale * b
        fit[6, at], fit[7, at] = radial * u, radial * v
        fit[BLUR, at], fit[SHIFT, at] = light * by_blur, light * by_shift
        if n > PLAIN:
            fit[HALO, at] = light * by_halo
        fit[n, at] = root * residual
        residuals[0, used], residuals[1, used], residuals[2, used] = residual, u, v
        used += 1
        if used % BLOCK == 0:
            add_products(fit, first, n, types.int64(BLOCK), normal)
    add_products(fit, first, n, used % BLOCK, normal)
    return used


@outlined
def add_products(rows, first, n, length, normal):
    """Adds to ``normal`` the products of the rows ``first`` to ``n``: sums along them, four at a time."""
    for i in range(first, n + 1):
        one = rows[i]
        for j in range(first, i + 1):
            other, total = rows[j], 0.0
            for p in range(length):
                total += one[p] * other[p]
            normal[i, j] += total


@outlined
def system(fit):
    """Fills SYSTEM, the equations with what is known beforehand (lower triangle); STEP is the right side."""
    n, noise, x = int(fit[NUMBERS, SIZE]), fit[NUMBERS, NOISE], fit[X]
    for i in range(n):
        weight = noise * noise * fit[PRIOR_INFORMATION, i]
        right = fit[NORMAL + n, i] + weight * (fit[PRIOR_MEAN, i] - x[i])
        if i == BLUR and x[i] <= LEAST_LN_BLUR and right < 0.0:
            weight = FIXED_INFORMATION
        for j in range(i):
            fit[SYSTEM + i, j] = fit[NORMAL + i, j]
        fit[SYSTEM + i, i] = fit[NORMAL + i, i] * (1.0 + 1e-10) + 1e-12 + weight
        fit[SYSTEM + n, i] = fit[STEP, i] = right


@outlined
def gauss_newton_step(fit):
    """Moves the unknowns, a corner never far at once.

    Returns:
        By how much that lessens the sum of squares, infinity where there is no step; and how far the
        unknowns moved, in parts of the tolerances.
    """
    n, x, h, step = int(fit[NUMBERS, SIZE]), fit[X], fit[TO_PRINT], fit[STEP]
    system(fit)
    if not eliminate(fit[SYSTEM:_CELLS], step, n):
        return math.inf, math.inf
    gain, farthest = 0.0, 1e-12
    for i in range(n):
        gain += fit[SYSTEM + n, i] * step[i]
    for i in range(8):
        move = 0.0
        for j in range(HOMOGRAPHY):
            move += fit[BY_UNKNOWN + i, j] * step[j]
        farthest = max(farthest, abs(move))
    part = min(1.0, _CORNER_STEP / farthest)
    for i in range(3):
        a, b, w = h[i], h[3 + i], h[6 + i]
        h[i] = a + part * (step[1] * a + step[2] * b + step[0] * w)
        h[3 + i] = b + part * (step[4] * a + step[5] * b + step[3] * w)
        h[6 + i] = w - part * (step[6] * a + step[7] * b)
    far = max(abs(step[BLUR]), abs(step[SHIFT]))
    if n > PLAIN:
        far = max(far, abs(step[HALO]))
    step[BLUR] = min(max(step[BLUR], -_BLUR_STEP), _BLUR_STEP)
    step[SHIFT] = min(max(step[SHIFT], -_SHIFT_STEP), _SHIFT_STEP)
    for i in range(BLUR, n):
        x[i] += step[i]
    x[BLUR] = max(x[BLUR], LEAST_LN_BLUR)
    x[SHIFT] = min(max(x[SHIFT], -_LARGEST_SHIFT), _LARGEST_SHIFT)
    x[HALO] = min(max(x[HALO], -0.5), _LARGEST_HALO)
    return gain, max(farthest / _CORNER_TOLERANCE, far / _PARAMETER_TOLERANCE)


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
def gauss_newton(pixels, count, black, fit, residuals, steps):
    """Gauss and Newton's steps, so many at most, until they are small: CONVERGED says whether they became so.

    Arguments are as in ``photometric_equations``.  Out come, in NORMAL of ``fit``, the equations before the
    last step; in ``residuals`` (5, k) those before the last step, positions, those before the first one.
    """
    numbers, sizes = fit[NUMBERS], residuals[4]
    for iteration in range(steps + 1):
        used = photometric_equations(pixels, count, black, fit, residuals)
        numbers[USED] = used
        if iteration == steps or used == 0:
            return
        if numbers[DROP_FLAT] > 0.0:
            count, numbers[DROP_FLAT] = used, 0.0
        noise = numbers[NOISE]
        for p in range(used):
            sizes[p] = abs(residuals[0, p])
            if iteration == 0:
                residuals[3, p] = residuals[0, p]
        if iteration < _NOISE_ROUNDS:
            numbers[NOISE] = max(1.4826 * median_of(sizes, used), LEAST_NOISE)
        gain, move = gauss_newton_step(fit)
        size = math.sqrt(max(gain, 0.0)) / numbers[NOISE]
        if not size + fit[X, BLUR] + abs(fit[TO_PRINT, 0]) < math.inf:
            numbers[CONVERGED] = 0.0
            return
        numbers[CONVERGED] = 1.0 if size < _LARGEST_LAST_STEP else 0.0
        if size < _STEP_TOLERANCE or (move < 1.0 and noise < ANY_NOISE and numbers[NOISE] < _GROWN * noise):
            numbers[CONVERGED] = 1.0
            return
