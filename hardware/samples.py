"""Measured motion of an arm, and the silent, jumping and twisted servos that it shows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import TWIST, Drive
from robot_ik.ports import Array

SILENCE = 0.13
"""s without a sample after which a servo is read alone, three times.

At 100 Hz the next cycle notices it, 0.14 s after the last reply.  Without a reply the servo is
given up 0.11 s later at 1 Mbit/s.  ``tests/hardware/test_times.py`` measures both times.
"""

SILENT_CYCLES = 3
"""Cycles in a row that a silent servo must have missed as well.

They distinguish a silent servo from a program that paused.
"""

NO_VELOCITIES: Mapping[int, float] = {}
"""Samples whose velocities were not read."""

HALF_REVOLUTION = TICKS_PER_REVOLUTION / 2
"""Ticks.  A reading that changes by more is another revolution, unless the servo moved so far."""


class Samples:
    """Measured positions and velocities of an arm.

    Args:
        config: Arm file.

    Attributes:
        ticks: Servo id -> last present position.
        jumped: Servo id -> ticks before it jumped further than it can have moved.
    """

    def __init__(self, config: ArmConfig) -> None:
        self.ticks: dict[int, int] = {}
        self.jumped: dict[int, int] = {}
        self._drives = config.drives
        self._joint_count = len(config.joints)
        # (row of a second servo, row of its joint)
        self._twins = [
            (row, config.names.index(drive.name))
            for row, drive in enumerate(self._drives)
            if row >= self._joint_count
        ]
        # Largest speed of each servo, tick/s.
        self._speeds = [drive.joint.velocity * drive.joint.ticks_per_unit for drive in self._drives]
        self._values = np.full(len(self._drives), np.nan)
        # Joint velocity by each servo, rad/s or m/s.
        self._velocities = np.full(len(self._drives), np.nan)
        self._times = np.full(len(self._drives), -np.inf)
        self._missed = [0] * len(self._drives)

    @property
    def q(self) -> Array:
        """(n,) joint values, rad or m, by the servos that measure the joints.

        NaN before the first sample.
        """
        return self._values[: self._joint_count]

    @property
    def dq(self) -> Array:
        """(n,) joint velocities, rad/s or m/s, by the servos that measure the joints.

        NaN before the first sample that has a velocity.
        """
        return self._velocities[: self._joint_count]

    @property
    def times(self) -> Array:
        """(n,) time of each sample, s on the arm's clock; of two servos the older one."""
        times = self._times[: self._joint_count]
        if self._twins:
            times = times.copy()
            for row, joint in self._twins:
                times[joint] = min(times[joint], self._times[row])
        return times

    def begin(
        self, ticks: Mapping[int, int], now: float, velocities: Mapping[int, float] = NO_VELOCITIES
    ) -> None:
        """Take the first samples of an arm without torque.

        A hand may have turned the arm since the last sample, so a jump means nothing.

        Args:
            ticks: Servo id -> present position.
            now: Time of the samples, s.
            velocities: As of ``take``.
        """
        self.ticks.clear()
        self.jumped.clear()
        self.take(ticks, now, velocities)

    def take(
        self,
        ticks: Mapping[int, int | None],
        now: float,
        velocities: Mapping[int, float | None] = NO_VELOCITIES,
    ) -> None:
        """Take the samples of a cycle.  A servo without one keeps its old sample.

        Args:
            ticks: Servo id -> present position.
            now: Time of the samples, s.
            velocities: Servo id -> velocity of the shaft, rad/s, positive if the ticks increase.  A
                servo without one keeps its old velocity.
        """
        for row, drive in enumerate(self._drives):
            id = drive.servo.id
            value = ticks[id]
            if value is None:
                self._missed[row] += 1
                continue
            self._missed[row] = 0
            before = self.ticks.get(id, value)
            excess = abs(value - before) - HALF_REVOLUTION
            if excess > 0.0 and excess > self._speeds[row] * (now - self._times[row]):
                self.jumped.setdefault(id, before)
            self.ticks[id] = value
            joint_value = drive.joint.value(value, drive.servo)
            self._values[row] = joint_value
            self._times[row] = now
            velocity = velocities.get(id)
            if velocity is not None:
                shaft_velocity = drive.servo.direction * velocity
                self._velocities[row] = shaft_velocity * drive.joint.gear.lever(joint_value)

    def age(self, drive: Drive, now: float) -> float:
        """Return the time in s since the last sample of a servo; infinite before the first."""
        return float(now - self._times[self._drives.index(drive)])

    def silent(self, now: float) -> list[Drive]:
        """Return the servos that have not answered for ``SILENCE`` and ``SILENT_CYCLES``."""
        return [
            drive
            for row, drive in enumerate(self._drives)
            if self._missed[row] >= SILENT_CYCLES and now - self._times[row] >= SILENCE
        ]

    def twisted(self) -> Drive | None:
        """Return a servo that stands more than ``TWIST`` apart from the other one of its joint."""
        for row, joint in self._twins:
            drive = self._drives[row]
            value = self._values[joint]
            if abs(self._values[row] - value) > TWIST * drive.joint.lever_at(value):
                return drive
        return None
