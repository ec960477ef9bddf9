"""Compiled: faces into sample buffers with depth.

A pixel has ``n`` samples at given positions in it.  Each sample keeps the nearest surface: one over its depth
and whose it is.  What is nearer wins, in whatever order faces come.

Samples lie in *cells* of one column and so many rows of pixels that a cell has ``LANES`` samples: then all of
a cell is looked at in one go, and a face is begun anew only once for several rows.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, distort_point
from robot_ik.kernels.jit import inlined, kernel
from robot_ik.ports import Array

# Samples are looked at so many at a time: what fits into the registers of common processors.
LANES = 8
# Faces are drawn wider by this, pixels, so that rounding leaves no cracks between neighbours.
_SEAM = 2e-4
# Beyond every picture, pixels.
_FAR = 1e9
# Of surfaces closer together than this the first is seen: 1.5e-5 to 3e-5 of one over depth, as bits.
# Two that lie in each other shall not show in patches because of rounding, or of the lens that bends planes.
_SAME = np.int32(256)
_ZERO, _HALF, _ONE, _WHITE = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)
# What is thinner than this (square pixels, twice) is not seen.
_THIN = -1e-9


@inlined
def _turn(p, a, b, c):
    """Twice the area of a triangle, which seen from outside runs counter-clockwise: below 0."""
    return (p[b, 0] - p[a, 0]) * (p[c, 1] - p[a, 1]) - (p[c, 0] - p[a, 0]) * (p[b, 1] - p[a, 1])


@inlined
def _light(p, lit, a, b, c, at, left, top, plane):
    """``plane`` (6,): diffuse light and highlight as functions 1, x, y, from corners ``at`` of ``lit``."""
    ax, ay = p[a, 0] - left, p[a, 1] - top
    bx, by, cx, cy = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[c, 0] - p[a, 0], p[c, 1] - p[a, 1]
    area = bx * cy - cx * by
    for k in range(2):
        base, lb, lc = lit[0, k], lit[at, k] - lit[0, k], lit[at + 1, k] - lit[0, k]
        gx, gy = (cy * lb - by * lc) / area, (bx * lc - cx * lb) / area
        plane[3 * k], plane[3 * k + 1], plane[3 * k + 2] = base - gx * ax - gy * ay, gx, gy


@inlined
def _light_face(p, lit, a, b, c, d, left, top, one, two, plane):
    """``plane`` (11,) of a face of which at least one half is seen; see ``fill_faces``."""
    plane[6:11] = _ZERO
    if not one < _THIN:
        _light(p, lit, a, c, d, 2, left, top, plane)
        return
    _light(p, lit, a, b, c, 1, left, top, plane)
    if two < _THIN:
        gx, gy = p[a, 1] - p[c, 1], p[c, 0] - p[a, 0]
        plane[6], plane[7], plane[8] = gx * (left - p[a, 0]) + gy * (top - p[a, 1]), gx, gy
        x, y = p[d, 0] - left, p[d, 1] - top
        for k in range(2):
            curvature = lit[3, k] - (plane[3 * k] + plane[3 * k + 1] * x + plane[3 * k + 2] * y)
            plane[9 + k] = curvature / two


@inlined
def _side(ax, ay, bx, by, half):
    """Distance inwards from the line a b times its length: value at (0, 0), gradient; columns a row.

    And where the line is at row 0 if it bounds rows from the left, and if it does so from the right.
    """
    gx, gy = by - ay, ax - bx
    value = _SEAM * (abs(gx) + abs(gy)) - gx * ax - gy * ay
    slope = -gy / gx if gx != 0.0 else 0.0
    at, reach = ax - slope * ay, half * abs(slope) + _SEAM
    low = at - reach if gx > 0.0 else -_FAR
    high = at + reach if gx < 0.0 else _FAR
    return value, gx, gy, slope, low, high


@inlined
def _depth(ax, ay, bx, by, cx, cy, dx, dy, wa, wb, wc, wd):
    """One over depth as a function 1, x, y of the picture, with the gradient that the diagonals have."""
    area = (cx - ax) * (dy - by) - (dx - bx) * (cy - ay)
    one, two = (wc - wa) / area, (wd - wb) / area
    gx, gy = (dy - by) * one - (cy - ay) * two, (cx - ax) * two - (dx - bx) * one
    return 0.25 * (wa + wb + wc + wd - gx * (ax + bx + cx + dx) - gy * (ay + by + cy + dy)), gx, gy


@inlined
def _fill(p, inverse, a, b, c, d, mark, left, top, across, down, tall, lanes, reach, depth, whose, extent):
    """A convex face into the buffers; a triangle repeats its last corner, which makes a side of no length.

    The innermost loop has no branches, so that it is done for eight samples at a time.  Depths are compared
    as integers: floats that are chosen between would be stored through a mask, which is slow.
    """
    side, half = reach
    ax, ay, bx, by = p[a, 0] - left, p[a, 1] - top, p[b, 0] - left, p[b, 1] - top
    cx, cy, dx, dy = p[c, 0] - left, p[c, 1] - top, p[d, 0] - left, p[d, 1] - top
    first = max(math.ceil((min(ay, by, cy, dy) - half) / tall), 0)
    last = min(math.floor((max(ay, by, cy, dy) + half) / tall), len(depth) - 1)
    least = max(min(ax, bx, cx, dx) - side, 0.0)
    most = min(max(ax, bx, cx, dx) + side, depth.shape[1] // lanes - 1.0)
    w0, wx, wy = _depth(ax, ay, bx, by, cx, cy, dx, dy, inverse[a], inverse[b], inverse[c], inverse[d])
    e0, x0, y0, s0, l0, h0 = _side(ax, ay, bx, by, half)
    e1, x1, y1, s1, l1, h1 = _side(bx, by, cx, cy, half)
    e2, x2, y2, s2, l2, h2 = _side(cx, cy, dx, dy, half)
    e3, x3, y3, s3, l3, h3 = _side(dx, dy, ax, ay, half)
    gx0, gx1, gx2, gx3 = np.float32(x0), np.float32(x1), np.float32(x2), np.float32(x3)
    gy0, gy1, gy2, gy3 = np.float32(y0), np.float32(y1), np.float32(y2), np.float32(y3)
    gwx, gwy, owned = np.float32(wx), np.float32(wy), np.int32(mark)
    for row in range(first, last + 1):
        y = tall * row
        low = max(least, max(l0 + s0 * y, l1 + s1 * y, l2 + s2 * y, l3 + s3 * y) - side)
        high = min(most, min(h0 + s0 * y, h1 + s1 * y, h2 + s2 * y, h3 + s3 * y) + side)
        if not low <= high or math.ceil(low) > math.floor(high):
            continue
        start, stop = math.ceil(low), math.floor(high) + 1
        extent[row, 0], extent[row, 1] = min(extent[row, 0], start), max(extent[row, 1], stop)
        d0, d1 = np.float32(e0 + x0 * start + y0 * y), np.float32(e1 + x1 * start + y1 * y)
        d2, d3 = np.float32(e2 + x2 * start + y2 * y), np.float32(e3 + x3 * start + y3 * y)
        w = np.float32(w0 + wx * start + wy * y)
        near, owner = depth[row, start * lanes :], whose[row, start * lanes :]
        for i in range(LANES * ((stop - start) * (lanes // LANES))):
            u, v, close, behind = across[i], down[i], near[i], owner[i]
            inside = (
                (d0 + u * gx0 + v * gy0 >= _ZERO)
                & (d1 + u * gx1 + v * gy1 >= _ZERO)
                & (d2 + u * gx2 + v * gy2 >= _ZERO)
                & (d3 + u * gx3 + v * gy3 >= _ZERO)
            )
            here = np.float32(w + u * gwx + v * gwy if inside else _ZERO).view(np.int32)
            near[i] = max(close, here)
            owner[i] = owned if np.int32(here - _SAME) > close else behind


@inlined
def _fill_face(
    pixels, inverse, lit, faces, f, offset, left, top, across, down, tall, lanes, reach,
    depth, whose, planes, extent,
):  # fmt: skip
    """One of the faces, with its light; see ``fill_faces``."""
    a, b, c, d = faces[f, 0], faces[f, 1], faces[f, 2], faces[f, 3]
    one, two = _turn(pixels, a, b, c), _turn(pixels, a, c, d) if c != d else 0.0
    first, second = one < _THIN, two < _THIN
    if not (first or second):
        return
    _light_face(pixels, lit[f], a, b, c, d, left, top, one, two, planes[f + 1])
    # a quad that the lens bent too far is drawn as two triangles, where they show their outside
    convex = second and _turn(pixels, a, b, d) < 0.0 and _turn(pixels, b, c, d) < 0.0
    whole = first and (c == d or convex)
    for k in range(2 if first and second and not whole else 1):
        if first and k == 0 and not whole:
            d = c
        elif not whole:
            b, c, d = faces[f, 2], faces[f, 3], faces[f, 3]
        _fill(
            pixels, inverse, a, b, c, d, offset + f + 1, left, top + 0.5 * (tall - 1),
            across, down, tall, lanes, reach, depth, whose, extent,
        )  # fmt: skip


@kernel
def fill_faces(
    pixels, inverse, lit, faces, chosen, offset, left, top, across, down, tall, lanes, reach,
    depth, whose, planes, extent,
):  # fmt: skip
    """Faces into the sample buffers.

    * ``pixels`` (v, 2): where the vertices are; ``inverse`` (v,): one over their depth, 1/m;
    * ``lit`` (f, 4, 2): light at the corners; ``faces`` (f, 4): vertices; ``chosen`` (k,): which to fill;
    * ``offset``: number of faces that are in the buffers already; ``left``, ``top``: the buffers' first
      pixel;
    * ``across`` (w lanes,) float32: columns of the samples in a row of cells; ``down``: rows off its middle;
    * ``tall``: rows of pixels in a cell; ``lanes``: samples in it; ``reach``: the farthest column and row of
      one off its middle;
    * ``depth`` (h, w lanes): float32 seen as int32, which are in the same order; 0 where nothing is;
    * ``whose`` (h, w lanes) int32: 0 where nothing is, then f + 1, where f counts from ``offset``;
    * ``planes`` (f + 1, 12) gets functions 1, x, y of the buffers' pixels: diffuse light, highlight, and what
      is below 0 in the second half of a face; and by how much of that the first two change there;
    * ``extent`` (h, 2): first column of each row that is touched, and the one after the last.
    """
    for i in range(len(chosen)):
        _fill_face(
            pixels, inverse, lit, faces, chosen[i], offset, left, top, across, down, tall, lanes, reach,
            depth, whose, planes, extent,
        )  # fmt: skip


@kernel
def transform_vertices(vertices, owner, rotation, position, placed):
    """``placed`` (v, 3): ``vertices`` (v, 3) turned and moved with their geom ``owner`` (v,)."""
    for k in range(len(vertices)):
        g = owner[k]
        x, y, z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        for i in range(3):
            placed[k, i] = (
                rotation[g, i, 0] * x + rotation[g, i, 1] * y + rotation[g, i, 2] * z + position[g, i]
            )


@kernel
def through_lens(points, lens, near, limit, pixels, inverse, within):
    """Where ``points`` (v, 3) of the camera frame are in the picture of a camera (``lens_vector``).

    What is not beyond ``near``, metres, cannot be seen, nor what is farther off the axis than ``limit`` of
    its depth, which is put there.  ``pixels`` (v, 2) gets the pixels, ``inverse`` (v,) one over depth,
    ``within`` (v,) what can be seen.
    """
    for k in range(len(points)):
        z = points[k, 2]
        w = 1.0 / max(z, 0.5 * near)
        x, y = points[k, 0] * w, points[k, 1] * w
        r2 = x * x + y * y
        within[k] = z > near and r2 < limit * limit
        if r2 > limit * limit:
            shrink = limit / math.sqrt(r2)
            x, y = x * shrink, y * shrink
        u, v, _, _, _ = distort_point(lens, x, y)
        pixels[k, 0], pixels[k, 1], inverse[k] = lens[FX] * u + lens[CX], lens[FY] * v + lens[CY], w


@kernel
def light_corners(normals, faces, owner, pixels, every, light, half, ambient, lit):
    """``lit`` (f, 4, 2): diffuse light and highlight at each corner of each face that shows its outside.

    * ``normals`` (f, 4, 3): at the corners, in geom frames; ``faces`` (f, 4): into ``pixels`` (v, 2);
    * ``owner`` (f,): geom of each; ``every``: light all, also what shows its inside;
    * ``light`` (g, 3): unit direction to the light in each geom's frame; ``half``: the one halfway to the
      viewer (Blinn 1977); ``ambient``: light everywhere.
    """
    for f in range(len(normals)):
        a, b, c, d = faces[f, 0], faces[f, 1], faces[f, 2], faces[f, 3]
        if not every and _turn(pixels, a, b, c) >= 0.0 and _turn(pixels, a, c, d) >= 0.0:
            continue  # the lens sees the inside of both halves
        g = owner[f]
        for k in range(4):
            n = normals[f, k]
            diffuse = n[0] * light[g, 0] + n[1] * light[g, 1] + n[2] * light[g, 2]
            shine = n[0] * half[g, 0] + n[1] * half[g, 1] + n[2] * half[g, 2]
            # half way round, so that the side away from the light is not flat
            wrapped = 0.5 + 0.5 * diffuse
            lit[f, k, 0] = ambient + (1.0 - ambient) * wrapped * wrapped
            power = max(shine, 0.0)
            for _ in range(5):
                power *= power
            lit[f, k, 1] = power


@inlined
def _shaded(plane, base, gloss, x, y):
    """Blue, green and red of a face at a pixel."""
    beyond = min(plane[6] + plane[7] * x + plane[8] * y, _ZERO)
    shade = plane[0] + plane[1] * x + plane[2] * y + plane[9] * beyond
    shine = plane[3] + plane[4] * x + plane[5] * y + plane[10] * beyond
    # a sample beside the pixel's middle may be on a face whose plane bends away there
    shade, shine = min(max(shade, _ZERO), _ONE), gloss * min(max(shine, _ZERO), _ONE)
    return (
        min(base[0] * shade + shine, _WHITE),
        min(base[1] * shade + shine, _WHITE),
        min(base[2] * shade + shine, _WHITE),
    )


@inlined
def _put(pixel, blue, green, red):
    pixel[0], pixel[1], pixel[2] = (
        np.uint8(np.int32(blue)),
        np.uint8(np.int32(green)),
        np.uint8(np.int32(red)),
    )


@inlined
def _mixed(marks, samples, planes, owner, base, gloss, x, y, pixel):
    """A pixel of several faces: the mean of its samples; returns how much is covered, 0..255."""
    blue = green = red = seen = _ZERO
    share = _ONE / np.float32(len(samples))
    for k in range(len(samples)):
        who = owner[marks[k]]
        weight = share if who >= 0 else _ZERO
        b, g, r = _shaded(planes[marks[k]], base[max(who, 0)], gloss, x, y)
        blue, green, red, seen = blue + weight * b, green + weight * g, red + weight * r, seen + weight
    _put(pixel, blue + _HALF, green + _HALF, red + _HALF)
    return np.uint8(np.int32(seen * _WHITE + _HALF))


@inlined
def _resolve_row(row, whose, tall, samples, planes, extent, owner, base, gloss, colour, coverage):
    """One row of the pixels; see ``resolve``."""
    count, cell = len(samples), row // tall
    start, stop, y = extent[cell, 0], extent[cell, 1], np.float32(row)
    if start >= stop:
        return
    marks = whose[cell, (start * tall + row % tall) * count :]
    line, cover = colour[row, start:], coverage[row, start:]
    for column in range(stop - start):
        at, x = column * tall * count, np.float32(start + column)
        mark, mixed = marks[at], 0
        for k in range(1, count):
            mixed |= marks[at + k] ^ mark
        if mixed != 0:
            cover[column] = _mixed(marks[at:], samples, planes, owner, base, gloss, x, y, line[column])
        elif owner[mark] >= 0:
            b, g, r = _shaded(planes[mark], base[owner[mark]], gloss, x, y)
            _put(line[column], b + _HALF, g + _HALF, r + _HALF)
            cover[column] = 255


@kernel
def resolve(whose, tall, samples, planes, extent, owner, base, gloss, colour, coverage):
    """Samples into pixels.

    * ``whose``, ``planes``, ``extent``: as filled; ``tall``: rows of pixels in a cell;
    * ``samples``: tuple with as many numbers as a pixel has samples, so that this is compiled for as many;
    * ``owner`` (f + 1,): row in ``base`` of each number in ``whose``; below 0 nothing or an occluder;
    * ``base`` (m, 3): float32 colours 0..255; ``gloss``: of the highlights likewise;
    * ``colour`` (h, w, 3) uint8, 0 before: gets colour times coverage; ``coverage`` (h, w).
    """
    for row in range(len(colour)):
        _resolve_row(row, whose, tall, samples, planes, extent, owner, base, gloss, colour, coverage)


@kernel
def lay_over(image, colour, coverage, alpha, left, top):
    """Blends a layer (see ``resolve``) into ``image`` (h, w, 3) uint8, in place."""
    share = round(alpha * 256)
    for row in range(coverage.shape[0]):
        for column in range(coverage.shape[1]):
            c = int(coverage[row, column])
            if c == 255 and share == 256:
                for k in range(3):
                    image[row + top, column + left, k] = colour[row, column, k]
            elif c > 0:
                keep = 65536 - ((c * share * 65793 + 32768) >> 16)  # c * share = 255 * 256 keeps nothing
                for k in range(3):
                    old = int(image[row + top, column + left, k])
                    new = int(colour[row, column, k])
                    mixed = (old * keep + new * share * 256 + 32768) >> 16
                    image[row + top, column + left, k] = np.uint8(min(mixed, 255))


# ------------------------------------------------------------------------------------------
# Faces cut off where they leave the part of space that a camera sees.


# Clipped faces are cut this fraction of the view outside it, where the lens model still holds.
_MARGIN = 0.06


@lru_cache(maxsize=16)
def view_planes(intrinsics: CameraIntrinsics, near: float) -> Array:
    """Inward planes (5, 4) round the view, n . p + d >= 0 inside: near (metres), left, right, top, bottom."""
    low, high = intrinsics.extent
    low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    return np.array(
        [
            [0, 0, 1, -near],
            [1, 0, -low[0], 0],
            [-1, 0, high[0], 0],
            [0, 1, -low[1], 0],
            [0, -1, high[1], 0],
        ],
        dtype=float,
    )


def clip(polygon: Array, planes: Array) -> Array:
    """Part (k, 3) of a convex polygon inside all planes (Sutherland and Hodgman 1974)."""
    for plane in planes:
        if len(polygon) < 3:
            break
        side = polygon @ plane[:3] + plane[3]
        following, side_next = np.roll(polygon, -1, axis=0), np.roll(side, -1)
        kept: list[Array] = []
        for p, q, a, b in zip(polygon, following, side, side_next, strict=True):
            if a >= 0:
                kept.append(p)
            if (a >= 0) != (b >= 0):
                kept.append(p + (q - p) * (a / (a - b)))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon
