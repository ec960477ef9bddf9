"""Something in a cycle looks wrong: the servo itself is asked what it is, and the fault is put into words."""

from __future__ import annotations

import logging
import math

from robot_ik.errors import BusCorruptError, BusTimeoutError, HardwareError, MotorFaultError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import JointMap
from robot_ik.hardware.control_table import hardware_error_names

log = logging.getLogger(__name__)


def shut_down(bus: ServoBus, servo: JointMap) -> MotorFaultError:
    """The fault of a servo whose answers carry the alert bit, with what its register says."""
    try:
        value = bus.read(servo.id, servo.table["hardware_error_status"]).data or 0
    except HardwareError as error:
        log.warning("hardware error status of %s: %s", servo.name, error)
        value = 0
    return MotorFaultError(
        servo.name,
        hardware_error_names(value) or ("hardware_error",),
        hint="the others hold; remove the cause, then: robot-ik servo reset-fault, or Arm.reset_fault()",
    )


def torque_lost(servo: JointMap) -> MotorFaultError:
    """The fault of a servo that has no torque and should."""
    return MotorFaultError(
        servo.name,
        ("torque_lost",),
        hint="the servo has probably restarted: check its supply; the other joints hold",
    )


def jumped(servo: JointMap, before: int, now: int) -> MotorFaultError:
    """The fault of a servo whose position changed by more than it can have moved, in ticks.

    It goes on to where its goal seems to be by then, and takes the joint there: it must be held at once.
    """
    there, here = (servo.text(servo.to_radians(ticks)) for ticks in (before, now))
    return MotorFaultError(
        servo.name,
        ("position_jump",),
        hint=f"it read {there}, now {here}: it lost count of its turns, or a horn is loose: "
        "all hold. Check it, then: robot-ik servo reset-fault, or Arm.reset_fault()",
    )


def has_torque(bus: ServoBus, servo: JointMap) -> bool:
    """Whether a servo says so itself; False where it cannot be heard.

    Raises:
        MotorFaultError: It has none.
        BusDisconnectedError: The port went away.
    """
    try:
        torque = bus.read(servo.id, servo.table["torque_enable"]).data
    except (BusTimeoutError, BusCorruptError):
        return False
    if not torque:
        raise torque_lost(servo)
    return True


def last_word(bus: ServoBus, servo: JointMap, age: float, *, everyone: bool) -> int | None:
    """Present position of a servo that has not answered for ``age`` s, asked by itself.

    Args:
        bus: Open.
        servo: Who.
        age: s; infinite if it never answered.
        everyone: All others are silent too.

    Raises:
        MotorFaultError: ``no_status`` or ``corrupt``.
        BusTimeoutError: Nobody answers.
        BusDisconnectedError: The port went away.
    """
    try:
        return bus.read(servo.id, servo.table["present_position"]).data
    except BusTimeoutError:
        status, cause = "no_status", "its cable and power"
    except BusCorruptError:
        status, cause = "corrupt", "whether another servo has this id"
    if everyone:
        raise BusTimeoutError(
            id=servo.id,
            register="present_position",
            port=bus.port,
            joint=servo.name,
            last_good=age if math.isfinite(age) else None,
            everyone=True,
            hint="check their power, the cable and the adapter; torque stays as it was",
        )
    hint = f"no good answer of servo id {servo.id} for {age:.2f} s: check {cause}; the others hold"
    raise MotorFaultError(servo.name, (status,), hint=hint)
