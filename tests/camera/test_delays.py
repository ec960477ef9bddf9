"""Delays in figures."""

from __future__ import annotations

import math

import pytest

from robot_ik.camera.delays import DelayMeter


def test_delays_come_as_median_and_percentile() -> None:
    meter = DelayMeter()
    assert meter.summary().count == 0 and str(meter.summary()) == "not measured"
    for k in range(101):
        assert meter.add(5.0, 5.0 + 1e-3 * k) == pytest.approx(1e-3 * k)
    found = meter.summary()
    assert found.count == 101
    assert found.p50 == pytest.approx(0.050) and found.p95 == pytest.approx(0.095)
    assert str(found) == "p50 50.0 ms, p95 95.0 ms"


@pytest.mark.parametrize("grabbed", [5.1, -100.0, math.nan])
def test_stamps_of_another_clock_are_left_out(grabbed: float) -> None:
    meter = DelayMeter()
    assert math.isnan(meter.add(grabbed, 5.0))
    assert meter.summary().count == 0


def test_old_delays_are_forgotten() -> None:
    meter = DelayMeter()
    for k in range(5000):
        meter.add(0.0, 1.0 if k < 3000 else 0.01)
    assert meter.summary().count == 5000 and meter.summary().p95 == 0.01
