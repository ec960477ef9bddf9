"""Single keys of the terminal, without Enter."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from robot_ik.cli import console

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm

POLL_PERIOD = 0.05
"""s between two looks for a key."""


@contextmanager
def single_keys() -> Iterator[int | None]:
    """Switch standard input to single keys, without Enter.

    Yields:
        The file descriptor of standard input; None if it is no terminal of this process.
    """
    try:
        import termios  # Windows has neither
        import tty

        file = sys.stdin.fileno()
        # A program in the shell's background may not touch the terminal.
        is_ours = sys.stdin.isatty() and os.tcgetpgrp(file) == os.getpgrp()
    except (ImportError, OSError, ValueError, AttributeError):  # no terminals, or stdin is closed
        is_ours = False
    if not is_ours:
        yield None
        return
    before = termios.tcgetattr(file)
    try:
        tty.setcbreak(file)
        yield file
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)


@contextmanager
def stop_on_space(arm: Arm) -> Iterator[None]:
    """Make the space bar stop and hold an arm, as ``robot-ik stop`` does; only at a terminal."""
    ended = threading.Event()

    def listen(file: int) -> None:
        while not ended.is_set():
            if select.select([file], [], [], POLL_PERIOD)[0]:
                key = os.read(file, 1)
                if key == b" ":
                    arm.request_stop()
                elif not key:
                    return

    with single_keys() as file:
        if file is None:
            yield
            return
        console.say("space: stop and hold", "dim")
        listener = threading.Thread(target=listen, args=(file,), name="space", daemon=True)
        listener.start()
        try:
            yield
        finally:
            ended.set()
            listener.join()
