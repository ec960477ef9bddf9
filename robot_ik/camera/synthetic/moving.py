"""Sources that move something before a synthetic camera: ``synthetic:orbit``, ``synthetic:charuco``, ….

They need no robot, camera or display.  Each frame's ``truth`` holds what tracks must not read.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from urllib.parse import parse_qsl

import cv2
import numpy as np

from robot_ik.camera.boards.patterns import Pattern, PatternRequest
from robot_ik.camera.image import Image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.datasets import (
    STANDARD_CAMERA,
    STANDARD_SIZE,
    pattern_pose,
    render_marker,
    render_pattern,
)
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.errors import CameraNotFoundError, FrameTimeoutError, unknown_name_text
from robot_ik.geometry import Pose, rotation_exp

_RATE_HZ = 30.0
#: The marker of ``synthetic:orbit``.
ORBIT_ID, ORBIT_DICTIONARY = 7, "DICT_5X5_50"
# It swings through all tilts once in so many seconds.
_ORBIT_S = 4.0
# Pictures for which a board is held in one place: what is still can be told from what moves.
_HELD = 3
_FACING = Pose.from_rotation(np.diag([1.0, -1.0, -1.0]))


@dataclass(frozen=True)
class MovingOptions:
    """What may follow the name, as in ``synthetic:orbit?frames=60&noise=8``.

    Attributes:
        frames: Pictures before the source ends.
        seed: Of noise, light and poses.
        noise: Standard deviation of the sensor's noise, grey levels.
        blur: Standard deviation of the optical blur, px.
    """

    frames: int = 90
    seed: int = 0
    noise: float = 4.0
    blur: float = 0.7


class MovingSource(FrameSource):
    """Something that moves before the camera of the standard set; 640 x 480 px, 30 pictures a second.

    Args:
        options: Length, seed and noise.

    Attributes:
        intrinsics: The camera's true ones.
    """

    #: It shows no arm and goes on only when it is read, as a film does.
    live = False

    def __init__(self, options: MovingOptions) -> None:
        self.options = options
        self.intrinsics: CameraIntrinsics = STANDARD_CAMERA
        self.size = self.intrinsics.size
        self._rng = np.random.default_rng(options.seed)
        self._sensor = replace(SensorModel(), noise=options.noise, blur=options.blur, gradient=0.2)
        self._start = time.monotonic()
        self._count = 0

    @property
    def exhausted(self) -> bool:
        return self._count >= self.options.frames

    def read(self) -> Frame:
        if self.exhausted:
            raise FrameTimeoutError(f"the synthetic camera's {self.options.frames} pictures have been read")
        index = self._count
        gray, truth = self._picture(index)
        self._count += 1
        image = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        return Frame(image, self._start + index / _RATE_HZ, index, truth)

    def _picture(self, index: int) -> tuple[Image, dict[str, object]]:
        raise NotImplementedError


class OrbitSource(MovingSource):
    """Marker 7 of DICT_5X5_50, 50 mm, seen from all round: truth ``pose_camera_marker``."""

    def _picture(self, index: int) -> tuple[Image, dict[str, object]]:
        phase = 2 * np.pi * index / _RATE_HZ / _ORBIT_S
        tilt = np.deg2rad(30.0 + 15.0 * np.sin(0.37 * phase))
        tilt_rotation = Pose(wxyz=rotation_exp([tilt * np.cos(phase), tilt * np.sin(phase), 0.0]))
        position = (0.04 * np.sin(phase), 0.03 * np.cos(phase), 0.45 + 0.12 * np.sin(0.61 * phase))
        pose = Pose(position, _FACING.compose(tilt_rotation).wxyz)
        image = render_marker(
            self.intrinsics,
            pose,
            self._rng,
            size=STANDARD_SIZE,
            dictionary=ORBIT_DICTIONARY,
            marker_id=ORBIT_ID,
            sensor=self._sensor,
        )
        return image, {"pose_camera_marker": {ORBIT_ID: pose}}


class BoardSource(MovingSource):
    """A calibration pattern held here and there for a few pictures each: truth ``pose_camera_board``."""

    def __init__(self, pattern: Pattern, options: MovingOptions) -> None:
        super().__init__(options)
        self.pattern = pattern
        self._pose = Pose()
        self._clean: Image | None = None

    def _picture(self, index: int) -> tuple[Image, dict[str, object]]:
        if self._clean is None or index % _HELD == 0:
            self._pose = pattern_pose(self.pattern, self.intrinsics, self._rng)
            still = replace(self._sensor, noise=0.0)
            self._clean = render_pattern(self.pattern, self.intrinsics, self._pose, self._rng, still)
        noisy = self._clean + self._rng.normal(0.0, self.options.noise, self._clean.shape)
        image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return image, {"pose_camera_board": self._pose}


SCENES = ("orbit", "charuco", "chessboard")


def open_moving(text: str) -> MovingSource:
    """Opens ``synthetic:NAME?option=value&…``.

    Raises:
        CameraNotFoundError: Unknown name or option, or a value that is no number.
    """
    name, _, query = text.removeprefix("synthetic:").partition("?")
    options = _options(query)
    if name == "orbit":
        return OrbitSource(options)
    if name == "charuco" or name == "chessboard":
        return BoardSource(
            PatternRequest("charuco" if name == "charuco" else "chessboard").pattern(), options
        )
    raise CameraNotFoundError(unknown_name_text("synthetic scene", name, SCENES))


def _options(query: str) -> MovingOptions:
    known = {field.name: type(getattr(MovingOptions(), field.name)) for field in fields(MovingOptions)}
    given: dict[str, float] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise CameraNotFoundError(unknown_name_text("option of a synthetic source", key, list(known)))
        try:
            given[key] = known[key](value)
        except ValueError:
            raise CameraNotFoundError(f"{key}={value!r} of a synthetic source must be a number") from None
        if not 0 <= given[key] < 1e9:
            raise CameraNotFoundError(f"{key}={value} of a synthetic source cannot be negative or endless")
    return replace(MovingOptions(), **given)  # type: ignore[arg-type]
