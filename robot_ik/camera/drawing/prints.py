"""Prints, rectangles of ink on paper: laid flat as a page, or as a camera sees them.

Every pixel is the exact mean of what falls on it, not a mean of samples.  Flat, it is a box among the borders
of the print's cells.  Before a camera it is a parallelogram on the paper, whose ink is an integral along its
outline (Green's theorem).  The map from picture to paper is linear within a pixel, so an edge lies where it
belongs to 1e-4 px, and to 2e-4 px on a print that is tilted by 60 degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.rays import RayField
from robot_ik.camera.image import Box, marker_boxes
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image, Mask

#: A marker's axes (x right, y up, z out of the paper) seen from its print's (x right, y down, z into it).
PRINT_MARKER = Pose.from_rotation(np.diag([1.0, -1.0, -1.0]))

# Subpixels per pixel side where the outline of something in front crosses a pixel.
_SUB = 4
# Away from any sheet, metres.
_FAR = 1e6
# What is nearer to the lens than this, metres, is not seen.
_NEAR = 0.02
# Borders closer together than this share of the paper are one.
_SAME = 1e-9
# Ink of a cell beyond the paper: more than any sum of others.
_BEYOND = 1e6
# Pixels on edges are done so many at a time.
_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class Print:
    """Ink on one sheet of paper; any unit of length, x to the right and y down.

    Attributes:
        x: (k + 1,) borders of the columns of cells, from one edge of the paper to the other; ``y``: (m + 1,).
        ink: (m, k) in each cell, from 0 for paper to 1 for black.
    """

    x: Array
    y: Array
    ink: Array

    @classmethod
    def of_boxes(
        cls, boxes: Array, paper: tuple[float, float, float, float], ink: Array | None = None
    ) -> Print:
        """The paper with rectangles on it.

        Args:
            boxes: (n, 4) x, y, width, height; what lies beyond the paper is cut off.
            paper: Likewise.
            ink: (n,) of each rectangle; black when not given.  Where two overlap the darker one shows.
        """
        dark = np.ones(len(boxes)) if ink is None else ink
        low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:4]
        x, columns = _borders(paper[0], paper[2], low[:, 0], high[:, 0])
        y, rows = _borders(paper[1], paper[3], low[:, 1], high[:, 1])
        cells = np.zeros((len(y) - 1, len(x) - 1))
        for (left, right), (top, bottom), shade in zip(columns, rows, dark, strict=True):
            part = cells[top:bottom, left:right]
            np.maximum(part, shade, out=part)
        return cls(x, y, cells)

    @cached_property
    def outline(self) -> Array:
        """Points (32, 3) along the edge of the paper, which may be bent in a picture."""
        t = np.linspace(0.0, 1.0, 8, endpoint=False)
        one, none = np.ones(8), np.zeros(8)
        along = np.concatenate([t, one, 1.0 - t, none]), np.concatenate([none, t, one, 1.0 - t])
        x, y = (
            border[0] + (border[-1] - border[0]) * a
            for border, a in zip((self.x, self.y), along, strict=True)
        )
        return np.stack([x, y, np.zeros(32)], axis=1)

    @cached_property
    def below(self) -> Array:
        """Integrals of ink and of paper down each column, and nothing on either side: (2, m + 1, k + 2)."""
        density = np.stack([self.ink, np.ones_like(self.ink)])
        sums = np.cumsum(density * np.diff(self.y)[:, None], axis=1)
        return np.pad(sums, ((0, 0), (1, 0), (1, 1)))

    @cached_property
    def counts(self) -> Array:
        """Sums (m + 3, k + 3) of ink over cells; in a ring beyond the paper each counts ``_BEYOND``."""
        cells = np.pad(self.ink, 1, constant_values=_BEYOND)
        return np.pad(np.cumsum(np.cumsum(cells, axis=0), axis=1), ((1, 0), (1, 0)))

    def flat(self, width: int, height: int) -> Image:
        """The print (height, width) as grey pixels of side 1 from the origin on: 255 paper, 0 ink."""
        total = np.pad(np.cumsum(self.below[0, :, 1:-1] * np.diff(self.x), axis=1), ((0, 0), (1, 0)))
        for borders, count in ((self.y, height), (self.x, width)):
            at = _cell_places(borders, np.arange(count + 1.0))
            k = np.minimum(at.astype(np.int64), len(borders) - 2)
            part = (at - k)[:, None]
            # along one side, then, turned, along the other
            total = np.diff(total[k] * (1.0 - part) + total[k + 1] * part, axis=0).T
        return np.rint(255.0 * (1.0 - np.clip(total, 0.0, 1.0))).astype(np.uint8, order="C")

    def mean(self, at: Array, by_pixel: Array) -> tuple[Array, Array]:
        """Mean ink over pixels and the part of them that is paper, each (n,); exact.

        Args:
            at: (2, n) where the centres of the pixels are on the paper.
            by_pixel: (2, 2, n) derivative of x and y by the pixel's column and row.
        """
        across, down = 0.5 * by_pixel[:, 0], 0.5 * by_pixel[:, 1]
        corners = at[:, None] + np.stack(
            [-across - down, across - down, across + down, down - across], axis=1
        )
        first, last = (
            np.stack([np.searchsorted(b, c) for b, c in zip((self.x, self.y), ends, strict=True)])
            for ends in (corners.min(axis=1), corners.max(axis=1))
        )
        on_edge = ((first == 0) | (last == [[len(self.x)], [len(self.y)]])).any(axis=0)
        crossed = (last - first).max(axis=0)
        sums = np.zeros((2, at.shape[1]))
        for count in np.unique(crossed):
            for edge in (False, True):
                same = np.flatnonzero((crossed == count) & (on_edge == edge))
                # As many at a time as a processor keeps near.
                for some in np.array_split(same, -(-len(same) // _AT_ONCE) or 1):
                    tables = self.below if edge else self.below[:1]
                    sums[: len(tables), some] = self._around(
                        tables, corners[..., some], first[:, some], int(count)
                    )
        ink, paper = -sums / (4.0 * (across[0] * down[1] - across[1] * down[0]))
        paper[~on_edge] = 1.0
        return ink, paper

    def _around(self, tables: Array, corners: Array, first: NDArray[np.int64], count: int) -> Array:
        """Integrals (t, n) of some of ``below`` (t, ...) by x around quadrilaterals.

        Args:
            tables: What is integrated.
            corners: (2, 4, n) in turn.
            first: (2, n) the first border that one may cross, of columns and of rows.
            count: How many borders either way.
        """
        step = np.roll(corners, -1, axis=1) - corners
        steps = np.where(step == 0.0, 1e-300, step)
        ends = np.zeros((2 * count + 2, *corners.shape[1:]))
        ends[-1] = 1.0
        for k, borders in enumerate((self.x, self.y)):
            for j in range(count):
                near = borders[np.minimum(first[k] + j, len(borders) - 1)]
                ends[1 + k * count + j] = np.clip((near - corners[k]) / steps[k], 0.0, 1.0)
        ends.sort(axis=0)
        # Between two cuts the integrand is linear: its middle says it all.
        x, y = corners[:, None] + step[:, None] * (0.5 * (ends[1:] + ends[:-1]))
        column = np.searchsorted(self.x, x)
        row = _cell_places(self.y, y)
        above = np.minimum(row.astype(np.int64), len(self.y) - 2)
        part, at = row - above, above * tables.shape[2] + column
        width = step[0] * np.diff(ends, axis=0)
        sums = []
        for table in tables.reshape(len(tables), -1):
            value = table[at] * (1.0 - part) + table[at + tables.shape[2]] * part
            sums.append((value * width).sum(axis=(0, 1)))
        return np.stack(sums)


def _borders(start: float, length: float, low: Array, high: Array) -> tuple[Array, NDArray[np.int64]]:
    """Borders of cells along one side of the paper, and between which ones each box lies (n, 2)."""
    ends = np.clip(np.stack([low, high], axis=1), start, start + length)
    every = np.unique(np.concatenate([ends.ravel(), [start, start + length]]))
    borders = every[np.diff(every, prepend=-np.inf) > _SAME * length]
    return borders, np.searchsorted(borders, ends - _SAME * length)


def _cell_places(borders: Array, at: Array) -> Array:
    """Places ``at`` in numbers of cells, those beyond the paper put on its edge."""
    return np.interp(at, borders, np.arange(len(borders), dtype=float))


@lru_cache(maxsize=64)
def marker_print(dictionary: str, marker: int, size: float, margin: float, bleed: float = 0.0) -> Print:
    """A marker on white paper; metres from the middle of the marker.

    Args:
        dictionary: OpenCV's name of it.
        marker: Id in it.
        size: Side of the black border.
        margin: Paper beyond it.
        bleed: Ink reaches so far beyond the black cells.

    Raises:
        CameraError: Unknown dictionary, or no such id in it.
    """
    half = 0.5 * size
    boxes = marker_boxes(dictionary, marker, size) - np.array([half, half, 0.0, 0.0])
    boxes += np.array([-bleed, -bleed, 2.0 * bleed, 2.0 * bleed])
    edge = half + max(margin, bleed)
    return Print.of_boxes(boxes, (-edge, -edge, 2.0 * edge, 2.0 * edge))


def blank_paper(side: float, ink: float = 0.0) -> Print:
    """A square of one tone round its middle, metres."""
    edges = np.array([-0.5 * side, 0.5 * side])
    return Print(edges, edges, np.full((1, 1), ink))


@dataclass(frozen=True, eq=False)
class SeenPrint:
    """A print as it falls on the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels, half open.
        coverage: (h, w) part of each pixel that shows the paper, 0..1.
        ink: (h, w) mean ink of that part, 0..1.
        visible: Part of the paper inside the picture that nothing hides, 0..1.
        depth: (h, w) distance of the paper's plane along the optical axis, metres; NaN where there is none.
    """

    box: Box
    coverage: Array
    ink: Array
    visible: float
    depth: Array


#: For pixels (n, 2) and depths (n,), in metres: whether an object there is nearer than the depth.
Blocker = Callable[[Array, Array], Mask]


def see_print(
    sheet: Print, pose_camera_print: Pose, field: RayField, blocked: Blocker | None = None
) -> SeenPrint | None:
    """Projects a print; ``None`` when its face is turned away or outside the picture.

    Args:
        sheet: In metres.
        pose_camera_print: The print (x right, y down, z into the paper) seen from the camera.
        field: Rays of the camera.
        blocked: Asks for objects in front; ``None`` means that there are none.
    """
    box = print_box(sheet, pose_camera_print, field)
    if box is None:
        return None
    rays = field.box(*box)
    x, y, depth = _on_plane(rays, pose_camera_print)
    (x_down, x_across), (y_down, y_across) = np.gradient(x), np.gradient(y)
    usable = np.isfinite(x_down + x_across + y_down + y_across)
    ink, paper = np.zeros(x.shape), np.zeros(x.shape)
    slopes = np.stack([x_across, x_down, y_across, y_down])
    mixed = _fill_uniform(sheet, (x, y), slopes, usable, ink, paper)
    by_pixel = slopes.reshape(2, 2, *x.shape)
    ink[mixed], paper[mixed] = sheet.mean(np.stack([x[mixed], y[mixed]]), by_pixel[..., mixed])
    whole = paper.sum()
    if blocked is not None:
        _hide(sheet, pose_camera_print, field, box, by_pixel, blocked, depth, ink, paper)
    paper = np.clip(paper, 0.0, 1.0)
    visible = float(paper.sum() / max(whole, 1e-9))
    return SeenPrint(box, paper, np.clip(ink / np.maximum(paper, 1e-9), 0.0, 1.0), visible, depth)


def print_box(sheet: Print, pose_camera_print: Pose, field: RayField) -> Box | None:
    """Return the pixels that a print can touch, all of them if it reaches the lens.

    None if its face is turned away or outside the picture.
    """
    if pose_camera_print.rotation[:, 2] @ pose_camera_print.position <= 0:
        return None
    outline = pose_camera_print.apply(sheet.outline)
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


def _on_plane(normalized: Array, pose_camera_print: Pose) -> tuple[Array, Array, Array]:
    """Where rays (..., 2) meet the plane of a print: x, y, depth (...), NaN where a ray misses it."""
    a, b = normalized[..., 0], normalized[..., 1]
    # By columns: OpenBLAS spreads a product of so narrow an array over all cores, which takes longer.
    along_x, along_y, along_z = (p * a + q * b + r for p, q, r in pose_camera_print.rotation.T)
    origin_x, origin_y, origin_z = pose_camera_print.position @ pose_camera_print.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = origin_z / along_z
    depth = np.where(depth > _NEAR, depth, np.nan)
    return along_x * depth - origin_x, along_y * depth - origin_y, depth


def _fill_uniform(
    sheet: Print, at: tuple[Array, Array], slopes: Array, usable: Mask, ink: Array, paper: Array
) -> Mask:
    """Fills pixels (h, w) on which there is one tone; returns which ones show more than one."""
    x_across, x_down, y_across, y_down = slopes
    ends = []
    for borders, centre, half in (
        (sheet.x, at[0], 0.5 * (np.abs(x_across) + np.abs(x_down))),
        (sheet.y, at[1], 0.5 * (np.abs(y_across) + np.abs(y_down))),
    ):
        ends += [np.searchsorted(borders, centre - half), np.searchsorted(borders, centre + half) + 1]
    left, right, top, bottom = ends
    table, count = sheet.counts, (right - left) * (bottom - top)
    total = table[bottom, right] - table[bottom, left] - table[top, right] + table[top, left]
    beyond = ~usable | (total == _BEYOND * count)
    uniform = ~beyond & ((total == 0.0) | (total == count) | (count == 1))
    ink[uniform], paper[uniform] = total[uniform] / count[uniform], 1.0
    return ~(uniform | beyond)


def _hide(
    sheet: Print,
    pose_camera_print: Pose,
    field: RayField,
    box: Box,
    by_pixel: Array,
    blocked: Blocker,
    depth: Array,
    ink: Array,
    paper: Array,
) -> None:
    """Takes away the paper that something hides, in place; by subpixels along the outline of that object."""
    asked = paper > 0
    hidden = np.zeros(depth.shape, dtype=bool)
    rows, columns = np.nonzero(asked)
    hidden[asked] = blocked(np.stack([columns + box[0], rows + box[1]], axis=1), depth[asked])
    if not hidden.any():
        return
    around = np.ones((3, 3), np.uint8)
    byte = hidden.astype(np.uint8)
    rows, columns = np.nonzero((cv2.dilate(byte, around) != cv2.erode(byte, around)) & asked)
    shift = (np.arange(_SUB) + 0.5) / _SUB - 0.5
    offsets = np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)
    pixels = (np.stack([columns + box[0], rows + box[1]], axis=1)[:, None] + offsets).reshape(-1, 2)
    x, y, far = _on_plane(field.points(pixels), pose_camera_print)
    # subpixels that look past the plane see none of it
    at = np.nan_to_num(np.stack([x, y]), nan=_FAR)
    slopes = np.repeat(by_pixel[..., rows, columns] / _SUB, len(offsets), axis=-1)
    parts = sheet.mean(at, slopes)
    shown = ~blocked(pixels, far)
    ink[hidden], paper[hidden] = 0.0, 0.0
    for total, part in zip((ink, paper), parts, strict=True):
        total[rows, columns] = (part * shown).reshape(-1, len(offsets)).mean(axis=1)
