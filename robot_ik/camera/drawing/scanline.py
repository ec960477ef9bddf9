"""Compiled: triangles into sample buffers with depth, and samples into pixels.

A pixel has ``n`` samples at given places in it.  Each sample keeps the nearest surface: one over its depth
and whose it is.  What is nearer wins, in whatever order triangles come.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from robot_ik.kernels.jit import kernel, pure


@kernel
def place_vertices(vertices: Any, owner: Any, rotation: Any, position: Any, placed: Any) -> None:
    """``placed`` (v, 3): ``vertices`` (v, 3) turned and moved with their geom ``owner`` (v,)."""
    for k in range(len(vertices)):
        g = owner[k]
        x, y, z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        for i in range(3):
            placed[k, i] = (
                rotation[g, i, 0] * x + rotation[g, i, 1] * y + rotation[g, i, 2] * z + position[g, i]
            )


@kernel
def light_corners(normals: Any, owner: Any, light: Any, half: Any, ambient: float, lit: Any) -> None:
    """``lit`` (f, 4, 2): diffuse light and highlight at each corner of each face.

    ``normals`` (f, 4, 3) in geom frames; ``light`` and ``half`` (g, 3) the unit directions to the light and
    halfway to the viewer in each geom's frame (Blinn 1977).
    """
    for f in range(len(normals)):
        g = owner[f]
        for c in range(4):
            n = normals[f, c]
            diffuse = n[0] * light[g, 0] + n[1] * light[g, 1] + n[2] * light[g, 2]
            shine = n[0] * half[g, 0] + n[1] * half[g, 1] + n[2] * half[g, 2]
            # half way round, so that the side away from the light is not flat
            wrapped = 0.5 + 0.5 * diffuse
            lit[f, c, 0] = ambient + (1.0 - ambient) * wrapped * wrapped
            power = max(shine, 0.0)
            for _ in range(5):
                power *= power
            lit[f, c, 1] = power


@pure
def _fill(
    p: Any, inverse: Any, lit: Any, corners: Any, face: int, half: int,
    offset: int, samples: Any, left: int, top: int, depth: Any, whose: Any, planes: Any, extent: Any,
) -> None:  # fmt: skip
    """Half a face into the buffers: its corners 0 1 2 or 0 2 3."""
    a, b, c = corners[0], corners[1 + half], corners[2 + half]
    ax, ay, bx, by, cx, cy = p[a, 0], p[a, 1], p[b, 0], p[b, 1], p[c, 0], p[c, 1]
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    # seen from outside a face runs counter-clockwise, which is negative with y down
    if not area < 0.0:
        return
    height, width = depth.shape[1], depth.shape[2]
    first = max(math.floor(min(ay, by, cy)) - top, 0)
    last = min(math.ceil(max(ay, by, cy)) - top, height - 1)
    low, high = min(ax, bx, cx), max(ax, bx, cx)
    if first > last or high < left - 1 or low > left + width:
        return
    # gradients in the picture of one over depth and of the light
    ux, uy, vx, vy = (cy - ay) / area, (ax - cx) / area, (ay - by) / area, (bx - ax) / area
    wb, wc = inverse[b] - inverse[a], inverse[c] - inverse[a]
    wx, wy = ux * wb + vx * wc, uy * wb + vy * wc
    mark = 2 * face + half
    for k in range(2):
        lb, lc = lit[face, 1 + half, k] - lit[face, 0, k], lit[face, 2 + half, k] - lit[face, 0, k]
        gx, gy = ux * lb + vx * lc, uy * lb + vy * lc
        planes[mark, 3 * k] = lit[face, 0, k] - gx * ax - gy * ay
        planes[mark, 3 * k + 1], planes[mark, 3 * k + 2] = gx, gy
    # corners from the uppermost to the lowest: an edge has the same numbers in both its faces, so no cracks
    x0, y0, x1, y1, x2, y2 = ax, ay, bx, by, cx, cy
    if y1 < y0:
        x0, y0, x1, y1 = x1, y1, x0, y0
    if y2 < y0:
        x0, y0, x2, y2 = x2, y2, x0, y0
    if y2 < y1:
        x1, y1, x2, y2 = x2, y2, x1, y1
    long = (x2 - x0) / (y2 - y0)
    upper = (x1 - x0) / (y1 - y0) if y1 > y0 else 0.0
    lower = (x2 - x1) / (y2 - y1) if y2 > y1 else 0.0
    slope, owned = np.float32(wx), np.int32(mark + 2 * offset)
    for k in range(len(samples)):
        shift, drop = left + samples[k, 0], top + samples[k, 1]
        for row in range(max(first, math.ceil(y0 - drop)), min(last + 1, math.ceil(y2 - drop))):
            y = row + drop
            one = x0 + (y - y0) * long
            two = x0 + (y - y0) * upper if y < y1 else x1 + (y - y1) * lower
            start = max(math.ceil(min(one, two) - shift), 0)
            stop = min(math.ceil(max(one, two) - shift), width)
            if start >= stop:
                continue
            extent[row, 0], extent[row, 1] = min(extent[row, 0], start), max(extent[row, 1], stop)
            w = np.float32(inverse[a] + wx * (start + shift - ax) + wy * (y - ay))
            near, owner = depth[k, row, start:stop], whose[k, row, start:stop]
            for column in range(len(near)):  # without branches, so that it runs eight at a time
                here = w + np.float32(column) * slope
                nearer = here > near[column]
                owner[column] = owned if nearer else owner[column]
                near[column] = here if nearer else near[column]


@kernel
def fill_faces(
    pixels: Any, inverse: Any, lit: Any, faces: Any, chosen: Any, offset: int,
    samples: Any, left: int, top: int, depth: Any, whose: Any, planes: Any, extent: Any,
) -> None:  # fmt: skip
    """Faces into the sample buffers.

    Args:
        pixels: (v, 2) where the vertices are; ``inverse`` (v,) one over their depth, 1/m.
        inverse: See ``pixels``.
        lit: (f, 4, 2) light at the corners.
        faces: (f, 4) vertices; ``chosen`` (k,) which faces to fill.
        chosen: See ``faces``.
        offset: Number of the first face, where others are in the buffers already.
        samples: (n, 2) places in a pixel, its centre is 0.
        left: Pixel column of the buffers' first, ``top`` the row.
        top: See ``left``.
        depth: (n, h, w) float32, 0 where nothing is; ``whose`` (n, h, w) int32: 2 f, or 2 f + 1 for the
            second triangle of a face; f counts from ``offset``.
        whose: See ``depth``.
        planes: (2 f, 6) gets diffuse light and highlight as functions 1, x, y of the picture.
        extent: (h, 2) first column of each row that is touched, and the one after the last.
    """
    for i in range(len(chosen)):
        f = chosen[i]
        for half in range(2 if faces[f, 3] != faces[f, 2] else 1):
            _fill(
                pixels, inverse, lit, faces[f], f, half, offset, samples, left, top, depth, whose, planes,
                extent,
            )  # fmt: skip


@kernel
def resolve(
    depth: Any, whose: Any, planes: Any, extent: Any, owner: Any, base: Any, gloss: float,
    left: int, top: int, colour: Any, coverage: Any,
) -> None:  # fmt: skip
    """Samples into pixels: ``colour`` (h, w, 3) times coverage and ``coverage`` (h, w), uint8, 0 before.

    ``owner`` (f,) row of each face in ``base`` (m, 3), colours 0..255; a phantom has a row below 0 and covers
    nothing.
    """
    count, height = depth.shape[:2]
    scale = 1.0 / count
    last, who = -1, -1  # whose light and colour are at hand: neighbours are mostly of one face
    a0 = ax = ay = s0 = sx = sy = blue = green = red = 0.0
    for row in range(height):
        y = row + top
        for column in range(extent[row, 0], extent[row, 1]):
            b, g, r, seen = 0.0, 0.0, 0.0, 0
            k = 0
            while k < count:
                if not depth[k, row, column] > 0.0:
                    k += 1
                    continue
                mark, run = whose[k, row, column], 0
                while k < count and whose[k, row, column] == mark and depth[k, row, column] > 0.0:
                    k, run = k + 1, run + 1
                if mark != last:
                    last, who = mark, owner[mark // 2]
                    if who >= 0:
                        a0, ax, ay = planes[mark, 0], planes[mark, 1], planes[mark, 2]
                        s0, sx, sy = planes[mark, 3], planes[mark, 4], planes[mark, 5]
                        blue, green, red = base[who, 0], base[who, 1], base[who, 2]
                if who >= 0:
                    x = column + left
                    # a sample beside the pixel's middle may be on a face whose plane bends away there
                    shade = min(max(a0 + ax * x + ay * y, 0.0), 1.0)
                    shine = gloss * min(max(s0 + sx * x + sy * y, 0.0), 1.0)
                    b += run * min(blue * shade + shine, 255.0)
                    g += run * min(green * shade + shine, 255.0)
                    r += run * min(red * shade + shine, 255.0)
                    seen += run
            if seen > 0:
                colour[row, column, 0] = np.uint8(np.int32(b * scale + 0.5))
                colour[row, column, 1] = np.uint8(np.int32(g * scale + 0.5))
                colour[row, column, 2] = np.uint8(np.int32(r * scale + 0.5))
                coverage[row, column] = np.uint8(seen * 255 * scale + 0.5)


@kernel
def lay_over(image: Any, colour: Any, coverage: Any, alpha: float, left: int, top: int) -> None:
    """Blends a layer (see ``resolve``) into ``image`` (h, w, 3) uint8, in place."""
    share = round(alpha * 256)
    for row in range(coverage.shape[0]):
        for column in range(coverage.shape[1]):
            c = int(coverage[row, column])
            if c == 255 and share == 256:
                for k in range(3):
                    image[row + top, column + left, k] = colour[row, column, k]
            elif c > 0:
                keep = 65280 - c * share  # 255 * 256 is all of it
                for k in range(3):
                    old = int(image[row + top, column + left, k])
                    new = int(colour[row, column, k])
                    image[row + top, column + left, k] = np.uint8(
                        min((old * keep + new * share * 255 + 32640) // 65280, 255)
                    )


@kernel
def hide_lines(points: Any, inverse: Any, slack: float, depth: Any, left: int, top: int, seen: Any) -> None:
    """``seen`` (n,): which points (n, 2) in pixels, at one over depth ``inverse`` (n,), nothing hides.

    A point on an outline is seen if one of the nine pixels around it lets it through.
    """
    height, width = depth.shape[1], depth.shape[2]
    for i in range(len(points)):
        column = math.floor(points[i, 0] + 0.5) - left
        row = math.floor(points[i, 1] + 0.5) - top
        seen[i] = False
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                if depth[0, y, x] <= inverse[i] * (1.0 + slack):
                    seen[i] = True
