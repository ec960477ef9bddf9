"""Steps in which a person does something to the arm, until Enter or for a time; meanwhile it is sampled."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Callable

from robot_ik.cli import console
from robot_ik.errors import HardwareError
from robot_ik.ports import Clock


class Prompts:
    """Asks for one step after the other.

    Args:
        clock: Paces the samples.
        seconds: Each step lasts so long; None: until Enter (a line on standard input).
        period: s between two samples.
    """

    def __init__(self, clock: Clock, seconds: float | None = None, period: float = 0.02) -> None:
        self._clock = clock
        self._period = period
        self._seconds = seconds
        self._lines: queue.Queue[bool] = queue.Queue()
        self._reader: threading.Thread | None = None

    @property
    def patient(self) -> bool:
        """Somebody sits there who can do a step again."""
        return self._seconds is None and sys.__stdin__ is not None and sys.__stdin__.isatty()

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Says what to do and samples until it is done, and once more then.

        Raises:
            HardwareError: Standard input has ended.  Whatever ``sample`` raises.
        """
        ending = "then press Enter" if self._seconds is None else f"{self._seconds:g} s from now"
        console.say(f"{text}; {ending}", "bold")
        self._start_reading()
        end = self._clock.now() + (self._seconds or 0.0)
        due = self._clock.now()
        while not (self._entered() if self._seconds is None else self._clock.now() >= end):
            sample()
            due = max(due + self._period, self._clock.now())
            self._clock.sleep_until(due)
        sample()

    def _entered(self) -> bool:
        try:
            more = self._lines.get_nowait()
        except queue.Empty:
            return False
        if not more:
            self._lines.put(False)
            raise HardwareError("the input ended before all steps were done", hint="or let steps take a time")
        return True

    def _start_reading(self) -> None:
        if self._reader is None and self._seconds is None:
            self._reader = threading.Thread(target=self._read, name="standard input", daemon=True)
            self._reader.start()

    def _read(self) -> None:
        # Not sys.stdin: at the end of the interpreter a thread that waits inside it would hold its lock.
        try:
            while data := os.read(sys.__stdin__.fileno() if sys.__stdin__ else 0, 1024):
                for _ in range(data.count(b"\n")):
                    self._lines.put(True)
        except (OSError, ValueError):
            pass
        self._lines.put(False)
