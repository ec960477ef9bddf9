"""Ticks come when they are due, also after delays."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from robot_ik.ports import VirtualClock
from robot_ik.schedule import Schedule, StoppableClock, regular


def test_each_value_comes_when_it_is_due() -> None:
    clock = VirtualClock(5.0)
    ticks = list(Schedule(clock).ticks([(0.0, "a"), (0.25, "b"), (1.0, "c")]))
    assert ticks == [(5.0, "a"), (5.25, "b"), (6.0, "c")]


def test_regular_ticks_have_exact_times() -> None:
    assert list(regular(3.0, 4)) == [(k / 3.0, k) for k in range(4)]
    endless = regular(10.0)
    assert [next(endless)[1] for _ in range(100)] == list(range(100))


@pytest.mark.parametrize(
    ("delay", "overruns", "times"),
    [
        pytest.param(0.09, 0, [0.0, 0.1, 0.2, 0.3], id="within the period"),
        pytest.param(0.15, 0, [0.0, 0.1, 0.25, 0.3], id="shorter than a period: caught up"),
        pytest.param(0.95, 1, [0.0, 0.1, 1.05, 1.15], id="longer: the schedule moves"),
    ],
)
def test_delays(delay: float, overruns: int, times: list[float]) -> None:
    """The loop body is slow once, in the second tick."""
    clock = VirtualClock()
    schedule = Schedule(clock)
    seen = []
    for now, k in schedule.ticks(regular(10.0, 4)):
        seen.append(now)
        if k == 1:
            clock.sleep_until(now + delay)
    assert seen == pytest.approx(times)
    assert schedule.overruns == overruns


def test_values_are_taken_one_at_a_time() -> None:
    """A loop may compute the next value from the effect of the last one."""
    clock = VirtualClock()
    taken: list[int] = []

    def values() -> Iterator[tuple[float, int]]:
        for k in range(3):
            taken.append(k)
            yield 0.1 * k, k

    for _, k in Schedule(clock).ticks(values()):
        assert taken == list(range(k + 1))


def test_an_event_ends_the_sleep_of_a_stoppable_clock() -> None:
    stop = threading.Event()
    clock = StoppableClock(stop)
    sleeper = threading.Thread(
        target=clock.sleep_until, args=(time.monotonic() + 1e6,), daemon=True
    )
    sleeper.start()
    stop.set()
    sleeper.join(60.0)
    assert not sleeper.is_alive()
