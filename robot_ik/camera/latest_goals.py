"""Process pictures in a thread, so that no tick of the control loop waits for a picture."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from typing import Self

from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.errors import FrameTimeoutError
from robot_ik.goals import Goal
from robot_ik.ports import Clock, Closing, VirtualClock, short_switch_interval

_log = logging.getLogger(__name__)

# Rate of a synthetic camera, Hz: that of a cheap camera.
SYNTHETIC_RATE_HZ = 15.0
# Longest time that ``close`` waits for the thread, s. It covers the timeout of a camera.
_CLOSE_TIMEOUT = 5.0


class LatestGoals(Closing):
    """Runs a source of goals in a thread beside the control loop.

    Taking a picture and finding a marker in it takes several periods of a control loop. In real
    time a thread therefore observes, and each tick of the loop gets the goal for the time of the
    tick. In virtual time the tick observes whenever a picture is due.

    Args:
        goals: The source. The thread calls its ``observe``, the loop its ``goal_at``.
        clock: Clock of the run.
        rate_hz: Rate of observations. None: as fast as pictures arrive. Real time only, for cameras
            that have a rate.

    Attributes:
        ended: Whether the film is over or the camera has stopped. There are no goals afterwards.
    """

    def __init__(self, goals: MarkerGoalSource, clock: Clock, rate_hz: float | None = None) -> None:
        self.ended = False
        self._goals = goals
        self._clock = clock
        self._period = 0.0 if rate_hz is None else 1.0 / rate_hz
        self._virtual = isinstance(clock, VirtualClock)
        self._next_time = -math.inf
        self._failure: BaseException | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._switching = contextlib.ExitStack()

    def __enter__(self) -> Self:
        if not self._virtual:
            self._switching.enter_context(short_switch_interval())
            self._thread = threading.Thread(target=self._run, daemon=True, name="observe")
            self._thread.start()
        return self

    def close(self) -> None:
        """Stop observing. The source stays open."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=_CLOSE_TIMEOUT)
        self._switching.close()

    def poll(self, now: float) -> Goal | None:
        """Return the goal for the time ``now``, s; None if the arm should hold.

        Raises:
            CameraError: Any error of ``observe`` except the end of the pictures.
            MarkerNotFoundError: The target is lost and its policy is ``stop``.
        """
        if self._virtual and now >= self._next_time and not self.ended:
            self._next_time = now + self._period
            self._observe(now)
        if self._failure is not None:
            raise self._failure
        return self._goals.goal_at(now)

    def _observe(self, now: float) -> None:
        try:
            self._goals.observe(now, wait=not self._virtual)
        except FrameTimeoutError as error:
            _log.info("no more pictures: %s", error)
            self.ended = True

    def _run(self) -> None:
        while not self._stop.is_set() and not self.ended:
            begin = self._clock.now()
            try:
                self._observe(begin)
            except Exception as error:
                # The next call of ``poll`` raises it.
                self._failure = error
                return
            self._stop.wait(max(0.0, begin + self._period - self._clock.now()))
