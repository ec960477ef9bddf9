"""Black rectangles on white paper as pixels, each pixel the exact mean of what falls on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


def paint_boxes(boxes: Array, width: int, height: int, ink: Array | None = None) -> Image:
    """Rectangles that do not overlap.

    Args:
        boxes: (n, 4) x, y, width, height in pixels from the picture's upper left *edge*.
        width: Of the picture; ``height``: likewise.
        height: See ``width``.
        ink: (n,) how dark each is, 1 black; by default all are.

    Returns:
        (height, width) uint8, 255 paper and 0 ink.
    """
    paper = np.zeros((height, width))
    dark = np.ones(len(boxes)) if ink is None else ink
    for (x, y, w, h), shade in zip(boxes, dark, strict=True):
        columns, across = _cover(x, x + w, width)
        rows, down = _cover(y, y + h, height)
        paper[rows, columns] += shade * np.outer(down, across)
    return np.asarray(np.rint(255.0 * (1.0 - np.clip(paper, 0.0, 1.0))), dtype=np.uint8)


def _cover(low: float, high: float, size: int) -> tuple[slice, Array]:
    """Pixels of a row touched by the stretch from ``low`` to ``high``, and the part covered of each."""
    first, last = max(0, int(np.floor(low))), min(size, int(np.ceil(high)))
    edges = np.arange(first, max(first, last) + 1, dtype=float)
    cut = np.clip(edges, low, high)
    return slice(first, max(first, last)), np.diff(cut)
