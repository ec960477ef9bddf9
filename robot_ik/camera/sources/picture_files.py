"""Picture files: read as the sensor saw them, written whole; and what lies beside a wrong name."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.opencv import quiet
from robot_ik.errors import CameraNotFoundError, OutputError
from robot_ik.files import write_atomically

Image = NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".ogv")


def read_image(path: Path | str) -> Image:
    """A picture file as BGR (height, width, 3) uint8, in the sensor's own orientation.

    The orientation mark of cameras (EXIF) is ignored: lens distortion belongs to the sensor's axes.

    Raises:
        CameraNotFoundError: The file is missing or no picture.
    """
    path = Path(path)
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise CameraNotFoundError(
            f"cannot read the picture {path}: {error.strerror}", hint=neighbours(path)
        ) from None
    image = None
    if data.size:
        # It raises where the header of a file says more pixels than a picture may have.
        with quiet(), contextlib.suppress(cv2.error):
            image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise CameraNotFoundError(
            f"{path} is not a picture that OpenCV can read", hint=f"usual kinds: {', '.join(IMAGE_SUFFIXES)}"
        )
    return np.asarray(image, dtype=np.uint8)


def first_size(files: Sequence[Path]) -> tuple[int, int]:
    """(width, height) of the first picture that can be read.

    Raises:
        CameraNotFoundError: None can; it is of the first one.
    """
    trouble: CameraNotFoundError | None = None
    for file in files:
        try:
            height, width = read_image(file).shape[:2]
        except CameraNotFoundError as error:
            trouble = trouble or error
        else:
            return width, height
    raise trouble or CameraNotFoundError("there are no pictures")


def natural_sort(paths: Iterable[Path]) -> list[Path]:
    """Paths sorted as people count: numbers in names by their value."""

    def key(path: Path) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", path.name.lower())
        return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts if p]

    return sorted(paths, key=lambda path: (key(path), path.name))


def neighbours(path: Path) -> str:
    """What is there beside a path that is not: the pictures and films of its folder."""
    folder = path.parent
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    known = IMAGE_SUFFIXES + VIDEO_SUFFIXES
    found = natural_sort(f for f in folder.iterdir() if f.suffix.lower() in known)
    shown = ", ".join(f.name for f in found[:8]) + (", …" if len(found) > 8 else "")
    return f"{folder} holds {shown}" if found else f"{folder} holds no pictures or films"


def write_image(path: Path, image: Image) -> None:
    """Writes a picture, whole or not at all; the suffix says how.

    Raises:
        OutputError: The suffix is none of a picture, or the folder is missing or not writable.
    """
    good, data = False, None
    if path.suffix.lower() in IMAGE_SUFFIXES:
        good, data = cv2.imencode(path.suffix.lower(), image)
    if not good or data is None:
        raise OutputError(
            f"cannot write {path}: no kind of picture ends in {path.suffix or 'nothing'!r}",
            hint=f"usual kinds: {', '.join(IMAGE_SUFFIXES)}",
        )
    write_atomically(path, np.asarray(data, dtype=np.uint8).tobytes())
