"""What synthetic pictures cannot tell: photographs of your own, and the first command on a bare machine."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera import Effort, Figure, NotMeasuredError
from robot_ik.bench.camera.accuracy import frame_of
from robot_ik.camera.boards.patterns import ChessboardPattern, FoundPattern
from robot_ik.camera.calibration.intrinsic import calibrate
from robot_ik.camera.tracker import MarkerFinder

Image = NDArray[np.uint8]

# The chessboard that photographs may show: OpenCV's own has 9 × 6 inner corners.
_BOARD = ChessboardPattern(9, 6, 0.025)
_LEAST_BOARDS = 6
_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff"}
_FIRST_SECONDS, _PATIENCE = 20.0, 300.0


def photographs(effort: Effort) -> Iterator[Figure]:
    """False finds in a folder of photographs; where they show chessboards, how well unseen corners are met.

    Raises:
        NotMeasuredError: No folder is given, or it holds no pictures.
    """
    if not effort.photographs:
        raise NotMeasuredError("it needs photographs of yours: --photographs FOLDER")
    files = sorted(f for f in Path(effort.photographs).glob("*") if f.suffix.lower() in _SUFFIXES)
    pictures = [one for f in files if (one := cv2.imread(str(f), cv2.IMREAD_GRAYSCALE)) is not None]
    if not pictures:
        raise NotMeasuredError(f"no pictures in {effort.photographs}")
    finder = MarkerFinder("DICT_5X5_50")
    finds = sum(len(finder.look(frame_of(np.asarray(one, dtype=np.uint8))).ids) for one in pictures)
    yield Figure(f"finds in {len(pictures)} photographs without markers (DICT_5X5_50)", finds, "", 0)
    yield from _real_corners([np.asarray(one, dtype=np.uint8) for one in pictures])


def _real_corners(pictures: list[Image]) -> Iterator[Figure]:
    """Pose by every other corner of a chessboard, the lens by all other photographs; the miss at the rest."""
    size = max((one.shape for one in pictures), key=[one.shape for one in pictures].count)
    views = [v for one in pictures if one.shape == size and (v := _BOARD.find(one)) is not None]
    if len(views) < _LEAST_BOARDS:
        return
    squares = [_unseen(view, views[:k] + views[k + 1 :], (size[1], size[0])) for k, view in enumerate(views)]
    error = float(np.sqrt(np.mean(np.concatenate(squares))))
    yield Figure(f"overlay on real corners of {len(views)} chessboards, RMS", error, "px", 1.0)


def _unseen(view: FoundPattern, others: list[FoundPattern], size: tuple[int, int]) -> NDArray[np.float64]:
    lens = calibrate(others, size).intrinsics
    fitted = np.arange(len(view.pixels)) % 2 == 0
    _, turn, place = cv2.solvePnP(
        view.points_board[fitted], view.pixels[fitted], lens.matrix, lens.coefficients
    )
    there, _ = cv2.projectPoints(view.points_board[~fitted], turn, place, lens.matrix, lens.coefficients)
    off = np.asarray(there, dtype=float).reshape(-1, 2) - view.pixels[~fitted]
    return np.asarray((off**2).sum(axis=1), dtype=float)


def first_command(effort: Effort) -> Iterator[Figure]:
    """A picture of a robot on a board, by a new process: nothing compiled before, no display, no camera."""
    with tempfile.TemporaryDirectory() as folder:
        bare = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
        bare["XDG_CACHE_HOME"] = folder
        command = ["ar", "--seconds", "0.2", "--out", str(Path(folder) / "ar.png")]
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "robot_ik", *command],
            env=bare, cwd=folder, capture_output=True, check=False, timeout=_PATIENCE,
        )  # fmt: skip
        took = time.monotonic() - began
    yield Figure(
        "first command (robot-ik ar), nothing compiled before", took, "s", _FIRST_SECONDS, timed=True
    )
    yield Figure("its exit code", done.returncode, "", 0)
