"""Which pattern a picture really shows, when it is not the one that was said; and patterns in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern, Pattern

Image = NDArray[np.uint8]


def fitting_pattern(pattern: Pattern, images: Sequence[Image]) -> Pattern | None:
    """The pattern itself, or what it must be where only that is found in the pictures; None when nothing is.

    Tried: a ChArUco board of the old layout, columns and rows the other way round, and one row or column
    more or less (a chessboard is easily miscounted: squares instead of inner corners).
    """
    for candidate in (pattern, *_relatives(pattern)):
        if any(candidate.find(image) is not None for image in images):
            return candidate
    return None


def _relatives(pattern: Pattern) -> list[Pattern]:
    if isinstance(pattern, CharucoPattern):
        turned = dataclasses.replace(pattern, columns=pattern.rows, rows=pattern.columns)
        both = [dataclasses.replace(p, legacy=old) for p in (pattern, turned) for old in (False, True)]
        return [p for p in both if p != pattern]
    if isinstance(pattern, ChessboardPattern):
        c, r = pattern.columns, pattern.rows
        sizes = [(c - 1, r - 1), (r, c), (c + 1, r + 1), (c - 1, r), (c, r - 1), (c + 1, r), (c, r + 1)]
        good = [s for s in dict.fromkeys(sizes) if min(s) >= 3 and s != (c, r)]
        return [ChessboardPattern(a, b, pattern.square) for a, b in good]
    return []


def describe(pattern: Pattern) -> str:
    """The pattern in words."""
    count, square = f"{pattern.columns}x{pattern.rows}", f"{1e3 * pattern.square:g} mm"
    if isinstance(pattern, CharucoPattern):
        layout = ", layout of OpenCV before 4.6" if pattern.legacy else ""
        markers = f"markers {1e3 * pattern.marker:g} mm, {pattern.dictionary}"
        return f"ChArUco board of {count} squares ({square}, {markers}{layout})"
    return f"chessboard of {count} inner corners (squares {square})"
