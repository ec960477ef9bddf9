"""A copy of A00's update loses the goals as in the thesis. With equal axes it does not."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


@pytest.fixture(scope="module", autouse=True)
def import_copy() -> Any:
    """Make the copy, which is beside this file, importable."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parent)
        yield


@pytest.fixture(scope="module")
def update() -> Any:
    return importlib.import_module("aho_update")


@pytest.fixture(scope="module")
def courses() -> Any:
    return importlib.import_module("aho_courses")


@pytest.mark.parametrize("number", range(1, 6))
def test_goals_in_a_plane_do_not_show_the_error(number: int, update: Any, courses: Any) -> None:
    course = courses.course(number)
    assert course.lost_at(update.MIXED) is None
    assert course.lost_at(update.ALIKE) is None


def test_test_6_is_lost_near_20_degrees_because_of_the_axes(update: Any, courses: Any) -> None:
    six = courses.course(6)
    lost = six.lost_at(update.MIXED)
    assert 18.0 < lost < 25.0
    assert six.lost_at(update.ALIKE) is None
    # The other possible causes do not change the result.
    for other in ({"exact": True}, {"svd": True}):
        assert six.lost_at(update.Update("world", "body", **other)) == pytest.approx(lost, abs=2.0)
    assert six.lost_at(update.Update("world", "body", iterations=1000)) is not None
    for columns, applied in (
        ("body", "world"),
        ("world", "parent"),
        ("parent", "world"),
        ("world", "angles"),
    ):
        assert 10.0 < six.lost_at(update.Update(columns, applied)) < 25.0, (columns, applied)


@pytest.mark.parametrize("number", [7, 8, 9, 10, 11, 12])
def test_the_other_losses_have_the_same_cause(number: int, update: Any, courses: Any) -> None:
    course = courses.course(number)
    lost = course.lost_at(update.MIXED)
    assert lost is not None
    if number == 7:
        assert lost < courses.course(6).lost_at(update.MIXED)  # "sooner"
    for columns in ("world",) if number == 7 else ("world", "parent", "body"):
        assert course.lost_at(update.Update(columns, columns)) is None, columns


def test_test_13_needs_a_pseudoinverse(update: Any, courses: Any) -> None:
    square = courses.course(13)
    assert square.lost_at(update.ALIKE) is not None
    assert square.lost_at(update.Update("world", "body", svd=True)) is not None
    assert square.lost_at(update.Update("world", "world", svd=True)) is None


@pytest.mark.parametrize("axes", ["world", "parent", "body", "euler"])
def test_the_copy_is_correct_for_equal_axes(axes: str, update: Any, courses: Any) -> None:
    """J equals finite differences of the copy's motion, so only the mixture of axes is wrong."""
    rng = np.random.default_rng(5)
    rotations = [Rotation.random(rng=rng).as_matrix() for _ in range(3)]
    chain = update.Chain(update.Z, rotations)
    same = update.Update(axes, "angles" if axes == "euler" else axes)
    jacobian = chain.jacobian(axes, True)
    h = 1e-6
    still = (np.zeros(3), np.eye(3))
    for k in range(9):
        step = np.zeros(9)
        step[k] = h
        forward = chain.moved(same, step)
        backward = chain.moved(same, -step)
        linear = (backward.off(still, False) - forward.off(still, False)) / (2.0 * h)
        np.testing.assert_allclose(jacobian[:3, k], linear, atol=1e-8)
        rotated = forward.frames()[0][-1] @ backward.frames()[0][-1].T
        np.testing.assert_allclose(
            jacobian[3:, k], Rotation.from_matrix(rotated).as_rotvec() / (2.0 * h), atol=1e-6
        )


def test_the_place_of_the_loss_depends_on_the_start(update: Any, courses: Any) -> None:
    """The place of the loss depends on the start. With equal axes the goal is never lost."""
    starts = [courses.start_of_six(name, step=1.0) for name in courses.STARTS]
    lost = [start.lost_at(update.MIXED) for start in starts]
    assert all(at is not None for at in lost) and min(lost) < 15.0 and max(lost) > 100.0
    assert all(start.lost_at(update.ALIKE) is None for start in starts)
