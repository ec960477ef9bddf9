"""The last good sample of every servo, how old it is, and who has been silent for too long."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import TICKS_PER_REVOLUTION
from robot_ik.hardware.joint_map import JointMap
from robot_ik.ports import Array

SILENCE = 0.13
"""s without a sample after which a servo is asked by itself, three times.  It shows in the next cycle (0.14 s
after the last reply, at 100 Hz); without a reply it is given up 0.14 s later at 1 Mbit/s."""

SILENT_CYCLES = 3
"""Cycles in a row a servo must have missed as well: a program that paused is no fault of a servo."""

TWIST = 0.1
"""rad (of a slide's pinion) between the two servos of one joint beyond which they fight, or one slips."""


class Samples:
    """Measured positions of an arm.

    Attributes:
        ticks: Servo id -> last present position.
        q: (n,) the same in rad at the joints, by their first servos; NaN before the first sample.
        times: (n,) when each was taken, s on the arm's clock: of two servos the older one.
        jumped: Servo id -> ticks before it jumped further than it can have moved.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._servos = config.servos
        self._joints = len(config.joints)
        self._twins = [
            (k, config.names.index(servo.name)) for k, servo in enumerate(self._servos) if k >= self._joints
        ]
        self._speeds = [
            config.velocity[config.names.index(servo.name)] * servo.ticks_per_unit for servo in self._servos
        ]
        self.ticks: dict[int, int] = {}
        self.jumped: dict[int, int] = {}
        self._angles = np.full(len(self._servos), np.nan)
        self._times = np.full(len(self._servos), -np.inf)
        self._missed = [0] * len(self._servos)

    @property
    def q(self) -> Array:
        return self._angles[: self._joints]

    @property
    def times(self) -> Array:
        times = self._times[: self._joints]
        if self._twins:
            times = times.copy()
            for k, joint in self._twins:
                times[joint] = min(times[joint], self._times[k])
        return times

    def begin(self, ticks: Mapping[int, int], now: float) -> None:
        """The arm had no torque until here: a hand may have turned it since the last sample."""
        self.ticks.clear()
        self.jumped.clear()
        self.take(ticks, now)

    def take(self, ticks: Mapping[int, int | None], now: float) -> None:
        """Takes what a cycle brought (servo id -> ticks); who is missing keeps its old sample."""
        for k, servo in enumerate(self._servos):
            value = ticks[servo.id]
            if value is None:
                self._missed[k] += 1
                continue
            self._missed[k] = 0
            before = self.ticks.get(servo.id, value)
            if abs(value - before) > TICKS_PER_REVOLUTION / 2 + self._speeds[k] * (now - self._times[k]):
                self.jumped.setdefault(servo.id, before)
            self.ticks[servo.id] = value
            self._angles[k] = servo.to_radians(value)
            self._times[k] = now

    def age(self, servo: JointMap, now: float) -> float:
        """s since the last sample of a servo; infinite before the first."""
        return float(now - self._times[self._servos.index(servo)])

    def silent(self, now: float) -> list[JointMap]:
        """Servos that have not answered for ``SILENCE`` and ``SILENT_CYCLES``."""
        return [
            servo
            for k, servo in enumerate(self._servos)
            if self._missed[k] >= SILENT_CYCLES and now - self._times[k] >= SILENCE
        ]

    def twisted(self) -> JointMap | None:
        """A servo that stands more than ``TWIST`` apart from the other one of its joint."""
        for k, joint in self._twins:
            servo = self._servos[k]
            if abs(self._angles[k] - self._angles[joint]) > TWIST * servo.lever_at(self._angles[joint]):
                return servo
        return None
