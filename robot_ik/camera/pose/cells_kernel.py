"""Normal equations of a marker's whole print, compiled: every border between its cells says where it is.

Model of the grey value at a pixel that sees the print at (u, v), in sides of the marker, rows downwards:

    I = dark(u, v) + contrast(u, v) * S(u, v)

S is the print, 0 black and 1 white, blurred by a Gaussian of the picture; ``dark`` and ``contrast`` are
linear.  A cell's share of S is an integral of a Gaussian over a rectangle.  Seen aslant, the Gaussian's u and
v are correlated; the integral is then a series in the correlation r, whose terms are products of differences
along u and v: of error functions, of r times bells, of r^2 / 2 times bells times their places, ….
Source: Pearson, Mathematical contributions to the theory of evolution VII, Phil. Trans. R. Soc. A 195, 1900.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.camera.lens_kernels import CX, CY, FX, FY, bend_point, from_pixel
from robot_ik.kernels.jit import kernel, outlined

#: Unknowns: twist of the body (translation, rotation about its origin, camera axes), ln blur, dark and
#: contrast with their slopes along u and v.
UNKNOWNS = 13
TWIST = 6
# What is kept of a pixel: undistorted coordinates, their derivative by pixels (symmetric but for the focal
# lengths), grey value.
PIXEL_ROWS = 7
# Beyond so many standard deviations an edge is no longer felt.
_FAR = 3.2
_BELL, _ROOT_HALF = 1.0 / math.sqrt(2.0 * math.pi), math.sqrt(0.5)
# As for the edges: residuals beyond this many standard deviations lose weight (Cauchy's function).
_CAUCHY = 2.4
# Where hardly anything changes (parts of the contrast a pixel), light is all there is to see: of such pixels
# one in so many is enough.
_FLAT, _SLOPE = 6, 0.02


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
            below, bell = 0.5 + 0.5 * math.erf(z * _ROOT_HALF), _BELL * math.exp(-0.5 * z * z)
        if i > first:
            shares[0, i - 1] = before - below
            shares[1, i - 1] = before_bell - bell
            shares[2, i - 1] = before_z * before_bell - z * bell
        before, before_bell, before_z = below, bell, z
    return first, last


@kernel
def take_print(gray, lens, box, to_print, reach, pixels):
    """Collects the pixels of a box (x0, y0, x1, y1) that see the print; how many.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: Of whole pixels.
        to_print: (3, 3) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        reach: Pixels beyond ± this (u and v) are not taken.
        pixels: (7, k) out, with room for all of the box.
    """
    count = 0
    for py in range(box[1], box[3]):
        by = (py - lens[CY]) / lens[FY]
        x, y = from_pixel(lens, box[0], py)
        for px in range(box[0], box[2]):
            # One step of Newton's method from the pixel beside it is exact to 1e-9.
            tx, ty, xx, xy, yy = bend_point(lens, x, y)
            area = 1.0 / (xx * yy - xy * xy)
            ex, ey = tx - (px - lens[CX]) / lens[FX], ty - by
            x, y = x - (yy * ex - xy * ey) * area, y - (xx * ey - xy * ex) * area
            w = to_print[2, 0] * x + to_print[2, 1] * y + to_print[2, 2]
            u = (to_print[0, 0] * x + to_print[0, 1] * y + to_print[0, 2]) / w
            v = (to_print[1, 0] * x + to_print[1, 1] * y + to_print[1, 2]) / w
            if abs(u) < reach and abs(v) < reach and w > 0.0:
                pixels[0, count], pixels[1, count] = x, y
                pixels[2, count], pixels[3, count] = yy * area / lens[FX], -xy * area / lens[FY]
                pixels[4, count], pixels[5, count] = -xy * area / lens[FX], xx * area / lens[FY]
                pixels[6, count] = gray[py, px]
                count += 1
            x, y = x + yy * area / lens[FX], y - xy * area / lens[FX]
    return count


@kernel
def print_equations(pixels, count, black, to_print, origin, x, noise, work, normal, misses):
    """Sums the normal equations of one marker.

    Args:
        pixels: (7, k) of ``take_print``.  Those that tell nothing are left out when ``noise`` is 0.
        count: How many of them.
        black: (n, n) 1 where the print is black.
        to_print: As in ``take_print``.
        origin: (3,) of the body in the camera's frame, metres.
        x: (7,) blur in px, then dark and contrast with their slopes.
        noise: Standard deviation of a pixel, grey levels; 0: all weigh the same.
        work: (7, 13 or n) work space.
        normal: (13, 14) out: lower triangle, and the right side in the last column.
        misses: (k,) out: residuals of the pixels that were used.

    Returns:
        How many pixels were used.
    """
    n = black.shape[0]
    along, down, row = work[0:3], work[3:6], work[6]
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS + 1):
            normal[i, j] = 0.0
    used = 0
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
        wide, high = wide * x[0], high * x[0]
        left, right = cell_shares(u, wide, n, along)
        top, bottom = cell_shares(v, high, n, down)
        light, by_u, by_v, by_blur = 1.0, 0.0, 0.0, 0.0
        for j in range(top, bottom):
            d0, d1, d2 = down[0, j], down[1, j], down[2, j]
            for i in range(left, right):
                if black[j, i] == 0.0:
                    continue
                a0, a1, a2 = along[0, i], along[1, i], along[2, i]
                light -= a0 * d0 + r * (a1 * d1 + 0.5 * r * a2 * d2)
                by_u -= a1 * d0 - r * a2 * d1
                by_v -= a0 * d1 - r * a1 * d2
                by_blur += a2 * d0 + a0 * d2
        by_u, by_v = by_u / wide, by_v / high
        flat = abs(by_u * gux + by_v * gvx) + abs(by_u * guy + by_v * gvy) < _SLOPE
        if flat and noise == 0.0 and p % _FLAT:
            continue
        first = TWIST if flat else 0
        contrast = x[4] + x[5] * u + x[6] * v
        miss = pixels[6, p] - (x[1] + x[2] * u + x[3] * v) - contrast * light
        # The print moves by a twist of the body: the pixel sees what was behind it.
        a, b = -contrast * (by_u * ux + by_v * vx) * w, -contrast * (by_u * uy + by_v * vy) * w
        c = -(a * ix + b * iy)
        rx, ry, rz = ix / w - origin[0], iy / w - origin[1], 1.0 / w - origin[2]
        row[0], row[1], row[2] = a, b, c
        row[3], row[4], row[5] = ry * c - rz * b, rz * a - rx * c, rx * b - ry * a
        row[6] = contrast * by_blur
        row[7], row[8], row[9] = 1.0, u, v
        row[10], row[11], row[12] = light, light * u, light * v
        weight = 1.0 / (1.0 + cauchy * miss * miss)
        for i in range(first, UNKNOWNS):
            share = weight * row[i]
            for j in range(first, i + 1):
                normal[i, j] += share * row[j]
            normal[i, UNKNOWNS] += share * miss
        misses[used] = miss
        if noise == 0.0:
            for i in range(PIXEL_ROWS):
                pixels[i, used] = pixels[i, p]
        used += 1
    return used
