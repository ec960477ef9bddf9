"""Clocks of a run, and the interval between switches of threads."""

from __future__ import annotations

import contextlib
import sys

import pytest

from robot_ik.ports import short_switch_interval


@pytest.mark.parametrize("first_leaves_first", [True, False])
def test_the_last_loop_restores_the_switch_interval(first_leaves_first: bool) -> None:
    kept = sys.getswitchinterval()
    sys.setswitchinterval(0.004)
    try:
        first = contextlib.ExitStack()
        second = contextlib.ExitStack()
        for loop in (first, second):
            loop.enter_context(short_switch_interval())
            assert sys.getswitchinterval() == pytest.approx(0.0005)
        earlier, later = (first, second) if first_leaves_first else (second, first)
        earlier.close()
        assert sys.getswitchinterval() == pytest.approx(0.0005)
        later.close()
        assert sys.getswitchinterval() == pytest.approx(0.004)
    finally:
        sys.setswitchinterval(kept)


def test_a_shorter_switch_interval_is_not_changed() -> None:
    kept = sys.getswitchinterval()
    sys.setswitchinterval(0.0001)
    try:
        with short_switch_interval(), contextlib.suppress(KeyError):
            assert sys.getswitchinterval() == pytest.approx(0.0001, abs=2e-6)
            raise KeyError
        assert sys.getswitchinterval() == pytest.approx(0.0001, abs=2e-6)
    finally:
        sys.setswitchinterval(kept)
