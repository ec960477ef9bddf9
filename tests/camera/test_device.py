"""Cameras: the list of the machine, their settings, and reconnection."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.camera import device as device_list
from robot_ik.camera import device as device_module
from robot_ik.camera.device import DeviceSource, find_cameras
from robot_ik.errors import CameraNotFoundError, FrameTimeoutError
from tests.waiting import LONG

linux_only = pytest.mark.skipif(not device_list.CAN_LIST, reason="cameras are only listed on Linux")


@pytest.fixture
def machine(tmp_path: Path) -> tuple[str, str]:
    """Return /dev and /sys of a machine with two cameras, one with a metadata node."""
    dev = tmp_path / "dev"
    sysfs = tmp_path / "sys"
    (dev / "v4l/by-id").mkdir(parents=True)
    for number, name, index in (
        (0, "HD Webcam C920\n", "0\n"),
        (1, "HD Webcam C920\n", "1\n"),
        (10, "Cam", "0"),
    ):
        (dev / f"video{number}").touch()
        folder = sysfs / "class/video4linux" / f"video{number}"
        folder.mkdir(parents=True)
        (folder / "name").write_text(name)
        (folder / "index").write_text(index)
    (dev / "video-enc").touch()
    os.symlink(dev / "video10", dev / "v4l/by-id/usb-Cam-video-index0")
    return str(dev), str(sysfs)


@linux_only
def test_cameras_are_listed_by_number_with_their_names(machine: tuple[str, str]) -> None:
    cameras = find_cameras(*machine)
    assert [(c.index, c.name, c.pictures) for c in cameras] == [
        (0, "HD Webcam C920", True),
        (1, "HD Webcam C920", False),
        (10, "Cam", True),
    ]
    assert cameras[2].stable.endswith("usb-Cam-video-index0") and not cameras[0].stable
    assert all(c.usable for c in cameras)
    assert find_cameras("/nowhere") == ()


def test_where_cameras_cannot_be_listed_the_list_is_empty(
    machine: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_list, "CAN_LIST", False)
    assert find_cameras(*machine) == ()


class FilmCapture:
    """A ``cv2.VideoCapture`` that repeats a film until it is unplugged."""

    def __init__(self, path: Path) -> None:
        self.capture = cv2.VideoCapture(str(path))
        self.plugged = True

    def isOpened(self) -> bool:
        return self.plugged

    def set(self, key: int, value: float) -> bool:
        return False

    def get(self, key: int) -> float:
        return 0.0

    def read(self) -> tuple[bool, np.ndarray | None]:
        if not self.plugged:
            return False, None
        good, image = self.capture.read()
        if not good:
            self.capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
            good, image = self.capture.read()
        return good, image

    def release(self) -> None:
        self.capture.release()


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (64, 48))
    for i in range(5):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()
    return path


@pytest.fixture
def camera(
    machine: tuple[str, str], film: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[list[FilmCapture]]:
    """Provide camera 0 of that machine. The list receives each opened capture."""
    opened: list[FilmCapture] = []

    def open_capture(device: object, *rest: object) -> FilmCapture:
        opened.append(FilmCapture(film))
        return opened[-1]

    monkeypatch.setattr(device_module, "find_cameras", lambda: find_cameras(*machine))
    monkeypatch.setattr(device_module, "_check_device", lambda device, path: None)
    monkeypatch.setattr(cv2, "VideoCapture", _Switch(cv2.VideoCapture, open_capture))
    yield opened
    for capture in opened:
        capture.plugged = False


class _Switch:
    """Opens the simulated camera for numbers, and OpenCV's capture otherwise."""

    def __init__(self, real: type, pretended: object) -> None:
        self.real = real
        self.pretended = pretended

    def __call__(self, what: object, *rest: object) -> object:
        return self.pretended(what, *rest) if isinstance(what, int) else self.real(what, *rest)  # type: ignore[operator]


@linux_only
def test_an_unplugged_camera_is_named_and_opens_again(camera: list[FilmCapture]) -> None:
    with DeviceSource(0, timeout=LONG) as source:
        assert source.read().size == (64, 48)
        camera[0].plugged = False
        with pytest.raises(
            FrameTimeoutError, match=r"camera 0 \(HD Webcam C920\) stopped delivering"
        ) as caught:
            while True:
                source.read()
        assert "Plug it in" in caught.value.hint
    # A new source of the same camera in the same process works and counts from 0.
    with DeviceSource(0, timeout=LONG) as again:
        assert again.read().sequence >= 0
        assert len(camera) == 2


@linux_only
def test_no_permission_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "video3"
    path.touch()
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(CameraNotFoundError, match="no permission to use camera") as caught:
        device_module._check_device(3, path)
    assert "group video" in caught.value.hint
