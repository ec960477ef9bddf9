"""How hard servos in current-based position mode may press."""

from __future__ import annotations

import math
from collections.abc import Mapping

from robot_ik.errors import HardwareError, UnsafeCommandError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.config_check import current_unit
from robot_ik.hardware.control_table import OperatingMode


def set_currents(bus: ServoBus, config: ArmConfig, wanted: Mapping[str, float]) -> None:
    """Goal Current of joints; it is kept in RAM, so every start sets it.

    Args:
        bus: Open.
        config: The arm; its ``current_ma`` is the most there is, and so is the servo's Current Limit.
        wanted: Joint name -> mA.  Empty: all joints of that mode, what the arm file says.

    Raises:
        UnknownJointError, UnsafeCommandError: Not a joint of this mode, or no current; nothing was sent.
        HardwareError: A servo reads back otherwise.  Errors of the bus.
    """
    for name, current in wanted.items():
        joint = config.joint(name)
        if joint.mode != OperatingMode.CURRENT_BASED_POSITION:
            raise UnsafeCommandError(
                f"a current for {name!r} in mode {joint.mode.name.lower()}", "current_based_position"
            )
        if not (math.isfinite(current) and current >= current_unit(joint.table)):
            raise UnsafeCommandError(
                f"{current} mA for {name!r}", f"{current_unit(joint.table):g} mA and more"
            )
    for servo in config.servos:
        if servo.mode != OperatingMode.CURRENT_BASED_POSITION or (wanted and servo.name not in wanted):
            continue
        most = bus.read(servo.id, servo.table["current_limit"]).data or 0
        given = [mA for mA in (servo.current, wanted.get(servo.name)) if mA is not None]
        counts = min([most, *(int(mA / current_unit(servo.table)) for mA in given)])
        register = servo.table["goal_current"]
        bus.write(servo.id, register, counts)
        if bus.read(servo.id, register).data != counts:
            raise HardwareError(f"joint {servo.name!r} does not take a current of {counts} units")
