"""The closed-form profile of a virtual servo against a numeric integration, and its laws."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.hardware.virtual.profiles import brake, move


def _integrate(
    x: float, v: float, goal: float, top: float, a: float, samples: list[float], dt: float
) -> list[float]:
    """Braking-distance control in small steps: speed up while there is room to stop."""
    found = []
    t = 0.0
    for sample in samples:
        while t < sample:
            wanted = math.copysign(min(top, math.sqrt(2 * a * abs(goal - x))), goal - x)
            change = max(-a * dt, min(a * dt, wanted - v))
            x += (v + 0.5 * change) * dt
            v += change
            t += dt
        found.append(x)
    return found


@settings(max_examples=40, deadline=None)
@given(
    distance=st.floats(-3000, 3000),
    v=st.floats(-2000, 2000),
    top=st.floats(100, 2000),
    a=st.floats(500, 20_000),
)
def test_closed_form_is_the_integrated_motion(
    distance: float, v: float, top: float, a: float
) -> None:
    motion = move(0.0, 500.0, v, 500.0 + distance, top, a)
    samples = [motion.end * k / 7 for k in range(1, 8)]
    dt = max(motion.end / 8000, 1e-5)
    found = _integrate(500.0, v, 500.0 + distance, top, a, samples, dt)
    allowed = 1e-6 + 4 * dt * max(top, abs(v)) + 4 * a * dt**2
    for t, x in zip(samples, found, strict=True):
        assert motion.at(t)[0] == pytest.approx(x, abs=allowed)


@settings(deadline=None)
@given(
    goal=st.floats(-1e6, 1e6),
    v=st.floats(-5000, 5000),
    top=st.floats(1, 6000),
    a=st.floats(100, 2e5),
)
def test_motion_laws(goal: float, v: float, top: float, a: float) -> None:
    motion = move(3.0, -70.0, v, goal, top, a)
    assert motion.at(3.0) == (-70.0, pytest.approx(v, abs=1e-6))
    assert motion.at(motion.end) == motion.at(motion.end + 100.0) == (goal, 0.0)
    scale = 1e-9 * (abs(goal) + 1e3) + 1e-6
    times = [3.0 + (motion.end - 3.0) * k / 400 for k in range(401)]
    dt = (motion.end - 3.0) / 400
    previous = motion.at(3.0)
    for t in times[1:]:
        x, speed = motion.at(t)
        assert abs(speed) <= max(top, abs(v)) * (1 + 1e-9) + 1e-6
        assert abs(speed - previous[1]) <= a * dt * (1 + 1e-6) + 1e-6
        # The position has no jump: it changes by what the speeds at both ends allow.
        reach = (max(abs(speed), abs(previous[1])) + a * dt) * dt
        assert abs(x - previous[0]) <= reach + scale
        previous = x, speed


@given(st.floats(-5000, 5000), st.floats(100, 2e5))
def test_brake_stops_within_the_braking_distance(v: float, a: float) -> None:
    motion = brake(1.0, 10.0, v, a)
    x, speed = motion.at(motion.end)
    assert speed == 0.0
    assert x == pytest.approx(10.0 + v * abs(v) / (2 * a))
