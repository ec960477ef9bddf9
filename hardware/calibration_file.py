"""The calibration file: what was measured at an arm, so that it can be compared with the arm later."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from robot_ik.errors import ConfigError
from robot_ik.files import config_error, read_toml, write_atomically
from robot_ik.hardware.control_table import MULTI_TURN_TICKS

SCHEMA = 1
"""Raised when a key changes its meaning."""

SUFFIX = ".calibration.toml"
"""``my_arm.toml`` has its calibration beside it in ``my_arm.calibration.toml``."""


@dataclass(frozen=True)
class JointCalibration:
    """One joint and a servo of it, as measured.

    Attributes:
        name, id, model, firmware: Which; ``drive_mode``, ``homing_offset``: registers 10 and 20.
        range_min, range_max: Present Position at the ends of the sweep, ticks.
        direction: +1 or -1; ``zero_ticks``: Present Position at q = 0.
        urdf_lower, urdf_upper: Limits of the model then, deg (mm of a slide).
        present_at_save: Present Position at the end, ticks.
    """

    name: str
    id: int
    model: str
    firmware: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int
    direction: int
    zero_ticks: int
    urdf_lower: float
    urdf_upper: float
    present_at_save: int


@dataclass(frozen=True)
class Calibration:
    """A calibrated arm.

    Attributes:
        arm: Name in the arm file; ``robot``: model; ``created``: ISO 8601; ``baud``: bits/s.
        joints: In the order of the arm file.
        twins: The second servos, of joints that two of them turn.
        file: Where it was read from, for messages.
    """

    arm: str
    robot: str
    created: str
    baud: int
    joints: tuple[JointCalibration, ...]
    twins: tuple[JointCalibration, ...] = ()
    file: Path | None = None

    @property
    def rows(self) -> tuple[JointCalibration, ...]:
        """Every servo, in the order of ``ArmConfig.servos``."""
        return self.joints + self.twins

    def save(self, path: Path) -> None:
        """Writes the file whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        lines = [f"schema = {SCHEMA}"]
        lines += [f"{k} = {json.dumps(getattr(self, k))}" for k in ("arm", "robot", "created")]
        lines += ["", "[bus]", f"baud = {self.baud}"]
        for table, rows in (("joints", self.joints), ("twins", self.twins)):
            for row in rows:
                lines += ["", f"[[{table}]]", *(f"{k} = {json.dumps(v)}" for k, v in asdict(row).items())]
        write_atomically(path, "\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Reads and checks a file.

        Raises:
            ConfigError: It cannot be read, or a key is unknown, missing or out of range.
        """
        try:
            found = _File.model_validate(read_toml(path, "the calibration"))
        except ValidationError as error:
            raise config_error(error, path) from None
        joints, twins = (
            tuple(JointCalibration(**row.model_dump()) for row in rows)
            for rows in (found.joints, found.twins)
        )
        for joint in joints + twins:
            if joint.range_min >= joint.range_max:
                raise ConfigError(f"the range of {joint.name!r} is empty", file=path, key="range_min")
        return cls(found.arm, found.robot, found.created, found.bus.baud, joints, twins, path)


def calibration_beside(arm_file: Path) -> Path:
    """Where the calibration of an arm file is, or would be."""
    return arm_file.with_name(arm_file.stem + SUFFIX)


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


_Ticks = Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)]
_Degrees = Annotated[float, Field(allow_inf_nan=False)]


class _Joint(_Table):
    name: str
    id: Annotated[int, Field(ge=0, le=252)]
    model: str
    firmware: Annotated[int, Field(ge=0, le=255)]
    drive_mode: Annotated[int, Field(ge=0, le=255)]
    homing_offset: _Ticks
    range_min: _Ticks
    range_max: _Ticks
    direction: Literal[1, -1]
    zero_ticks: _Ticks
    urdf_lower: _Degrees
    urdf_upper: _Degrees
    present_at_save: _Ticks


class _Bus(_Table):
    baud: int


class _File(_Table):
    version: Annotated[Literal[1], Field(alias="schema")]
    arm: str
    robot: str
    created: str
    bus: _Bus
    joints: Annotated[list[_Joint], Field(min_length=1)]
    twins: list[_Joint] = []


def as_plain(calibration: Calibration) -> dict[str, Any]:
    """For JSON."""
    content = asdict(calibration)
    content["file"] = str(calibration.file) if calibration.file else ""
    return content
