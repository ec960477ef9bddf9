"""From mode and goal registers to the motion that a servo wants: one function a kind of mode."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from robot_ik.hardware.control_table import OperatingMode
from robot_ik.hardware.control_table_data import TIME_BASED
from robot_ik.hardware.virtual.load import PWM_FULL
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.profile import (
    ACCELERATION_TICKS,
    PHYSICAL_ACCELERATION,
    VELOCITY_TICKS,
    Motion,
    profiled_move,
    rest,
    turn,
)

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.load import Load

_CURRENT_UNITS = {"1 mA": 1.0, "2.69 mA": 2.69}

TORQUE_MODES = (OperatingMode.CURRENT, OperatingMode.PWM)
"""Modes that give a torque or a voltage and no place to be."""


def current_unit(memory: Memory) -> float:
    """mA a count of the current registers; 0 where the model has none."""
    return _CURRENT_UNITS[memory.table["goal_current"].unit] if "goal_current" in memory.table else 0.0


def torque_limit(memory: Memory, volts: float) -> float:
    """Largest torque that mode, limits and supply allow, N m."""
    motor = memory.table.motor
    mode = memory.get("operating_mode")
    pwm = memory.get("pwm_limit")
    if mode != OperatingMode.PWM:
        pwm = min(pwm, abs(memory.get("goal_pwm")))
    limit = motor.stall_torque * volts / motor.volts * pwm / PWM_FULL
    if mode == OperatingMode.CURRENT_BASED_POSITION:
        amperes = abs(memory.get("goal_current")) * current_unit(memory) / 1000.0
        limit = min(limit, amperes * motor.torque_per_ampere)
    return limit


def effort(memory: Memory, volts: float) -> float:
    """Torque that the goal of a torque mode asks for from a standing shaft, N m, signed as its register."""
    motor = memory.table.motor
    if memory.get("operating_mode") == OperatingMode.CURRENT:
        return memory.get("goal_current") * current_unit(memory) / 1000.0 * motor.torque_per_ampere
    return memory.get("goal_pwm") / PWM_FULL * motor.stall_torque * volts / motor.volts


def turning(now: float, position: float, velocity: float, memory: Memory, sign: int) -> Motion:
    """Velocity mode: to Goal Velocity, as steeply as Profile Acceleration says (0: as the motor can)."""
    wanted = sign * memory.get("goal_velocity") * VELOCITY_TICKS
    steepness = memory.get("profile_acceleration")
    acceleration = steepness * ACCELERATION_TICKS
    if memory.values.get("drive_mode", 0) & TIME_BASED:
        acceleration = abs(wanted - velocity) / (steepness / 1000.0) if steepness else 0.0
    return turn(now, position, velocity, wanted, min(acceleration or math.inf, PHYSICAL_ACCELERATION))


def pushed(
    now: float, position: float, velocity: float, torque: float, load: Load, memory: Memory, volts: float
) -> Motion:
    """Current and PWM mode without a model of the arm: speeds up to where the motor has no torque to spare.

    Args:
        now: s.
        position: Encoder ticks.
        velocity: Ticks/s.
        torque: What the motor gives at a stand, N m, in encoder direction.
        load: What it works against; taken where the motion begins.
        memory: Registers.
        volts: Supply.
    """
    motor = memory.table.motor
    stall = motor.stall_torque * volts / motor.volts
    net = torque - load.holding(position)
    if abs(net) <= load.friction:
        return rest(now, position) if velocity == 0.0 else turn(now, position, velocity, 0.0, _coasting())
    net -= math.copysign(load.friction, net)
    share = net / stall
    if memory.get("operating_mode") == OperatingMode.CURRENT:
        # The current is kept until the voltage is used up.
        share = math.copysign(max(0.0, 1.0 - abs(torque) / stall), net)
        acceleration = abs(net) / motor.stall_torque * PHYSICAL_ACCELERATION
    else:
        acceleration = PHYSICAL_ACCELERATION
    top = motor.no_load_rpm / 60.0 * 4096.0 * volts / motor.volts
    return turn(now, position, velocity, share * top, acceleration)


def _coasting() -> float:
    return 0.05 * PHYSICAL_ACCELERATION


def moving(
    now: float, position: float, velocity: float, goal: float, memory: Memory, physical_top: float
) -> Motion:
    """Position modes: the profile that the registers ask for.

    Args:
        now: s.
        position: Encoder ticks.
        velocity: Ticks/s.
        goal: Encoder ticks.
        memory: Registers.
        physical_top: Speed of the motor and of Velocity Limit, ticks/s.
    """
    return profiled_move(
        now,
        position,
        velocity,
        goal,
        profile_velocity=memory.get("profile_velocity"),
        profile_acceleration=memory.get("profile_acceleration"),
        time_based=bool(memory.values.get("drive_mode", 0) & TIME_BASED),
        physical_top=physical_top,
    )
