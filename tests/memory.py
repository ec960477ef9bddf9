"""Resident memory of this process, measured reproducibly."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import time


def resident_memory(settle: float = 3.0) -> float:
    """Return the resident memory of this process, MB: the smallest value within ``settle`` s.

    Before each reading, dead objects are collected and glibc returns its free memory.
    Connections and threads that are ending keep their buffers for a moment, so the smallest value
    is returned.
    """
    lowest = float("inf")
    end = time.monotonic() + settle
    while time.monotonic() < end:
        gc.collect()
        with contextlib.suppress(AttributeError):  # a libc other than glibc
            ctypes.CDLL(None).malloc_trim(0)
        with open("/proc/self/statm") as file:
            lowest = min(lowest, int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
        time.sleep(0.2)
    return lowest
