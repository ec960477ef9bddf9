"""What a shaft has to hold and what that costs the motor: torque, current, voltage, heat, overload.

Torques are N m at the output shaft, positive in the direction in which the encoder counts up.
Stall torque, stall current and no load speed are the manual's (``control_table_motors``).  The manual says
neither how fast a servo heats nor when it calls a load an overload: those constants are chosen here so that a
shaft held against its stop shuts down within seconds and a lighter steady load within minutes or never.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from robot_ik.hardware.control_table import RADIANS_PER_TICK, TICKS_PER_TURN
from robot_ik.hardware.control_table_motors import Motor

ROOM_TEMPERATURE = 32.0
"""C; inside a servo that has been on for a while."""
HEAT_TIME = 180.0
"""Seconds in which a servo comes two thirds of the way to its final temperature."""
STALL_HEAT = 150.0
"""C above the room that a stalled motor would reach; goes with the square of the current."""
OVERLOAD_SHARE = 0.9
"""Of the stall torque; more than this for longer than ``OVERLOAD_TIME`` is an overload."""
OVERLOAD_TIME = 1.0
PWM_FULL = 885.0
"""PWM registers at the full supply voltage (0.113 % a count)."""


@dataclass(frozen=True)
class Load:
    """What hangs on a shaft for which no model of the arm is given.

    Attributes:
        gravity: Torque needed to hold the load where it weighs most, N m.
        level_ticks: Encoder ticks there (a lever held level).
        friction: Torque that turning costs, N m.
        push: A steady torque that the motor must hold besides, N m.
    """

    gravity: float = 0.0
    level_ticks: float = TICKS_PER_TURN / 2.0
    friction: float = 0.0
    push: float = 0.0

    @classmethod
    def light(cls, motor: Motor) -> Load:
        """What a servo carries where nothing is said: a twentieth of its stall torque."""
        return cls(gravity=0.05 * motor.stall_torque, friction=0.03 * motor.stall_torque)

    def holding(self, ticks: float) -> float:
        """Torque that holds the shaft at ``ticks``, N m."""
        return self.gravity * math.cos((ticks - self.level_ticks) * RADIANS_PER_TICK) + self.push


class Electrics:
    """Temperature and strain of one motor over time, and its electrical readings.

    Args:
        motor: Constants.
        now: Time, s.

    Attributes:
        temperature: C.
        strain: 0 fresh .. 1 overloaded.
    """

    def __init__(self, motor: Motor, now: float) -> None:
        self.motor = motor
        self.temperature = ROOM_TEMPERATURE
        self.strain = 0.0
        self.at = now

    def advance(self, now: float, torque: float, volts: float) -> None:
        """Heats and strains the motor as if ``torque`` (N m) had been there since the last call."""
        seconds, self.at = now - self.at, now
        share = torque / self.motor.stall_torque
        final = ROOM_TEMPERATURE + STALL_HEAT * share**2
        self.temperature = final + (self.temperature - final) * math.exp(-seconds / HEAT_TIME)
        overloaded = abs(share) >= OVERLOAD_SHARE * volts / self.motor.volts
        change = seconds / OVERLOAD_TIME
        self.strain = min(1.0, self.strain + change) if overloaded else max(0.0, self.strain - change)

    def duty(self, torque: float, speed: float, volts: float) -> float:
        """Share of the supply voltage, -1..1, that gives ``torque`` (N m) at ``speed`` (rad/s)."""
        share = torque / self.motor.stall_torque + speed / self.motor.no_load_speed
        return max(-1.0, min(1.0, share * self.motor.volts / max(volts, 0.1)))

    def milliamperes(self, torque: float, duty: float) -> float:
        """What Present Current measures, mA."""
        current = 1000.0 * torque / self.motor.torque_per_ampere
        return current * abs(duty) if self.motor.sensed_at_supply else current

    def stall_torque(self, volts: float) -> float:
        """N m at this supply."""
        return self.motor.stall_torque * volts / self.motor.volts
