"""Writing registers of several servos, with proof that the values arrived."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from robot_ik.errors import ArmStateError, HardwareError
from robot_ik.hardware.arm_registers import read_all, shared_register
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import Drive

log = logging.getLogger(__name__)

ATTEMPTS = 3
"""How often a sync write, which has no reply, is repeated if its values do not read back."""


def write_register(bus: ServoBus, drive: Drive, name: str, value: int) -> None:
    """Write one register of one servo and read it back.

    Raises:
        HardwareError: The register has another value.
    """
    register = drive.servo.table[name]
    bus.write(drive.id, register, value)
    if bus.read(drive.id, register).data != value:
        raise HardwareError(
            f"{name} of {drive.label} was written and reads back otherwise; no torque was changed"
        )


def sync_set(bus: ServoBus, config: ArmConfig, name: str, values: Mapping[int, int]) -> list[Drive]:
    """Write one register of every servo (id -> value) and return those that have another value."""
    register = shared_register(config, name)
    failed = list(config.drives)
    for _ in range(ATTEMPTS):
        bus.sync_write(register, {drive.id: values[drive.id] for drive in failed})
        present = read_all(bus, config, name)
        failed = [drive for drive in config.drives if present[drive.id] != values[drive.id]]
        if not failed:
            break
    return failed


def set_eeprom(
    bus: ServoBus,
    config: ArmConfig,
    name: str,
    wanted: Mapping[int, int],
    torque: Mapping[int, int],
) -> None:
    """Write one EEPROM register of every servo (id -> value) where it differs.  EEPROM wears out.

    Args:
        bus: Open bus.
        config: Arm file.
        name: Register.
        wanted: Servo id -> value.
        torque: Servo id -> Torque Enable.

    Raises:
        ArmStateError: A register must change and torque is on.
    """
    present = read_all(bus, config, name, absent=0)
    different = [drive for drive in config.drives if present[drive.id] != wanted[drive.id]]
    for drive in different:
        if torque[drive.id]:
            raise ArmStateError(
                f"{name} of joint {drive.name!r} must change, but its torque is on (left on by a "
                f"program)",
                hint="support the arm, switch its torque off, and connect again",
            )
    for drive in different:
        log.info("%s of %s: %d -> %d", name, drive.name, present[drive.id], wanted[drive.id])
        write_register(bus, drive, name, wanted[drive.id])


def check_position_limits(bus: ServoBus, config: ArmConfig, drives: Sequence[Drive]) -> None:
    """Check that the servos' own position limits contain the arm file's range.

    Args:
        bus: Open bus.
        config: Arm file.
        drives: Servos to check.

    Raises:
        ConfigError: The limits of a servo are narrower.
    """
    lowest = read_all(bus, config, "min_position_limit")
    highest = read_all(bus, config, "max_position_limit")
    for drive in drives:
        joint = drive.joint
        first, last = drive.ticks_range
        low = lowest[drive.id]
        high = highest[drive.id]
        if not low <= first <= last <= high:
            ends = sorted(drive.value(ticks) / joint.per_unit for ticks in (low, high))
            raise config.wrong_joint(
                joint,
                f"the servo's own limits (ticks {low} to {high}) are narrower than "
                f"lower_{joint.unit} .. upper_{joint.unit}",
                allowed=f"{ends[0]:.1f} to {ends[1]:.1f} {joint.unit}, "
                "or other limits in the servo",
            )
