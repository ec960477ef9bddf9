"""What the parts of the program plug into each other with: protocols, and the clocks of a run.

Nothing here knows a robot, a solver or a servo.  Joint vectors are ``q`` of shape (nq,) in
radians (metres for slides), in the robot's joint order; times are seconds on the clock of
whoever runs the loop.
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
#: A picture (height, width) or (height, width, 3), BGR; and which of its pixels.
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Goal_co = TypeVar("Goal_co", covariant=True)


@dataclass(frozen=True)
class JointReading:
    """Measured joint angles.

    Attributes:
        q: (nq,) rad or m, never clipped to limits.
        time: When they were sampled, seconds on the run's clock.
    """

    q: Array
    time: float


@runtime_checkable
class JointSink(Protocol):
    """Takes joint angles: a viewer, a recorder, a servo arm."""

    def send(self, q: Array, now: float) -> object:
        """Takes the commanded ``q`` (nq,) for the time ``now`` in seconds.  Must not keep or change ``q``.

        What it returns is not used.
        """
        ...


@runtime_checkable
class JointSource(Protocol):
    """Gives measured joint angles."""

    def read(self) -> JointReading:
        """The newest measured joint angles."""
        ...


class GoalSource(Protocol[Goal_co]):
    """Feeds goals to ``follow``: a hand, a curve, a script, a camera."""

    def poll(self, now: float) -> Goal_co | None:
        """The goal for the time ``now`` in seconds; ``None`` means: hold where you are."""
        ...


class Clock(Protocol):
    """Gives the time and waits; real, or virtual so that tests and simulated buses run at full speed."""

    def now(self) -> float:
        """Seconds, monotonic."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Returns at ``deadline`` (seconds on this clock) or at once if that has passed."""
        ...


class RealClock:
    """The machine's monotonic clock: jumps of the wall clock have no effect."""

    def __repr__(self) -> str:
        return "RealClock()"

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        wait = deadline - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)


class Closing:
    """A context manager whose block ends with its own ``close``."""

    def close(self) -> None:
        """Lets go of what it holds."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


_SWITCH_INTERVAL_S = 0.0005
_switch_lock = threading.Lock()
_switch_users, _usual_interval_s = 0, 0.0


@contextlib.contextmanager
def short_switch_interval() -> Iterator[None]:
    """Threads of this process take turns every 0.5 ms while anybody is inside, for loops in real time.

    The interpreter's default of 5 ms is half a period of a loop of 100 Hz: beside a thread that computes
    pictures the loop lost a fifth of its rate, and answers of servos came too late.  The last one to leave
    restores the interval that the first one found.
    """
    global _switch_users, _usual_interval_s
    with _switch_lock:
        if _switch_users == 0:
            _usual_interval_s = sys.getswitchinterval()
            sys.setswitchinterval(min(_SWITCH_INTERVAL_S, _usual_interval_s))
        _switch_users += 1
    try:
        yield
    finally:
        with _switch_lock:
            _switch_users -= 1
            if _switch_users == 0:
                sys.setswitchinterval(_usual_interval_s)


class VirtualClock:
    """Time that passes only when somebody sleeps."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def __repr__(self) -> str:
        return f"VirtualClock(now={self._now:g} s)"

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, deadline)
