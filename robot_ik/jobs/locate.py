"""Where a camera stands, from pictures of a board whose pose is known."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, locate_camera
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import open_source
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import Observation, Target
from robot_ik.errors import CameraNotFoundError, FrameTimeoutError, MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.jobs import Progress
from robot_ik.jobs.pictures import GUESSED_FROM, frames_of, hint_of_other_markers
from robot_ik.ports import Image

# Corners of a good calibration and a flat board miss by a few tenths of a pixel.
_DOUBTFUL_PX = 1.0


@dataclass(frozen=True)
class LocateRequest:
    """A camera and a board; neither moves.

    Attributes:
        source: As for ``open_source``.
        intrinsics: The camera's calibration file.
        board: As for ``parse_target``; ``dictionary`` of its markers, empty: the usual one.
        pose_parent_board: Where the board's frame is, seen from the frame that is called ``parent``.
        pictures: No more than so many are looked at.
    """

    source: str
    intrinsics: Path | str
    board: str
    dictionary: str = ""
    pose_parent_board: Pose = field(default_factory=Pose)
    parent: str = "world"
    pictures: int = 20


@dataclass(frozen=True, eq=False)
class LocateReport:
    """What came out.

    Attributes:
        extrinsics: The camera's pose by all pictures that show the board.
        searched: How many pictures were looked at.
        misses: Of each picture that shows the board: the median distance of its corners from where they
            would be by that pose, px.
    """

    extrinsics: CameraExtrinsics
    searched: int
    misses: Sequence[float]

    @property
    def _doubtful(self) -> int:
        return sum(miss > _DOUBTFUL_PX for miss in self.misses)

    @property
    def believed(self) -> bool:
        """Whether a picture agrees with all together; else the pose is of no use."""
        return self._doubtful < len(self.misses)

    @property
    def doubt(self) -> str:
        """What may be wrong where a picture has the board elsewhere; empty: none has."""
        if not self._doubtful:
            return ""
        count, most = len(self.misses), max(self.misses)
        moved = "camera or board moved, or " if count > 1 else ""
        return (
            f"in {self._doubtful} of {count} pictures the board is elsewhere, by up to {most:.1f} px: {moved}"
            f"the board is not flat or not of this size, or the calibration is of another camera"
        )


def run_locate(
    request: LocateRequest,
    *,
    progress: Progress = lambda phase, share: None,
    left_out: Callable[[str], None] = lambda why: None,
) -> LocateReport:
    """Looks for the board, and finds the camera by all pictures that show it.

    ``left_out`` is given why a file cannot be used.

    Raises:
        MarkerNotFoundError: No picture shows the board; the hint says what may be wrong.
        RobotIkError: Wrong input or environment, or board or camera moved between the pictures.
    """
    board = parse_target(request.board, request.dictionary)
    intrinsics = CameraIntrinsics.load(request.intrinsics)
    views: list[Observation] = []
    searched, blank = 0, deque[Image](maxlen=GUESSED_FROM)
    # A camera may give no more.
    with open_source(request.source) as source, contextlib.suppress(FrameTimeoutError):
        for frame in frames_of(source):
            if isinstance(frame, CameraNotFoundError):
                left_out(str(frame.args[0]))
                continue
            searched += 1
            view = board.find(frame, intrinsics)
            if view is None:
                blank.append(frame.image)
            else:
                views.append(view)
            progress("looking", searched / request.pictures)
            if searched == request.pictures:
                break
    if not views:
        pictures = f"{searched} picture{'' if searched == 1 else 's'}"
        raise MarkerNotFoundError(
            f"no board {request.board} in {pictures} of {request.source}", hint=_unseen_hint(board, blank)
        )
    extrinsics = locate_camera(views, request.pose_parent_board, intrinsics, parent=request.parent)
    pose_camera_board = extrinsics.pose_parent_camera.inverse() @ request.pose_parent_board
    return LocateReport(extrinsics, searched, [_miss(view, pose_camera_board, intrinsics) for view in views])


def _miss(view: Observation, pose_camera_board: Pose, intrinsics: CameraIntrinsics) -> float:
    expected = intrinsics.project(pose_camera_board.apply(view.points))
    return float(np.median(np.linalg.norm(expected - view.pixels, axis=1)))


def _unseen_hint(board: Target, blank: Sequence[Image]) -> str:
    """What may be wrong when no picture shows the board: markers of another dictionary are named."""
    dictionary, hint = getattr(getattr(board, "pattern", board), "dictionary", ""), ""
    if dictionary and not any(MarkerDetector(dictionary, strict=True).detect(image) for image in blank):
        hint = hint_of_other_markers(dictionary, blank)
    return hint or "check its sizes and dictionary, light and focus; the whole board should be in view"
