"""What ``run_verify`` shall do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_ik.camera.boards.board import Board
from robot_ik.geometry import Pose

#: How well the board's place on the arm is known unless said otherwise, each axis: metres, rad.
BOARD_SIGMA = (2e-4, float(np.deg2rad(0.1)))


@dataclass(frozen=True)
class VerifyRequest:
    """An arm that carries a board before a standing camera.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        bus: ``sim``, ``pty`` or a serial port.
        arm_file: None: the one beside the model, else a generic one.
        frame: What carries the board; None: the tool, or what carries the stage's markers.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file; needed for a real camera.
        place: File of the camera's place; needed for a real camera, the simulated one is located first.
        board: None: the simulated one.
        pose_frame_board: Where the board is on ``frame``; None: the simulated one, or its frame.
        board_sigma: How well that is known, each axis: metres, rad.
        views: How many pictures.
        fit: Whether to estimate the joints' zero offsets.
        speed: Share of the joints' speed limits.
        seed: Of planning and of the simulated noise.
        zero_offset_deg: Joint -> degrees by which a simulated servo's shaft is ahead of its registers.
    """

    robot: str = "puma560"
    bus: str = "sim"
    arm_file: Path | None = None
    frame: str | None = None
    camera: str = "synthetic"
    intrinsics: Path | None = None
    place: Path | None = None
    board: Board | None = None
    pose_frame_board: Pose | None = None
    board_sigma: tuple[float, float] = BOARD_SIGMA
    views: int = 30
    fit: bool = False
    speed: float = 1.0
    seed: int = 0
    zero_offset_deg: Mapping[str, float] = field(default_factory=dict)
