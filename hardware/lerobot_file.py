"""LeRobot's calibration JSON: ``{joint: {id, drive_mode, homing_offset, range_min, range_max}}``.

Positions in it are Present Position, as here, with the homing offset of the servo's register 20 in them.
LeRobot's zero degrees are the middle of the range.  (huggingface/lerobot, ``motors/motors_bus.py``:
``MotorCalibration``, and ``_normalize`` for degrees.)
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robot_ik.errors import ConfigError
from robot_ik.files import read_text, write_atomically
from robot_ik.hardware.calibration_file import Calibration, JointCalibration
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import MULTI_TURN_TICKS, TICKS_PER_TURN, OperatingMode
from robot_ik.hardware.control_table_data import REVERSE
from robot_ik.hardware.joint_map import HOMING_CURES, HOMING_ONE_TURN

KEYS = ("id", "drive_mode", "homing_offset", "range_min", "range_max")


def save_lerobot(path: Path, calibration: Calibration) -> None:
    """Writes a calibration as LeRobot reads it.

    Raises:
        ConfigError: A range beyond one turn: LeRobot writes it into registers that take 0 to 4095.  Or two
            servos turn a joint.
        OutputError: The file cannot be written.
    """
    _require_no_twins([row.name for row in calibration.twins], calibration.file or path)
    for joint in calibration.joints:
        if not 0 <= joint.range_min < joint.range_max < TICKS_PER_TURN:
            raise ConfigError(
                f"ticks {joint.range_min} to {joint.range_max} of {joint.name!r} are not within a turn",
                file=calibration.file or calibration.arm,
                key=joint.name,
                allowed=f"0 to {TICKS_PER_TURN - 1} (LeRobot writes it into the servo's position limits)",
            )
    content = {joint.name: {key: getattr(joint, key) for key in KEYS} for joint in calibration.joints}
    write_atomically(path, json.dumps(content, indent=4) + "\n")


def _require_no_twins(names: Sequence[str], file: Path) -> None:
    if names:
        raise ConfigError(
            f"two servos turn {', '.join(names)}: LeRobot's file has one for each joint",
            file=file,
            key=names[0],
            hint="calibrate by hand: robot-ik servo calibrate",
        )


def load_lerobot(path: Path, config: ArmConfig, created: str) -> Calibration:
    """A calibration out of LeRobot's file, for the joints of an arm file.

    Joints are matched by name, or all by id where the names are others.  q = 0 is LeRobot's zero: the
    middle of the range.  Directions are those of the arm file.

    Raises:
        ConfigError: Unreadable, a key missing or out of range, or a joint without a row.
    """
    _require_no_twins([joint.name for joint in config.joints if joint.twin is not None], path)
    rows = _rows(path)
    by_id = {row["id"]: row for row in rows.values()}
    joints = []
    for joint in config.joints:
        row = rows.get(joint.name) or by_id.get(joint.id)
        if row is None:
            allowed = ", ".join(f"{name} (id {row['id']})" for name, row in rows.items())
            raise ConfigError(f"no joint {joint.name!r} (id {joint.id}) in it", file=path, allowed=allowed)
        _require_usable(joint, row, path)
        joints.append(
            JointCalibration(
                name=joint.name,
                model=joint.model,
                firmware=0,
                direction=joint.direction,
                zero_ticks=(row["range_min"] + row["range_max"]) // 2,
                urdf_lower=0.0,
                urdf_upper=0.0,
                present_at_save=(row["range_min"] + row["range_max"]) // 2,
                **row,
            )
        )
    return Calibration(config.name, config.robot, created, config.baud, tuple(joints), file=path)


def _require_usable(joint: JointMap, row: dict[str, int], path: Path) -> None:
    """Offset and direction of counting that the servo of the arm file has as well."""
    if joint.mode == OperatingMode.POSITION and abs(row["homing_offset"]) > HOMING_ONE_TURN:
        raise ConfigError(
            f"servos in position mode, as {joint.name!r} in the arm file, ignore a Homing Offset of "
            f"{row['homing_offset']} ticks",
            file=path,
            key=f"{joint.name}.homing_offset",
            allowed=HOMING_CURES,
        )
    if bool(row["drive_mode"] & REVERSE) != bool(joint.reverse):
        said = "not reversed" if joint.reverse else "reversed"
        raise ConfigError(
            f"the servo of {joint.name!r} is {said} in it (drive_mode {row['drive_mode']}), and the arm file "
            f"says reverse = {str(bool(joint.reverse)).lower()}",
            file=path,
            key=f"{joint.name}.drive_mode",
            allowed=f"reverse = {str(not joint.reverse).lower()} in the arm file",
        )


def _rows(path: Path) -> dict[str, dict[str, int]]:
    try:
        content = json.loads(read_text(path, "LeRobot's calibration"))
    except json.JSONDecodeError as error:
        raise ConfigError(f"not valid JSON: {error}", file=path) from None
    if not isinstance(content, dict) or not content:
        raise ConfigError(
            "this is no calibration of LeRobot", file=path, allowed='{"joint": {"id": 1, …}, …}'
        )
    return {str(name): _row(name, row, path) for name, row in content.items()}


def _row(name: str, row: Any, path: Path) -> dict[str, int]:
    limits = {"id": (0, 252), "drive_mode": (0, 255)}
    found = {}
    for key in KEYS:
        value = row.get(key) if isinstance(row, dict) else None
        low, high = limits.get(key, (-MULTI_TURN_TICKS, MULTI_TURN_TICKS))
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise ConfigError(
                f"{value!r} is not right", file=path, key=f"{name}.{key}", allowed=f"{low}..{high}"
            )
        found[key] = value
    if found["range_min"] >= found["range_max"]:
        raise ConfigError("the range is empty", file=path, key=name, allowed="range_min < range_max")
    return found


def completed(
    calibration: Calibration,
    firmware: dict[int, int],
    present: dict[int, int],
    limits: dict[str, tuple[float, float]],
) -> Calibration:
    """What LeRobot's file does not say, from servos and model.

    Args:
        calibration: Of ``load_lerobot``.
        firmware: Servo id -> version.
        present: Servo id -> Present Position, ticks.
        limits: Joint -> limits of the model, deg (mm of a slide).
    """
    joints = (
        replace(
            joint,
            firmware=firmware[joint.id],
            present_at_save=present[joint.id],
            urdf_lower=limits[joint.name][0],
            urdf_upper=limits[joint.name][1],
        )
        for joint in calibration.joints
    )
    return replace(calibration, joints=tuple(joints))
