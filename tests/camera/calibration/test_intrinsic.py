"""Calibration against cameras that are known exactly."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.camera.pictures import pattern_set
from robot_ik.camera.calibration.coverage import TILTS
from robot_ik.camera.calibration.intrinsic import CalibrationResult, CalibrationView, calibrate
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, FoundPattern
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, pattern_pose
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose, rotation_exp

BOARD = ChessboardPattern(9, 6, 0.025)
SIZE = STANDARD_CAMERA.size
WIDE = CameraIntrinsics(
    640,
    480,
    450.0,
    451.0,
    317.0,
    243.0,
    (-0.05, 0.02, 0.0004, -0.0003, 0.001, 0.2, 0.03, 0.002),
    "rational_polynomial",
)

VERY_WIDE = CameraIntrinsics(
    640,
    480,
    300.0,
    300.0,
    318.0,
    241.0,
    (10.0, 5.0, 0.0, 0.0, 0.3, 10.4, 8.0, 1.6),
    "rational_polynomial",
)


def seen(
    camera: CameraIntrinsics, pose: Pose, rng: np.random.Generator, noise: float = 0.05
) -> FoundPattern:
    """The board's corners as a detector with this much noise (px) would give them."""
    column, row = np.meshgrid(np.arange(9.0), np.arange(6.0))
    points = np.stack([column.ravel(), row.ravel(), np.zeros(54)], axis=1) * BOARD.square
    pixels = camera.project(pose.apply(points)) + rng.normal(0.0, noise, (54, 2))
    return FoundPattern(points, pixels, np.arange(54), blur=0.9)


def views(
    camera: CameraIntrinsics, count: int, seed: int = 0, **wishes: object
) -> list[FoundPattern]:
    rng = np.random.default_rng(seed)
    return [seen(camera, pattern_pose(BOARD, camera, rng, **wishes), rng) for _ in range(count)]  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pictures() -> list[tuple[Pose, FoundPattern]]:
    """Twenty pictures of a ChArUco board: where it was, and its corners."""
    board = CharucoPattern(8, 6, 0.03, 0.022)
    found = [
        (pose, board.find(image)) for image, pose in pattern_set(board, STANDARD_CAMERA, 20, seed=1)
    ]
    return [(pose, corners) for pose, corners in found if corners is not None]


@pytest.fixture(scope="module")
def twenty(pictures: list[tuple[Pose, FoundPattern]]) -> CalibrationResult:
    """The calibration from them."""
    return calibrate([found for _, found in pictures], SIZE)


def test_corners_of_a_charuco_board_are_found_without_bias(
    pictures: list[tuple[Pose, FoundPattern]],
) -> None:
    errors = np.concatenate(
        [f.pixels - STANDARD_CAMERA.project(p.apply(f.points_board)) for p, f in pictures]
    )
    assert len(pictures) == 20 and len(errors) > 600
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.01


def test_twenty_views_give_the_camera(twenty: CalibrationResult) -> None:
    camera = twenty.intrinsics
    true = STANDARD_CAMERA
    assert camera.fx == pytest.approx(true.fx, rel=0.0015)
    assert camera.fy == pytest.approx(true.fy, rel=0.0015)
    assert np.hypot(camera.cx - true.cx, camera.cy - true.cy) < 2.0
    assert camera.rms < 0.08
    # What matters: where a ray goes, all over the picture.
    x, y = np.meshgrid(np.linspace(40, 600, 9), np.linspace(40, 440, 7))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = np.hstack([true.undistort(pixels), np.ones((63, 1))])
    assert np.abs(camera.project(rays) - pixels).max() < 1.5
    assert not twenty.doubts and twenty.verdict.startswith("good")


def test_standard_deviations_and_hold_out_error_are_consistent(twenty: CalibrationResult) -> None:
    camera = twenty.intrinsics
    true = STANDARD_CAMERA
    errors = np.array(
        [camera.fx - true.fx, camera.fy - true.fy, camera.cx - true.cx, camera.cy - true.cy]
    )
    assert (np.abs(errors) < 4.0 * np.array(camera.std[:4])).all()
    assert camera.std[0] < 0.002 * true.fx and max(camera.std[2:4]) < 2.0
    assert camera.views == 20
    assert camera.rms <= twenty.hold_out_rms < 1.2 * camera.rms


def test_a_wide_angle_lens_needs_eight_coefficients() -> None:
    found = views(WIDE, 9, seed=4, fill=(0.5, 1.1))
    eight = calibrate(found, SIZE, coefficients=8)
    five = calibrate(found, SIZE)
    assert eight.intrinsics.model == "rational_polynomial" and len(eight.intrinsics.std) == 12
    assert eight.intrinsics.rms < 0.09
    assert eight.intrinsics.fx == pytest.approx(WIDE.fx, rel=0.005)
    assert five.intrinsics.rms >= eight.intrinsics.rms


@pytest.mark.parametrize("seed", [4, 5, 6])
def test_the_fit_of_a_very_wide_lens_converges(seed: int) -> None:
    found = views(VERY_WIDE, 9, seed=seed, fill=(0.5, 1.1))
    result = calibrate(found, SIZE, coefficients=8)
    # The noise of the corners is 0.05 px in each direction.
    assert result.intrinsics.rms < 0.08
    assert result.intrinsics.fx == pytest.approx(VERY_WIDE.fx, rel=0.005)


def test_the_lens_determines_the_number_of_coefficients() -> None:
    wide = calibrate(views(VERY_WIDE, 9, seed=4, fill=(0.5, 1.1)), SIZE, coefficients=None)
    assert wide.intrinsics.model == "rational_polynomial"
    usual = calibrate(views(STANDARD_CAMERA, 7, seed=2), SIZE, coefficients=None)
    assert usual.intrinsics.model == "plumb_bob"


def test_eight_undetermined_coefficients_are_reported() -> None:
    result = calibrate(views(STANDARD_CAMERA, 7, seed=2), SIZE, coefficients=8)
    assert any("8 coefficients fit no better than 5" in doubt for doubt in result.doubts)


def test_few_views_give_a_warning() -> None:
    result = calibrate(views(STANDARD_CAMERA, 8, seed=2), SIZE)
    assert result.doubts[0] == "only 8 views: take 15 or more"
    assert result.verdict.startswith("usable, with doubts")


def test_too_few_views_are_refused() -> None:
    with pytest.raises(CalibrationError, match="5 usable views: too few, at least 6") as caught:
        calibrate(views(STANDARD_CAMERA, 5), SIZE)
    assert "tilted" in caught.value.hint


def test_a_board_that_is_never_tilted_is_refused() -> None:
    with pytest.raises(CalibrationError, match="square to the camera") as caught:
        calibrate(views(STANDARD_CAMERA, 12, tilt_deg=(0.0, 4.0)), SIZE)
    assert "tilt the board" in caught.value.hint


def test_noise_gives_no_calibration() -> None:
    rng = np.random.default_rng(0)
    found = [
        seen(STANDARD_CAMERA, pattern_pose(BOARD, STANDARD_CAMERA, rng), rng, noise=2.0)
        for _ in range(10)
    ]
    with pytest.raises(CalibrationError, match=r"leaves 2\.\d\d px RMS; at most 1 px are accepted"):
        calibrate(found, SIZE)


def test_a_view_that_does_not_fit_is_named_and_left_out() -> None:
    good = views(STANDARD_CAMERA, 12, seed=6)
    # A board that was bent between two pictures, and one that moved during its picture.
    distorted = good[4].pixels + 0.004 * (good[4].pixels - good[4].pixels.mean(axis=0)) ** 2 / 20.0
    wrong = dataclasses.replace(good[4], pixels=distorted)
    moved = dataclasses.replace(good[7], blur=3.1)
    named = [
        CalibrationView(f"photo{k}.png", {4: wrong, 7: moved}.get(k, v)) for k, v in enumerate(good)
    ]
    result = calibrate(named, SIZE)
    left_out = {r.name: r.left_out for r in result.per_view if r.left_out}
    assert set(left_out) == {"photo4.png", "photo7.png"}
    assert "does not fit the other views" in left_out["photo4.png"]
    assert left_out["photo7.png"].startswith("blurred: edges 3.1 px wide, 0.9 px")
    assert result.intrinsics.views == 10 and result.intrinsics.rms < 0.1
    assert result.intrinsics.fx == pytest.approx(STANDARD_CAMERA.fx, rel=0.003)


def test_parts_without_views_are_named() -> None:
    rng = np.random.default_rng(1)
    found = []
    for k in range(10):  # always in the left half, always with its right side or top away
        tilt = np.deg2rad(20.0 + k)
        turn = rotation_exp([tilt, 0, 0] if k % 2 else [0, -tilt, 0])
        found.append(seen(STANDARD_CAMERA, Pose((-0.2, -0.07, 0.55), turn), rng))
    coverage = calibrate(found, SIZE).coverage
    missing = " ".join(coverage.missing)
    for text in (
        "the board in the right",
        "the board in the lower right",
        "the left side of the board tilted away",
    ):
        assert text in missing
    assert "the right side" not in missing and "the board in the left" not in missing
    tops = {"top": -1.0, "bottom": 1.0}
    shown = max(tops, key=lambda side: float((coverage.tilts[:, 1] * tops[side]).max()))
    assert f"the {shown} side" not in missing
    assert f"the {({'top', 'bottom'} - {shown}).pop()} side" in missing


@pytest.mark.parametrize("side", TILTS)
def test_a_tilt_points_to_the_side_that_is_farther(side: str) -> None:
    way = np.array(TILTS[side])
    # A rotation about the axis across ``way`` moves that side away: checked by the depths.
    turn = rotation_exp(np.deg2rad(25.0) * np.array([way[1], -way[0], 0.0]))
    found = [seen(STANDARD_CAMERA, Pose((-0.1, -0.06, 0.5), turn), np.random.default_rng(0))]
    depth = Pose((-0.1, -0.06, 0.5), turn).apply(found[0].points_board)[:, 2]
    along = (found[0].pixels - found[0].pixels.mean(axis=0)) @ way
    assert np.corrcoef(depth, along)[0, 1] > 0.9
    from robot_ik.camera.calibration.coverage import cover

    tilt = cover(found, [Pose(wxyz=turn).rotation], SIZE).tilts[0]
    assert tilt == pytest.approx(25.0 * way, abs=1e-6)


@pytest.mark.parametrize("coefficients", [5, 8])
def test_the_file_is_complete_for_opencv_and_plain_yaml(tmp_path: Path, coefficients: int) -> None:
    distortion = tuple(0.01 * (k + 1) for k in range(coefficients))
    model = "plumb_bob" if coefficients == 5 else "rational_polynomial"
    std = tuple(0.1 + 0.01 * k for k in range(4 + coefficients))
    date = "2026-11-21T05:40:54+00:00"
    camera = CameraIntrinsics(
        640, 480, 601.0, 602.0, 318.0, 243.0, distortion, model, 0.12, std, 21, "desk", date
    )
    path = tmp_path / "camera.yaml"
    camera.save(path)
    assert CameraIntrinsics.load(path) == camera
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("intrinsics_std_dev").mat().ravel() == pytest.approx(std)
    assert storage.getNode("distortion_coefficients").mat().ravel() == pytest.approx(distortion)
    assert storage.getNode("distortion_model").string() == model
    assert storage.getNode("calibration_time").string() == camera.date
    storage.release()
    content = yaml.safe_load(path.read_text())
    assert (content["views"], content["avg_reprojection_error"], content["calibration_time"]) == (
        21,
        0.12,
        camera.date,
    )
    for key, shape in {"rectification_matrix": (3, 3), "projection_matrix": (3, 4)}.items():
        assert (content[key]["rows"], content[key]["cols"]) == shape


Change = Callable[[CameraIntrinsics], CameraIntrinsics]


@settings(max_examples=20)
@given(
    st.sampled_from(["width", "height", "fx", "fy", "cx", "cy"]),
    st.floats(1e-9, 50.0, allow_nan=False),
    st.integers(0, 4),
)
def test_the_digest_depends_on_everything_that_maps_points_to_pixels(
    name: str, change: float, lens: int
) -> None:
    camera = STANDARD_CAMERA
    step = int(change) + 1 if name in ("width", "height") else change
    value = getattr(camera, name) + step
    other = dataclasses.replace(camera, **{name: value})
    assert (other.digest == camera.digest) == (value == getattr(camera, name))
    distorted = list(camera.distortion)
    distorted[lens] += change
    assert dataclasses.replace(camera, distortion=tuple(distorted)).digest != camera.digest
    # What is known of the calibration, or what the camera is called, is not the camera.
    same = dataclasses.replace(
        camera, rms=1.0, std=(1.0,) * 9, views=3, name="other", date="2026-01-01"
    )
    assert same.digest == camera.digest


def test_the_digest_survives_the_file(tmp_path: Path) -> None:
    plain = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)  # written with five zeros
    for camera in (plain, STANDARD_CAMERA, WIDE):
        camera.save(tmp_path / "camera.yaml")
        assert CameraIntrinsics.load(tmp_path / "camera.yaml").digest == camera.digest
    assert len({plain.digest, STANDARD_CAMERA.digest, WIDE.digest}) == 3
    assert len(plain.digest) == 12 and int(plain.digest, 16) >= 0
