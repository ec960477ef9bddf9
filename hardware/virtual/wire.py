"""What is to happen on a virtual bus at a time, or when so many packets have come."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Sequence

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


# ------------------------------------------------------------------------------------------
# What a host receives when several servos answer at once: bits, as a UART sees them.
#
# The line is high at rest and low as soon as anybody pulls it low; a byte is a low start bit, eight data bits
# from the lowest and a high stop bit.


_SPREAD_BITS = 12
"""Two servos begin within so many bit times of each other: they do not share a clock."""


def collide(answers: Sequence[bytes], dice: random.Random) -> bytes:
    """The bytes received when ``answers`` are on the wire at once, each a little late by chance."""
    starts = [0, *(dice.randrange(1, _SPREAD_BITS) for _ in answers[1:])]
    dice.shuffle(starts)
    lines = [[1] * start + _bits(answer) for start, answer in zip(starts, answers, strict=True)]
    length = max(map(len, lines))
    wire = [min(line[k] if k < len(line) else 1 for line in lines) for k in range(length)]
    return _received(wire)


def _bits(data: bytes) -> list[int]:
    return [bit for byte in data for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]


def _received(wire: list[int]) -> bytes:
    """A start bit, then the eight bits after it, whatever the stop bit says."""
    found, at = bytearray(), 0
    while at < len(wire):
        if wire[at]:
            at += 1
            continue
        data = (*wire[at + 1 : at + 9], *[1] * 8)[:8]
        found.append(sum(bit << k for k, bit in enumerate(data)))
        at += 10
    return bytes(found)
