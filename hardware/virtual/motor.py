"""Operating modes of a Dynamixel servo: from goal registers to the motion of the shaft."""

from __future__ import annotations

import math

from robot_ik.hardware.families.dynamixel_x_table import TIME_BASED
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION, Motor, OperatingMode
from robot_ik.hardware.virtual.electrics import PWM_FULL, Load
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.profiles import (
    ACCELERATION_TICKS,
    PHYSICAL_ACCELERATION,
    VELOCITY_TICKS,
    MotorMotion,
    ProfileKind,
    constant_velocity,
    move,
    rest,
)

TORQUE_MODES = (OperatingMode.CURRENT, OperatingMode.PWM)
"""Modes whose goal is a torque or a voltage and not a position."""

_COASTING = 0.05 * PHYSICAL_ACCELERATION
"""ticks/s^2. Deceleration of a shaft that friction stops."""


def unloaded_speed(motor: Motor, volts: float) -> float:
    """Return the speed of a motor without load at a supply voltage, ticks/s."""
    return motor.no_load_rpm / 60.0 * TICKS_PER_REVOLUTION * volts / motor.volts


def torque_limit(memory: Memory, volts: float) -> float:
    """Return the largest torque that mode, limits and supply allow, N m."""
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
    """Return the torque that the goal of a torque mode gives a standing shaft, N m.

    The sign is that of the goal register.
    """
    motor = memory.table.motor
    if memory.values["operating_mode"] == OperatingMode.CURRENT:
        return (
            memory.values["goal_current"]
            * memory.table.current_unit
            / 1000.0
            * motor.torque_per_ampere
        )
    return memory.values["goal_pwm"] / PWM_FULL * motor.stall_at(volts)


def velocity_control(
    now: float, position: float, velocity: float, memory: Memory, sign: int
) -> MotorMotion:
    """Return the motion of velocity mode: to Goal Velocity, with Profile Acceleration.

    Profile Acceleration 0 is the acceleration of the motor.
    """
    target = sign * memory.values["goal_velocity"] * VELOCITY_TICKS
    steepness = memory.values["profile_acceleration"]
    acceleration = steepness * ACCELERATION_TICKS
    if memory.drives(TIME_BASED):
        acceleration = abs(target - velocity) / (steepness / 1000.0) if steepness else 0.0
    return constant_velocity(
        now, position, velocity, target, min(acceleration or math.inf, PHYSICAL_ACCELERATION)
    )


def torque_control(
    now: float,
    position: float,
    velocity: float,
    torque: float,
    load: Load,
    memory: Memory,
    volts: float,
) -> MotorMotion:
    """Return the motion of current and PWM mode: speed up until the motor has no torque left.

    Args:
        now: Time, s.
        position: Encoder ticks.
        velocity: ticks/s.
        torque: Torque of the motor at a standstill, N m, in encoder direction.
        load: Load. It counts where the motion begins.
        memory: Registers.
        volts: Supply, V.
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
        # The servo keeps the current until the voltage is used up.
        share = math.copysign(max(0.0, 1.0 - abs(torque) / stall), net)
        acceleration = abs(net) / motor.stall_torque * PHYSICAL_ACCELERATION
    else:
        acceleration = PHYSICAL_ACCELERATION
    top = unloaded_speed(motor, volts)
    return constant_velocity(now, position, velocity, share * top, acceleration)


def position_control(
    now: float, position: float, velocity: float, goal: float, memory: Memory, physical_top: float
) -> MotorMotion:
    """Return the motion of the position modes, within the limits of the motor.

    Profile Velocity 0 is a step and Profile Acceleration 0 a rectangle. Both are as steep as the
    motor allows. Time-based profiles (Drive Mode bit 2) keep their times from a standstill. A new
    goal during the motion uses the same cruising speed and ramps.

    Args:
        now: Time, s.
        position: Encoder ticks.
        velocity: ticks/s.
        goal: Encoder ticks.
        memory: Registers.
        physical_top: Speed of the motor and of Velocity Limit, ticks/s.
    """
    fastest = memory.values["profile_velocity"]
    steepness = memory.values["profile_acceleration"]
    if fastest == 0:
        return move(
            now, position, velocity, goal, physical_top, PHYSICAL_ACCELERATION, ProfileKind.STEP
        )
    kind = None if steepness else ProfileKind.RECTANGULAR
    top = fastest * VELOCITY_TICKS
    acceleration = steepness * ACCELERATION_TICKS
    if memory.drives(TIME_BASED):
        total = fastest / 1000.0
        ramp = min(steepness / 1000.0, 0.5 * total)
        top = abs(goal - position) / (total - ramp)
        acceleration = top / ramp if ramp > 0.0 else 0.0
    # 0 means the limit of the motor, and so does a time for no distance.
    top = min(top or math.inf, physical_top)
    acceleration = min(acceleration or math.inf, PHYSICAL_ACCELERATION)
    return move(now, position, velocity, goal, top, acceleration, kind)
