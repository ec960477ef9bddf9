"""Vision: true poses are not used, recordings end, no blocked loop."""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera import targets, tracker
from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.commands.reach_report import ReachReport
from robot_ik.errors import (
    CalibrationError,
    CameraError,
    FrameTimeoutError,
    MarkerNotFoundError,
    OptionError,
)
from robot_ik.geometry import Pose
from robot_ik.ports import RealClock, VirtualClock
from robot_ik.robot import load_robot
from robot_ik.workcell.scene import scene_for
from robot_ik.workcell.vision import wandering
from tests.waiting import wait_for


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write photo.png, blank.png, film.avi, pictures/ and the calibration into a folder.

    In the film the marker moves by 2 mm a picture.
    """
    folder = tmp_path_factory.mktemp("photos")
    robot = load_robot("puma560")
    scene = scene_for(robot)
    synthetic = scene.synthetic(robot)
    source = SyntheticSource(synthetic, lambda: robot.home)
    scene.intrinsics.save(folder / "camera.yaml")
    cv2.imwrite(str(folder / "photo.png"), source.read().image)
    source.scene = synthetic.with_marker(scene.marker_id, condition="blank")
    cv2.imwrite(str(folder / "blank.png"), source.read().image)
    (folder / "pictures").mkdir()
    cv2.imwrite(str(folder / "pictures" / "a1.png"), cv2.imread(str(folder / "blank.png")))
    cv2.imwrite(str(folder / "pictures" / "a2.png"), cv2.imread(str(folder / "photo.png")))
    film = cv2.VideoWriter(
        str(folder / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 15, scene.intrinsics.size
    )
    home = scene.pose_world_marker
    for k in range(12):
        moved = Pose(np.add(home.position, [0.002 * k, 0.0, 0.0]), home.wxyz)
        source.scene = synthetic.with_marker(scene.marker_id, pose=moved)
        film.write(source.read().image)
    film.release()
    return folder


@pytest.fixture
def look(reach: Any, photos: Path) -> Any:
    """Run reach with a file of ``photos`` and its calibration."""

    def run(name: str, *fault: str, **options: Any) -> ReachReport:
        settings = {
            "intrinsics": photos / "camera.yaml",
            "marker_size": 0.1,
            "bus": "none",
            **options,
        }
        report: ReachReport = reach(*fault, camera=str(photos / name), **settings)
        return report

    return run


def test_no_picture_with_truth_ever_reaches_a_tracker(
    monkeypatch: pytest.MonkeyPatch, reach: Any
) -> None:
    seen = []
    for module in (targets, tracker):
        real = module.find_corners

        def spy(frame: Any, *rest: Any, real: Any = real, **more: Any) -> Any:
            seen.append(frame.truth)
            return real(frame, *rest, **more)

        monkeypatch.setattr(module, "find_corners", spy)
    assert reach(follow=1.0).ok
    assert len(seen) > 5 and all(truth is None for truth in seen)


@pytest.mark.usefixtures("full_pictures")
def test_a_lying_truth_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, reach: Any, healthy: ReachReport
) -> None:
    lie = Pose((9.0, 9.0, 9.0))
    lies = {"pose_world_marker": {7: lie, 20: lie, 21: lie}}
    monkeypatch.setattr(SyntheticSource, "_truth", lambda self, *rest: lies)
    report = reach()
    assert report.ok and report.seen.true_pose == healthy.seen.true_pose  # type: ignore[union-attr]
    np.testing.assert_array_equal(report.goal.target.position, healthy.goal.target.position)  # type: ignore[union-attr]
    assert report.judged.by_camera.position == healthy.judged.by_camera.position  # type: ignore[union-attr]


@pytest.mark.parametrize("name", ["photo.png", "pictures", "film.avi"])
def test_recorded_pictures_go_the_same_way(name: str, look: Any, healthy: ReachReport) -> None:
    report = look(name)
    assert report.ok and report.judged.by_camera is None and "recorded" in report.verdict
    assert report.seen.true_pose is None
    scene = report.vision.scene
    assert report.seen.pose_world_marker.distance(scene.pose_world_marker)[0] < 1.5e-3
    camera = scene.pose_world_camera.inverse().compose(scene.pose_world_marker)
    assert report.seen.observation.pose.distance(camera)[0] < 1.5e-3


def test_a_camera_that_stands_elsewhere(
    look: Any, healthy: ReachReport, photos: Path, tmp_path: Path
) -> None:
    scene = healthy.vision.scene  # type: ignore[union-attr]
    moved = Pose(
        np.add(scene.pose_world_camera.position, [0.02, 0.0, 0.0]), scene.pose_world_camera.wxyz
    )
    file = tmp_path / "extrinsics.toml"
    intrinsics = CameraIntrinsics.load(photos / "camera.yaml")
    CameraExtrinsics(
        moved, "world", 1e-8 * np.eye(6), 0.1, 0.1, "2026-01-01", intrinsics.digest
    ).save(file)
    report = look("photo.png", extrinsics=file)
    shift = report.goal.target.position - healthy.goal.target.position  # type: ignore[union-attr]
    np.testing.assert_allclose(shift, [0.02, 0, 0], atol=1e-3)


def test_a_photograph_without_the_marker_ends(look: Any) -> None:
    report = look("blank.png")
    assert isinstance(report.error, MarkerNotFoundError) and not report.ok
    # These are the markers of the gripper.
    assert "in view: 20, 23" in str(report.error)
    report = look("photo.png", marker=3)
    assert isinstance(report.error, MarkerNotFoundError) and "marker 3" in str(report.error)


def test_a_film_is_followed_to_its_last_place(look: Any) -> None:
    report = look("film.avi", follow=1.5, bus="sim")
    assert report.ok
    home = report.vision.scene.pose_world_marker.position
    np.testing.assert_allclose(
        report.seen.pose_world_marker.position - home, [0.022, 0, 0], atol=2e-3
    )
    tool = report.robot.forward(report.setup.true_q(), "gripper").position
    assert np.linalg.norm(tool - report.goal.target.position) < 3e-3
    # The film is shorter than the run.
    assert report.followed.ticks.held > 20


@pytest.mark.parametrize(
    ("change", "error", "expected"),
    [
        ({"intrinsics": None}, CalibrationError, "--intrinsics"),
        ({"marker_size": None}, CameraError, "--marker-size"),
        ({"marker_size": -0.1}, CameraError, "size"),
        ({"dictionary": "DICT_5X5_5"}, CameraError, "DICT_5X5_50"),
        ({"marker": 99}, CameraError, "99"),
        ({"follow": 1.0}, OptionError, "photograph"),
        ({"marker_at": (0.0, 0.0, 0.0)}, OptionError, "synthetic"),
    ],
)
def test_wrong_input(
    change: dict[str, Any], error: type[Exception], expected: str, look: Any
) -> None:
    with pytest.raises(error) as caught:
        look("photo.png", **change)
    assert expected in f"{caught.value} {getattr(caught.value, 'hint', '')}"


def test_a_calibration_for_another_size(look: Any, photos: Path) -> None:
    picture = cv2.imread(str(photos / "photo.png"))
    cv2.imwrite(str(photos / "small.png"), cv2.resize(picture, (640, 360)))
    with pytest.raises(CalibrationError, match="1280x720"):
        look("small.png")


def test_the_pushed_marker_rests_wanders_and_rests() -> None:
    path = partial(wandering, Pose((0.1, 0.2, 0.3)), 10.0, 6.0, 0.05)
    early = path(9.0).position
    late = path(30.0).position
    np.testing.assert_array_equal(path(10.0).position, early)
    # The marker rests in the last second and a half.
    np.testing.assert_array_equal(path(14.5).position, late)
    assert np.linalg.norm(late - early) > 0.03
    places = np.array([path(t).position for t in np.linspace(9, 17, 801)])
    assert np.abs(np.diff(places, axis=0)).max() < 0.003 and np.ptp(places[:, 2]) == 0.0


class Counting:
    """A goal source that counts its observations and raises a given error."""

    def __init__(self, delay: float = 0.0) -> None:
        self.count = 0
        self.delay = delay
        self.error = None

    def observe(self, now: float, *, wait: bool = False) -> None:
        time.sleep(self.delay)
        if self.error is not None:
            raise self.error
        self.count += 1

    def goal_at(self, now: float) -> tuple[int, float]:
        return self.count, now


def test_on_virtual_time_pictures_come_at_their_rate() -> None:
    goals = Counting()
    clock = VirtualClock()
    with LatestGoals(goals, clock, 10.0) as latest:
        for k in range(100):
            clock.sleep_until(0.01 * k)
            assert latest.poll(clock.now()) == (goals.count, clock.now())
    assert goals.count == 10
    goals.error = FrameTimeoutError("over")
    with LatestGoals(goals, clock, 10.0) as latest:
        latest.poll(clock.now())
        assert latest.ended


def test_looking_never_holds_up_the_loop(real_time: None) -> None:
    goals = Counting(delay=0.2)
    clock = RealClock()
    before = sys.getswitchinterval()
    with LatestGoals(goals, clock, None) as latest:
        # The loop does not wait for the first picture.
        assert latest.poll(7.0) == (0, 7.0)
        wait_for(lambda: latest.poll(7.0) == (1, 7.0), "no goal comes")
        slowest = 0.0
        for _ in range(200):
            begin = time.monotonic()
            latest.poll(clock.now())
            slowest = max(slowest, time.monotonic() - begin)
        assert slowest < 0.2
    assert sys.getswitchinterval() == before


def test_what_looking_raises_comes_out_in_the_loop() -> None:
    goals = Counting()
    goals.error = CameraError("lens cap")
    with (
        LatestGoals(goals, RealClock(), None) as latest,
        pytest.raises(CameraError, match="lens cap"),
    ):
        for _ in range(30_000):
            latest.poll(time.monotonic())
            time.sleep(0.01)
