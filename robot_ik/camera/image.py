"""The one place that knows how OpenCV 4.8+ and 5.x differ, and that keeps OpenCV quiet.

OpenCV 5 returns (N, 2) and (N,) where 4.x returned (N, 1, 2) and (N, 1); subtracting one from the other
broadcasts silently to N x N.  Everything that comes out of OpenCV is therefore reshaped here.
"""

from __future__ import annotations

import contextlib
import os
import re
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import CameraError, CameraNotFoundError, OutputError, unknown_name_text
from robot_ik.files import write_atomically
from robot_ik.ports import Array, Image

Float32 = NDArray[np.float32]
#: Pixels (x0, y0, x1, y1), half open.
Box = tuple[int, int, int, int]

# FFMPEG inside OpenCV has a log level of its own, read once, before the first film is opened; -8 is silence.
# Whoever has set it keeps what he set.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_SILENT = 0


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """OpenCV's own messages on stderr off for a while: failures are reported by our errors."""
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


def full_dictionary_name(name: str) -> str:
    """Return OpenCV's name of a dictionary: ``DICT_5X5_50`` of ``5x5_50``.

    Raises:
        CameraError: Unknown dictionary; close names are listed.
    """
    names = dictionary_names()
    wanted = name.strip().upper()
    if wanted not in names and f"DICT_{wanted}" in names:
        wanted = f"DICT_{wanted}"
    if wanted not in names:
        raise CameraError(unknown_name_text("marker dictionary", name, names))
    return wanted


def marker_dictionary(name: str) -> Any:
    """Return the predefined dictionary ``name``, for example ``DICT_5X5_50``.

    Raises:
        CameraError: Unknown dictionary; close names are listed.
    """
    wanted = full_dictionary_name(name)
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


def marker_boxes(name: str, marker_id: int, size: float) -> Array:
    """A marker's black cells (n, 4): x, y (down), width and height from its upper left corner.

    ``size`` is the side of its black border, in any unit.

    Raises:
        CameraError: Unknown dictionary, or an id beyond it.
    """
    bits = marker_bits(name, marker_id)
    cell = size / len(bits)
    row, column = np.nonzero(bits == 0)
    return np.stack([column * cell, row * cell, np.full(len(row), cell), np.full(len(row), cell)], axis=1)


# ------------------------------------------------------------------------------------------
# Pictures in a whole part of their size: a large or soft picture is searched there, and loses nothing.
#
# A reduced pixel is the mean of ``times`` x ``times`` pixels, so that noise and the place of edges are kept.


# Detectors look at so many pixels round a pixel as suits pictures of up to this longer side, px.
LARGE = 3000
_WANTED = 2000


def to_gray(image: Image) -> Image:
    """Grey (h, w), contiguous, of a BGR (h, w, 3) or grey (h, w) picture.

    Raises:
        CameraError: It is no such picture.
    """
    known = isinstance(image, np.ndarray)
    if not known or image.dtype != np.uint8 or image.ndim < 2 or image.shape[2:] not in ((), (3,)):
        found = f"{image.shape} of {image.dtype}" if known else type(image).__name__
        raise CameraError(
            f"a picture (height, width, 3) or (height, width) of uint8 is wanted, not {found}",
            hint='read one: read_image("photo.png"); a Frame has one: frame.image',
        )
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def times_smaller(image: Image) -> int:
    """How many times smaller a picture (h, w, …) is to be searched; 1: as it is."""
    longer = max(image.shape[:2])
    return 1 if longer <= LARGE else -(-longer // _WANTED)


def reduced(gray: Image, times: float) -> Image:
    """The picture (h, w) so many times smaller, without the last columns and rows that fill no pixel.

    ``times`` is whole; or 0.5, and the picture becomes larger.
    """
    if times == 1:
        return gray
    height, width = (int(n / times) for n in gray.shape)
    whole = gray[: round(height * times), : round(width * times)]
    how = cv2.INTER_AREA if times > 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(whole, (width, height), interpolation=how), dtype=np.uint8)


def to_reduced(pixels: Array, times: float) -> Array:
    """Places (…, 2) of a picture in the one that is so many times smaller, pixel centres being whole."""
    return (pixels + 0.5) / times - 0.5


def from_reduced(pixels: Array, times: float) -> Array:
    """The way back."""
    return (pixels + 0.5) * times - 0.5


# ------------------------------------------------------------------------------------------
# Picture files: read as the sensor saw them, written whole; and what lies beside a wrong name.


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
    if data.size and _is_whole(data.tobytes()):
        # It raises where the header of a file says more pixels than a picture may have.
        with quiet(), contextlib.suppress(cv2.error):
            image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise CameraNotFoundError(
            f"{path} is not a picture that OpenCV can read", hint=f"usual kinds: {', '.join(IMAGE_SUFFIXES)}"
        )
    return np.asarray(image, dtype=np.uint8)


def _is_whole(data: bytes) -> bool:
    """Whether a PNG has its chunks, with right checksums, to the end; else libpng itself writes to stderr."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return True
    at, kind = 8, b""
    while kind != b"IEND" and at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        kind, checksum = data[at + 4 : at + 8], int.from_bytes(data[end : end + 4], "big")
        if kind[:1].isupper() and zlib.crc32(data[at + 4 : end]) != checksum:
            return False
        at = end + 4
    return kind == b"IEND"


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

    def key(path: Path) -> list[str | int]:
        # Text and numbers take turns.
        parts = re.split(r"(\d+)", path.name.lower())
        return [int(part) if k % 2 else part for k, part in enumerate(parts)]

    return sorted(paths, key=lambda path: (key(path), path.name))


def neighbours(path: Path) -> str:
    """What is there beside a path that is not: the pictures and films of its folder."""
    folder = path.parent
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    known = IMAGE_SUFFIXES + VIDEO_SUFFIXES
    found = natural_sort(f for f in folder.iterdir() if f.suffix.lower() in known)
    shown = ", ".join(f.name for f in found[:8]) + (", …" if len(found) > 8 else "")
    where = "this folder" if folder == Path() else str(folder)
    return f"{where} holds {shown}" if found else f"{where} holds no pictures or films"


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
