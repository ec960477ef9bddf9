"""``problem_text``: the text of an exception for the page, in one line."""

from __future__ import annotations


def problem_text(error: Exception) -> str:
    """Return the first line of an error's message, or the name of its type without a message."""
    lines = str(error).splitlines()
    return lines[0] if lines else type(error).__name__
