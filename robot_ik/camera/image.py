"""Dictionaries, grey and reduced pictures, and picture files, for OpenCV 4 and 5.

OpenCV 5 returns (N, 2) and (N,) where 4.x returned (N, 1, 2) and (N, 1). Subtracting one from the
other broadcasts silently to N x N. Arrays from OpenCV are therefore reshaped.
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

# FFMPEG inside OpenCV has its own log level, which is read before the first film is opened. -8 is
# silence. A value that the user has set is kept.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

# Log level of OpenCV without messages.
_SILENT = 0
# Largest longer side of a picture for which the neighbourhood of the detectors is suitable, px.
LARGE = 3000
# Longer side of a reduced picture, px.
_REDUCED_SIZE = 2000
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".ogv")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Number of files that a hint names.
_NAMED_FILES = 8


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence the messages of OpenCV on stderr. Exceptions report the failures."""
    # Releases before 4.11 have the same two functions under another name.
    log = getattr(cv2.utils, "logging", cv2)
    before = log.getLogLevel()
    log.setLogLevel(_SILENT)
    try:
        yield
    finally:
        log.setLogLevel(before)


def dictionary_names() -> tuple[str, ...]:
    """Return the names of the predefined marker dictionaries of the installed OpenCV."""
    # OpenCV lists some names twice, as 36h11 and 36H11.
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
    """Return the number of markers of a dictionary. Ids are 0 to one less."""
    return int(marker_dictionary(name).bytesList.shape[0])


def marker_bits(name: str, marker_id: int) -> Image:
    """Return the cells (n, n) of a marker with its black border of one cell: 0 black, 255 white.

    Raises:
        CameraError: Unknown dictionary, or an id that it does not have.
    """
    dictionary = marker_dictionary(name)
    count = dictionary_size(name)
    if not 0 <= marker_id < count:
        raise CameraError(
            f"marker id {marker_id} is not in {name}", hint=f"its ids are 0 to {count - 1}"
        )
    side = int(dictionary.markerSize) + 2
    bits = cv2.aruco.generateImageMarker(dictionary, int(marker_id), side)
    return np.asarray(bits, dtype=np.uint8)


def marker_boxes(name: str, marker_id: int, size: float) -> Array:
    """Return the black cells (n, 4) of a marker.

    The columns are x, y (down), width and height from its upper left corner.

    Args:
        name: OpenCV's name of the dictionary.
        marker_id: Id in the dictionary.
        size: Side of the black border, in any unit.

    Raises:
        CameraError: Unknown dictionary, or an id that it does not have.
    """
    bits = marker_bits(name, marker_id)
    cell = size / len(bits)
    row, column = np.nonzero(bits == 0)
    sides = np.full(len(row), cell)
    return np.stack([column * cell, row * cell, sides, sides], axis=1)


def to_gray(image: Image) -> Image:
    """Return the grey picture (h, w), contiguous, of a BGR (h, w, 3) or grey (h, w) one.

    Raises:
        CameraError: It is not such a picture.
    """
    is_array = isinstance(image, np.ndarray)
    if (
        not is_array
        or image.dtype != np.uint8
        or image.ndim < 2
        or image.shape[2:] not in ((), (3,))
    ):
        given = f"{image.shape} of {image.dtype}" if is_array else type(image).__name__
        raise CameraError(
            f"expected a picture (height, width, 3) or (height, width) of uint8, got {given}",
            hint='read one: read_image("photo.png"); a Frame has one: frame.image',
        )
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def reduction_factor(image: Image) -> int:
    """Return the factor by which a picture (h, w, ...) is reduced for a search; 1: not reduced."""
    longer = max(image.shape[:2])
    return 1 if longer <= LARGE else -(-longer // _REDUCED_SIZE)


def reduced(gray: Image, times: int) -> Image:
    """Return a picture (h, w) reduced by a whole factor.

    A reduced pixel is the mean of ``times`` x ``times`` pixels, so that noise falls and edges keep
    their place. The last columns and rows that do not fill a pixel are left out.
    """
    if times == 1:
        return gray
    height = gray.shape[0] // times
    width = gray.shape[1] // times
    part = gray[: height * times, : width * times]
    small = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def to_reduced(pixels: Array, times: float) -> Array:
    """Return the pixels (..., 2) of a picture in the one reduced by ``times``.

    Whole numbers are the centres of pixels.
    """
    return (pixels + 0.5) / times - 0.5


def from_reduced(pixels: Array, times: float) -> Array:
    """Return the pixels (..., 2) of a picture in the one before it was reduced by ``times``."""
    return (pixels + 0.5) * times - 0.5


def read_image(path: Path | str) -> Image:
    """Read a picture file as BGR (height, width, 3) uint8, in the orientation of the sensor.

    The orientation mark of cameras (EXIF) is ignored: lens distortion belongs to the axes of the
    sensor.

    Raises:
        CameraNotFoundError: The file is missing or not a picture.
    """
    path = Path(path)
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise CameraNotFoundError(
            f"cannot read the picture {path}: {error.strerror}", hint=missing_path_hint(path)
        ) from None
    image = None
    if data.size and _is_complete(data.tobytes()):
        # OpenCV raises if the header states more pixels than a picture may have.
        with quiet(), contextlib.suppress(cv2.error):
            image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise CameraNotFoundError(
            f"{path} is not a picture that OpenCV can read",
            hint=f"usual kinds: {', '.join(IMAGE_SUFFIXES)}",
        )
    return np.asarray(image, dtype=np.uint8)


def _is_complete(data: bytes) -> bool:
    """Return whether a PNG is complete, with correct checksums.

    libpng writes to stderr if a PNG is damaged.
    """
    if not data.startswith(_PNG_SIGNATURE):
        return True
    at = len(_PNG_SIGNATURE)
    kind = b""
    while kind != b"IEND" and at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        kind = data[at + 4 : at + 8]
        checksum = int.from_bytes(data[end : end + 4], "big")
        if kind[:1].isupper() and zlib.crc32(data[at + 4 : end]) != checksum:
            return False
        at = end + 4
    return kind == b"IEND"


def first_size(files: Sequence[Path]) -> tuple[int, int]:
    """Return (width, height) of the first picture that can be read.

    Raises:
        CameraNotFoundError: No file can be read. The error is that of the first one.
    """
    first_error: CameraNotFoundError | None = None
    for file in files:
        try:
            height, width = read_image(file).shape[:2]
        except CameraNotFoundError as error:
            first_error = first_error or error
        else:
            return width, height
    raise first_error or CameraNotFoundError("there are no pictures")


def natural_sort(paths: Iterable[Path]) -> list[Path]:
    """Return paths sorted naturally: numbers in names by their value."""

    def key(path: Path) -> list[str | int]:
        # Text and numbers alternate.
        parts = re.split(r"(\d+)", path.name.lower())
        return [int(part) if k % 2 else part for k, part in enumerate(parts)]

    return sorted(paths, key=lambda path: (key(path), path.name))


def missing_path_hint(path: Path) -> str:
    """Return a hint for a missing path: the pictures and films of its folder."""
    folder = path.parent
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    known = IMAGE_SUFFIXES + VIDEO_SUFFIXES
    files = natural_sort(f for f in folder.iterdir() if f.suffix.lower() in known)
    where = "this folder" if folder == Path() else str(folder)
    if not files:
        return f"{where} contains no pictures or films"
    shown = ", ".join(f.name for f in files[:_NAMED_FILES])
    if len(files) > _NAMED_FILES:
        shown += ", …"
    return f"{where} contains {shown}"


def write_image(path: Path, image: Image) -> None:
    """Write a picture atomically, in the format of the suffix.

    Raises:
        OutputError: The suffix is not that of a picture, or the folder is missing or not writable.
    """
    success = False
    data = None
    if path.suffix.lower() in IMAGE_SUFFIXES:
        success, data = cv2.imencode(path.suffix.lower(), image)
    if not success or data is None:
        raise OutputError(
            f"cannot write {path}: its suffix {path.suffix!r} is not that of a picture",
            hint=f"usual kinds: {', '.join(IMAGE_SUFFIXES)}",
        )
    write_atomically(path, np.asarray(data, dtype=np.uint8).tobytes())
