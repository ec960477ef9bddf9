"""When the faults of a virtual bus begin and end."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

from robot_ik.ports import Clock

Action = Callable[[], None]


class WireSchedule:
    """Actions in the order of their time. Not locked: the bus holds its lock.

    Attributes:
        packets: Number of instruction packets so far.
        upcoming: Number of the next packet; within ``count``, number of the counted packet.
    """

    def __init__(self, clock: Clock) -> None:
        self.packets = 0
        self.upcoming = 1
        self._clock = clock
        self._timed: list[tuple[float, int, Action]] = []
        self._counted: list[tuple[int, int, Action]] = []
        self._numbers = itertools.count()

    @property
    def next_time(self) -> float | None:
        """Time of the next timed action, s; None if there is none."""
        return self._timed[0][0] if self._timed else None

    def at(self, time: float, action: Action) -> None:
        """Schedule ``action`` for ``time`` in s. A time in the past means the next ``run``."""
        heapq.heappush(self._timed, (time, next(self._numbers), action))

    def at_packet(self, number: int, action: Action) -> None:
        """Schedule ``action`` just before the packet with this number; the first is 1."""
        heapq.heappush(self._counted, (number, next(self._numbers), action))

    def run(self) -> None:
        """Do the timed actions that are due."""
        while self._timed and self._timed[0][0] <= self._clock.now():
            heapq.heappop(self._timed)[2]()

    def count(self) -> None:
        """Count an instruction packet and do the actions scheduled for it."""
        self.packets += 1
        while self._counted and self._counted[0][0] <= self.packets:
            heapq.heappop(self._counted)[2]()
        self.upcoming = self.packets + 1
