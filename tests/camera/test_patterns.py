"""Calibration patterns against OpenCV's drawings and against pictures with exact truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.camera.pictures import pattern_set
from robot_ik.camera.chess_corner import refine_corners
from robot_ik.camera.drawing.prints import Print
from robot_ik.camera.image import marker_dictionary
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, Pattern, fitting_pattern
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.errors import CalibrationError

CHARUCO = CharucoPattern(8, 6, 0.03, 0.022)
CHESSBOARD = ChessboardPattern(9, 6, 0.025)


def drawn(pattern: Pattern, scale: float = 1000.0, margin: float = 0.0) -> np.ndarray:
    """The pattern in a frontal view, ``scale`` pixels per metre."""
    boxes = pattern.black()
    boxes[:, :2] += margin - np.array(pattern.origin)
    width, height = (round((length + 2 * margin) * scale) for length in pattern.size)
    return Print.of_boxes(boxes * scale, (0.0, 0.0, width, height)).flat(width, height)


def opencv_board(p: CharucoPattern) -> cv2.aruco.CharucoBoard:
    dictionary = marker_dictionary(p.dictionary)
    board = cv2.aruco.CharucoBoard((p.columns, p.rows), p.square, p.marker, dictionary)
    board.setLegacyPattern(p.legacy)
    return board


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(8, 6), (5, 7)])
def test_a_charuco_board_equals_opencvs(columns: int, rows: int, legacy: bool) -> None:
    # 28 px a square, 14 px a marker of 7 cells: every edge falls on a pixel's edge, in both
    # drawings.
    pattern = CharucoPattern(columns, rows, 0.028, 0.014, legacy=legacy)
    board = opencv_board(pattern)
    theirs = board.generateImage((28 * columns, 28 * rows), marginSize=0)
    ours = drawn(pattern)
    assert (ours == theirs).all()
    corners = np.asarray(board.getChessboardCorners())
    found = pattern.find(np.pad(cv2.resize(ours, None, fx=3, fy=3), 60, constant_values=255))
    assert found is not None and len(found.ids) == (columns - 1) * (rows - 1)
    assert found.points_board == pytest.approx(corners[found.ids], abs=1e-6)


def test_corners_of_a_chessboard_are_found_to_hundredths_of_a_pixel() -> None:
    errors = []
    for image, pose in pattern_set(CHESSBOARD, STANDARD_CAMERA, 2, seed=3):
        found = CHESSBOARD.find(image)
        assert found is not None
        true = STANDARD_CAMERA.project(pose.apply(found.points_board))
        errors.append(found.pixels - true)
        assert 0.6 < found.blur < 1.2
    all_errors = np.concatenate(errors)
    assert len(all_errors) == 108
    assert np.sqrt(np.mean(np.sum(all_errors**2, axis=1))) < 0.03
    assert np.abs(all_errors.mean(axis=0)).max() < 0.01


def test_a_start_that_is_half_a_pixel_off_ends_at_the_same_corner() -> None:
    """Some releases of OpenCV give ChArUco corners half a pixel off."""
    ((image, _),) = pattern_set(
        CHESSBOARD, STANDARD_CAMERA, 1, seed=5, sensor=SensorModel(noise=2.0)
    )
    found = CHESSBOARD.find(image)
    assert found is not None
    grid = np.stack([found.ids % 9, found.ids // 9], axis=1).astype(float)
    for shift in ((0.5, 0.5), (-0.5, 0.5), (1.0, 0.0)):
        pixels, good, _ = refine_corners(image, found.pixels + shift, grid, 0.45)
        assert good.all()
        assert np.abs(pixels - found.pixels).max() < 0.02


def test_a_flat_grey_picture_has_no_corners() -> None:
    rng = np.random.default_rng(0)
    gray = rng.integers(120, 124, (480, 640)).astype(np.uint8)
    start = np.stack(np.meshgrid([200.0, 240.0, 280.0], [200.0, 240.0, 280.0]), axis=-1).reshape(
        -1, 2
    )
    _, good, _ = refine_corners(gray, start, (start - 200.0) / 40.0, 0.45)
    assert not good.any()
    for pattern in (CHARUCO, CHESSBOARD):
        assert pattern.find(gray) is None


def test_an_old_board_is_recognized() -> None:
    old = CharucoPattern(8, 6, 0.03, 0.022, legacy=True)
    image = drawn(old, margin=0.02, scale=2000.0)
    assert CHARUCO.find(image) is None
    assert fitting_pattern(CHARUCO, [image]) == old


@pytest.mark.parametrize("said", [(10, 7), (6, 9), (8, 5)])
def test_the_size_of_a_miscounted_chessboard_is_found(said: tuple[int, int]) -> None:
    image = drawn(CHESSBOARD, margin=0.02, scale=2000.0)
    other = fitting_pattern(ChessboardPattern(*said, 0.025), [image])
    # In a frontal view 9x6 and 6x9 are the same board. A part of a board is not a board.
    assert other in (CHESSBOARD, ChessboardPattern(6, 9, 0.025)) or said == (6, 9)


def test_the_majority_of_pictures_decides_the_size_of_a_chessboard() -> None:
    odd, right = (
        drawn(ChessboardPattern(*n, 0.025), margin=0.02, scale=2000.0) for n in ((10, 6), (9, 6))
    )
    assert fitting_pattern(ChessboardPattern(9, 5, 0.025), [odd, right, right, right]) == CHESSBOARD


def test_nothing_fits_an_empty_picture() -> None:
    assert fitting_pattern(CHARUCO, [np.full((480, 640, 3), 200, np.uint8)]) is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ChessboardPattern(2, 6, 0.02), "2x6 inner corners is too small"),
        (lambda: ChessboardPattern(9, 6, 25.0), "25 m is not possible(.|\\n)*25 mm are 0.025"),
        (lambda: CharucoPattern(8, 6, 30.0, 22.0), "30 m is not possible"),
        (
            lambda: CharucoPattern(8, 6, 0.03, 0.03),
            "markers of 30 mm do not fit into squares of 30 mm",
        ),
        (lambda: CharucoPattern(12, 9, 0.03, 0.022), "needs 54 markers; DICT_5X5_50 has 50"),
    ],
)
def test_impossible_patterns_are_rejected(make: object, message: str) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        make()  # type: ignore[operator]
    assert caught.value.hint
