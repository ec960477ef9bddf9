"""How long to wait for a reply and when to watch for it, learned from the replies before."""

from __future__ import annotations

import os
import pty
import threading
import time
import tty

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.hardware.bus import Counters
from robot_ik.hardware.serial_port import (
    MAX_JITTER,
    MIN_TIMEOUT,
    TIMEOUT_FACTOR,
    RoundTripEstimator,
    SleepingPortHandler,
)

AT_MOST = 0.034


def learned(times):
    known = RoundTripEstimator()
    for took in times:
        known.add(took)
    return known


@given(st.lists(st.floats(0.0, 0.1), min_size=1, max_size=100))
def test_a_late_reply_extends_the_time_for_the_next_ones(times):
    timeout = learned(times).timeout(AT_MOST)
    assert min(MIN_TIMEOUT, AT_MOST) <= timeout <= AT_MOST
    assert timeout >= min(TIMEOUT_FACTOR * times[-1], AT_MOST)


def test_a_new_line_gets_all_the_time_and_is_not_watched():
    assert RoundTripEstimator().timeout(AT_MOST) == AT_MOST
    assert RoundTripEstimator().expected is None


@given(
    st.floats(0.0, 0.02),
    st.lists(st.floats(-MAX_JITTER / 4, MAX_JITTER / 4), min_size=60, max_size=80),
)
def test_steady_answers_are_expected_where_they_come(usual, jitter):
    expected = learned([usual + late for late in jitter]).expected
    assert expected == pytest.approx(usual, abs=MAX_JITTER / 2)


@given(st.floats(0.0, 0.02), st.lists(st.sampled_from([0.0, 1e-3]), min_size=60, max_size=80))
def test_answers_that_come_by_the_millisecond_are_not_watched_for(usual, jitter):
    times = [usual + late for late in [*jitter, 0.0, 1e-3, 0.0, 1e-3]]  # as behind a USB adapter
    assert learned(times).expected is None


@pytest.mark.parametrize("expected", [None, -0.01, 0.0, 0.005, 0.02, 10.0])
@pytest.mark.parametrize("answer", [b"", b"answer"])
def test_watching_changes_nothing_but_the_moment(answer, expected):
    """Bytes come whether they are expected earlier or later; without any the deadline holds."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = SleepingPortHandler(os.ttyname(slave), 1_000_000, Counters())
    port.openPort()
    writer = threading.Timer(0.01, os.write, (master, answer)) if answer else None
    begin = time.monotonic()
    if writer:
        writer.start()
    deadline = begin + (30.0 if answer else 0.02)
    used = time.process_time()
    assert port.receive(deadline, None if expected is None else begin + expected) == answer
    assert time.process_time() - used < 0.5  # never watched until the deadline
    assert answer or time.monotonic() >= deadline
    if writer:
        writer.join()
    port.closePort()
    os.close(master)
    os.close(slave)
