"""Pictures of a camera for the page, taken beside the loop."""

from __future__ import annotations

import functools
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from robot_ik.ports import Closing
from robot_ik.testbed.camera_picture import CameraPicture, ReadPicture
from robot_ik.testbed.frontends.channel import Channel
from robot_ik.testbed.frontends.picture_message import packed

_log = logging.getLogger(__name__)

PERIOD = 0.25
"""Seconds between two pictures: the synthetic camera takes a quarter of a core at this rate."""

_CLOSE_LIMIT = 5.0
"""Seconds to wait for the thread to end."""

NO_SCENE = "This robot has no scene with a camera: choose tabletop_puma."
STARTING = "The first picture takes some seconds."


class CameraPictures(Closing):
    """Sends pictures to the page while they are switched on.

    Args:
        open_camera: Opens the camera, when pictures are asked for first.
        channel: Where pictures go.
    """

    def __init__(self, open_camera: Callable[[], ReadPicture], channel: Channel) -> None:
        self._open = functools.cache(open_camera)
        self._channel = channel
        self._is_on = threading.Event()
        self._over = threading.Event()
        self._count = 0
        self._thread = threading.Thread(target=self._work, name="testbed-camera", daemon=True)
        self._thread.start()

    @property
    def is_on(self) -> bool:
        """Whether pictures are taken."""
        return self._is_on.is_set()

    def switch(self, on: bool) -> None:
        """Take pictures, or none."""
        if on:
            self._say(STARTING)
            self._is_on.set()
        else:
            self._is_on.clear()
            self._say("")

    def _work(self) -> None:
        while not self._over.is_set():
            self._is_on.wait()
            if self._over.is_set():
                return
            try:
                picture = self._open()()
            except Exception as error:  # else the thread would end without a message
                _log.debug("no picture", exc_info=True)
                self._say(f"no picture: {str(error).splitlines()[0]}", error=True)
            else:
                self._show(picture)
            self._over.wait(PERIOD)

    def _show(self, picture: CameraPicture | None) -> None:
        if not self._is_on.is_set():
            return
        if picture is None:
            self._say(NO_SCENE, error=True)
            return
        self._count += 1
        self._channel.send_picture(packed(picture.image, self._count, time.time()))
        markers = [list(marker) for marker in picture.markers]
        self._say(picture.note, markers=markers)

    def _say(self, note: str, *, markers: list[Any] | None = None, error: bool = False) -> None:
        camera = {"note": note, "markers": markers or [], "error": error}
        self._channel.publish("camera", camera)

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        self._is_on.set()
        self._thread.join(_CLOSE_LIMIT)
