"""What every job says that moves an arm before a camera."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from robot_ik.camera.boards.board import Board
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
