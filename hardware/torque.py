"""Torque on without a jerk, and the checks before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from robot_ik.errors import HardwareError, MotorFaultError
from robot_ik.hardware.arm_registers import read_all, read_motion
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.register_access import sync_set
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import TWIST, Drive

REBASE_TICKS = TICKS_PER_REVOLUTION // 8
"""Ticks.  A shaft moves less while torque comes on, and a lost revolution is more."""


def read_standing(bus: ServoBus, config: ArmConfig) -> tuple[dict[int, int], dict[int, float]]:
    """Return positions and velocities as ``read_motion``, if every servo may get torque.

    Args:
        bus: Open bus.
        config: Arm file.

    Returns:
        Servo id -> present position, ticks; and servo id -> velocity of the shaft, rad/s.

    Raises:
        HardwareError: A servo restarted since it was set up, lost revolutions, or is too weak to
            hold the arm.  No torque was switched on.
    """
    present, velocities = read_motion(bus, config)
    _check_set_up(bus, config, "nothing was switched on")
    config.family.check_strength(bus, config)
    _check_revolutions(config, present)
    _check_twins(config, present)
    return present, velocities


def torque_on(bus: ServoBus, config: ArmConfig, goals: Mapping[int, int]) -> None:
    """Set goals at the present pose, arm the Bus Watchdog, switch torque on; read all back.

    A Bus Watchdog counts only while its servo has torque (ROBOTIS-GIT/emanual
    _includes/en/dxl/x/bus_watchdog.md).  A watchdog that was armed before stops the servo also if
    this program dies just then.

    Args:
        bus: Open bus.
        config: Arm file.
        goals: Servo id -> ticks.

    Raises:
        HardwareError: A servo did not take its goal, counts from another revolution, or restarted
            meanwhile.  Torque may be on then, so the caller switches it off.
        MotorFaultError: A servo refuses torque, by joint and with its hardware error.
    """
    failed = sync_set(bus, config, "goal_position", goals)
    if failed:
        raise HardwareError(
            f"{_names(failed)} did not take the present position as goal; nothing was switched on",
            hint="if the shaft is outside the servo's own position limits, turn it back inside "
            "them by hand",
        )
    arm_watchdog(bus, config)
    failed = sync_set(bus, config, "torque_enable", dict.fromkeys(config.servo_ids, 1))
    if failed:
        errors = read_all(bus, config, "hardware_error_status")
        names = config.family.error_names(errors[failed[0].id])
        raise MotorFaultError(failed[0].name, names or ("torque_refused",))
    present = read_all(bus, config, "present_position")
    for drive in config.drives:
        before = goals[drive.id]
        after = present[drive.id]
        if abs(after - before) > REBASE_TICKS:
            raise HardwareError(
                f"joint {drive.name!r} read {before} ticks before torque came on and {after} after",
                hint="a servo may restart its count of revolutions when torque comes on: check "
                "zero_ticks",
            )
    # A servo that restarted between the last check and its torque has no speed limit now.
    _check_set_up(bus, config, "its torque goes off again")


def arm_watchdog(bus: ServoBus, config: ArmConfig) -> None:
    """Make servos stop by themselves if the bus is silent for ``watchdog_ms`` (0: never)."""
    if config.watchdog_ms:
        config.family.arm_watchdog(bus, config)


def set_profiles(bus: ServoBus, config: ArmConfig) -> None:
    """Limit the speed at which servos follow their goals; see ``ServoFamily.limit_speed``."""
    config.family.limit_speed(bus, config)


def _names(drives: Sequence[Drive]) -> str:
    return ", ".join(dict.fromkeys(drive.name for drive in drives))


def _check_set_up(bus: ServoBus, config: ArmConfig, consequence: str) -> None:
    """Check that no servo restarted since ``set_profiles``.

    A servo that restarted has lost its profile, its gains and its goal current.

    Args:
        bus: Open bus.
        config: Arm file.
        consequence: What happens to the torque, for the error.
    """
    drive = config.family.forgot_speed(bus, config)
    if drive is not None:
        raise HardwareError(
            f"{drive.label} has restarted since it was set up: no limit of "
            f"speed or current is left in it; {consequence}",
            hint="check its supply; then connect again, in a program reconnect(), then enable()",
        )


def _check_revolutions(config: ArmConfig, present: Mapping[int, int]) -> None:
    """Check that every servo has kept its count of revolutions."""
    for joint, servo in config.drives:
        ticks = present[servo.id]
        revolutions = joint.lost_revolutions(ticks, servo)
        if revolutions:
            lower, upper = joint.limits
            zero = servo.zero_ticks - TICKS_PER_REVOLUTION * revolutions
            raise HardwareError(
                f"joint {joint.name!r} reads {joint.text(joint.value(ticks, servo))}, outside "
                f"{joint.text(lower)} .. {joint.text(upper)}: the servo has lost count of its "
                "revolutions; nothing was switched on",
                hint="if the joint is wound up, turn it back by hand; if not, set "
                f"zero_ticks = {zero} in the arm file, which is right until the next power-off",
            )


def _check_twins(config: ArmConfig, present: Mapping[int, int]) -> None:
    """Check that the two servos of a joint agree on its angle: otherwise they push each other."""
    for joint in config.joints:
        values = [joint.value(present[servo.id], servo) for servo in joint.servos]
        if abs(values[-1] - values[0]) > TWIST * joint.lever_at(values[0]):
            raise HardwareError(
                f"the two servos of joint {joint.name!r} read {joint.text(values[0])} and "
                f"{joint.text(values[-1])}; nothing was switched on",
                hint="correct direction or zero_ticks of joints.twin in the arm file",
            )
