"""``robot-ik camera locate`` as a user meets it, and its file given to ``reach``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import marker_grid
from robot_ik.commands.reach import Reach, load_camera_pose
from robot_ik.commands.tables import pose_text
from robot_ik.errors import CalibrationError, OptionError
from robot_ik.geometry import Pose, rotation_exp

SEEN = Pose((0.03, -0.02, 0.6), (0, 1, 0, 0)).compose(Pose(wxyz=rotation_exp([0.5, -0.3, 0.2])))
BOARD = Pose((0.4, -0.1, 0.02), rotation_exp([0.0, 0.0, 0.7]))
GRID = ("--board", "grid:2x2:50:12.5", "--dictionary", "DICT_4X4_50")


@pytest.fixture(scope="module")
def images() -> list[Any]:
    """Two pictures of a board of four."""
    rng = np.random.default_rng(0)
    markers = {
        id: (side, SEEN.compose(pose))
        for id, (side, pose) in marker_grid(2, 2, 0.05, 0.0125).markers.items()
    }
    return [render_markers(STANDARD_CAMERA, markers, rng, margin=0.12) for _ in range(2)]


@pytest.fixture(autouse=True)
def _photographs(images: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("shots").mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(f"shots/{number}.png", image)
    cv2.imwrite("shots/2.png", np.full((480, 640), 128, np.uint8))
    Path("shots/1a.png").write_text("no picture")
    STANDARD_CAMERA.save("camera.yaml")


def test_nothing_is_written_when_all_pictures_are_doubted(robot_ik: Any) -> None:
    image = cv2.imread("shots/1.png")
    cv2.imwrite("shots/1.png", np.roll(image, 25, axis=1))  # the camera was knocked
    run = robot_ik("camera", "locate", "shots", "--intrinsics", "camera.yaml", *GRID)
    assert run.code == 1 and "doubtful: in 2 of 2 pictures" in run.err
    assert "camera or board moved" in run.err and "extrinsics.toml is not written" in run.err
    assert run.out == "" and not Path("extrinsics.toml").exists()


def test_one_picture_that_contradicts_the_others_is_reported(robot_ik: Any) -> None:
    image = cv2.imread("shots/1.png")
    for number in range(3, 8):
        cv2.imwrite(f"shots/{number}.png", image)
    cv2.imwrite("shots/8.png", np.roll(image, 25, axis=1))
    run = robot_ik("camera", "locate", "shots", "--intrinsics", "camera.yaml", *GRID)
    assert run.code == 0 and "doubtful: in 1 of 8 pictures" in run.err, run
    assert CameraExtrinsics.load("extrinsics.toml").views == 8


def test_a_folder_of_pictures_gives_a_file_that_reach_takes(robot_ik: Any) -> None:
    place = [str(v) for v in (*BOARD.position, *BOARD.wxyz)]
    run = robot_ik(
        "camera",
        "locate",
        "shots",
        "--intrinsics",
        "camera.yaml",
        *GRID,
        "--board-pose",
        *place,
    )
    assert (
        run.code == 0 and "2 of 3 show the board" in run.out and "wrote extrinsics.toml" in run.err
    ), run
    assert "left out: shots/1a.png is not a picture" in run.err and "doubtful" not in run.err
    true = BOARD.compose(SEEN.inverse())
    found = CameraExtrinsics.load("extrinsics.toml")
    position, angle = found.pose_parent_camera.distance(true)
    assert position < 1.5e-3 and angle < np.deg2rad(0.15)
    assert position < 4 * found.sigma_position
    reach = Reach(camera="0", intrinsics=Path("camera.yaml"), extrinsics=Path("extrinsics.toml"))
    assert load_camera_pose(reach) == found.pose_parent_camera
    dataclasses.replace(STANDARD_CAMERA, fx=802.0).save("other.yaml")
    with pytest.raises(CalibrationError, match="another calibration"):
        load_camera_pose(dataclasses.replace(reach, intrinsics=Path("other.yaml")))
    with pytest.raises(OptionError, match="the calibration is missing"):
        load_camera_pose(dataclasses.replace(reach, intrinsics=None))
    dataclasses.replace(found, parent="gripper").save("carried.toml")
    with pytest.raises(CalibrationError, match="'gripper'"):
        load_camera_pose(dataclasses.replace(reach, extrinsics=Path("carried.toml")))


def test_json(robot_ik: Any) -> None:
    run = robot_ik(
        "camera", "locate", "shots/0.png", "--intrinsics", "camera.yaml", *GRID, "--json"
    )
    facts = json.loads(run.out)
    assert run.code == 0 and facts["parent"] == "world" and facts["pictures"] == facts["used"] == 1
    np.testing.assert_allclose(facts["camera"]["position"], SEEN.inverse().position, atol=2e-3)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["shots/2.png", *GRID], 1, "check its sizes and dictionary"),
        (["shots/0.png", *GRID[:2]], 1, "exist in DICT_4X4_50: 0, 1, 2, 3: --dictionary DICT_4X4"),
        (["shots/0.png", "--board", "plank"], 2, "'plank' is not a board"),
        (["shots/0.png", *GRID, "--board-pose", "1", "2"], 2, "2 numbers"),
        (["shots/0.png", *GRID, "--board-pose", *"1230000"], 2, "zero quaternion"),
        (["shots/0.png", *GRID, "--count", "0"], 2, "--count"),
        (["nowhere.png", *GRID], 2, "nowhere.png"),
    ],
)
def test_what_cannot_be_done_is_reported(
    robot_ik: Any, arguments: list[str], code: int, words: str
) -> None:
    run = robot_ik("camera", "locate", *arguments, "--intrinsics", "camera.yaml")
    run.assert_one_screen_error(code)
    assert words in run.err
    assert not Path("extrinsics.toml").exists()


def test_a_pose_for_people_has_no_minus_zero() -> None:
    shown = pose_text(Pose((-1e-9, 0.0, -0.1), (1.0, -1e-9, 0.0, 0.0)))
    assert shown == "0.00 0.00 -100.00 mm, wxyz 1.00000 0.00000 0.00000 0.00000"
