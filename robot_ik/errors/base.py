"""What all errors share: the root, and how a wrong name is answered."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


def close_matches(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Known names most like ``name``, best first (compared without regard to case)."""
    name = str(name)  # None or a number is an unknown name too
    by_lower = {item.lower(): item for item in known}
    found = difflib.get_close_matches(name.lower(), list(by_lower), n=count, cutoff=0.5)
    return [by_lower[item] for item in found]


def unknown_name_text(kind: str, name: str, known: Sequence[str]) -> str:
    """One sentence for an unknown name: the close ones first, then what exists."""
    shown = repr(name)
    text = f"unknown {kind} {shown if len(shown) <= 60 else shown[:59] + '…'}"
    close = close_matches(name, known)
    if close:
        text += f"; did you mean {' or '.join(repr(c) for c in close)}?"
    if known:
        shown = ", ".join(list(known)[:30]) + (", …" if len(known) > 30 else "")
        text += f" Known: {shown}." if close else f"; known: {shown}."
    else:
        text += f"; there is no {kind} at all here."
    return text


def apart(*values: float, digits: int = 1, form: str = "f") -> list[str]:
    """Numbers as text, with as many digits as it takes to tell those that differ from each other.

    "160.0 is outside; allowed: -160.0 to 160.0" explains nothing: 160.04 does.

    Args:
        values: A value and its limits, say.
        digits: At least so many behind the point (``form`` "f") or in all ("g").
        form: As of ``format``.
    """
    texts: list[str] = []
    for count in range(digits, 18):
        texts = [f"{value:.{count}{form}}" for value in values]
        if len(set(texts)) >= len(set(values)):
            break
    return texts


class RobotIkError(Exception):
    """Root of all errors of this package.

    Attributes:
        hint: What to try next, one or two lines; empty when the message says it all.
    """

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint

    def __str__(self) -> str:
        text = super().__str__()
        return f"{text}\n{self.hint}" if self.hint else text
