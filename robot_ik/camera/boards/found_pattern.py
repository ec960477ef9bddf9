"""The corners of a pattern in one picture, fitted at the size in which they are measured best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.chess_corner import refine_corners
from robot_ik.camera.reduction import from_reduced, reduced, to_reduced

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

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


@dataclass(frozen=True)
class CornerGrid:
    """Where the inner corners of a pattern are.

    Attributes:
        columns: How many there are in a row.
        square: Side of a square, metres.
        first: x and y of the first one in the board frame, metres.
        reach: Radius round a corner, in squares, in which there is no third edge.
    """

    columns: int
    square: float
    first: tuple[float, float]
    reach: float


def fitted_pattern(
    gray: Image, times: int, start: Array, ids: NDArray[np.int64], grid: CornerGrid
) -> FoundPattern | None:
    """Refines corners and takes away those that were none; None when too few are left.

    Args:
        gray: (h, w), the whole picture.
        times: So many times smaller was the one in which the corners were found.
        start: (n, 2) pixels of that smaller one, to within about 1.5 px.
        ids: (n,) their numbers.
        grid: Whose they are.
    """
    place = np.stack([ids % grid.columns, ids // grid.columns], axis=1).astype(float)
    pixels, good, blur = refine_corners(reduced(gray, times), start, place, grid.reach)
    softness = float(np.median(blur[good])) if good.any() else 0.0
    best = max(1, int(times * softness / _SOFT))
    if good.any() and best != times:
        again = to_reduced(from_reduced(np.where(good[:, None], pixels, start), times), best)
        other = refine_corners(reduced(gray, best), again, place, grid.reach)
        if other[1].sum() >= good.sum():
            times, (pixels, good, blur) = best, other
    if good.sum() < FEWEST_CORNERS:
        return None
    points = np.hstack([np.array(grid.first) + place * grid.square, np.zeros((len(place), 1))])
    there = from_reduced(pixels[good], times)
    return FoundPattern(points[good], there, ids[good], times * float(np.median(blur[good])))
