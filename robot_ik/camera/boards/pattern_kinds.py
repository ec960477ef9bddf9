"""The patterns that are printed and calibrated with by name, and their usual sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern, Pattern

PatternKind = Literal["charuco", "chessboard"]

#: A marker's side in squares, where nobody says it.
MARKER_SHARE = 0.73


@dataclass(frozen=True)
class PatternWish:
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
        columns, rows = self.columns or columns, self.rows or rows
        square = square if self.square_mm is None else self.square_mm
        if self.kind == "chessboard":
            return ChessboardPattern(columns, rows, square / 1e3)
        marker = self.marker_mm if self.marker_mm is not None else _marker_of(square)
        return CharucoPattern(columns, rows, square / 1e3, marker / 1e3, self.dictionary)


_USUAL = {"charuco": (8, 6, 30.0), "chessboard": (9, 6, 25.0)}


def _marker_of(square: float) -> float:
    share = MARKER_SHARE * square
    # Whole millimetres can be measured; in a small square they would be too coarse.
    return float(round(share)) if square >= 10.0 else share
