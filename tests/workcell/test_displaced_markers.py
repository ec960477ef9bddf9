"""Jobs reject a marker of a board that is not at its place, from half a pixel on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.synthetic.camera import SyntheticMarker, SyntheticScene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import Observation, marker_grid
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import load_robot
from robot_ik.workcell import locate as locate_job
from robot_ik.workcell import vision
from robot_ik.workcell.arm_camera import verify
from robot_ik.workcell.arm_camera.camera_and_board import HandEyeRequest
from robot_ik.workcell.arm_camera.handeye import run_handeye
from robot_ik.workcell.arm_camera.verify import VerifyRequest, run_verify
from robot_ik.workcell.locate import LocateRequest, run_locate
from robot_ik.workcell.robot_setup import RobotSetup
from robot_ik.workcell.scene import scene_for
from tests.camera.rendering import board_picture
from tests.workcell.arm_camera.drawn_camera import DrawnCamera, use_drawn_camera

BOARD = marker_grid(3, 3, size=0.04, gap=0.01)
#: The marker in the middle.
DISPLACED = 4
ROBOT = "tabletop_puma"
POSE = Pose((0.01, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0)).compose(
    Pose(wxyz=rotation_exp([0.4, 0.0, 0.0]))
)
#: Displacements, px.
DISPLACEMENTS = (0.0, 0.5, 1.0, 4.0)


@pytest.mark.parametrize("pixels", DISPLACEMENTS)
def test_locate_rejects_a_displaced_marker(
    pixels: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    displacement = pixels * POSE.position[2] / STANDARD_CAMERA.fx
    frame = board_picture(BOARD, POSE, displaced=DISPLACED, displacement=displacement)
    cv2.imwrite(str(tmp_path / "photo.png"), frame.image)
    STANDARD_CAMERA.save(tmp_path / "lens.yaml")
    views: list[Observation] = []
    locate_camera = locate_job.locate_camera

    def record_views(observations: Sequence[Observation], *arguments: Any, **options: Any) -> Any:
        views.extend(observations)
        return locate_camera(observations, *arguments, **options)

    monkeypatch.setattr(locate_job, "locate_camera", record_views)
    report = run_locate(
        LocateRequest(str(tmp_path / "photo.png"), tmp_path / "lens.yaml", "grid:3x3:40:10")
    )
    assert [view.rejected for view in views] == [(DISPLACED,) if pixels else ()]
    assert report.extrinsics.pose_parent_camera.distance(POSE.inverse())[0] < 1e-4


@pytest.mark.parametrize("pixels", DISPLACEMENTS)
def test_hand_eye_rejects_a_displaced_marker(
    pixels: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_drawn_camera(monkeypatch)
    # The simulated board has the ids 30 to 35.
    monkeypatch.setattr(DrawnCamera, "displaced", {34: pixels})
    report = run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=6))
    rejected = [view.rejected for view in report.samples.views]
    assert rejected == [(34,) if pixels else ()] * 6


@pytest.mark.parametrize("pixels", DISPLACEMENTS)
def test_verify_rejects_a_displaced_marker(
    pixels: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_drawn_camera(monkeypatch)
    monkeypatch.setattr(DrawnCamera, "displaced", {DISPLACED: pixels})
    scene = scene_for(load_robot(ROBOT))
    # The board is on a side of the cube that the tool carries.
    _, side = next(iter(scene.cube.values()))
    pose_hand_board = scene.cube_offset.compose(side)
    setups: list[RobotSetup] = []
    prepare = verify.prepare_robot

    def prepare_once(request: VerifyRequest) -> RobotSetup:
        setups.append(prepare(request))
        return setups[0]

    def open_drawn_camera(*_: Any, **__: Any) -> DrawnCamera:
        (setup,) = setups
        carried = partial(SyntheticMarker, dictionary=BOARD.dictionary, frame=scene.cube_frame)
        markers = [
            carried(marker_id, size, pose_hand_board.compose(pose))
            for marker_id, (size, pose) in BOARD.markers.items()
        ]
        synthetic = SyntheticScene(
            setup.robot, STANDARD_CAMERA, scene.pose_world_camera, tuple(markers)
        )
        return DrawnCamera(synthetic, setup.true_q)

    monkeypatch.setattr(verify, "prepare_robot", prepare_once)
    monkeypatch.setattr(vision, "open_source", open_drawn_camera)
    STANDARD_CAMERA.save(tmp_path / "lens.yaml")
    CameraExtrinsics(
        scene.pose_world_camera,
        "world",
        1e-8 * np.eye(6),
        0.1,
        0.1,
        "2026-01-01",
        STANDARD_CAMERA.digest,
    ).save(tmp_path / "place.toml")
    report = run_verify(
        VerifyRequest(
            ROBOT,
            camera="0",
            intrinsics=tmp_path / "lens.yaml",
            extrinsics=tmp_path / "place.toml",
            views=4,
            frame=scene.cube_frame,
            board=BOARD,
            pose_other_board=pose_hand_board,
        )
    )
    rejected = [view.rejected for view in report.samples.views]
    assert rejected == [(DISPLACED,) if pixels else ()] * 4
