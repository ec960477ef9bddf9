"""The hand-eye job through the simulated arm: both mountings, interruption, samples on file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticScene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import Observation
from robot_ik.errors import CalibrationError, CameraError, ConfigError, MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.jobs.arm_camera import handeye
from robot_ik.jobs.arm_camera.handeye import (
    HandEyeRequest,
    handeye_from_samples,
    run_handeye,
    samples_path,
)
from robot_ik.jobs.arm_camera.samples import SampleSet
from robot_ik.jobs.arm_camera.view_planning import ViewTask, plan_views
from robot_ik.robot import Robot, load_robot

Array = NDArray[np.float64]


class Drawn(FrameSource):
    """A light camera: the markers of the scene where the servos' shafts put them, before a wall."""

    live = True
    blind = False

    def __init__(self, scene: SyntheticScene, true_q: Any, seed: int = 0, **rest: Any) -> None:
        self.scene, self.true_q = scene, true_q
        self.size = scene.intrinsics.size
        self.rng = np.random.default_rng(seed)

    def read(self) -> Frame:
        q, scene = self.true_q(), self.scene
        camera = scene.camera(q)
        seen = {m.id: (m.size, camera.inverse().compose(m.pose_world(scene, q, 0.0))) for m in scene.markers}
        facing = {
            id: (size, pose)
            for id, (size, pose) in sorted(seen.items(), key=lambda one: -one[1][1].position[2])
            if pose.rotation[:, 2] @ pose.position < 0 < pose.position[2] and not self.blind
        }
        image = render_markers(
            scene.intrinsics, facing, self.rng, dictionary=scene.markers[0].dictionary, margin=0.15
        )
        return Frame(np.repeat(image[:, :, None], 3, axis=2), 0.0, 0)


PLANS: dict[tuple[object, ...], list[Array]] = {}


def planned(
    robot: Robot, task: ViewTask, count: int, *, start: Array, seed: int, collisions: None
) -> list[Array]:
    """Stations, searched for once: the scenes of this file differ in robot, mounting and camera alone."""
    key = (robot.name, task.mount.mounting, task.intrinsics, count, start.tobytes(), seed)
    if key not in PLANS:
        PLANS[key] = plan_views(robot, task, count, start=start, seed=seed, collisions=collisions)
    return PLANS[key]


@pytest.fixture(autouse=True)
def _drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small pictures that are quickly made."""
    monkeypatch.setattr(handeye, "plan_views", planned)
    scene_for = handeye.scene_for

    def small(*arguments: Any) -> Any:
        return replace(scene_for(*arguments), intrinsics=STANDARD_CAMERA)

    monkeypatch.setattr(handeye, "scene_for", small)
    monkeypatch.setattr(handeye, "SyntheticSource", Drawn)


def test_a_standing_camera_is_found_by_an_arm_of_servos(tmp_path: Path) -> None:
    kept: list[int] = []
    report = run_handeye(
        HandEyeRequest(robot="tabletop_puma", views=5, seed=2), keep=lambda samples: kept.append(len(samples))
    )
    result = report.result
    assert result is not None and report.true_error is not None and report.truth is not None
    assert kept == [1, 2, 3, 4, 5] and report.parent == "world" and report.unseen == () and not report.doubt
    position, angle = report.true_error
    assert position < 2e-3 and angle < np.deg2rad(0.4)
    assert position < 5 * result.sigma_position
    # joint angles are those of the servos' registers, not those that were asked for
    assert any(
        np.abs(q - asked).max() > 0.0 for q, asked in zip(report.samples.q, report.stations, strict=True)
    )
    assert all(
        np.abs(q - asked).max() < 0.01 for q, asked in zip(report.samples.q, report.stations, strict=True)
    )
    # the place and the samples on file say the same
    report.extrinsics().save(tmp_path / "place.toml")
    place = CameraExtrinsics.load(tmp_path / "place.toml", report.samples.intrinsics)
    assert place.parent == "world" and place.views == 5
    path = samples_path(tmp_path / "place.toml")
    report.samples.save(path)
    again = handeye_from_samples(SampleSet.load(path))
    assert again.result is not None and again.truth is None
    assert max(again.result.pose_parent_camera.distance(place.pose_parent_camera)) < 1e-9
    np.testing.assert_allclose(again.result.covariance, result.covariance, rtol=1e-6)
    other = replace(report.samples.intrinsics, width=320, height=240)
    with pytest.raises(CalibrationError, match="320x240"):
        handeye_from_samples(SampleSet.load(path), other)


def test_a_carried_camera_is_found() -> None:
    report = run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=6))
    assert report.result is not None and report.true_error is not None
    assert report.parent == "gripper" == report.extrinsics().parent
    position, angle = report.true_error
    assert position < 1e-3 and angle < np.deg2rad(0.15)


@pytest.mark.parametrize(("name", "frame"), [("panda", "hand_tcp"), ("ur5e", "gripper")])
def test_a_carried_camera_is_not_put_into_the_arm(name: str, frame: str) -> None:
    robot = load_robot(name)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(robot.home)
    mujoco.mj_forward(robot.model, data)
    camera = robot.forward(robot.home, frame).compose(handeye._beside_the_tool(robot, frame))
    ahead = camera.apply(np.array([0.0, 0.0, 1.0])) - camera.position
    hit = mujoco.mj_ray(robot.model, data, camera.position, ahead, None, 1, -1, np.zeros(1, np.int32), None)
    assert hit < 0.0 or hit > 0.1


def test_an_interruption_keeps_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[SampleSet] = []
    read = Drawn.read

    def interrupted(source: Drawn) -> Frame:
        if kept and len(kept[-1]) == 2:
            raise KeyboardInterrupt
        return read(source)

    monkeypatch.setattr(Drawn, "read", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=4), keep=kept.append)
    assert len(kept[-1]) == 2


def test_a_board_that_is_not_there_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Drawn, "blind", True)
    with pytest.raises(MarkerNotFoundError, match="at 0 of 4 stations"):
        run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=4))


def test_a_dry_run_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Drawn, "read", None)
    report = run_handeye(HandEyeRequest(mounting="eye_in_hand", bus="none", views=4, dry_run=True))
    assert len(report.stations) == 4 and report.result is None and len(report.samples) == 0


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"camera": "0"}, CalibrationError, "has no calibration"),
        ({"camera": "0", "intrinsics": Path("x.yaml")}, CameraError, "what board"),
        ({"board": parse_target("marker:7:50")}, ConfigError, "a board of its own"),
    ],
)
def test_what_is_missing_is_reported_before_anything_moves(
    changes: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        run_handeye(HandEyeRequest(bus="none", **changes))


@pytest.mark.parametrize("text", [None, "{", "{}", '{"schema": 1, "mounting": "beside"}'])
def test_a_file_without_samples_is_reported(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "some.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(
        CameraError, match="cannot be read: No such file" if text is None else "holds no samples"
    ):
        SampleSet.load(path)


def test_samples_of_views_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    samples = SampleSet("puma560", ("joint1",), "gripper", "eye_in_hand", STANDARD_CAMERA)
    view = Observation(np.eye(4, 3), np.ones((4, 2)), Pose())
    samples.add(np.zeros(1), view)
    path = tmp_path / "some.json"
    samples.save(path)
    read = SampleSet.load(path)
    np.testing.assert_array_equal(read.views[0].points, view.points)
    assert read.intrinsics.digest == STANDARD_CAMERA.digest
    with pytest.raises(CalibrationError, match="1 views are too few"):
        handeye_from_samples(read)
