"""Laws of the profiles, checked by sampling them finely."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.motion.timing import PROFILES, fastest_timing

positive = st.floats(0.01, 100.0)


@given(name=st.sampled_from(sorted(PROFILES)), velocity=positive, acceleration=positive)
@settings(deadline=None, max_examples=40)
def test_profiles_rest_at_both_ends_and_keep_their_bounds(name, velocity, acceleration):
    profile = PROFILES[name](velocity, acceleration)
    phase = np.linspace(0.0, 1.0, 2001)
    s = profile.progress(phase)
    step = profile.duration / 2000.0
    assert s[0] == 0.0 and s[-1] == pytest.approx(1.0, abs=1e-15)
    assert (np.diff(s) >= -1e-15).all()
    assert np.diff(s).max() / step <= velocity * (1.0 + 1e-9)
    assert np.abs(np.diff(s, 2)).max() / step**2 <= acceleration * (1.0 + 1e-6)
    np.testing.assert_allclose(s, 1.0 - s[::-1], atol=1e-12)


def test_an_infinite_bound_has_no_effect():
    assert PROFILES["trapezoid"](np.inf, 4.0).duration == pytest.approx(1.0)
    assert PROFILES["quintic"](np.inf, 4.0).duration > 1.0


@given(velocity=st.floats(0.1, 10.0), acceleration=st.floats(0.1, 10.0))
@settings(deadline=None, max_examples=30)
def test_a_straight_path_takes_the_time_of_the_trapezoid(velocity, acceleration):
    """Two ways to the same optimum: closed form, and the forward and backward pass."""
    s = np.linspace(0.0, 1.0, 400)
    timing = fastest_timing(s, s[:, None], np.array([velocity]), np.array([acceleration]), np.inf)
    ideal = PROFILES["trapezoid"](velocity, acceleration)
    assert timing.duration == pytest.approx(ideal.duration, rel=0.01)
    phase = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(
        timing.progress(phase * timing.duration), ideal.progress(phase), atol=0.01
    )


@given(seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_a_curved_path_keeps_joint_bounds_and_reaches_them(seed):
    """Random smooth curves of four joints; the bounds hold to the density of the knots."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0.0, 1.0, 600)
    q = sum(
        rng.normal(size=4) * np.sin((k + 1) * s[:, None] * 2.0 + rng.uniform(0, 6, 4))
        for k in range(3)
    )
    velocity = rng.uniform(0.2, 2.0, 4)
    acceleration = rng.uniform(0.5, 5.0, 4)
    timing = fastest_timing(s, np.asarray(q), velocity, acceleration, np.inf)
    times = np.linspace(0.0, timing.duration, 1500)
    step = times[1]
    at = timing.progress(times)
    sampled = np.column_stack([np.interp(at, s, q[:, j]) for j in range(4)])
    smooth = sampled[::10]
    assert (np.abs(np.diff(smooth, axis=0)).max(axis=0) / (10 * step) <= velocity * 1.03).all()
    share_v = np.abs(np.diff(smooth, axis=0)) / (10 * step) / velocity
    share_a = np.abs(np.diff(smooth, 2, axis=0)) / (10 * step) ** 2 / acceleration
    assert share_a.max() <= 1.15
    # Time-optimal: at nearly every moment one joint is at one of its bounds.
    used = np.maximum(share_v[:-1], share_a).max(axis=1)
    assert np.median(used) > 0.9


def test_speed_bound_holds_along_a_still_path():
    """No joint limit has an effect, and the bound of ds/dt is kept."""
    s = np.linspace(0.0, 1.0, 50)
    timing = fastest_timing(s, 1e-6 * s[:, None], np.array([1.0]), np.array([1.0]), 0.5)
    assert timing.speed.max() == pytest.approx(0.5)
    assert timing.duration == pytest.approx(2.0, rel=0.05)
