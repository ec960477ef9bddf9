"""The option ``--bus`` of all commands: names and help from the table of buses; which robot is meant."""

from __future__ import annotations

from typing import Any

from tyro.conf import arg

from robot_ik.catalogue import SERVO_ROBOT, SHOWN_ROBOT
from robot_ik.hardware import BUSES, bus_row

NONE = "none"
"""Where a command can do without servos."""


def bus_argument(*, none: bool = False, default: str = "") -> Any:
    """Annotation of a field of type ``str``.

    Args:
        none: There may be no servos at all.
        default: What it says behind the help; empty: the field's own default.
    """
    names, told = list(BUSES), [f"{bus.name}: {bus.title}" for bus in BUSES.values()]
    if none:
        names.append(NONE)
        told.append(f"{NONE}: no servos")
    hint = f"(default: {default})" if default else None
    text = "Where the servos are. " + "; ".join(told) + "."
    return arg(metavar="|".join(names), help=text, help_behavior_hint=hint)


def robot_meant(arm: str, bus: str) -> str:
    """The robot where none is named: the arm file's; at a port the one that servos move; else the shown one.

    Args:
        arm: Arm file, or empty.
        bus: As ``--bus`` takes it.

    Raises:
        ConfigError: The arm file is wrong.
    """
    if arm:
        from robot_ik.hardware.config import ArmConfig

        return ArmConfig.load(arm).robot
    return SHOWN_ROBOT if bus == NONE or bus_row(bus).virtual else SERVO_ROBOT
