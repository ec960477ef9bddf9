"""Locate a camera from pictures of a board whose pose is known."""

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
from robot_ik.ports import Image
from robot_ik.workcell.pictures import MAX_BLANK, frames_of, hint_of_other_markers
from robot_ik.workcell.progress import Progress

# A picture is doubtful if the median error of its corners is larger, px. With a good calibration
# and a flat board it is a few tenths.
_DOUBTFUL_PX = 1.0


@dataclass(frozen=True)
class LocateRequest:
    """A resting camera and a resting board.

    Attributes:
        source: Source of the pictures, see ``open_source``.
        intrinsics: Calibration file of the camera.
        board: Name of the board, see ``parse_target``.
        dictionary: Dictionary of its markers. Empty: the default one.
        pose_world_board: Pose of the board.
        pictures: Largest number of pictures that are read.
    """

    source: str
    intrinsics: Path | str
    board: str
    dictionary: str = ""
    pose_world_board: Pose = field(default_factory=Pose)
    pictures: int = 20


@dataclass(frozen=True, eq=False)
class LocateReport:
    """Result of ``run_locate``.

    Attributes:
        extrinsics: Pose of the camera by all pictures that show the board.
        searched: Number of pictures that were read.
        errors: Median reprojection error of the corners at that pose, px. One for each picture that
            shows the board.
    """

    extrinsics: CameraExtrinsics
    searched: int
    errors: Sequence[float]

    @property
    def _doubtful_count(self) -> int:
        return sum(error > _DOUBTFUL_PX for error in self.errors)

    @property
    def believed(self) -> bool:
        """Whether at least one picture agrees with the pose. Otherwise the pose is useless."""
        return self._doubtful_count < len(self.errors)

    @property
    def doubt(self) -> str:
        """Possible causes if pictures contradict the pose. Empty if none does."""
        if not self._doubtful_count:
            return ""
        count = len(self.errors)
        moved = "camera or board moved, or " if count > 1 else ""
        return (
            f"in {self._doubtful_count} of {count} pictures the board is elsewhere, by up to "
            f"{max(self.errors):.1f} px: {moved}the board is not flat or not of this size, or the "
            "calibration is of another camera"
        )


def run_locate(
    request: LocateRequest,
    *,
    progress: Progress = lambda _phase, _share: None,
    left_out: Callable[[str], None] = lambda _why: None,
) -> LocateReport:
    """Find the board in the pictures, and the camera by all pictures that show it.

    Args:
        request: Camera and board.
        progress: Called with the phase and its finished share.
        left_out: Called with the reason if a file cannot be used.

    Raises:
        MarkerNotFoundError: No picture shows the board. The hint names possible causes.
        RobotIkError: The input or the environment is wrong, or board or camera moved between the
            pictures.
    """
    board = parse_target(request.board, request.dictionary)
    intrinsics = CameraIntrinsics.load(request.intrinsics)
    views: list[Observation] = []
    searched = 0
    without_board: deque[Image] = deque(maxlen=MAX_BLANK)
    # A source that stops early is no error: the pictures read so far are used.
    with open_source(request.source) as source, contextlib.suppress(FrameTimeoutError):
        for frame in frames_of(source):
            if isinstance(frame, CameraNotFoundError):
                left_out(str(frame.args[0]))
                continue
            searched += 1
            view = board.find(frame, intrinsics)
            if view is None:
                without_board.append(frame.image)
            else:
                views.append(view)
            progress("looking", searched / request.pictures)
            if searched == request.pictures:
                break

    if not views:
        pictures = f"{searched} picture{'' if searched == 1 else 's'}"
        raise MarkerNotFoundError(
            f"no board {request.board} in {pictures} of {request.source}",
            hint=_not_found_hint(board, without_board),
        )
    extrinsics = locate_camera(views, request.pose_world_board, intrinsics)
    pose_camera_board = extrinsics.pose_parent_camera.inverse() @ request.pose_world_board
    errors = [_median_error(view, pose_camera_board, intrinsics) for view in views]
    return LocateReport(extrinsics, searched, errors)


def _median_error(
    view: Observation, pose_camera_board: Pose, intrinsics: CameraIntrinsics
) -> float:
    """Return the median reprojection error of the corners, px."""
    expected = intrinsics.project(pose_camera_board.apply(view.points))
    return float(np.median(np.linalg.norm(expected - view.pixels, axis=1)))


def _not_found_hint(board: Target, pictures: Sequence[Image]) -> str:
    """Return possible causes why no picture shows the board.

    Markers of other dictionaries in the pictures are named.
    """
    dictionary = getattr(getattr(board, "pattern", board), "dictionary", "")
    hint = ""
    if dictionary:
        detector = MarkerDetector(dictionary, strict=True)
        if not any(detector.detect(image) for image in pictures):
            hint = hint_of_other_markers(dictionary, pictures)
    return hint or (
        "check its sizes and dictionary, light and focus; the whole board should be in view"
    )
