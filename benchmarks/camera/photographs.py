"""What synthetic pictures cannot show: photographs of your own, and the first command on a bare machine."""

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
from robot_ik.jobs.pictures import MarkerFinder
from robot_ik.jobs.quantity import Quantity
from robot_ik.ports import Image

#: The boards that photographs may show: OpenCV's own chessboard has 9 × 6 inner corners; its ChArUco board,
#: and that of ``robot-ik camera print charuco``.
CHESSBOARD = ChessboardPattern(9, 6, 0.025)
CHARUCOS = (
    CharucoPattern(5, 7, 0.04, 0.02, "DICT_6X6_250", legacy=True),
    CharucoPattern(8, 6, 0.03, 0.022, "DICT_5X5_50"),
)
_LEAST_BOARDS, _LEAST_SADDLES = 6, 8
# So many chessboards are searched for markers of all dictionaries: a second and more each.
_ASKED = 3
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
_FIRST_SECONDS, _PATIENCE = 20.0, 300.0


def photographs(effort: Effort) -> Iterator[Quantity]:
    """What the tests ask of OpenCV's samples, a user's folder: false finds, calibration, markers' positions.

    Raises:
        CameraError: No folder is given, or it holds no pictures.
    """
    if not effort.photographs:
        raise CameraError("it needs photographs of yours: --photographs FOLDER")
    folder = Path(effort.photographs)
    files = [f for f in natural_sort(folder.glob("*")) if f.suffix.lower() in IMAGE_SUFFIXES]
    pictures = [to_gray(read_image(f)) for f in files]
    if not pictures:
        raise CameraError(f"no pictures in {folder}")
    boards = [(one, view) for one in pictures if (view := CHESSBOARD.find(one)) is not None]
    if boards:
        finds = sum(any_finds(one) for one, _ in boards[:_ASKED])
        yield Quantity(
            f"finds of any dictionary on {min(len(boards), _ASKED)} chessboards", finds, "", 0
        )
    plain = [one for one in pictures if all(one is not other for other, _ in boards)]
    finder = MarkerFinder("DICT_5X5_50")
    finds = sum(len(finder.observe(frame_of(one)).markers) for one in plain)
    yield Quantity(f"finds in {len(plain)} photographs without markers (DICT_5X5_50)", finds, "", 0)
    yield from _of_chessboards(boards)
    yield from _of_charuco(plain, folder)


def any_finds(picture: Image) -> int:
    """Return how many markers all dictionaries together find in a picture."""
    # A dictionary of 1000 markers contains the smaller ones of the same cells.
    largest = [name for name in dictionary_names() if not name.endswith(("_50", "_100", "_250"))]
    return sum(len(MarkerFinder(name).observe(frame_of(picture)).markers) for name in largest)


def _of_chessboards(boards: list[tuple[Image, FoundPattern]]) -> Iterator[Quantity]:
    """Reprojection beside OpenCV's; and the miss at every other corner, the lens by all other pictures."""
    size = max(
        (one.shape for one, _ in boards), key=[one.shape for one, _ in boards].count, default=(0, 0)
    )
    boards = [(one, view) for one, view in boards if one.shape == size]
    views = [view for _, view in boards]
    if len(views) < _LEAST_BOARDS:
        return
    mine = calibrate(views, (size[1], size[0])).intrinsics.rms or np.nan
    yield Quantity(f"calibration by {len(views)} chessboards, RMS", mine, "px")
    yield Quantity("the same, beside OpenCV's corners", mine / opencv_rms(boards), "", 1.0)
    squares = [
        _unseen(view, views[:k] + views[k + 1 :], (size[1], size[0]))
        for k, view in enumerate(views)
    ]
    error = float(np.sqrt(np.mean(np.concatenate(squares))))
    yield Quantity(f"overlay on real corners of {len(views)} chessboards, RMS", error, "px", 1.0)


def opencv_rms(boards: Sequence[tuple[Image, FoundPattern]]) -> float:
    """Reprojection error, px, of ``cv2.calibrateCamera`` with OpenCV's own corners of the same pictures."""
    points, pixels = [], []
    for gray, view in boards:
        seen, corners = cv2.findChessboardCorners(gray, (CHESSBOARD.columns, CHESSBOARD.rows))
        if seen:
            fine = cv2.cornerSubPix(gray, corners.reshape(-1, 1, 2), (11, 11), (-1, -1), _STOP)
            pixels.append(np.asarray(fine, dtype=np.float32).reshape(-1, 2))
            points.append(view.points_board.astype(np.float32))
    return float(cv2.calibrateCamera(points, pixels, boards[0][0].shape[::-1], None, None)[0])


def _of_charuco(pictures: list[Image], folder: Path) -> Iterator[Quantity]:
    """Markers against the saddles of their board; where a camera file of that size lies in the folder."""
    lenses = {}
    for file in sorted((*folder.glob("*.yml"), *folder.glob("*.yaml"))):
        with contextlib.suppress(CalibrationError):
            lens = CameraIntrinsics.load(file)
            lenses[lens.size] = lens
    off: list[float] = []
    for picture in pictures:
        size = (picture.shape[1], picture.shape[0])
        if size not in lenses:
            continue
        lens = lenses[size]
        for board in CHARUCOS:
            corners = unique(find_corners(frame_of(picture), lens, board.dictionary))
            seen = {marker_id: c.pixels for marker_id, c in corners.items()}
            off += outward_of_saddles(picture, lens, board, seen)
    if off:
        text = f"{len(off)} markers, corners outside of where their chessboard puts them"
        yield Quantity(f"{text}, mean", abs(float(np.mean(off))), "px", 0.15)
        yield Quantity(f"{text}, scatter", float(np.std(off)), "px", 0.12)


def outward_of_saddles(
    gray: Image,
    lens: CameraIntrinsics,
    board: CharucoPattern,
    seen: Mapping[int, NDArray[np.float64]],
) -> list[float]:
    """How far outwards, px, corners (4, 2) of markers, by id, lie of where the saddles round them say.

    Only markers with saddles on all sides are asked: beyond them homography and lens are only guessed.
    """
    found = board.find(gray)
    if found is None or len(found.pixels) < _LEAST_SADDLES:
        return []
    homography, _ = cv2.findHomography(found.points_board[:, :2], lens.undistort(found.pixels))
    off = []
    for number, (column, row) in enumerate(board.marker_squares()):
        if number not in seen or not 0 < row < board.rows - 1:
            continue
        expected = lens.distort(_predicted(homography, board, column, row))
        off.append(float(outward(seen[number] - expected, expected).mean()))
    return off


def _predicted(
    homography: NDArray[Any], board: CharucoPattern, column: int, row: int
) -> NDArray[np.float64]:
    """Undistorted corners (4, 2) of the marker in a square of the board."""
    middle = (np.array([column, row]) + 0.5) * board.square
    half = 0.5 * board.marker * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    there = np.column_stack([middle + half, np.ones(4)]) @ homography.T
    return np.asarray(there[:, :2] / there[:, 2:], dtype=float)


def _unseen(
    view: FoundPattern, others: list[FoundPattern], size: tuple[int, int]
) -> NDArray[np.float64]:
    lens = calibrate(others, size).intrinsics
    fitted = np.arange(len(view.pixels)) % 2 == 0
    _, rotation, translation = cv2.solvePnP(
        view.points_board[fitted], view.pixels[fitted], lens.matrix, lens.coefficients
    )
    there, _ = cv2.projectPoints(
        view.points_board[~fitted], rotation, translation, lens.matrix, lens.coefficients
    )
    off = np.asarray(there, dtype=float).reshape(-1, 2) - view.pixels[~fitted]
    return np.asarray((off**2).sum(axis=1), dtype=float)


def first_command(effort: Effort) -> Iterator[Quantity]:
    """A picture of a robot on a board, by a new process: nothing compiled before, no display, no camera."""
    with tempfile.TemporaryDirectory() as folder:
        bare = {
            k: v
            for k, v in os.environ.items()
            if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
        }
        bare["XDG_CACHE_HOME"] = folder
        command = ["ar", "--seconds", "0.2", "--out", str(Path(folder) / "ar.png")]
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "robot_ik", *command],
            env=bare, cwd=folder, capture_output=True, check=False, timeout=_PATIENCE,
        )  # fmt: skip
        took = time.monotonic() - began
    yield Quantity(
        "first command (robot-ik ar), nothing compiled before", took, "s", _FIRST_SECONDS
    )
    yield Quantity("its exit code", done.returncode, "", 0)
