"""Where in the next picture the markers of the last ones will be."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect.detector import Detection, shortest_side

Array = NDArray[np.float64]
Box = tuple[int, int, int, int]

# The window for a marker: its box and so much of its size on each side, for its white margin (a cell) and
# for what it moves otherwise than in the last picture; and when it was not there.
_MARGIN, _WIDE_MARGIN = 0.5, 1.5
# The whole picture is searched every so many pictures all the same: for markers that come into view.
_WHOLE_EVERY = 10
# A window of more than this part of the picture saves nothing.
_LARGEST_PART = 0.5


class SearchWindow:
    """Remembers the corners of the last two pictures.

    Attributes:
        side: The shortest one in the last picture, px; 0 when there was none.
    """

    def __init__(self) -> None:
        self.side = 0.0
        self._last: dict[int, Array] = {}
        self._before: dict[int, Array] = {}
        self._since_whole = 0

    @property
    def due(self) -> bool:
        """Whether it is time to search the whole picture, or there is nothing to search round."""
        return not self._last or self._since_whole + 1 >= _WHOLE_EVERY

    def around(self, width: int, height: int, *, wide: bool = False) -> Box | None:
        """Part of the picture (x0, y0, x1, y1), half open, for the last markers; None: search all of it."""
        x0, y0, x1, y1 = math.inf, math.inf, -math.inf, -math.inf
        for i, corners in self._last.items():
            (left, top), (right, bottom) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
            dx = (_WIDE_MARGIN if wide else _MARGIN) * (right - left)
            dy = (_WIDE_MARGIN if wide else _MARGIN) * (bottom - top)
            # Where it is if it stays, and if it goes on as it did.
            step = (corners - self._before.get(i, corners)).mean(axis=0).tolist()
            x0, x1 = min(x0, left - dx + min(step[0], 0.0)), max(x1, right + dx + max(step[0], 0.0))
            y0, y1 = min(y0, top - dy + min(step[1], 0.0)), max(y1, bottom + dy + max(step[1], 0.0))
        if not self._last:
            return None
        left, right = max(math.floor(x0), 0), min(math.ceil(x1) + 1, width)
        top, bottom = max(math.floor(y0), 0), min(math.ceil(y1) + 1, height)
        if right <= left or bottom <= top or (right - left) * (bottom - top) > _LARGEST_PART * width * height:
            return None
        return left, top, right, bottom

    def holds(self, found: Sequence[Detection]) -> bool:
        """Whether all markers of the last picture are among these."""
        return {d.id for d in found} >= self._last.keys()

    def remember(self, found: Sequence[Detection], *, whole: bool = False) -> None:
        """Takes in what was found; ``whole``: in all of the picture."""
        self._since_whole = 0 if whole else self._since_whole + 1
        self._before, self._last = self._last, {d.id: d.corners for d in found}
        self.side = min((shortest_side(c) for c in self._last.values()), default=0.0)
