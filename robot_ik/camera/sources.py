"""Sources of pictures: photographs, folders, films, cameras, network streams.

``open_source`` opens a source from a text. ``Frame`` and ``FrameSource`` are defined here. Cameras
and their thread are in ``device``, computed pictures in ``synthetic``.
"""

from __future__ import annotations

import dataclasses
import importlib
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import cv2
import numpy as np

from robot_ik.camera.image import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    first_size,
    missing_path_hint,
    natural_sort,
    quiet,
    read_image,
)
from robot_ik.errors import CameraError, CameraNotFoundError, FrameSizeError, FrameTimeoutError
from robot_ik.ports import Closing, Image

# Rate of folders, and of films that do not state theirs, Hz.
_DEFAULT_RATE_HZ = 30.0
# Plausible rates of a film, Hz.
_MIN_RATE_HZ = 0.1
_MAX_RATE_HZ = 1000.0


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture.

    Attributes:
        image: (height, width, 3) uint8, BGR, raw (with lens distortion).
        time: Time at which it was taken, s, on the machine's monotonic clock. For files: time of
            opening plus position in the film.
        sequence: Number of the picture from 0. After a gap pictures were skipped.
        truth: Truth about the scene from a synthetic camera. For tests only: trackers must not read
            it; pass ``without_truth()`` to them.
    """

    image: Image
    time: float
    sequence: int
    truth: object | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return int(self.image.shape[1]), int(self.image.shape[0])

    def without_truth(self) -> Frame:
        """Return the same frame without its truth."""
        return dataclasses.replace(self, truth=None)


class FrameSource(Closing, ABC):
    """Source of pictures. It is a context manager, and an iterator up to the last picture.

    Every source states whether it is live. A wrapper has the value of the source that it wraps.
    Arms are moved and goals are predicted only with a live source.

    Attributes:
        size: (width, height) of the pictures, px.
    """

    size: tuple[int, int]

    @property
    @abstractmethod
    def live(self) -> bool:
        """Whether a picture shows the scene at the time of reading.

        False for recorded or computed pictures: photographs, folders, films, also over a network.
        """

    @abstractmethod
    def read(self) -> Frame:
        """Return the next picture, or the newest one if the source is a camera.

        Raises:
            FrameTimeoutError: No more pictures, or none in time.
        """

    def newest(self) -> Frame | None:
        """Return the newest picture without waiting, or None if there is no new one.

        Raises:
            FrameTimeoutError: No more pictures.
        """
        return self.read()

    def close(self) -> None:
        """Release the device or file. May be called twice."""

    @property
    def exhausted(self) -> bool:
        """Whether there are no more pictures."""
        return False

    def __iter__(self) -> Iterator[Frame]:
        while not self.exhausted:
            yield self.read()


class ImageSource(FrameSource):
    """One photograph: every ``read`` returns the same frame, with the same time and number."""

    live = False

    def __init__(self, path: Path | str) -> None:
        self._frame = Frame(read_image(path), time.monotonic(), 0)
        self.size = self._frame.size
        self._was_read = False

    @property
    def exhausted(self) -> bool:
        return self._was_read

    def read(self) -> Frame:
        self._was_read = True
        return self._frame


class FolderSource(FrameSource):
    """The pictures of a folder in natural order (frame2 before frame10).

    A file that is not a picture raises an error when it is read.
    """

    live = False

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise CameraNotFoundError(
                f"there is no folder {self.path}", hint=missing_path_hint(self.path)
            )
        files = [f for f in self.path.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES]
        self.files = natural_sort(files)
        if not self.files:
            kinds = f"usual kinds: {', '.join(IMAGE_SUFFIXES)}"
            raise CameraNotFoundError(f"the folder {self.path} contains no pictures", hint=kinds)
        self.size = first_size(self.files)
        self._next = 0
        self._start = time.monotonic()

    @property
    def exhausted(self) -> bool:
        return self._next >= len(self.files)

    def read(self) -> Frame:
        if self.exhausted:
            raise FrameTimeoutError(f"all {len(self.files)} pictures of {self.path} have been read")
        index = self._next
        self._next += 1
        return Frame(read_image(self.files[index]), self._start + index / _DEFAULT_RATE_HZ, index)


class VideoSource(FrameSource):
    """A film: every picture in order, as fast as it is read."""

    live = False

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise CameraNotFoundError(
                f"there is no film {self.path}", hint=missing_path_hint(self.path)
            )
        with quiet():
            self._capture: Any = cv2.VideoCapture(str(self.path))
            opened = self._capture.isOpened()
            success, image = self._capture.read() if opened else (False, None)
        if not success or image is None:
            self._capture.release()
            raise CameraNotFoundError(
                f"{self.path} is not a film that OpenCV can read",
                hint=f"usual kinds: {', '.join(VIDEO_SUFFIXES)}",
            )
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        is_plausible = _MIN_RATE_HZ < rate < _MAX_RATE_HZ
        self.rate_hz = rate if is_plausible else _DEFAULT_RATE_HZ
        self._start = time.monotonic()
        self._count = 0
        # One picture is read ahead, so that ``exhausted`` is known before the next read.
        self._lookahead: Image | None = np.asarray(image, dtype=np.uint8)
        self.size = (int(image.shape[1]), int(image.shape[0]))

    @property
    def exhausted(self) -> bool:
        return self._lookahead is None

    def read(self) -> Frame:
        image = self._lookahead
        if image is None:
            raise FrameTimeoutError(f"the film {self.path} ended after {self._count} pictures")
        frame = Frame(image, self._start + self._count / self.rate_hz, self._count)
        self._count += 1
        with quiet():
            success, following = self._capture.read()
        self._lookahead = np.asarray(following, dtype=np.uint8) if success else None
        return frame

    def close(self) -> None:
        self._lookahead = None
        self._capture.release()


def require_frame(frame: object) -> None:
    """Check that an object is a ``Frame``, not a bare picture, a path or None.

    Raises:
        CameraError: It is another object.
    """
    if not isinstance(frame, Frame):
        raise CameraError(
            f"expected a Frame, got {'None' if frame is None else type(frame).__name__}",
            hint='read one: open_source("photo.png").read(); from an array: Frame(image, 0.0, 0)',
        )


def open_source(
    text: str | int | Path,
    *,
    size: tuple[int, int] | None = None,
    timeout: float | None = None,
) -> FrameSource:
    """Open a source of pictures.

    Args:
        text: Index of a camera, path, URL or synthetic scene: ``0``, ``/dev/video0``, ``clip.mp4``,
            ``photo.jpg``, ``folder/``, ``http://…``, ``synthetic:…``.
        size: (width, height) in pixels: requested from a camera, required of every other source.
        timeout: Longest time without a new picture from a camera or stream, s.

    Raises:
        CameraNotFoundError: It cannot be opened. The hint lists what exists.
        FrameSizeError: A camera does not deliver ``size``, or a file has another one.
    """
    text = str(text).strip()
    if text.startswith("file://"):
        text = url2pathname(urlsplit(text).path)
    # A file in /dev/shm is not a device.
    is_node = text.startswith("/dev/") and not Path(text).is_file()
    if text.isdigit() or is_node or re.match(r"[a-zA-Z][a-zA-Z0-9+.-]+://", text):
        device = int(text) if text.isdigit() else text
        return _opener("device", "DeviceSource")(device, size=size, timeout=timeout)
    computed = text.startswith("synthetic:")
    source = _opener("synthetic.sources", "open_moving")(text) if computed else _open_file(text)
    if size is not None and source.size != size:
        source.close()
        raise FrameSizeError(
            f"{text} has pictures of {source.size[0]}x{source.size[1]} px, not "
            f"{size[0]}x{size[1]} px",
            hint="use the picture size of the calibration",
        )
    return source


def _opener(module: str, name: str) -> Callable[..., FrameSource]:
    """Return the function that opens another kind of source. Its module imports this one."""
    loaded = importlib.import_module(f"robot_ik.camera.{module}")
    opener: Callable[..., FrameSource] = getattr(loaded, name)
    return opener


def _open_file(text: str) -> FrameSource:
    path = Path(text).expanduser()
    if path.is_dir():
        return FolderSource(path)
    if not path.exists():
        raise CameraNotFoundError(
            f"there is no camera, file or folder {text!r}",
            hint="give a camera's index (0), picture, film, folder or URL; "
            f"{missing_path_hint(path)}",
        )
    return VideoSource(path) if path.suffix.lower() in VIDEO_SUFFIXES else ImageSource(path)
