"""A pytest plugin: tests in real time are repeated if the machine halted during them.

A serial line, a heartbeat and a servo's watchdog have deadlines of milliseconds. On a machine that
halts for longer they fail, and so does their test. During a test with the fixture ``real_time`` a
thread measures the delay of its wake-ups. A test that fails after a halt is tried again. A test
that fails without a halt has failed.
"""

from __future__ import annotations

import threading
import time

import pytest
from _pytest.runner import runtestprotocol

HALT = 0.02
"""s. The shortest deadline of these tests is 34 ms, for the fast read of six servos."""

TRIES = 6


@pytest.fixture(scope="session")
def real_time() -> None:
    """Mark a test of real time. Fixtures with servos behind a serial line use it."""


class Halts:
    """Measures the longest time for which this process should have run and did not, s."""

    PERIOD = 0.005

    def __init__(self) -> None:
        self.longest = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="halts", daemon=True)

    def _look(self) -> None:
        while not self._over.is_set():
            begin = time.monotonic()
            time.sleep(self.PERIOD)
            self.longest = max(self.longest, time.monotonic() - begin - self.PERIOD)

    def __enter__(self) -> Halts:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test as pytest does, with several tries."""
    if "real_time" not in getattr(item, "fixturenames", ()):
        return None
    hook = item.ihook
    hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for left in reversed(range(TRIES)):
        with Halts() as halts:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if left == 0 or halts.longest < HALT or not any(report.failed for report in reports):
            break
        item.warn(
            pytest.PytestWarning(f"tried again: the machine halted for {halts.longest:.3f} s")
        )
    for report in reports:
        hook.pytest_runtest_logreport(report=report)
    hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
