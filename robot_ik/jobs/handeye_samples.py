"""What was measured for a hand-eye calibration, in a file: it can be solved again without moving the arm."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.view import BoardView
from robot_ik.camera.handeye.model import MOUNTINGS, HandEyeSample, Mounting
from robot_ik.camera.handeye.places import today
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CameraError, RobotIkError
from robot_ik.files import plain, write_atomically
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
            ValueError, TypeError, KeyError, RobotIkError: It is something else.
        """
        if data["schema"] != _SCHEMA or data["mounting"] not in MOUNTINGS:
            raise ValueError("another schema or an unknown mounting")
        found = cls(
            str(data["robot"]), tuple(data["joints"]), str(data["frame"]), data["mounting"],
            CameraIntrinsics(**data["intrinsics"]), str(data["date"]),
        )  # fmt: skip
        for one in data["samples"]:
            pose = Pose(one["position"], one["wxyz"])
            found.add(np.array(one["q"]), BoardView(one["points"], one["pixels"], pose, one["sigma"]))
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


Made = TypeVar("Made")


def read_samples(path: Path, made: Callable[[Any], Made], of: str, command: str) -> Made:
    """What ``made`` makes of a JSON file.

    Raises:
        CameraError: It is missing, or ``made`` can make nothing of it.
    """
    try:
        return made(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise CameraError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, TypeError, KeyError, RobotIkError) as error:
        raise CameraError(
            f"{path} holds no samples of {of} ({error})",
            hint=f"give the file that robot-ik camera {command} leaves beside its result",
        ) from error
