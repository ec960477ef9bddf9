"""Cameras and network streams: a thread keeps only the newest picture, stamped when it was grabbed."""

from __future__ import annotations

import glob
import os
import re
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from robot_ik.camera.image import quiet
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.errors import CameraNotFoundError, FrameSizeError, FrameTimeoutError
from robot_ik.ports import Image

#: Whether this system lets its cameras be listed, without opening any.  macOS and Windows tell them only to
#: programs that use their own video interfaces, which OpenCV's Python wheel does not expose.
CAN_LIST = sys.platform.startswith("linux")


@dataclass(frozen=True)
class CameraDevice:
    """One video device.

    Attributes:
        index: What ``open_source`` takes as a number.
        path: Its device file.
        name: What the camera calls itself; empty where the system does not say.
        stable: A name that survives replugging, empty where there is none.
        usable: Whether this user may read and write it.
        pictures: False for a camera's further nodes, which carry its metadata and no pictures.
    """

    index: int
    path: str
    name: str
    stable: str
    usable: bool
    pictures: bool


def find_cameras(dev: str = "/dev", sys_root: str = "/sys") -> tuple[CameraDevice, ...]:
    """Video devices in the order of their numbers (Linux only; none elsewhere).

    Args:
        dev: Folder of device files.
        sys_root: Where the kernel lists their names.
    """
    if not CAN_LIST:
        return ()
    stable = {os.path.realpath(name): name for name in sorted(glob.glob(f"{dev}/v4l/by-id/*"), reverse=True)}
    cameras = []
    for path in glob.glob(f"{dev}/video*"):
        node = os.path.basename(path)
        if not re.fullmatch(r"video\d+", node):
            continue
        folder = Path(sys_root, "class/video4linux", node)
        cameras.append(
            CameraDevice(
                int(node.removeprefix("video")),
                path,
                _text_of(folder / "name"),
                stable.get(os.path.realpath(path), ""),
                os.access(path, os.R_OK | os.W_OK),
                # The kernel counts the nodes of one camera from 0, and the first is the one with pictures.
                _text_of(folder / "index") in ("", "0"),
            )
        )
    return tuple(sorted(cameras, key=lambda camera: camera.index))


def _text_of(path: Path) -> str:
    """What a file of the kernel's says; empty where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


DEFAULT_TIMEOUT = 2.0
# Opening a camera switches it on and may take seconds; a dead URL must not hang the program.
_OPEN_TIMEOUT_S = 10.0
_CLOSE_TIMEOUT_S = 1.0
# A camera drops a picture now and then; this many in a row mean that it is gone.
_FAILURES_ALLOWED = 5
_FRAME_COUNT = cv2.CAP_PROP_FRAME_COUNT


class DeviceSource(FrameSource):
    """A camera by index or path, or a stream by URL.

    ``read`` waits for a picture newer than the last one it gave, so a slow reader skips pictures and never
    works on old ones.

    Args:
        device: Index, device path or URL.
        size: (width, height) in pixels to ask for; what comes is verified.
        timeout: Seconds that ``read`` waits; None: ``DEFAULT_TIMEOUT``.
        opener: For tests: gives a ``cv2.VideoCapture`` or something with its methods.

    Attributes:
        live: False for a URL that names a film.
        label: What it is called in errors: number or path, and the name that the camera gives itself.

    Raises:
        CameraNotFoundError: It cannot be opened, or gives no first picture.
        FrameSizeError: Pictures have another size than asked for.
    """

    live = True

    def __init__(
        self,
        device: int | str,
        *,
        size: tuple[int, int] | None = None,
        timeout: float | None = None,
        opener: Callable[[], Any] | None = None,
    ) -> None:
        self.device = device
        self.label = _label(device)
        self.timeout = DEFAULT_TIMEOUT if timeout is None else timeout
        self._capture: Any = opener() if opener else _open(device)
        # A film that a server holds has a length; what is sent as it happens has none.
        is_film = isinstance(device, str) and "://" in device and self._capture.get(_FRAME_COUNT) > 0
        self.live = not is_film
        if size is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        # Fewer buffered pictures, less delay; drivers that cannot do it refuse without harm.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._news = threading.Condition()
        self._latest: Frame | None = None
        self._given = -1
        self._ended = False
        self._stop = False
        self._thread = threading.Thread(target=self._grab, name=f"camera {device}", daemon=True)
        self._thread.start()
        self._check_first(size)

    def _check_first(self, size: tuple[int, int] | None) -> None:
        with self._news:
            self._news.wait_for(lambda: self._latest is not None or self._ended, _OPEN_TIMEOUT_S)
            first = self._latest
        if first is None:
            self.close()
            raise CameraNotFoundError(
                f"camera {self.label} opens but delivers no picture",
                hint="is another program using it? Unplug it and plug it in again",
            )
        if size is not None and first.size != size:
            self.close()
            raise FrameSizeError(
                f"camera {self.label} was asked for {size[0]}x{size[1]} px and delivers "
                f"{first.size[0]}x{first.size[1]} px",
                hint="ask for a size that the camera has; the calibration must be made at that size",
            )
        self.size = first.size

    def _grab(self) -> None:
        sequence = failures = 0
        while not self._stop and failures < _FAILURES_ALLOWED:
            good, image = self._next_image()
            stamp = time.monotonic()
            if not good or image is None:
                failures += 1
                continue
            failures = 0
            with self._news:
                self._latest = Frame(image, stamp, sequence)
                self._news.notify_all()
            sequence += 1
        # Released by the thread that reads: a driver must not be closed under the feet of a waiting read().
        self._capture.release()
        with self._news:
            self._ended = True
            self._news.notify_all()

    def _next_image(self) -> tuple[bool, Image | None]:
        try:
            return self._capture.read()
        except cv2.error:
            return False, None

    def read(self) -> Frame:
        with self._news:
            self._news.wait_for(self._has_news, self.timeout)
            frame = self._latest
            if frame is not None and frame.sequence > self._given:
                self._given = frame.sequence
                return frame
            ended = self._ended
        if ended:
            raise FrameTimeoutError(
                f"camera {self.label} stopped delivering pictures after {self._given + 1}",
                hint="was it unplugged? Plug it in and open the source again; its number may have changed",
            )
        raise FrameTimeoutError(
            f"no new picture from camera {self.label} for {self.timeout:g} s",
            hint="check cable and network, or allow more time",
        )

    def newest(self) -> Frame | None:
        with self._news:
            ended = self._ended and not (self._latest and self._latest.sequence > self._given)
            if not ended and not self._has_news():
                return None
        return self.read()

    def _has_news(self) -> bool:
        return self._ended or (self._latest is not None and self._latest.sequence > self._given)

    def close(self) -> None:
        self._stop = True
        if self._thread is not threading.current_thread():
            # A read() that hangs is left behind; its thread releases the camera when it returns.
            self._thread.join(timeout=_CLOSE_TIMEOUT_S)


def _label(device: int | str) -> str:
    for camera in find_cameras():
        if device in (camera.index, camera.path, camera.stable) and camera.name:
            return f"{device} ({camera.name})"
    return str(device)


def _open(device: int | str) -> Any:
    is_url = isinstance(device, str) and "://" in device
    path = None
    if CAN_LIST and not is_url:
        path = Path(f"/dev/video{device}") if isinstance(device, int) else Path(device)
        _check_device(device, path)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(1000 * _OPEN_TIMEOUT_S)]
    limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(1000 * _OPEN_TIMEOUT_S)]
    with quiet():
        capture = cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits) if is_url else cv2.VideoCapture(device)
    if not capture.isOpened():
        capture.release()
        hint = "check the address with a browser" if is_url else _camera_hint()
        raise CameraNotFoundError(f"cannot open camera {device}", hint=hint)
    return capture


def _check_device(device: int | str, path: Path) -> None:
    if not path.exists():
        raise CameraNotFoundError(f"there is no camera {device} ({path})", hint=_camera_hint())
    if not os.access(path, os.R_OK | os.W_OK):
        raise CameraNotFoundError(
            f"no permission to use camera {device} ({path})",
            hint="add yourself to the group video and log in again",
        )


def _camera_hint() -> str:
    cameras = ", ".join(camera.path for camera in find_cameras())
    if cameras:
        return f"cameras here: {cameras}"
    return "no camera was found here; a picture, a film, a folder or a URL does as well"
