"""How old a goal is: the delay from the grab of its picture, measured where the goal is made and used."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

# Delays kept; older ones are forgotten, so that the figures tell of the last minute or so.
_KEPT = 2000
# A picture that is older than this, or of the future, was not stamped by the clock that is asked now.
LONGEST_S = 2.0
_AHEAD_S = 1e-3


@dataclass(frozen=True)
class Delays:
    """Delays in figures, seconds; NaN where nothing was measured.

    Attributes:
        count: How many were measured.
        p50, p95: Median, and what 95 of 100 stay below.
        longest: The longest of those kept.
    """

    count: int = 0
    p50: float = float("nan")
    p95: float = float("nan")
    longest: float = float("nan")

    def __str__(self) -> str:
        if not self.count:
            return "not measured"
        return f"p50 {1e3 * self.p50:.1f} ms, p95 {1e3 * self.p95:.1f} ms"


class DelayMeter:
    """Gathers delays; may be written by one thread and read by another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: deque[float] = deque(maxlen=_KEPT)
        self._count = 0

    def add(self, grabbed: float, now: float) -> float:
        """Takes the delay from ``grabbed`` to ``now``, seconds on one clock; gives it back.

        One that cannot be (negative, or longer than two seconds) is of two different clocks: it is not
        counted, and comes back as NaN.
        """
        delay = now - grabbed
        if not -_AHEAD_S <= delay <= LONGEST_S:
            return float("nan")
        with self._lock:
            self._kept.append(max(delay, 0.0))
            self._count += 1
        return max(delay, 0.0)

    def figures(self) -> Delays:
        """What was measured until now."""
        with self._lock:
            kept, count = list(self._kept), self._count
        if not kept:
            return Delays()
        p50, p95 = np.percentile(kept, [50.0, 95.0])
        return Delays(count, float(p50), float(p95), float(max(kept)))
