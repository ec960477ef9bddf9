"""The compiled model of a pixel agrees with exact integrals and with differences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_ik.camera.corners import marker_black
from robot_ik.camera.print_model import (
    CONTRAST,
    DARK,
    ELONGATION,
    HALO,
    LOG_BLUR,
    PIXEL,
    SHIFT,
    UNKNOWNS,
    linearise,
)
from tests.camera.print_oracle import pixel_value

BLACK = marker_black("DICT_4X4_50", 7)
# A marker of about 60 px, seen at an angle.
HOMOGRAPHY = np.array([[9.0, 2.0, 0.05], [-1.5, 14.0, -0.1], [0.3, 0.4, 1.0]])


def some_pixels(count: int, seed: int) -> np.ndarray:
    """Pixels at random places of the print, one pixel being 1/800 in undistorted coordinates."""
    rng = np.random.default_rng(seed)
    pixels = np.zeros(count, dtype=PIXEL)
    to_normalized = np.linalg.inv(HOMOGRAPHY)
    points = (
        np.column_stack([rng.uniform(-0.55, 0.55, (count, 2)), np.ones(count)]) @ to_normalized.T
    )
    pixels["x"] = points[:, 0] / points[:, 2]
    pixels["y"] = points[:, 1] / points[:, 2]
    pixels["x_by_px"] = 1.0 / 800.0
    pixels["y_by_py"] = 1.0 / 800.0
    pixels["weight"] = 1.0
    return pixels


def unknowns(
    blur: float = 0.9,
    shift: float = 0.4,
    elongation: tuple[float, float] = (0.0, 0.0),
    halo: float = 0.0,
) -> np.ndarray:
    x = np.zeros(UNKNOWNS)
    x[LOG_BLUR] = math.log(blur)
    x[SHIFT] = shift
    x[DARK] = 30.0
    x[CONTRAST] = 170.0
    x[ELONGATION:HALO] = elongation
    x[HALO] = halo
    return x


def values(
    pixels: np.ndarray, homography: np.ndarray, x: np.ndarray, halo_blur: float
) -> np.ndarray:
    """Grey values of the model: the negative residuals of black pixels."""
    linearise(pixels, BLACK, homography, x, math.inf, halo_blur)
    return -pixels["residual"].copy()


def view(pixel: np.void, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point of the print at a pixel, and its derivative by pixels."""

    def at(dx: float, dy: float) -> np.ndarray:
        w = homography @ [pixel["x"] + dx / 800.0, pixel["y"] + dy / 800.0, 1.0]
        return np.asarray(w[:2] / w[2])

    h = 1e-4
    slopes = [(at(h, 0) - at(-h, 0)) / (2 * h), (at(0, h) - at(0, -h)) / (2 * h)]
    return at(0.0, 0.0), np.column_stack(slopes)


@pytest.mark.parametrize(
    ("blur", "shift", "elongation"),
    [
        (0.5, 0.0, (0.0, 0.0)),
        (0.9, 0.4, (0.0, 0.0)),
        (1.6, -0.3, (0.0, 0.0)),
        (0.9, 0.4, (0.25, 0.0)),
        (1.2, 0.2, (-0.1, 0.2)),
    ],
)
def test_values_agree_with_exact_integrals(
    blur: float, shift: float, elongation: tuple[float, float]
) -> None:
    pixels = some_pixels(40, seed=1)
    model = values(pixels, HOMOGRAPHY, unknowns(blur, shift, elongation), 1.2)
    along_rows, along_diagonal = elongation
    covariance = blur**2 * np.array(
        [[1.0 + along_rows, along_diagonal], [along_diagonal, 1.0 - along_rows]]
    )
    for pixel, value in zip(pixels, model, strict=True):
        (u, v), per_pixel = view(pixel, HOMOGRAPHY)
        # 0.15 % of the contrast: an edge has no effect beyond 3.2 standard deviations of the blur.
        expected = pixel_value(
            u, v, per_pixel, covariance, shift, dark=30.0, contrast=170.0, black=BLACK
        )
        assert value == pytest.approx(expected, abs=0.25)


@pytest.mark.parametrize("halo", [-0.2, 0.0, 0.8])
def test_the_gram_matrix_is_that_of_differences(halo: float) -> None:
    """J^T J of the compiled Jacobian against central differences of the compiled values."""
    pixels = some_pixels(300, seed=2)
    x = unknowns(elongation=(0.1, -0.05), halo=halo)
    gram = linearise(pixels, BLACK, HOMOGRAPHY, x, math.inf, 1.2)[:UNKNOWNS, :UNKNOWNS]
    jacobian = np.empty((len(pixels), UNKNOWNS))
    # So small that no edge comes within 3.2 standard deviations, where the model has a step.
    h = 1e-6
    for k in range(UNKNOWNS):
        both = []
        for sign in (h, -h):
            e = np.zeros(UNKNOWNS)
            e[k] = sign
            motion = np.array([[1 + e[1], e[2], e[0]], [e[4], 1 + e[5], e[3]], [-e[6], -e[7], 1.0]])
            moved = np.where(np.arange(UNKNOWNS) < LOG_BLUR, x, x + e)
            both.append(values(pixels, motion @ HOMOGRAPHY, moved, 1.2))
        jacobian[:, k] = (both[0] - both[1]) / (2.0 * h)
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-12))
    difference = (gram - jacobian.T @ jacobian) / np.outer(scale, scale)
    # The Jacobian leaves out that the blur in u and v changes with the homography: 4 %.
    assert np.abs(difference).max() < 0.05
