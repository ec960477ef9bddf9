"""Measured delays of pictures and goals."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

# Number of delays that are kept: about the last minute of a camera of 30 Hz.
_CAPACITY = 2000
# Largest plausible delay, s. A longer one is the difference of two different clocks.
MAX_DELAY = 2.0
# A time may be this far in the future because clocks are read one after the other, s.
_CLOCK_SLACK = 1e-3


@dataclass(frozen=True)
class Delays:
    """A summary of delays, in seconds.

    Attributes:
        count: Number of delays measured.
        p50: Median. NaN if none was measured.
        p95: 95th percentile. NaN if none was measured.
    """

    count: int = 0
    p50: float = math.nan
    p95: float = math.nan

    def __str__(self) -> str:
        if not self.count:
            return "not measured"
        return f"p50 {1e3 * self.p50:.1f} ms, p95 {1e3 * self.p95:.1f} ms"


class DelayMeter:
    """Collects delays. One thread may write while another reads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._delays: deque[float] = deque(maxlen=_CAPACITY)
        self._count = 0

    def add(self, start: float, end: float) -> float:
        """Add the delay between two times on one clock, s, and return it.

        A delay that is negative or longer than ``MAX_DELAY`` is between two different clocks. It is
        not counted, and NaN is returned.
        """
        delay = end - start
        if not -_CLOCK_SLACK <= delay <= MAX_DELAY:
            return math.nan
        delay = max(delay, 0.0)
        with self._lock:
            self._delays.append(delay)
            self._count += 1
        return delay

    def summary(self) -> Delays:
        """Return the summary of the delays so far."""
        with self._lock:
            delays = list(self._delays)
            count = self._count
        if not delays:
            return Delays()
        p50, p95 = np.percentile(delays, [50.0, 95.0])
        return Delays(count, float(p50), float(p95))
