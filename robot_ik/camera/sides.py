"""The sides of markers as bent curves in the picture, and the pixels beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.edges import EdgeFit, EdgePixels
from robot_ik.camera.intrinsics import CameraIntrinsics

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Pixels per edge are limited by taking at most this many columns (or rows) across it.
_COLUMNS = 64
# Places along an edge at which its bent curve is computed; in between it is straight enough.
_STATIONS = 17
# The band is also kept inside the outer cell: fraction of the cell used.
_CELL_PART = 0.75
_LEAST_BAND = 1.6
# Pixels within this distance of a corner see two edges at once.
CORNER_GAP = 2.5


class Sides:
    """The 4m sides of m markers as bent curves in the picture, crossed by columns (or rows) of pixels.

    A side that runs more along x than along y is crossed by picture columns, the others by rows; in the
    arrays below ``main`` is the coordinate along and ``cross`` the one across.
    """

    def __init__(self, corners: Array, intrinsics: CameraIntrinsics, cells: int, band: float) -> None:
        m = len(corners)
        ideal = intrinsics.undistort(corners.reshape(-1, 2)).reshape(m, 4, 2)
        t = np.linspace(0.0, 1.0, _STATIONS)
        line = ideal[:, :, None] + t[:, None] * (np.roll(ideal, -1, axis=1) - ideal)[:, :, None]
        curve = intrinsics.distort(line.reshape(-1, 2)).reshape(4 * m, _STATIONS, 2)
        chord = curve[:, -1] - curve[:, 0]
        self.steep = np.abs(chord[:, 1]) > np.abs(chord[:, 0])
        curve = np.where(self.steep[:, None, None], curve[:, :, ::-1], curve)
        centre = np.repeat(corners.mean(axis=1), 4, axis=0)
        length = np.linalg.norm(chord, axis=1)
        self.shortest = length.reshape(m, 4).min(axis=1)
        # Height of the marker over each side: twice the area of the triangle to the centre, over the side.
        reach = curve[:, 0] - np.where(self.steep[:, None], centre[:, ::-1], centre)
        along = curve[:, -1] - curve[:, 0]
        height = 2 * np.abs(reach[:, 0] * along[:, 1] - reach[:, 1] * along[:, 0]) / np.maximum(length, 1e-9)
        self.cell = height / cells
        self.band = np.clip(_CELL_PART * self.cell, _LEAST_BAND, band)
        self._cross_columns(curve, t, np.where(self.steep, centre[:, 0], centre[:, 1]), length)
        self._corner_normals(curve, m)

    def _cross_columns(self, curve: Array, t: Array, centre: Array, length: Array) -> None:
        """Whole columns along each side, and where the curve crosses them."""
        s = len(curve)
        gap = CORNER_GAP * np.abs(curve[:, -1, 0] - curve[:, 0, 0]) / np.maximum(length, 1e-9)
        first = np.minimum(curve[:, 0, 0], curve[:, -1, 0]) + gap
        last = np.maximum(curve[:, 0, 0], curve[:, -1, 0]) - gap
        low, high = np.ceil(first), np.floor(last)
        columns = np.rint(low[:, None] + np.linspace(0, 1, _COLUMNS) * (high - low)[:, None])
        self.use = np.ones((s, _COLUMNS))
        self.use[:, 1:] = np.diff(columns, axis=1) > 0
        # Columns at the ends, and pixels at the border of the band below, fade in over one pixel: with a hard
        # border the fit can jump between two sets of pixels for ever.
        self.use *= np.clip(np.minimum(columns - first[:, None], last[:, None] - columns), 0.0, 1.0)
        self.columns = columns
        self.along, self.cross, slope = (np.empty((s, _COLUMNS)) for _ in range(3))
        for i in range(s):
            order = slice(None) if curve[i, -1, 0] > curve[i, 0, 0] else slice(None, None, -1)
            main, cross = curve[i, order, 0], curve[i, order, 1]
            self.along[i] = np.interp(columns[i], main, t[order])
            self.cross[i] = np.interp(columns[i], main, cross)
            middle = 0.5 * (main[1:] + main[:-1])
            slope[i] = np.interp(columns[i], middle, np.diff(cross) / np.maximum(np.diff(main), 1e-9))
        # Light lies outside the black square: away from its centre.
        self.sign = np.where(curve[:, :, 1].mean(axis=1) > centre, 1.0, -1.0)
        self.cosine = 1.0 / np.sqrt(1.0 + slope**2)

    def _corner_normals(self, curve: Array, m: int) -> None:
        """Outward unit normals (m, 4, 2, 2) of the two sides that meet in each corner: own, previous."""
        ends = np.stack([curve[:, 1] - curve[:, 0], curve[:, -1] - curve[:, -2]], axis=1)
        normal = np.stack([-ends[..., 1], ends[..., 0]], axis=2)
        normal *= np.sign(normal[..., 1] * self.sign[:, None])[..., None]
        normal /= np.maximum(np.linalg.norm(normal, axis=2), 1e-12)[..., None]
        normal = np.where(self.steep[:, None, None], normal[..., ::-1], normal).reshape(m, 4, 2, 2)
        self.normals = np.stack([normal[:, :, 0], np.roll(normal[:, :, 1], 1, axis=1)], axis=2)

    def pixels(self, gray: Image) -> EdgePixels:
        """The pixels of the band, as they are in the picture."""
        reach = int(((self.band[:, None] + 0.5) / self.cosine).max() + 0.5)
        rows = np.rint(self.cross)[:, :, None] + np.arange(-reach, reach + 1)
        columns = np.broadcast_to(self.columns[:, :, None], rows.shape)
        distance = (rows - self.cross[:, :, None]) * (self.cosine * self.sign[:, None])[:, :, None]
        steep = self.steep[:, None, None]
        x, y = np.where(steep, rows, columns), np.where(steep, columns, rows)
        h, w = gray.shape
        use = np.clip(self.band[:, None, None] + 0.5 - np.abs(distance), 0.0, 1.0) * self.use[:, :, None]
        use = use * ((x >= 0) & (x < w) & (y >= 0) & (y < h))
        x = np.clip(np.nan_to_num(x), 0, w - 1).astype(np.intp)
        y = np.clip(np.nan_to_num(y), 0, h - 1).astype(np.intp)
        flat = (len(rows), -1)
        along = np.broadcast_to(self.along[:, :, None], rows.shape)
        return EdgePixels(
            np.nan_to_num(distance).reshape(flat),
            np.nan_to_num(along).reshape(flat),
            gray[y, x].astype(float).reshape(flat),
            np.nan_to_num(use).reshape(flat),
        )

    def move_corners(self, fit: EdgeFit) -> tuple[Array, Array]:
        """Shift (m, 4, 2) of the corners in px, and the covariance (m, 8, 8) of all eight numbers.

        A corner moves so that it lies on both of its displaced sides: normal . shift = offset, twice.
        """
        m = len(self.normals)
        offset = fit.offset.reshape(m, 4, 2)
        both = np.stack([offset[:, :, 0], np.roll(offset[:, :, 1], 1, axis=1)], axis=2)
        determinant = np.linalg.det(self.normals)
        safe = np.where((np.abs(determinant) > 0.05)[..., None, None], self.normals, np.nan * np.eye(2))
        inverse = np.full_like(self.normals, np.nan)
        fine = np.isfinite(safe).all(axis=(1, 2, 3))
        if fine.any():
            inverse[fine] = np.linalg.inv(safe[fine])
        shift = np.einsum("mkij,mkj->mki", inverse, both)
        # Linear map (8, 8) from the offsets (side k: first end, second end) to the corners.
        to_corner = np.zeros((m, 8, 8))
        for k in range(4):
            to_corner[:, 2 * k : 2 * k + 2, 2 * k] = inverse[:, k, :, 0]
            to_corner[:, 2 * k : 2 * k + 2, (2 * k - 1) % 8] = inverse[:, k, :, 1]
        ends = np.zeros((m, 8, 8))
        # Light of the next cell leaks over the border when that is hardly wider than the blur; the leak at
        # one border width is the tail of a Gaussian.
        leak = fit.blur * np.exp(-0.5 * (self.cell / fit.blur) ** 2)
        per_side = (fit.covariance + np.eye(2) * (leak**2)[:, None, None]).reshape(m, 4, 2, 2)
        for k in range(4):
            ends[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = per_side[:, k]
        return shift, to_corner @ ends @ to_corner.transpose(0, 2, 1)
