"""The hand-eye job through the simulated arm: both mountings, interruption, samples in files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import Observation
from robot_ik.errors import CalibrationError, CameraError, ConfigError, MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot
from robot_ik.workcell.arm_camera import stations
from robot_ik.workcell.arm_camera.camera_and_board import HandEyeRequest, camera_beside_tool
from robot_ik.workcell.arm_camera.handeye import handeye_from_samples, run_handeye, samples_path
from robot_ik.workcell.arm_camera.samples import SampleSet
from robot_ik.workcell.arm_camera.view_planning import ViewTask, plan_views
from tests.workcell.arm_camera.drawn_camera import DrawnCamera, use_drawn_camera

PLANS: dict[tuple[object, ...], list[Array]] = {}


def planned(
    robot: Robot, task: ViewTask, count: int, *, start: Array, seed: int, collisions: None
) -> list[Array]:
    """Plan the views once for equal scenes. They differ in robot, mounting and camera alone."""
    key = (robot.name, task.mount.mounting, task.intrinsics, count, start.tobytes(), seed)
    if key not in PLANS:
        PLANS[key] = plan_views(robot, task, count, start=start, seed=seed, collisions=collisions)
    return PLANS[key]


@pytest.fixture(autouse=True)
def _drawn_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stations, "plan_views", planned)
    use_drawn_camera(monkeypatch)


def test_a_standing_camera_is_found_by_an_arm_of_servos(tmp_path: Path) -> None:
    kept: list[int] = []
    report = run_handeye(
        HandEyeRequest(robot="tabletop_puma", views=5, seed=2),
        keep=lambda samples: kept.append(len(samples)),
    )
    result = report.result
    assert result is not None
    assert report.true_error is not None
    assert report.truth is not None
    assert kept == [1, 2, 3, 4, 5]
    assert report.parent == "world"
    assert report.unseen == ()
    assert not report.doubt
    position, angle = report.true_error
    assert position < 2e-3
    assert angle < np.deg2rad(0.4)
    assert position < 5 * result.sigma_position
    # The joint angles are those of the servos' registers, not the planned ones.
    pairs = zip(report.samples.q, report.stations, strict=True)
    deviations = [np.abs(q - station).max() for q, station in pairs]
    assert 0.0 < max(deviations) < 0.01

    # The file of the pose and the file of the samples give the same result.
    report.extrinsics().save(tmp_path / "place.toml")
    place = CameraExtrinsics.load(tmp_path / "place.toml", report.samples.intrinsics)
    assert place.parent == "world"
    assert place.views == 5
    path = samples_path(tmp_path / "place.toml")
    report.samples.save(path)
    repeated = handeye_from_samples(SampleSet.load(path))
    assert repeated.result is not None
    assert repeated.truth is None
    assert max(repeated.result.pose_parent_camera.distance(place.pose_parent_camera)) < 1e-9
    np.testing.assert_allclose(repeated.result.covariance, result.covariance, rtol=1e-6)
    other_size = replace(report.samples.intrinsics, width=320, height=240)
    with pytest.raises(CalibrationError, match="320x240"):
        handeye_from_samples(SampleSet.load(path), other_size)


def test_a_carried_camera_is_found() -> None:
    report = run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=6))
    assert report.result is not None
    assert report.true_error is not None
    assert report.parent == "gripper" == report.extrinsics().parent
    position, angle = report.true_error
    assert position < 1e-3
    assert angle < np.deg2rad(0.15)


@pytest.mark.parametrize(("name", "frame"), [("panda", "hand_tcp"), ("ur5e", "gripper")])
def test_a_carried_camera_is_outside_the_arm(name: str, frame: str) -> None:
    robot = load_robot(name)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(robot.home)
    mujoco.mj_forward(robot.model, data)
    camera = robot.forward(robot.home, frame).compose(camera_beside_tool(robot, frame))
    ahead = camera.apply(np.array([0.0, 0.0, 1.0])) - camera.position
    geom = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(robot.model, data, camera.position, ahead, None, 1, -1, geom, None)
    assert distance < 0.0 or distance > 0.1


def test_an_interruption_keeps_the_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[SampleSet] = []
    read = DrawnCamera.read

    def read_twice(source: DrawnCamera) -> Frame:
        if kept and len(kept[-1]) == 2:
            raise KeyboardInterrupt
        return read(source)

    monkeypatch.setattr(DrawnCamera, "read", read_twice)
    with pytest.raises(KeyboardInterrupt):
        run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=4), keep=kept.append)
    assert len(kept[-1]) == 2


def test_a_board_in_no_picture_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DrawnCamera, "hidden", None)
    with pytest.raises(MarkerNotFoundError, match="at 0 of 4 stations"):
        run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=4))


def test_a_dry_run_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DrawnCamera, "read", None)
    report = run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=4, dry_run=True))
    assert len(report.stations) == 4
    assert report.result is None
    assert len(report.samples) == 0


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"camera": "0"}, CalibrationError, "has no calibration"),
        ({"camera": "0", "intrinsics": Path("x.yaml")}, CameraError, "no board is given"),
        ({"board": parse_target("marker:7:50")}, ConfigError, "a simulated board"),
    ],
)
def test_missing_input_is_reported_before_anything_moves(
    changes: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        run_handeye(HandEyeRequest(bus="none", **changes))


@pytest.mark.parametrize("text", [None, "{", "{}", '{"schema": 1, "mounting": "beside"}'])
def test_a_file_without_samples_is_reported(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "some.json"
    message = "cannot be read: No such file"
    if text is not None:
        path.write_text(text)
        message = "holds no samples"
    with pytest.raises(CameraError, match=message):
        SampleSet.load(path)


def test_too_few_samples_are_rejected(tmp_path: Path) -> None:
    samples = SampleSet("puma560", ("joint1",), "gripper", "eye_in_hand", STANDARD_CAMERA)
    view = Observation(np.eye(4, 3), np.ones((4, 2)), Pose())
    samples.add(np.zeros(1), view)
    path = tmp_path / "some.json"
    samples.save(path)
    loaded = SampleSet.load(path)
    np.testing.assert_array_equal(loaded.views[0].points, view.points)
    assert loaded.intrinsics.digest == STANDARD_CAMERA.digest
    with pytest.raises(CalibrationError, match="1 views are too few"):
        handeye_from_samples(loaded)
