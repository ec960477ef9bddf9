"""The iterator of all loops that run at a rate: it waits until each value is due."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from robot_ik.ports import Clock

Value = TypeVar("Value")


class Schedule:
    """Absolute deadlines. They move after a long delay.

    A delay below one period is caught up, so delays never add up. After a longer delay the rest of
    the schedule moves, because two samples sent at once are a jump for a servo.

    Args:
        clock: Clock to wait on. Its present time is the origin of the schedule.

    Attributes:
        overruns: Number of ticks that were late by a period or more.
    """

    def __init__(self, clock: Clock) -> None:
        self.overruns = 0
        self._clock = clock
        self._origin = clock.now()

    def ticks(self, values: Iterable[tuple[float, Value]]) -> Iterator[tuple[float, Value]]:
        """Yield each value when it is due, with the time on the clock.

        Args:
            values: Due time, s since the origin, and value. The times increase.
        """
        before: float | None = None
        for due, value in values:
            period = 0.0 if before is None else due - before
            before = due
            yield self._wait(due, period), value

    def _wait(self, due: float, period: float) -> float:
        """Sleep until ``due`` seconds after the origin, and return the time on the clock."""
        self._clock.sleep_until(self._origin + due)
        now = self._clock.now()
        late = now - (self._origin + due)
        if period > 0.0 and late >= period:
            self.overruns += 1
            self._origin += late
        return now


def regular(rate: float, count: int | None = None) -> Iterator[tuple[float, int]]:
    """Yield due times at a rate from 0 on, each with its index.

    Args:
        rate: Ticks a second, Hz.
        count: Number of ticks. None: no end.
    """
    indices = itertools.count() if count is None else range(count)
    return ((k / rate, k) for k in indices)


class StoppableClock:
    """The monotonic clock of the machine. An event ends a sleep.

    Args:
        stop: The event.
    """

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        wait = deadline - time.monotonic()
        if wait > 0.0:
            self._stop.wait(wait)
