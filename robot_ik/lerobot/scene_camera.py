"""LeRobot camera that draws the arm at its measured joint angles."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from numpy.typing import NDArray

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.lerobot.config_scene_camera import SceneCameraConfig
from robot_ik.ports import Array
from robot_ik.robot import Robot

BACKGROUND = 200
"""Grey level of the table and of the wall."""


class SceneCamera(Camera):
    """Draws one picture for each call, without a thread and without waiting.

    Args:
        config: Options.
        robot: Robot to draw.
        read_qpos: Returns the configuration (model.nq,) to draw.
    """

    def __init__(
        self, config: SceneCameraConfig, robot: Robot, read_qpos: Callable[[], Array]
    ) -> None:
        super().__init__(config)
        width = config.width or 0
        height = config.height or 0
        focal = 0.5 * width / math.tan(0.5 * math.radians(config.field_of_view_deg))
        center = (0.5 * (width - 1), 0.5 * (height - 1))
        self._intrinsics = CameraIntrinsics(width, height, focal, focal, *center)
        self._pose = Pose.look_at(config.position, config.look_at)
        self._drawn = DrawnRobot(robot.model, shadow=True)
        self._read_qpos = read_qpos
        self._is_connected = False

    @property
    def is_connected(self) -> bool:
        """Whether ``connect`` was called."""
        return self._is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return no cameras: a drawn camera cannot be discovered."""
        return []

    def connect(self, warmup: bool = True) -> None:  # noqa: ARG002  # of LeRobot's interface
        """Allow pictures to be read."""
        self._is_connected = True

    def read(self) -> NDArray[np.uint8]:
        """Return an RGB picture (height, width, 3) of the arm at its current joint angles."""
        width, height = self._intrinsics.size
        image = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
        self._drawn.draw(self._read_qpos(), self._intrinsics, self._pose).over(image)
        return np.ascontiguousarray(image[..., ::-1])

    def async_read(self, timeout_ms: float = 200.0) -> NDArray[np.uint8]:  # noqa: ARG002
        """Return ``read()``."""
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:  # noqa: ARG002
        """Return ``read()``."""
        return self.read()

    def disconnect(self) -> None:
        """Refuse further pictures."""
        self._is_connected = False
