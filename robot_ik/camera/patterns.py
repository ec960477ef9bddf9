"""Flat patterns to calibrate with: ChArUco boards and chessboards, found to a fraction of a pixel.

The board frame is OpenCV's: origin at the outer corner of the first square (ChArUco) or at the first inner
corner (chessboard), x along the columns, y along the rows, z *into* the board.  A print seen upright has x
right and y down.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.chess_corner import refine_corners
from robot_ik.camera.image import (
    dictionary_size,
    from_reduced,
    marker_boxes,
    marker_dictionary,
    quiet,
    reduced,
    times_smaller,
    to_gray,
    to_reduced,
)
from robot_ik.errors import CalibrationError
from robot_ik.ports import Array, Image

# Fewer corners of a ChArUco board than these do not hold a view against a wrong one among them.
FEWEST_CORNERS = 6
# A step of this width, px, is measured well; the fit does not look far enough round much wider ones.
_SOFT = 1.0


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


# How far from a corner its picture is its own, in gaps between square and marker: the nearest marker's corner
# is the root of 2 away, and blur takes some of that.
_GAP_REACH = 1.2
# The same on a chessboard, in squares.
_SQUARE_REACH = 0.45
# What is plain beside an edge of a square, in squares: nearly half of it.
_PLAIN = 0.4
# Columns and rows of a board at least.
_LEAST_COUNT = 3
# A view needs corners on both sides of the board: two lines of them at least.
_FEWEST_LINES = 2


@dataclass(frozen=True)
class Pattern(ABC):
    """What both kinds of calibration pattern share.

    Attributes:
        columns, rows: How many, counted as OpenCV counts them for this pattern.
        square: Side of a square, metres.
    """

    columns: int
    rows: int
    square: float

    #: What the pattern and what its columns and rows are called; how many squares there are more than these.
    name: ClassVar[str]
    counted: ClassVar[str]
    uncounted: ClassVar[int]

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < _LEAST_COUNT:
            raise CalibrationError(
                f"a {self.name} of {self.columns}x{self.rows} {self.counted} is too small to calibrate with",
                hint=f"at least {_LEAST_COUNT}x{_LEAST_COUNT}; 8x6 is usual",
            )
        _check_length("a square", self.square)

    @property
    def corners(self) -> tuple[int, int]:
        """Inner corners along the columns and rows."""
        return self.columns + self.uncounted - 1, self.rows + self.uncounted - 1

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the print, metres."""
        return (self.columns + self.uncounted) * self.square, (self.rows + self.uncounted) * self.square

    @property
    def origin(self) -> tuple[float, float]:
        """Where the print's upper left corner is in the board frame, metres."""
        return 0.0 - self.uncounted * self.square, 0.0 - self.uncounted * self.square

    @property
    def plain(self) -> float:
        """How far from an edge between two squares there is one tone only, in squares."""
        return _PLAIN

    @abstractmethod
    def find(self, image: Image) -> FoundPattern | None:
        """The pattern in a picture, grey or BGR; None when it is not there."""

    def black(self) -> Array:
        """The print: black rectangles (n, 4) as x, y, width, height in the board frame, metres."""
        squares = np.array(self._every_other_square(0 if self._starts_black else 1), dtype=float)
        return np.hstack([np.array(self.origin) + self.square * squares, np.full(squares.shape, self.square)])

    @property
    def _starts_black(self) -> bool:
        """Whether the upper left square is black."""
        return True

    def _every_other_square(self, first: int) -> list[tuple[int, int]]:
        """Column and row of the squares of one colour, the upper left one being number 0."""
        columns, rows = (count + 1 for count in self.corners)
        return [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == first]

    def _fitted(
        self, gray: Image, times: int, start: Array, ids: NDArray[np.int64], reach: float
    ) -> FoundPattern | None:
        """Refines corners and takes away those that were none; None when too few are left.

        They are those of numbers ``ids`` (n,), found at ``start`` (n, 2) to within about 1.5 px in a picture
        that is ``times`` smaller than ``gray``; no third edge is within ``reach`` squares of one.
        """
        columns = self.corners[0]
        grid_position = np.stack([ids % columns, ids // columns], axis=1).astype(float)
        pixels, good, blur = refine_corners(reduced(gray, times), start, grid_position, reach)
        softness = float(np.median(blur[good])) if good.any() else 0.0
        best = max(1, int(times * softness / _SOFT))
        if good.any() and best != times:
            again = to_reduced(from_reduced(np.where(good[:, None], pixels, start), times), best)
            other = refine_corners(reduced(gray, best), again, grid_position, reach)
            if other[1].sum() >= good.sum():
                times, (pixels, good, blur) = best, other
        if good.sum() < FEWEST_CORNERS:
            return None
        first = np.array(self.origin) + self.square
        points = np.hstack([first + grid_position * self.square, np.zeros((len(ids), 1))])
        there = from_reduced(pixels[good], times)
        return FoundPattern(points[good], there, ids[good], times * float(np.median(blur[good])))


@dataclass(frozen=True)
class ChessboardPattern(Pattern):
    """A chessboard, counted by its inner corners as OpenCV and ROS do.

    Attributes:
        columns, rows: Inner corners; one less than squares.
        square: Side of a square, metres.

    Raises:
        CalibrationError: Fewer than 3 x 3 inner corners, or a size that cannot be meant.
    """

    name, counted, uncounted = "chessboard", "inner corners", 1

    def find(self, image: Image) -> FoundPattern | None:
        gray = to_gray(image)
        times = times_smaller(gray)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        with quiet():
            good, corners = cv2.findChessboardCorners(
                reduced(gray, times), (self.columns, self.rows), flags=flags
            )
        if not good or corners is None:
            return None
        start = np.asarray(corners, dtype=float).reshape(-1, 2)
        return self._fitted(gray, times, start, np.arange(len(start)), _SQUARE_REACH)


@dataclass(frozen=True)
class CharucoPattern(Pattern):
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

    marker: float
    dictionary: str = "DICT_5X5_50"
    legacy: bool = False

    name, counted, uncounted = "ChArUco board", "squares", 0

    def __post_init__(self) -> None:
        super().__post_init__()
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
    def plain(self) -> float:
        return min(_PLAIN, (self.square - self.marker) / 2 / self.square)

    def find(self, image: Image) -> FoundPattern | None:
        gray = to_gray(image)
        times = times_smaller(gray)
        found = self._find(gray, times)
        if times > 1 and (found is None or len(found.ids) < self.corners[0] * self.corners[1]):
            # A board far away in a large picture is too small in a reduced one.
            whole = self._find(gray, 1)
            if whole is not None and (found is None or len(whole.ids) > len(found.ids)):
                return whole
        return found

    def _find(self, gray: Image, times: int) -> FoundPattern | None:
        """The pattern as found in the picture that is so many times smaller."""
        with quiet():
            corners, ids, _, _ = _charuco_detector(self).detectBoard(reduced(gray, times))
        if ids is None or corners is None:
            return None
        numbers = np.asarray(ids, dtype=np.int64).reshape(-1)
        start = np.asarray(corners, dtype=float).reshape(-1, 2)
        lines = [len(np.unique(n)) for n in (numbers % self.corners[0], numbers // self.corners[0])]
        if len(numbers) < FEWEST_CORNERS or min(lines) < _FEWEST_LINES:
            return None
        gap = (self.square - self.marker) / 2 / self.square
        return self._fitted(gray, times, start, numbers, _GAP_REACH * gap)

    def black(self) -> Array:
        boxes = [super().black()]
        for number, (column, row) in enumerate(self.marker_squares()):
            gap = (self.square - self.marker) / 2
            offset = np.array([column * self.square + gap, row * self.square + gap, 0.0, 0.0])
            boxes.append(marker_boxes(self.dictionary, number, self.marker) + offset)
        return np.concatenate(boxes)

    @property
    def _starts_black(self) -> bool:
        return not (self.legacy and self.rows % 2 == 0)

    def marker_squares(self) -> list[tuple[int, int]]:
        """Column and row of the white squares, in the order of the markers' ids."""
        return self._every_other_square(1 if self._starts_black else 0)


@lru_cache(maxsize=8)
def _charuco_detector(pattern: CharucoPattern) -> Any:
    board = cv2.aruco.CharucoBoard(
        (pattern.columns, pattern.rows), pattern.square, pattern.marker, marker_dictionary(pattern.dictionary)
    )
    board.setLegacyPattern(pattern.legacy)
    return cv2.aruco.CharucoDetector(board)


def _check_length(what: str, length: float) -> None:
    # A print of more than a metre a square, or less than a millimetre, is a mistake of the unit.
    if not 1e-3 <= length <= 1.0:
        meant = f": {length:g} mm are {1e-3 * length:g}" if 1.0 <= length <= 1000.0 else ", 0.001 to 1"
        raise CalibrationError(f"{what} of {length:g} m is not possible", hint=f"give metres{meant}")


def check_millimetres(what: str, length: float, least: float = 1.0) -> None:
    """Raises ``CalibrationError`` for a length in millimetres that no print has."""
    if not least <= length <= 1000.0:
        meant = f": is {1e3 * length:g} mm meant?" if least <= 1e3 * length <= 1000.0 else ""
        raise CalibrationError(
            f"{what} of {length:g} mm is not possible", hint=f"give {least:g} to 1000 mm{meant}"
        )


# ------------------------------------------------------------------------------------------
# Which pattern a picture really shows, when it is not the one that was said; and patterns as text.


# Pictures that must show a pattern before the rest need not be asked.
_ENOUGH_VOTES = 3


def fitting_pattern(pattern: Pattern, images: Sequence[Image]) -> Pattern | None:
    """The pattern itself, or what it must be where only that is found in the pictures; None when nothing is.

    Tried: a ChArUco board of the old layout, columns and rows the other way round, and one row or column
    more or less (a chessboard is easily miscounted: squares instead of inner corners).  A chance find in one
    picture is outvoted by the others; of candidates that are found equally often the first is taken.
    """
    candidates = (pattern, *_relatives(pattern))
    votes = dict.fromkeys(candidates, 0)
    for image in images:
        for candidate in candidates:
            votes[candidate] += candidate.find(image) is not None
        if max(votes.values()) >= _ENOUGH_VOTES:
            break
    best = max(candidates, key=lambda one: votes[one])
    return best if votes[best] else None


def larger_chessboard(pattern: Pattern, images: Sequence[Image]) -> ChessboardPattern | None:
    """The chessboard of which only a part was taken, where most of the pictures show it; None: none.

    OpenCV also finds a smaller chessboard than is there: which part of it differs from picture to picture.
    """
    if not isinstance(pattern, ChessboardPattern):
        return None
    wider, taller = pattern.columns + 1, pattern.rows + 1
    for columns, rows in ((wider, taller), (wider, pattern.rows), (pattern.columns, taller)):
        candidate = ChessboardPattern(columns, rows, pattern.square)
        if 2 * sum(candidate.find(image) is not None for image in images) > len(images):
            return candidate
    return None


def _relatives(pattern: Pattern) -> list[Pattern]:
    if isinstance(pattern, CharucoPattern):
        transposed = dataclasses.replace(pattern, columns=pattern.rows, rows=pattern.columns)
        both = [dataclasses.replace(p, legacy=old) for p in (pattern, transposed) for old in (False, True)]
        return [p for p in both if p != pattern]
    c, r = pattern.columns, pattern.rows
    sizes = [(c - 1, r - 1), (r, c), (c + 1, r + 1), (c - 1, r), (c, r - 1), (c + 1, r), (c, r + 1)]
    good = [s for s in dict.fromkeys(sizes) if min(s) >= _LEAST_COUNT and s != (c, r)]
    return [ChessboardPattern(a, b, pattern.square) for a, b in good]


def describe(pattern: Pattern) -> str:
    """The pattern as text."""
    what = f"{pattern.name} of {pattern.columns}x{pattern.rows} {pattern.counted}"
    square = f"{1e3 * pattern.square:g} mm"
    if not isinstance(pattern, CharucoPattern):
        return f"{what} (squares {square})"
    layout = ", layout of OpenCV before 4.6" if pattern.legacy else ""
    return f"{what} ({square}, markers {1e3 * pattern.marker:g} mm, {pattern.dictionary}{layout})"


PatternKind = Literal["charuco", "chessboard"]

#: A marker's side in squares, where it is not given.
MARKER_SHARE = 0.73


@dataclass(frozen=True)
class PatternRequest:
    """What somebody said of a pattern; None where the usual will do.

    Attributes:
        kind: ``charuco`` or ``chessboard``.
        columns: charuco: squares (8); chessboard: inner corners (9).
        rows: The same downwards (6; 6).
        square_mm: Side of a square (30; 25).
        marker_mm: Side of a marker of a charuco board; by default ``MARKER_SHARE`` squares, to whole mm.
        dictionary: Of its markers.
    """

    kind: PatternKind = "charuco"
    columns: int | None = None
    rows: int | None = None
    square_mm: float | None = None
    marker_mm: float | None = None
    dictionary: str = "DICT_5X5_50"

    def pattern(self) -> Pattern:
        """The pattern.

        Raises:
            CalibrationError: No such pattern can be.
        """
        columns, rows, square = _USUAL[self.kind]
        columns = columns if self.columns is None else self.columns
        rows = rows if self.rows is None else self.rows
        square = square if self.square_mm is None else self.square_mm
        check_millimetres("a square", square)
        if self.kind == "chessboard":
            if self.marker_mm is not None:
                raise CalibrationError("a chessboard has no markers", hint="leave their size out")
            return ChessboardPattern(columns, rows, square / 1e3)
        marker = self.marker_mm
        if marker is None:
            # Whole millimetres can be measured; in a small square they would be too coarse.
            share = MARKER_SHARE * square
            marker = float(round(share)) if square >= 10.0 else share
        check_millimetres("a marker", marker)
        return CharucoPattern(columns, rows, square / 1e3, marker / 1e3, self.dictionary)


_USUAL = {"charuco": (8, 6, 30.0), "chessboard": (9, 6, 25.0)}
