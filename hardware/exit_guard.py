"""Signals while servos have torque: turned into exceptions, so that ``with`` and ``finally`` switch it off.

A handler must not talk to the bus: it may run in the middle of a packet.  It raises, the transaction unwinds,
and whoever owns the arm shuts it down on a clean line.  From then on further signals are only counted: an
impatient second Ctrl-C cannot stop the shut-down half-way.
"""

from __future__ import annotations

import atexit
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

log = logging.getLogger(__name__)


def ending_signals(there: Any = signal) -> tuple[int, ...]:
    """Signals that end a program here: no SIGHUP on Windows, but SIGBREAK (Ctrl-Break, a closed console).

    Args:
        there: What has them by name.
    """
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
    return tuple(getattr(there, name) for name in names if hasattr(there, name))


SIGNALS = ending_signals()

PATIENCE = 5.0
"""s after which a program that swallowed the first exception gets a second one."""


class ExitGuard:
    """Handlers of SIGINT, SIGTERM and SIGHUP, and a last resort at the end of the interpreter.

    Handlers are installed only from the main thread (Python allows no other) and only for signals the process
    does not ignore.  In another thread only the last resort is armed.

    Args:
        last_resort: Called by ``atexit`` if nobody removed the guard; must not raise.
    """

    def __init__(self, last_resort: Callable[[], object]) -> None:
        self._last_resort = last_resort
        self._previous: dict[int, Any] = {}
        self._shielded = 0
        self._deferred: int | None = None
        self._raised_at: float | None = None
        self.received = 0
        """Signals seen since ``install``."""

    def install(self) -> None:
        """Takes the signals over.  May be called again after ``remove``."""
        self._deferred = self._raised_at = None
        self.received = 0
        atexit.unregister(self._last_resort)  # not twice
        atexit.register(self._last_resort)
        if threading.current_thread() is not threading.main_thread():
            log.warning("not in the main thread: SIGINT and SIGTERM cannot be turned into an orderly exit")
            return
        for number in SIGNALS:
            previous = signal.getsignal(number)
            if previous not in (signal.SIG_IGN, None, self._handle):
                self._previous[number] = previous
                signal.signal(number, self._handle)

    def remove(self) -> None:
        """Gives the signals back to whoever had them; may be called any number of times."""
        atexit.unregister(self._last_resort)
        if threading.current_thread() is not threading.main_thread():
            return  # a handler that stays behind passes its signals on, see _handle
        for number, previous in list(self._previous.items()):
            if signal.getsignal(number) == self._handle:
                signal.signal(number, previous)
                del self._previous[number]

    @contextmanager
    def shield(self) -> Iterator[None]:
        """Signals that arrive inside are kept for ``deferred`` instead of raising."""
        self._shielded += 1
        try:
            yield
        finally:
            self._shielded -= 1

    def deferred(self) -> BaseException | None:
        """What a signal inside ``shield`` asks for, unless an earlier one is unwinding already."""
        number, self._deferred = self._deferred, None
        return None if number is None or self._raised_at is not None else self._exception(number)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.received += 1
        now = time.monotonic()
        if self._shielded:
            self._deferred = number
        elif self._raised_at is None or now - self._raised_at > PATIENCE:
            self._raised_at = now
            raise self._exception(number)

    @staticmethod
    def _exception(number: int) -> BaseException:
        """As a shell would report it: 128 + number; Ctrl-C as Python does it."""
        return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
