"""Printed markers as a camera sees them: exact edges through the lens, partly hidden by other things.

Every (sub)pixel is mapped back onto the paper, where the print is integrated over the subpixel's
footprint in closed form (summed areas of its cells).  So an edge lies where it belongs to about 0.001 px,
not on a raster of samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.raycast import RayField
from robot_ik.errors import CameraError, close_matches
from robot_ik.geometry import Pose

Array = NDArray[np.float64]
Box = tuple[int, int, int, int]
Condition = Literal["printed", "blank", "covered"]

# Reflectances of print, paper and the patch that covers a marker: a laser print in a lit room.
INK, PAPER, PATCH = 0.07, 0.93, 0.45
# Subpixels per pixel side where print or outline changes inside the pixel.
_SUB = 4
# Depth in metres by which something must be nearer than the paper to hide it: paper lies on things.
_SLACK = 1.5e-3
_NEAR = 0.02


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined dictionary, e.g. ``DICT_5X5_50``.

    Raises:
        CameraError: No dictionary of that name; the message lists the close ones.
    """
    known = [n for n in dir(cv2.aruco) if n.startswith("DICT_")]
    if name not in known:
        raise CameraError(
            f"unknown marker dictionary {name!r}",
            hint=f"similar: {', '.join(close_matches(name, known)) or ', '.join(sorted(known)[:12])}",
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


# Cells away from any sheet.
_FAR = 1e6


@dataclass(frozen=True)
class Sheet:
    """Summed reflectance of one printed sheet; lengths in cells, origin at the marker's upper left corner.

    Attributes:
        lines: (k,) cell borders along either side, from paper edge to paper edge.
        tone: (k, k) integral of reflectance from the paper's corner; rows run down the marker.
        area: (k, k) integral of 1: the paper's own outline.
        cells: Cells along a side of the marker, border included.
    """

    lines: Array
    tone: Array
    area: Array
    cells: int

    def integrate(self, u: Array, v: Array, half_u: Array, half_v: Array) -> tuple[Array, Array]:
        """Mean reflectance times coverage, and coverage (each (n,)), over boxes round (u, v) in cells."""
        # Pixels that look nowhere (beyond the fold of the lens, along the paper) see none of it.
        lost = ~np.isfinite(u + v + half_u + half_v)
        if lost.any():
            u, v = np.where(lost, _FAR, u), np.where(lost, _FAR, v)
            half_u, half_v = np.where(lost, 1.0, half_u), np.where(lost, 1.0, half_v)
        left, right = self._place(u - half_u), self._place(u + half_u)
        top, bottom = self._place(v - half_v), self._place(v + half_v)
        size = 4.0 * half_u * half_v
        result = []
        for table in (self.tone, self.area):
            total = _bilinear(table, bottom, right) - _bilinear(table, bottom, left)
            total += _bilinear(table, top, left) - _bilinear(table, top, right)
            result.append(total / size)
        return result[0], result[1]

    def _place(self, at: Array) -> Array:
        return np.interp(at, self.lines, np.arange(len(self.lines), dtype=float))


def _bilinear(table: Array, row: Array, column: Array) -> Array:
    last = table.shape[0] - 2
    i = np.minimum(row.astype(np.int64), last)
    j = np.minimum(column.astype(np.int64), last)
    a, b = row - i, column - j
    flat, width = table.reshape(-1), table.shape[1]
    k = i * width + j
    upper = flat[k] * (1 - b) + flat[k + 1] * b
    lower = flat[k + width] * (1 - b) + flat[k + width + 1] * b
    return np.asarray(upper * (1 - a) + lower * a)


@lru_cache(maxsize=64)
def make_sheet(dictionary: str, marker: int, margin_cells: float, condition: Condition) -> Sheet:
    """The print of one marker on white paper reaching ``margin_cells`` beyond its black border.

    Raises:
        CameraError: Unknown dictionary, or no such id in it.
    """
    table = dictionary_by_name(dictionary)
    count = len(table.bytesList)
    if not 0 <= marker < count:
        raise CameraError(f"{dictionary} has no marker {marker}", hint=f"its ids are 0 to {count - 1}")
    cells = int(table.markerSize) + 2
    bits = cv2.aruco.generateImageMarker(table, marker, cells, borderBits=1)
    tones = np.full((cells + 2, cells + 2), PATCH if condition == "covered" else PAPER)
    if condition == "printed":
        tones[1:-1, 1:-1] = np.where(bits > 127, PAPER, INK)
    lines = np.concatenate([[-margin_cells], np.arange(cells + 1.0), [cells + margin_cells]])
    widths = np.diff(lines)
    area = np.outer(widths, widths)
    sums = [
        np.pad(np.cumsum(np.cumsum(x * area, axis=0), axis=1), ((1, 0), (1, 0)))
        for x in (tones, np.ones_like(tones))
    ]
    return Sheet(lines, sums[0], sums[1], cells)


@dataclass(frozen=True)
class PaintedMarker:
    """One marker as it falls on the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels, half open.
        coverage: (h, w) part of each pixel that shows the paper, 0..1.
        tone: (h, w) mean reflectance of that part.
        visible: Part of the paper inside the picture that nothing hides, 0..1.
        depth: (h, w) distance of the paper's plane along the optical axis, metres.
    """

    box: Box
    coverage: Array
    tone: Array
    visible: float
    depth: Array


def paper_outline(size: float, margin: float) -> Array:
    """Points (36, 3) along the paper's edge in the marker frame, metres."""
    half = size / 2 + margin
    t = np.linspace(-half, half, 9, endpoint=False)
    side = np.full(len(t), half)
    xy = np.concatenate([np.stack(p, axis=1) for p in ((t, side), (side, -t), (-t, -side), (-side, t))])
    return np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)


def _pixel_box(outline: Array, field: RayField) -> Box | None:
    """Pixels that the outline (n, 3) in the camera frame can touch; all of them when it reaches the lens."""
    w, h = field.intrinsics.size
    if (outline[:, 2] <= 0).all():
        return None
    normalized = outline[:, :2] / np.maximum(outline[:, 2:], 1e-9)
    outside = np.hypot(normalized[:, 0], normalized[:, 1]) > field.intrinsics.radius_limit
    if (outline[:, 2] < _NEAR).any() or outside.any():
        return 0, 0, w, h
    pixels = field.intrinsics.distort(normalized)
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 2, 0, (w, h))
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 3, 0, (w, h))
    if (high - low < 2).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


class _Plane:
    """Maps viewing rays to cell coordinates on one marker."""

    def __init__(self, pose_camera_marker: Pose, size: float, cells: int) -> None:
        self._axes, self._origin = pose_camera_marker.rotation, pose_camera_marker.position
        self._scale, self._half = cells / size, cells / 2.0

    def map(self, normalized: Array) -> tuple[Array, Array, Array]:
        """Cells u, v and depth (m), each (...), of rays (..., 2); depth NaN where a ray misses the plane."""
        x, y = normalized[..., 0], normalized[..., 1]
        # By columns: OpenBLAS spreads a product of so narrow an array over all cores, which takes longer.
        along_x, along_y, along_z = (a * x + b * y + c for a, b, c in self._axes.T)
        origin_x, origin_y, origin_z = self._origin @ self._axes
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = origin_z / along_z
        depth = np.where(depth > _NEAR, depth, np.nan)
        u = self._half + self._scale * (along_x * depth - origin_x)
        v = self._half - self._scale * (along_y * depth - origin_y)
        return u, v, depth


Blocker = Callable[[Array, Array], NDArray[np.bool_]]
"""Tells for rays (n, 2) and depths (n,) whether something is nearer than that depth."""


def paint_marker(
    sheet: Sheet,
    size: float,
    margin: float,
    pose_camera_marker: Pose,
    field: RayField,
    blocked: Blocker | None,
) -> PaintedMarker | None:
    """Projects a sheet exactly; ``None`` when its face is turned away or outside the picture.

    Args:
        sheet: What is printed.
        size: Side of the black border, metres; ``margin``: white paper beyond it, metres.
        margin: See ``size``.
        pose_camera_marker: Marker (x right, y up, z out of the print) seen from the camera.
        field: Rays of the camera.
        blocked: Asks for things in front; ``None`` means that there are none.
    """
    # a print is seen only from its front
    if pose_camera_marker.rotation[:, 2] @ pose_camera_marker.position >= 0:
        return None
    box = _pixel_box(pose_camera_marker.apply(paper_outline(size, margin)), field)
    if box is None:
        return None
    x, y = np.arange(box[0], box[2], dtype=float), np.arange(box[1], box[3], dtype=float)
    plane = _Plane(pose_camera_marker, size, sheet.cells)
    centre = field.box(*box)
    u, v, depth = plane.map(centre)
    half_u, half_v = (0.5 * np.hypot(*np.gradient(c)) for c in (u, v))
    usable = np.isfinite(u + v + half_u + half_v)
    u, v, half_u, half_v = (np.where(usable, c, 1e6 if c is u else 1.0) for c in (u, v, half_u, half_v))
    tone, area = sheet.integrate(u.ravel(), v.ravel(), 2 * half_u.ravel(), 2 * half_v.ravel())
    tone, area = tone.reshape(u.shape), area.reshape(u.shape)
    uniform = _uniform(tone, area)
    hidden, partly = _hidden(centre, depth, usable & (area > 0), blocked)
    shown, tones, whole = np.where(hidden, 0.0, area), np.where(hidden, 0.0, tone), area.copy()
    fine = np.nonzero(usable & (~uniform | (partly & (area > 0))))
    if len(fine[0]):
        pixels = np.stack([x[fine[1]], y[fine[0]]], axis=1)
        cell = np.stack([half_u[fine], half_v[fine]], axis=1)
        asks = blocked if (partly | hidden)[fine].any() else None
        whole[fine], shown[fine], tones[fine] = _subpixels(sheet, plane, field, pixels, cell, asks)
    shown = np.clip(shown, 0.0, 1.0)
    visible = float(shown.sum() / max(whole.sum(), 1e-9))
    tones = np.where(shown > 1e-9, tones / np.maximum(shown, 1e-9), PAPER)
    return PaintedMarker(box, shown, tones, visible, depth)


def _subpixels(
    sheet: Sheet, plane: _Plane, field: RayField, pixels: Array, cell: Array, blocked: Blocker | None
) -> tuple[Array, Array, Array]:
    """Paper in each of ``pixels`` (n, 2), the part of it that is seen, and its reflectance times that part.

    ``cell`` (n, 2) are half widths of a pixel in cells; each result is (n,).
    """
    shift = (np.arange(_SUB) + 0.5) / _SUB - 0.5
    offsets = np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)
    count = len(offsets)
    rays = field.points((pixels[:, None] + offsets).reshape(-1, 2))
    u, v, depth = plane.map(rays)
    half = np.repeat(cell / _SUB, count, axis=0)
    tone, area = sheet.integrate(u, v, half[:, 0], half[:, 1])
    whole = area.reshape(-1, count).mean(axis=1)
    if blocked is not None:
        ask = np.flatnonzero(area > 0)
        gone = ask[blocked(rays[ask], depth[ask])]
        tone[gone], area[gone] = 0.0, 0.0
    return whole, area.reshape(-1, count).mean(axis=1), tone.reshape(-1, count).mean(axis=1)


def _uniform(tone: Array, area: Array) -> NDArray[np.bool_]:
    """Pixels whose double-sized footprint shows one tone only, or no paper at all."""
    full = area > 1 - 1e-9
    flat = np.zeros_like(full)
    for value in (INK, PAPER, PATCH):
        flat |= np.abs(tone - value) < 1e-9
    return np.asarray((area < 1e-9) | (full & flat))


def _hidden(
    rays: Array, depth: Array, asked: NDArray[np.bool_], blocked: Blocker | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels whose centre is hidden, and pixels whose neighbours say otherwise, each (h, w)."""
    hidden = np.zeros(depth.shape, dtype=bool)
    if blocked is None or not asked.any():
        return hidden, hidden
    hidden[asked] = blocked(rays[asked], depth[asked])
    if not hidden.any():
        return hidden, hidden
    byte = hidden.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    return hidden, cv2.dilate(byte, kernel) != cv2.erode(byte, kernel)


def nearer(depth: Array, than: Array) -> NDArray[np.bool_]:
    """Whether things at ``depth`` hide paper at depth ``than``."""
    return np.asarray(depth < than - _SLACK)
