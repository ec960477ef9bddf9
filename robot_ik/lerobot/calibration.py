"""LeRobot's calibration of an arm: create it, use it, and compare it with the servos.

The procedure and the registers are those of LeRobot's ``so_follower``: the middle of the range
first, then every joint from stop to stop.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from robot_ik.errors import HardwareError
from robot_ik.files import write_atomically
from robot_ik.hardware.arm_registers import read_all
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.calibration import CalibrationMismatchError, calibrated
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import FULL_TURN, MotorCalibration, load_lerobot
from robot_ik.hardware.register_access import set_eeprom, sync_set
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import Joint

MIDDLE_TICKS = TICKS_PER_REVOLUTION // 2 - 1
"""Present Position in the middle of the range after homing."""

MAX_OFFSET = 2047
"""Largest Homing Offset of an STS servo, ticks: 11 bits and a sign."""

MAX_STOPPED_RANGE = 4.5
"""rad. A joint with a larger range, such as ``wrist_roll``, has no end stops to sweep to."""

Wait = Callable[[str, Callable[[], None]], None]
"""Shows a text, and calls a function repeatedly until the person has pressed ENTER."""


def with_calibration(
    config: ArmConfig, path: Path, limits: Mapping[str, tuple[float, float]]
) -> ArmConfig:
    """Return the arm with the zeros and ranges of LeRobot's calibration file.

    Args:
        config: Arm file.
        path: LeRobot's file.
        limits: Joint -> limits of the model, rad or m.

    Raises:
        ConfigError: The file cannot be read, or does not fit the arm.
        CalibrationMismatchError: Its ranges are not those of the arm file and the model.
    """
    return calibrated(config, load_lerobot(path, config, limits))


def nominal(config: ArmConfig) -> dict[str, MotorCalibration]:
    """Return the calibration that the arm file describes, for simulated servos."""
    motors = {}
    for joint in config.joints:
        first, last = FULL_TURN if turns_freely(joint) else joint.ticks_range()
        motors[joint.name] = _motor(joint, 0, first, last)
    return motors


def save(path: Path, motors: Mapping[str, MotorCalibration]) -> None:
    """Write LeRobot's file completely or not at all."""
    content = {name: motor.model_dump() for name, motor in motors.items()}
    write_atomically(path, json.dumps(content, indent=4) + "\n")


def check_offsets(bus: ServoBus, config: ArmConfig, offsets: Mapping[str, int]) -> None:
    """Compare the Homing Offset registers with a calibration file.

    Args:
        bus: Open bus.
        config: Arm file.
        offsets: Joint -> homing offset of the file, ticks.

    Raises:
        CalibrationMismatchError: The servos were calibrated after the file was written.
    """
    present = read_all(bus, config, "homing_offset")
    rows = []
    for joint in config.joints:
        expected = offsets.get(joint.name)
        measured = present[joint.servo.id]
        if expected is not None and measured != expected:
            rows.append((joint.name, "homing offset, ticks", str(expected), str(measured)))
    if rows:
        raise CalibrationMismatchError(
            "the servos are not those of the calibration file",
            rows,
            "calibrate again: lerobot-calibrate",
        )


def calibrate_by_hand(bus: ServoBus, config: ArmConfig, wait: Wait) -> dict[str, MotorCalibration]:
    """Calibrate an arm that a person moves. Writes offsets and limits into the servos.

    Torque is off afterwards.

    Args:
        bus: Open bus.
        config: Arm file. Its zeros are not used.
        wait: See ``Wait``.

    Returns:
        Joint -> calibration.

    Raises:
        ConfigError: The servos are of another family, or two servos turn a joint.
    """
    _require_procedure(config)
    ids = config.servo_ids
    _set_all(bus, config, "torque_enable", 0)
    first, last = FULL_TURN
    factory_limits = {
        "min_position_limit": dict.fromkeys(ids, first),
        "max_position_limit": dict.fromkeys(ids, last),
    }
    _write_eeprom(bus, config, {"homing_offset": dict.fromkeys(ids, 0), **factory_limits})
    wait("Move the arm to the middle of its range of motion and press ENTER.", lambda: None)
    present = read_all(bus, config, "present_position")
    offsets = {id: homing_offset(ticks) for id, ticks in present.items()}
    _write_eeprom(bus, config, {"homing_offset": offsets})
    lowest = dict(read_all(bus, config, "present_position"))
    highest = dict(lowest)

    def sample() -> None:
        for id, ticks in read_all(bus, config, "present_position").items():
            lowest[id] = min(lowest[id], ticks)
            highest[id] = max(highest[id], ticks)

    free = [joint for joint in config.joints if turns_freely(joint)]
    except_free = f" except {', '.join(joint.name for joint in free)}" if free else ""
    wait(f"Move all joints{except_free} through their ranges and press ENTER.", sample)
    for joint in free:
        lowest[joint.servo.id], highest[joint.servo.id] = FULL_TURN
    _write_eeprom(bus, config, {"min_position_limit": lowest, "max_position_limit": highest})
    return {
        joint.name: _motor(
            joint, offsets[joint.servo.id], lowest[joint.servo.id], highest[joint.servo.id]
        )
        for joint in config.joints
    }


def homing_offset(ticks: int) -> int:
    """Return the Homing Offset with which a servo at ``ticks`` reads ``MIDDLE_TICKS``.

    Present Position is the encoder minus the offset on Feetech servos.
    """
    return min(max(ticks - MIDDLE_TICKS, -MAX_OFFSET), MAX_OFFSET)


def turns_freely(joint: Joint) -> bool:
    """Return whether a joint has no end stops to sweep to."""
    return joint.upper - joint.lower > MAX_STOPPED_RANGE


def _motor(joint: Joint, offset: int, first: int, last: int) -> MotorCalibration:
    return MotorCalibration(
        id=joint.servo.id, drive_mode=0, homing_offset=offset, range_min=first, range_max=last
    )


def _require_procedure(config: ArmConfig) -> None:
    if config.family.name != "feetech_sts":
        raise config.wrong(
            "LeRobot's calibration procedure needs Feetech STS servos",
            "joints[0].model",
            hint="calibrate this arm with: robot-ik servo calibrate",
        )
    for joint in config.joints:
        if len(joint.servos) > 1:
            raise config.wrong_joint(
                joint, "two servos turn this joint, and LeRobot's file has one for each", "servos"
            )


def _write_eeprom(
    bus: ServoBus, config: ArmConfig, registers: Mapping[str, Mapping[int, int]]
) -> None:
    """Write EEPROM registers, name -> servo id -> value, of servos without torque."""
    torque = dict.fromkeys(config.servo_ids, 0)
    _set_all(bus, config, "lock", 0)
    try:
        for name, values in registers.items():
            set_eeprom(bus, config, name, values, torque)
    finally:
        _set_all(bus, config, "lock", 1)


def _set_all(bus: ServoBus, config: ArmConfig, name: str, value: int) -> None:
    """Write a register of every servo.

    Raises:
        HardwareError: A servo has another value afterwards.
    """
    failed = sync_set(bus, config, name, dict.fromkeys(config.servo_ids, value))
    if failed:
        servos = ", ".join(drive.label for drive in failed)
        raise HardwareError(
            f"{name} of {servos} was set to {value}, but the servos return another value",
            hint="check the cable and the supply, then calibrate again",
        )
