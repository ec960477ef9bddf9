"""Marker corners from all of the print, in the picture's own grey values, whatever the camera did to them.

The borders between the black and white cells of a marker are as sharp as its sides, and there are many more
of them.  ``corner_refinement`` takes the place where grey is half way between black and white for an edge.
That is right for a camera whose grey values are proportional to light.  Webcams, telephones and JPEG files
have a tone curve; bloom and ink that bleeds do the same: the half way moves, mostly into the black, by a part
of the blur, and every marker looks smaller than it is.  Since the print has black cells in white and white
cells in black, it says by how much: the shift is one more unknown of the fit.

Model of the grey value of a pixel that sees the print at (u, v), in sides of the marker, rows downwards:

    I = dark(u, v) + contrast(u, v) * G_k(S(u, v)),        G_k(S) = N(N^-1(S) + k)

S is the print, 0 black and 1 white, blurred by a Gaussian of the picture; N is the normal distribution; k is
the shift of an edge into the black, in sigmas of the blur.  Light and contrast are linear, or quadratic where
the residuals ask for it.  Where they ask for that, the picture has been sharpened by a share a:

    (1 + a) G_k(S) - a G_k'(S'),        S' of the blur s'^2 = s^2 + h^2,     k' = k s / s'

A cell's share of S is an integral of a Gaussian over a rectangle.  Seen aslant, the Gaussian's u and v are
correlated; the integral is then a series in the correlation r, whose terms are products of differences along
u and v: of error functions, of r times bells, of r^2 / 2 times bells times their places, ….
Source: Pearson, Mathematical contributions to the theory of evolution VII, Phil. Trans. R. Soc. A 195, 1900.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.corner_refinement import RefinedCorners
from robot_ik.camera.detection import Image, correctable, to_gray
from robot_ik.camera.edge_fit import median_of
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, distort_point, from_pixel, lens_vector
from robot_ik.kernels.jit import announce, kernel, outlined, pure
from robot_ik.kernels.linalg import eliminate

# ------------------------------------------------------------------------------------------
# What is summed over the pixels of a marker's print, compiled.


# Unknowns: eight of the homography, ln blur (px), edge shift, three each of dark and contrast; then halo, and
# three more each of dark and contrast where light is quadratic.  A fit has the first 16, 17 or 23 of them.
HOMOGRAPHY, BLUR, SHIFT, DARK, CONTRAST, HALO, CURVED = 8, 8, 9, 10, 13, 16, 17
PLAIN, HALOED, UNKNOWNS = 16, 17, 23
# What is kept of a pixel: undistorted coordinates, their derivative by pixels (symmetric but for the focal
# lengths), grey value, how many pixels it stands for.
PIXEL_ROWS = 8
# What is kept of a residual: its size in grey levels, u and v, what it was before the first step, work space.
MISS_ROWS = 5
# Of a fit: noise in grey levels (0: dark and contrast alone); one pixel in EVERY is used; whether pixels that
# tell nothing are left out; blur that sharpening subtracts, px (0: no halo).  Out: how many were used,
# whether steps became small.
NOISE, EVERY, TO_DROP, HALO_WIDTH, USED, AT_REST = 0, 1, 2, 3, 4, 5
FIT_NUMBERS = 6
# Trust in what stays as it is.
HELD = 1e15
# Rows of the work space: those of some pixels, so many at a time; equations; system; shares of cells along u
# and v; the print with and without the halo's blur; (1, u, v, uu, uv, vv); step.
_BLOCK = 64
_SYSTEM, _CELLS, _PRINT, _WIDER, _BASIS, _STEP = 24, 48, 54, 55, 56, 57
SPACE_ROWS = 58
# Beyond so many standard deviations an edge is no longer felt.
_FAR = 3.2
# Residuals beyond this many standard deviations lose weight (Cauchy's function).
_CAUCHY = 4.0
# Where hardly anything changes (parts of the contrast a pixel), light is all there is to see: of such pixels
# one in so many is enough.
_FLAT, _SLOPE = 6, 0.06
# Of a blur of so many sigmas nothing is left that is steeper.
_NO_SLOPE = 2.4
# Least share of black or white: beyond, the inverse of the normal distribution says nothing.
_LEAST_SHARE = 1e-5
# Blur that sharpening subtracts, px: unsharp masks of webcams and telephones are narrow, those of programs
# wider.
_HALO_BLURS = (1.2, 2.0, 3.0)
# White round the black square that is looked at, in cells.
_ROUND = 0.45
# So many pixels say whether the model needs more unknowns.
_ASKED = 800
# Steps at most; one so small, in standard deviations, is the last; a fit that does not come below that one
# is none.
_STEPS, _DONE, _RESTLESS = 14, 0.2, 0.5
# So is one that moves no corner by more than this, px, and ln blur, edge shift and halo not more than that:
# the model is straight enough there for the place where it ends.
_NEAR, _ALIKE = 0.05, 0.05
# Where noise grows by more than this, the fit is not yet where it should be.
_GROWN = 1.3
# Pixels of a fit at least: twice the unknowns.
_LEAST_PIXELS = 2 * HALOED
# Rounds in which noise is still estimated anew: later it would keep the fit from coming to rest.
_NOISE_ROUNDS = 5
# A step at most: px at a corner, ln blur, edge shift.
_CORNER_STEP, _BLUR_STEP, _SHIFT_STEP = 1.5, 0.4, 0.5
# Blur of an edge, px: the pixel's own width is the least.  What it is believed to be before it is measured,
# as ln.
_BLUR, _LEAST_LN_BLUR, _BLUR_SPREAD = 0.8, math.log(0.29), 0.6
# A corner may go so far from where it was found: px, part of the side.  The detector's sharp corners of a
# strongly tilted marker are off by a tenth; a print that is shifted by a cell explains nothing.
_FARTHEST, _FARTHEST_PART = 3.0, 0.2
#: Edge shift and its spread for a camera of which nothing is known: none for a linear one, 0.5 for sRGB.
UNKNOWN_SHIFT = (0.25, 0.35)
# Spread of the edge shift between the markers of a picture (light, printing).
_SHIFT_ALIKE = 0.08
# Least standard deviation of corners, px, and of the edge shift by side lines, as a part of it.
_LEAST_SIGMA, _SHIFT_PART = 0.01, 0.05
# Noise of a pixel, grey levels: quantisation; and so much that all pixels weigh the same.
_LEAST_NOISE, _ANY_NOISE = 0.3, 1e4
# Of a print that is believed: contrast in grey levels, and part of the variance that the model explains.
_LEAST_CONTRAST, _EXPLAINED = 5.0, 0.75
# Quadratic light and a halo are taken where they lessen the sum of squares by these parts: by chance it is a
# hundredth.  Mild sharpening (0.6) gives 0.01 to 0.04 and does no harm; strong (1.5) gives 0.06 to 0.13.
_LIGHT_ASKED, _HALO_ASKED = 0.03, 0.05
# Halo of the strongest sharpening; beyond any edge shift that the model is good for.
_MOST_HALO, _MOST_SHIFT = 3.0, 2.0
# Corners of the print as (u, v, 1), and (4, 2, 8) how u and v there follow the unknowns of the homography.
_CORNERS = np.array([[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.0], [-0.5, 0.5, 1.0]])
_BY_UNKNOWN = np.array(
    [[[1, u, v, 0, 0, 0, u * u, u * v], [0, 0, 0, 1, u, v, u * v, v * v]] for u, v, _ in _CORNERS]
)
# Unknowns of a fit as it is, with light that is curved, with a halo.
_MODELS_ASKED = tuple(
    np.array([*range(PLAIN), *more]) for more in ((), range(CURVED, UNKNOWNS), range(HALO, HALOED))
)


# The normal distribution and its bell at so many places a sigma: Taylor's series from the nearest one is
# exact to 1e-7, and takes a third of the time of an error function and an exponential.
_PLACES, _REACH = 64, 8.0
_AT = np.arange(-_REACH * _PLACES, _REACH * _PLACES + 1) / _PLACES
_BELLS = np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
_BELOW = np.array([0.5 * math.erfc(-z * math.sqrt(0.5)) for z in _AT])


@pure
def normal_at(z):
    """The normal distribution and its bell at z, -8 to 8."""
    i = int(z * _PLACES + _REACH * _PLACES + 0.5)
    place = i / _PLACES - _REACH
    h, bell = z - place, _BELLS[i]
    bend = 0.5 * h * h * (place * place - 1.0)
    return _BELOW[i] + h * bell * (1.0 - 0.5 * h * place + bend / 3.0), bell * (1.0 - h * place + bend)


@pure
def cell_shares(place, width, count, shares, row):
    """Differences over the cells that are felt: of the normal distribution, its bell, and bell times place.

    They are written into three rows of ``shares``, from ``row`` on.

    Returns:
        The first of those cells and the one after the last.
    """
    inverse = 1.0 / width
    at, room, pitch = (place + 0.5) * count, _FAR * width * count, inverse / count
    first, last = max(math.floor(at - room), 0), min(math.floor(at + room) + 1, count)
    before, before_bell, before_z = 0.0, 0.0, 0.0
    for i in range(first, last + 1):
        z = (at - i) * pitch
        below, bell = (1.0 if z > 0.0 else 0.0), 0.0
        if abs(z) < _FAR:
            below, bell = normal_at(z)
        if i > first:
            shares[row, i - 1] = before - below
            shares[row + 1, i - 1] = before_bell - bell
            shares[row + 2, i - 1] = before_z * before_bell - z * bell
        before, before_bell, before_z = below, bell, z
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


@pure
def toned_print(u, v, wide, high, r, k, black, least, space, seen):
    """Fills ``seen``: G_k(S) at (u, v), its derivatives by u, v, ln blur and k; how steep S is, a sigma.

    Args:
        u: Place on the print, with ``v``.
        v: See ``u``.
        wide: Sigma of the blur along u; ``high`` along v; ``r`` their correlation.
        high: See ``wide``.
        r: See ``wide``.
        k: Edge shift.
        black: (n, n) 1 where the print is black.
        least: Where S is less steep than this, nothing but that is wanted.
        space: Work space.
        seen: (6,) out.

    Returns:
        Whether it is as steep.
    """
    n = black.shape[0]
    if least > 0.0:
        # Far from every border between cells, which most pixels are.
        x, y = (u + 0.5) * n, (v + 0.5) * n
        if abs(x - math.floor(x + 0.5)) > _NO_SLOPE * wide * n and abs(y - math.floor(y + 0.5)) > (
            _NO_SLOPE * high * n
        ):
            return False
    left, right = cell_shares(u, wide, n, space, _CELLS)
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
        _, bell = normal_at(t)
        value, by_k = normal_at(t + k)
        slope = by_k / bell
    seen[0], seen[1], seen[2] = value, slope * by_u / wide, slope * by_v / high
    seen[3], seen[4] = slope * by_blur, by_k
    return True


@kernel
def take_print(gray, lens, box, every, to_print, reach, pixels):
    """Collects the pixels of a box (x0, y0, x1, y1) that see the print; how many.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: Of whole pixels.
        every: 2 or odd: one pixel in so many is taken, on a lattice.
        to_print: (9,) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        reach: Pixels beyond ± this (u and v) are not taken.
        pixels: (8, k) out; what finds no room is left out.
    """
    h, count, fx, fy, lattice = to_print, 0, 1.0 / lens[FX], 1.0 / lens[FY], 1 if every == 2 else 2
    for py in range(box[1], box[3]):
        by, first = (py - lens[CY]) * fy, box[0] + (-box[0] - lattice * py) % every
        x, y = from_pixel(lens, first, py)
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


@kernel
def see_points(lens, normalized, pixels, slopes):
    """Pixels (n, 2) of undistorted coordinates (n, 2), and their derivative (n, 2, 2)."""
    for k in range(len(normalized)):
        x, y, xx, xy, yy = distort_point(lens, normalized[k, 0], normalized[k, 1])
        pixels[k, 0], pixels[k, 1] = lens[FX] * x + lens[CX], lens[FY] * y + lens[CY]
        slopes[k, 0, 0], slopes[k, 0, 1] = lens[FX] * xx, lens[FX] * xy
        slopes[k, 1, 0], slopes[k, 1, 1] = lens[FY] * xy, lens[FY] * yy


@outlined
def print_equations(pixels, count, black, to_print, x, unknowns, numbers, normal, space, misses):
    """Sums the normal equations of one marker; how many pixels were used.

    Args:
        pixels: (8, k) of ``take_print``.  With TO_DROP those that tell nothing are left out.
        count: How many of them.
        black: (n, n) 1 where the print is black.
        to_print: As in ``take_print``.
        x: (23,) unknowns; the first eight are not read.
        unknowns: How many the model has.
        numbers: Of the fit, see NOISE.
        normal: (24, 24) out: lower triangle, and the right side in the row after the unknowns.
        space: Work space.
        misses: (5, k) out: residuals of the pixels that were used, and where on the print these are.
    """
    n, h, noise, every = unknowns, to_print, numbers[NOISE], int(numbers[EVERY])
    seen, wider, basis = space[_PRINT], space[_WIDER], space[_BASIS]
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    blur, k, alpha, halo = math.exp(x[BLUR]), x[SHIFT], x[HALO], numbers[HALO_WIDTH]
    blur2 = math.sqrt(blur * blur + halo * halo)
    part, dropping, flat = blur / blur2, numbers[TO_DROP] > 0.0, _SLOPE * blur
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
        if not toned_print(u, v, wide * blur, high * blur, r, k, black, least, space, seen):
            continue
        if dropping:
            for i in range(PIXEL_ROWS - 1):
                pixels[i, used] = pixels[i, p]
            pixels[7, used] = _FLAT if seen[5] < flat else 1.0
        white, by_u, by_v, by_blur, by_shift, by_halo = seen[0], seen[1], seen[2], seen[3], seen[4], 0.0
        if halo > 0.0:
            toned_print(u, v, wide * blur2, high * blur2, r, k * part, black, 0.0, space, wider)
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
        miss = pixels[6, p] - dark - contrast * white
        at = used % _BLOCK
        root = 1.0 / math.sqrt(1.0 + cauchy * miss * miss)
        light, pale = root * contrast, root * white
        gu, gv = light * by_u, light * by_v
        along_way = gu * u + gv * v
        for i in range(3):
            b = basis[i]
            space[i, at], space[3 + i, at] = gu * b, gv * b
            space[DARK + i, at], space[CONTRAST + i, at] = root * b, pale * b
            if n > HALOED:
                b = basis[3 + i]
                space[CURVED + i, at], space[CURVED + 3 + i, at] = root * b, pale * b
        space[6, at], space[7, at] = along_way * u, along_way * v
        space[BLUR, at], space[SHIFT, at] = light * by_blur, light * by_shift
        if n > PLAIN:
            space[HALO, at] = light * by_halo
        space[n, at] = root * miss
        misses[0, used], misses[1, used], misses[2, used] = miss, u, v
        used += 1
        if used % _BLOCK == 0:
            add_products(space, first, n, _BLOCK, normal)
    add_products(space, first, n, used % _BLOCK, normal)
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
def take_step(normal, noise, x, unknowns, trust, expected, by_unknown, to_print, matrix, step):
    """Moves the unknowns, a corner never far at once.

    Returns:
        By how much that lessens the sum of squares, infinity where there is no step; and how far the
        unknowns moved, in parts of what is hardly any way.
    """
    n, h = unknowns, to_print
    for i in range(n):
        weight = noise * noise * trust[i]
        right = normal[n, i] + weight * (expected[i] - x[i])
        if i == BLUR and x[i] <= _LEAST_LN_BLUR and right < 0.0:
            weight = HELD
        for j in range(i):
            matrix[i, j] = normal[i, j]
        matrix[i, i] = normal[i, i] * (1.0 + 1e-10) + 1e-12 + weight
        matrix[n, i], step[i] = right, right
    if not eliminate(matrix, step, n):
        return math.inf, math.inf
    gain, farthest = 0.0, 1e-12
    for i in range(n):
        gain += matrix[n, i] * step[i]
    for i in range(8):
        way = 0.0
        for j in range(HOMOGRAPHY):
            way += by_unknown[i, j] * step[j]
        farthest = max(farthest, abs(way))
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
    x[BLUR] = max(x[BLUR], _LEAST_LN_BLUR)
    x[SHIFT] = min(max(x[SHIFT], -_MOST_SHIFT), _MOST_SHIFT)
    x[HALO] = min(max(x[HALO], -0.5), _MOST_HALO)
    return gain, max(farthest / _NEAR, far / _ALIKE)


@kernel
def settle(
    pixels,
    count,
    black,
    to_print,
    x,
    unknowns,
    trust,
    expected,
    by_unknown,
    numbers,
    normal,
    space,
    misses,
    steps,
):
    """Gauss and Newton's steps until they are small: AT_REST says whether they became so.

    Args:
        pixels: As in ``print_equations``, like all that is not named here.
        count: See ``pixels``.
        black: See ``pixels``.
        to_print: In and out.
        x: In and out.
        unknowns: See ``pixels``.
        trust: (23,) one over the variance of what is believed of an unknown beforehand; HELD: it stays.
        expected: (23,) what is believed.
        by_unknown: (8, 8) how the corners move, px, by the unknowns of the homography.
        numbers: In and out.
        normal: Out: the equations before the last step.
        space: (58, k) work space.
        misses: (5, k) out: residuals before the last step, places, residuals before the first one.
        steps: At most; 0: the equations alone are wanted.
    """
    matrix, step, sizes = space[_SYSTEM:_CELLS], space[_STEP], misses[4]
    for turn in range(steps + 1):
        used = print_equations(pixels, count, black, to_print, x, unknowns, numbers, normal, space, misses)
        numbers[USED] = used
        if turn == steps or used == 0:
            return
        if numbers[TO_DROP] > 0.0:
            count, numbers[TO_DROP] = used, 0.0
        noise = numbers[NOISE]
        for p in range(used):
            sizes[p] = abs(misses[0, p])
            if turn == 0:
                misses[3, p] = misses[0, p]
        if turn < _NOISE_ROUNDS:
            numbers[NOISE] = max(1.4826 * median_of(sizes, used), _LEAST_NOISE)
        gain, way = take_step(
            normal, numbers[NOISE], x, unknowns, trust, expected, by_unknown, to_print, matrix, step
        )
        size = math.sqrt(max(gain, 0.0)) / numbers[NOISE]
        if not size + x[BLUR] + abs(to_print[0]) < math.inf:
            numbers[AT_REST] = 0.0
            return
        numbers[AT_REST] = 1.0 if size < _RESTLESS else 0.0
        if size < _DONE or (way < 1.0 and noise < _ANY_NOISE and numbers[NOISE] < _GROWN * noise):
            numbers[AT_REST] = 1.0
            return


# ------------------------------------------------------------------------------------------
# The fit of all prints of a picture.


Array = NDArray[np.float64]


@dataclass(frozen=True)
class EdgeShift:
    """How far edges seem to lie in the black, in sigmas of the blur: what a camera's tone curve does.

    Attributes:
        value: 0 for a camera whose grey values are proportional to light, about 0.5 for sRGB.
        sigma: Standard deviation.
    """

    value: float = UNKNOWN_SHIFT[0]
    sigma: float = UNKNOWN_SHIFT[1]

    @classmethod
    def of(cls, intrinsics: CameraIntrinsics) -> EdgeShift:
        """What is known of a camera beforehand: by its calibration, if that has measured it."""
        if intrinsics.edge_shift is None:
            return cls()
        return cls(intrinsics.edge_shift, max(intrinsics.edge_shift_sigma or 0.0, _SHIFT_ALIKE))


@dataclass(frozen=True)
class PrintEffort:
    """How many pixels a fit uses.

    Attributes:
        looked_at: Of a print, about.
        fitted: Of those near an edge, at most.
    """

    looked_at: int = 9000
    fitted: int = 2200


#: Of a picture alone: more pixels make no marker better than the model is; and in films, which want to be
#: fast: the next picture comes soon.
SINGLE, FILM = PrintEffort(), PrintEffort(2500, 1000)


class _PrintFit:
    """The fit of one print: its unknowns, and what is known of them.

    Attributes:
        x: (23,) unknowns; the homography is in ``to_print``.
        unknowns: How many the model has; ``halo`` how wide a halo is among them, px, 0 without.
        halo: See ``unknowns``.
        to_print: (9,) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        pixels: (8, k), of which ``count`` are used.
        count: See ``pixels``.
        numbers: Noise and so on, see NOISE.
        misses: (5, k) residuals and their places on the print.
    """

    def __init__(self, black: Array, to_print: Array, by_unknown: Array, pixels: Array, count: int) -> None:
        self.black, self.to_print, self.by_unknown = black, to_print.ravel(), by_unknown
        self.pixels, self.count = pixels, count
        self.x, self.trust, self.expected = np.zeros(UNKNOWNS), np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
        self.trust[BLUR] = 1.0 / _BLUR_SPREAD**2
        self.numbers, self.normal = np.zeros(FIT_NUMBERS), np.zeros((24, 24))
        self.space = np.zeros((SPACE_ROWS, _BLOCK))
        self.misses = np.empty((MISS_ROWS, pixels.shape[1]))
        self.unknowns, self.halo = PLAIN, 0.0

    def believe(self, blur: float, shift: EdgeShift) -> None:
        """What is known beforehand."""
        self.expected[BLUR], self.expected[SHIFT] = math.log(blur), shift.value
        self.trust[SHIFT] = 1.0 / shift.sigma**2

    def model(self, unknowns: int, halo: float) -> None:
        """Which unknowns there are; how wide the halo is, px, 0 without."""
        self.unknowns, self.halo = unknowns, halo
        self.trust[HALO], self.numbers[HALO_WIDTH] = 0.0 if halo > 0.0 else HELD, halo

    def _sum(self, steps: int) -> None:
        settle(
            self.pixels, self.count, self.black, self.to_print, self.x, self.unknowns, self.trust,
            self.expected, self.by_unknown, self.numbers, self.normal, self.space, self.misses, steps,
        )  # fmt: skip

    @property
    def used(self) -> int:
        """How many pixels the residuals are of."""
        return int(self.numbers[USED])

    @property
    def noise(self) -> float:
        """Grey levels."""
        return float(self.numbers[NOISE])

    def resume(self, model: tuple[float, ...]) -> None:
        """Starts from where the fit of the last picture ended."""
        self.model(int(model[1]), model[2])
        self.numbers[NOISE], self.numbers[TO_DROP], self.x[BLUR:] = model[0], 1.0, model[3:]

    def light(self, blur: float, shift: float, most: int) -> bool:
        """Fits dark and contrast, which are linear, and keeps ``most`` of the pixels that tell something."""
        self.x[BLUR], self.x[SHIFT] = math.log(blur), shift
        self.numbers[NOISE], self.numbers[EVERY], self.numbers[TO_DROP] = 0.0, 1.0, 1.0
        self._sum(0)
        self.count, self.numbers[TO_DROP], self.numbers[NOISE] = self.used, 0.0, _ANY_NOISE
        if self.count < _LEAST_PIXELS:
            return False
        matrix, right = self._system()
        self.x[DARK:PLAIN] = np.linalg.solve(matrix[DARK:, DARK:], right[DARK:])
        if self.count > most:
            self.pixels = np.take(self.pixels, np.arange(most) * self.count // most, axis=1)
            self.count = most
        return True

    def settle(self) -> bool:
        """Gauss and Newton's steps; whether they became small."""
        self.numbers[EVERY] = 1.0
        self._sum(_STEPS)
        self.count = self.used
        return self.used >= _LEAST_PIXELS and bool(self.numbers[AT_REST])

    def _system(self) -> tuple[Array, Array]:
        """The equations with what is known beforehand: (n, n) and (n,)."""
        n, x = self.unknowns, self.x[: self.unknowns]
        matrix = self.normal[:n, :n] + self.normal[:n, :n].T
        weight = self.noise**2 * self.trust[:n]
        right = self.normal[n, :n] + weight * (self.expected[:n] - x)
        if x[BLUR] <= _LEAST_LN_BLUR and right[BLUR] < 0.0:
            weight[BLUR] = HELD
        diagonal = matrix.reshape(-1)[:: n + 1]
        diagonal *= 0.5 * (1.0 + 1e-10)
        diagonal += weight + 1e-12
        return matrix, right

    def ask_for_more(self) -> bool:
        """Whether the residuals ask for uneven light or for a halo, which are then part of the model."""
        self.numbers[EVERY] = (self.count + _ASKED - 1) // _ASKED
        most, width, curved = 0.0, 0.0, False
        for halo in _HALO_BLURS:
            self.model(UNKNOWNS, halo)
            self._sum(0)
            matrix, right = self._system()
            plain, by_light, by_halo = (
                float(right[some] @ np.linalg.solve(matrix[np.ix_(some, some)], right[some]))
                for some in _MODELS_ASKED
            )
            squares = self.squares()
            curved = by_light - plain > _LIGHT_ASKED * squares
            if by_halo - plain > max(most, _HALO_ASKED * squares):
                most, width = by_halo - plain, halo
            if width == 0.0:
                break  # where a narrow one lessens nothing a wide one does not either
        self.model(UNKNOWNS if curved else HALOED if width else PLAIN, width)
        return curved or width > 0.0

    def squares(self) -> float:
        """Sum of the squares of the residuals; what is far off counts as four standard deviations."""
        squares = self.misses[0, : self.used] ** 2
        return float(np.minimum(squares, (_CAUCHY * self.noise) ** 2).sum())

    def explained(self, *, before: bool = False) -> float:
        """Part of the variance of the grey values that the model explains, or did ``before`` the steps."""
        value, weight = self.pixels[6:, : self.count : 1 if before else int(self.numbers[EVERY])]
        miss, total = self.misses[3 if before else 0, : len(value)], float(weight.sum())
        off = value - weight @ value / total
        spread = float((weight * off) @ off)
        # Where hardly anything is to be seen nothing is there.
        return 1.0 - float((weight * miss) @ miss) / spread if spread > _LEAST_CONTRAST * total else 0.0

    def cells(self) -> tuple[int, float]:
        """How many cells the picture shows otherwise; squares of cells' residuals over those of noise."""
        n, (miss, u, v) = len(self.black), self.misses[:3, : self.used]
        # With a row and a column of what is outside on each side.
        column, row = (
            np.minimum(np.maximum((n * w + 0.5 * n + 1.0), 0.0), n + 1.0).astype(int) for w in (u, v)
        )
        cell, inside = (n + 2) * row + column, (slice(1, -1), slice(1, -1))
        total = np.bincount(cell, miss, (n + 2) ** 2).reshape(n + 2, n + 2)[inside]
        count = np.bincount(cell, minlength=(n + 2) ** 2).reshape(n + 2, n + 2)[inside]
        misread = int(np.count_nonzero(np.abs(total) > 0.5 * abs(self.x[CONTRAST]) * count))
        seen = max(int(np.count_nonzero(count)), 1)
        return misread, float((total**2 / np.maximum(count, 1)).sum()) / (seen * self.noise**2)

    def conclude(
        self,
        lens: Array,
        origin: tuple[int, int],
        start: RefinedCorners,
        other: RefinedCorners | None,
    ) -> RefinedCorners | None:
        """The corners, if they can be believed.

        Args:
            lens: ``lens_vector`` of the part of the picture that begins at ``origin``.
            origin: See ``lens``.
            start: Where the fit began.
            other: What was found without a halo, or in the last picture.
        """
        explained, x, (misread, uneven) = self.explained(), self.x, self.cells()
        if not x[CONTRAST] > max(_LEAST_CONTRAST, 1.5 * self.noise) or explained < _EXPLAINED:
            return None
        back = np.asarray(np.linalg.inv(self.to_print.reshape(3, 3)), dtype=float)
        normalized, depth = _places(back, _CORNERS)
        if not depth.min() > 0.0:
            return None
        corners, by_normalized = np.empty((4, 2)), np.empty((4, 2, 2))
        see_points(lens, normalized, corners, by_normalized)
        corners += origin
        (ax, ay), (bx, by) = (corners[2] - corners[0]).tolist(), (corners[3] - corners[1]).tolist()
        far = float(np.abs(corners - start.corners).max())
        if not far < max(_FARTHEST, _FARTHEST_PART * math.sqrt(0.5 * abs(ax * by - ay * bx))):
            return None
        covariance, sigma = self._uncertainty(uneven, corners, _corner_slopes(back, by_normalized))
        edges = math.exp(x[BLUR]), float(x[SHIFT]), sigma
        if self.halo > 0.0 and other is not None:
            # With a halo the model's edges are others than those that four sides see.
            edges = other.blur, other.edge_shift, other.edge_shift_sigma
        return RefinedCorners(
            corners, normalized, covariance, math.sqrt(covariance.trace() / 8), True, blur=edges[0],
            edge_shift=edges[1], edge_shift_sigma=edges[2], explained=explained, misread=misread,
            by_print=True, model=(self.noise, self.unknowns, self.halo, *x[BLUR:].tolist()),
        )  # fmt: skip

    def _uncertainty(self, uneven: float, corners: Array, slopes: Array) -> tuple[Array, float]:
        """Covariance (8, 8) of the corners, px^2; standard deviation of the edge shift."""
        variance = self.squares() / (self.used - self.unknowns)
        # Residuals that are alike all over a cell are no noise but a shadow's hard edge, glare, dirt: usual
        # pictures give 0.4 to 5 times what noise leaves of a cell's mean, squared; hard shadows 7 to 36.
        variance = max(variance, _LEAST_NOISE**2) * max(1.0, uneven - 1.0)
        inverse = variance * np.linalg.inv(self._system()[0])
        covariance = slopes @ inverse[:HOMOGRAPHY, :HOMOGRAPHY] @ slopes.T
        way = corners - corners.mean(axis=0)
        outward = (way / np.hypot(way[:, :1], way[:, 1:])).reshape(8)
        covariance += _LEAST_SIGMA**2 * (0.5 * np.eye(8) + np.outer(outward, outward))
        return covariance, math.sqrt(inverse[SHIFT, SHIFT])


def _homography(corners: Array) -> Array | None:
    """(3, 3) from the print to its corners (4, 2) (Heckbert, 1989); None where these are on one line."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners.tolist()
    ax, ay, bx, by = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    sx, sy, area = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3, (x1 - x2) * (y3 - y2) - (y1 - y2) * (x3 - x2)
    if not abs(area) > 0.0:
        return None
    g, h = (sx * by - bx * sy) / area, (ax * sy - sx * ay) / area
    a, b, d, e = x1 - x0 + g * x1, x3 - x0 + h * x3, y1 - y0 + g * y1, y3 - y0 + h * y3
    return np.array([[a, b, x0 + 0.5 * (a + b)], [d, e, y0 + 0.5 * (d + e)], [g, h, 1.0 + 0.5 * (g + h)]])


def _places(homography: Array, on_print: Array) -> tuple[Array, Array]:
    """Where places (n, 3) of the print, as (u, v, 1), are seen (n, 2), and their depth (n,)."""
    there = on_print @ homography.T
    return there[:, :2] / there[:, 2:], there[:, 2]


def _corner_slopes(homography: Array, lens: Array | None = None) -> Array:
    """(8, 8) how the corners move by the unknowns of the homography; times ``lens`` (4, 2, 2)."""
    corners, depth = _places(homography, _CORNERS)
    slopes = homography[:2, :2] - corners[:, :, None] * homography[2, :2]
    slopes /= -depth[:, None, None]
    if lens is not None:
        slopes = lens @ slopes
    return (slopes @ _BY_UNKNOWN).reshape(8, 8)


def _box(seen: Array, shape: tuple[int, ...], reach: float, most: int) -> tuple[Array, int] | None:
    """Whole pixels (x0, y0, x1, y1) round a print, and one in how many is looked at.

    Args:
        seen: (3, 3) from the print to pixels.
        shape: Of the picture.
        reach: Of the print, u and v to each side.
        most: About so many pixels are enough.

    Returns:
        None where the print is not in the picture.
    """
    (a, b, c), (d, e, f), (g, h, i) = seen.tolist()
    xs, ys, least = [], [], math.inf
    for u, v in ((-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)):
        depth = g * u + h * v + i
        least = min(least, depth)
        xs.append((a * u + b * v + c) / depth)
        ys.append((d * u + e * v + f) / depth)
    x0, y0, x1, y1 = min(xs), min(ys), max(xs), max(ys)
    height, width = shape
    if not (least > 0.0 and x1 > 0.0 and y1 > 0.0 and x0 < width - 1.0 and y0 < height - 1.0):
        return None
    area = 0.5 * abs((xs[2] - xs[0]) * (ys[3] - ys[1]) - (ys[2] - ys[0]) * (xs[3] - xs[1]))
    box = [
        max(math.floor(x0), 0),
        max(math.floor(y0), 0),
        min(math.ceil(x1) + 1, width),
        min(math.ceil(y1) + 1, height),
    ]
    share = area / most
    return np.array(box), max(int(share + 0.5), 1) if share < 2.5 else 2 * int(0.5 * share) + 1


def _begin(
    gray: Image,
    lens: Array,
    black: Array,
    corners: Array,
    normalized: Array,
    push: float,
    effort: PrintEffort,
) -> _PrintFit | None:
    """The pixels of a print whose sides lie ``push`` px outside of what was found; None where it is not."""
    back, seen = _homography(normalized), _homography(corners)
    if back is None or seen is None:
        return None
    reach = 0.5 + _ROUND / len(black)
    found = _box(seen, gray.shape, reach, effort.looked_at)
    if found is None:
        return None
    box, every = found
    try:
        to_print = np.asarray(np.linalg.inv(back), dtype=float)
    except np.linalg.LinAlgError:
        return None
    # At the middle (u, v) are 0, and the depth is back[2, 2].
    slopes = np.hypot(to_print[:2, 0] / lens[FX], to_print[:2, 1] / lens[FY]) * abs(back[2, 2])
    to_print[:2] /= (1.0 + 2.0 * push * slopes)[:, None]
    pixels = np.empty((PIXEL_ROWS, ((box[2] - box[0]) // every + 1) * (box[3] - box[1])))
    count = take_print(gray, lens, box, every, to_print.ravel(), reach, pixels)
    return _PrintFit(black, to_print, _corner_slopes(seen), pixels, count)


def refine_prints(
    image: Image,
    sides: Sequence[RefinedCorners],
    ids: Sequence[int],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    *,
    origin: tuple[int, int] = (0, 0),
    expected: EdgeShift | None = None,
    effort: PrintEffort = SINGLE,
    before: Mapping[int, RefinedCorners] = MappingProxyType({}),
) -> list[RefinedCorners]:
    """Corners of several markers by all of their prints.

    Where a print cannot be fitted its side lines are moved outwards by the edge shift of the others, or by
    the expected one, and are as uncertain as that.

    Args:
        image: (h, w) or (h, w, 3) uint8; or a part of the picture that holds the markers.
        sides: Corners by ``refine_markers``, to start from.
        ids: Of the markers.
        dictionary: Of all of them.
        intrinsics: Of the whole picture.
        origin: Pixel (x, y) of the whole picture at which the part begins.
        expected: Edge shift of this camera; None: as its calibration says.
        effort: How many pixels of a print are used.
        before: Of the last picture, by id: a fit starts from what was found there.
    """
    if not len(sides):
        return []
    announce(settle, "the fit of the markers' prints")
    gray, expected = np.ascontiguousarray(to_gray(image)), expected or EdgeShift.of(intrinsics)
    lens = lens_vector(intrinsics).copy()
    lens[[CX, CY]] -= origin
    fits = []
    for i, start in zip(ids, sides, strict=True):
        black, last = marker_black(dictionary, i), before.get(i)
        one = _fitted(gray, lens, black, start, origin, expected, effort, last)
        if last is not None and not one.by_print:
            one = _fitted(gray, lens, black, start, origin, expected, effort, None)
        fits.append(one)
    allowed = correctable(dictionary, strict=True)
    fits = [replace(one, misread=max(0, one.misread - allowed)) if one.misread else one for one in fits]
    shift = _common_shift([one for one in fits if one.by_print], expected)
    return [
        one if one.by_print or not one.refined else moved_outwards(one, shift, intrinsics) for one in fits
    ]


def is_print(corners: RefinedCorners) -> bool:
    """Whether the picture shows the marker's print there, and not something with a like code."""
    return corners.misread == 0 and not corners.explained < _EXPLAINED


def _common_shift(fitted: Sequence[RefinedCorners], expected: EdgeShift) -> EdgeShift:
    """The edge shift of a picture from that of its prints."""
    values = [(expected.value, expected.sigma), *((f.edge_shift, f.edge_shift_sigma) for f in fitted)]
    weights = np.array([1.0 / (sigma**2 + _SHIFT_ALIKE**2) for _, sigma in values])
    mean = float(weights @ [value for value, _ in values] / weights.sum())
    return EdgeShift(mean, math.sqrt(1.0 / weights.sum() + (_SHIFT_ALIKE**2 if fitted else 0.0)))


def moved_outwards(sides: RefinedCorners, shift: EdgeShift, intrinsics: CameraIntrinsics) -> RefinedCorners:
    """Corners whose side lines lie where the edges are: outwards by the edge shift."""
    along = np.roll(sides.corners, -1, axis=0) - sides.corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turn = np.sign(along[0, 0] * along[1, 1] - along[0, 1] * along[1, 0])
    normals = turn * np.stack([along[:, 1], -along[:, 0]], axis=1)
    both = np.stack([normals, np.roll(normals, 1, axis=0)], axis=1)
    by_push = np.linalg.solve(both, np.ones((4, 2, 1)))[..., 0]
    corners = sides.corners + shift.value * sides.blur * by_push
    far = sides.blur * math.hypot(shift.sigma, _SHIFT_PART * shift.value)
    wide = sides.covariance + (far**2 + _LEAST_SIGMA**2) * np.outer(by_push, by_push)
    return replace(
        sides, corners=corners, normalized=intrinsics.undistort(corners), covariance=wide,
        sigma=math.sqrt(wide.trace() / 8), edge_shift=shift.value, edge_shift_sigma=shift.sigma,
    )  # fmt: skip


@lru_cache(maxsize=256)
def marker_black(dictionary: str, marker_id: int) -> Array:
    """(n, n) cells of a marker with its border, 1 where they are black."""
    return np.ascontiguousarray(marker_bits(dictionary, marker_id) == 0, dtype=float)


def _fitted(
    gray: Image,
    lens: Array,
    black: Array,
    start: RefinedCorners,
    origin: tuple[int, int],
    expected: EdgeShift,
    effort: PrintEffort,
    before: RefinedCorners | None,
) -> RefinedCorners:
    """Corners by one print; where that fails those of the sides, with how much the print explains."""
    blur, push = (start.blur, start.blur * expected.value) if start.refined else (_BLUR, 0.0)
    if before is not None and start.refined:
        push = before.blur * before.edge_shift
    fit = _begin(gray, lens, black, start.corners - origin, start.normalized, push, effort)
    if fit is None:
        return replace(start, explained=math.nan, misread=0)
    fit.believe(blur, expected)
    if before is not None and before.model is not None:
        fit.resume(before.model)
    elif not fit.light(blur, expected.value, effort.fitted):
        return replace(start, explained=math.nan, misread=0)
    found = None
    for more in (False, True):
        if more and not fit.ask_for_more():
            break
        fine = fit.settle()
        if fine:
            found = fit.conclude(lens, origin, start, found or before) or found
        if not fine or before is not None:
            break
    if found is not None:
        return found
    if fit.used < _LEAST_PIXELS:
        return replace(start, explained=math.nan, misread=0)
    explained = max(fit.explained(before=True), fit.explained())
    return replace(start, explained=explained, misread=fit.cells()[0])
