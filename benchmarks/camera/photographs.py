"""Accuracy in the user's own photographs, and the time of the first command after installation."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.camera.accuracy import frame_of, outward
from benchmarks.camera.rows import Effort
from benchmarks.quantity import Quantity
from robot_ik.camera.calibration.intrinsic import calibrate
from robot_ik.camera.image import (
    IMAGE_SUFFIXES,
    dictionary_names,
    natural_sort,
    read_image,
    to_gray,
)
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, FoundPattern
from robot_ik.camera.targets import find_corners, unique
from robot_ik.errors import CalibrationError, CameraError
from robot_ik.ports import Image
from robot_ik.workcell.pictures import MarkerFinder

#: Chessboard of OpenCV's sample pictures: 9 × 6 inner corners.
CHESSBOARD = ChessboardPattern(9, 6, 0.025)
#: ChArUco boards of OpenCV's samples and of ``robot-ik camera print charuco``.
CHARUCOS = (
    CharucoPattern(5, 7, 0.04, 0.02, "DICT_6X6_250", legacy=True),
    CharucoPattern(8, 6, 0.03, 0.022, "DICT_5X5_50"),
)
# Smallest number of chessboards of one picture size for a calibration.
_MIN_BOARDS = 6
# Smallest number of saddle points of a ChArUco board for a homography.
_MIN_SADDLES = 8
# Chessboards that are searched for markers of all dictionaries. Each takes more than a second.
_SEARCHED = 3
# When ``cv2.cornerSubPix`` stops: after 30 steps, or after a step of 0.01 px.
_SUBPIX_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
# Largest time of the first command, s.
_FIRST_SECONDS = 20.0
# Time after which the first command is stopped, s.
_TIMEOUT = 300.0


def photographs(effort: Effort) -> Iterator[Quantity]:
    """Yield false detections, calibration and marker errors in a folder of photographs.

    Raises:
        CameraError: The folder is not given, or it holds no pictures.
    """
    if not effort.photographs:
        raise CameraError("it needs photographs of yours: --photographs FOLDER")
    folder = Path(effort.photographs)
    files = [f for f in natural_sort(folder.glob("*")) if f.suffix.lower() in IMAGE_SUFFIXES]
    pictures = [to_gray(read_image(f)) for f in files]
    if not pictures:
        raise CameraError(f"no pictures in {folder}")
    boards = [
        (picture, view) for picture in pictures if (view := CHESSBOARD.find(picture)) is not None
    ]
    if boards:
        finds = sum(any_finds(picture) for picture, _ in boards[:_SEARCHED])
        yield Quantity(
            f"finds of any dictionary on {min(len(boards), _SEARCHED)} chessboards", finds, "", 0
        )
    plain = [picture for picture in pictures if all(picture is not board for board, _ in boards)]
    finder = MarkerFinder("DICT_5X5_50")
    finds = sum(len(finder.observe(frame_of(picture)).markers) for picture in plain)
    yield Quantity(f"finds in {len(plain)} photographs without markers (DICT_5X5_50)", finds, "", 0)
    yield from _of_chessboards(boards)
    yield from _of_charuco(plain, folder)


def any_finds(picture: Image) -> int:
    """Return how many markers all dictionaries together find in a picture."""
    # A dictionary of 1000 markers contains the smaller ones of the same cells.
    largest = [name for name in dictionary_names() if not name.endswith(("_50", "_100", "_250"))]
    return sum(len(MarkerFinder(name).observe(frame_of(picture)).markers) for name in largest)


def _of_chessboards(boards: list[tuple[Image, FoundPattern]]) -> Iterator[Quantity]:
    """Yield the reprojection error beside OpenCV's, and the error at corners that were left out.

    The lens is calibrated by the other pictures, and every other corner of a picture is left out.
    """
    shapes = [picture.shape for picture, _ in boards]
    size = max(shapes, key=shapes.count, default=(0, 0))
    boards = [(picture, view) for picture, view in boards if picture.shape == size]
    views = [view for _, view in boards]
    if len(views) < _MIN_BOARDS:
        return
    error = calibrate(views, (size[1], size[0])).intrinsics.rms or np.nan
    yield Quantity(f"calibration by {len(views)} chessboards, RMS", error, "px")
    yield Quantity("the same, beside OpenCV's corners", error / opencv_rms(boards), "", 1.0)
    squares = [
        _held_out(view, views[:k] + views[k + 1 :], (size[1], size[0]))
        for k, view in enumerate(views)
    ]
    error = float(np.sqrt(np.mean(np.concatenate(squares))))
    yield Quantity(f"overlay on real corners of {len(views)} chessboards, RMS", error, "px", 1.0)


def opencv_rms(boards: Sequence[tuple[Image, FoundPattern]]) -> float:
    """Return the error of ``cv2.calibrateCamera`` with OpenCV's corners of these pictures, px."""
    points = []
    pixels = []
    for gray, view in boards:
        found, corners = cv2.findChessboardCorners(gray, (CHESSBOARD.columns, CHESSBOARD.rows))
        if found:
            fine = cv2.cornerSubPix(
                gray, corners.reshape(-1, 1, 2), (11, 11), (-1, -1), _SUBPIX_STOP
            )
            pixels.append(np.asarray(fine, dtype=np.float32).reshape(-1, 2))
            points.append(view.points_board.astype(np.float32))
    return float(cv2.calibrateCamera(points, pixels, boards[0][0].shape[::-1], None, None)[0])


def _of_charuco(pictures: list[Image], folder: Path) -> Iterator[Quantity]:
    """Yield the errors of markers against the saddle points of their ChArUco board.

    Only pictures are used for whose size the folder holds a camera file.
    """
    lenses = {}
    for file in sorted((*folder.glob("*.yml"), *folder.glob("*.yaml"))):
        with contextlib.suppress(CalibrationError):
            lens = CameraIntrinsics.load(file)
            lenses[lens.size] = lens
    errors: list[float] = []
    for picture in pictures:
        size = (picture.shape[1], picture.shape[0])
        if size not in lenses:
            continue
        lens = lenses[size]
        for board in CHARUCOS:
            corners = unique(find_corners(frame_of(picture), lens, board.dictionary))
            pixels = {marker_id: marker.pixels for marker_id, marker in corners.items()}
            errors += outward_of_saddles(picture, lens, board, pixels)
    if errors:
        text = f"{len(errors)} markers, corners outside of where their chessboard puts them"
        yield Quantity(f"{text}, mean", abs(float(np.mean(errors))), "px", 0.15)
        yield Quantity(f"{text}, scatter", float(np.std(errors)), "px", 0.12)


def outward_of_saddles(
    gray: Image,
    lens: CameraIntrinsics,
    board: CharucoPattern,
    pixels: Mapping[int, NDArray[np.float64]],
) -> list[float]:
    """Return how far outwards the corners of markers lie from their positions by the saddles, px.

    Markers at the border of the board are left out: homography and lens would be extrapolated.

    Args:
        gray: Picture.
        lens: Its intrinsics.
        board: Board to look for.
        pixels: Corners (4, 2) of the detected markers by id, px.

    Returns:
        Mean of the four corners of each marker.
    """
    view = board.find(gray)
    if view is None or len(view.pixels) < _MIN_SADDLES:
        return []
    homography, _ = cv2.findHomography(view.points_board[:, :2], lens.undistort(view.pixels))
    errors = []
    for number, (column, row) in enumerate(board.marker_squares()):
        if number not in pixels or not 0 < row < board.rows - 1:
            continue
        expected = lens.distort(_predicted(homography, board, column, row))
        errors.append(float(outward(pixels[number] - expected, expected).mean()))
    return errors


def _predicted(
    homography: NDArray[Any], board: CharucoPattern, column: int, row: int
) -> NDArray[np.float64]:
    """Return the undistorted corners (4, 2) of the marker in a square of the board."""
    middle = (np.array([column, row]) + 0.5) * board.square
    half = 0.5 * board.marker * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    points = np.column_stack([middle + half, np.ones(4)]) @ homography.T
    return np.asarray(points[:, :2] / points[:, 2:], dtype=float)


def _held_out(
    view: FoundPattern, others: list[FoundPattern], size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the squared errors (k,), px^2, of the corners of ``view`` that were left out.

    Args:
        view: Every other corner gives the pose of the board.
        others: They give the lens.
        size: Width and height of the pictures, px.
    """
    lens = calibrate(others, size).intrinsics
    fitted = np.arange(len(view.pixels)) % 2 == 0
    _, rotation, translation = cv2.solvePnP(
        view.points_board[fitted], view.pixels[fitted], lens.matrix, lens.coefficients
    )
    projected, _ = cv2.projectPoints(
        view.points_board[~fitted], rotation, translation, lens.matrix, lens.coefficients
    )
    errors = np.asarray(projected, dtype=float).reshape(-1, 2) - view.pixels[~fitted]
    return np.asarray((errors**2).sum(axis=1), dtype=float)


def first_command(_effort: Effort) -> Iterator[Quantity]:
    """Yield the time of ``robot-ik ar`` in a new process, with an empty cache, without display."""
    with tempfile.TemporaryDirectory() as folder:
        bare = {
            k: v
            for k, v in os.environ.items()
            if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
        }
        bare["XDG_CACHE_HOME"] = folder
        command = ["ar", "--seconds", "0.2", "--video", str(Path(folder) / "ar.png")]
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "robot_ik", *command],
            env=bare,
            cwd=folder,
            capture_output=True,
            check=False,
            timeout=_TIMEOUT,
        )
        took = time.monotonic() - began
    yield Quantity(
        "first command (robot-ik ar), nothing compiled before", took, "s", _FIRST_SECONDS
    )
    yield Quantity("its exit code", done.returncode, "", 0)
