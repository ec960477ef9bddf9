"""How much memory this process holds, in a way that does not change by itself."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import time


def resident_memory(settle: float = 3.0) -> float:
    """The memory of this process that is resident (MB), the lowest within ``settle`` s.

    Before each reading, dead objects are collected and glibc returns its free memory.
    Connections and threads that are ending still hold their buffers for a moment: hence the lowest.
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
