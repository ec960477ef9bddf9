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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.corner_refinement import RefinedCorners
from robot_ik.camera.detection import Image, correctable, to_gray
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, distort_point, from_pixel, lens_vector
from robot_ik.kernels.jit import announce, kernel, outlined

# ------------------------------------------------------------------------------------------
# Normal equations of a marker's whole print, compiled.


# Unknowns: eight of the homography, ln blur, edge shift, halo; then dark and contrast, 3 or 6 numbers each.
HOMOGRAPHY, BLUR, SHIFT, HALO, LIGHT = 8, 8, 9, 10, 11
LINEAR, QUADRATIC = 3, 6
# What is kept of a pixel: undistorted coordinates, their derivative by pixels (symmetric but for the focal
# lengths), grey value, how many pixels it stands for.
PIXEL_ROWS = 8
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
    at, room = (place + 0.5) * count, _FAR * width * count
    first, last = max(math.floor(at - room), 0), min(math.floor(at + room) + 1, count)
    before, before_bell, before_z = 0.0, 0.0, 0.0
    for i in range(first, last + 1):
        z = (place + 0.5 - i / count) * inverse
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
    t = normal_quantile(share)
    _, bell = normal_at(t)
    tone[0], tone[2] = normal_at(t + k)
    tone[1] = tone[2] / bell


@kernel
def take_print(gray, lens, box, every, to_print, reach, pixels):
    """Collects the pixels of a box (x0, y0, x1, y1) that see the print; how many.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: Of whole pixels.
        every: Odd: one pixel in so many is taken, on a lattice.
        to_print: (3, 3) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        reach: Pixels beyond ± this (u and v) are not taken.
        pixels: (8, k) out, with room for all of the box.
    """
    count = 0
    for py in range(box[1], box[3]):
        by = (py - lens[CY]) / lens[FY]
        x, y = from_pixel(lens, box[0], py)
        for px in range(box[0], box[2]):
            # One step of Newton's method from the pixel beside it is exact to 1e-9.
            tx, ty, xx, xy, yy = distort_point(lens, x, y)
            area = 1.0 / (xx * yy - xy * xy)
            ex, ey = tx - (px - lens[CX]) / lens[FX], ty - by
            x, y = x - (yy * ex - xy * ey) * area, y - (xx * ey - xy * ex) * area
            w = to_print[2, 0] * x + to_print[2, 1] * y + to_print[2, 2]
            u = (to_print[0, 0] * x + to_print[0, 1] * y + to_print[0, 2]) / w
            v = (to_print[1, 0] * x + to_print[1, 1] * y + to_print[1, 2]) / w
            if abs(u) < reach and abs(v) < reach and w > 0.0 and (px + 2 * py) % every == 0:
                pixels[0, count], pixels[1, count] = x, y
                pixels[2, count], pixels[3, count] = yy * area / lens[FX], -xy * area / lens[FY]
                pixels[4, count], pixels[5, count] = -xy * area / lens[FX], xx * area / lens[FY]
                pixels[6, count], pixels[7, count] = gray[py, px], 1.0
                count += 1
            x, y = x + yy * area / lens[FX], y - xy * area / lens[FX]
    return count


@kernel
def print_equations(pixels, count, black, to_print, x, terms, halo, noise, work, normal, misses):
    """Sums the normal equations of one marker.

    Args:
        pixels: (8, k) of ``take_print``.  Those that tell nothing are left out when ``noise`` is 0, and only
            the rows of the light are summed.
        count: How many of them.
        black: (n, n) 1 where the print is black.
        to_print: As in ``take_print``.
        x: (15,) blur in px, edge shift, halo, then dark and contrast, 6 numbers each.
        terms: Numbers of the light that are fitted: ``LINEAR`` or ``QUADRATIC``.
        halo: Whether that of sharpening is part of the model.
        noise: Standard deviation of a pixel, grey levels; 0: all weigh the same.
        work: (10, 23 or more) work space.
        normal: (23, 24) out: lower triangle, and the right side in the last column.
        misses: (k,) out: residuals of the pixels that were used.

    Returns:
        How many pixels were used.
    """
    along, down, row = work[0:3], work[3:6], work[6]
    share, tone, wider, paler = work[7, 0:4], work[7, 4:7], work[8, 0:4], work[8, 4:7]
    basis = work[9]
    n, last = LIGHT + 2 * terms, normal.shape[1] - 1
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    blur2 = math.sqrt(x[0] * x[0] + _HALO_BLUR * _HALO_BLUR)
    part = x[0] / blur2
    k, k2, alpha = x[1], x[1] * part, x[2]
    for i in range(n):
        for j in range(n):
            normal[i, j] = 0.0
        normal[i, last] = 0.0
    used, first = 0, LIGHT if noise == 0.0 else 0
    for p in range(count):
        ix, iy = pixels[0, p], pixels[1, p]
        w = to_print[2, 0] * ix + to_print[2, 1] * iy + to_print[2, 2]
        u = (to_print[0, 0] * ix + to_print[0, 1] * iy + to_print[0, 2]) / w
        v = (to_print[1, 0] * ix + to_print[1, 1] * iy + to_print[1, 2]) / w
        # (u, v) by undistorted coordinates, then by pixels.
        ux, uy = (to_print[0, 0] - u * to_print[2, 0]) / w, (to_print[0, 1] - u * to_print[2, 1]) / w
        vx, vy = (to_print[1, 0] - v * to_print[2, 0]) / w, (to_print[1, 1] - v * to_print[2, 1]) / w
        gux, guy = ux * pixels[2, p] + uy * pixels[4, p], ux * pixels[3, p] + uy * pixels[5, p]
        gvx, gvy = vx * pixels[2, p] + vy * pixels[4, p], vx * pixels[3, p] + vy * pixels[5, p]
        wide, high = math.hypot(gux, guy), math.hypot(gvx, gvy)
        r = (gux * gvx + guy * gvy) / (wide * high)
        blurred_print(u, v, wide * x[0], high * x[0], r, black, along, down, share)
        if noise == 0.0:
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
        basis[0], basis[1], basis[2] = 1.0, u, v
        basis[3], basis[4], basis[5] = u * u, u * v, v * v
        dark, contrast = 0.0, 0.0
        for i in range(6):
            dark += x[3 + i] * basis[i]
            contrast += x[9 + i] * basis[i]
        miss = pixels[6, p] - dark - contrast * white
        gu, gv = contrast * by_u, contrast * by_v
        along_way = gu * u + gv * v
        row[0], row[1], row[2] = gu, gu * u, gu * v
        row[3], row[4], row[5] = gv, gv * u, gv * v
        row[6], row[7] = along_way * u, along_way * v
        row[BLUR], row[SHIFT], row[HALO] = contrast * by_blur, contrast * by_shift, contrast * by_halo
        for i in range(terms):
            row[LIGHT + i], row[LIGHT + terms + i] = basis[i], white * basis[i]
        weight = 1.0 / (1.0 + cauchy * miss * miss)
        for i in range(first, n):
            portion = weight * row[i]
            for j in range(first, i + 1):
                normal[i, j] += portion * row[j]
            normal[i, last] += portion * miss
        misses[used] = miss
        used += 1
    return used


# ------------------------------------------------------------------------------------------
# The fit of one print, and of all of a picture.


Array = NDArray[np.float64]

# White round the black square that is looked at, in cells.
_ROUND = 0.45
# Pixels of a print that are looked at, and those of them with an edge that are fitted: more make no marker
# better than the model is.
PIXELS, _FITTED = 9000, 2200
# In films, which want to be fast: the next picture comes soon.
FILM_PIXELS = 3000
# So many of them say whether the model needs more unknowns.
_ASKED = 800
# Steps at most; one so small, in standard deviations, is the last; a fit that does not come below that one
# is none.
_STEPS, _DONE, _RESTLESS = 12, 0.2, 0.5
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


def refine_prints(
    image: Image,
    sides: Sequence[RefinedCorners],
    ids: Sequence[int],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    *,
    origin: tuple[int, int] = (0, 0),
    expected: EdgeShift | None = None,
    pixels: int = PIXELS,
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
        pixels: So many of a print are looked at, at most.
    """
    if not len(sides):
        return []
    announce(print_equations, "the fit of the markers' prints")
    gray, expected = to_gray(image), expected or EdgeShift.of(intrinsics)
    allowed = correctable(dictionary, strict=True)
    fits = [
        _Print(
            gray, marker_black(dictionary, i), one, intrinsics, origin, expected, pixels, allowed
        ).corners()
        for i, one in zip(ids, sides, strict=True)
    ]
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


class _Print:
    """The fit of one marker's print."""

    def __init__(
        self,
        gray: Image,
        black: Array,
        start: RefinedCorners,
        intrinsics: CameraIntrinsics,
        origin: tuple[int, int],
        expected: EdgeShift,
        pixels: int,
        allowed: int,
    ) -> None:
        self._allowed = allowed
        self._start, self._black, self._intrinsics, self._expected = start, black, intrinsics, expected
        self._to_print = _homography(start.normalized)
        blur = start.blur if start.refined else _BLUR
        self._log_blur = math.log(blur)
        self._x = np.array([blur, expected.value, *[0.0] * 13])
        self._terms, self._halo, self._noise, self._step = LINEAR, False, 0.0, math.inf
        self._inverse, self._at_start = np.empty((0, 0)), 0.0
        room = LIGHT + 2 * QUADRATIC
        self._work = np.empty((10, max(room, len(black))))
        self._normal = np.empty((room, room + 1))
        self._collect(gray, origin, pixels)

    # ------------------------------------------------------------------------------- pixels

    def _collect(self, gray: Image, origin: tuple[int, int], pixels: int) -> None:
        """The pixels, chosen once."""
        reach = 0.5 + _ROUND / len(self._black)
        self._count, self._misses, self._taken = 0, np.empty(0), np.empty((PIXEL_ROWS, 0))
        if not np.isfinite(self._to_print).all():
            return
        outline = _seen_at(self._to_print, 2.0 * reach * _CORNERS)
        if outline is None:
            return
        places = self._intrinsics.distort(outline) - origin
        size = np.array(gray.shape[::-1])
        low = np.clip(np.floor(places.min(axis=0)), 0, size).astype(np.int64)
        high = np.clip(np.ceil(places.max(axis=0)) + 1, 0, size).astype(np.int64)
        room = int(np.prod(np.maximum(high - low, 0)))
        if room == 0:
            return
        side = math.sqrt(abs(_area(places)))
        every = 2 * int(side * side / (2 * pixels)) + 1
        lens = lens_vector(self._intrinsics).copy()
        lens[[CX, CY]] -= origin
        self._taken, self._misses = np.empty((PIXEL_ROWS, room)), np.empty(room)
        self._count = take_print(
            np.ascontiguousarray(gray), lens, np.concatenate([low, high]), every, self._to_print, reach,
            self._taken,
        )  # fmt: skip

    def _thin_out(self, most: int) -> None:
        """Leaves out pixels where there are more than enough."""
        if self._count > most:
            self._taken = self._taken[:, np.arange(most) * self._count // most]
            self._count = most

    # ---------------------------------------------------------------------------------- fit

    def corners(self) -> RefinedCorners:
        """The corners; where it fails those of the sides, with how much the print explains."""
        if self._count < 2 * (LIGHT + 2 * LINEAR) or not self._find_light():
            return self._start
        self._thin_out(_FITTED)
        found = None
        if self._fit():
            self._blur, self._shift = float(self._x[0]), EdgeShift(float(self._x[1]), self._shift_sigma())
            found = self._result()
            if self._ask_for_more() and self._fit():
                found = self._result() or found
        best = found or replace(self._start, explained=max(self._at_start, self._explained()))
        return replace(best, misread=max(0, self._misread() - self._allowed))

    def _equations(self, terms: int, halo: bool) -> int:
        used: int = print_equations(
            self._taken, self._count, self._black, self._to_print, self._x, terms, halo, self._noise,
            self._work, self._normal, self._misses,
        )  # fmt: skip
        return used

    def _find_light(self) -> bool:
        """Dark and contrast alone, which are linear; keeps the pixels that tell something."""
        self._count = self._equations(LINEAR, False)
        if self._count < 2 * (LIGHT + 2 * LINEAR):
            return False
        own = slice(LIGHT, LIGHT + 2 * LINEAR)
        matrix = _symmetric(self._normal[own, own])
        step = np.linalg.lstsq(matrix, self._normal[own, -1], rcond=1e-12)[0]
        self._x[3:6], self._x[9:12] = step[:3], step[3:]
        self._noise = _ANY_NOISE
        return True

    def _estimate_noise(self) -> None:
        misses = np.abs(self._misses[: self._count])
        self._noise = max(1.4826 * float(np.median(misses)), _LEAST_NOISE)

    def _system(self, terms: int, halo: bool) -> tuple[Array, Array]:
        """Normal matrix and right side, with what is believed beforehand."""
        n = LIGHT + 2 * terms
        matrix, right = _symmetric(self._normal[:n, :n]), self._normal[:n, -1].copy()
        variance = self._noise**2
        for k, spread, off in (
            (BLUR, _BLUR_SPREAD, self._log_blur - math.log(self._x[0])),
            (SHIFT, self._expected.sigma, self._expected.value - self._x[1]),
        ):
            matrix[k, k] += variance / spread**2
            right[k] += variance / spread**2 * off
        held = [] if halo else [HALO]
        if self._x[0] <= _LEAST_BLUR and right[BLUR] < 0.0:
            held.append(BLUR)
        matrix[held, :], matrix[:, held], right[held] = 0.0, 0.0, 0.0
        matrix[held, held] = 1.0
        return matrix, right

    def _fit(self) -> bool:
        """Gauss and Newton's steps until they are small; False where they do not become so."""
        by_unknown = self._corner_jacobian()
        if by_unknown is None:
            return False
        self._by_unknown = by_unknown
        for turn in range(_STEPS):
            self._equations(self._terms, self._halo)
            if self._noise == _ANY_NOISE:
                self._at_start = self._explained()
            if turn < _NOISE_ROUNDS:
                self._estimate_noise()
            matrix, right = self._system(self._terms, self._halo)
            inverse = _inverse(matrix)
            if inverse is None:
                return False
            step = inverse @ right
            self._step = math.sqrt(max(float(step @ right), 0.0)) / self._noise
            if not self._step < math.inf or not self._take(step):
                return False
            self._inverse = inverse
            if self._step < _DONE:
                break
        return self._step < _RESTLESS

    def _take(self, step: Array) -> bool:
        """Moves the unknowns; a corner never far at once."""
        x, terms = self._x, self._terms
        way = float(np.abs(self._by_unknown @ step[:HOMOGRAPHY]).max())
        e = step[:HOMOGRAPHY] * min(1.0, _CORNER_STEP / max(way, 1e-12))
        change = np.array([[1 + e[1], e[2], e[0]], [e[4], 1 + e[5], e[3]], [-e[6], -e[7], 1.0]])
        self._to_print = change @ self._to_print
        x[0] = max(x[0] * math.exp(float(np.clip(step[BLUR], -_BLUR_STEP, _BLUR_STEP))), _LEAST_BLUR)
        x[1] = float(
            np.clip(x[1] + np.clip(step[SHIFT], -_SHIFT_STEP, _SHIFT_STEP), -_MOST_SHIFT, _MOST_SHIFT)
        )
        x[2] = min(max(x[2] + step[HALO], -0.5), _MOST_HALO) if self._halo else 0.0
        x[3 : 3 + terms] += step[LIGHT : LIGHT + terms]
        x[9 : 9 + terms] += step[LIGHT + terms :]
        return bool(np.isfinite(x).all() and np.isfinite(self._to_print).all())

    def _ask_for_more(self) -> bool:
        """Whether the residuals ask for uneven light or for a halo, which are then part of the model."""
        whole = self._taken, self._count
        self._thin_out(_ASKED)
        self._equations(QUADRATIC, True)
        matrix, right = self._system(QUADRATIC, True)
        squares = float(self._squares().sum())
        plain = [*range(HALO), *range(LIGHT, LIGHT + 3), *range(LIGHT + 6, LIGHT + 9)]
        light = [*range(HALO), *range(LIGHT, LIGHT + 12)]
        none = _gain(matrix, right, plain)
        if _gain(matrix, right, light) - none > _LIGHT_ASKED * squares:
            self._terms = QUADRATIC
        if _gain(matrix, right, [*plain, HALO]) - none > _HALO_ASKED * squares:
            self._halo = True
        self._taken, self._count = whole
        return self._halo or self._terms == QUADRATIC

    # ------------------------------------------------------------------------------- result

    def _squares(self) -> Array:
        """(k,) squares of the residuals; what is far off counts as four standard deviations."""
        misses = self._misses[: self._count]
        return np.asarray(np.minimum(misses**2, (_CAUCHY * self._noise) ** 2), dtype=float)

    def _covariance(self) -> Array:
        """Of the unknowns."""
        variance = float(self._squares().sum()) / (self._count - len(self._inverse))
        return np.asarray(self._inverse * max(variance, _LEAST_NOISE**2) * (1.0 + _MODEL) ** 2)

    def _shift_sigma(self) -> float:
        return math.sqrt(self._covariance()[SHIFT, SHIFT])

    def _explained(self) -> float:
        """Part of the variance of the grey values that the model explains."""
        values, weights = self._taken[6, : self._count], self._taken[7, : self._count]
        off = values - np.average(values, weights=weights)
        spread = float(weights @ off**2)
        if spread < _LEAST_CONTRAST * float(weights.sum()):
            return 0.0  # nothing is there
        return 1.0 - float(weights @ self._misses[: self._count] ** 2) / spread

    def _misread(self) -> int:
        """Cells whose pixels miss the model by more than half of the contrast, on average."""
        n, taken = len(self._black), self._taken[:, : self._count]
        w = self._to_print @ np.stack([taken[0], taken[1], np.ones(self._count)])
        column, row = (np.floor((w[:2] / w[2] + 0.5) * n)).astype(int)
        inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < n)
        cell = (row * n + column)[inside]
        misses = np.bincount(cell, self._misses[: self._count][inside], n * n)
        return int(np.sum(np.abs(misses) > 0.5 * abs(self._x[9]) * np.bincount(cell, minlength=n * n)))

    def _corner_jacobian(self) -> Array | None:
        """(8, 8) of the corners in px by the homography's unknowns."""
        at = _seen_at(self._to_print, _CORNERS)
        if at is None:
            return None
        h = self._to_print
        weight = h[2, 0] * at[:, 0] + h[2, 1] * at[:, 1] + h[2, 2]
        slope = (h[None, :2, :2] - _CORNERS[:, :, None] * h[None, 2:, :2]) / weight[:, None, None]
        by_place = self._intrinsics.pixel_jacobian(at) @ np.linalg.inv(slope)
        return np.asarray(-(by_place @ _BY_UNKNOWN).reshape(8, 8), dtype=float)

    def _result(self) -> RefinedCorners | None:
        by_unknown, normalized = self._corner_jacobian(), _seen_at(self._to_print, _CORNERS)
        if by_unknown is None or normalized is None:
            return None
        corners = self._intrinsics.distort(normalized)
        far = float(np.linalg.norm(corners - self._start.corners, axis=1).max())
        explained = self._explained()
        if (
            not far < max(_FARTHEST, _FARTHEST_PART * math.sqrt(abs(_area(corners))))
            or not self._x[9] > max(_LEAST_CONTRAST, 1.5 * self._noise)
            or explained < _EXPLAINED
        ):
            return None
        unknowns = self._covariance()[:HOMOGRAPHY, :HOMOGRAPHY]
        covariance = by_unknown @ unknowns @ by_unknown.T
        way = corners - corners.mean(axis=0)
        outward = (way / np.linalg.norm(way, axis=1, keepdims=True)).reshape(8)
        covariance += _LEAST_SIGMA**2 * (0.5 * np.eye(8) + np.outer(outward, outward))
        return RefinedCorners(
            corners, normalized, covariance, math.sqrt(covariance.trace() / 8), True,
            blur=self._blur, edge_shift=self._shift.value, edge_shift_sigma=self._shift.sigma,
            explained=explained, by_print=True,
        )  # fmt: skip


# How a corner's place on the print follows the homography's unknowns: (4, 2, 8).
_BY_UNKNOWN = np.array(
    [
        [[1.0, u, v, 0.0, 0.0, 0.0, u * u, u * v], [0.0, 0.0, 0.0, 1.0, u, v, u * v, v * v]]
        for u, v in _CORNERS
    ]
)


def _homography(normalized: Array) -> Array:
    """(3, 3) from undistorted coordinates of the corners (4, 2) to the print; NaN where there is none."""
    rows = np.zeros((8, 8))
    for k, ((x, y), (u, v)) in enumerate(zip(normalized, _CORNERS, strict=True)):
        rows[2 * k] = x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y
        rows[2 * k + 1] = 0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y
    try:
        found = np.linalg.solve(rows, _CORNERS.reshape(8))
    except np.linalg.LinAlgError:
        return np.full((3, 3), np.nan)
    matrix = np.append(found, 1.0).reshape(3, 3)
    centre = normalized.mean(axis=0)
    # Positive before the camera.
    return np.asarray(matrix * np.sign(matrix[2, 0] * centre[0] + matrix[2, 1] * centre[1] + 1.0))


def _seen_at(to_print: Array, places: Array) -> Array | None:
    """Undistorted coordinates (n, 2) of places on the print; None beyond its horizon."""
    try:
        back = np.linalg.inv(to_print)
    except np.linalg.LinAlgError:
        return None
    p = places @ back[:, :2].T + back[:, 2]
    if not p[:, 2].min() > 0.0:
        return None
    return np.asarray(p[:, :2] / p[:, 2:], dtype=float)


def _symmetric(lower: Array) -> Array:
    matrix = np.tril(lower)
    return np.asarray(matrix + np.tril(matrix, -1).T)


def _inverse(matrix: Array) -> Array | None:
    """Inverse of a positive definite matrix whose rows have different units."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    outer = np.outer(scale, scale)
    try:
        return np.asarray(np.linalg.inv(matrix * outer + 1e-10 * np.eye(len(matrix))) * outer)
    except np.linalg.LinAlgError:
        return None


def _gain(matrix: Array, right: Array, chosen: list[int]) -> float:
    """By how much the best step of some unknowns lessens the sum of squares."""
    inverse = _inverse(matrix[np.ix_(chosen, chosen)])
    return 0.0 if inverse is None else float(right[chosen] @ inverse @ right[chosen])


def _area(corners: Array) -> float:
    x, y = corners.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
