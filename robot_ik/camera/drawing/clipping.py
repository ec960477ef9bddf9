"""Faces cut off where they leave the part of space that a camera sees."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics

Array = NDArray[np.float64]

# Clipped faces are cut this fraction of the view outside it, where the lens model still holds.
_MARGIN = 0.06


@lru_cache(maxsize=16)
def view_planes(intrinsics: CameraIntrinsics, near: float) -> Array:
    """Inward planes (5, 4) round the view, n . p + d >= 0 inside: near (metres), left, right, top, bottom."""
    x = np.linspace(-0.5, intrinsics.width - 0.5, 33)
    y = np.linspace(-0.5, intrinsics.height - 0.5, 33)
    edges = [(x, np.full(33, y[0])), (x, np.full(33, y[-1])), (np.full(33, x[0]), y), (np.full(33, x[-1]), y)]
    border = intrinsics.undistort(np.concatenate([np.stack(e, axis=1) for e in edges]))
    border = border[np.isfinite(border).all(axis=1)]
    low, high = border.min(axis=0), border.max(axis=0)
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
