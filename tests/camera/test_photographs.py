"""Real photographs: OpenCV's samples, whose content is known.  See ``tests/data/opencv/README.md``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.bench.camera.accuracy import frame_of
from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern
from robot_ik.camera.boards.tone import measure_tone
from robot_ik.camera.calibration.intrinsic import View, calibrate
from robot_ik.camera.corner_refinement import refine_markers
from robot_ik.camera.detection import MarkerDetector, _families
from robot_ik.camera.image import read_image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.tracker import MarkerFinder, MarkerTracker

FOLDER = Path(__file__).parent.parent / "data" / "opencv"
CHESSBOARD = ChessboardPattern(9, 6, 0.025)
CHARUCO = CharucoPattern(5, 7, 0.04, 0.02, "DICT_6X6_250", legacy=True)


def gray_of(name: str) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(read_image(FOLDER / name), cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def test_the_markers_of_a_photograph_are_found_and_no_others() -> None:
    finder = MarkerFinder("DICT_6X6_250")
    assert finder.look(frame_of(gray_of("singlemarkersoriginal.jpg"))).ids == (23, 40, 62, 98, 124, 203)
    assert finder.look(frame_of(gray_of("choriginal.jpg"))).ids == tuple(range(17))


@pytest.mark.parametrize("name", ["left12.jpg"])
def test_no_dictionary_has_a_marker_on_a_chessboard(name: str) -> None:
    frame = frame_of(gray_of(name))
    for family in _families():
        assert MarkerFinder(family[-1]).look(frame).ids == ()


@pytest.fixture(scope="module")
def chessboards() -> list[View]:
    views = []
    for file in sorted(FOLDER.glob("left*.jpg")):
        gray = gray_of(file.name)
        found = CHESSBOARD.find(gray)
        assert found is not None, file.name
        tone = measure_tone(gray, found.pixels, found.ids, 9, CHESSBOARD.plain)
        views.append(View(file.name, found, tone))
    return views


def test_a_calibration_from_photographs_beats_opencvs(chessboards: list[View]) -> None:
    points, pixels = [], []
    for view in chessboards:
        gray = gray_of(view.name)
        _, corners = cv2.findChessboardCorners(gray, (9, 6))
        done = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
        pixels.append(
            cv2.cornerSubPix(gray, corners.reshape(-1, 1, 2), (11, 11), (-1, -1), done).reshape(-1, 2)
        )
        points.append(view.found.points_board.astype(np.float32))
    theirs = cv2.calibrateCamera(points, pixels, (640, 480), None, None)[0]
    mine = calibrate(chessboards, (640, 480))
    assert mine.rms < 0.2 and mine.rms < 0.6 * theirs
    assert mine.intrinsics.fx == pytest.approx(535.9, rel=0.01)  # left_intrinsics.yml


def test_one_camera_shifts_edges_differently_from_picture_to_picture(chessboards: list[View]) -> None:
    """Why a stored curve would not do, and why the camera file holds a spread."""
    shifts = np.array([view.tone.pixels for view in chessboards if view.tone is not None])
    assert len(shifts) >= 10
    assert shifts.max() - shifts.min() > 0.1
    result = calibrate(chessboards, (640, 480))
    assert result.intrinsics.edge_shift is not None and (result.intrinsics.edge_shift_sigma or 0.0) > 0.02
    assert any("in the black" in note for note in result.notes)


def test_markers_lie_where_the_saddles_of_their_board_say() -> None:
    """A ChArUco board: the print's corners are nearer to the saddles' prediction than four sides are."""
    gray, lens = gray_of("choriginal.jpg"), CameraIntrinsics.load(FOLDER / "tutorial_camera_charuco.yml")
    found = CHARUCO.find(gray)
    assert found is not None
    homography, _ = cv2.findHomography(found.points_board[:, :2], lens.undistort(found.pixels))
    tracker = MarkerTracker(lens, "DICT_6X6_250", CHARUCO.marker)
    fitted = {seen.id: seen.corners for seen in tracker.observe(frame_of(gray))}
    detected = MarkerDetector("DICT_6X6_250").detect(gray)
    sides = refine_markers(gray, [d.corners for d in detected], lens, cells=8)
    by_sides = {d.id: one.corners for d, one in zip(detected, sides, strict=True)}
    outward: dict[str, list[float]] = {"print": [], "sides": []}
    for number, (column, row) in enumerate(CHARUCO.marker_squares()):
        if not 0 < row < CHARUCO.rows - 1:
            continue  # beyond the saddles the homography and the tutorial's lens are only guessed
        middle = (np.array([column, row]) + 0.5) * CHARUCO.square
        half = 0.5 * CHARUCO.marker * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        there = np.column_stack([middle + half, np.ones(4)]) @ homography.T
        expected = lens.distort(there[:, :2] / there[:, 2:])
        way = expected - expected.mean(axis=0)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        for name, corners in (("print", fitted), ("sides", by_sides)):
            outward[name].append(float(np.mean(np.sum((corners[number] - expected) * way, axis=1))))
    # The picture is decimated, its blur narrower than a pixel: a hundredth cannot be asked of it.
    assert abs(np.mean(outward["print"])) < 0.15 < abs(np.mean(outward["sides"]))
    assert np.std(outward["print"]) < 0.12
