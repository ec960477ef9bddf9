"""Steps in which a person moves the arm, until Enter or for a time, while it is sampled."""

from __future__ import annotations

import contextlib
import os
import queue
import select
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from robot_ik.commands.terminal import Terminal, show_error
from robot_ik.errors import HardwareError, OptionError
from robot_ik.schedule import Schedule, regular

if TYPE_CHECKING:
    from robot_ik.hardware.calibration import OperatorError
    from robot_ik.ports import Clock

NO_ENTER = "standard input has ended, so Enter cannot be pressed"
"""Reason why a step cannot end with Enter."""

INPUT_WITH_ENTER = "a terminal, or a pipe that sends one line for each step"
"""Standard input with which steps can end."""

SAMPLE_PERIOD = 0.02
"""s between two samples: quick enough that a sweep by hand misses no end of a range."""

READ_BYTES = 1024
"""Bytes read from standard input at once."""


class Prompts:
    """Prompts for one step after the other.

    Args:
        terminal: Shows the steps.
        clock: Paces the samples.
        seconds: Duration of each step.  None: until Enter (a line on standard input).
        period: s between two samples.
        alternative: What to try if Enter cannot be pressed, for the error.

    Raises:
        OptionError: Steps end with Enter, and standard input has ended already.
    """

    def __init__(
        self,
        terminal: Terminal,
        clock: Clock,
        seconds: float | None = None,
        period: float = SAMPLE_PERIOD,
        alternative: str = INPUT_WITH_ENTER,
    ) -> None:
        self._terminal = terminal
        self._alternative = alternative
        self._clock = clock
        self._period = period
        self._seconds = seconds
        # True for every line of standard input, False for its end.
        self._lines: queue.Queue[bool] = queue.Queue()
        self._reader: threading.Thread | None = None
        with contextlib.suppress(OSError):  # on Windows select() works with sockets only
            if seconds is None and _has_input() and not self._read_input():
                raise OptionError("standard input", NO_ENTER, alternative)

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Print an instruction, sample until the step is done, and sample once afterwards.

        Args:
            text: Instruction to the person.
            sample: Takes a sample.

        Raises:
            HardwareError: Standard input has ended.  Errors of ``sample``.
        """
        ending = "then press Enter" if self._seconds is None else f"{self._seconds:g} s from now"
        self._terminal.say(f"{text}; {ending}", "bold")
        if self._reader is None and self._seconds is None:
            self._reader = threading.Thread(
                target=self._read_lines, name="standard input", daemon=True
            )
            self._reader.start()
        end = self._clock.now() + (self._seconds or 0.0)
        for _ in Schedule(self._clock).ticks(regular(1.0 / self._period)):
            if self._is_done(end):
                break
            sample()
        sample()

    def note(self, text: str) -> None:
        """Print the result of a step."""
        self._terminal.say(text)

    def again(self, error: OperatorError) -> bool:
        """Show why a step failed.  Return whether it can be repeated: only at a terminal."""
        if self._seconds is not None or sys.__stdin__ is None or not sys.__stdin__.isatty():
            return False
        show_error(error)
        self._terminal.say(
            "repeat the step once more (Ctrl-C ends the command; nothing is written)", "yellow"
        )
        return True

    def _is_done(self, end: float) -> bool:
        """Return whether a step is done.

        Args:
            end: Time of its end, s; for steps with a duration.
        """
        if self._seconds is not None:
            return self._clock.now() >= end
        try:
            is_line = self._lines.get_nowait()
        except queue.Empty:
            return False
        if not is_line:
            self._lines.put(False)
            raise HardwareError(NO_ENTER, hint=f"run the command with {self._alternative}")
        return True

    def _read_lines(self) -> None:
        # Not with sys.stdin: a waiting thread would keep its lock at the end of the program.
        with contextlib.suppress(OSError, ValueError):
            while self._read_input():
                pass
        self._lines.put(False)

    def _read_input(self) -> bool:
        """Count the lines that were typed.  Return False at the end of standard input."""
        data = os.read(_input_file(), READ_BYTES)
        for _ in range(data.count(b"\n")):
            self._lines.put(True)
        return bool(data)


def _input_file() -> int:
    return sys.__stdin__.fileno() if sys.__stdin__ else 0


def _has_input() -> bool:
    """Return whether standard input can be read now."""
    return bool(select.select([_input_file()], [], [], 0.0)[0])
