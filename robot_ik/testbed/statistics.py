"""Numbers of an instance over its last frames, and histories of a fixed length."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from robot_ik.ports import Array

WINDOW = 1000
"""Frames that the statistics cover, as in S12's program."""


@dataclass(frozen=True)
class Statistics:
    """Of the last ``count`` solves, at most ``WINDOW``.

    Attributes:
        count: How many solves these numbers cover.
        mean, p99: Seconds of processor time of a solve, without those in which its thread waited for others;
            a page's times are no benchmark.
        iterations: Mean steps of a solve.
        solved: Share of solves that met the ball's goal, from 0 to 1; goals beside it do not count.
    """

    count: int = 0
    mean: float = 0.0
    p99: float = 0.0
    iterations: float = 0.0
    solved: float = 0.0


class Window:
    """The last solves of one instance."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, int, bool]] = deque(maxlen=WINDOW)

    def add(self, seconds: float, iterations: int, solved: bool) -> None:
        """One solve more."""
        self._rows.append((seconds, iterations, solved))

    def clear(self) -> None:
        """Forgets all."""
        self._rows.clear()

    def statistics(self) -> Statistics:
        """Of what is in the window."""
        if not self._rows:
            return Statistics()
        rows = np.array(self._rows, dtype=float)
        mean, iterations, solved = rows.mean(axis=0).tolist()
        return Statistics(len(rows), mean, float(np.percentile(rows[:, 0], 99)), iterations, solved)


class History:
    """The last rows of a series, oldest first.

    Args:
        length: How many rows are kept.
        width: Numbers in a row.
    """

    def __init__(self, length: int, width: int) -> None:
        # Twice as long, so that a full one is moved once in ``length`` rows and not in each.
        self._rows, self._length, self._end = np.zeros((2 * length, width)), length, 0

    def add(self, row: Array | float) -> None:
        """One row (width,) more."""
        if self._end == len(self._rows):
            self._rows[: self._length] = self._rows[self._length :]
            self._end = self._length
        self._rows[self._end] = row
        self._end += 1

    def clear(self) -> None:
        """Forgets all."""
        self._end = 0

    def rows(self) -> Array:
        """(n, width) a copy."""
        return self._rows[max(0, self._end - self._length) : self._end].copy()
