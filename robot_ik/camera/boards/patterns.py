"""Flat patterns to calibrate with: ChArUco boards and chessboards, found to a fraction of a pixel.

The board frame is OpenCV's: origin at the outer corner of the first square (ChArUco) or at the first inner
corner (chessboard), x along the columns, y along the rows, z *into* the board.  A print seen upright has x
right and y down.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.chess_corner import refine_corners
from robot_ik.camera.opencv import dictionary_size, marker_bits, marker_dictionary, quiet
from robot_ik.errors import CalibrationError

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Fewer corners of a ChArUco board than these do not hold a view against a wrong one among them.
_FEWEST_CORNERS = 6
# How far from a corner its picture is its own, in gaps between square and marker: the nearest marker's corner
# is the root of 2 away, and blur takes some of that.
_GAP_REACH = 1.2
# A view needs corners on both sides of the board: two lines of them at least.
_FEWEST_LINES = 2


@dataclass(frozen=True, eq=False)
class FoundPattern:
    """The corners of a pattern in one picture.

    Attributes:
        points_board: (n, 3) metres, z = 0, in the board frame.
        pixels: (n, 2) distorted pixels, integer pixel centres.
        ids: (n,) number of each corner: column + row * columns of inner corners.
        blur: Width of the edges at the corners, pixels (median): about 1.2 times the blur's sigma.
    """

    points_board: Array
    pixels: Array
    ids: NDArray[np.int64]
    blur: float = 0.0


class Pattern(Hashable, Protocol):
    """What a calibration pattern can do."""

    @property
    def columns(self) -> int:
        """How many columns, counted as OpenCV counts them for this pattern."""
        ...

    @property
    def rows(self) -> int:
        """How many rows, counted likewise."""
        ...

    @property
    def square(self) -> float:
        """Side of a square, metres."""
        ...

    @property
    def corners(self) -> tuple[int, int]:
        """Inner corners along the columns and rows."""
        ...

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the print, metres."""
        ...

    @property
    def origin(self) -> tuple[float, float]:
        """Where the print's upper left corner is in the board frame, metres."""
        ...

    def find(self, image: Image) -> FoundPattern | None:
        """The pattern in a picture, grey or BGR; None when it is not there."""
        ...

    def black(self) -> Array:
        """The print: black rectangles (n, 4) as x, y, width, height in the board frame, metres."""
        ...


@dataclass(frozen=True)
class ChessboardPattern:
    """A chessboard, counted by its inner corners as OpenCV and ROS do.

    Attributes:
        columns, rows: Inner corners; one less than squares.
        square: Side of a square, metres.

    Raises:
        CalibrationError: Fewer than 3 x 3 inner corners, or a size that cannot be meant.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        _check_count("chessboard", "inner corners", self.columns, self.rows, 3)
        _check_length("a square", self.square)

    @property
    def corners(self) -> tuple[int, int]:
        return self.columns, self.rows

    @property
    def size(self) -> tuple[float, float]:
        return (self.columns + 1) * self.square, (self.rows + 1) * self.square

    @property
    def origin(self) -> tuple[float, float]:
        return -self.square, -self.square

    def find(self, image: Image) -> FoundPattern | None:
        gray = _gray(image)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        with quiet():
            good, corners = cv2.findChessboardCorners(gray, (self.columns, self.rows), flags=flags)
        if not good or corners is None:
            return None
        start = np.asarray(corners, dtype=float).reshape(-1, 2)
        ids = np.arange(len(start))
        return _found(gray, start, ids, self, reach=0.45)

    def black(self) -> Array:
        return _black_squares(self.columns + 1, self.rows + 1, self.square, self.origin)


@dataclass(frozen=True)
class CharucoPattern:
    """A chessboard with markers in its white squares: found in part, and never turned the wrong way.

    Attributes:
        columns, rows: Squares, as OpenCV counts them here.
        square: Side of a square, metres.
        marker: Side of a marker, metres.
        dictionary: Of the markers, whose ids count from 0.
        legacy: The pattern of OpenCV before 4.6: white upper left square where the rows are even.

    Raises:
        CalibrationError: Fewer than 3 x 3 squares, markers larger than squares, a dictionary too small,
            or a size that cannot be meant.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "DICT_5X5_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        _check_count("ChArUco board", "squares", self.columns, self.rows, 3)
        _check_length("a square", self.square)
        _check_length("a marker", self.marker)
        if self.marker >= self.square:
            raise CalibrationError(
                f"markers of {1e3 * self.marker:g} mm do not go into squares of {1e3 * self.square:g} mm",
                hint="a marker is about three quarters of a square",
            )
        needed, there = self.columns * self.rows // 2, dictionary_size(self.dictionary)
        if needed > there:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares needs {needed} markers; "
                f"{self.dictionary} has {there}",
                hint="take a larger dictionary of the same cells, for example DICT_5X5_250",
            )

    @property
    def corners(self) -> tuple[int, int]:
        return self.columns - 1, self.rows - 1

    @property
    def size(self) -> tuple[float, float]:
        return self.columns * self.square, self.rows * self.square

    @property
    def origin(self) -> tuple[float, float]:
        return 0.0, 0.0

    def find(self, image: Image) -> FoundPattern | None:
        gray = _gray(image)
        with quiet():
            corners, ids, _, _ = _charuco_detector(self).detectBoard(gray)
        if ids is None or corners is None:
            return None
        numbers = np.asarray(ids, dtype=np.int64).reshape(-1)
        start = np.asarray(corners, dtype=float).reshape(-1, 2)
        lines = [len(np.unique(n)) for n in (numbers % self.corners[0], numbers // self.corners[0])]
        if len(numbers) < _FEWEST_CORNERS or min(lines) < _FEWEST_LINES:
            return None
        gap = (self.square - self.marker) / 2 / self.square
        return _found(gray, start, numbers, self, reach=_GAP_REACH * gap)

    def black(self) -> Array:
        first = 0 if self._starts_black else 1
        boxes = [_black_squares(self.columns, self.rows, self.square, self.origin, first)]
        for number, (column, row) in enumerate(self.marker_squares()):
            bits = marker_bits(self.dictionary, number)
            cell = self.marker / len(bits)
            gap = (self.square - self.marker) / 2
            v, u = np.nonzero(bits == 0)
            place = np.stack(
                [column * self.square + gap + u * cell, row * self.square + gap + v * cell], axis=1
            )
            boxes.append(np.hstack([place, np.full((len(place), 2), cell)]))
        return np.concatenate(boxes)

    @property
    def _starts_black(self) -> bool:
        return not (self.legacy and self.rows % 2 == 0)

    def marker_squares(self) -> list[tuple[int, int]]:
        """Column and row of the white squares, in the order of the markers' ids."""
        first = 1 if self._starts_black else 0
        return [(c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2 == first]


@lru_cache(maxsize=8)
def _charuco_detector(pattern: CharucoPattern) -> Any:
    board = cv2.aruco.CharucoBoard(
        (pattern.columns, pattern.rows), pattern.square, pattern.marker, marker_dictionary(pattern.dictionary)
    )
    board.setLegacyPattern(pattern.legacy)
    return cv2.aruco.CharucoDetector(board)


def _found(
    gray: Image, start: Array, ids: NDArray[np.int64], pattern: Pattern, reach: float
) -> FoundPattern | None:
    """Refines corners and takes away those that were none; ``reach`` is the free way in squares."""
    columns = pattern.corners[0]
    grid = np.stack([ids % columns, ids // columns], axis=1).astype(float)
    pixels, good, blur = refine_corners(gray, start, grid, reach)
    if good.sum() < _FEWEST_CORNERS:
        return None
    offset = np.array(pattern.origin) + pattern.square
    points = np.hstack([offset + grid * pattern.square, np.zeros((len(grid), 1))])
    return FoundPattern(points[good], pixels[good], ids[good], float(np.median(blur[good])))


def _black_squares(
    columns: int, rows: int, square: float, origin: tuple[float, float], first: int = 0
) -> Array:
    places = [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == first]
    corner = np.array(origin) + square * np.array(places, dtype=float)
    return np.hstack([corner, np.full((len(places), 2), square)])


def _gray(image: Image) -> Image:
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _check_count(what: str, of: str, columns: int, rows: int, least: int) -> None:
    if min(columns, rows) < least:
        raise CalibrationError(
            f"a {what} of {columns}x{rows} {of} is too small to calibrate with",
            hint=f"at least {least}x{least}; 8x6 is usual",
        )


def _check_length(what: str, length: float) -> None:
    # A print of more than a metre a square, or less than a millimetre, is a slip of the unit.
    if not 1e-3 <= length <= 1.0:
        raise CalibrationError(
            f"{what} of {length:g} m cannot be meant",
            hint="lengths are in metres here, in millimetres on the command line",
        )
