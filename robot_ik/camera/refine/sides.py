"""The sides of a marker as bent curves in the picture, and the pixels beside them, compiled.

A side that runs more along x than along y is crossed by picture columns, the others by rows; below ``main``
is the coordinate along and ``cross`` the one across.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

import numpy as np

from robot_ik.camera.lens_kernels import CX, CY, FX, FY, bend_point, from_pixel
from robot_ik.camera.refine.edges import DISTANCE, VALUE, WEIGHT
from robot_ik.kernels.jit import outlined

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
def bent_side(lens, corners, k, cells, band, curve, side):
    """Fills ``curve`` and ``side``: the side from corner k to the next, straight without the lens.

    Args:
        lens: ``lens_vector``.
        corners: (4, 2) pixels.
        k: Which side.
        cells: Cells along a side with the black border.
        band: Half width of the band of pixels at most, px.
        curve: (17, 3) out: main, cross, fraction of the way; main ascends.
        side: (SIDE_NUMBERS,) out.

    Returns:
        False when the lens has no inverse there.
    """
    n, last = (k + 1) % 4, STATIONS - 1
    x0, y0 = from_pixel(lens, corners[k, 0], corners[k, 1])
    x1, y1 = from_pixel(lens, corners[n, 0], corners[n, 1])
    if not abs(x0 + x1) < math.inf:
        return False
    ax, ay = corners[n, 0] - corners[k, 0], corners[n, 1] - corners[k, 1]
    steep = abs(ay) > abs(ax)
    own = 1 if steep else 0
    ascending = ay > 0.0 if steep else ax > 0.0
    mean = 0.0
    for i in range(STATIONS):
        t = i / last if ascending else 1.0 - i / last
        bx, by, _, _, _ = bend_point(lens, x0 + t * (x1 - x0), y0 + t * (y1 - y0))
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
        place = np.rint(first + column * length / (most - 1))
        # Columns at the ends, and pixels at the border of the band, fade in over one pixel: with a hard
        # border the fit can jump between two sets of pixels for ever.
        use = min(place - low, high - place, 1.0)
        if not (place > previous and use > 0.0):
            continue
        previous = place
        while i < last - 1 and curve[i, 0] < place:
            i += 1
        step = max(curve[i, 0] - curve[i - 1, 0], 1e-9)
        part = (place - curve[i - 1, 0]) / step
        slope = (curve[i, 1] - curve[i - 1, 1]) / step
        table[MAIN, n] = place
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
    count, room = 0, pixels.shape[1]
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
                if weight > 0.0 and count < room:
                    pixels[DISTANCE, count] = distance * side[SIGN]
                    pixels[VALUE, count] = gray[main, j] if steep else gray[j, main]
                    pixels[WEIGHT, count] = weight
                    count += 1
        columns[i + 1] = count
    return count
