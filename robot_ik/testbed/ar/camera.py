"""The camera of live augmented reality: webcam, stream, video file or synthetic table."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame, FrameSource, open_source
from robot_ik.camera.synthetic.board_table import board_table
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import DEFAULT_DICTIONARY, MarkerTarget, Target, marker
from robot_ik.errors import CameraError
from robot_ik.ports import Closing
from robot_ik.testbed.ar.setup import SYNTHETIC, ArSetup

RATE_HZ = 30.0
"""Pictures a second of the synthetic camera and of recorded pictures without a rate."""

_SYNTHETIC_SIZE = (640, 480)
"""Width and height, pixels."""

_ASSUMED_VIEW = math.radians(60.0)
"""Horizontal field of view of a camera without a calibration: that of a usual webcam."""


def ball_marker(setup: ArSetup, board: Target) -> MarkerTarget | None:
    """Return the marker that is the ball, or None if keys and mouse move it.

    Raises:
        CameraError: That marker is on the board.
    """
    if setup.ball == "virtual":
        return None
    dictionary = setup.dictionary or DEFAULT_DICTIONARY
    if isinstance(board, MarkerTarget):
        dictionary = board.dictionary
        if setup.marker in board.ids:
            raise CameraError(
                f"marker {setup.marker} is on the board, so it cannot be the ball",
                hint="choose a marker that is not on the board",
            )
    return marker(setup.marker, setup.marker_size, dictionary)


class ArCamera(Closing):
    """Reads the pictures of a setup, each at its time.

    Recorded pictures come at their own rate, and begin again at their end.

    Args:
        setup: Camera, board and ball.

    Attributes:
        intrinsics: Optics of the pictures.
        note: What is assumed about the camera. Empty: nothing.

    Raises:
        CameraError: The camera cannot be opened.
        CalibrationError: The calibration cannot be read, or is for other pictures.
    """

    def __init__(self, setup: ArSetup) -> None:
        self.note = ""
        self._text = setup.camera
        self._count = 0
        self._due = time.monotonic()
        if setup.camera == SYNTHETIC:
            scene = board_table(*_SYNTHETIC_SIZE, follow=setup.ball == "marker")
            self._source: FrameSource = SyntheticSource(scene, lambda: np.zeros(0))
            self._period = 1.0 / RATE_HZ
            self.intrinsics = scene.intrinsics
            return
        self._source = open_source(setup.camera)
        rate = float(getattr(self._source, "rate_hz", RATE_HZ))
        self._period = 0.0 if self._source.live else 1.0 / rate
        try:
            self.intrinsics = self._lens(setup.intrinsics)
        except BaseException:
            self._source.close()
            raise

    def _lens(self, file: str) -> CameraIntrinsics:
        """Return the calibration of a file, or that of an assumed lens."""
        width, height = self._source.size
        if file:
            lens = CameraIntrinsics.load(Path(file))
            return lens if lens.size == (width, height) else lens.scaled(width, height)
        self.note = "no calibration: a field of view of 60° is assumed"
        focal = 0.5 * width / math.tan(0.5 * _ASSUMED_VIEW)
        return CameraIntrinsics(
            width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), (0.0,) * 5
        )

    def read(self) -> Frame:
        """Wait for the next picture and return it. Its time is on the machine's monotonic clock.

        Raises:
            CameraError: The camera gives no picture.
        """
        rest = self._due - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        self._due = max(self._due, time.monotonic() - self._period) + self._period
        if not self._source.live and self._source.exhausted:
            self._source.close()
            self._source = open_source(self._text)
        frame = self._source.read().without_truth()
        moment = frame.time if self._source.live else time.monotonic()
        self._count += 1
        return replace(frame, time=moment, sequence=self._count)

    def close(self) -> None:
        """Release the camera."""
        self._source.close()
