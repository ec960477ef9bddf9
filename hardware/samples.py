"""The last good sample of every joint, how old it is, and who has been silent for too long."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robot_ik.hardware.bus import Status
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array

SILENCE = 0.15
"""s without a sample after which a servo counts as lost; with the cycle in which that shows, under 250 ms."""

SILENT_CYCLES = 3
"""Cycles in a row a servo must have missed as well: a program that paused is no fault of a servo."""


class Samples:
    """Measured positions of an arm.

    Attributes:
        ticks: Servo id -> last present position.
        q: (n,) the same in rad at the joints; NaN before the first sample.
        times: (n,) when each was taken, s on the arm's clock.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._config = config
        self.ticks: dict[int, int] = {}
        self.q: Array = np.full(len(config.joints), np.nan)
        self.times: Array = np.full(len(config.joints), -np.inf)
        self._missed = [0] * len(config.joints)

    def take(self, statuses: Mapping[int, Status], now: float) -> None:
        """Takes what a cycle brought; who is missing keeps its old sample."""
        for k, joint in enumerate(self._config.joints):
            ticks = statuses[joint.id].data
            if ticks is None:
                self._missed[k] += 1
                continue
            self._missed[k] = 0
            self.ticks[joint.id] = ticks
            self.q[k] = joint.to_radians(ticks)
            self.times[k] = now

    def silent(self, now: float) -> list[str]:
        """Joints that have not answered for ``SILENCE`` and ``SILENT_CYCLES``."""
        return [
            joint.name
            for k, joint in enumerate(self._config.joints)
            if self._missed[k] >= SILENT_CYCLES and now - self.times[k] >= SILENCE
        ]
