"""Where in the next picture the markers of the last ones will be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect import Detection

Array = NDArray[np.float64]
Box = tuple[int, int, int, int]

# The window for a marker: its box and so much of its size on each side, for its white margin (a cell) and
# for what it moves otherwise than in the last picture.
_MARGIN = 0.5
# The whole picture is searched every so many pictures all the same: for markers that come into view.
_WHOLE_EVERY = 10
# A window of more than this part of the picture saves nothing.
_LARGEST_PART = 0.5


class SearchWindow:
    """Remembers the corners of the last two pictures.

    Attributes:
        perimeter: Of the smallest marker in the last picture, px; 0 when there was none.
    """

    def __init__(self) -> None:
        self.perimeter = 0.0
        self._last: dict[int, Array] = {}
        self._before: dict[int, Array] = {}
        self._since_whole = 0

    def around(self, width: int, height: int) -> Box | None:
        """Part of the picture (x0, y0, x1, y1), half open, for the last markers; None: search all of it."""
        if not self._last or self._since_whole + 1 >= _WHOLE_EVERY:
            return None
        boxes = []
        for i, corners in self._last.items():
            margin = _MARGIN * np.ptp(corners, axis=0)
            ahead = corners - self._before.get(i, corners)
            low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
            step = ahead.mean(axis=0)
            boxes.append((np.minimum(low, low + step), np.maximum(high, high + step)))
        low = np.min([b[0] for b in boxes], axis=0)
        high = np.max([b[1] for b in boxes], axis=0)
        x0, y0 = np.maximum(np.floor(low), 0).astype(int)
        x1, y1 = np.minimum(np.ceil(high) + 1, (width, height)).astype(int)
        if x1 <= x0 or y1 <= y0 or (x1 - x0) * (y1 - y0) > _LARGEST_PART * width * height:
            return None
        return int(x0), int(y0), int(x1), int(y1)

    def holds(self, found: Sequence[Detection]) -> bool:
        """Whether all markers of the last picture are among these."""
        return {d.id for d in found} >= self._last.keys()

    def remember(self, found: Sequence[Detection], *, whole: bool = False) -> None:
        """Takes in what was found; ``whole``: in all of the picture."""
        self._since_whole = 0 if whole else self._since_whole + 1
        self._before, self._last = self._last, {d.id: d.corners for d in found}
        sides = [np.linalg.norm(np.roll(c, -1, axis=0) - c, axis=1).sum() for c in self._last.values()]
        self.perimeter = float(min(sides, default=0.0))
