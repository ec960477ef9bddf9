"""When a tick is due, and on whose clock."""

from __future__ import annotations

from collections.abc import Sequence

from robot_ik.ports import Clock, JointSink, JointSource, RealClock


class Schedule:
    """Deadlines a period apart that yield to a stall instead of bunching up.

    Attributes:
        overruns: Ticks that came a whole period late or more.
        slipped: Seconds by which the schedule was moved because of them.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.origin = clock.now()
        self.overruns = 0
        self.slipped = 0.0

    def wait(self, due: float, period: float) -> float:
        """Sleeps until ``due`` seconds after the origin; the time on the clock then."""
        self.clock.sleep_until(self.origin + due)
        now = self.clock.now()
        late = now - (self.origin + due)
        if period > 0.0 and late >= period:
            self.overruns += 1
            self.slipped += late
            self.origin += late
        return now


def clock_of(clock: Clock | None, source: JointSource | None, sinks: Sequence[JointSink]) -> Clock:
    """The given clock, else that of the arm: a simulated arm stands still on the machine's clock."""
    if clock is not None:
        return clock
    for part in (source, *sinks):
        own: Clock | None = getattr(part, "clock", None)
        if own is not None:
            return own
    return RealClock()
