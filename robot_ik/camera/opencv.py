"""The one place that knows how OpenCV 4.8+ and 5.x differ, and that keeps OpenCV quiet.

OpenCV 5 returns (N, 2) and (N,) where 4.x returned (N, 1, 2) and (N, 1); subtracting one from the other
broadcasts silently to N x N.  Everything that comes out of OpenCV is therefore reshaped here.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import CameraError, unknown_name_text

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

VERSION: tuple[int, int] = tuple(int(v) for v in re.findall(r"\d+", cv2.__version__)[:2])  # type: ignore[assignment]

# FFMPEG inside OpenCV has a log level of its own, read once, before the first film is opened; -8 is silence.
# Whoever has set it keeps what he set.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_SILENT = 0


@contextmanager
def quiet() -> Iterator[None]:
    """OpenCV's own messages on stderr off for a while: failures are told by our errors."""
    # Releases before 4.11 have the same two functions under another name.
    log = getattr(cv2.utils, "logging", cv2)
    before = log.getLogLevel()
    log.setLogLevel(_SILENT)
    try:
        yield
    finally:
        log.setLogLevel(before)


def dictionary_names() -> tuple[str, ...]:
    """Names of the predefined marker dictionaries of the installed OpenCV."""
    # Upper case throughout: OpenCV has some names twice, as 36h11 and 36H11.
    return tuple(sorted({name.upper() for name in dir(cv2.aruco) if name.startswith("DICT_")}))


def marker_dictionary(name: str) -> Any:
    """The predefined dictionary ``name``, for example ``DICT_5X5_50``.

    Raises:
        CameraError: No such dictionary; the close names are listed.
    """
    names = dictionary_names()
    wanted = name.strip().upper()
    if wanted not in names and f"DICT_{wanted}" in names:
        wanted = f"DICT_{wanted}"
    if wanted not in names:
        raise CameraError(unknown_name_text("marker dictionary", name, names))
    number = next(getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.upper() == wanted)
    return cv2.aruco.getPredefinedDictionary(number)


def dictionary_size(name: str) -> int:
    """Number of markers in the dictionary ``name``; ids run from 0 to one less."""
    return int(marker_dictionary(name).bytesList.shape[0])


def marker_bits(name: str, marker_id: int) -> Image:
    """Cells (n, n) of a marker with its one-cell black border, 0 black and 255 white.

    Raises:
        CameraError: Unknown dictionary, or an id beyond it.
    """
    dictionary = marker_dictionary(name)
    count = dictionary_size(name)
    if not 0 <= marker_id < count:
        raise CameraError(f"marker id {marker_id} is not in {name}", hint=f"its ids are 0 to {count - 1}")
    side = int(dictionary.markerSize) + 2
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, int(marker_id), side), dtype=np.uint8)


def detect_markers(detector: Any, gray: Image) -> list[tuple[int, Array]]:
    """Runs a ``cv2.aruco.ArucoDetector``: pairs of id and corners (4, 2), float64 pixels."""
    corners, ids, _ = detector.detectMarkers(gray)
    if ids is None or len(corners) == 0:
        return []
    numbers = np.asarray(ids).reshape(-1)
    return [(int(i), np.asarray(c, dtype=float).reshape(4, 2)) for i, c in zip(numbers, corners, strict=True)]


def square_poses(points: Array, ideal: Array) -> list[tuple[list[float], list[float]]]:
    """Both poses of a square seen in undistorted normalised coordinates (IPPE_SQUARE).

    Args:
        points: (4, 3) metres, in the order (-,+) (+,+) (+,-) (-,-), z = 0.
        ideal: (4, 2) undistorted normalised coordinates.

    Returns:
        Up to two pairs of rotation vector (3,) and translation (3,), best first; empty when the four corners
        are degenerate.
    """
    try:
        found, rotations, translations, _ = cv2.solvePnPGeneric(
            points, np.ascontiguousarray(ideal), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:
        return []
    if not found:
        return []
    poses = []
    for vector, shift in zip(rotations, translations, strict=True):
        turn, translation = np.ravel(vector).tolist(), np.ravel(shift).tolist()
        if all(map(math.isfinite, turn + translation)):
            poses.append((turn, translation))
    return poses
