"""Torque on without a jerk: every goal is where its shaft is before any servo gets torque."""

from __future__ import annotations

from robot_ik.errors import HardwareError, MotorFaultError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import TICKS_PER_TURN, hardware_error_names
from robot_ik.hardware.registers import read_all, shared_register
from robot_ik.hardware.samples import TWIST

WATCHDOG_UNIT_MS = 20

_ATTEMPTS = 3  # a sync write has no answer: it is read back, and repeated if it was lost
_REBASE_TICKS = TICKS_PER_TURN // 8  # a shaft does not move so far while torque comes on; a lost turn does


def torque_on(bus: ServoBus, config: ArmConfig) -> dict[int, int]:
    """Goal = present, read back; torque on, read back; then the Bus Watchdog.

    Returns:
        Servo id -> goal position, ticks: where the arm now holds.

    Raises:
        HardwareError: A goal was not taken, or a multi-turn servo has lost its turns.  Torque may be on then:
            the caller switches it off.
        MotorFaultError: A servo refuses torque, by joint and with its hardware error.
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError.
    """
    goals = read_all(bus, config, "present_position")
    _check_turns(config, goals)
    _check_twins(config, goals)
    missing = _sync_set(bus, config, "goal_position", goals)
    if missing:
        raise HardwareError(
            f"{_names(missing)} did not take the present position as goal; nothing was switched on",
            hint="is the shaft outside the servo's own position limits? turn it back inside by hand",
        )
    missing = _sync_set(bus, config, "torque_enable", dict.fromkeys(config.servo_ids, 1))
    if missing:
        errors = read_all(bus, config, "hardware_error_status")
        names = hardware_error_names(errors[missing[0].id])
        raise MotorFaultError(missing[0].name, names or ("torque_refused",))
    arm_watchdog(bus, config)
    present = read_all(bus, config, "present_position")
    for joint in config.servos:
        after = present[joint.id]
        if abs(after - goals[joint.id]) > _REBASE_TICKS:
            raise HardwareError(
                f"joint {joint.name!r} read {goals[joint.id]} ticks before torque came on and {after} after",
                hint="a servo may count its turns anew when torque comes on: check zero_ticks",
            )
    return goals


def arm_watchdog(bus: ServoBus, config: ArmConfig) -> None:
    """Servos stop by themselves when the bus is silent for ``watchdog_ms`` (0: never).

    Raises:
        HardwareError: A servo did not take it.
    """
    if not config.watchdog_ms:
        return  # cleared when the arm was connected, where there is one
    value = config.watchdog_ms // WATCHDOG_UNIT_MS
    missing = _sync_set(bus, config, "bus_watchdog", dict.fromkeys(config.servo_ids, value))
    if missing:
        raise HardwareError(
            f"{_names(missing)} did not take the bus watchdog",
            hint="power-cycle the servos and try again",
        )


def _sync_set(bus: ServoBus, config: ArmConfig, name: str, values: dict[int, int]) -> list[JointMap]:
    """Servos that do not read back what was written."""
    register = shared_register(config, name)
    wrong = list(config.servos)
    for _ in range(_ATTEMPTS):
        bus.sync_write(register, {joint.id: values[joint.id] for joint in wrong})
        present = read_all(bus, config, name)
        wrong = [joint for joint in config.servos if present[joint.id] != values[joint.id]]
        if not wrong:
            break
    return wrong


def _names(servos: list[JointMap]) -> str:
    return ", ".join(dict.fromkeys(servo.name for servo in servos))


def _check_turns(config: ArmConfig, present: dict[int, int]) -> None:
    """A servo that lost power counts its turns anew: then its angle is wrong by whole turns."""
    for joint in config.servos:
        here = present[joint.id]
        if turns := joint.lost_turns(here):
            lower, upper = joint.limits
            zero = joint.zero_ticks - TICKS_PER_TURN * turns
            raise HardwareError(
                f"joint {joint.name!r} reads {joint.text(joint.to_radians(here))}, outside "
                f"{joint.text(lower)} .. {joint.text(upper)}: the servo has lost count of its turns; "
                "nothing was switched on",
                hint="is it wound up? then turn it back by hand. Else, until its power goes again, "
                f"zero_ticks = {zero} in the arm file is right",
            )


def _check_twins(config: ArmConfig, present: dict[int, int]) -> None:
    """Two servos of one joint that do not agree where it is would fight each other."""
    for joint in config.whole.joints:
        angles = [servo.to_radians(present[servo.id]) for servo in joint.servos]
        if abs(angles[-1] - angles[0]) > TWIST * joint.lever_at(angles[0]):
            raise HardwareError(
                f"the two servos of joint {joint.name!r} read {joint.text(angles[0])} and "
                f"{joint.text(angles[-1])}; nothing was switched on",
                hint="correct direction or zero_ticks of joints.twin in the arm file",
            )
