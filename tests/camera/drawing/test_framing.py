"""A fitted camera shows all points, centred and as large as possible."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    st.tuples(st.floats(-180, 180), st.floats(-60, 80)),
    st.integers(0, 2**32 - 1),
    st.floats(0.05, 5.0),
)
def test_a_fitted_camera_shows_all_points_centred_and_as_large_as_possible(
    view: tuple[float, float], seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * size * rng.uniform(0.2, 1.0, 3) + rng.normal(size=3) * 3
    optics = portrait_lens(320, 200)
    camera = fitted_camera(points, view, optics)
    pixels = optics.project(camera.inverse().apply(points))
    low = pixels.min(axis=0)
    high = pixels.max(axis=0)
    assert (low > 0).all()
    assert (high < np.array(optics.size) - 1).all()
    assert ((high - low) / np.array(optics.size)).max() > 0.8
    assert np.abs((low + high) / 2 - np.array([optics.cx, optics.cy])).max() < 4
