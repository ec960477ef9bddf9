"""Shadows on a part of a print: the factor of the light, and corners that it does not bias."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_ik.camera import corners
from robot_ik.camera.corners import refine_markers
from robot_ik.camera.shade import shade_factors
from robot_ik.camera.synthetic.pictures import (
    STANDARD_CAMERA,
    marker_light,
    photograph,
    render_markers,
)
from robot_ik.camera.synthetic.sensor import WEBCAM
from robot_ik.camera.targets import marker_points
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array, Image

CELLS = 6
SIZE = 0.05
POSE = Pose((0.01, -0.02, 0.45), (0.0, 1.0, 0.0, 0.0)).compose(
    Pose(wxyz=rotation_exp([0.4, 0.2, 0.3]))
)
TRUE_CORNERS = STANDARD_CAMERA.project(POSE.apply(marker_points(SIZE)))


def shaded(image: Image, position: float, strength: float, softness: float) -> Image:
    """Return a picture with a shadow to the right of a vertical border.

    Args:
        image: (h, w) grey levels of a linear camera.
        position: Position of the border relative to the centre of the marker, in marker widths.
        strength: Part of the light that the shadow takes.
        softness: Width of the border, px.
    """
    left = TRUE_CORNERS[:, 0].min()
    width = np.ptp(TRUE_CORNERS[:, 0])
    column = left + (0.5 + position) * width
    depth = 0.5 + 0.5 * np.tanh((np.arange(image.shape[1]) - column) / softness)
    return np.rint(image * (1.0 - strength * depth)).astype(np.uint8)


def corner_errors(image: Image) -> Array:
    """Return the errors (4, 2) of the refined corners, px."""
    (corners,) = refine_markers(image, [TRUE_CORNERS + 0.4], [7], "DICT_4X4_50", STANDARD_CAMERA)
    assert corners.refined
    return corners.pixels - TRUE_CORNERS


@pytest.mark.parametrize("softness", [2.0, 6.0])
@pytest.mark.parametrize("position", [-0.45, 0.0, 0.45])
def test_a_shadow_on_a_part_of_a_marker_does_not_bias_its_corners(
    position: float, softness: float
) -> None:
    errors = []
    for seed in range(4):
        image = render_markers(STANDARD_CAMERA, {7: (SIZE, POSE)}, np.random.default_rng(seed))
        errors.append(corner_errors(shaded(image, position, 0.42, softness)))
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05


def test_an_overexposed_print_is_not_treated_as_shaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_arguments: object) -> Array:
        raise AssertionError("a shadow was estimated")

    monkeypatch.setattr(corners, "shade_factors", refuse)
    sensor = replace(WEBCAM, exposure=1.5)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        canvas, center = marker_light(STANDARD_CAMERA, {7: (SIZE, POSE)}, rng)
        image = photograph(canvas, center, rng, sensor)
        refine_markers(image, [TRUE_CORNERS + 0.4], [7], "DICT_4X4_50", STANDARD_CAMERA)


def test_the_factor_of_a_known_shadow_is_found() -> None:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-0.56, 0.56, (2, 3000))
    true = 1.0 - 0.4 / (1.0 + np.exp(-12.0 * (u - 0.3 * v - 0.1)))
    model = np.where(rng.random(3000) < 0.5, 200.0, 30.0)
    grey = true * model + rng.normal(0.0, 2.0, 3000)
    factors = shade_factors(u, v, grey, model, np.full(3000, 0.25), CELLS)
    assert np.sqrt(np.mean((factors - true) ** 2)) < 0.01


def test_pixels_without_weight_do_not_change_the_factor() -> None:
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-0.5, 0.5, (2, 500))
    model = np.full(500, 100.0)
    weights = np.where(np.arange(500) % 2, 1.0, 0.0)
    grey = np.where(weights > 0.0, 80.0, 255.0)
    assert shade_factors(u, v, grey, model, weights, CELLS) == pytest.approx(0.8, abs=1e-3)


def test_without_pixels_the_factor_is_one() -> None:
    nothing = np.zeros(10)
    factors = shade_factors(nothing, nothing, nothing, nothing, nothing, CELLS)
    assert factors == pytest.approx(1.0)
