"""Which writes a servo refuses because of its other registers."""

from __future__ import annotations

from robot_ik.hardware.control_table import OperatingMode, Register
from robot_ik.hardware.control_table_data import TIME_BASED
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.protocol2 import ErrorCode

TRIPPED = -1
"""What Bus Watchdog reads once it has tripped."""
GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")

_LONGEST_RAMP = 32_737  # ms; Profile Acceleration of a time-based profile


def check_write(memory: Memory, register: Register, value: int) -> ErrorCode:
    """The error of writing ``value``; sizes, access and the register's own range are checked before."""
    name = register.name
    tripped = "bus_watchdog" in memory.table and memory.get("bus_watchdog") == TRIPPED
    if tripped and (name in GOALS or (name == "bus_watchdog" and value != 0)):
        return ErrorCode.DATA_RANGE
    if name == "operating_mode" and value not in memory.table.modes:
        return ErrorCode.DATA_RANGE
    if name == "drive_mode" and value & ~memory.table.drive_bits:
        return ErrorCode.DATA_RANGE
    if name == "profile_acceleration" and value > _LONGEST_RAMP:
        time_based = "drive_mode" in memory.table and memory.get("drive_mode") & TIME_BASED
        return ErrorCode.DATA_RANGE if time_based else ErrorCode.NONE
    if name == "goal_position" and memory.get("operating_mode") == OperatingMode.POSITION:
        low, high = memory.get("min_position_limit"), memory.get("max_position_limit")
        return ErrorCode.NONE if low <= value <= high else ErrorCode.DATA_LIMIT
    if name in ("goal_velocity", "goal_current", "goal_pwm"):
        limit = memory.get(name.removeprefix("goal_") + "_limit")
        return ErrorCode.NONE if abs(value) <= limit else ErrorCode.DATA_LIMIT
    return ErrorCode.NONE
