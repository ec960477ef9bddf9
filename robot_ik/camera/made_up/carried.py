"""The synthetic camera on the arm's hand: it moves with the joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.made_up.synthetic import SyntheticScene, SyntheticSource
from robot_ik.camera.sources import ClosingSource, Frame
from robot_ik.geometry import Pose
from robot_ik.ports import Clock

Array = NDArray[np.float64]


class CarriedSource(ClosingSource):
    """Photographs of a ``SyntheticScene`` by a camera that a frame of the robot carries.

    Each picture is of a new stage, so it takes longer than with a camera that stands.

    Args:
        scene: What to look at; its ``pose_world_camera`` is not used.
        frame: Of the robot, which carries the camera.
        pose_frame_camera: Where on it.
        true_q: Where the robot really is, (nq,).
        seed: Of the sensor noise.
        clock: As for ``SyntheticSource``.
        quality: Likewise.
    """

    live = True

    def __init__(
        self,
        scene: SyntheticScene,
        frame: str,
        pose_frame_camera: Pose,
        true_q: Callable[[], Array],
        *,
        seed: int = 0,
        clock: Clock | None = None,
        quality: Literal["full", "fast"] = "fast",
    ) -> None:
        self.scene, self.frame, self.pose_frame_camera = scene, frame, pose_frame_camera
        self.size = scene.intrinsics.size
        self._true_q, self._seed, self._clock, self._quality = true_q, seed, clock, quality
        self._sequence = 0

    def read(self) -> Frame:
        """Takes the next picture, with the truth of ``SyntheticSource``."""
        q = np.array(self._true_q(), dtype=float)
        pose = self.scene.robot.forward(q, self.frame).compose(self.pose_frame_camera)
        source = SyntheticSource(
            replace(self.scene, pose_world_camera=pose), lambda: q,
            seed=1000 * self._seed + self._sequence, clock=self._clock, quality=self._quality,
        )  # fmt: skip
        frame = replace(source.read(), sequence=self._sequence)
        self._sequence += 1
        return frame
