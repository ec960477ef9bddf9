"""The second of three watchdogs: a thread that looks after an arm whose program has stopped commanding it.

The first is the limiter's (a pause ends in rest), the third is in the servos (Bus Watchdog: nobody speaks).
Between them lies the program that is alive and busy with something else: then nobody would see a servo that
overheats, and the Bus Watchdog would trip although nothing is wrong.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

BEAT = 0.05
"""s between two looks; well within any Bus Watchdog one would set."""

GIVE_UP = 2.0
"""s without a command after which ``on_stale`` = park or torque_off is carried out."""


class Heartbeat:
    """Calls ``look`` every ``BEAT`` seconds until stopped, from a thread of its own.

    Args:
        look: Must not raise.
    """

    def __init__(self, look: Callable[[], None]) -> None:
        self._look = look
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """From here on; may be called again after ``stop``."""
        if self._thread is not None and self._thread.is_alive():
            return
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name="heartbeat", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """No look begins after this returns; may be called any number of times, also from ``look``."""
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=GIVE_UP)

    def stopping(self) -> bool:
        """Whether the thread has been told to end."""
        return self._stop.is_set()

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(BEAT):
            self._look()
