"""What ``run_verify`` shall do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_ik.geometry import Pose
from robot_ik.jobs.cameras_request import ArmCameraRequest

#: How well the board's place on the arm is known unless said otherwise, each axis: metres, rad.
BOARD_SIGMA = (2e-4, float(np.deg2rad(0.1)))


@dataclass(frozen=True)
class VerifyRequest(ArmCameraRequest):
    """An arm that carries a board before a standing camera.

    Attributes:
        place: File of the camera's place; needed for a real camera, the simulated one is located first.
        pose_frame_board: Where the board is on ``frame``; None: the simulated one, or its frame.
        board_sigma: How well that is known, each axis: metres, rad.
        fit: Whether to estimate the joints' zero offsets.
        zero_offset_deg: Joint -> degrees by which a simulated servo's shaft is ahead of its registers.
    """

    views: int = 30
    place: Path | None = None
    pose_frame_board: Pose | None = None
    board_sigma: tuple[float, float] = BOARD_SIGMA
    fit: bool = False
    zero_offset_deg: Mapping[str, float] = field(default_factory=dict)
