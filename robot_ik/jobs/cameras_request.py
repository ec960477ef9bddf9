"""What every job says that moves an arm before a camera, and how a camera with a calibration is opened."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from robot_ik.camera.boards.board import Board
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import FrameSource, open_source
from robot_ik.errors import CalibrationError
from robot_ik.jobs.reach_request import ReachRequest, Rehearsal


@dataclass(frozen=True)
class ArmCameraRequest:
    """An arm, a camera, a board, and how many pictures to take of it.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        bus: ``sim``, ``pty`` or a serial port.
        arm_file: None: the one beside the model, else a generic one.
        frame: What carries camera or board; None: the tool, or what carries the stage's markers.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file; needed for a real camera.
        board: None: the simulated one.
        views: How many pictures.
        speed: Share of the joints' speed limits.
        seed: Of planning and of the simulated noise.
    """

    robot: str = "puma560"
    bus: str = "sim"
    arm_file: Path | None = None
    frame: str | None = None
    camera: str = "synthetic"
    intrinsics: Path | None = None
    board: Board | None = None
    views: int = 15
    speed: float = 1.0
    seed: int = 0

    @property
    def shared(self) -> dict[str, Any]:
        """These attributes by name, for a request of another kind."""
        return {one.name: getattr(self, one.name) for one in fields(ArmCameraRequest)}

    def limbs(self, rehearsal: Rehearsal | None = None) -> ReachRequest:
        """What ``prepare_limbs`` is asked for."""
        return ReachRequest(
            robot=self.robot, frame=self.frame, bus=self.bus, arm_file=self.arm_file,
            speed=self.speed, seed=self.seed, rehearsal=rehearsal or Rehearsal(),
        )  # fmt: skip


def calibration_of(camera: str, intrinsics: Path | None) -> Path:
    """The file, for a camera that shall measure.

    Raises:
        CalibrationError: None was given.
    """
    if intrinsics is None:
        raise CalibrationError(
            f"the camera {camera!r} has no calibration, so nothing can be measured in its pictures",
            hint="give its calibration file (OpenCV or ROS YAML): --intrinsics FILE; "
            "make one with: robot-ik camera calibrate",
        )
    return intrinsics


def open_calibrated(
    camera: str,
    intrinsics: Path | None,
    stack: contextlib.ExitStack,
    *,
    size: tuple[int, int] | None = None,
    scaled: bool = False,
) -> tuple[FrameSource, CameraIntrinsics]:
    """A camera that can measure.

    Args:
        camera: What ``open_source`` opens.
        intrinsics: Its calibration file.
        stack: Closes it.
        size: (width, height) to ask of it.
        scaled: Whether a calibration for the same picture at another size will do.

    Raises:
        CalibrationError: There is no calibration, or it is for other pictures.
        CameraError: The camera cannot be opened.
    """
    lens = CameraIntrinsics.load(calibration_of(camera, intrinsics))
    source = stack.enter_context(open_source(camera, size=size))
    delivered = tuple(getattr(source, "size", lens.size))
    if scaled and delivered != lens.size:
        return source, lens.scaled(*delivered)
    lens.require_size(*delivered)
    return source, lens
