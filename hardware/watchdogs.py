"""Watchdogs for a program that drives an arm and ends, pauses or is killed.

    failure                          what acts                      when, and what happens
    -------------------------------  -----------------------------  -------------------------------
    a person or the system ends      ``signals.ExitGuard``:         at once: the arm is left by
    the program                      signals become exceptions      ``on_exit``, then the handlers
                                                                    from before run
    the program stops commanding     ``Heartbeat``: a thread        ``stale_ms`` after the last
                                                                    command the arm holds; after
                                                                    2 s ``on_stale`` decides
    program, computer or cable       Bus Watchdog of every servo    ``watchdog_ms`` after the last
                                     of a family that has one       packet the servo stops and
                                                                    holds with torque on

The heartbeat must act before the Bus Watchdogs trip.  ``min_watchdog_ms`` is the condition.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

WATCHDOG_UNIT_MS = 20
"""ms of one count of the register Bus Watchdog (address 98 of every X series table)."""

BEAT = 0.05
"""s between two beats of the heartbeat."""

GIVE_UP = 2.0
"""s without a command after which ``on_stale`` = park or torque_off is carried out."""

STALE_CYCLES = 3.0
"""Control cycles that may be missed before an arm is held, however short ``stale_ms`` is."""

HOLD_CYCLES = 2.0
"""Control cycles that holding an arm takes at most."""


def stale_time(stale_ms: int, period: float) -> float:
    """Return the time in s without a command after which an arm is held.

    Args:
        stale_ms: As in the arm file.
        period: Control period, s.
    """
    return max(0.001 * stale_ms, STALE_CYCLES * period)


def min_watchdog_ms(stale_ms: int, period: float) -> int:
    """Return the shortest Bus Watchdog that trips only if the heartbeat cannot run.

    The first beat after ``stale_time`` finds the arm stale, and holding it takes ``HOLD_CYCLES``.

    Args:
        stale_ms: As in the arm file.
        period: Control period, s.
    """
    needed_ms = 1000.0 * (stale_time(stale_ms, period) + BEAT + HOLD_CYCLES * period)
    return WATCHDOG_UNIT_MS * (math.floor(needed_ms / WATCHDOG_UNIT_MS + 1e-9) + 1)


class Heartbeat:
    """Calls a function every ``BEAT`` seconds until stopped, from a thread of its own.

    Without it, a busy program would not notice a servo that overheats, and the Bus Watchdogs would
    trip without a failure.

    Args:
        beat: The function.  It must not raise.
    """

    def __init__(self, beat: Callable[[], None]) -> None:
        self._beat = beat
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread.  May be called again after ``stop``.

        Raises:
            RuntimeError: The system gives no thread.
        """
        if self._thread is not None and self._thread.is_alive() and not self._stop.is_set():
            return  # a dismissed thread may live for a beat, and does nothing
        self._stop = threading.Event()
        thread = threading.Thread(
            target=self._run, args=(self._stop,), name="heartbeat", daemon=True
        )
        thread.start()
        self._thread = thread  # only now: a thread that never started cannot be joined

    def dismiss(self) -> None:
        """Begin no further beat.  A beat that has begun ends soon."""
        self._stop.set()

    def stop(self) -> None:
        """End the thread.  May be called any number of times, also from ``beat``."""
        self._stop.set()
        thread = self._thread
        self._thread = None
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=GIVE_UP)

    def stopping(self) -> bool:
        """Return whether the thread is to end."""
        return self._stop.is_set()

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(BEAT):
            self._beat()
