"""A camera that is given where it stands and what it looks at."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from robot_ik.camera.synthetic.camera import look_at
from robot_ik.errors import CameraError


@given(st.tuples(*[st.floats(-2, 2)] * 3), st.tuples(*[st.floats(-2, 2)] * 3))
def test_look_at_puts_the_target_in_the_middle_and_up_upwards(
    eye: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    away = np.array(target) - eye
    assume(np.linalg.norm(away) > 0.05 and np.linalg.norm(away[:2]) > 0.02)
    inverse = look_at(eye, target).inverse()
    assert inverse.apply(target) == pytest.approx([0, 0, np.linalg.norm(away)], abs=1e-9)
    raised = inverse.apply(np.array(target) + np.array([0, 0, 0.01]))
    assert raised[1] < 0 and raised[0] == pytest.approx(0, abs=1e-9), "image y points down"


@pytest.mark.parametrize("target", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_look_at_refuses_views_without_an_up(target: tuple[float, float, float]) -> None:
    with pytest.raises(CameraError, match="cannot look"):
        look_at((0, 0, 1), target)
