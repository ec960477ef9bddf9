"""Waiting for a condition of a thread, a process or a browser, and never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

LONG = 300.0
"""s. A busy machine that compiles kernels is faster, so a longer wait means a hang."""

T = TypeVar("T")


def wait_for(
    holds: Callable[[], T], what: str | Callable[[], str] = "the condition did not become true"
) -> T:
    """Return ``holds()`` as soon as it is true; fail with ``what`` after ``LONG`` s."""
    end = time.monotonic() + LONG
    while not (found := holds()):
        assert time.monotonic() < end, what if isinstance(what, str) else what()
        time.sleep(0.005)
    return found
