"""Prints: rectangles of ink on paper, drawn as a flat page or as a camera sees them.

The value of every pixel is the exact mean over its area, not a mean of samples. On a flat page a
pixel is a box. In the picture of a camera it is a parallelogram on the paper, whose ink is an
integral along its outline (Green's theorem). The map from picture to paper is linear within a
pixel, so an edge is exact to 1e-4 px, and to 2e-4 px on a print that is tilted by 60 degrees.
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

#: For pixels (n, 2) and depths (n,), in metres: whether an object there is nearer than the depth.
Blocker = Callable[[Array, Array], Mask]
#: A marker's axes (x right, y up, z out of the paper) seen from its print (x right, y down, z in).
PRINT_MARKER = Pose.from_rotation(np.diag([1.0, -1.0, -1.0]))
#: Subpixels per pixel, along each axis, where the outline of an object in front crosses a pixel.
SUBPIXELS = 4

# Coordinate outside every sheet, metres.
_BEYOND_PLACE = 1e6
# Points nearer to the lens than this are not drawn, metres.
_NEAR = 0.02
# Borders closer together than this part of the paper are merged.
_SAME_BORDER = 1e-9
# Ink of a cell beyond the paper: more than any sum of the ink of other cells.
_BEYOND_INK = 1e6
# Pixels on edges are computed in groups of this size, which fit into the cache of a processor.
_GROUP = 4096
# Points along each side of the paper.
_SIDE_POINTS = 8
# Margin of the box round an outline, px.
_BOX_MARGIN = 2


@dataclass(frozen=True, eq=False)
class Print:
    """Ink on one sheet of paper, in any unit of length, x to the right and y down.

    Attributes:
        x: (k + 1,) borders of the columns of cells, from one edge of the paper to the other.
        y: (m + 1,) borders of the rows.
        ink: (m, k) in each cell, from 0 for paper to 1 for black.
    """

    x: Array
    y: Array
    ink: Array

    @classmethod
    def of_boxes(
        cls, boxes: Array, paper: tuple[float, float, float, float], ink: Array | None = None
    ) -> Print:
        """Return the paper with rectangles on it.

        Args:
            boxes: (n, 4) x, y, width, height. The parts beyond the paper are cut off.
            paper: x, y, width, height.
            ink: (n,) of each rectangle; default: black. The darker one of overlapping rectangles
                shows.
        """
        dark = np.ones(len(boxes)) if ink is None else ink
        lower = boxes[:, :2]
        upper = lower + boxes[:, 2:4]
        x, columns = _borders(paper[0], paper[2], lower[:, 0], upper[:, 0])
        y, rows = _borders(paper[1], paper[3], lower[:, 1], upper[:, 1])
        cells = np.zeros((len(y) - 1, len(x) - 1))
        for (left, right), (top, bottom), shade in zip(columns, rows, dark, strict=True):
            part = cells[top:bottom, left:right]
            np.maximum(part, shade, out=part)
        return cls(x, y, cells)

    @cached_property
    def outline(self) -> Array:
        """Points (32, 3) along the edge of the paper, which may be bent in a picture."""
        t = np.linspace(0.0, 1.0, _SIDE_POINTS, endpoint=False)
        one = np.ones(_SIDE_POINTS)
        zero = np.zeros(_SIDE_POINTS)
        across = np.concatenate([t, one, 1.0 - t, zero])
        down = np.concatenate([zero, t, one, 1.0 - t])
        x = self.x[0] + (self.x[-1] - self.x[0]) * across
        y = self.y[0] + (self.y[-1] - self.y[0]) * down
        return np.stack([x, y, np.zeros(len(x))], axis=1)

    @cached_property
    def below(self) -> Array:
        """Integrals of ink and of paper down each column, (2, m + 1, k + 2).

        There is a column of zeros on either side.
        """
        density = np.stack([self.ink, np.ones_like(self.ink)])
        sums = np.cumsum(density * np.diff(self.y)[:, None], axis=1)
        return np.pad(sums, ((0, 0), (1, 0), (1, 1)))

    @cached_property
    def counts(self) -> Array:
        """Sums (m + 3, k + 3) of ink over cells. Cells in a ring beyond the paper are marked."""
        cells = np.pad(self.ink, 1, constant_values=_BEYOND_INK)
        return np.pad(np.cumsum(np.cumsum(cells, axis=0), axis=1), ((1, 0), (1, 0)))

    def flat(self, width: int, height: int) -> Image:
        """Return the print (height, width) as grey pixels of side 1: 255 for paper, 0 for ink."""
        sums = np.cumsum(self.below[0, :, 1:-1] * np.diff(self.x), axis=1)
        total = np.pad(sums, ((0, 0), (1, 0)))
        # Along one side, then, transposed, along the other.
        for borders, count in ((self.y, height), (self.x, width)):
            at = _cell_places(borders, np.arange(count + 1.0))
            k = np.minimum(at.astype(np.int64), len(borders) - 2)
            part = (at - k)[:, None]
            total = np.diff(total[k] * (1.0 - part) + total[k + 1] * part, axis=0).T
        return np.rint(255.0 * (1.0 - np.clip(total, 0.0, 1.0))).astype(np.uint8, order="C")

    def mean(self, at: Array, by_pixel: Array) -> tuple[Array, Array]:
        """Return the exact mean ink of pixels and the part of them that is paper, each (n,).

        Args:
            at: (2, n) positions of the centres of the pixels on the paper.
            by_pixel: (2, 2, n) derivative of x and y by the pixel's column and row.
        """
        across = 0.5 * by_pixel[:, 0]
        down = 0.5 * by_pixel[:, 1]
        offsets = [-across - down, across - down, across + down, down - across]
        corners = at[:, None] + np.stack(offsets, axis=1)
        first = self._border_numbers(corners.min(axis=1))
        last = self._border_numbers(corners.max(axis=1))
        on_edge = ((first == 0) | (last == [[len(self.x)], [len(self.y)]])).any(axis=0)
        crossed = (last - first).max(axis=0)
        sums = np.zeros((2, at.shape[1]))
        for count in np.unique(crossed):
            for edge in (False, True):
                same = np.flatnonzero((crossed == count) & (on_edge == edge))
                for group in np.array_split(same, -(-len(same) // _GROUP) or 1):
                    tables = self.below if edge else self.below[:1]
                    sums[: len(tables), group] = self._around(
                        tables, corners[..., group], first[:, group], int(count)
                    )
        area = 4.0 * (across[0] * down[1] - across[1] * down[0])
        ink, paper = -sums / area
        paper[~on_edge] = 1.0
        return ink, paper

    def _border_numbers(self, places: Array) -> NDArray[np.int64]:
        """Return how many borders of columns and of rows (2, n) are before places (2, n)."""
        return np.stack([np.searchsorted(self.x, places[0]), np.searchsorted(self.y, places[1])])

    def _around(self, tables: Array, corners: Array, first: NDArray[np.int64], count: int) -> Array:
        """Return the integrals (t, n) of some of ``below`` (t, ...) by x around quadrilaterals.

        Args:
            tables: Tables to integrate.
            corners: (2, 4, n) in order along the outline.
            first: (2, n) the first border that a quadrilateral may cross, of columns and of rows.
            count: The largest number of borders that it crosses, in either direction.
        """
        step = np.roll(corners, -1, axis=1) - corners
        divisor = np.where(step == 0.0, 1e-300, step)
        cuts = np.zeros((2 * count + 2, *corners.shape[1:]))
        cuts[-1] = 1.0
        for k, borders in enumerate((self.x, self.y)):
            for j in range(count):
                border = borders[np.minimum(first[k] + j, len(borders) - 1)]
                cuts[1 + k * count + j] = np.clip((border - corners[k]) / divisor[k], 0.0, 1.0)
        cuts.sort(axis=0)
        # The integrand is linear between two cuts, so its middle is enough.
        x, y = corners[:, None] + step[:, None] * (0.5 * (cuts[1:] + cuts[:-1]))
        column = np.searchsorted(self.x, x)
        row = _cell_places(self.y, y)
        above = np.minimum(row.astype(np.int64), len(self.y) - 2)
        part = row - above
        at = above * tables.shape[2] + column
        width = step[0] * np.diff(cuts, axis=0)
        sums = []
        for table in tables.reshape(len(tables), -1):
            value = table[at] * (1.0 - part) + table[at + tables.shape[2]] * part
            sums.append((value * width).sum(axis=(0, 1)))
        return np.stack(sums)


@dataclass(frozen=True, eq=False)
class ProjectedPrint:
    """A print in the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels, half open.
        coverage: (h, w) part of each pixel that shows the paper, 0 to 1.
        ink: (h, w) mean ink of that part, 0 to 1.
        visible: Part of the paper inside the picture that nothing hides, 0 to 1.
        depth: (h, w) distance of the paper's plane along the optical axis, metres. NaN where a ray
            does not meet it.
    """

    box: Box
    coverage: Array
    ink: Array
    visible: float
    depth: Array


@lru_cache(maxsize=64)
def marker_print(
    dictionary: str, marker: int, size: float, margin: float, bleed: float = 0.0
) -> Print:
    """Return a marker on white paper, in metres from the middle of the marker.

    Args:
        dictionary: OpenCV's name of the dictionary.
        marker: Id in the dictionary.
        size: Side of the black border, metres.
        margin: Paper beyond the border, metres.
        bleed: Ink beyond the black cells, metres.

    Raises:
        CameraError: Unknown dictionary, or no such id in it.
    """
    half = 0.5 * size
    boxes = marker_boxes(dictionary, marker, size) - np.array([half, half, 0.0, 0.0])
    boxes += np.array([-bleed, -bleed, 2.0 * bleed, 2.0 * bleed])
    edge = half + max(margin, bleed)
    return Print.of_boxes(boxes, (-edge, -edge, 2.0 * edge, 2.0 * edge))


def blank_paper(side: float, ink: float = 0.0) -> Print:
    """Return a square of one tone, in metres from its middle."""
    edges = np.array([-0.5 * side, 0.5 * side])
    return Print(edges, edges, np.full((1, 1), ink))


def project_print(
    sheet: Print, pose_camera_print: Pose, field: RayField, blocked: Blocker | None = None
) -> ProjectedPrint | None:
    """Project a print.

    Args:
        sheet: In metres.
        pose_camera_print: The print (x right, y down, z into the paper) seen from the camera.
        field: Rays of the camera.
        blocked: Whether objects are in front of points. None: no objects.

    Returns:
        None if the face of the print is turned away or outside the picture.
    """
    box = print_box(sheet, pose_camera_print, field)
    if box is None:
        return None
    x, y, depth = _on_plane(field.box(*box), pose_camera_print)
    x_down, x_across = np.gradient(x)
    y_down, y_across = np.gradient(y)
    usable = np.isfinite(x_down + x_across + y_down + y_across)
    ink = np.zeros(x.shape)
    paper = np.zeros(x.shape)
    slopes = np.stack([x_across, x_down, y_across, y_down])
    mixed = _fill_uniform(sheet, (x, y), slopes, usable, ink, paper)
    by_pixel = slopes.reshape(2, 2, *x.shape)
    places = np.stack([x[mixed], y[mixed]])
    ink[mixed], paper[mixed] = sheet.mean(places, by_pixel[..., mixed])
    total = paper.sum()
    if blocked is not None:
        _hide(sheet, pose_camera_print, field, box, by_pixel, blocked, depth, ink, paper)
    paper = np.clip(paper, 0.0, 1.0)
    visible = float(paper.sum() / max(total, 1e-9))
    tone = np.clip(ink / np.maximum(paper, 1e-9), 0.0, 1.0)
    return ProjectedPrint(box, paper, tone, visible, depth)


def print_box(sheet: Print, pose_camera_print: Pose, field: RayField) -> Box | None:
    """Return the pixels that a print can touch, all of them if it reaches the lens.

    None if its face is turned away or outside the picture.
    """
    if pose_camera_print.rotation[:, 2] @ pose_camera_print.position <= 0:
        return None
    outline = pose_camera_print.apply(sheet.outline)
    width, height = field.intrinsics.size
    if (outline[:, 2] <= 0).all():
        return None
    normalized = outline[:, :2] / np.maximum(outline[:, 2:], 1e-9)
    outside = np.hypot(normalized[:, 0], normalized[:, 1]) > field.intrinsics.radius_limit
    if (outline[:, 2] < _NEAR).any() or outside.any():
        return 0, 0, width, height
    pixels = field.intrinsics.distort(normalized)
    lower = np.floor(pixels.min(axis=0)).astype(int) - _BOX_MARGIN
    upper = np.ceil(pixels.max(axis=0)).astype(int) + _BOX_MARGIN + 1
    lower = np.clip(lower, 0, (width, height))
    upper = np.clip(upper, 0, (width, height))
    if (upper - lower < 2).any():
        return None
    return int(lower[0]), int(lower[1]), int(upper[0]), int(upper[1])


def _borders(
    start: float, length: float, lower: Array, upper: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Return the borders of cells along one side of the paper, and the borders of each box.

    The second result (n, 2) has the indices of the two borders between which each box lies.
    """
    ends = np.clip(np.stack([lower, upper], axis=1), start, start + length)
    every = np.unique(np.concatenate([ends.ravel(), [start, start + length]]))
    borders = every[np.diff(every, prepend=-np.inf) > _SAME_BORDER * length]
    return borders, np.searchsorted(borders, ends - _SAME_BORDER * length)


def _cell_places(borders: Array, at: Array) -> Array:
    """Return places ``at`` in numbers of cells. Places beyond the paper are moved to its edge."""
    return np.interp(at, borders, np.arange(len(borders), dtype=float))


def _on_plane(normalized: Array, pose_camera_print: Pose) -> tuple[Array, Array, Array]:
    """Return the points in which rays (..., 2) meet the plane of a print: x, y, depth (...).

    They are NaN where a ray does not meet it. The products are computed by columns, because
    OpenBLAS spreads a product of so narrow an array over all cores, which takes longer.
    """
    a = normalized[..., 0]
    b = normalized[..., 1]
    along_x, along_y, along_z = (p * a + q * b + r for p, q, r in pose_camera_print.rotation.T)
    origin_x, origin_y, origin_z = pose_camera_print.position @ pose_camera_print.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = origin_z / along_z
    depth = np.where(depth > _NEAR, depth, np.nan)
    return along_x * depth - origin_x, along_y * depth - origin_y, depth


def _fill_uniform(
    sheet: Print, at: tuple[Array, Array], slopes: Array, usable: Mask, ink: Array, paper: Array
) -> Mask:
    """Write ``ink`` and ``paper`` of pixels (h, w) with one tone. Return the mask of the others."""
    x_across, x_down, y_across, y_down = slopes
    half_x = 0.5 * (np.abs(x_across) + np.abs(x_down))
    half_y = 0.5 * (np.abs(y_across) + np.abs(y_down))
    left = np.searchsorted(sheet.x, at[0] - half_x)
    right = np.searchsorted(sheet.x, at[0] + half_x) + 1
    top = np.searchsorted(sheet.y, at[1] - half_y)
    bottom = np.searchsorted(sheet.y, at[1] + half_y) + 1
    table = sheet.counts
    count = (right - left) * (bottom - top)
    total = table[bottom, right] - table[bottom, left] - table[top, right] + table[top, left]
    beyond = ~usable | (total == _BEYOND_INK * count)
    uniform = ~beyond & ((total == 0.0) | (total == count) | (count == 1))
    ink[uniform] = total[uniform] / count[uniform]
    paper[uniform] = 1.0
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
    """Remove hidden paper from ``ink`` and ``paper``, in place.

    Pixels along the outline of the object in front are computed by subpixels.
    """
    shown = paper > 0
    hidden = np.zeros(depth.shape, dtype=bool)
    rows, columns = np.nonzero(shown)
    pixels = np.stack([columns + box[0], rows + box[1]], axis=1).astype(float)
    hidden[shown] = blocked(pixels, depth[shown])
    if not hidden.any():
        return
    around = np.ones((3, 3), np.uint8)
    byte = hidden.astype(np.uint8)
    outline = cv2.dilate(byte, around) != cv2.erode(byte, around)
    rows, columns = np.nonzero(outline & shown)
    shift = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    offsets = np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)
    centres = np.stack([columns + box[0], rows + box[1]], axis=1).astype(float)
    pixels = (centres[:, None] + offsets).reshape(-1, 2)
    x, y, far = _on_plane(field.points(pixels), pose_camera_print)
    # Subpixels whose rays do not meet the plane show none of it.
    at = np.nan_to_num(np.stack([x, y]), nan=_BEYOND_PLACE)
    slopes = np.repeat(by_pixel[..., rows, columns] / SUBPIXELS, len(offsets), axis=-1)
    part_ink, part_paper = sheet.mean(at, slopes)
    visible = ~blocked(pixels, far)
    ink[hidden] = 0.0
    paper[hidden] = 0.0
    ink[rows, columns] = (part_ink * visible).reshape(-1, len(offsets)).mean(axis=1)
    paper[rows, columns] = (part_paper * visible).reshape(-1, len(offsets)).mean(axis=1)
