"""Software rasteriser: fill triangles into a depth buffer, with smooth shading.

A buffer has several samples per pixel along each axis. The mean of the samples of a pixel gives
smooth outlines. Each sample keeps the nearest surface, whatever the order of the faces.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

import numpy as np

from robot_ik.kernels.jit import inlined, kernel, outlined

# Triangles are widened by this, in samples. Rounding then leaves no cracks between neighbours.
_SEAM = 2e-4
# Two surfaces count as equally far if their inverse depths differ by less than this factor. The
# first one is kept. Coplanar surfaces then show no patches, although the lens bends planes
# slightly.
_SAME_DEPTH = 1.0 + 2e-5
# Triangles with less than twice this area, in squared samples, are not drawn.
_SMALLEST_AREA = 1e-9


@kernel
def fill_faces(
    pixels, inverse_depth, faces, chosen, geom, lit, paint, gloss, corner, scale, depth, colour
):
    """Fill faces into the buffers ``depth`` and ``colour``.

    Args:
        pixels: (v, 2) vertices in the picture, px.
        inverse_depth: (v,) 1 / m.
        faces: (f, 4) vertices of quadrilaterals. The last two of a triangle are equal.
        chosen: (k,) faces to fill.
        geom: (f,) row of each face in ``paint``.
        lit: (f, 4, 2) diffuse light and highlight at the corners.
        paint: (g, 4) float32 BGR of 0 to 255, and opacity: 255, or 0 for an occluder. An occluder
            hides the surfaces behind it and is not drawn. Its colour is black.
        gloss: Strength of the highlights, 0 to 255.
        corner: (2,) column and row of the first pixel of the buffers.
        scale: Samples per pixel along each axis.
        depth: (h, w) float32 inverse depth of the nearest surface, 1 / m; 0 where there is none.
        colour: (h, w, 4) uint8 BGR and opacity of that surface.
    """
    for i in range(len(chosen)):
        f = chosen[i]
        for k in range(1, 3):
            # The second triangle of a triangle has no area.
            if turn(pixels, faces[f, 0], faces[f, k], faces[f, k + 1]) < 0.0:
                fill_triangle(
                    pixels,
                    inverse_depth,
                    faces[f],
                    k,
                    lit[f],
                    paint[geom[f]],
                    gloss,
                    corner,
                    scale,
                    depth,
                    colour,
                )


@inlined
def turn(pixels, a, b, c):
    """Return twice the area of a triangle, which is negative if it shows its outside."""
    bx = pixels[b, 0] - pixels[a, 0]
    by = pixels[b, 1] - pixels[a, 1]
    cx = pixels[c, 0] - pixels[a, 0]
    cy = pixels[c, 1] - pixels[a, 1]
    return bx * cy - cx * by


@inlined
def _span(value, slope, first, last):
    """Return the part of the columns first to last where value + slope x is not negative."""
    if slope > 0.0:
        return max(first, math.ceil(-value / slope)), last
    if slope < 0.0:
        return first, min(last, math.floor(-value / slope))
    if value < 0.0:
        return first, first - 1
    return first, last


@inlined
def _byte(value):
    """Return a positive float32 as uint8, at most 255. The conversion through int32 is faster."""
    return np.uint8(np.int32(min(value, np.float32(255.0))))


@outlined
def fill_triangle(pixels, inverse_depth, face, k, lit, paint, gloss, corner, scale, depth, colour):
    """Fill the triangle of the corners 0, k and k + 1 of a face that shows its outside."""
    height, width = depth.shape
    # Buffer coordinates of the corners. Centres of pixels and of samples are integers.
    ax = (pixels[face[0], 0] - corner[0] + 0.5) * scale - 0.5
    ay = (pixels[face[0], 1] - corner[1] + 0.5) * scale - 0.5
    bx = (pixels[face[k], 0] - corner[0] + 0.5) * scale - 0.5
    by = (pixels[face[k], 1] - corner[1] + 0.5) * scale - 0.5
    cx = (pixels[face[k + 1], 0] - corner[0] + 0.5) * scale - 0.5
    cy = (pixels[face[k + 1], 1] - corner[1] + 0.5) * scale - 0.5
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if not area < -_SMALLEST_AREA:
        return
    left = max(math.ceil(min(ax, bx, cx) - _SEAM), 0)
    right = min(math.floor(max(ax, bx, cx) + _SEAM), width - 1)
    top = max(math.ceil(min(ay, by, cy) - _SEAM), 0)
    bottom = min(math.floor(max(ay, by, cy) + _SEAM), height - 1)
    if left > right or top > bottom:
        return

    # Barycentric coordinates of the second and third corner are linear: their slopes along x and y.
    b_x = (cy - ay) / area
    b_y = (ax - cx) / area
    c_x = (ay - by) / area
    c_y = (bx - ax) / area
    seam_a = _SEAM * (abs(b_x + c_x) + abs(b_y + c_y))
    seam_b = _SEAM * (abs(b_x) + abs(b_y))
    seam_c = _SEAM * (abs(c_x) + abs(c_y))
    # Inverse depth and light are linear in them.
    depth_a = inverse_depth[face[0]]
    depth_b = inverse_depth[face[k]] - depth_a
    depth_c = inverse_depth[face[k + 1]] - depth_a
    depth_x = b_x * depth_b + c_x * depth_c
    diffuse_b = lit[k, 0] - lit[0, 0]
    diffuse_c = lit[k + 1, 0] - lit[0, 0]
    shine_b = lit[k, 1] - lit[0, 1]
    shine_c = lit[k + 1, 1] - lit[0, 1]
    diffuse_x = np.float32(b_x * diffuse_b + c_x * diffuse_c)
    shine_x = np.float32(gloss * (b_x * shine_b + c_x * shine_c))
    blue = paint[0]
    green = paint[1]
    red = paint[2]
    opacity = np.uint8(paint[3])
    if opacity == 0:
        gloss = np.float32(0.0)
        shine_x = gloss

    for y in range(top, bottom + 1):
        b = b_y * (y - ay) - b_x * ax
        c = c_y * (y - ay) - c_x * ax
        first, last = _span(b + seam_b, b_x, left, right)
        first, last = _span(c + seam_c, c_x, first, last)
        first, last = _span(1.0 - b - c + seam_a, -b_x - c_x, first, last)
        if first > last:
            continue
        b += b_x * first
        c += c_x * first
        inverse = depth_a + b * depth_b + c * depth_c
        diffuse = np.float32(lit[0, 0] + b * diffuse_b + c * diffuse_c)
        shine = np.float32(gloss * (lit[0, 1] + b * shine_b + c * shine_c))
        for x in range(first, last + 1):
            if inverse > depth[y, x] * _SAME_DEPTH:
                depth[y, x] = inverse
                colour[y, x, 3] = opacity
                colour[y, x, 0] = _byte(blue * diffuse + shine)
                colour[y, x, 1] = _byte(green * diffuse + shine)
                colour[y, x, 2] = _byte(red * diffuse + shine)
            inverse += depth_x
            diffuse += diffuse_x
            shine += shine_x


@kernel
def lay_over(image, colour, coverage, alpha, left, top):
    """Blend a layer into ``image`` (h, w, 3) uint8, in place.

    Args:
        image: The picture that is changed.
        colour: (r, c, 3) uint8 BGR times coverage.
        coverage: (r, c) uint8, 255 where the layer hides the picture.
        alpha: Opacity of the layer, 0 to 1.
        left: Column of the layer's first pixel in the image.
        top: Row of it.
    """
    share = round(alpha * 256)
    for row in range(coverage.shape[0]):
        for column in range(coverage.shape[1]):
            cover = int(coverage[row, column])
            if cover == 255 and share == 256:
                for k in range(3):
                    image[row + top, column + left, k] = colour[row, column, k]
            elif cover > 0:
                # Fixed point with 16 bits: cover * share = 255 * 256 keeps nothing of the picture.
                keep = 65536 - ((cover * share * 65793 + 32768) >> 16)
                for k in range(3):
                    old = int(image[row + top, column + left, k])
                    new = int(colour[row, column, k])
                    mixed = (old * keep + new * share * 256 + 32768) >> 16
                    image[row + top, column + left, k] = np.uint8(min(mixed, 255))
