"""Flat patterns to calibrate with: ChArUco boards and chessboards.

The frame of a pattern is OpenCV's: origin at the outer corner of the first square (ChArUco) or at
the first inner corner (chessboard), x along the columns, y along the rows, z *into* the board. A
print that is upright in the picture has x right and y down.
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
    reduction_factor,
    to_gray,
    to_reduced,
)
from robot_ik.errors import CalibrationError
from robot_ik.ports import Array, Image

#: Smallest number of corners in a picture. With fewer, a wrong corner is not noticed.
FEWEST_CORNERS = 6
#: Side of a marker in squares if it is not given.
MARKER_SHARE = 0.73

# Width of an edge that is measured well, px. The patch of a fit is too small for much wider edges.
_SHARP_WIDTH = 1.0
# Radius around a corner without a third edge. ChArUco, in gaps between square and marker: the
# corner of the nearest marker is 1.41 gaps away, and blur needs a part of that. Chessboard, in
# squares.
_GAP_REACH = 1.2
_SQUARE_REACH = 0.45
# Smallest number of columns and of rows.
_MIN_COUNT = 3
# Smallest number of columns and of rows of corners in a picture of a ChArUco board.
_MIN_LINES = 2
# Number of pictures with a pattern after which the other pictures are not searched.
_ENOUGH_VOTES = 3
# Plausible lengths of a print, metres and millimetres.
_MIN_LENGTH = 1e-3
_MAX_LENGTH = 1.0
_MAX_LENGTH_MM = 1000.0
# From this square on the default marker has whole millimetres, mm. In smaller ones they are too
# coarse.
_WHOLE_MM_SQUARE = 10.0
# Default columns, rows and side of a square (mm).
_DEFAULTS = {"charuco": (8, 6, 30.0), "chessboard": (9, 6, 25.0)}


@dataclass(frozen=True, eq=False)
class FoundPattern:
    """The corners of a pattern in one picture.

    Attributes:
        points_board: (n, 3) in the pattern's frame, metres, z = 0.
        pixels: (n, 2) distorted pixels, integer pixel centres.
        ids: (n,) number of each corner: column + row * columns of inner corners.
        blur: Median width of the edges at the corners, px: about 1.2 times the sigma of the blur.
    """

    points_board: Array
    pixels: Array
    ids: NDArray[np.int64]
    blur: float = 0.0


@dataclass(frozen=True)
class Pattern(ABC):
    """Base of both kinds of patterns.

    Attributes:
        columns: Number of columns, as OpenCV counts them for this pattern.
        rows: Number of rows, likewise.
        square: Side of a square, metres.
    """

    columns: int
    rows: int
    square: float

    #: Name of the kind of pattern.
    name: ClassVar[str]
    #: What columns and rows count.
    counted: ClassVar[str]
    #: Number of squares in a row beyond ``columns``.
    uncounted: ClassVar[int]

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < _MIN_COUNT:
            raise CalibrationError(
                f"a {self.name} of {self.columns}x{self.rows} {self.counted} is too small to "
                "calibrate with",
                hint=f"at least {_MIN_COUNT}x{_MIN_COUNT}; 8x6 is usual",
            )
        _check_length("a square", self.square)

    @property
    def corners(self) -> tuple[int, int]:
        """Number of inner corners along the columns and rows."""
        return self.columns + self.uncounted - 1, self.rows + self.uncounted - 1

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the print, metres."""
        columns, rows = self.corners
        return (columns + 1) * self.square, (rows + 1) * self.square

    @property
    def origin(self) -> tuple[float, float]:
        """Upper left corner of the print in the pattern's frame, metres."""
        margin = 0.0 - self.uncounted * self.square
        return margin, margin

    @abstractmethod
    def find(self, image: Image) -> FoundPattern | None:
        """Find the pattern in a grey or BGR picture. Return None if it is not visible."""

    def black(self) -> Array:
        """Return the black rectangles (n, 4): x, y, width, height, pattern's frame, metres."""
        squares = np.array(self._every_other_square(0 if self._starts_black else 1), dtype=float)
        corners = np.array(self.origin) + self.square * squares
        return np.hstack([corners, np.full(squares.shape, self.square)])

    @property
    def _starts_black(self) -> bool:
        """Whether the upper left square is black."""
        return True

    def _every_other_square(self, first: int) -> list[tuple[int, int]]:
        """Return column and row of the squares of one colour. The upper left one has number 0."""
        columns, rows = (count + 1 for count in self.corners)
        return [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == first]

    def _refined(
        self, gray: Image, times: int, start: Array, ids: NDArray[np.int64], reach: float
    ) -> FoundPattern | None:
        """Refine corners and remove those that are not corners. None if too few are left.

        Args:
            gray: The picture.
            times: Factor by which it was reduced for ``start``.
            start: (n, 2) pixels of the reduced picture, accurate to about 1.5 px.
            ids: (n,) numbers of the corners.
            reach: Radius around a corner without a third edge, squares.
        """
        columns = self.corners[0]
        grid = np.stack([ids % columns, ids // columns], axis=1).astype(float)
        pixels, is_corner, blur = refine_corners(reduced(gray, times), start, grid, reach)
        width = float(np.median(blur[is_corner])) if is_corner.any() else 0.0
        # The size at which the edges are sharp.
        best = max(1, int(times * width / _SHARP_WIDTH))
        if is_corner.any() and best != times:
            rough = from_reduced(np.where(is_corner[:, None], pixels, start), times)
            other = refine_corners(reduced(gray, best), to_reduced(rough, best), grid, reach)
            if other[1].sum() >= is_corner.sum():
                times = best
                pixels, is_corner, blur = other
        if is_corner.sum() < FEWEST_CORNERS:
            return None
        first = np.array(self.origin) + self.square
        points = np.hstack([first + grid * self.square, np.zeros((len(ids), 1))])
        return FoundPattern(
            points[is_corner],
            from_reduced(pixels[is_corner], times),
            ids[is_corner],
            times * float(np.median(blur[is_corner])),
        )


@dataclass(frozen=True)
class ChessboardPattern(Pattern):
    """A chessboard, counted by its inner corners as OpenCV and ROS do.

    Attributes:
        columns: Inner corners in a row; one less than squares.
        rows: Inner corners in a column.
        square: Side of a square, metres.

    Raises:
        CalibrationError: Fewer than 3 x 3 inner corners, or an implausible size.
    """

    name = "chessboard"
    counted = "inner corners"
    uncounted = 1

    def find(self, image: Image) -> FoundPattern | None:
        gray = to_gray(image)
        times = reduction_factor(gray)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        flags |= cv2.CALIB_CB_FAST_CHECK
        with quiet():
            success, corners = cv2.findChessboardCorners(
                reduced(gray, times), (self.columns, self.rows), flags=flags
            )
        if not success or corners is None:
            return None
        start = np.asarray(corners, dtype=float).reshape(-1, 2)
        return self._refined(gray, times, start, np.arange(len(start)), _SQUARE_REACH)


@dataclass(frozen=True)
class CharucoPattern(Pattern):
    """A chessboard with markers in its white squares.

    It is also found if a part of it is hidden, and its orientation is unique.

    Attributes:
        columns: Squares in a row, as OpenCV counts them here.
        rows: Squares in a column.
        square: Side of a square, metres.
        marker: Side of a marker, metres.
        dictionary: Dictionary of the markers, whose ids count from 0.
        legacy: Layout of OpenCV before 4.6: white upper left square if the rows are even.

    Raises:
        CalibrationError: Fewer than 3 x 3 squares, markers larger than squares, a dictionary with
            too few markers, or an implausible size.
    """

    marker: float
    dictionary: str = "DICT_5X5_50"
    legacy: bool = False

    name = "ChArUco board"
    counted = "squares"
    uncounted = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_length("a marker", self.marker)
        if self.marker >= self.square:
            raise CalibrationError(
                f"markers of {1e3 * self.marker:g} mm do not fit into squares of "
                f"{1e3 * self.square:g} mm",
                hint="a marker is about three quarters of a square",
            )
        needed = self.columns * self.rows // 2
        available = dictionary_size(self.dictionary)
        if needed > available:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares needs {needed} markers; "
                f"{self.dictionary} has {available}",
                hint="take a larger dictionary of the same cells, for example DICT_5X5_250",
            )

    @property
    def gap(self) -> float:
        """White between a marker and the sides of its square, metres."""
        return (self.square - self.marker) / 2

    def find(self, image: Image) -> FoundPattern | None:
        gray = to_gray(image)
        times = reduction_factor(gray)
        found = self._find(gray, times)
        columns, rows = self.corners
        if times > 1 and (found is None or len(found.ids) < columns * rows):
            # A distant board in a large picture is too small in the reduced picture.
            at_full_size = self._find(gray, 1)
            if at_full_size is not None and (
                found is None or len(at_full_size.ids) > len(found.ids)
            ):
                return at_full_size
        return found

    def _find(self, gray: Image, times: int) -> FoundPattern | None:
        """Find the pattern in a picture reduced by ``times``."""
        with quiet():
            corners, ids, _, _ = _charuco_detector(self).detectBoard(reduced(gray, times))
        if ids is None or corners is None:
            return None
        numbers = np.asarray(ids, dtype=np.int64).reshape(-1)
        start = np.asarray(corners, dtype=float).reshape(-1, 2)
        columns = len(np.unique(numbers % self.corners[0]))
        rows = len(np.unique(numbers // self.corners[0]))
        if len(numbers) < FEWEST_CORNERS or min(columns, rows) < _MIN_LINES:
            return None
        return self._refined(gray, times, start, numbers, _GAP_REACH * self.gap / self.square)

    def black(self) -> Array:
        boxes = [super().black()]
        for number, (column, row) in enumerate(self.marker_squares()):
            x = column * self.square + self.gap
            y = row * self.square + self.gap
            marker = marker_boxes(self.dictionary, number, self.marker)
            boxes.append(marker + np.array([x, y, 0.0, 0.0]))
        return np.concatenate(boxes)

    @property
    def _starts_black(self) -> bool:
        return not (self.legacy and self.rows % 2 == 0)

    def marker_squares(self) -> list[tuple[int, int]]:
        """Return column and row of the white squares, in the order of the markers' ids."""
        return self._every_other_square(1 if self._starts_black else 0)


@lru_cache(maxsize=8)
def _charuco_detector(pattern: CharucoPattern) -> Any:
    board = cv2.aruco.CharucoBoard(
        (pattern.columns, pattern.rows),
        pattern.square,
        pattern.marker,
        marker_dictionary(pattern.dictionary),
    )
    board.setLegacyPattern(pattern.legacy)
    return cv2.aruco.CharucoDetector(board)


def _check_length(name: str, length: float) -> None:
    if not _MIN_LENGTH <= length <= _MAX_LENGTH:
        hint = "give metres, 0.001 to 1"
        if _MAX_LENGTH <= length <= 1e3 * _MAX_LENGTH:
            hint = f"give metres: {length:g} mm are {1e-3 * length:g}"
        raise CalibrationError(f"{name} of {length:g} m is not possible", hint=hint)


def check_millimetres(name: str, length: float, minimum: float = 1.0) -> None:
    """Check a length of a print.

    Args:
        name: Name of the length in messages.
        length: Length, mm.
        minimum: Smallest possible length, mm.

    Raises:
        CalibrationError: No print has this length.
    """
    if not minimum <= length <= _MAX_LENGTH_MM:
        hint = f"give {minimum:g} to {_MAX_LENGTH_MM:g} mm"
        if minimum <= 1e3 * length <= _MAX_LENGTH_MM:
            hint = f"{hint}: is {1e3 * length:g} mm meant?"
        raise CalibrationError(f"{name} of {length:g} mm is not possible", hint=hint)


def fitting_pattern(pattern: Pattern, images: Sequence[Image]) -> Pattern | None:
    """Return the pattern in pictures: the given one, or a similar one; None if there is none.

    Similar ones are a ChArUco board of the old layout, columns and rows exchanged, and one row or
    column more or less, because a chessboard is easily miscounted. The pattern that is found in
    most pictures is returned, so that a false detection in one picture has no effect. Of patterns
    that are found equally often the first is returned.
    """
    candidates = (pattern, *_similar(pattern))
    votes = dict.fromkeys(candidates, 0)
    for image in images:
        for candidate in candidates:
            votes[candidate] += candidate.find(image) is not None
        if max(votes.values()) >= _ENOUGH_VOTES:
            break
    best = max(candidates, key=lambda candidate: votes[candidate])
    return best if votes[best] else None


def larger_chessboard(pattern: Pattern, images: Sequence[Image]) -> ChessboardPattern | None:
    """Return the larger chessboard in most pictures, or None if there is none.

    OpenCV also finds a part of a chessboard. The part differs from picture to picture.
    """
    if not isinstance(pattern, ChessboardPattern):
        return None
    wider = pattern.columns + 1
    taller = pattern.rows + 1
    for columns, rows in ((wider, taller), (wider, pattern.rows), (pattern.columns, taller)):
        candidate = ChessboardPattern(columns, rows, pattern.square)
        if 2 * sum(candidate.find(image) is not None for image in images) > len(images):
            return candidate
    return None


def _similar(pattern: Pattern) -> list[Pattern]:
    c = pattern.columns
    r = pattern.rows
    if isinstance(pattern, CharucoPattern):
        others: list[Pattern] = []
        for base in (pattern, dataclasses.replace(pattern, columns=r, rows=c)):
            for legacy in (False, True):
                other = dataclasses.replace(base, legacy=legacy)
                if other != pattern:
                    others.append(other)
        return others
    sizes = [(c - 1, r - 1), (r, c), (c + 1, r + 1), (c - 1, r), (c, r - 1), (c + 1, r), (c, r + 1)]
    possible = [s for s in dict.fromkeys(sizes) if min(s) >= _MIN_COUNT and s != (c, r)]
    return [ChessboardPattern(columns, rows, pattern.square) for columns, rows in possible]


def describe(pattern: Pattern) -> str:
    """Return a pattern as text."""
    text = f"{pattern.name} of {pattern.columns}x{pattern.rows} {pattern.counted}"
    square = f"{1e3 * pattern.square:g} mm"
    if not isinstance(pattern, CharucoPattern):
        return f"{text} (squares {square})"
    layout = ", layout of OpenCV before 4.6" if pattern.legacy else ""
    marker = f"{1e3 * pattern.marker:g} mm"
    return f"{text} ({square}, markers {marker}, {pattern.dictionary}{layout})"


PatternKind = Literal["charuco", "chessboard"]


@dataclass(frozen=True)
class PatternRequest:
    """A pattern with lengths in millimetres. Numbers that are None have a default.

    Attributes:
        kind: ``charuco`` or ``chessboard``.
        columns: charuco: squares (8); chessboard: inner corners (9).
        rows: The same downwards (6; 6).
        square_mm: Side of a square (30; 25).
        marker_mm: Side of a marker of a ChArUco board; by default ``MARKER_SHARE`` squares, to
            whole millimetres.
        dictionary: Dictionary of its markers.
    """

    kind: PatternKind = "charuco"
    columns: int | None = None
    rows: int | None = None
    square_mm: float | None = None
    marker_mm: float | None = None
    dictionary: str = "DICT_5X5_50"

    def pattern(self) -> Pattern:
        """Return the pattern.

        Raises:
            CalibrationError: The pattern is impossible.
        """
        columns, rows, square = _DEFAULTS[self.kind]
        columns = columns if self.columns is None else self.columns
        rows = rows if self.rows is None else self.rows
        square = square if self.square_mm is None else self.square_mm
        check_millimetres("a square", square)
        if self.kind == "chessboard":
            if self.marker_mm is not None:
                raise CalibrationError(
                    "a chessboard has no markers", hint="do not give the size of markers"
                )
            return ChessboardPattern(columns, rows, square / 1e3)
        marker = self.marker_mm
        if marker is None:
            # Whole millimetres can be measured.
            marker = MARKER_SHARE * square
            marker = float(round(marker)) if square >= _WHOLE_MM_SQUARE else marker
        check_millimetres("a marker", marker)
        return CharucoPattern(columns, rows, square / 1e3, marker / 1e3, self.dictionary)
