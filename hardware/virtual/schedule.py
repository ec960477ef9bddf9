"""What is to happen on a virtual bus at a time, or when so many packets have come."""

from __future__ import annotations

import heapq
from collections.abc import Callable

from robot_ik.ports import Clock

Action = Callable[[], None]


class Schedule:
    """Actions in the order of their time.  Not locked by itself: the bus does that.

    Args:
        clock: Whose time it is.

    Attributes:
        start: When this was made, s.
        packets: Instruction packets so far.
        upcoming: Number of the packet that is handled next; within ``count`` that is the one counted.
    """

    def __init__(self, clock: Clock) -> None:
        self.start = clock.now()
        self.packets = 0
        self.upcoming = 1
        self._clock = clock
        self._timed: list[tuple[float, int, Action]] = []
        self._counted: list[tuple[int, int, Action]] = []
        self._number = 0

    @property
    def next_time(self) -> float | None:
        """Time of the next timed action, s; ``None`` if there is none."""
        return self._timed[0][0] if self._timed else None

    def at(self, time: float, action: Action) -> None:
        """Books ``action`` for ``time``, s on the clock; a time that has passed is the next ``run``."""
        self._number += 1
        heapq.heappush(self._timed, (time, self._number, action))

    def at_packet(self, number: int, action: Action) -> None:
        """Books ``action`` for just before the packet with this number (the first is 1) is handled."""
        self._number += 1
        heapq.heappush(self._counted, (number, self._number, action))

    def run(self) -> None:
        """Does everything whose time has come."""
        while self._timed and self._timed[0][0] <= self._clock.now():
            heapq.heappop(self._timed)[2]()

    def count(self) -> None:
        """One packet more has come."""
        self.packets += 1
        while self._counted and self._counted[0][0] <= self.packets:
            heapq.heappop(self._counted)[2]()
        self.upcoming = self.packets + 1
