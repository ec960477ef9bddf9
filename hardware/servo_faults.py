"""Faults of single servos, with their causes.  A control cycle finds them and raises them."""

from __future__ import annotations

import logging

from robot_ik.errors import (
    BusCorruptError,
    BusTimeoutError,
    HardwareError,
    MotorFaultError,
)
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.family import family_of
from robot_ik.hardware.servo import Drive

log = logging.getLogger(__name__)


def shutdown_fault(bus: ServoBus, drive: Drive) -> MotorFaultError:
    """Return the fault of a servo whose replies carry the alert bit, with its hardware errors."""
    try:
        value = bus.read(drive.id, drive.servo.table["hardware_error_status"]).data or 0
    except HardwareError as error:
        log.warning("hardware error status of %s: %s", drive.name, error)
        value = 0
    return MotorFaultError(
        drive.name,
        family_of(drive.servo.table.family).error_names(value) or ("hardware_error",),
        hint="the others hold; remove the cause, then: robot-ik servo reset-fault, or "
        "Arm.reset_fault()",
    )


def jump_fault(drive: Drive, before: int, after: int) -> MotorFaultError:
    """Return the fault of a servo whose position changed by more than it can have moved.

    The servo moves to its goal by its new count, so it must be held at once.

    Args:
        drive: Servo.
        before: Position before the jump, ticks.
        after: Position now, ticks.
    """
    old = drive.joint.text(drive.value(before))
    new = drive.joint.text(drive.value(after))
    return MotorFaultError(
        drive.name,
        ("position_jump",),
        hint=f"it read {old}, now {new}: it lost count of its revolutions, or a horn is loose: "
        "all hold. Check it, then: robot-ik servo reset-fault, or Arm.reset_fault()",
    )


def silence_fault(drive: Drive, age: float, *, corrupt: bool) -> MotorFaultError:
    """Return the fault of a servo that does not answer, or whose replies are damaged.

    Args:
        drive: Servo.
        age: s since its last sample.
        corrupt: Replies come, and they are damaged.
    """
    status = "corrupt" if corrupt else "no_status"
    cause = "whether another servo has this id" if corrupt else "its cable and power"
    return MotorFaultError(
        drive.name,
        (status,),
        hint=f"no good reply of servo id {drive.id} for {age:.2f} s: check {cause}; the others "
        "hold",
    )


def confirm_torque(bus: ServoBus, drive: Drive) -> bool:
    """Read the torque of a servo.  Return True if it has torque, False if it does not answer.

    Raises:
        MotorFaultError: The servo has none.
        BusDisconnectedError: The port went away.
    """
    family = family_of(drive.servo.table.family)
    names = [part.name for part in family.plain_block(drive.servo.table).parts[:2]]
    try:
        values = {name: bus.read(drive.id, drive.servo.table[name]).data or 0 for name in names}
    except (BusTimeoutError, BusCorruptError):
        return False
    if not family.is_in_control(values):
        hint = "the servo has probably restarted: check its supply; the other joints hold"
        raise MotorFaultError(drive.name, ("torque_lost",), hint=hint)
    return True
