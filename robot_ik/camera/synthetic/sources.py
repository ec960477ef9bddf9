"""Sources with a moving object in front of a synthetic camera, such as ``synthetic:orbit``.

They need no robot, camera or display. Trackers must not use the ``truth`` of the frames.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any
from urllib.parse import parse_qsl

import cv2
import numpy as np

from robot_ik.camera.drawing.prints import PRINT_MARKER
from robot_ik.camera.patterns import Pattern, PatternRequest
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.pictures import (
    STANDARD_CAMERA,
    STANDARD_SIZE,
    pattern_pose,
    render_markers,
    render_pattern,
)
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.errors import CameraNotFoundError, FrameTimeoutError, unknown_name_text
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Image

_RATE_HZ = 30.0
# Light lost from one end of the picture to the other, 0 to 1.
_GRADIENT = 0.2
# The marker of ``synthetic:orbit``.
_ORBIT_ID = 7
_ORBIT_DICTIONARY = "DICT_5X5_50"
# It swings through all tilts once in this time, s.
_ORBIT_PERIOD = 4.0
# Pictures for which a board is held in one place, so that a program can tell rest from motion.
_HELD = 3
# Upper bound of an option of a source.
_LARGEST_OPTION = 1e9

#: Pictures (height, width) uint8 without an end, each with its truth.
Pictures = Iterator[tuple[Image, dict[str, object]]]


@dataclass(frozen=True)
class MovingOptions:
    """Options that may follow the name, as in ``synthetic:orbit?frames=60&noise=8``.

    Attributes:
        frames: Pictures before the source ends.
        seed: Of noise, light and poses.
        noise: Standard deviation of the noise of the sensor, grey levels.
        blur: Standard deviation of the optical blur, px.
    """

    frames: int = 90
    seed: int = 0
    noise: float = 4.0
    blur: float = 0.7


class MovingSource(FrameSource):
    """An object that moves in front of ``STANDARD_CAMERA``: 640 x 480 px, 30 pictures a second.

    Args:
        options: Length, seed and noise.
        show: Returns the pictures.
    """

    #: Like a film, it advances only when it is read.
    live = False

    def __init__(
        self,
        options: MovingOptions,
        show: Callable[[np.random.Generator, SensorModel], Pictures],
    ) -> None:
        self.options = options
        self.size = STANDARD_CAMERA.size
        sensor = SensorModel(noise=options.noise, blur=options.blur, gradient=_GRADIENT)
        self._pictures = show(np.random.default_rng(options.seed), sensor)
        self._start = time.monotonic()
        self._count = 0

    @property
    def exhausted(self) -> bool:
        """Whether all pictures have been read."""
        return self._count >= self.options.frames

    def read(self) -> Frame:
        """Return the next picture.

        Raises:
            FrameTimeoutError: All pictures have been read.
        """
        if self.exhausted:
            count = self.options.frames
            raise FrameTimeoutError(f"the synthetic camera's {count} pictures have been read")
        index = self._count
        gray, truth = next(self._pictures)
        self._count += 1
        image = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        return Frame(image, self._start + index / _RATE_HZ, index, truth)


def open_moving(text: str) -> MovingSource:
    """Open ``synthetic:NAME?option=value&…``.

    Raises:
        CameraNotFoundError: Unknown name or option, or a value that is not a number.
    """
    name, _, query = text.removeprefix("synthetic:").partition("?")
    if name not in _SCENES:
        raise CameraNotFoundError(unknown_name_text("synthetic scene", name, list(_SCENES)))
    known = {option: type(value) for option, value in asdict(MovingOptions()).items()}
    given: dict[str, Any] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            problem = unknown_name_text("option of a synthetic source", key, list(known))
            raise CameraNotFoundError(problem)
        try:
            given[key] = known[key](value)
        except ValueError:
            problem = f"{key}={value!r} of a synthetic source must be a number"
            raise CameraNotFoundError(problem) from None
        if not 0 <= given[key] < _LARGEST_OPTION:
            problem = f"{key}={value} of a synthetic source must be from 0 to {_LARGEST_OPTION:g}"
            raise CameraNotFoundError(problem)
    return MovingSource(MovingOptions(**given), _SCENES[name])


def _orbit(rng: np.random.Generator, sensor: SensorModel) -> Pictures:
    """Show marker 7 of DICT_5X5_50, 50 mm, from all directions; truth: ``pose_camera_marker``."""
    for index in itertools.count():
        phase = 2 * np.pi * index / _RATE_HZ / _ORBIT_PERIOD
        tilt = np.deg2rad(30.0 + 15.0 * np.sin(0.37 * phase))
        tilted = Pose(wxyz=rotation_exp([tilt * np.cos(phase), tilt * np.sin(phase), 0.0]))
        depth = 0.45 + 0.12 * np.sin(0.61 * phase)
        position = (0.04 * np.sin(phase), 0.03 * np.cos(phase), depth)
        pose = Pose(position, PRINT_MARKER.compose(tilted).wxyz)
        image = render_markers(
            STANDARD_CAMERA,
            {_ORBIT_ID: (STANDARD_SIZE, pose)},
            rng,
            dictionary=_ORBIT_DICTIONARY,
            sensor=sensor,
        )
        yield image, {"pose_camera_marker": {_ORBIT_ID: pose}}


def _held_board(pattern: Pattern, rng: np.random.Generator, sensor: SensorModel) -> Pictures:
    """Show a calibration pattern at rest in one place after another; truth: its pose."""
    while True:
        pose = pattern_pose(pattern, STANDARD_CAMERA, rng)
        still = replace(sensor, noise=0.0)
        clean = render_pattern(pattern, STANDARD_CAMERA, pose, rng, still)
        for _ in range(_HELD):
            noisy = clean + rng.normal(0.0, sensor.noise, clean.shape)
            image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            yield image, {"pose_camera_board": pose}


_SCENES: dict[str, Callable[[np.random.Generator, SensorModel], Pictures]] = {
    "orbit": _orbit,
    "charuco": partial(_held_board, PatternRequest("charuco").pattern()),
    "chessboard": partial(_held_board, PatternRequest("chessboard").pattern()),
}
