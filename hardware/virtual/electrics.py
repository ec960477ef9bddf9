"""Load on a shaft, and its cost for the motor: torque, current, voltage, heat, overload.

Torques are N m at the output shaft, positive in the direction in which the encoder counts up.
The manual gives neither how fast a servo heats nor when a load is an overload. With the constants
below, a shaft that is pressed against a stop shuts down within seconds. A lighter steady load takes
minutes, or never shuts it down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from robot_ik.hardware.registers import RADIANS_PER_TICK, TICKS_PER_REVOLUTION, Motor

ROOM_TEMPERATURE = 32.0
"""C. Temperature inside a servo without load that has been on for a while."""
HEAT_TIME = 180.0
"""s. Time constant of the temperature."""
STALL_HEAT = 150.0
"""C above the surroundings that a stalled motor reaches.

The heat is proportional to the square of the current.
"""
OVERLOAD_SHARE = 0.9
"""Share of the stall torque. More than this for longer than ``OVERLOAD_TIME`` is an overload."""
OVERLOAD_TIME = 1.0
"""s."""
PWM_FULL = 885.0
"""Count of the PWM registers at the full supply voltage (0.113 % a count)."""


@dataclass(frozen=True)
class Load:
    """Load on a shaft that no model of the arm describes.

    Attributes:
        gravity: Torque that holds the load where it weighs most, N m.
        level_ticks: Encoder ticks at which the load weighs most: a lever is level there.
        friction: Friction torque of a turning shaft, N m.
        push: Steady torque that the motor must hold in addition, N m.
    """

    gravity: float = 0.0
    level_ticks: float = TICKS_PER_REVOLUTION / 2.0
    friction: float = 0.0
    push: float = 0.0

    @classmethod
    def light(cls, motor: Motor) -> Load:
        """Return the default load: a twentieth of the stall torque."""
        return cls(gravity=0.05 * motor.stall_torque, friction=0.03 * motor.stall_torque)

    def holding(self, ticks: float) -> float:
        """Return the torque that holds the shaft at ``ticks``, N m."""
        return self.gravity * math.cos((ticks - self.level_ticks) * RADIANS_PER_TICK) + self.push


class Electrics:
    """Temperature and strain of one motor over time, and its electrical readings.

    Attributes:
        motor: The motor.
        temperature: C.
        strain: From 0 (no overload) to 1 (overloaded).
        at: Time of the last update, s.
    """

    def __init__(self, motor: Motor, now: float) -> None:
        self.motor = motor
        self.temperature = ROOM_TEMPERATURE
        self.strain = 0.0
        self.at = now

    def advance(self, now: float, torque: float, volts: float) -> None:
        """Heat and strain the motor as if ``torque`` (N m) was constant since the last call."""
        seconds = now - self.at
        self.at = now
        share = torque / self.motor.stall_torque
        final = ROOM_TEMPERATURE + STALL_HEAT * share**2
        self.temperature = final + (self.temperature - final) * math.exp(-seconds / HEAT_TIME)
        overloaded = abs(share) >= OVERLOAD_SHARE * volts / self.motor.volts
        change = seconds / OVERLOAD_TIME
        if overloaded:
            self.strain = min(1.0, self.strain + change)
        else:
            self.strain = max(0.0, self.strain - change)

    def duty(self, torque: float, speed: float, volts: float) -> float:
        """Return the PWM share, -1..1, that gives ``torque`` (N m) at ``speed`` (rad/s)."""
        share = torque / self.motor.stall_torque + speed / self.motor.no_load_speed
        return max(-1.0, min(1.0, share * self.motor.volts / max(volts, 0.1)))

    def milliamperes(self, torque: float, duty: float) -> float:
        """Return the current that Present Current measures, mA."""
        current = 1000.0 * torque / self.motor.torque_per_ampere
        return current * abs(duty) if self.motor.sensed_at_supply else current
