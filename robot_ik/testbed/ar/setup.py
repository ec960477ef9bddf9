"""Choices of live augmented reality: camera, board, ball, and the measures against delay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ArBall = Literal["virtual", "marker"]
"""What moves the ball: keys and mouse (``virtual``), or a marker beside the board."""

Sync = Literal["tracked", "latest"]
"""Whether the video waits for the tracker, or the newest picture is shown."""

SYNTHETIC = "synthetic"
"""Name of the synthetic camera, which shows a table with the board."""

LONGEST_DELAY = 0.5
"""Largest delay that can be set, seconds."""


@dataclass(frozen=True)
class ArSetup:
    """Camera, board and ball.

    Attributes:
        camera: ``synthetic``, or a source for ``open_source``.
        intrinsics: Calibration file of the camera. Empty: a field of view of 60° is assumed.
        board: Board that the robot stands on, see ``parse_target``.
        dictionary: Dictionary of the markers. Empty: the usual one.
        ball: What moves the ball.
        marker: Id of the marker that is the ball.
        marker_size: Side of its black square, metres.
    """

    camera: str = SYNTHETIC
    intrinsics: str = ""
    board: str = "grid:2x2:50:12.5"
    dictionary: str = ""
    ball: ArBall = "virtual"
    marker: int = 9
    marker_size: float = 0.05


@dataclass(frozen=True)
class ArDelay:
    """When the pose of the board is known, and the measures against the delay (Azuma 1997).

    Attributes:
        seconds: Delay of the tracker, beside the time that tracking takes here.
        sync: ``tracked`` shows the picture in which the pose was measured: delayed video.
            ``latest`` shows the newest picture.
        predict: Draw where the board will be when the picture shown was taken.
        shift: Move the finished drawing by the motion of the board's points in the picture.
    """

    seconds: float = 0.0
    sync: Sync = "tracked"
    predict: bool = False
    shift: bool = False
