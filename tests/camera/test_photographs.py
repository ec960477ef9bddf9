"""Real photographs: OpenCV's samples with known content.

See ``tests/data/opencv/README.md``.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.camera.accuracy import frame_of
from benchmarks.camera.photographs import (
    CHARUCOS,
    CHESSBOARD,
    any_finds,
    opencv_rms,
    outward_of_saddles,
    photographs,
)
from benchmarks.camera.rows import Effort
from robot_ik.camera.calibration.intrinsic import CalibrationView, calibrate
from robot_ik.camera.image import read_image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import find_corners, unique
from robot_ik.workcell.pictures import MarkerFinder

FOLDER = Path(__file__).parent.parent / "data" / "opencv"


def gray_of(name: str) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(read_image(FOLDER / name), cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def test_the_markers_of_a_photograph_are_found_and_no_others() -> None:
    finder = MarkerFinder("DICT_6X6_250")
    for name, ids in (
        ("singlemarkersoriginal.jpg", [23, 40, 62, 98, 124, 203]),
        ("choriginal.jpg", list(range(17))),
    ):
        assert [marker.id for marker in finder.observe(frame_of(gray_of(name))).markers] == ids


def test_no_dictionary_has_a_marker_on_a_chessboard() -> None:
    assert any_finds(gray_of("left12.jpg")) == 0


@pytest.fixture(scope="module")
def chessboards() -> list[CalibrationView]:
    views = []
    for file in sorted(FOLDER.glob("left*.jpg")):
        gray = gray_of(file.name)
        found = CHESSBOARD.find(gray)
        assert found is not None, file.name
        views.append(CalibrationView(file.name, found))
    return views


def test_a_calibration_from_photographs_is_more_accurate_than_opencvs(
    chessboards: list[CalibrationView],
) -> None:
    theirs = opencv_rms([(gray_of(view.name), view.found) for view in chessboards])
    mine = calibrate(chessboards, (640, 480))
    assert mine.intrinsics.rms < min(0.2, 0.6 * theirs)
    # OpenCV's left_intrinsics.yml has 535.9 px.
    assert mine.intrinsics.fx == pytest.approx(535.9, rel=0.01)


def test_markers_lie_where_the_saddles_of_their_board_say() -> None:
    """The corners of the markers are near the positions that the chess corners predict."""
    gray = gray_of("choriginal.jpg")
    lens = CameraIntrinsics.load(FOLDER / "tutorial_camera_charuco.yml")
    board = CHARUCOS[0]
    corners = unique(find_corners(frame_of(gray), lens, board.dictionary))
    fitted = {marker_id: c.pixels for marker_id, c in corners.items()}
    errors = outward_of_saddles(gray, lens, board, fitted)
    # The picture is decimated. Its blur is narrower than a pixel, which limits the accuracy.
    assert len(errors) >= 10 and abs(np.mean(errors)) < 0.15
    assert np.std(errors) < 0.12


def test_a_folder_of_photographs_passes_the_same_checks(tmp_path: Path) -> None:
    for name in ("choriginal.jpg", "tutorial_camera_charuco.yml", "left01.jpg"):
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes())
    figures = {
        quantity.quantity: quantity for quantity in photographs(Effort(photographs=str(tmp_path)))
    }
    assert [quantity.passed for quantity in figures.values()] == [True] * 4
    assert figures["finds of any dictionary on 1 chessboards"].value == 0
    assert any("outside of where their chessboard puts them" in words for words in figures)
