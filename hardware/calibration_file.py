"""The calibration file: what was measured at an arm, to compare the arm with it later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tomlkit
from pydantic import BeforeValidator, Field

from robot_ik.config import KeyProblem, SchemaVersion, Several, Table, keys_of, read_table
from robot_ik.errors import ConfigError
from robot_ik.files import write_atomically
from robot_ik.hardware.arm_file import with_zeros
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import MULTI_TURN_TICKS
from robot_ik.hardware.servo import Joint, Servo, ServoId, Sign, SwingArm

SCHEMA = 1
"""Version of the file. It increases when a key changes its meaning."""


_Ticks = Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)]
_Byte = Annotated[int, Field(ge=0, le=255)]


@dataclass(frozen=True)
class JointCalibration:
    """One joint and one of its servos, as measured.

    Attributes:
        name: Name of the joint.
        id: Servo id.
        model: Servo model.
        drive_mode: Drive Mode register.
        homing_offset: Homing Offset register.
        range_min: Smallest Present Position of the sweep, ticks.
        range_max: Largest Present Position of the sweep, ticks.
        direction: +1 or -1.
        zero_ticks: Present Position at q = 0.
        urdf_lower: Lower limit of the model at that time, deg (mm of a slide).
        urdf_upper: Upper limit of the model at that time, deg (mm of a slide).

    Raises:
        KeyProblem: The range is empty.
    """

    name: str
    id: ServoId
    model: str
    drive_mode: _Byte
    homing_offset: _Ticks
    range_min: _Ticks
    range_max: _Ticks
    direction: Sign
    zero_ticks: _Ticks
    urdf_lower: float
    urdf_upper: float

    def __post_init__(self) -> None:
        if self.range_min >= self.range_max:
            raise KeyProblem(
                f"the range of {self.name!r} is empty", "range_min", f"< {self.range_max}"
            )


@dataclass(frozen=True)
class Calibration:
    """A calibrated arm.

    Attributes:
        arm: Name in the arm file.
        robot: Name of the model.
        created: Date and time, ISO 8601.
        joints: First servos, in the order of the arm file.
        twins: Second servos of joints that have two.
        file: File that it was read from, for messages.
    """

    arm: str
    robot: str
    created: str
    joints: tuple[JointCalibration, ...]
    twins: tuple[JointCalibration, ...] = ()
    file: Path | None = None

    @property
    def rows(self) -> tuple[JointCalibration, ...]:
        """Every servo, in the order of ``ArmConfig.servos``."""
        return self.joints + self.twins

    def save(self, path: Path) -> None:
        """Write the file completely or not at all.

        Raises:
            OutputError: The file cannot be written.
        """
        head = {"schema": SCHEMA, "arm": self.arm, "robot": self.robot, "created": self.created}
        tables = {"joints": self.joints, "twins": self.twins}
        content = {name: [asdict(row) for row in rows] for name, rows in tables.items() if rows}
        write_atomically(path, tomlkit.dumps(head | content))

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Read and check a file.

        Raises:
            ConfigError: The file cannot be read, or a key is unknown, missing or out of range.
        """
        content = read_table(_CalibrationFile, path, "the calibration")
        return cls(content.arm, content.robot, content.created, content.joints, content.twins, path)


def calibration_beside(arm_file: Path) -> Path:
    """Return the path of the calibration of ``my.toml``: ``my.calibration.toml``."""
    return arm_file.with_name(arm_file.stem + ".calibration.toml")


_NOT_READ = ("firmware", "present_at_save")
"""Keys of joints in older files."""


def _keys_read(row: Any) -> Any:
    return {key: row[key] for key in row if key not in _NOT_READ} if isinstance(row, dict) else row


_Row = Annotated[JointCalibration, keys_of(JointCalibration), BeforeValidator(_keys_read)]


class _CalibrationFile(Table):
    version: SchemaVersion
    arm: str
    robot: str
    created: str
    bus: Any = None  # in older files; not used
    joints: Annotated[Several[_Row], Field(min_length=1)]
    twins: Several[_Row] = ()


def zeros_moved(config: ArmConfig, offsets: Mapping[str, float]) -> ArmConfig:
    """Return the arm with zeros for which the joints are where they really are.

    Args:
        config: Arm.
        offsets: Joint -> true value minus the value that its servos report, rad (m of a slide).

    Raises:
        UnknownJointError: No such joint.
        ConfigError: A zero that no servo can have.
    """
    for name in offsets:
        config.joint(name)
    moved = []
    for joint in config.joints:
        offset = offsets.get(joint.name, 0.0)
        servos = tuple(
            replace(servo, zero_ticks=_moved_zero(joint, servo, offset)) for servo in joint.servos
        )
        moved.append(replace(joint, servos=servos))
    return replace(config, joints=tuple(moved))


def _moved_zero(joint: Joint, servo: Servo, offset: float) -> int:
    """Return the corrected zero. Of a swing arm it is exact in the middle of the range."""
    middle = sum(joint.limits) / 2.0 if isinstance(joint.gear, SwingArm) else 0.0
    moved = joint.position(middle - offset, servo) - joint.position(middle, servo)
    return round(servo.zero_ticks + moved)


def write_zeros(file: Path, used: ArmConfig, offsets: Mapping[str, float]) -> tuple[Path, ...]:
    """Write ``zeros_moved`` into an arm file and into its calibration, if there is one.

    Only the zeros change. Comments and all other text stay. Servos are not touched.

    Args:
        file: Arm file.
        used: Arm for which the offsets were measured; it may have only some joints of the file.
        offsets: Joint -> rad (m of a slide), see ``zeros_moved``.

    Returns:
        Copies of the old files, beside the new ones.

    Raises:
        ConfigError: The arm file has changed since.
        OutputError: A file cannot be written. Nothing was changed.
    """
    old = ArmConfig.load(file)
    for joint in used.joints:
        if old.joint(joint.name) != joint:
            raise ConfigError(
                f"joint {joint.name!r} has been changed since the arm was measured; nothing is "
                "written",
                file=file,
                key="joints",
                hint="measure again",
            )
    new = zeros_moved(old, offsets)
    text = file.read_bytes().decode("utf-8")  # keeps the line ends
    edited = with_zeros(text, {servo.id: servo.zero_ticks for servo in new.servos})
    calibration_file = calibration_beside(file)
    backups = [_backup(file, text)]
    if calibration_file.exists():
        calibration = Calibration.load(calibration_file)
        old_text = calibration_file.read_bytes().decode("utf-8")
        backups.append(_backup(calibration_file, old_text))
        # Arm file and calibration must agree.
        zeros = {servo.id: servo.zero_ticks for servo in new.servos if servo.primary_id is None}
        joints, twins = (
            tuple(replace(row, zero_ticks=zeros.get(row.id, row.zero_ticks)) for row in rows)
            for rows in (calibration.joints, calibration.twins)
        )
        replace(calibration, joints=joints, twins=twins).save(calibration_file)
    write_atomically(file, edited)
    return tuple(backups)


def _backup(file: Path, text: str) -> Path:
    """Write ``text`` to the first free path FILE.N.bak and return that path."""
    number = 1
    while (kept := file.with_name(f"{file.name}.{number}.bak")).exists():
        number += 1
    write_atomically(kept, text)
    return kept
