"""What a camera does to edges: measured between saddles, kept in its file; and saddles that do not mind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.boards.tone import Tone, measure_tone
from robot_ik.camera.corner_refinement import expected_shift
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, pattern_pose, render_pattern
from robot_ik.camera.synthetic.sensor import LINEAR, TONES, WEBCAM, SensorModel
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Image

CHESSBOARD, CHARUCO = ChessboardPattern(9, 6, 0.025), CharucoPattern(7, 5, 0.03, 0.022)
QUIET = replace(LINEAR, noise=1.0)


def seen(pattern: Pattern, sensor: SensorModel, seed: int = 3) -> tuple[Image, Pose]:
    rng = np.random.default_rng(seed)
    pose = pattern_pose(pattern, STANDARD_CAMERA, rng, fill=(0.8, 0.9))
    return render_pattern(pattern, STANDARD_CAMERA, pose, rng, sensor), pose


def tone_of(pattern: Pattern, sensor: SensorModel) -> Tone:
    image, _ = seen(pattern, sensor)
    found = pattern.find(image)
    assert found is not None
    tone = measure_tone(image, found.pixels, found.ids, pattern.corners[0], pattern.plain)
    assert tone is not None
    return tone


@pytest.mark.parametrize("pattern", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize("name", ["linear", "gamma 2.2", "srgb", "s-curve"])
def test_saddles_are_where_they_are_under_every_tone_curve(pattern: Pattern, name: str) -> None:
    image, pose = seen(pattern, replace(WEBCAM, tone=name))
    found = pattern.find(image)
    assert found is not None
    off = found.pixels - STANDARD_CAMERA.project(pose.apply(found.points_board))
    assert np.sqrt(np.mean(off**2)) < 0.05
    assert np.abs(off.mean(axis=0)).max() < 0.02


def test_the_shift_of_edges_is_measured_between_saddles() -> None:
    linear, toned = tone_of(CHESSBOARD, QUIET), tone_of(CHESSBOARD, replace(QUIET, tone="srgb"))
    assert abs(linear.pixels) < 0.03 and abs(linear.edge_shift) < 0.05
    # Half of 0.1 and 0.88 of the light is 0.49 of it; half of their grey values in sRGB is 0.39.
    assert 0.2 < toned.pixels < 0.5 and 0.25 < toned.edge_shift < 0.6
    assert tone_of(CHARUCO, replace(QUIET, tone="srgb")).edge_shift == pytest.approx(
        toned.edge_shift, abs=0.1
    )


def test_overexposed_sharpened_and_compressed_views_are_named() -> None:
    assert tone_of(CHESSBOARD, QUIET).troubles == ()
    for sensor, text in (
        (replace(QUIET, exposure=2.5), "overexposed"),
        (replace(QUIET, sharpening=1.5), "sharpened"),
        (replace(QUIET, jpeg=30), "compressed"),
    ):
        (trouble,) = tone_of(CHESSBOARD, sensor).troubles
        assert trouble.startswith(text) and ":" in trouble


def test_the_camera_file_holds_what_is_expected_of_edges(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    camera = replace(STANDARD_CAMERA, edge_shift=0.41, edge_shift_sigma=0.12)
    camera.save(path)
    again = CameraIntrinsics.load(path)
    assert (again.edge_shift, again.edge_shift_sigma) == (0.41, 0.12)
    assert expected_shift(again) == (0.41, 0.12)
    # It is no part of how points become pixels, and never certain.
    assert camera.digest == STANDARD_CAMERA.digest
    assert expected_shift(replace(camera, edge_shift_sigma=0.0))[1] > 0.05
    assert expected_shift(STANDARD_CAMERA)[1] > 0.3


# --------------------------------------------------------------------------------- sensors


def test_every_tone_curve_rises_from_black_to_white() -> None:
    light = np.linspace(0.0, 1.0, 101)
    for name, tone in TONES.items():
        grey = tone(light)
        assert grey[0] == pytest.approx(0.0, abs=1e-6) and grey[-1] == pytest.approx(1.0, abs=1e-6), name
        assert (np.diff(grey) > 0.0).all(), name
    assert TONES["srgb"](np.array([0.2140])) == pytest.approx(0.5, abs=1e-3)  # IEC 61966-2-1
    with pytest.raises(CameraError, match="srgb"):
        SensorModel(tone="sRBG")


def test_a_flat_light_becomes_a_flat_picture() -> None:
    light = np.full((40, 60, 3), 100.0)
    for sensor in (LINEAR, WEBCAM, replace(WEBCAM, motion=3.0, sharpening=1.5)):
        picture = sensor.developed(sensor.scattered(light), None)
        level = 255.0 * TONES[sensor.tone](np.array([100.0 / 255.0]))[0]
        assert picture.shape == light.shape and picture.dtype == np.uint8
        assert np.abs(picture.astype(float) - level).max() <= 1.0


def test_noise_is_as_strong_as_it_says() -> None:
    light, rng = np.full((200, 200), 60.0), np.random.default_rng(1)
    unit_noise = rng.normal(0.0, 1.0, light.shape)
    assert LINEAR.developed(light, unit_noise).std() == pytest.approx(4.0, rel=0.05)
    # Demosaicing averages neighbours.
    webcam = replace(WEBCAM, noise=4.0, sharpening=0.0, jpeg=None)
    assert 1.5 < webcam.developed(light, unit_noise).std() < 4.0
