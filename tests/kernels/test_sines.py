"""Sine and cosine against Python's."""

import math

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from robot_ik.kernels.jit import kernel
from robot_ik.kernels.kinematics import sine_cosine


@kernel
def sine_and_cosine(angle):
    return sine_cosine(angle)


@given(angle=st.floats(-1e7, 1e7))
@example(angle=0.0)
@example(angle=1e-300)
@example(angle=math.pi)
@example(angle=-1.5 * math.pi)
@example(angle=np.nextafter(math.pi / 4, 1.0))
@example(angle=1e6)
@example(angle=1e300)
def test_equal_to_the_library_to_rounding(angle):
    sine, cosine = sine_and_cosine(angle)
    assert abs(sine - math.sin(angle)) <= 2.3e-16
    assert abs(cosine - math.cos(angle)) <= 2.3e-16


def test_numbers_that_are_not_finite_give_nan():
    for angle in (math.inf, -math.inf, math.nan):
        assert all(math.isnan(x) for x in sine_and_cosine(angle))


def test_small_angles_keep_their_digits():
    for angle in np.geomspace(1e-300, 1e-3, 50):
        sine, _ = sine_and_cosine(angle)
        assert abs(sine - math.sin(angle)) <= 2.3e-16 * angle
