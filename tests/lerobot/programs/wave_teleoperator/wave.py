"""The teleoperator ``wave``."""

from __future__ import annotations

import math
import time
from typing import Any

from lerobot.teleoperators import Teleoperator

from wave_teleoperator.config_wave import WaveConfig

REST = {
    "shoulder_pan.pos": 0.0,
    "shoulder_lift.pos": -34.0,
    "elbow_flex.pos": 34.0,
    "wrist_flex.pos": 74.0,
    "wrist_roll.pos": 0.0,
    "gripper.pos": 50.0,
}
"""Pose about which the arm waves: degrees, and percent for the gripper."""


class Wave(Teleoperator):
    """Gives the joint positions of a sine wave."""

    config_class = WaveConfig
    name = "wave"

    def __init__(self, config: WaveConfig) -> None:
        super().__init__(config)
        self.config = config
        self._connected = False

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(REST, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_action(self) -> dict[str, Any]:
        phase = 2.0 * math.pi * time.monotonic() / self.config.period
        return {**REST, "shoulder_pan.pos": self.config.amplitude_deg * math.sin(phase)}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        pass

    def disconnect(self) -> None:
        self._connected = False
