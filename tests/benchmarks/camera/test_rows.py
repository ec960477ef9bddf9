"""The benchmark of the camera: its rows, its figures, and that they can fail."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any

import pytest

from benchmarks.camera import accuracy
from benchmarks.camera.drawing_errors import PINHOLE, projection_errors
from benchmarks.camera.rows import ROWS, Effort
from benchmarks.quantity import Quantity


def figures(of: object, **effort: object) -> dict[str, Quantity]:
    return {quantity.quantity: quantity for quantity in of(Effort(quick=True, **effort))}  # type: ignore[operator]


def test_rows_have_unique_names_and_existing_functions() -> None:
    assert len({row.name for row in ROWS}) == len(ROWS)
    for row in ROWS:
        module, _, name = row.function.partition(":")
        assert callable(getattr(importlib.import_module(module), name)), row.name


@pytest.mark.parametrize(
    ("value", "bounds", "passed", "wanted"),
    [
        (1.0, {"most": 1.0}, True, "≤ 1 mm"),
        (1.1, {"most": 1.0}, False, "≤ 1 mm"),
        (1.1, {"least": 1.0}, True, "≥ 1 mm"),
        (0.9, {"least": 1.0}, False, "≥ 1 mm"),
        (0.9, {"least": 1.0, "most": 2.0}, False, "1 … 2 mm"),
        (2.0, {"least": 1.0, "most": 2.0}, True, "1 … 2 mm"),
        (1.0, {}, None, ""),
        (float("nan"), {"most": 1.0}, False, "≤ 1 mm"),
        (float("nan"), {"most": 1.0, "missing": "no camera"}, None, "≤ 1 mm"),
    ],
)
def test_a_quantity_passes_within_its_limits(
    value: float, bounds: dict[str, Any], passed: bool | None, wanted: str
) -> None:
    quantity = Quantity("x", value, "mm", **bounds)
    assert quantity.passed is passed and quantity.wanted_text == wanted


def test_clutter_gives_no_detection_and_a_detector_of_everything_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert all(quantity.value == 0 for quantity in figures(accuracy.clutter).values())
    (view,) = accuracy.standard_set(0.3, 1, seed=2, marker_id=7, dictionary="DICT_5X5_50")
    real = accuracy.find_corners

    def find_everything(_frame: object, *rest: Any) -> object:
        return real(accuracy.frame_of(view.image), *rest)

    monkeypatch.setattr(accuracy, "find_corners", find_everything)
    found = list(figures(accuracy.clutter).values())
    assert [quantity.passed for quantity in found] == [False]


def test_half_hidden_boards_are_measured_within_the_limits() -> None:
    found = figures(accuracy.occlusion)
    assert len(found) == 4 and all(
        quantity.passed in (True, None) for quantity in found.values()
    ), found


def test_drawings_are_where_opencv_projects_them_and_a_shift_would_be_seen() -> None:
    found = figures(accuracy.projection)
    assert len(found) == 4 and all(quantity.passed for quantity in found.values()), found
    # A painter with an error of half a pixel.
    shifted = replace(PINHOLE, cx=PINHOLE.cx + 0.5)
    assert projection_errors(PINHOLE, drawn_through=shifted).rms > 0.4


def test_handeye_is_within_its_limits() -> None:
    found = figures(accuracy.handeye)
    assert all(quantity.passed for quantity in found.values()), found
