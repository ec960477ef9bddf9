"""Which writes a servo refuses because of its other registers."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from robot_ik.hardware.control_table import OperatingMode, Register
from robot_ik.hardware.control_table_data import TIME_BASED
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.protocol2 import ErrorCode

TRIPPED = -1
"""What Bus Watchdog reads once it has tripped."""

_LONGEST_RAMP = 32_737  # ms; Profile Acceleration of a time-based profile


Rule = Callable[[Memory, str, int], ErrorCode]


def check_write(memory: Memory, register: Register, value: int) -> ErrorCode:
    """The error of writing ``value``; sizes, access and the register's own range are checked before."""
    rule = _RULES.get(register.name)
    return rule(memory, register.name, value) if rule is not None else ErrorCode.NONE


def _tripped(memory: Memory) -> bool:
    return memory.values.get("bus_watchdog") == TRIPPED


def _watchdog(memory: Memory, name: str, value: int) -> ErrorCode:
    return ErrorCode.DATA_RANGE if _tripped(memory) and value else ErrorCode.NONE


def _mode(memory: Memory, name: str, value: int) -> ErrorCode:
    return ErrorCode.NONE if value in memory.table.modes else ErrorCode.DATA_RANGE


def _drive_mode(memory: Memory, name: str, value: int) -> ErrorCode:
    return ErrorCode.DATA_RANGE if value & ~memory.table.drive_bits else ErrorCode.NONE


def _ramp(memory: Memory, name: str, value: int) -> ErrorCode:
    time_based = memory.values.get("drive_mode", 0) & TIME_BASED
    return ErrorCode.DATA_RANGE if time_based and value > _LONGEST_RAMP else ErrorCode.NONE


def _position(memory: Memory, name: str, value: int) -> ErrorCode:
    if _tripped(memory):
        return ErrorCode.DATA_RANGE
    values = memory.values
    one_turn = values["operating_mode"] == OperatingMode.POSITION
    if one_turn and not values["min_position_limit"] <= value <= values["max_position_limit"]:
        return ErrorCode.DATA_LIMIT
    return ErrorCode.NONE


def _limited(memory: Memory, name: str, value: int) -> ErrorCode:
    if _tripped(memory):
        return ErrorCode.DATA_RANGE
    limit = memory.get(name.removeprefix("goal_") + "_limit")
    return ErrorCode.NONE if abs(value) <= limit else ErrorCode.DATA_LIMIT


_RULES: Mapping[str, Rule] = {
    "bus_watchdog": _watchdog,
    "operating_mode": _mode,
    "drive_mode": _drive_mode,
    "profile_acceleration": _ramp,
    "goal_position": _position,
    "goal_velocity": _limited,
    "goal_current": _limited,
    "goal_pwm": _limited,
}
