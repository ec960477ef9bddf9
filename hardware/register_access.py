"""Writing registers of several servos, with proof that the values arrived."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from robot_ik.errors import ArmStateError, HardwareError
from robot_ik.hardware.bus import ServoBus, read_all, shared_register
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.joint_map import JointMap

log = logging.getLogger(__name__)

ATTEMPTS = 3
"""How often a sync write, which has no reply, is repeated if its values do not read back."""


def write_register(bus: ServoBus, servo: JointMap, name: str, value: int) -> None:
    """Write one register of one servo and read it back.

    Raises:
        HardwareError: The register has another value.
    """
    register = servo.table[name]
    bus.write(servo.id, register, value)
    if bus.read(servo.id, register).data != value:
        raise HardwareError(
            f"{name} of joint {servo.name!r} (servo id {servo.id}) was written and reads back "
            f"otherwise; "
            "no torque was changed"
        )


def sync_set(
    bus: ServoBus, config: ArmConfig, name: str, values: Mapping[int, int]
) -> list[JointMap]:
    """Write one register of every servo (id -> value).

    Return the servos that have another value.
    """
    register = shared_register(config, name)
    failed = list(config.servos)
    for _ in range(ATTEMPTS):
        bus.sync_write(register, {servo.id: values[servo.id] for servo in failed})
        present = read_all(bus, config, name)
        failed = [servo for servo in config.servos if present[servo.id] != values[servo.id]]
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
    different = [servo for servo in config.servos if present[servo.id] != wanted[servo.id]]
    for servo in different:
        if torque[servo.id]:
            raise ArmStateError(
                f"{name} of joint {servo.name!r} must change, but its torque is on (left on by a "
                f"program)",
                hint="support the arm, switch its torque off, and connect again",
            )
    for servo in different:
        log.info("%s of %s: %d -> %d", name, servo.name, present[servo.id], wanted[servo.id])
        write_register(bus, servo, name, wanted[servo.id])


def check_position_limits(bus: ServoBus, config: ArmConfig, servos: Sequence[JointMap]) -> None:
    """Check that the servos' own position limits contain the arm file's range.

    Args:
        bus: Open bus.
        config: Arm file.
        servos: Servos to check.

    Raises:
        ConfigError: The limits of a servo are narrower.
    """
    lowest, highest = (read_all(bus, config, f"{end}_position_limit") for end in ("min", "max"))
    for servo in servos:
        first, last = servo.ticks_range
        low = lowest[servo.id]
        high = highest[servo.id]
        if not low <= first <= last <= high:
            ends = sorted(servo.to_radians(ticks) / servo.per_unit for ticks in (low, high))
            raise config.wrong(
                f"the servo's own limits (ticks {low} to {high}) are narrower than "
                f"lower_{servo.unit} .. upper_{servo.unit}",
                f"joints[{config.whole.names.index(servo.name)}]",
                f"{ends[0]:.1f} to {ends[1]:.1f} {servo.unit}, or other limits in the servo",
            )
