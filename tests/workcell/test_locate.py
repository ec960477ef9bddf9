"""The job that locates a camera by a board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.errors import MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.workcell.locate import LocateRequest, run_locate

SEEN = Pose((0.02, -0.03, 0.5), (0.0, 1.0, 0.0, 0.0))
BOARD = Pose((0.4, -0.1, 0.02))


@pytest.fixture
def request_of_two(tmp_path: Path) -> LocateRequest:
    """Return a request with two pictures of marker 7 in a folder."""
    shots = tmp_path / "shots"
    shots.mkdir()
    for number in range(2):
        rng = np.random.default_rng(number)
        image = render_markers(STANDARD_CAMERA, {7: (0.05, SEEN)}, rng, dictionary="DICT_5X5_50")
        cv2.imwrite(str(shots / f"{number}.png"), image)
    STANDARD_CAMERA.save(tmp_path / "lens.yaml")
    return LocateRequest(str(shots), tmp_path / "lens.yaml", "marker:7:50", pose_world_board=BOARD)


def test_the_report_has_pose_and_errors(request_of_two: LocateRequest) -> None:
    shares: list[float] = []
    report = run_locate(request_of_two, progress=lambda phase, share: shares.append(share))
    metres, radians = report.extrinsics.pose_parent_camera.distance(BOARD.compose(SEEN.inverse()))
    assert metres < 2e-3 and radians < 4e-3
    assert report.searched == len(report.errors) == 2 and max(report.errors) < 0.3
    assert report.believed and report.doubt == "" and shares == [0.05, 0.1]


def test_a_camera_that_moved_is_rejected(request_of_two: LocateRequest) -> None:
    file = Path(request_of_two.source) / "1.png"
    cv2.imwrite(str(file), np.roll(cv2.imread(str(file)), 25, axis=1))
    report = run_locate(request_of_two)
    assert not report.believed and "in 2 of 2 pictures the board is elsewhere" in report.doubt


def test_without_the_board_other_markers_are_named(request_of_two: LocateRequest) -> None:
    other = LocateRequest(
        request_of_two.source, request_of_two.intrinsics, "grid:2x2:50:10", "DICT_6X6_50"
    )
    with pytest.raises(
        MarkerNotFoundError, match="no board grid:2x2:50:10 in 2 pictures"
    ) as raised:
        run_locate(other)
    assert "check its sizes" in raised.value.hint or "DICT_5X5_50" in raised.value.hint
