"""Compiled: triangles into sample buffers with depth, and samples into pixels.

A pixel has ``n`` samples at given places in it.  Each sample keeps the nearest surface: one over its depth
and whose it is.  What is nearer wins, in whatever order triangles come.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from robot_ik.kernels.jit import kernel, pure

# Samples are looked at so many at a time: what fits into the registers of common processors.
LANES = 8
# Faces are drawn wider by this, pixels, so that rounding leaves no cracks between neighbours.
_SEAM = 2e-4
# Beyond every picture, pixels.
_FAR = 1e9


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
def _light(p: Any, lit: Any, a: int, b: int, c: int, face: int, half: int, area: float, plane: Any) -> None:
    """``plane`` (6,): diffuse light and highlight of half a face as functions 1, x, y of the picture."""
    ux, uy = (p[c, 1] - p[a, 1]) / area, (p[a, 0] - p[c, 0]) / area
    vx, vy = (p[a, 1] - p[b, 1]) / area, (p[b, 0] - p[a, 0]) / area
    for k in range(2):
        lb, lc = lit[face, 1 + half, k] - lit[face, 0, k], lit[face, 2 + half, k] - lit[face, 0, k]
        gx, gy = ux * lb + vx * lc, uy * lb + vy * lc
        plane[3 * k] = lit[face, 0, k] - gx * p[a, 0] - gy * p[a, 1]
        plane[3 * k + 1], plane[3 * k + 2] = gx, gy


@pure
def _side(ax: float, ay: float, bx: float, by: float, half: float) -> Any:
    """Distance inwards from the line a b times its length: value at (0, 0), its gradient.

    And where the line is at row 0, columns a row, when it bounds its rows from the left; when from the right.
    """
    gx, gy = by - ay, ax - bx
    value = _SEAM * (abs(gx) + abs(gy)) - gx * ax - gy * ay
    slope = -gy / gx if gx != 0.0 else 0.0
    at, reach = ax - slope * ay, half * abs(slope) + _SEAM
    low = at - reach if gx > 0.0 else -_FAR
    high = at + reach if gx < 0.0 else _FAR
    return value, gx, gy, slope, low, high


@pure
def _fill(
    ax: float, ay: float, bx: float, by: float, cx: float, cy: float, wa: float, wb: float, wc: float, mark: int,
    across: Any, down: Any, tall: int, lanes: int, half: float, depth: Any, whose: Any, extent: Any,
) -> None:  # fmt: skip
    """A triangle into the buffers: its corners off the middle of the first cell, one over their depths."""
    side = 0.5
    first = max(math.ceil((min(ay, by, cy) - half) / tall), 0)
    last = min(math.floor((max(ay, by, cy) + half) / tall), len(depth) - 1)
    least, most = max(min(ax, bx, cx) - side, 0.0), min(max(ax, bx, cx) + side, depth.shape[1] // lanes - 1.0)
    # one over depth, and the distances from the three sides
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    ub, uc = (wb - wa) / area, (wc - wa) / area
    wx, wy = (cy - ay) * ub + (ay - by) * uc, (ax - cx) * ub + (bx - ax) * uc
    w0 = wa - wx * ax - wy * ay
    e0, x0, y0, s0, l0, h0 = _side(ax, ay, bx, by, half)
    e1, x1, y1, s1, l1, h1 = _side(bx, by, cx, cy, half)
    e2, x2, y2, s2, l2, h2 = _side(cx, cy, ax, ay, half)
    gwx, gwy, gx0, gy0 = np.float32(wx), np.float32(wy), np.float32(x0), np.float32(y0)
    gx1, gy1, gx2, gy2 = np.float32(x1), np.float32(y1), np.float32(x2), np.float32(y2)
    zero, owned = np.float32(0.0), np.int32(mark)
    for row in range(first, last + 1):
        middle = tall * row
        low = max(l0 + s0 * middle, l1 + s1 * middle, l2 + s2 * middle) - side
        high = min(h0 + s0 * middle, h1 + s1 * middle, h2 + s2 * middle) + side
        start, stop = math.ceil(max(low, least)), math.floor(min(high, most)) + 1
        if start >= stop:
            continue
        extent[row, 0], extent[row, 1] = min(extent[row, 0], start), max(extent[row, 1], stop)
        d0 = np.float32(e0 + x0 * start + y0 * middle)
        d1 = np.float32(e1 + x1 * start + y1 * middle)
        d2 = np.float32(e2 + x2 * start + y2 * middle)
        w = np.float32(w0 + wx * start + wy * middle)
        near, owner = depth[row, start * lanes :], whose[row, start * lanes :]
        for i in range(LANES * ((stop - start) * (lanes // LANES))):  # without branches: eight at a time
            x, y, behind, close = across[i], down[i], owner[i], near[i]
            inside = (
                (d0 + x * gx0 + y * gy0 >= zero)
                & (d1 + x * gx1 + y * gy1 >= zero)
                & (d2 + x * gx2 + y * gy2 >= zero)
            )
            here = np.float32(w + x * gwx + y * gwy if inside else zero).view(np.int32)
            near[i] = max(close, here)
            owner[i] = owned if here > close else behind


@kernel
def fill_faces(
    pixels: Any, inverse: Any, lit: Any, faces: Any, chosen: Any, offset: int,
    across: Any, down: Any, tall: int, count: int, left: int, top: int, depth: Any, whose: Any, planes: Any, extent: Any,
) -> None:  # fmt: skip
    """Faces into the sample buffers.

    Args:
        pixels: (v, 2) where the vertices are; ``inverse`` (v,) one over their depth, 1/m.
        inverse: See ``pixels``.
        lit: (f, 4, 2) light at the corners.
        faces: (f, 4) vertices; ``chosen`` (k,) which faces to fill.
        chosen: See ``faces``.
        offset: Number of the first face, where others are in the buffers already.
        across: (w n,) float32 columns of the samples of a row, ``down`` (w n,) their rows off the row's middle.
        down: See ``across``.
        count: n, samples of a pixel.
        left: Pixel column of the buffers' first, ``top`` the row.
        top: See ``left``.
        depth: (h, w n) float32, 0 where nothing is; ``whose`` (h, w n) int32: 0 where nothing is, 2 f + 1, or
            2 f + 2 for the second triangle of a face; f counts from ``offset``.
        whose: See ``depth``.
        planes: (2 f + 1, 6) gets diffuse light and highlight as functions 1, x, y of the picture.
        extent: (h, 2) first column of each row that is touched, and the one after the last.
    """
    lanes = tall * count
    half = 0.5 * tall
    middle = top + 0.5 * (tall - 1)
    for i in range(len(chosen)):
        f = chosen[i]
        for k in range(2 if faces[f, 3] != faces[f, 2] else 1):
            a, b, c = faces[f, 0], faces[f, 1 + k], faces[f, 2 + k]
            ax, ay, bx, by = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1]
            cx, cy = pixels[c, 0], pixels[c, 1]
            area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
            # seen from outside a face runs counter-clockwise, which is negative with y down
            if area < 0.0:
                mark = 2 * f + k + 1
                _light(pixels, lit, a, b, c, f, k, area, planes[mark])
                _fill(
                    ax - left, ay - middle, bx - left, by - middle, cx - left, cy - middle,
                    inverse[a], inverse[b], inverse[c], mark + 2 * offset,
                    across, down, tall, lanes, half, depth, whose, extent,
                )  # fmt: skip


@pure
def _shaded(plane: Any, base: Any, gloss: float, x: float, y: float) -> Any:
    """Blue, green and red of a triangle at a pixel; a sample may be where its light would leave 0..1."""
    shade = min(max(plane[0] + plane[1] * x + plane[2] * y, 0.0), 1.0)
    shine = gloss * min(max(plane[3] + plane[4] * x + plane[5] * y, 0.0), 1.0)
    return (
        min(base[0] * shade + shine, 255.0),
        min(base[1] * shade + shine, 255.0),
        min(base[2] * shade + shine, 255.0),
    )


@pure
def _mixed(
    marks: Any, places: Any, planes: Any, owner: Any, base: Any, gloss: float, x: float, y: float, pixel: Any
) -> float:
    """A pixel of several surfaces: the mean of its samples, and how many show one."""
    blue, green, red, seen = 0.0, 0.0, 0.0, 0.0
    for k in range(len(places)):
        who = owner[marks[k]]
        weight = 1.0 if who >= 0 else 0.0
        b, g, r = _shaded(planes[marks[k]], base[max(who, 0)], gloss, x, y)
        blue, green, red, seen = blue + weight * b, green + weight * g, red + weight * r, seen + weight
    scale = 1.0 / len(places)
    pixel[0] = np.uint8(np.int32(blue * scale + 0.5))
    pixel[1] = np.uint8(np.int32(green * scale + 0.5))
    pixel[2] = np.uint8(np.int32(red * scale + 0.5))
    return seen


@kernel
def resolve(
    whose: Any, tall: int, places: Any, planes: Any, extent: Any, owner: Any, base: Any, gloss: float,
    left: int, top: int, colour: Any, coverage: Any,
) -> None:  # fmt: skip
    """Samples into pixels: ``colour`` (h, w, 3) times coverage and ``coverage`` (h, w), uint8, 0 before.

    ``owner`` (2 f + 1,) row of each mark in ``base`` (m, 3), colours 0..255; nothing and phantoms have a row
    below 0 and cover nothing.
    """
    count = len(places)
    for row in range(len(colour)):
        cell, at = row // tall, (row % tall) * count
        start, stop, y = extent[cell, 0], extent[cell, 1], float(row + top)
        if start >= stop:
            continue
        lanes, line, cover = (
            whose[cell, start * tall * count + at :],
            colour[row, start:],
            coverage[row, start:],
        )
        for column in range(stop - start):
            first, x = column * tall * count, float(start + column + left)
            mark, mixed = lanes[first], 0
            for k in range(1, count):
                mixed |= lanes[first + k] ^ mark
            if mixed != 0:
                seen = _mixed(
                    lanes[first : first + count], places, planes, owner, base, gloss, x, y, line[column]
                )
                cover[column] = np.uint8(seen * (255.0 / count) + 0.5)
            elif owner[mark] >= 0:
                b, g, r = _shaded(planes[mark], base[owner[mark]], gloss, x, y)
                line[column, 0] = np.uint8(np.int32(b + 0.5))
                line[column, 1] = np.uint8(np.int32(g + 0.5))
                line[column, 2] = np.uint8(np.int32(r + 0.5))
                cover[column] = 255


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
    height, width = depth.shape[:2]
    for i in range(len(points)):
        column = math.floor(points[i, 0] + 0.5) - left
        row = math.floor(points[i, 1] + 0.5) - top
        seen[i] = False
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                if depth[y, x] <= inverse[i] * (1.0 + slack):
                    seen[i] = True
