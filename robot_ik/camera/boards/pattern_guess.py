"""Which pattern a picture really shows, when it is not the one that was said; and patterns in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern, Pattern

Image = NDArray[np.uint8]

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
