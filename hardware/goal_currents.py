"""Goal Currents of joints in current-based position mode: how hard they may press."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping

from robot_ik.errors import UnsafeCommandError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.limiter import finite
from robot_ik.hardware.register_access import write_register
from robot_ik.hardware.servo import Drive


def set_all_currents(bus: ServoBus, config: ArmConfig, currents: Mapping[str, float]) -> None:
    """Set the Goal Current of every joint that has one.

    Args:
        bus: Open bus.
        config: Arm file.
        currents: Joint name -> mA that the program has set.  Other joints get the arm file's
            ``current_ma``.
    """
    if not config.family.capabilities.current_goal:
        return
    for drive in config.drives:
        if drive.servo.presses:
            _set_current(bus, drive, currents.get(drive.name))


def set_currents(bus: ServoBus, config: ArmConfig, currents: Mapping[str, float]) -> None:
    """Set the Goal Current of some joints.

    Args:
        bus: Open bus.
        config: Arm file.
        currents: Joint name -> mA, checked by ``check_currents``.  The arm file's ``current_ma``
            and the servo's Current Limit are the largest values.

    Raises:
        HardwareError: A register has another value than was written.  Errors of the bus.
    """
    for drive in config.drives:
        if drive.name in currents:
            _set_current(bus, drive, currents[drive.name])


def check_currents(config: ArmConfig, currents: Mapping[str, float]) -> None:
    """Check currents before they are sent.

    Args:
        config: Arm file.
        currents: Joint name -> mA.

    Raises:
        UnknownJointError: No such joint.
        UnsafeCommandError: The joint is not in current-based position mode, or no such current.
    """
    for name, current in currents.items():
        servo = config.joint(name).servo
        if not servo.presses:
            raise UnsafeCommandError(
                f"a current for {name!r} in mode {servo.mode.name.lower()}",
                "current_based_position",
            )
        unit = servo.table.current_unit
        number = finite(current)
        if number is None or number < unit:
            raise UnsafeCommandError(
                f"{reprlib.repr(current)} mA for {name!r}", f"{unit:g} mA and more"
            )


def _set_current(bus: ServoBus, drive: Drive, current: float | None) -> None:
    """Set the Goal Current of one servo, a RAM register.

    Args:
        bus: Open bus.
        drive: Servo.
        current: mA.  None: as much as the arm file allows.
    """
    joint, servo = drive
    limit = bus.read(servo.id, servo.table["current_limit"]).data or 0
    given = [mA for mA in (joint.current, current) if mA is not None]
    counts = min([limit, *(int(mA / servo.table.current_unit) for mA in given)])
    write_register(bus, drive, "goal_current", counts)
