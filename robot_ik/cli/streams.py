"""Standard streams as they may be: closed, or of an encoding without the signs that tables use."""

from __future__ import annotations

import codecs
import contextlib
import os
import sys

# What a stream without these signs shows instead.
_SPELLED = {
    "°": " deg", "µ": "u", "σ": "s", "…": "...", "±": "+-", "×": "x", "·": "*", "²": "2", "³": "3", "–": "-",
    "—": "-", "≤": "<=", "≥": ">=", "∞": "inf", "→": "->", "│": "|", "─": "-", "━": "-", "√": "sqrt",
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼", "+"),
}  # fmt: skip
_HANDLER = "robot_ik.spelled"


def _spell(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_SPELLED.get(sign, "?") for sign in error.object[error.start : error.end]), error.end


def is_unicode(stream: object) -> bool:
    """Whether a stream can show every sign."""
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "").startswith("utf")


def prepare_streams() -> bool:
    """Makes standard streams that can be written to without an error; False: there is no standard output.

    A closed descriptor is opened on the null device: the next file, a serial port perhaps, would get its
    number, and with it what C libraries write to their standard error.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    there = sys.stdout is not None
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - for good
        elif not is_unicode(stream):
            codecs.register_error(_HANDLER, _spell)
            with contextlib.suppress(AttributeError, OSError):  # a stream that somebody made himself
                stream.reconfigure(errors=_HANDLER)
    return there
