"""The time by which each command may move an arm.

A caller's clock may jump, and a program that was stopped may send in one burst what it missed.  So
a command moves the arm by the shortest of three times: the time since the last command on the
caller's clock, the unused time on the arm's own clock, and ``LONGEST_TICK`` control periods.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from robot_ik.ports import Clock

PAUSE = 0.25
"""s on the arm's own clock between two commands after which the arm starts from rest.

It also applies to a program that sends slowly.
"""

LONGEST_TICK = 2.0
"""Longest time by which one command moves the arm, in control periods.

After a longer pause the shafts stand, so the arm starts from rest.  For a program that sends more
slowly, the pause is compared with this multiple of the program's own period.
"""

SHORTEST_TICK = 0.01
"""Control periods below which a command moves nothing.

Over shorter times the velocities are mostly rounding.
"""

JITTER = 0.1
"""Control periods of unused time that later commands may use: a clock is read a little late."""

REPEATED_TIME_SHARE = 0.5
"""Control periods that must have passed before a command with an impossible time moves the arm."""


class Tick(NamedTuple):
    """The time of one command.

    Attributes:
        dt: s by which the command may move the arm; 0: it moves nothing.
        from_rest: The shafts stand, so the arm starts from rest.
    """

    dt: float
    from_rest: bool = False


class CommandClock:
    """Gives every command its time.

    Args:
        clock: Clock of the arm.
        period: Control period, s.
    """

    def __init__(self, clock: Clock, period: float) -> None:
        self._clock = clock
        self._period = period
        # Time of the caller at the last command, s.
        self._last: float | None = None
        # s between the last two commands on the arm's clock.
        self._rhythm = period
        # Time on the arm's clock that the commands so far have used, s.
        self._used_until = -math.inf

    def restart(self) -> None:
        """Forget the commands so far: the arm stands."""
        self._last = None
        self._used_until = self._clock.now()

    def tick(self, time: float) -> Tick:
        """Return the time of the next command.

        Args:
            time: Time for which the command is meant, s on the caller's clock.
        """
        last = self._last
        self._last = time
        now = self._clock.now()
        if last is None:
            self._used_until = now
            self._rhythm = self._period
            return Tick(self._period)

        requested = time - last
        passed = now - self._used_until
        usual_period = max(self._rhythm, self._period)
        self._rhythm = passed
        from_rest = passed > min(LONGEST_TICK * usual_period + JITTER * self._period, PAUSE)
        if from_rest:
            requested = self._period
        elif not 0.0 < requested <= PAUSE:
            # The same time again, another zero of time, or a clock that was set.
            enough = passed >= REPEATED_TIME_SHARE * self._period
            requested = self._period if enough else 0.0

        dt = min(requested, passed, LONGEST_TICK * self._period)
        if dt < SHORTEST_TICK * self._period:
            return Tick(0.0, from_rest)  # the time that has passed is left to the next command
        self._used_until = max(self._used_until + dt, now - JITTER * self._period)
        return Tick(dt, from_rest)
