"""Looking beside the control loop: the newest goal is always at hand, and no tick waits for a picture."""

from __future__ import annotations

import logging
import sys
import threading
from types import TracebackType
from typing import Any, Self

from robot_ik.errors import FrameTimeoutError
from robot_ik.ports import Clock, GoalSource, VirtualClock

_log = logging.getLogger(__name__)

# A goal older than this is history: then the arm holds.
_MAX_AGE_S = 0.5
# The interpreter changes threads every 5 ms by default, half a period of the loop: with pictures computed
# in Python that cost a fifth of the loop's rate and answers of servos that came too late.
_SWITCH_INTERVAL_S = 0.0005
# How often a scene that exists only in numbers is looked at, Hz: as a cheap camera would.
SYNTHETIC_RATE_HZ = 15.0


class LatestGoals:
    """Asks a goal source on a thread of its own (real time), or whenever a picture is due (virtual time).

    Taking a picture and finding a marker in it takes several periods of a control loop.  A source with
    ``look`` and ``goal_at`` (``MarkerGoalSource``) looks there and is asked for the goal at each tick's own
    time; any other is polled there, and its newest goal given.

    Args:
        goals: What looks.
        clock: The run's clock.
        rate_hz: How often to look; None, real time only: as fast as pictures come, for cameras that
            have a rate of their own.

    Attributes:
        ended: The film is over, or the camera has stopped; from then on there is no goal.
    """

    def __init__(self, goals: GoalSource[Any], clock: Clock, rate_hz: float | None = None) -> None:
        self._goals, self._clock = goals, clock
        self._look_at = getattr(goals, "look", None)
        self._goal_at = getattr(goals, "goal_at", None)
        self._period = 0.0 if rate_hz is None else 1.0 / rate_hz
        self._virtual = isinstance(clock, VirtualClock)
        self._due = -float("inf")
        self._lock = threading.Lock()
        self._latest: Any = None
        self._seen_at = -float("inf")
        self._failure: BaseException | None = None
        self.ended = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._switch_interval = sys.getswitchinterval()

    def __enter__(self) -> Self:
        if not self._virtual:
            self._switch_interval = sys.getswitchinterval()
            sys.setswitchinterval(min(_SWITCH_INTERVAL_S, self._switch_interval))
            self._thread = threading.Thread(target=self._run, daemon=True, name="looking")
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops looking; the source stays open."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            sys.setswitchinterval(self._switch_interval)

    def poll(self, now: float) -> Any:
        """The newest goal; None, which means hold, when there is none or it is older than half a second.

        Raises:
            CameraError: What looking raised, except that pictures came to an end.
            MarkerNotFoundError: The source's policy for a lost marker says stop.
        """
        if self._virtual and now >= self._due and not self.ended:
            self._due = now + self._period
            self._look(now)
        with self._lock:
            if self._failure is not None:
                raise self._failure
            fresh = now - self._seen_at <= max(_MAX_AGE_S, 2.0 * self._period)
            latest = self._latest if fresh else None
        return latest if self._goal_at is None else self._goal_at(now)

    def _look(self, now: float) -> None:
        goal = None
        try:
            if self._look_at is not None:
                self._look_at(now, wait=not self._virtual)
            else:
                goal = self._goals.poll(now)
        except FrameTimeoutError as error:
            _log.info("no more pictures: %s", error)
            self.ended = True
            return
        with self._lock:
            self._latest, self._seen_at = goal, self._clock.now()

    def _run(self) -> None:
        while not self._stop.is_set() and not self.ended:
            begin = self._clock.now()
            try:
                self._look(begin)
            except Exception as error:  # handed to whoever asks next
                with self._lock:
                    self._failure = error
                return
            self._stop.wait(max(0.0, begin + self._period - self._clock.now()))
