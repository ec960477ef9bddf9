"""Compiled: the corners of faces through pose and lens, and the light on them."""

from __future__ import annotations

import math
from typing import Any

from robot_ik.camera.lens_kernels import CX, CY, FX, FY, bend_point
from robot_ik.kernels.jit import kernel, pure


@kernel
def place(vertices: Any, owner: Any, rotation: Any, position: Any, placed: Any) -> None:
    """``placed`` (v, 3): ``vertices`` (v, 3) turned and moved with their geom ``owner`` (v,)."""
    for k in range(len(vertices)):
        g = owner[k]
        x, y, z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        for i in range(3):
            placed[k, i] = (
                rotation[g, i, 0] * x + rotation[g, i, 1] * y + rotation[g, i, 2] * z + position[g, i]
            )


@kernel
def through_lens(
    points: Any, lens: Any, near: float, limit: float, pixels: Any, inverse: Any, within: Any
) -> bool:
    """Where ``points`` (v, 3) of the camera frame are in the picture of a camera (``lens_vector``).

    Args:
        points: Metres.
        lens: (14,) of the camera.
        near: What is not beyond this, metres, cannot be seen.
        limit: Nor what is farther off the axis than this, of its depth; it is put there.
        pixels: (v, 2) gets the pixels, ``inverse`` (v,) one over depth, ``within`` (v,) what can be seen.
        inverse: See ``pixels``.
        within: See ``pixels``.

    Returns:
        Whether all can be seen.
    """
    all_within = True
    for k in range(len(points)):
        z = points[k, 2]
        w = 1.0 / max(z, 0.5 * near)
        x, y = points[k, 0] * w, points[k, 1] * w
        r2 = x * x + y * y
        within[k] = z > near and r2 < limit * limit
        if not within[k]:
            all_within = False
            if r2 > limit * limit:
                shrink = limit / math.sqrt(r2)
                x, y = x * shrink, y * shrink
        u, v, _, _, _ = bend_point(lens, x, y)
        pixels[k, 0], pixels[k, 1], inverse[k] = lens[FX] * u + lens[CX], lens[FY] * v + lens[CY], w
    return all_within


@pure
def _from_behind(p: Any, face: Any) -> bool:
    """Whether the lens sees the inside of both halves of a face."""
    ax, ay, cx, cy = p[face[0], 0], p[face[0], 1], p[face[2], 0], p[face[2], 1]
    bx, by, dx, dy = p[face[1], 0], p[face[1], 1], p[face[3], 0], p[face[3], 1]
    one = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    two = (cx - ax) * (dy - ay) - (dx - ax) * (cy - ay)
    return one >= 0.0 and two >= 0.0


@kernel
def light_corners(
    normals: Any,
    faces: Any,
    owner: Any,
    pixels: Any,
    every: bool,
    light: Any,
    half: Any,
    ambient: float,
    lit: Any,
) -> None:
    """``lit`` (f, 4, 2): diffuse light and highlight at each corner of each face that shows its outside.

    Args:
        normals: (f, 4, 3) at the corners, in geom frames.
        faces: (f, 4) into ``pixels`` (v, 2); ``owner`` (f,) geom of each.
        owner: See ``faces``.
        pixels: See ``faces``.
        every: Light all, also what shows its inside.
        light: (g, 3) unit direction to the light in each geom's frame.
        half: (g, 3) the one halfway to the viewer (Blinn 1977).
        ambient: Light everywhere.
        lit: Gets the light.
    """
    for f in range(len(normals)):
        if not every and _from_behind(pixels, faces[f]):
            continue
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
