"""Checks before an arm may move: its servos are those of the arm file, healthy and set up.

Nothing here switches torque on.  EEPROM is written only where it differs, because it wears out, and
only with torque off.  Errors of the bus are raised by joint name.
"""

from __future__ import annotations

from collections.abc import Mapping

from robot_ik.errors import MotorFaultError
from robot_ik.hardware.arm_registers import read_all, require_models
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.calibration import check_calibration, own_calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.goal_currents import set_all_currents


def verify(
    bus: ServoBus,
    config: ArmConfig,
    *,
    currents: Mapping[str, float] | None = None,
) -> Feedback:
    """Check and set up the servos of an arm.

    Real servos are also compared with the calibration beside the arm file.

    Args:
        bus: Open bus.
        config: Arm file.
        currents: Joint name -> mA that the program has set.

    Returns:
        What a control cycle reads from the servos.

    Raises:
        ServoMismatchError: A servo is missing or is another model.
        MotorFaultError: A latched hardware error, or a supply outside the servo's limits.
        CalibrationMismatchError: With a table of what differs.
        ArmStateError, ConfigError, HardwareError: As ``ServoFamily.set_up``.
    """
    expected = {drive.id: (drive.name, drive.servo.table.number) for drive in config.drives}
    require_models(bus, expected, "the arm file")
    family = config.family
    family.prepare(bus, config)
    _check_errors(bus, config)
    _check_voltage(bus, config)
    for drive in config.drives:
        family.clear_watchdog(bus, config, drive)
    calibration = own_calibration(config) if bus.real else None
    if calibration is not None:
        check_calibration(bus, config, calibration)
    set_up_servos(bus, config, currents or {})
    family.check_strength(bus, config)
    family.check_protection(bus, config)
    feedback = Feedback(config)
    feedback.prepare(bus, read_all(bus, config, "firmware_version"))
    return feedback


def _check_errors(bus: ServoBus, config: ArmConfig) -> None:
    """Raise ``MotorFaultError`` if a servo has a latched hardware error."""
    values = read_all(bus, config, "hardware_error_status")
    errors = [(drive.name, config.family.error_names(values[drive.id])) for drive in config.drives]
    faulty = [(name, names) for name, names in errors if names]
    if not faulty:
        return
    others = ", ".join(f"{name} ({', '.join(names)})" for name, names in faulty[1:])
    hint = "remove the cause, support the arm, then: robot-ik servo reset-fault"
    if others:
        hint = f"likewise {others}; {hint}"
    raise MotorFaultError(*faulty[0], hint=hint)


def _check_voltage(bus: ServoBus, config: ArmConfig) -> None:
    """Raise ``MotorFaultError`` if a supply is outside the servo's limits."""
    lowest = read_all(bus, config, "min_voltage_limit")
    highest = read_all(bus, config, "max_voltage_limit")
    voltages = read_all(bus, config, "present_input_voltage")
    for drive in config.drives:
        low = lowest[drive.id]
        high = highest[drive.id]
        value = voltages[drive.id]
        if not low <= value <= high:
            raise MotorFaultError(
                drive.name,
                ("input_voltage",),
                hint=f"its supply is {value / 10:.1f} V, allowed are {low / 10:.1f} to "
                f"{high / 10:.1f} V",
            )


def set_up_servos(bus: ServoBus, config: ArmConfig, currents: Mapping[str, float]) -> None:
    """Set up every servo as program and arm file need it; see ``ServoFamily.set_up``.

    RAM registers (currents, gains, profile) are lost when a servo restarts.  Call it again then.

    Args:
        bus: Open bus.
        config: Arm file.
        currents: Joint name -> mA that the program has set.
    """
    config.family.set_up(bus, config)
    set_all_currents(bus, config, currents)
