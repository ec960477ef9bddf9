"""Protocols that connect the parts of a program, and the clocks of a run.

This module depends on no robot, solver or servo. Joint vectors are ``q`` of shape (nq,) in the
order of the joints of the robot, in radians (metres for slides). Times are seconds on the clock of
the loop.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Image = NDArray[np.uint8]
"""A picture (height, width) or (height, width, 3), BGR."""

Mask = NDArray[np.bool_]
"""Selected pixels (height, width) of a picture."""

Goal_co = TypeVar("Goal_co", covariant=True)


@dataclass(frozen=True)
class JointReading:
    """Measured joint angles and velocities.

    Attributes:
        q: Joint angles (nq,), rad or m, never clipped to limits.
        time: Time of the measurement, seconds on the clock of the run.
        dq: Joint velocities (nv,), rad/s or m/s. None if the source does not measure them.
    """

    q: Array
    time: float
    dq: Array | None = None


@runtime_checkable
class JointSink(Protocol):
    """Takes joint angles. Examples are a viewer, a recorder and a servo arm."""

    def send(self, q: Array, now: float) -> object:
        """Take the commanded ``q`` (nq,) for the time ``now`` in seconds.

        The method must neither keep nor change ``q``. What it returns is not used.
        """
        ...


@runtime_checkable
class JointSource(Protocol):
    """Gives measured joint angles."""

    def read(self) -> JointReading:
        """Return the latest measured joint angles."""
        ...


class GoalSource(Protocol[Goal_co]):
    """Gives goals to ``follow``. Examples are a slider, a curve, a script and a camera."""

    def poll(self, now: float) -> Goal_co | None:
        """Return the goal for the time ``now`` in seconds. None means: keep the last position."""
        ...


class Clock(Protocol):
    """Gives the time and waits. A virtual clock lets tests and simulations run at full speed."""

    def now(self) -> float:
        """Return the time in seconds. It never decreases."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline``, seconds on this clock, or at once if it has passed."""
        ...


class RealClock:
    """The monotonic clock of the machine. Changes of the wall clock have no effect."""

    def __repr__(self) -> str:
        return "RealClock()"

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        wait = deadline - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)


class VirtualClock:
    """A clock whose time passes only in ``sleep_until``."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def __repr__(self) -> str:
        return f"VirtualClock(now={self._now:g} s)"

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, deadline)


class Closing:
    """A context manager that calls ``close`` at the end of its block."""

    def close(self) -> None:
        """Release the resources."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


SWITCH_INTERVAL = 0.0005
"""Seconds between two switches of threads in a real-time loop."""

_switch_lock = threading.Lock()
_switch_users = 0
_usual_switch_interval = 0.0


@contextlib.contextmanager
def short_switch_interval() -> Iterator[None]:
    """Switch the threads of this process every 0.5 ms, for loops in real time.

    The interpreter's default of 5 ms is half a period of a loop at 100 Hz. Beside a thread that
    computes pictures, such a loop lost a fifth of its rate, and replies of servos came too late.
    The last block to end restores the interval that the first block found.
    """
    global _switch_users, _usual_switch_interval
    with _switch_lock:
        if _switch_users == 0:
            _usual_switch_interval = sys.getswitchinterval()
            sys.setswitchinterval(min(SWITCH_INTERVAL, _usual_switch_interval))
        _switch_users += 1
    try:
        yield
    finally:
        with _switch_lock:
            _switch_users -= 1
            if _switch_users == 0:
                sys.setswitchinterval(_usual_switch_interval)
