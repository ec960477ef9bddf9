"""Waiting for what a thread, a process or a browser does: for the condition, never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

LONG = 300.0
"""s. Even a slow and busy machine that must compile kernels is faster, so something hangs."""

T = TypeVar("T")


def wait_for(holds: Callable[[], T], what: str | Callable[[], str] = "waited in vain") -> T:
    """Return ``holds()`` as soon as it is true; fail with ``what`` after ``LONG`` s."""
    end = time.monotonic() + LONG
    while not (found := holds()):
        assert time.monotonic() < end, what if isinstance(what, str) else what()
        time.sleep(0.005)
    return found
