"""A board with one displaced marker is judged alike by a tracker and by ``MarkerBoard.see``."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.camera.accuracy import frame_of
from robot_ik.camera.boards.board import MarkerBoard
from robot_ik.camera.bodies import grid_body
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.geometry import Pose, rotation_exp

BOARD = grid_body(3, 3, 0.03, 0.0075)
POSE = Pose((0.01, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0)).compose(
    Pose(wxyz=rotation_exp([0.4, 0.0, 0.0]))
)
DISPLACED = 4


def picture(displacement: float) -> np.ndarray:
    """The board with one marker displaced along x, metres."""
    placed = {}
    for marker_id, (size, pose) in BOARD.markers.items():
        if marker_id == DISPLACED:
            pose = Pose((displacement, 0.0, 0.0)).compose(pose)
        placed[marker_id] = (size, POSE.compose(pose))
    return render_markers(
        STANDARD_CAMERA, placed, np.random.default_rng(0), dictionary="DICT_5X5_50"
    )


@pytest.mark.parametrize("pixels", [0.0, 0.5, 1.0, 4.0])
def test_see_and_observe_body_reject_the_same_markers(pixels: float) -> None:
    frame = frame_of(picture(pixels * 0.5 / 800.0))
    view = MarkerBoard(BOARD.markers).see(frame, STANDARD_CAMERA)
    body = MarkerTracker(STANDARD_CAMERA, sizes=BOARD.sizes).observe_body(frame, BOARD)
    assert view is not None and body is not None
    assert body.rejected == (() if pixels == 0.0 else (DISPLACED,))
    assert len(view.points) == 4 * len(body.ids)
    assert view.pose_camera_board.distance(POSE)[0] < 2e-5
