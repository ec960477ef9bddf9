"""From mode and goal registers to the motion that a servo wants: one function a kind of mode."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from robot_ik.hardware.families.dynamixel_x_table import (
    ACCELERATION_UNIT,
    TIME_BASED,
    VELOCITY_UNIT,
)
from robot_ik.hardware.registers import RADIANS_PER_TICK, TICKS_PER_REVOLUTION, Motor, OperatingMode
from robot_ik.hardware.virtual.memory import Memory

# ------------------------------------------------------------------------------------------
# What a shaft has to hold and what that costs the motor: torque, current, voltage, heat, overload.
#
# Torques are N m at the output shaft, positive in the direction in which the encoder counts up.
# The manual says neither how fast a servo heats nor when it calls a load an overload: by these constants a
# shaft held against its stop shuts down within seconds, under a lighter steady load in minutes or never.


ROOM_TEMPERATURE = 32.0
"""C; inside a servo that has been on for a while."""
HEAT_TIME = 180.0
"""Seconds in which a servo comes two thirds of the way to its final temperature."""
STALL_HEAT = 150.0
"""C above the surroundings that a stalled motor would reach; goes with the square of the current."""
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
    level_ticks: float = TICKS_PER_REVOLUTION / 2.0
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


# ------------------------------------------------------------------------------------------
# How a shaft gets to its goal: pieces of constant acceleration, known in closed form at any time.
#
# Positions are encoder ticks, velocities ticks/s, accelerations ticks/s^2.  Because a motion is a formula
# and not an integration, asking for the position often or rarely gives the same result.
# Source: ROBOTIS e-manual, "Profile Acceleration", "Profile Velocity" and "Moving Status" of the X series.


VELOCITY_TICKS = VELOCITY_UNIT / RADIANS_PER_TICK
"""One unit of the velocity registers, ticks/s."""
ACCELERATION_TICKS = ACCELERATION_UNIT / RADIANS_PER_TICK
"""One unit of the acceleration registers, ticks/s^2."""
PHYSICAL_ACCELERATION = 800.0 * ACCELERATION_TICKS
"""What an unloaded shaft can do, ticks/s^2 (300 rad/s^2): "unlimited" is still a motor with a rotor."""


class ProfileKind(IntEnum):
    """Bits 4-5 of Moving Status."""

    STEP = 0
    RECTANGULAR = 1
    TRIANGULAR = 2
    TRAPEZOIDAL = 3


_Piece = tuple[float, float, float, float]
"""From a time (s) on: position and velocity there, and the constant acceleration."""


def _at(piece: _Piece, t: float) -> tuple[float, float]:
    start, position, velocity, acceleration = piece
    dt = t - start
    return position + (velocity + 0.5 * acceleration * dt) * dt, velocity + acceleration * dt


class MotorMotion(NamedTuple):
    """A planned motion.

    ``pieces`` in order of time, the last one goes on for ever; ``end``: when it is over, s, infinite for
    turning at a velocity; ``kind``: as Moving Status reports it.
    """

    pieces: tuple[_Piece, ...]
    end: float
    kind: ProfileKind = ProfileKind.STEP

    def at(self, t: float) -> tuple[float, float]:
        """(position, velocity) at time ``t``, s, not before the start."""
        for piece in reversed(self.pieces):
            if t >= piece[0]:
                return _at(piece, t)
        first = self.pieces[0]
        return first[1], first[2]


def rest(t: float, position: float) -> MotorMotion:
    """Standing still."""
    return MotorMotion(((t, position, 0.0, 0.0),), t)


def brake(t: float, position: float, velocity: float, acceleration: float) -> MotorMotion:
    """Slowing down to a stand, wherever that is."""
    seconds = abs(velocity) / acceleration
    stop = position + 0.5 * velocity * seconds
    slowing = (t, position, velocity, -math.copysign(acceleration, velocity))
    return MotorMotion((slowing, (t + seconds, stop, 0.0, 0.0)), t + seconds, ProfileKind.TRIANGULAR)


def constant_velocity(
    t: float, position: float, velocity: float, wanted: float, acceleration: float
) -> MotorMotion:
    """Ramp to the ``wanted`` velocity and keep it."""
    seconds = abs(wanted - velocity) / acceleration
    ramp = (t, position, velocity, math.copysign(acceleration, wanted - velocity))
    return MotorMotion((ramp, (t + seconds, _at(ramp, t + seconds)[0], wanted, 0.0)), math.inf)


def move(
    t: float,
    position: float,
    velocity: float,
    goal: float,
    top: float,
    acceleration: float,
    kind: ProfileKind | None = None,
) -> MotorMotion:
    """The fastest motion to a stand at ``goal`` with ``|velocity| <= top`` and the given acceleration.

    A start that is faster than ``top`` first slows down to it; one that can no longer stop in time overshoots
    and comes back.

    ``top``: cruising speed, > 0; ``acceleration``: of both ramps, > 0; ``kind``: what to report, None:
    triangular or trapezoidal, as it comes out.
    """
    distance = goal - position
    spare = distance - 0.5 * velocity * abs(velocity) / acceleration
    side = math.copysign(1.0, spare)
    peak = min(top, math.sqrt(max(0.0, side * acceleration * distance + 0.5 * velocity**2)))
    cruise = side * peak
    first = abs(cruise - velocity) / acceleration
    last = peak / acceleration
    rest_of_way = distance - 0.5 * (velocity + cruise) * first - 0.5 * cruise * last
    middle = max(0.0, side * rest_of_way / peak) if peak > 0.0 else 0.0
    ramp = (t, position, velocity, math.copysign(acceleration, cruise - velocity))
    cruising = t + first
    there = _at(ramp, cruising)[0]
    braking = cruising + middle
    end = braking + last
    steady = (cruising, there, cruise, 0.0)
    slowing = (braking, there + cruise * middle, cruise, -side * acceleration)
    if kind is None:
        kind = ProfileKind.TRAPEZOIDAL if peak >= top else ProfileKind.TRIANGULAR
    return MotorMotion((ramp, steady, slowing, (end, goal, 0.0, 0.0)), end, kind)


TORQUE_MODES = (OperatingMode.CURRENT, OperatingMode.PWM)
"""Modes that give a torque or a voltage and no goal position."""

_COASTING = 0.05 * PHYSICAL_ACCELERATION


def unloaded_speed(motor: Motor, volts: float) -> float:
    """Ticks/s of a motor without a load at a supply."""
    return motor.no_load_rpm / 60.0 * TICKS_PER_REVOLUTION * volts / motor.volts


def torque_limit(memory: Memory, volts: float) -> float:
    """Largest torque that mode, limits and supply allow, N m."""
    motor = memory.table.motor
    mode = memory.values["operating_mode"]
    pwm = memory.values["pwm_limit"]
    if mode != OperatingMode.PWM:
        pwm = min(pwm, abs(memory.values["goal_pwm"]))
    limit = motor.stall_at(volts) * pwm / PWM_FULL
    if mode == OperatingMode.CURRENT_BASED_POSITION:
        amperes = abs(memory.values["goal_current"]) * memory.table.current_unit / 1000.0
        limit = min(limit, amperes * motor.torque_per_ampere)
    return limit


def effort(memory: Memory, volts: float) -> float:
    """Torque that the goal of a torque mode asks for from a standing shaft, N m, signed as its register."""
    motor = memory.table.motor
    if memory.values["operating_mode"] == OperatingMode.CURRENT:
        return memory.values["goal_current"] * memory.table.current_unit / 1000.0 * motor.torque_per_ampere
    return memory.values["goal_pwm"] / PWM_FULL * motor.stall_at(volts)


def velocity_control(now: float, position: float, velocity: float, memory: Memory, sign: int) -> MotorMotion:
    """Velocity mode: to Goal Velocity, as steeply as Profile Acceleration says (0: as the motor can)."""
    wanted = sign * memory.values["goal_velocity"] * VELOCITY_TICKS
    steepness = memory.values["profile_acceleration"]
    acceleration = steepness * ACCELERATION_TICKS
    if memory.drives(TIME_BASED):
        acceleration = abs(wanted - velocity) / (steepness / 1000.0) if steepness else 0.0
    return constant_velocity(
        now, position, velocity, wanted, min(acceleration or math.inf, PHYSICAL_ACCELERATION)
    )


def torque_control(
    now: float, position: float, velocity: float, torque: float, load: Load, memory: Memory, volts: float
) -> MotorMotion:
    """Current and PWM mode without a model of the arm: speeds up to where the motor has no torque to spare.

    ``torque``: what the motor gives at a stand, N m, in encoder direction; ``load``: taken where the motion
    begins.
    """
    motor = memory.table.motor
    stall = motor.stall_at(volts)
    net = torque - load.holding(position)
    if abs(net) <= load.friction:
        if velocity == 0.0:
            return rest(now, position)
        return constant_velocity(now, position, velocity, 0.0, _COASTING)
    net -= math.copysign(load.friction, net)
    share = net / stall
    if memory.values["operating_mode"] == OperatingMode.CURRENT:
        # The current is kept until the voltage is used up.
        share = math.copysign(max(0.0, 1.0 - abs(torque) / stall), net)
        acceleration = abs(net) / motor.stall_torque * PHYSICAL_ACCELERATION
    else:
        acceleration = PHYSICAL_ACCELERATION
    top = unloaded_speed(motor, volts)
    return constant_velocity(now, position, velocity, share * top, acceleration)


def position_control(
    now: float, position: float, velocity: float, goal: float, memory: Memory, physical_top: float
) -> MotorMotion:
    """Position modes: the motion that the profile registers ask for, within what the motor can do.

    Profile Velocity 0 is a step, Profile Acceleration 0 a rectangle: both are as steep as the motor allows.
    Time-based profiles (Drive Mode bit 2) keep their times from a stand; a new goal on the fly uses the same
    cruising speed and ramps.  ``physical_top``: speed of the motor and of Velocity Limit, ticks/s.
    """
    fastest, steepness = memory.values["profile_velocity"], memory.values["profile_acceleration"]
    if fastest == 0:
        return move(now, position, velocity, goal, physical_top, PHYSICAL_ACCELERATION, ProfileKind.STEP)
    kind = None if steepness else ProfileKind.RECTANGULAR
    top, acceleration = fastest * VELOCITY_TICKS, steepness * ACCELERATION_TICKS
    if memory.drives(TIME_BASED):
        total = fastest / 1000.0
        ramp = min(steepness / 1000.0, 0.5 * total)
        top = abs(goal - position) / (total - ramp)
        acceleration = top / ramp if ramp > 0.0 else 0.0
    # 0 is "as the motor can"; so is a time for no distance.
    top = min(top or math.inf, physical_top)
    acceleration = min(acceleration or math.inf, PHYSICAL_ACCELERATION)
    return move(now, position, velocity, goal, top, acceleration, kind)
