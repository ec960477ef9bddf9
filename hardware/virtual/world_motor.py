"""One servo on a joint of a MuJoCo world: what its controller wants, and what its motor can give."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco

from robot_ik.hardware.config import JointMap
from robot_ik.hardware.control_table import RADIANS_PER_TICK, OperatingMode
from robot_ik.hardware.virtual import drive
from robot_ik.hardware.virtual.servo import VirtualServo

STIFFNESS = 60.0
"""rad/s; natural frequency with which a servo pulls its joint to the profile.  There is no integral part (the
manual's initial Position I Gain is 0): a load of a rad/s^2 leaves it 1 / STIFFNESS^2 off its goal."""
DAMPING = 1.0
"""Critical: no overshoot that the profile has not."""


class Seat(NamedTuple):
    """Where motors sit: a joint of a model.

    Attributes:
        model, data: MuJoCo's.
        at: Of the joint in qpos; ``dof``: in qvel.
        changed: Called when the joint was put elsewhere.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    at: int
    dof: int
    changed: Callable[[], None]


class Motor:
    """One servo on a joint of the world; the ``Body`` of its shaft.

    Args:
        seat: The joint.
        row: The joint by this servo.
        servo: The servo.
        start: rad (m) of the joint at first: there this shaft stands where it stands.

    Attributes:
        position, velocity, torque: Encoder ticks, ticks/s and N m at the servo's shaft, as last seen.
        gear: rad of the shaft for one of the joint (for a metre) where it stands, signed.
        strength: N m (N) at the joint, where it stood at first.
    """

    def __init__(self, seat: Seat, row: JointMap, servo: VirtualServo, start: float) -> None:
        self._seat, self._servo, self._row = seat, servo, row
        motor = servo.table.motor
        # A servo whose Drive Mode reverses it was mounted the other way round.
        self._sign = servo.shaft.sign
        self._ticks_per = self._sign * row.ticks_per(start)
        self.gear = self._ticks_per * RADIANS_PER_TICK
        self.strength = motor.stall_torque * abs(self.gear)
        self._no_load, self._stall = motor.no_load_speed, motor.stall_torque
        self.position = servo.shaft.encoder
        self.velocity = self.torque = 0.0
        # Where two shafts do not agree at first, they are coupled as they stand.
        self._zero = self.position + servo.zero_offset_ticks - self._sign * row.position(start)

    @property
    def stuck(self) -> bool:
        """Broken, or held fast."""
        shaft = self._servo.shaft
        return shaft.stuck_at is not None or shaft.stops[0] == shaft.stops[1]

    @property
    def stops(self) -> tuple[float, float]:
        """Joint values between which its shaft can turn."""
        low, high = sorted(self._angle(ticks) for ticks in self._servo.shaft.stops)
        return low, high

    def attach(self) -> None:
        """From here on the joint moves the shaft."""
        self._servo.shaft.stop()
        self._servo.shaft.body = self

    def look(self) -> None:
        """What the encoder says now."""
        data = self._seat.data
        angle = float(data.qpos[self._seat.at])
        self._ticks_per = self._sign * self._row.ticks_per(angle)  # of a swing arm it depends on the place
        self.gear = self._ticks_per * RADIANS_PER_TICK
        self.position = self._zero + self._sign * self._row.position(angle) - self._servo.zero_offset_ticks
        self.velocity = float(data.qvel[self._seat.dof]) * self._ticks_per

    def turn_by(self, ticks: float) -> None:
        """Somebody turns the joint by hand."""
        seat = self._seat
        seat.data.qpos[seat.at] = self._angle(self.position + ticks)
        seat.data.qvel[seat.dof] = 0.0
        mujoco.mj_forward(seat.model, seat.data)
        seat.changed()

    def wanted(self, t: float) -> float | None:
        """Acceleration that its controller wants, rad/s^2 (m/s^2) at the joint; None where it wants none."""
        servo, data = self._servo, self._seat.data
        servo.controller.watch(t)
        shaft = servo.shaft
        if not shaft.powered or servo.memory.get("operating_mode") in drive.TORQUE_MODES:
            return None
        position, velocity = shaft.motion.at(t)
        q, dq = float(data.qpos[self._seat.at]), float(data.qvel[self._seat.dof])
        error = self._angle(position) - q
        if servo.memory.get("operating_mode") == OperatingMode.VELOCITY:
            most = 0.1 * self._row.lever  # it minds its speed, not how far it has fallen behind
            error = max(-most, min(most, error))
        rate = velocity / self._ticks_per - dq
        return STIFFNESS**2 * error + 2.0 * DAMPING * STIFFNESS * rate

    def push(self, wish: float) -> float:
        """N m (N) at the joint: ``wish`` within what the motor can do and is allowed to."""
        servo = self._servo
        shaft = servo.shaft
        if not shaft.powered or shaft.stuck_at is not None:
            self.torque = 0.0
            return 0.0
        volts = shaft.volts
        stall = self._stall * volts / servo.table.motor.volts
        # The faster it turns, the less torque the voltage that is left can give.
        speed = float(self._seat.data.qvel[self._seat.dof]) * self.gear
        lost = stall * speed / (self._no_load * volts / servo.table.motor.volts)
        limit = drive.torque_limit(servo.memory, volts)
        mode = servo.memory.get("operating_mode")
        torque = wish / self.gear
        if mode in drive.TORQUE_MODES:
            torque = shaft.sign * drive.effort(servo.memory, volts)
            torque -= lost if mode == OperatingMode.PWM else 0.0
            limit = stall
        torque = max(-limit, min(limit, torque))
        self.torque = max(min(-stall - lost, 0.0), min(max(stall - lost, 0.0), torque))
        return self.torque * self.gear

    def outside(self) -> float:
        """N m (N) at the joint by the fault ``push``."""
        return -self._servo.shaft.load.push * self.gear

    def _angle(self, ticks: float) -> float:
        return self._row.to_radians(self._sign * (ticks + self._servo.zero_offset_ticks - self._zero))
