"""What was measured for a hand-eye calibration, in a file: it can be solved again without moving the arm."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from robot_ik.camera.boards.view import BoardView
from robot_ik.camera.handeye.model import HandEyeSample, Mounting
from robot_ik.camera.handeye.places import today
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CameraError, ConfigError, RobotIkError
from robot_ik.files import config_error, parse_json, plain, read_text, write_atomically
from robot_ik.geometry import Pose
from robot_ik.robot import Robot, load_robot

Array = NDArray[np.float64]

_SCHEMA = 1


@dataclass(eq=False)
class SampleSet:
    """Joint angles read from the servos, and the board's corners in the picture taken there.

    Attributes:
        robot: As for ``load_robot``; ``joints`` are the active ones, in the order of ``q``.
        frame: What carries camera or board.
        mounting: Which of the two.
        intrinsics: Of the pictures.
        date: ISO 8601.
        q: (nq,) of each stop; ``views``: what was seen there.
    """

    robot: str
    joints: tuple[str, ...]
    frame: str
    mounting: Mounting
    intrinsics: CameraIntrinsics
    date: str = field(default_factory=today)
    q: list[Array] = field(default_factory=list)
    views: list[BoardView] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.q)

    def add(self, q: Array, view: BoardView) -> None:
        """One stop more."""
        self.q.append(np.array(q, dtype=float))
        self.views.append(view)

    def load_robot(self) -> Robot:
        """The robot with the joints that ``q`` is of."""
        return load_robot(self.robot, joints=self.joints)

    def samples(self, robot: Robot) -> list[HandEyeSample]:
        """For ``solve_handeye``: the hand where the joint angles put it."""
        return [
            HandEyeSample(robot.forward(q, self.frame), view)
            for q, view in zip(self.q, self.views, strict=True)
        ]

    def as_values(self) -> dict[str, Any]:
        """For JSON."""
        lens = self.intrinsics
        return {
            "schema": _SCHEMA,
            "job": "handeye",
            "date": self.date,
            "robot": self.robot,
            "joints": self.joints,
            "frame": self.frame,
            "mounting": self.mounting,
            "intrinsics": {
                "width": lens.width, "height": lens.height, "fx": lens.fx, "fy": lens.fy,
                "cx": lens.cx, "cy": lens.cy, "distortion": lens.distortion, "model": lens.model,
            },
            "samples": [
                {
                    "q": q,
                    "points": view.points,
                    "pixels": view.pixels,
                    "sigma": view.sigma,
                    "position": view.pose_camera_board.position,
                    "wxyz": view.pose_camera_board.wxyz,
                }
                for q, view in zip(self.q, self.views, strict=True)
            ],
        }  # fmt: skip

    @classmethod
    def of_values(cls, data: Any) -> SampleSet:
        """What ``as_values`` gave, through JSON.

        Raises:
            ValueError (pydantic's ValidationError among them), RobotIkError: It is something else.
        """
        file = _File.model_validate(data)
        lens = CameraIntrinsics(**file.intrinsics.model_dump())
        found = cls(file.robot, tuple(file.joints), file.frame, file.mounting, lens, file.date)
        for k, one in enumerate(file.samples):
            if len(one.q) != len(file.joints):
                raise ValueError(f"samples[{k}].q: {len(one.q)} angles of {len(file.joints)} joints")
            view = BoardView(one.points, one.pixels, Pose(one.position, one.wxyz), one.sigma)
            found.add(np.array(one.q), view)
        return found

    def save(self, path: Path) -> None:
        """Writes JSON, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(path, json.dumps(plain(self.as_values())) + "\n")

    @classmethod
    def load(cls, path: Path) -> SampleSet:
        """Reads what ``save`` wrote.

        Raises:
            CameraError: Missing, or no such file.
        """
        return read_samples(path, cls.of_values, "a hand-eye calibration", "handeye")


class _Table(BaseModel):
    model_config = ConfigDict(strict=True)


Place = Annotated[list[float], Field(min_length=3, max_length=3)]
Turn = Annotated[list[float], Field(min_length=4, max_length=4)]


class _Lens(_Table):
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float]
    model: str


class _Sample(_Table):
    q: list[float]
    points: list[Place]
    pixels: list[Annotated[list[float], Field(min_length=2, max_length=2)]]
    sigma: float
    position: Place
    wxyz: Turn


class _File(_Table):
    version: Annotated[Literal[1], Field(alias="schema")]
    robot: str
    joints: list[str]
    frame: str
    mounting: Mounting
    intrinsics: _Lens
    date: str
    samples: list[_Sample]


Made = TypeVar("Made")


def read_samples(path: Path, made: Callable[[Any], Made], of: str, command: str) -> Made:
    """What ``made`` makes of a JSON file.

    Raises:
        CameraError: It is missing, or ``made`` can make nothing of it.
    """
    hint = f"give the file that robot-ik camera {command} leaves beside its result"
    try:
        text = read_text(path, "the file of samples")
    except ConfigError as error:
        raise CameraError(str(error.args[0]), hint=hint) from error
    try:
        return made(parse_json(text, path))
    except (ValueError, RobotIkError) as error:
        found = config_error(error, path) if isinstance(error, ValidationError) else error
        reason = str(found.args[0]).removeprefix(f"{path}: ")
        raise CameraError(f"{path} holds no samples of {of} ({reason})", hint=hint) from error
