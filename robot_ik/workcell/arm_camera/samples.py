"""Files with the measurements of an arm and a camera, to solve them again without moving."""

from __future__ import annotations

import json
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import ConfigDict, ValidationError

from robot_ik.camera.calibration.extrinsics import Covariance, today
from robot_ik.camera.calibration.handeye import MIN_VIEWS, HandEyeSample, Mounting
from robot_ik.camera.calibration.kinematic import KnownPose
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import Observation
from robot_ik.config import (
    Pair,
    Position,
    SchemaVersion,
    Several,
    Table,
    Wxyz,
    config_error,
    parse_json,
    read_text,
    shown,
)
from robot_ik.errors import CameraError, ConfigError, MarkerNotFoundError, RobotIkError
from robot_ik.files import plain, write_atomically
from robot_ik.geometry import Pose
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot


@dataclass(eq=False)
class SampleSet:
    """Joint angles read from the servos, and the corners of the board in the picture at each.

    Attributes:
        robot: Robot, see ``load_robot``.
        joints: Active joints, in the order of ``q``.
        frame: Frame that carries the camera or the board.
        mounting: What the arm carries.
        intrinsics: Intrinsics of the pictures.
        date: Date of the measurement, ISO 8601.
        q: Joint angles (nq,) of each station.
        views: Observation of the board at each station.
    """

    robot: str
    joints: tuple[str, ...]
    frame: str
    mounting: Mounting
    intrinsics: CameraIntrinsics
    date: str = field(default_factory=today)
    q: list[Array] = field(default_factory=list)
    views: list[Observation] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.q)

    def add(self, q: Array, view: Observation) -> None:
        self.q.append(np.array(q, dtype=float))
        self.views.append(view)

    def require(self, stations: int, hint: str) -> None:
        """Check that there are enough samples.

        Args:
            stations: Number of stations that were visited.
            hint: What to check beside board and light, for the message.

        Raises:
            MarkerNotFoundError: There are too few samples.
        """
        if len(self) < MIN_VIEWS:
            raise MarkerNotFoundError(
                f"the board was seen at {len(self)} of {stations} stations; "
                f"at least {MIN_VIEWS} are needed",
                hint=f"check board, dictionary and light, and {hint}",
            )

    def load_robot(self) -> Robot:
        """Return the robot with the active joints of ``q``."""
        return load_robot(self.robot, joints=self.joints)

    def samples(self, robot: Robot) -> list[HandEyeSample]:
        """Return the samples for ``solve_handeye``, with the hand by forward kinematics."""
        return [
            HandEyeSample(robot.forward(q, self.frame), view)
            for q, view in zip(self.q, self.views, strict=True)
        ]

    def as_values(self) -> dict[str, Any]:
        """Return the content of the file."""
        rows = [
            {"q": q, **{key: getattr(view, key) for key in ("points", "pixels", "sigma", "bias")}}
            | plain(view.pose)
            for q, view in zip(self.q, self.views, strict=True)
        ]
        lens = {key: getattr(self.intrinsics, key) for key in _Lens.model_fields}
        facts = {
            key: getattr(self, key) for key in ("date", "robot", "joints", "frame", "mounting")
        }
        return {"schema": 1, "job": "handeye", **facts, "intrinsics": lens, "samples": rows}

    def save(self, path: Path) -> None:
        """Write a JSON file atomically.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(path, json.dumps(plain(self.as_values())) + "\n")

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file of ``save``. A ``SampleSet`` also reads files of ``VerifySamples``.

        Raises:
            CameraError: The file is missing or invalid.
        """
        of_verify = issubclass(cls, VerifySamples)
        of = "an arm before a standing camera" if of_verify else "a hand-eye calibration"
        command = "verify" if of_verify else "handeye"
        hint = f"give the file that robot-ik camera {command} leaves beside its result"
        try:
            text = read_text(path, "the file of samples")
        except ConfigError as error:
            raise CameraError(str(error.args[0]), hint=hint) from error
        try:
            return cls._of_values(parse_json(text, path))
        except (ValueError, RobotIkError) as error:
            problem = config_error(error, path) if isinstance(error, ValidationError) else error
            reason = str(problem.args[0]).removeprefix(f"{path}: ")
            raise CameraError(f"{path} holds no samples of {of} ({reason})", hint=hint) from error

    @classmethod
    def _of_values(cls, data: Any) -> Self:
        of_verify = isinstance(data, dict) and data.get("job") == "verify"
        return cls._of_file((_VerifyFile if of_verify else _SampleFile).model_validate(data))

    @classmethod
    def _of_file(cls, file: _SampleFile, **others: Any) -> Self:
        """Return the samples of a file, with further fields ``others``.

        Raises:
            ValueError: A sample has another number of angles than joints.
            RobotIkError: Another value is invalid.
        """
        lens = CameraIntrinsics(**file.intrinsics.model_dump())
        samples = cls(file.robot, file.joints, file.frame, file.mounting, lens, file.date, **others)
        for k, sample in enumerate(file.samples):
            if len(sample.q) != len(file.joints):
                raise ValueError(
                    f"samples[{k}].q: {len(sample.q)} angles of {len(file.joints)} joints"
                )
            points = np.array(sample.points)
            pixels = np.array(sample.pixels)
            view = Observation(
                points, pixels, Pose(sample.position, sample.wxyz), sample.sigma, sample.bias
            )
            samples.add(np.array(sample.q), view)
        return samples


@dataclass(eq=False)
class VerifySamples(SampleSet):
    """Samples, and the prior knowledge of their measurement.

    Attributes:
        camera: Prior pose of the camera.
        board: Prior pose of the board.
        by_arm: Whether the camera's pose was found by moving the arm.
        true_offsets: (nv,) true joint offsets, rad. None if they are unknown.
        servos: Row of the arm file for each joint, with which ``q`` was read, as JSON values.
    """

    _: KW_ONLY
    camera: KnownPose
    board: KnownPose
    by_arm: bool
    true_offsets: Array | None = None
    servos: tuple[dict[str, Any], ...] = ()

    def as_values(self) -> dict[str, Any]:
        """Return the content of the file."""
        return super().as_values() | {
            "job": "verify",
            "camera": plain(self.camera.pose) | {"covariance": self.camera.covariance},
            "board": plain(self.board.pose) | {"covariance": self.board.covariance},
            "by_arm": self.by_arm,
            "true_offsets": self.true_offsets,
            "servos": self.servos,
        }

    @classmethod
    def _of_values(cls, data: Any) -> Self:
        job = data.get("job") if isinstance(data, dict) else None
        if isinstance(job, str) and job != "verify":
            raise ValueError(f"they are of {shown(job)}, and have no pose of the camera")
        file = _VerifyFile.model_validate(data)
        offsets = None if file.true_offsets is None else np.array(file.true_offsets, dtype=float)
        poses = {"camera": file.camera.known(), "board": file.board.known(), "by_arm": file.by_arm}
        servos = tuple(row.model_dump() for row in file.servos)
        return cls._of_file(file, **poses, true_offsets=offsets, servos=servos)

    def arm(self, file: Path) -> ArmConfig:
        """Return the arm of a file, with the joints of the samples.

        Raises:
            ConfigError: A joint is missing or differs from the arm of the measurement.
        """
        config = ArmConfig.load(file)
        by_name = {joint.name: joint for joint in config.joints}
        for row in self.servos:
            joint = by_name.get(row["name"])
            if joint is None or plain(joint) != row:
                problem = "has been changed since the arm was measured"
                if joint is None:
                    problem = "is missing"
                raise ConfigError(
                    f"joint {row['name']!r} {problem}, so these samples are not of this arm",
                    file=file,
                    key="joints",
                    hint="measure again",
                )
        if unknown := [name for name in self.joints if name not in by_name]:
            raise ConfigError(
                f"joint {unknown[0]!r} of the samples is missing",
                file=file,
                key="joints",
                allowed=", ".join(by_name),
            )
        return replace(config, joints=tuple(by_name[name] for name in self.joints))


class _Lens(Table):
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Several[float]
    model: str


class _Sample(Table):
    q: Several[float]
    points: Several[Position]
    pixels: Several[Pair]
    sigma: float
    bias: float = 0.0
    position: Position
    wxyz: Wxyz


class _SampleFile(Table):
    version: SchemaVersion
    job: str
    robot: str
    joints: Several[str]
    frame: str
    mounting: Mounting
    intrinsics: _Lens
    date: str
    samples: Several[_Sample]


class _Known(Table):
    position: Position
    wxyz: Wxyz
    covariance: Covariance

    def known(self) -> KnownPose:
        return KnownPose(Pose(self.position, self.wxyz), np.array(self.covariance))


class _Servo(Table):
    model_config = ConfigDict(extra="allow")

    name: str


class _VerifyFile(_SampleFile):
    camera: _Known
    board: _Known
    by_arm: bool
    true_offsets: Several[float] | None
    servos: Several[_Servo]
