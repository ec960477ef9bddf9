"""Crossings of two edges of a chessboard, accurate to a few hundredths of a pixel.

Around a crossing the picture is point symmetric, whatever the blur of the lens. The corner is where
the model

    light + slope . p + contrast tanh(n1 . p / width) tanh(n2 . p / width),      p = pixel - corner,

fits best. Directions, width, light and contrast are fitted with it by Gauss-Newton to the grey
values of the pixels. No grey value is interpolated, so there is no bias towards pixel centres.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from robot_ik.ports import Array, Image, Mask

# Smallest radius of a patch with enough pixels for nine unknowns, and largest one, px. Larger
# patches take more time than their accuracy is worth.
_MIN_RADIUS = 2.5
_MAX_RADIUS = 9.0
_MAX_STEPS = 12
# The fit ends when no corner moves farther than this in a step, px.
_MOVE_TOLERANCE = 2e-4
# Damping relative to the diagonal. In small patches the directions are hardly visible.
_DAMPING = 1e-3
# Damping of the first, linear fit.
_LINEAR_DAMPING = 1e-9
# Width of a step in a sharp and in an extremely blurred picture, px.
_MIN_WIDTH = 0.3
_MAX_WIDTH = 6.0
# Largest move of a corner (px) and of a direction (rad) in one step.
_MAX_STEP = 1.0
_MAX_TURN = 0.3
# Scale of the slope among the unknowns, px.
_SLOPE_SCALE = 8.0
# A fit that leaves more than this part of its contrast is not a corner.
_MAX_MISFIT = 0.35
# Smallest contrast of a corner, grey levels. Less is noise.
_MIN_CONTRAST = 4.0
# Largest move of a corner from the detector's position, px. Detectors seldom have an error of a
# pixel. A corner farther away is a different corner.
_MAX_MOVE = 2.5


def refine_corners(
    gray: Image, start: Array, grid: Array, reach: float
) -> tuple[Array, Mask, Array]:
    """Fit each corner.

    Args:
        gray: (height, width).
        start: (n, 2) pixels, accurate to about 1.5 px.
        grid: (n, 2) column and row of each corner in squares.
        reach: Radius around a corner without a third edge, in squares.

    Returns:
        (n, 2) pixels; (n,) whether each is a corner; (n,) blur: the width of the steps, px.
    """
    along = _directions(start, grid)
    if along is None:
        return start, np.zeros(len(start), dtype=bool), np.zeros(len(start))
    smallest = np.linalg.svd(along, compute_uv=False)[:, 1]
    radius = np.clip(reach * smallest, _MIN_RADIUS, _MAX_RADIUS)
    pixels, values, weights, inside = _patches(gray, start, radius)
    # Unknowns: x, y, directions of both edges, width; then light, slope (2), contrast.
    first = along[:, :, 0]
    second = along[:, :, 1]
    first_angle = np.arctan2(first[:, 1], first[:, 0])
    second_angle = np.arctan2(second[:, 1], second[:, 0])
    shape = np.column_stack([start, first_angle, second_angle, np.ones(len(start))])
    weighted = values * weights
    light = np.zeros((len(start), 4))
    for step in range(_MAX_STEPS):
        crossing, derivatives, offset = _model(shape, pixels)
        bases = [np.ones_like(crossing)[..., None], offset / _SLOPE_SCALE, crossing[..., None]]
        linear = np.concatenate(bases, axis=2) * weights[..., None]
        if step == 0:
            light = _solve(linear, weighted, _LINEAR_DAMPING)
        by_shape = derivatives * (light[:, 3, None] * weights)[..., None]
        jacobian = np.concatenate([by_shape, linear], axis=2)
        residual = weighted - np.einsum("npk,nk->np", linear, light)
        change = _solve(jacobian, residual, _DAMPING)
        change[:, :2] = np.clip(change[:, :2], -_MAX_STEP, _MAX_STEP)
        change[:, 2:4] = np.clip(change[:, 2:4], -_MAX_TURN, _MAX_TURN)
        shape += change[:, :5]
        shape[:, 4] = np.clip(shape[:, 4], _MIN_WIDTH, _MAX_WIDTH)
        light += change[:, 5:]
        if np.abs(change[:, :2]).max() < _MOVE_TOLERANCE:
            break
    squares = (residual**2).sum(axis=1) / np.maximum((weights**2).sum(axis=1), 1e-9)
    misfit = np.sqrt(squares)
    contrast = np.abs(light[:, 3])
    is_corner = inside & (contrast > _MIN_CONTRAST) & (misfit < _MAX_MISFIT * contrast)
    is_corner &= np.hypot(*(shape[:, :2] - start).T) < _MAX_MOVE
    return shape[:, :2], is_corner, shape[:, 4]


def _directions(start: Array, grid: Array) -> Array | None:
    """Return the pixels per square (n, 2, 2) at each corner.

    The columns of the matrices are along columns and rows of the board. None if the corners have no
    homography.
    """
    homography: Any = cv2.findHomography(grid, start)[0]
    if homography is None:
        return None
    h = np.asarray(homography, dtype=float)
    p = np.column_stack([grid, np.ones(len(grid))]) @ h.T
    projected = p[:, :2] / p[:, 2:]
    numerator = h[None, :2, :2] - projected[:, :, None] * h[None, 2:, :2]
    return np.asarray(numerator / p[:, 2, None, None])


def _patches(gray: Image, start: Array, radius: Array) -> tuple[Array, Array, Array, Mask]:
    """Return the pixels around corners.

    Returns:
        Pixels (n, p, 2), their grey levels (n, p), weights (n, p), and whether the patch is inside
        the picture (n,).
    """
    half = int(np.ceil(radius.max()))
    height, width = gray.shape
    center = np.rint(start)
    last = np.maximum(np.array([width, height]) - 1 - half, half)
    held = np.clip(center, half, last).astype(int)
    inside = np.asarray((held == center).all(axis=1), dtype=bool)
    side = np.arange(-half, half + 1)
    offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    pixels = held[:, None] + offsets
    rows = np.minimum(pixels[..., 1], height - 1)
    columns = np.minimum(pixels[..., 0], width - 1)
    values = gray[rows, columns].astype(float)
    distance = np.linalg.norm(pixels - start[:, None], axis=2)
    # The weight fades over one pixel at the rim.
    weights = np.clip(radius[:, None] + 0.5 - distance, 0.0, 1.0)
    return pixels.astype(float), values, weights, inside


def _model(shape: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Return crossing (n, p), its derivatives (n, p, 5) by the shape, and offset (n, p, 2)."""
    offset = pixels - shape[:, None, :2]
    width = shape[:, 4, None]
    across = []
    steps = []
    slopes = []
    normals = []
    by_angle = []
    for k in (2, 3):
        c = np.cos(shape[:, k, None])
        s = np.sin(shape[:, k, None])
        across.append((c * offset[..., 1] - s * offset[..., 0]) / width)
        step = np.tanh(across[-1])
        steps.append(step)
        slopes.append((1.0 - step * step) / width)
        normals.append((-s, c))
        by_angle.append(-s * offset[..., 1] - c * offset[..., 0])
    first = steps[1] * slopes[0]
    second = steps[0] * slopes[1]
    derivatives = np.stack(
        [
            -(first * normals[0][0] + second * normals[1][0]),
            -(first * normals[0][1] + second * normals[1][1]),
            first * by_angle[0],
            second * by_angle[1],
            -(first * across[0] + second * across[1]),
        ],
        axis=2,
    )
    return steps[0] * steps[1], derivatives, offset


def _solve(jacobian: Array, residual: Array, damping: float) -> Array:
    """Solve n damped least-squares problems: (n, p, k), (n, p) -> (n, k)."""
    normal = np.einsum("npi,npj->nij", jacobian, jacobian)
    right = np.einsum("npi,np->ni", jacobian, residual)
    k = normal.shape[1]
    diagonal = normal[:, range(k), range(k)]
    normal[:, range(k), range(k)] = diagonal * (1.0 + damping) + 1e-9
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])
