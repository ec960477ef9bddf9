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

    (1 + a) G_k(S) - a G_k'(S'),        S' of the blur s'^2 = s^2 + 1.2^2,     k' = k s / s'

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
from robot_ik.kernels.jit import announce, kernel, outlined
from robot_ik.kernels.linalg import solve_definite

# ------------------------------------------------------------------------------------------
# The fit of a marker's whole print, compiled.


# Unknowns: eight of the homography, ln blur, edge shift, halo; then dark and contrast, 3 or 6 numbers each.
HOMOGRAPHY, BLUR, SHIFT, HALO, LIGHT = 8, 8, 9, 10, 11
LINEAR, QUADRATIC = 3, 6
# What is kept of a pixel: undistorted coordinates, their derivative by pixels (symmetric but for the focal
# lengths), grey value, how many pixels it stands for.
PIXEL_ROWS = 8
# What is known beforehand: edge shift, its standard deviation, blur of the sides (px); how far out of the
# sides to start (px), with what noise and terms of the light; how many pixels are looked at, and fitted;
# whether the residuals are asked for more unknowns; blur, edge shift, halo and light to start with.
KNOWN_SHIFT, KNOWN_SIGMA, KNOWN_BLUR, PUSH, START_NOISE, START_TERMS = 0, 1, 2, 3, 4, 5
LOOKED_AT, FITTED, ASK, START = 6, 7, 8, 9
KNOWN_NUMBERS = START + 15
# What was found: whether; blur, shift and its standard deviation, without a halo; part of the variance that
# is explained; misread cells; noise, terms of the light, whether there is a halo; how sums were made; how
# much the cells' mean residuals are in units of what noise alone leaves.
FOUND, PLAIN_BLUR, PLAIN_SHIFT, SHIFT_SIGMA, EXPLAINED, MISREAD = 0, 1, 2, 3, 4, 5
NOISE, TERMS, WITH_HALO, AT_START, USED, EVERY, TO_DROP, UNEVEN = 6, 7, 8, 9, 10, 11, 12, 13
ANSWER_NUMBERS = 14
# Rows of the work space: those of some pixels, so many at a time; equations; system; shares of cells along u
# and v; shares and tones; unknowns that are held; step; places of the corners; how they follow the unknowns.
_BLOCK = 64
NORMAL, MATRIX, ALONG, DOWN, SHARES, HELD, STEP, PLACES, SLOPES = 24, 48, 72, 75, 78, 82, 83, 84, 88
SPACE_ROWS = 96
# Beyond so many standard deviations an edge is no longer felt.
_FAR = 3.2
# Residuals beyond this many standard deviations lose weight (Cauchy's function).
_CAUCHY = 4.0
# Where hardly anything changes (parts of the contrast a pixel), light is all there is to see: of such pixels
# one in so many is enough.
_FLAT, _SLOPE = 6, 0.06
# Least share of black or white: beyond, the inverse of the normal distribution says nothing.
_LEAST_SHARE = 1e-5
# Blur that sharpening subtracts, px: unsharp masks of webcams and telephones are narrow.
_HALO_BLUR = 1.2
# White round the black square that is looked at, in cells.
_ROUND = 0.45
# So many pixels say whether the model needs more unknowns; the first steps use one in so many.
_ASKED, _COARSE = 800, 3
# Steps at most; one so small, in standard deviations, is the last; a fit that does not come below that one
# is none.
_STEPS, _DONE, _RESTLESS = 14, 0.2, 0.5
# So is one that moves no corner by more than this, px, and ln blur, edge shift and halo not more than that:
# the model is straight enough there for the place where it ends.
_NEAR, _ALIKE = 0.05, 0.05
# Where noise grows by more than this, the fit is not yet where it should be.
_GROWN = 1.3
# Pixels of a fit at least: twice the unknowns.
_LEAST_PIXELS = 2 * (11 + 2 * 3)
# Rounds in which noise is still estimated anew: later it would keep the fit from coming to rest.
_NOISE_ROUNDS = 5
# A step at most: px at a corner, ln blur, edge shift.
_CORNER_STEP, _BLUR_STEP, _SHIFT_STEP = 1.5, 0.4, 0.5
# Blur of an edge, px: the pixel's own width is the least.  What it is believed to be before it is measured,
# as ln.
_BLUR, _LEAST_BLUR, _BLUR_SPREAD = 0.8, 0.29, 0.6
# A corner may go so far from where its sides were found: px, part of the side.
_FARTHEST, _FARTHEST_PART = 3.0, 0.1
#: Edge shift and its spread for a camera of which nothing is known: none for a linear one, 0.5 for sRGB.
UNKNOWN_SHIFT = (0.25, 0.35)
# Spread of the edge shift between the markers of a picture (light, printing).
_SHIFT_ALIKE = 0.08
# Least standard deviation of corners, px, and of the edge shift by side lines, as a part of it.
_LEAST_SIGMA, _SHIFT_PART = 0.01, 0.05
# What print, paper and lens leave, as a part of the standard deviation from noise alone.
_MODEL = 0.25
# Residuals that are alike all over a cell are no noise but a shadow's hard edge, glare, dirt.  In squares of
# what noise leaves of a cell's mean: usual pictures give 0.4 to 5, hard shadows over the print 7 to 36.
_UNEVEN = 4.0
# Noise of a pixel, grey levels: quantisation; and so much that all pixels weigh the same.
_LEAST_NOISE, _ANY_NOISE = 0.3, 1e4
# Of a print that is believed: contrast in grey levels, and part of the variance that the model explains.
_LEAST_CONTRAST, _EXPLAINED = 5.0, 0.75
# Quadratic light and a halo are taken where they lessen the sum of squares by these parts: by chance it is a
# hundredth.  Mild sharpening (0.6) gives 0.01 to 0.04 and does no harm; strong (1.5) gives 0.06 to 0.13.
_LIGHT_ASKED, _HALO_ASKED = 0.03, 0.05
# Halo of the strongest sharpening; beyond any edge shift that the model is good for.
_MOST_HALO, _MOST_SHIFT = 3.0, 2.0
_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


# The normal distribution and its bell at so many places a sigma: Taylor's series from the nearest one is
# exact to 1e-7, and takes a third of the time of an error function and an exponential.
_PLACES, _REACH = 64, 8.0
_AT = np.arange(-_REACH * _PLACES, _REACH * _PLACES + 1) / _PLACES
_BELLS = np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
_BELOW = np.array([0.5 * math.erfc(-z * math.sqrt(0.5)) for z in _AT])


@outlined
def normal_at(z):
    """The normal distribution and its bell at z, -8 to 8."""
    i = int(z * _PLACES + _REACH * _PLACES + 0.5)
    place = i / _PLACES - _REACH
    h, bell = z - place, _BELLS[i]
    bend = 0.5 * h * h * (place * place - 1.0)
    return _BELOW[i] + h * bell * (1.0 - 0.5 * h * place + bend / 3.0), bell * (1.0 - h * place + bend)


@outlined
def cell_shares(place, width, count, shares):
    """Differences over the cells that are felt: of the normal distribution, its bell, and bell times place.

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
            shares[0, i - 1] = before - below
            shares[1, i - 1] = before_bell - bell
            shares[2, i - 1] = before_z * before_bell - z * bell
        before, before_bell, before_z = below, bell, z
    return first, last


@outlined
def blurred_print(u, v, wide, high, r, black, along, down, share):
    """Fills ``share``: white at (u, v), its derivatives by u, by v, by ln blur.

    Args:
        u: Place on the print, with ``v``.
        v: See ``u``.
        wide: Sigma of the blur along u; ``high`` along v; ``r`` their correlation.
        high: See ``wide``.
        r: See ``wide``.
        black: (n, n) 1 where the print is black.
        along: (3, n) work space, as ``down``.
        down: See ``along``.
        share: (4,) out.
    """
    n = black.shape[0]
    left, right = cell_shares(u, wide, n, along)
    top, bottom = cell_shares(v, high, n, down)
    white, by_u, by_v, by_blur = 1.0, 0.0, 0.0, 0.0
    for j in range(top, bottom):
        d0, d1, d2 = down[0, j], down[1, j], down[2, j]
        for i in range(left, right):
            if black[j, i] == 0.0:
                continue
            a0, a1, a2 = along[0, i], along[1, i], along[2, i]
            white -= a0 * d0 + r * (a1 * d1 + 0.5 * r * a2 * d2)
            by_u -= a1 * d0 - r * a2 * d1
            by_v -= a0 * d1 - r * a1 * d2
            by_blur += a2 * d0 + a0 * d2
    share[0] = min(max(white, _LEAST_SHARE), 1.0 - _LEAST_SHARE)
    share[1], share[2], share[3] = by_u / wide, by_v / high, by_blur


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


@outlined
def toned(share, k, tone):
    """Fills ``tone`` (3,): G_k of a share of white, its derivatives by the share and by k."""
    if share <= _LEAST_SHARE or share >= 1.0 - _LEAST_SHARE:
        tone[0], tone[1], tone[2] = 1.0 if share > 0.5 else 0.0, 0.0, 0.0
        return
    t = normal_quantile(share)
    _, bell = normal_at(t)
    tone[0], tone[2] = normal_at(t + k)
    tone[1] = tone[2] / bell


@outlined
def take_print(gray, lens, box, every, to_print, reach, pixels):
    """Collects the pixels of a box (x0, y0, x1, y1) that see the print; how many.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: Of whole pixels.
        every: Odd: one pixel in so many is taken, on a lattice.
        to_print: (3, 3) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        reach: Pixels beyond ± this (u and v) are not taken.
        pixels: (8, k) out; what finds no room is left out.
    """
    count = 0
    for py in range(box[1], box[3]):
        by, first = (py - lens[CY]) / lens[FY], box[0] + (-box[0] - 2 * py) % every
        x, y = from_pixel(lens, first, py)
        for px in range(first, box[2], every):
            # One step of Newton's method from a pixel near by is exact to 1e-7.
            tx, ty, xx, xy, yy = distort_point(lens, x, y)
            area = 1.0 / (xx * yy - xy * xy)
            ex, ey = tx - (px - lens[CX]) / lens[FX], ty - by
            x, y = x - (yy * ex - xy * ey) * area, y - (xx * ey - xy * ex) * area
            w = to_print[2, 0] * x + to_print[2, 1] * y + to_print[2, 2]
            u = (to_print[0, 0] * x + to_print[0, 1] * y + to_print[0, 2]) / w
            v = (to_print[1, 0] * x + to_print[1, 1] * y + to_print[1, 2]) / w
            if abs(u) < reach and abs(v) < reach and w > 0.0 and count < pixels.shape[1]:
                pixels[0, count], pixels[1, count] = x, y
                pixels[2, count], pixels[3, count] = yy * area / lens[FX], -xy * area / lens[FY]
                pixels[4, count], pixels[5, count] = -xy * area / lens[FX], xx * area / lens[FY]
                pixels[6, count], pixels[7, count] = gray[py, px], 1.0
                count += 1
            x, y = x + every * yy * area / lens[FX], y - every * xy * area / lens[FX]
    return count


@outlined
def print_equations(pixels, count, black, to_print, x, answer, space, misses):
    """Sums the normal equations of one marker.

    Args:
        pixels: (8, k) of ``take_print``.  With TO_DROP those that tell nothing are left out.
        count: How many of them.
        black: (n, n) 1 where the print is black.
        to_print: As in ``take_print``.
        x: (15,) blur in px, edge shift, halo, then dark and contrast, 6 numbers each.
        answer: Of the model: TERMS, WITH_HALO, NOISE (0: light alone); one pixel in EVERY is used.  USED is
            written.
        space: Work space; its rows ``NORMAL`` take the result: lower triangle, and the right side in the row
            after the unknowns.
        misses: (2, k) out: residuals of the pixels that were used.
    """
    rows, normal, along, down = space[0:NORMAL], space[NORMAL:MATRIX], space[ALONG:DOWN], space[DOWN:SHARES]
    share, tone, wider, paler = space[SHARES], space[SHARES + 1], space[SHARES + 2], space[SHARES + 3]
    terms, halo, noise, every = int(answer[TERMS]), answer[WITH_HALO] > 0.0, answer[NOISE], int(answer[EVERY])
    n = LIGHT + 2 * terms
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    blur2 = math.sqrt(x[0] * x[0] + _HALO_BLUR * _HALO_BLUR)
    part = x[0] / blur2
    k, k2, alpha = x[1], x[1] * part, x[2]
    for i in range(n + 1):
        for j in range(n + 1):
            normal[i, j] = 0.0
    used, first = 0, LIGHT if noise == 0.0 else 0
    for p in range(0, count, every):
        ix, iy = pixels[0, p], pixels[1, p]
        w = 1.0 / (to_print[2, 0] * ix + to_print[2, 1] * iy + to_print[2, 2])
        u = (to_print[0, 0] * ix + to_print[0, 1] * iy + to_print[0, 2]) * w
        v = (to_print[1, 0] * ix + to_print[1, 1] * iy + to_print[1, 2]) * w
        # (u, v) by undistorted coordinates, then by pixels.
        ux, uy = (to_print[0, 0] - u * to_print[2, 0]) * w, (to_print[0, 1] - u * to_print[2, 1]) * w
        vx, vy = (to_print[1, 0] - v * to_print[2, 0]) * w, (to_print[1, 1] - v * to_print[2, 1]) * w
        gux, guy = ux * pixels[2, p] + uy * pixels[4, p], ux * pixels[3, p] + uy * pixels[5, p]
        gvx, gvy = vx * pixels[2, p] + vy * pixels[4, p], vx * pixels[3, p] + vy * pixels[5, p]
        wide, high = math.sqrt(gux * gux + guy * guy), math.sqrt(gvx * gvx + gvy * gvy)
        r = (gux * gvx + guy * gvy) / (wide * high)
        blurred_print(u, v, wide * x[0], high * x[0], r, black, along, down, share)
        if answer[TO_DROP] > 0.0:
            flat = abs(share[1] * gux + share[2] * gvx) + abs(share[1] * guy + share[2] * gvy) < _SLOPE
            if flat and p % _FLAT:
                continue
            for i in range(6 + 1):
                pixels[i, used] = pixels[i, p]
            pixels[7, used] = _FLAT if flat else 1.0
        toned(share[0], k, tone)
        white, by_u, by_v = tone[0], tone[1] * share[1], tone[1] * share[2]
        by_blur, by_shift, by_halo = tone[1] * share[3], tone[2], 0.0
        if halo:
            blurred_print(u, v, wide * blur2, high * blur2, r, black, along, down, wider)
            toned(wider[0], k2, paler)
            by_halo = white - paler[0]
            white += alpha * by_halo
            by_u += alpha * (by_u - paler[1] * wider[1])
            by_v += alpha * (by_v - paler[1] * wider[2])
            by_blur2 = paler[1] * wider[3] * part * part + paler[2] * k2 * (1.0 - part * part)
            by_blur += alpha * (by_blur - by_blur2)
            by_shift += alpha * (by_shift - paler[2] * part)
        dark = x[3] + u * (x[4] + u * x[6] + v * x[7]) + v * (x[5] + v * x[8])
        contrast = x[9] + u * (x[10] + u * x[12] + v * x[13]) + v * (x[11] + v * x[14])
        miss = pixels[6, p] - dark - contrast * white
        filled = used % _BLOCK
        root = 1.0 / math.sqrt(1.0 + cauchy * miss * miss)
        gu, gv, pale = root * contrast * by_u, root * contrast * by_v, root * white
        along_way = gu * u + gv * v
        rows[0, filled], rows[1, filled], rows[2, filled] = gu, gu * u, gu * v
        rows[3, filled], rows[4, filled], rows[5, filled] = gv, gv * u, gv * v
        rows[6, filled], rows[7, filled] = along_way * u, along_way * v
        rows[BLUR, filled], rows[SHIFT, filled] = root * contrast * by_blur, root * contrast * by_shift
        rows[HALO, filled] = root * contrast * by_halo
        rows[LIGHT, filled], rows[LIGHT + 1, filled], rows[LIGHT + 2, filled] = root, root * u, root * v
        i = LIGHT + terms
        rows[i, filled], rows[i + 1, filled], rows[i + 2, filled] = pale, pale * u, pale * v
        if terms > LINEAR:
            uu, uv, vv, i, j = u * u, u * v, v * v, LIGHT + LINEAR, LIGHT + terms + LINEAR
            rows[i, filled], rows[i + 1, filled], rows[i + 2, filled] = root * uu, root * uv, root * vv
            rows[j, filled], rows[j + 1, filled], rows[j + 2, filled] = pale * uu, pale * uv, pale * vv
        rows[n, filled] = root * miss
        misses[0, used] = miss
        used += 1
        if used % _BLOCK == 0:
            add_products(rows, first, n, _BLOCK + used - used, normal)
    add_products(rows, first, n, used % _BLOCK, normal)
    answer[USED] = used


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
def print_system(space, x, known, answer, unit):
    """Solves for the step of the unknowns that are not held, with what is believed beforehand.

    Args:
        space: Work space with the equations; HELD says 1 where an unknown stays as it is.  The step is in
            STEP.
        x: (15,) as there.
        known: What is believed.
        answer: Of the model: TERMS, NOISE.
        unit: A column of the inverse is wanted in place of the step; -1.0: the step.

    Returns:
        The right side times the step: by how much it lessens the sum of squares; NaN where there is none.
    """
    normal, matrix, held, step = space[NORMAL:MATRIX], space[MATRIX:ALONG], space[HELD], space[STEP]
    n, noise = LIGHT + 2 * int(answer[TERMS]), answer[NOISE]
    right = matrix[n]
    for i in range(n):
        right[i] = normal[n, i]
        for j in range(i + 1):
            matrix[i, j] = normal[i, j]
        matrix[i, i] += 1e-10 * matrix[i, i] + 1e-12
    trust = (noise / _BLUR_SPREAD) ** 2
    matrix[BLUR, BLUR] += trust
    right[BLUR] += trust * math.log(known[KNOWN_BLUR] / x[0])
    trust = (noise / known[KNOWN_SIGMA]) ** 2
    matrix[SHIFT, SHIFT] += trust
    right[SHIFT] += trust * (known[KNOWN_SHIFT] - x[1])
    for i in range(n):
        if held[i] > 0.0 or (i == BLUR and x[0] <= _LEAST_BLUR and right[BLUR] < 0.0):
            for j in range(n):
                matrix[max(i, j), min(i, j)] = 0.0
            matrix[i, i], right[i] = 1.0, 0.0
    for i in range(n):
        if unit >= 0.0:
            right[i] = 1.0 if i == unit else 0.0
        step[i] = right[i]
    if not solve_definite(matrix, step, n):
        return math.nan
    gain = 0.0
    for i in range(n):
        gain += right[i] * step[i]
    return gain


@outlined
def take_step(space, answer, to_print, x):
    """Moves the unknowns, a corner never far at once; how far, in parts of what is hardly any way."""
    step, by_unknown, terms, farthest = space[STEP], space[SLOPES:], int(answer[TERMS]), 0.0
    for i in range(8):
        way = 0.0
        for j in range(HOMOGRAPHY):
            way += by_unknown[i, j] * step[j]
        farthest = max(farthest, abs(way))
    part = min(1.0, _CORNER_STEP / max(farthest, 1e-12))
    for column in range(3):
        a, b, c = to_print[0, column], to_print[1, column], to_print[2, column]
        to_print[0, column] += part * (step[1] * a + step[2] * b + step[0] * c)
        to_print[1, column] += part * (step[4] * a + step[5] * b + step[3] * c)
        to_print[2, column] -= part * (step[6] * a + step[7] * b)
    x[0] = max(x[0] * math.exp(min(max(step[BLUR], -_BLUR_STEP), _BLUR_STEP)), _LEAST_BLUR)
    x[1] = min(max(x[1] + min(max(step[SHIFT], -_SHIFT_STEP), _SHIFT_STEP), -_MOST_SHIFT), _MOST_SHIFT)
    x[2] = min(max(x[2] + step[HALO], -0.5), _MOST_HALO) if answer[WITH_HALO] > 0.0 else 0.0
    for i in range(terms):
        x[3 + i] += step[LIGHT + i]
        x[9 + i] += step[LIGHT + terms + i]
    return max(farthest / _NEAR, max(abs(step[BLUR]), max(abs(step[SHIFT]), abs(step[HALO]))) / _ALIKE)


@outlined
def corner_slopes(lens, to_print, normalized, by_unknown):
    """Where the corners are, undistorted (4, 2), and (8, 8) how they move in px by the homography's unknowns.

    Returns:
        False beyond the print's horizon.
    """
    h, back = to_print, by_unknown
    invert(to_print, back)  # in the place of what is filled later
    for k in range(4):
        u, v = _CORNERS[k, 0], _CORNERS[k, 1]
        depth = back[2, 0] * u + back[2, 1] * v + back[2, 2]
        if not depth > 0.0:
            return False
        normalized[k, 0] = (back[0, 0] * u + back[0, 1] * v + back[0, 2]) / depth
        normalized[k, 1] = (back[1, 0] * u + back[1, 1] * v + back[1, 2]) / depth
    for k in range(4):
        u, v, x, y = _CORNERS[k, 0], _CORNERS[k, 1], normalized[k, 0], normalized[k, 1]
        _, _, xx, xy, yy = distort_point(lens, x, y)
        # Of (u, v) by (x, y), times the depth; its inverse has it, too.
        a, b = h[0, 0] - u * h[2, 0], h[0, 1] - u * h[2, 1]
        c, d = h[1, 0] - v * h[2, 0], h[1, 1] - v * h[2, 1]
        scale = -(h[2, 0] * x + h[2, 1] * y + h[2, 2]) / (a * d - b * c)
        for i in range(2):
            e, f = (lens[FX] * xx, lens[FX] * xy) if i == 0 else (lens[FY] * xy, lens[FY] * yy)
            by_u, by_v, row = scale * (e * d - f * c), scale * (f * a - e * b), by_unknown[2 * k + i]
            row[0], row[1], row[2] = by_u, by_u * u, by_u * v
            row[3], row[4], row[5] = by_v, by_v * u, by_v * v
            row[6], row[7] = (by_u * u + by_v * v) * u, (by_u * u + by_v * v) * v
    return True


@outlined
def settle(pixels, count, black, lens, to_print, x, known, answer, space, misses):
    """Gauss and Newton's steps until they are small; False where they do not become so."""
    if not corner_slopes(lens, to_print, space[PLACES:SLOPES], space[SLOPES:]):
        return False
    for i in range(LIGHT + 2 * int(answer[TERMS])):
        space[HELD, i] = 1.0 if i == HALO and not answer[WITH_HALO] > 0.0 else 0.0
    # The first steps need few pixels.
    answer[EVERY] = _COARSE if answer[NOISE] == _ANY_NOISE and count > _COARSE * _ASKED else 1
    size = math.inf
    for turn in range(_STEPS):
        print_equations(pixels, count, black, to_print, x, answer, space, misses)
        if answer[TO_DROP] > 0.0:
            count, answer[TO_DROP] = int(answer[USED]), 0.0
            if count < _LEAST_PIXELS:
                return False
        noise = answer[NOISE]
        if noise == _ANY_NOISE:
            answer[AT_START] = explained_part(pixels, answer, misses)
        if turn < _NOISE_ROUNDS:
            answer[NOISE] = max(1.4826 * median_size(misses, int(answer[USED])), _LEAST_NOISE)
        size = math.sqrt(max(print_system(space, x, known, answer, -1.0), 0.0)) / answer[NOISE]
        if not size < math.inf:
            return False
        way = take_step(space, answer, to_print, x)
        if not x[0] + abs(to_print[0, 0]) < math.inf:
            return False
        if size < _DONE or (way < 1.0 and noise < _ANY_NOISE and answer[NOISE] < _GROWN * noise):
            if answer[EVERY] == 1.0:
                return True
            answer[EVERY] = 1.0
    return size < _RESTLESS


@outlined
def median_size(misses, used):
    """Median of the sizes of the residuals, by Hoare's selection."""
    values = misses[1]
    for p in range(used):
        values[p] = abs(misses[0, p])
    return median_of(values, used)


@outlined
def explained_part(pixels, answer, misses):
    """Part of the variance of the grey values that the model explains."""
    used, every = int(answer[USED]), int(answer[EVERY])
    total, mean, spread, left = 0.0, 0.0, 0.0, 0.0
    for i in range(used):
        total += pixels[7, i * every]
        mean += pixels[7, i * every] * pixels[6, i * every]
    mean /= total
    for i in range(used):
        weight, off = pixels[7, i * every], pixels[6, i * every] - mean
        spread += weight * off * off
        left += weight * misses[0, i] * misses[0, i]
    return 1.0 - left / spread if spread > _LEAST_CONTRAST * total else 0.0  # nothing is there


@outlined
def squares_of(misses, answer):
    """Sum of the squares of the residuals; what is far off counts as four standard deviations."""
    total, most = 0.0, (_CAUCHY * answer[NOISE]) ** 2
    for i in range(int(answer[USED])):
        total += min(misses[0, i] * misses[0, i], most)
    return total


@outlined
def ask_for_more(pixels, count, black, to_print, x, known, answer, space, misses):
    """Whether the residuals ask for uneven light or for a halo, which are then part of the model."""
    held, none, light, halo = space[HELD], 0.0, False, False
    answer[EVERY], answer[TERMS], answer[WITH_HALO] = (count + _ASKED - 1) // _ASKED, QUADRATIC, 1.0
    print_equations(pixels, count, black, to_print, x, answer, space, misses)
    squares = squares_of(misses, answer)
    for model in range(3):  # as it is, with light, with a halo
        for i in range(LIGHT + 2 * QUADRATIC):
            curved = i >= LIGHT and (i - LIGHT) % QUADRATIC >= LINEAR
            held[i] = 1.0 if (curved and model != 1) or (i == HALO and model != 2) else 0.0
        gain = print_system(space, x, known, answer, -1.0)
        none = gain if model == 0 else none
        light = light or (model == 1 and gain - none > _LIGHT_ASKED * squares)
        halo = halo or (model == 2 and gain - none > _HALO_ASKED * squares)
    answer[TERMS], answer[WITH_HALO] = QUADRATIC if light else LINEAR, 1.0 if halo else 0.0
    return light or halo


@outlined
def misread_cells(pixels, n, to_print, contrast, answer, misses, sums):
    """Cells whose pixels miss the model by half of the contrast and more; ``sums`` (2, n n) is work space."""
    every = int(answer[EVERY])
    for i in range(n * n):
        sums[0, i], sums[1, i] = 0.0, 0.0
    for p in range(int(answer[USED])):
        x, y = pixels[0, p * every], pixels[1, p * every]
        w = to_print[2, 0] * x + to_print[2, 1] * y + to_print[2, 2]
        column = math.floor(((to_print[0, 0] * x + to_print[0, 1] * y + to_print[0, 2]) / w + 0.5) * n)
        row = math.floor(((to_print[1, 0] * x + to_print[1, 1] * y + to_print[1, 2]) / w + 0.5) * n)
        if min(column, row) >= 0 and max(column, row) < n:
            sums[0, row * n + column] += misses[0, p]
            sums[1, row * n + column] += 1.0
    count, cells, total = 0, 0.0, 0.0
    for i in range(n * n):
        count += 1 if abs(sums[0, i]) > 0.5 * abs(contrast) * sums[1, i] else 0
        cells += 1.0 if sums[1, i] > 0.0 else 0.0
        total += sums[0, i] * sums[0, i] / max(sums[1, i], 1.0)
    answer[UNEVEN] = total / (max(cells, 1.0) * answer[NOISE] * answer[NOISE])
    return count


@outlined
def conclude(pixels, lens, to_print, x, known, answer, space, misses, corners, normalized, covariance):
    """Takes over a fit that can be believed; ``corners`` come in as where it started."""
    places, by_unknown, unknowns = space[PLACES:SLOPES], space[SLOPES:], space[0:HOMOGRAPHY]
    explained = explained_part(pixels, answer, misses)
    if not x[9] > max(_LEAST_CONTRAST, 1.5 * answer[NOISE]) or explained < _EXPLAINED:
        return
    if not corner_slopes(lens, to_print, places, by_unknown):
        return
    far = 0.0
    for k in range(4):
        bx, by, _, _, _ = distort_point(lens, places[k, 0], places[k, 1])
        places[k, 2], places[k, 3] = lens[FX] * bx + lens[CX], lens[FY] * by + lens[CY]
        far = max(far, math.hypot(places[k, 2] - corners[k, 0], places[k, 3] - corners[k, 1]))
    area = 0.5 * abs(
        (places[2, 2] - places[0, 2]) * (places[3, 3] - places[1, 3])
        - (places[2, 3] - places[0, 3]) * (places[3, 2] - places[1, 2])
    )
    if not far < max(_FARTHEST, _FARTHEST_PART * math.sqrt(area)):
        return
    variance = squares_of(misses, answer) / (answer[USED] - LIGHT - 2.0 * answer[TERMS])
    variance = max(variance, _LEAST_NOISE**2) * (1.0 + _MODEL) ** 2
    for k in range(HOMOGRAPHY):
        print_system(space, x, known, answer, float(k))
        for i in range(8):
            total = 0.0
            for j in range(HOMOGRAPHY):
                total += by_unknown[i, j] * space[STEP, j]
            unknowns[k, i] = variance * total
    for i in range(8):
        for j in range(8):
            total = 0.0
            for k in range(HOMOGRAPHY):
                total += by_unknown[i, k] * unknowns[k, j]
            covariance[i, j] = total
    for k in range(4):
        for i in range(2):
            normalized[k, i], corners[k, i] = places[k, i], places[k, 2 + i]
    answer[FOUND], answer[EXPLAINED] = 1.0, explained
    for i in range(15):
        known[START + i] = x[i]
    if answer[WITH_HALO] == 0.0 or answer[PLAIN_BLUR] == 0.0:  # of edges as they seem to be
        answer[PLAIN_BLUR], answer[PLAIN_SHIFT] = x[0], x[1]
        answer[SHIFT_SIGMA] = math.sqrt(variance * print_system(space, x, known, answer, float(SHIFT)))


@outlined
def invert(matrix, inverse):
    """Inverse of a matrix (3, 3) by its cofactors."""
    m = matrix
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            inverse[j, i] = m[a, c] * m[b, d] - m[a, d] * m[b, c]
    determinant = m[0, 0] * inverse[0, 0] + m[0, 1] * inverse[1, 0] + m[0, 2] * inverse[2, 0]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant


@outlined
def print_from(lens, normalized, push, back, to_print):
    """Fills ``to_print`` and its inverse from the corners (Heckbert, 1989).

    Args:
        lens: ``lens_vector``.
        normalized: (4, 2) undistorted corners.
        push: The sides lie so many px farther out.
        back: (3, 3) out, from the print to the picture.
        to_print: (3, 3) out.
    """
    c = normalized
    ax, ay, bx, by = c[1, 0] - c[2, 0], c[1, 1] - c[2, 1], c[3, 0] - c[2, 0], c[3, 1] - c[2, 1]
    sx, sy = c[0, 0] - c[1, 0] + c[2, 0] - c[3, 0], c[0, 1] - c[1, 1] + c[2, 1] - c[3, 1]
    area = ax * by - ay * bx
    back[2, 0], back[2, 1] = (sx * by - bx * sy) / area, (ax * sy - sx * ay) / area
    for i in range(2):
        back[i, 0] = c[1, i] - c[0, i] + back[2, 0] * c[1, i]
        back[i, 1] = c[3, i] - c[0, i] + back[2, 1] * c[3, i]
        back[i, 2] = c[0, i] + 0.5 * (back[i, 0] + back[i, 1])
    back[2, 2] = 1.0 + 0.5 * (back[2, 0] + back[2, 1])
    invert(back, to_print)
    x, y = back[0, 2] / back[2, 2], back[1, 2] / back[2, 2]
    w = to_print[2, 0] * x + to_print[2, 1] * y + to_print[2, 2]
    for i in range(2):  # at the middle (u, v) are 0
        slope = math.hypot(to_print[i, 0] / lens[FX], to_print[i, 1] / lens[FY]) / w
        for j in range(3):
            to_print[i, j] /= 1.0 + 2.0 * push * abs(slope)


@outlined
def box_of(gray, lens, back, reach, most, box):
    """Fills ``box`` (x0, y0, x1, y1) of whole pixels round the print; one pixel in how many is looked at.

    Zero where the print is not in the picture.
    """
    x0, y0, x1, y1, area, last_x, last_y = math.inf, math.inf, -math.inf, -math.inf, 0.0, 0.0, 0.0
    for k in range(-1, 4):
        u, v = 2.0 * reach * _CORNERS[k, 0], 2.0 * reach * _CORNERS[k, 1]
        depth = back[2, 0] * u + back[2, 1] * v + back[2, 2]
        if not depth > 0.0:
            return 0
        x, y = back[0, 0] * u + back[0, 1] * v + back[0, 2], back[1, 0] * u + back[1, 1] * v + back[1, 2]
        bx, by, _, _, _ = distort_point(lens, x / depth, y / depth)
        px, py = lens[FX] * bx + lens[CX], lens[FY] * by + lens[CY]
        x0, y0, x1, y1 = min(x0, px), min(y0, py), max(x1, px), max(y1, py)
        area += last_x * py - last_y * px if k >= 0 else 0.0
        last_x, last_y = px, py
    height, width = gray.shape
    if not (x1 > 0.0 and y1 > 0.0 and x0 < width - 1.0 and y0 < height - 1.0):
        return 0
    box[0], box[1] = int(max(math.floor(x0), 0.0)), int(max(math.floor(y0), 0.0))
    box[2], box[3] = int(min(math.ceil(x1) + 1.0, width)), int(min(math.ceil(y1) + 1.0, height))
    return 2 * int(0.25 * abs(area) / most) + 1


@outlined
def thin_out(pixels, count, most):
    """Leaves out pixels, evenly, where there are more than enough; how many are left."""
    if count <= most:
        return count
    for p in range(most):
        for i in range(PIXEL_ROWS):
            pixels[i, p] = pixels[i, p * count // most]
    return most


@kernel
def fit_print(gray, lens, black, known, corners, normalized, covariance, answer):
    """Fits the whole print of one marker.

    Args:
        gray: (h, w) uint8, C-contiguous.
        lens: ``lens_vector``.
        black: (n, n) 1 where the print is black.
        known: (KNOWN_NUMBERS,) what is known beforehand; where the print was found, what is known now.
        corners: (4, 2) px in, roughly; out where the print was found.
        normalized: (4, 2) the same, undistorted.
        covariance: (8, 8) out, px^2, of noise alone.
        answer: (ANSWER_NUMBERS,) zeros in, out what was found.
    """
    n, x = black.shape[0], np.zeros(15)
    to_print, box = np.empty((3, 3)), np.empty(4, np.int64)
    space = np.zeros((SPACE_ROWS, max(_BLOCK, n)))
    back, reach = space[0:3], 0.5 + _ROUND / n
    print_from(lens, normalized, known[PUSH], back, to_print)
    every = box_of(gray, lens, back, reach, known[LOOKED_AT], box)
    if every == 0:
        return
    room = ((box[2] - box[0]) // every + 1) * (box[3] - box[1])
    pixels, misses, sums = np.empty((PIXEL_ROWS, room)), np.empty((2, room)), np.empty((2, n * n))
    count = take_print(gray, lens, box, every, to_print, reach, pixels)
    for i in range(15):
        x[i] = known[START + i]
    answer[TERMS], answer[TO_DROP] = known[START_TERMS], 1.0
    answer[WITH_HALO], answer[EVERY] = 1.0 if x[2] != 0.0 else 0.0, 1.0
    if known[START_NOISE] == _ANY_NOISE:
        # Dark and contrast alone, which are linear.
        for i in range(LIGHT):
            space[HELD, i] = 1.0
        print_equations(pixels, count, black, to_print, x, answer, space, misses)
        count = int(answer[USED])
        if count < _LEAST_PIXELS or not print_system(space, x, known, answer, -1.0) < math.inf:
            return
        take_step(space, answer, to_print, x)
        count, answer[TO_DROP] = thin_out(pixels, count, int(known[FITTED])), 0.0
    answer[NOISE] = known[START_NOISE]
    for turn in range(2):  # as it is; with what the residuals ask for
        if turn > 0 and not ask_for_more(pixels, count, black, to_print, x, known, answer, space, misses):
            break
        fine = settle(pixels, count, black, lens, to_print, x, known, answer, space, misses)
        answer[AT_START] = max(answer[AT_START], explained_part(pixels, answer, misses))
        answer[MISREAD] = misread_cells(pixels, n, to_print, x[9], answer, misses, sums)
        if fine:
            conclude(pixels, lens, to_print, x, known, answer, space, misses, corners, normalized, covariance)
        if not fine or known[ASK] == 0.0:
            break
    if answer[FOUND] == 0.0:
        answer[EXPLAINED] = answer[AT_START]


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
        looked_at: Of a print, at most.
        fitted: Of those near an edge, at most.
    """

    looked_at: int = 9000
    fitted: int = 2200


#: Of a picture alone: more pixels make no marker better than the model is; and in films, which want to be
#: fast: the next picture comes soon.
SINGLE, FILM = PrintEffort(), PrintEffort(3000, 1000)


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
    announce(fit_print, "the fit of the markers' prints")
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
    known, answer = np.zeros(KNOWN_NUMBERS), np.zeros(ANSWER_NUMBERS)
    blur = start.blur if start.refined else _BLUR
    known[:PUSH] = expected.value, expected.sigma, blur
    known[PUSH:LOOKED_AT] = blur * expected.value, _ANY_NOISE, LINEAR
    known[LOOKED_AT:START] = effort.looked_at, effort.fitted, before is None
    known[START : START + 2] = blur, expected.value
    if before is not None and before.model is not None:
        known[PUSH], known[START_NOISE:LOOKED_AT] = before.blur * before.edge_shift, before.model[:2]
        known[START:] = before.model[2:]
    if not start.refined:
        known[PUSH] = 0.0
    corners, normalized, covariance = start.corners - origin, start.normalized.copy(), np.empty((8, 8))
    answer[EXPLAINED] = math.nan
    fit_print(gray, lens, black, known, corners, normalized, covariance, answer)
    misread = int(answer[MISREAD])
    if not answer[FOUND]:
        return replace(start, explained=float(answer[EXPLAINED]), misread=misread)
    covariance *= max(1.0, float(answer[UNEVEN]) / _UNEVEN)
    way = corners - corners.mean(axis=0)
    outward = (way / np.linalg.norm(way, axis=1, keepdims=True)).reshape(8)
    covariance += _LEAST_SIGMA**2 * (0.5 * np.eye(8) + np.outer(outward, outward))
    # With a halo the model's edges are others than those that four sides see.
    seen = answer[PLAIN_BLUR:EXPLAINED].tolist()
    if before is not None and answer[WITH_HALO]:
        seen = [before.blur, before.edge_shift, before.edge_shift_sigma]
    return RefinedCorners(
        corners + origin, normalized, covariance, math.sqrt(covariance.trace() / 8), True,
        blur=seen[0], edge_shift=seen[1], edge_shift_sigma=seen[2], explained=float(answer[EXPLAINED]),
        misread=misread, by_print=True, model=(*answer[NOISE:WITH_HALO].tolist(), *known[START:].tolist()),
    )  # fmt: skip
