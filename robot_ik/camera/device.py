"""Cameras and network streams: a thread keeps the newest picture with the time it was taken."""

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

#: Whether cameras can be listed without opening them. macOS and Windows list them only through
#: their own video interfaces, which OpenCV's Python wheel does not expose.
CAN_LIST = sys.platform.startswith("linux")

#: Longest time that ``read`` waits for a picture, s.
DEFAULT_TIMEOUT = 2.0
# Opening a camera switches it on and may take seconds. A dead URL must not block the program.
_OPEN_TIMEOUT = 10.0
# Longest time that ``close`` waits for the thread, s.
_CLOSE_TIMEOUT = 1.0
# A camera sometimes loses a picture. After this many failures in a row it counts as disconnected.
_MAX_FAILURES = 5
_FRAME_COUNT = cv2.CAP_PROP_FRAME_COUNT


@dataclass(frozen=True)
class CameraDevice:
    """One video device.

    Attributes:
        index: Number for ``open_source``.
        path: Device file.
        name: Name of the camera by its driver; empty if unknown.
        stable: Path that survives replugging; empty if there is none.
        usable: Whether this user may read and write it.
        pictures: False for further nodes of a camera, which carry metadata and no pictures.
    """

    index: int
    path: str
    name: str
    stable: str
    usable: bool
    pictures: bool


def find_cameras(dev: str = "/dev", sys_root: str = "/sys") -> tuple[CameraDevice, ...]:
    """Return the video devices in the order of their numbers (on Linux; elsewhere none).

    Args:
        dev: Folder of device files.
        sys_root: Folder in which the kernel lists their names.
    """
    if not CAN_LIST:
        return ()
    links = sorted(glob.glob(f"{dev}/v4l/by-id/*"), reverse=True)
    stable = {os.path.realpath(link): link for link in links}
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
                # The kernel counts the nodes of a camera from 0. The first one has the pictures.
                _text_of(folder / "index") in ("", "0"),
            )
        )
    return tuple(sorted(cameras, key=lambda camera: camera.index))


def _text_of(path: Path) -> str:
    """Return the text of a kernel file; empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


class DeviceSource(FrameSource):
    """A camera by index or path, or a stream by URL.

    ``read`` waits for a picture newer than the last one that it returned, so a slow reader skips
    pictures and never gets old ones.

    Args:
        device: Index, device path or URL.
        size: (width, height) to request, px. The delivered size is verified.
        timeout: Longest time that ``read`` waits, s; None: ``DEFAULT_TIMEOUT``.
        opener: For tests: returns a ``cv2.VideoCapture`` or an object with its methods.

    Attributes:
        live: False for a URL that names a film.
        label: Name in messages: number or path, and the name of the camera.

    Raises:
        CameraNotFoundError: It cannot be opened, or delivers no first picture.
        FrameSizeError: Pictures do not have the requested size.
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
        # A film on a server has a length, a live stream has none.
        is_film = (
            isinstance(device, str) and "://" in device and self._capture.get(_FRAME_COUNT) > 0
        )
        self.live = not is_film
        if size is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        # Fewer buffered pictures give less delay. Drivers without this setting ignore it.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._changed = threading.Condition()
        self._latest: Frame | None = None
        self._last_returned = -1
        self._ended = False
        self._stop = False
        self._thread = threading.Thread(target=self._grab, name=f"camera {device}", daemon=True)
        self._thread.start()
        self._check_first(size)

    def _check_first(self, size: tuple[int, int] | None) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._latest is not None or self._ended, _OPEN_TIMEOUT)
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
                hint="request a size that the camera supports, and calibrate at that size",
            )
        self.size = first.size

    def _grab(self) -> None:
        sequence = failures = 0
        while not self._stop and failures < _MAX_FAILURES:
            success, image = self._next_image()
            stamp = time.monotonic()
            if not success or image is None:
                failures += 1
                continue
            failures = 0
            with self._changed:
                self._latest = Frame(image, stamp, sequence)
                self._changed.notify_all()
            sequence += 1
        # The reading thread releases the camera: a driver must not be closed during a read.
        self._capture.release()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _next_image(self) -> tuple[bool, Image | None]:
        try:
            return self._capture.read()
        except cv2.error:
            return False, None

    def read(self) -> Frame:
        with self._changed:
            self._changed.wait_for(self._has_new_frame, self.timeout)
            frame = self._latest
            if frame is not None and frame.sequence > self._last_returned:
                self._last_returned = frame.sequence
                return frame
            ended = self._ended
        if ended:
            raise FrameTimeoutError(
                f"camera {self.label} stopped delivering pictures after {self._last_returned + 1}",
                hint="was it unplugged? Plug it in and open it again; its number may differ",
            )
        raise FrameTimeoutError(
            f"no new picture from camera {self.label} for {self.timeout:g} s",
            hint="check cable and network, or increase the timeout",
        )

    def newest(self) -> Frame | None:
        with self._changed:
            ended = self._ended and not (
                self._latest and self._latest.sequence > self._last_returned
            )
            if not ended and not self._has_new_frame():
                return None
        return self.read()

    def _has_new_frame(self) -> bool:
        return self._ended or (
            self._latest is not None and self._latest.sequence > self._last_returned
        )

    def close(self) -> None:
        self._stop = True
        if self._thread is not threading.current_thread():
            # If a read blocks, its thread releases the camera when the read returns.
            self._thread.join(timeout=_CLOSE_TIMEOUT)


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
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(1000 * _OPEN_TIMEOUT)]
    limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(1000 * _OPEN_TIMEOUT)]
    with quiet():
        if is_url:
            capture = cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits)
        else:
            capture = cv2.VideoCapture(device)
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
        return f"available cameras: {cameras}"
    return "no camera was found; give a picture, a film, a folder or a URL instead"
