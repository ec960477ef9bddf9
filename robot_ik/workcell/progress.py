"""Progress of long work, as callers of the library receive it."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the phase ("looking", "moving") and the share of the phase that is done."""


def share_of(progress: Progress, phase: str, done: int, parts: int) -> Callable[[float], None]:
    """Return a progress function for one of several equal parts of a phase.

    Args:
        progress: Progress of the whole work.
        phase: The phase.
        done: Number of parts before this one.
        parts: Number of parts.
    """
    return lambda share: progress(phase, (done + share) / parts)
