"""Live augmented reality in a corner of MuJoCo's window."""

from __future__ import annotations

from typing import Any

import cv2
import mujoco
import numpy as np

from robot_ik.ports import Closing
from robot_ik.testbed.ar.live import ArPicture, LiveAr
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

_SHARE = 0.5
"""Part of the width and of the height of the window that the picture may take."""


class WindowAr(Closing):
    """The camera's picture with robot 1 and the ball, in the lower right corner of a window.

    Args:
        session: The session whose first robot is drawn.
    """

    def __init__(self, session: Session) -> None:
        self._picture: ArPicture | None = None
        self._live = LiveAr(session, self._take)

    def _take(self, picture: ArPicture) -> None:
        self._picture = picture

    @property
    def is_on(self) -> bool:
        """Whether pictures are taken."""
        return self._live.is_on

    def switch(self, on: bool) -> None:
        """Take pictures, or none."""
        self._picture = None
        self._live.switch(on)

    def draw(self, viewer: Any, view: View) -> int:
        """Show the last picture in a viewer, or none. Return its width, pixels."""
        self._live.show_view(view)
        picture = self._picture
        window = viewer.viewport
        if picture is None or not self.is_on or window is None:
            viewer.clear_images()
            return 0
        height, width = picture.image.shape[:2]
        scale = min(_SHARE * window.width / width, _SHARE * window.height / height, 1.0)
        size = (max(1, round(scale * width)), max(1, round(scale * height)))
        small = cv2.resize(picture.image, size, interpolation=cv2.INTER_AREA)
        place = mujoco.MjrRect(window.width - size[0], 0, *size)
        viewer.set_images((place, np.ascontiguousarray(small[:, :, ::-1])))
        return size[0]

    @property
    def problem(self) -> str:
        """Why there is no picture. Empty: there are pictures, or none are taken."""
        return self._live.status.problem

    def close(self) -> None:
        """End the camera's thread."""
        self._live.close()
