"""Cameras that misbehave: slow readers, silence, pulled plugs, other sizes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from robot_ik.camera.device import DeviceSource
from robot_ik.errors import CameraNotFoundError, FrameSizeError, FrameTimeoutError
from tests.waiting import LONG, wait_for


def picture(value: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    return np.full((size[1], size[0], 3), value, np.uint8)


class FakeCapture:
    """A camera: ``read`` blocks until a picture is put in front of it; or it runs by itself."""

    def __init__(
        self, size: tuple[int, int] = (64, 48), *, dead: bool = False, running: bool = False
    ) -> None:
        self.size = size
        self.dead = dead
        self.running = running
        self.asked: dict[int, float] = {}
        self.released = False
        self.number = 0
        self._ready = threading.Semaphore(0)

    def put(self, count: int = 1) -> None:
        for _ in range(count):
            self._ready.release()

    def set(self, key: int, value: float) -> bool:
        self.asked[key] = value
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        while not self._ready.acquire(timeout=0.02) and not self.running:
            if self.released or self.dead:
                return False, None
        self.number += 1
        return True, picture(self.number, self.size)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def capture() -> Iterator[FakeCapture]:
    fake = FakeCapture()
    fake.put()
    yield fake
    fake.dead = True
    wait_for(lambda: fake.released)


def test_a_slow_reader_gets_the_newest_picture(capture: FakeCapture) -> None:
    with DeviceSource(0, opener=lambda: capture, timeout=LONG) as source:
        assert source.read().sequence == 0
        assert source.newest() is None
        capture.put(5)
        wait_for(lambda: source._latest is not None and source._latest.sequence == 5)
        frame = source.newest()
        assert frame is not None
        assert frame.sequence == 5
        assert (frame.image == 6).all()
        assert capture.asked[cv2.CAP_PROP_BUFFERSIZE] == 1
        threading.Timer(0.05, capture.put).start()
        assert source.read().sequence == 6


def test_pictures_are_stamped_when_they_are_grabbed(capture: FakeCapture) -> None:
    with DeviceSource(0, opener=lambda: capture) as source:
        after = time.monotonic()
        time.sleep(0.1)
        assert source.read().time <= after


def test_a_silent_camera_times_out(capture: FakeCapture, real_time: None) -> None:
    with DeviceSource("/dev/cam", opener=lambda: capture, timeout=0.1) as source:
        source.read()
        with pytest.raises(
            FrameTimeoutError, match=r"no new picture from camera /dev/cam for 0.1 s"
        ):
            source.read()


def test_an_unplugged_camera_is_reported(capture: FakeCapture) -> None:
    with DeviceSource(0, opener=lambda: capture, timeout=LONG) as source:
        source.read()
        capture.dead = True
        with pytest.raises(FrameTimeoutError, match="stopped delivering"):
            source.read()
        with pytest.raises(FrameTimeoutError, match="stopped delivering"):
            source.newest()


def test_a_camera_without_pictures_is_not_opened() -> None:
    fake = FakeCapture(dead=True)
    with pytest.raises(CameraNotFoundError, match="delivers no picture"):
        DeviceSource(0, opener=lambda: fake)
    assert fake.released


def test_a_camera_with_another_size_is_refused() -> None:
    capture = FakeCapture(running=True)
    with pytest.raises(FrameSizeError, match="asked for 1280x720 px and delivers 64x48"):
        DeviceSource(0, opener=lambda: capture, size=(1280, 720))
    assert capture.asked[cv2.CAP_PROP_FRAME_WIDTH] == 1280
    assert capture.released


def test_closing_releases_the_camera() -> None:
    capture = FakeCapture(running=True)
    source = DeviceSource(0, opener=lambda: capture)
    source.close()
    source.close()
    assert capture.released
    assert not source._thread.is_alive()
