"""What was measured of an arm before a camera, in a file: it can be judged again without moving."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from robot_ik.camera.arm_zeros.model import KnownPose
from robot_ik.errors import ConfigError
from robot_ik.files import plain, shown, write_atomically
from robot_ik.geometry import Pose
from robot_ik.hardware.config import ArmConfig
from robot_ik.jobs.handeye_samples import Place, SampleSet, Turn, read_samples

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class VerifySamples:
    """Samples, and what was known when they were taken.

    Attributes:
        samples: Joint angles and what was seen there.
        camera, board: Their poses as they were known.
        by_arm: Whether the camera's place was found by moving the arm.
        true_offsets: (nv,) rad; None where nobody knows.
        servos: Each joint's row of the arm file, as JSON holds it: what ``q`` was read with.
    """

    samples: SampleSet
    camera: KnownPose
    board: KnownPose
    by_arm: bool
    true_offsets: Array | None = None
    servos: tuple[dict[str, Any], ...] = ()

    def __len__(self) -> int:
        return len(self.samples)

    def save(self, path: Path) -> None:
        """Writes JSON, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        values = self.samples.as_values() | {
            "job": "verify",
            "camera": _pose_values(self.camera),
            "board": _pose_values(self.board),
            "by_arm": self.by_arm,
            "true_offsets": self.true_offsets,
            "servos": self.servos,
        }
        write_atomically(path, json.dumps(plain(values)) + "\n")

    @classmethod
    def load(cls, path: Path) -> VerifySamples:
        """Reads what ``save`` wrote.

        Raises:
            CameraError: Missing, or no such file.
        """
        return read_samples(path, cls._of_values, "an arm before a standing camera", "verify")

    @classmethod
    def _of_values(cls, data: Any) -> VerifySamples:
        job = data.get("job") if isinstance(data, dict) else None
        if isinstance(job, str) and job != "verify":
            raise ValueError(f"they are of {shown(job, str)}, which does not know the camera's place")
        file = _File.model_validate(data)
        offsets = file.true_offsets
        return cls(
            SampleSet.of_values(data),
            _pose_of(file.camera),
            _pose_of(file.board),
            file.by_arm,
            None if offsets is None else np.array(offsets, dtype=float),
            tuple(row.model_dump() for row in file.servos),
        )

    def arm(self, file: Path) -> ArmConfig:
        """The arm of a file, if the joints were read with it.

        Raises:
            ConfigError: It has other joints, or one has been changed since.
        """
        config = ArmConfig.load(file)
        by_name = {joint.name: joint for joint in config.joints}
        for row in self.servos:
            joint = by_name.get(row["name"])
            if joint is None or servo_values(joint) != row:
                what = "is not there" if joint is None else "has been changed since the arm was measured"
                raise ConfigError(
                    f"joint {row['name']!r} {what}, so these samples say nothing of this arm",
                    file=file, key="joints", hint="measure again",
                )  # fmt: skip
        if unknown := [name for name in self.samples.joints if name not in by_name]:
            raise ConfigError(
                f"there is no joint {unknown[0]!r}, of which the samples are",
                file=file, key="joints", allowed=", ".join(by_name),
            )  # fmt: skip
        return replace(config, joints=tuple(by_name[name] for name in self.samples.joints))


def servo_values(joint: Any) -> dict[str, Any]:
    """One joint's row as JSON gives it back."""
    values: dict[str, Any] = json.loads(json.dumps(plain(asdict(joint))))
    return values


def _pose_values(known: KnownPose) -> dict[str, Any]:
    return {"position": known.pose.position, "wxyz": known.pose.wxyz, "covariance": known.covariance}


def _pose_of(data: _Known) -> KnownPose:
    return KnownPose(Pose(data.position, data.wxyz), np.array(data.covariance))


_Six = Annotated[list[float], Field(min_length=6, max_length=6)]


class _Known(BaseModel):
    model_config = ConfigDict(strict=True)

    position: Place
    wxyz: Turn
    covariance: Annotated[list[_Six], Field(min_length=6, max_length=6)]


class _Servo(BaseModel):
    model_config = ConfigDict(extra="allow")

    name: str


class _File(BaseModel):
    model_config = ConfigDict(strict=True)

    job: str
    camera: _Known
    board: _Known
    by_arm: bool
    true_offsets: list[float] | None
    servos: list[_Servo]
