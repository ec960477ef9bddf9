"""The viewing ray of each point of a calibrated picture."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array

# Rays are computed at nodes this far apart, px, and interpolated cubically. The error stays below
# 1e-3 px even for fisheye lenses.
_NODE_DISTANCE = 10.0


class RayField:
    """Undistorted viewing rays of a camera at any point of its picture.

    Attributes:
        intrinsics: The camera.
    """

    def __init__(self, intrinsics: CameraIntrinsics) -> None:
        self.intrinsics = intrinsics
        w, h = intrinsics.size
        x = np.linspace(-1.0, w, max(4, int(np.ceil(w / _NODE_DISTANCE)) + 1))
        y = np.linspace(-1.0, h, max(4, int(np.ceil(h / _NODE_DISTANCE)) + 1))
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        # The lens model has no ray for corners beyond its range. They get the ray along the optical
        # axis.
        normalized = np.nan_to_num(intrinsics.undistort(grid.reshape(-1, 2))).reshape(*grid.shape)
        # X/Z + i Y/Z of every pixel centre and of a border of one pixel. Complex numbers allow one
        # lookup for both coordinates.
        columns = _cubic_weights(x, np.arange(-1.0, w + 1)).T
        rows = _cubic_weights(y, np.arange(-1.0, h + 1))
        self._map = np.empty((h + 2, w + 2), dtype=np.complex128)
        self._map.real = rows @ (normalized[..., 0] @ columns)
        self._map.imag = rows @ (normalized[..., 1] @ columns)

    def box(self, x0: int, y0: int, x1: int, y1: int) -> Array:
        """Return normalized coordinates (y1 - y0, x1 - x0, 2) of a block of pixel centres."""
        return _pairs(self._map[y0 + 1 : y1 + 1, x0 + 1 : x1 + 1])

    def points(self, pixels: Array) -> Array:
        """Return normalized coordinates (n, 2) of pixels (n, 2).

        The pixels may be up to one pixel outside the picture. The coordinates are linear between
        pixel centres. A lens bends by a few 1e-3 px within a pixel.
        """
        w, h = self.intrinsics.size
        left = np.clip(np.floor(pixels[:, 0]).astype(np.int64), -1, w - 1)
        top = np.clip(np.floor(pixels[:, 1]).astype(np.int64), -1, h - 1)
        u = pixels[:, 0] - left
        v = pixels[:, 1] - top
        flat = self._map.reshape(-1)
        width = w + 2
        k = (top + 1) * width + left + 1
        upper = flat[k] * (1 - u) + flat[k + 1] * u
        lower = flat[k + width] * (1 - u) + flat[k + width + 1] * u
        return _pairs(upper * (1 - v) + lower * v)


@lru_cache(maxsize=4)
def ray_field(intrinsics: CameraIntrinsics) -> RayField:
    """Return the (cached) ray field of a camera."""
    return RayField(intrinsics)


def world_directions(pose_world_camera: Pose, normalized: Array) -> Array:
    """Return world directions (..., 3) of normalized coordinates (..., 2).

    Their component along the optical axis is 1. The product is computed by columns, because
    OpenBLAS spreads a product of so narrow an array over all cores, which takes five times as long.
    """
    x = normalized[..., 0]
    y = normalized[..., 1]
    result = np.empty((*x.shape, 3))
    for row, (a, b, c) in enumerate(pose_world_camera.rotation):
        np.multiply(x, a, out=result[..., row])
        result[..., row] += b * y
        result[..., row] += c
    return result


def _cubic_weights(nodes: Array, at: Array) -> Array:
    """Return the matrix (m, n) that interpolates values at ``nodes`` (n,) to ``at`` (m,).

    The nodes are evenly spaced. The interpolation is that of Lagrange through four nodes.
    """
    step = nodes[1] - nodes[0]
    position = (at - nodes[0]) / step
    left = np.clip(np.floor(position).astype(int) - 1, 0, len(nodes) - 4)
    t = position - left
    weights = np.zeros((len(at), len(nodes)))
    rows = np.arange(len(at))
    for k in range(4):
        value = np.ones(len(at))
        for j in range(4):
            if j != k:
                value *= (t - j) / (k - j)
        weights[rows, left + k] = value
    return weights


def _pairs(values: NDArray[np.complex128]) -> Array:
    """Return complex numbers (...) as pairs (..., 2)."""
    return np.ascontiguousarray(values).view(np.float64).reshape(*values.shape, 2)
