"""Where two edges of a chessboard cross, to a few hundredths of a pixel.

Round a crossing the picture is point symmetric, however the lens blurs it.  The corner is where the model

    light + slope . p + contrast tanh(n1 . p / width) tanh(n2 . p / width),      p = pixel - corner,

fits best.  Its directions, width, light and contrast are found with it, by Gauss and Newton over the pixels
as they are: nothing is interpolated, so that nothing pulls towards pixel centres.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from robot_ik.ports import Array, Image, Mask

# Smallest patch that still holds nine unknowns, and the largest that is worth its time, px.
_RADII = (2.5, 9.0)
_STEPS = 12
# Corners that move no farther than this in a step have been found.
_SETTLED_PX = 2e-4
# Damping relative to the diagonal: the directions are hardly seen where the patch is small.
_DAMPING = 1e-3
# Widths that a step in a sharp and in a hopelessly blurred picture has, px.
_WIDTHS = (0.3, 6.0)
# A corner whose fit leaves more than this part of its contrast is none.
_LARGEST_MISFIT = 0.35
# Grey levels; less contrast is noise.
_LEAST_CONTRAST = 4.0
# The detectors are seldom a pixel off; whatever went farther has found another corner.
_LARGEST_MOVE = 2.5


def refine_corners(gray: Image, start: Array, grid: Array, reach: float) -> tuple[Array, Mask, Array]:
    """Fits each corner.

    Args:
        gray: (height, width).
        start: (n, 2) pixels to within about 1.5 px.
        grid: (n, 2) column and row of each corner in squares.
        reach: Radius round a corner, in squares, in which there is no third edge.

    Returns:
        (n, 2) pixels; (n,) which of them are corners; (n,) blur: the width of the steps in pixels.
    """
    along = _directions(start, grid)
    if along is None:
        return start, np.zeros(len(start), dtype=bool), np.zeros(len(start))
    radius = np.clip(reach * np.linalg.svd(along, compute_uv=False)[:, 1], *_RADII)
    pixels, values, weights, inside = _patches(gray, start, radius)
    # Unknowns: x, y, direction of the first and second edge, width; then light, slope (2), contrast.
    first, second = along[:, :, 0], along[:, :, 1]
    shape = np.column_stack(
        [
            start,
            np.arctan2(first[:, 1], first[:, 0]),
            np.arctan2(second[:, 1], second[:, 0]),
            np.ones(len(start)),
        ]
    )
    weighted = values * weights
    light = np.zeros((len(start), 4))
    for step in range(_STEPS):
        crossing, slopes, offset = _model(shape, pixels)
        linear = np.concatenate(
            [np.ones_like(crossing)[..., None], offset / 8.0, crossing[..., None]], axis=2
        )
        linear *= weights[..., None]
        if step == 0:
            light = _solve(linear, weighted, 1e-9)
        jacobian = np.concatenate([slopes * (light[:, 3, None] * weights)[..., None], linear], axis=2)
        residual = weighted - np.einsum("npk,nk->np", linear, light)
        change = _solve(jacobian, residual, _DAMPING)
        change[:, :2] = np.clip(change[:, :2], -1.0, 1.0)
        change[:, 2:4] = np.clip(change[:, 2:4], -0.3, 0.3)
        shape += change[:, :5]
        shape[:, 4] = np.clip(shape[:, 4], *_WIDTHS)
        light += change[:, 5:]
        if np.abs(change[:, :2]).max() < _SETTLED_PX:
            break
    misfit = np.sqrt((residual**2).sum(axis=1) / np.maximum((weights**2).sum(axis=1), 1e-9))
    contrast = np.abs(light[:, 3])
    good = inside & (contrast > _LEAST_CONTRAST) & (misfit < _LARGEST_MISFIT * contrast)
    good &= np.hypot(*(shape[:, :2] - start).T) < _LARGEST_MOVE
    return shape[:, :2], good, shape[:, 4]


def _directions(start: Array, grid: Array) -> Array | None:
    """(n, 2, 2) pixels per square at each corner, columns along columns and rows of the board."""
    homography: Any = cv2.findHomography(grid, start)[0]
    if homography is None:
        return None
    h = np.asarray(homography, dtype=float)
    p = np.column_stack([grid, np.ones(len(grid))]) @ h.T
    seen = p[:, :2] / p[:, 2:]
    return np.asarray((h[None, :2, :2] - seen[:, :, None] * h[None, 2:, :2]) / p[:, 2, None, None])


def _patches(gray: Image, start: Array, radius: Array) -> tuple[Array, Array, Array, Mask]:
    """Pixels (n, p, 2), their grey levels (n, p), weights (n, p), and whether the patch is inside (n,)."""
    half = int(np.ceil(radius.max()))
    height, width = gray.shape
    centre = np.rint(start)
    held = np.clip(centre, half, np.maximum(np.array([width, height]) - 1 - half, half)).astype(int)
    inside = np.asarray((held == centre).all(axis=1), dtype=bool)
    side = np.arange(-half, half + 1)
    offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    at = held[:, None] + offsets
    values = gray[np.minimum(at[..., 1], height - 1), np.minimum(at[..., 0], width - 1)].astype(float)
    away = np.linalg.norm(at - start[:, None], axis=2)
    # Fades over one pixel at the rim.
    weights = np.clip(radius[:, None] + 0.5 - away, 0.0, 1.0)
    return at.astype(float), values, weights, inside


def _model(shape: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """The crossing (n, p), its derivatives (n, p, 5) by the shape, and the way from the corner (n, p, 2)."""
    offset = pixels - shape[:, None, :2]
    width = shape[:, 4, None]
    across, steps, slopes, normals, by_angle = [], [], [], [], []
    for k in (2, 3):
        c, s = np.cos(shape[:, k, None]), np.sin(shape[:, k, None])
        across.append((c * offset[..., 1] - s * offset[..., 0]) / width)
        step = np.tanh(across[-1])
        steps.append(step)
        slopes.append((1.0 - step * step) / width)
        normals.append((-s, c))
        by_angle.append(-s * offset[..., 1] - c * offset[..., 0])
    one, two = steps[1] * slopes[0], steps[0] * slopes[1]
    derivatives = np.stack(
        [
            -(one * normals[0][0] + two * normals[1][0]),
            -(one * normals[0][1] + two * normals[1][1]),
            one * by_angle[0],
            two * by_angle[1],
            -(one * across[0] + two * across[1]),
        ],
        axis=2,
    )
    return steps[0] * steps[1], derivatives, offset


def _solve(jacobian: Array, residual: Array, damping: float) -> Array:
    """n damped least-squares problems: (n, p, k), (n, p) -> (n, k)."""
    normal = np.einsum("npi,npj->nij", jacobian, jacobian)
    right = np.einsum("npi,np->ni", jacobian, residual)
    k = normal.shape[1]
    diagonal = normal[:, range(k), range(k)]
    normal[:, range(k), range(k)] = diagonal * (1.0 + damping) + 1e-9
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])
