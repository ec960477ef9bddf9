"""Standard streams that can be written to without an error, and the width of the output."""

from __future__ import annotations

import codecs
import contextlib
import os
import sys
from typing import IO

from rich.console import Console

PIPE_WIDTH = 240
"""Columns where the output is no terminal. No table is wider, so nothing is folded."""

MIN_WIDTH = 40
"""Columns below which nothing is folded further."""

_SPELLED = {
    "°": " deg",
    "µ": "u",
    "σ": "s",
    "…": "...",
    "±": "+-",
    "×": "x",
    "·": "*",
    "²": "2",
    "³": "3",
    "–": "-",
    "—": "-",
    "≤": "<=",
    "≥": ">=",
    "∞": "inf",
    "→": "->",
    "│": "|",
    "─": "-",
    "━": "-",
    "√": "sqrt",
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼", "+"),
}
"""Replacement of each character that a stream may be unable to encode."""

_HANDLER = "robot_ik.commands.spelled"


class _Console(Console):
    """Prints text literally, and leaves a closed pipe to ``main``, which sets the exit code."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def open_console(stream: IO[str], *, stderr: bool = False, max_width: int = PIPE_WIDTH) -> Console:
    """Return a console that prints text literally, without markup or highlighting.

    Args:
        stream: Standard output or standard error.
        stderr: Whether it is standard error.
        max_width: The largest number of columns away from a terminal.
    """
    width = output_width(stream)
    if not stream.isatty() or max_width < PIPE_WIDTH:
        width = min(width, max_width)
    return _Console(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)


def output_width(stream: IO[str]) -> int:
    """Return the columns of a stream: those of ``COLUMNS``, else of its terminal."""
    given = os.environ.get("COLUMNS", "")
    columns = int(given) if given.isdecimal() else 0
    if not columns and stream.isatty():
        with contextlib.suppress(OSError, ValueError):
            columns = os.get_terminal_size(stream.fileno()).columns or 80
    return max(columns or PIPE_WIDTH, MIN_WIDTH)


def is_unicode(stream: object) -> bool:
    """Return whether a stream can encode every character."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    return bool(encoding.lower().replace("-", "").startswith("utf"))


def prepare_streams() -> bool:
    """Make standard streams that can be written to without an error.

    A closed descriptor is opened on the null device. Otherwise the next file, for example a serial
    port, gets its number, and with it everything that C libraries write to standard error.

    Returns:
        Whether there is a standard output.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number: this one
    has_output = sys.stdout is not None
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif not is_unicode(stream) and hasattr(stream, "reconfigure"):
            codecs.register_error(_HANDLER, _spell)
            stream.reconfigure(errors=_HANDLER)
    return has_output


def silence_output() -> None:
    """Redirect standard output to the null device, after its reader has closed the pipe."""
    with contextlib.suppress(OSError, ValueError):
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)


def _spell(error: UnicodeError) -> tuple[str, int]:
    """Replace the characters that a stream cannot encode."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    characters = error.object[error.start : error.end]
    return "".join(_SPELLED.get(character, "?") for character in characters), error.end
