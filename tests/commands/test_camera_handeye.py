"""``robot-ik camera handeye``: output and errors. tests/workcell tests the job."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.calibration.handeye import Mount
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import Observation, marker_points
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import load_robot
from robot_ik.workcell.arm_camera import handeye
from robot_ik.workcell.arm_camera.samples import SampleSet

CAMERA = Pose((0.05, 0.01, -0.08), rotation_exp([0.0, -0.1, 0.4]))
POINTS = marker_points(0.12)


def seen_from_the_gripper(turned: tuple[float, ...], count: int) -> SampleSet:
    """Return samples of a carried camera that sees a large marker. The seventh is wrong.

    Args:
        turned: Largest deviation of each joint from home, rad.
        count: Number of samples.
    """
    robot = load_robot("puma560")
    rng = np.random.default_rng(0)
    board = (
        robot.forward(robot.home, "gripper")
        .compose(CAMERA)
        .compose(Pose((0, 0, 0.6), (0, 1, 0, 0)))
    )
    made = SampleSet("puma560", robot.joints, "gripper", "eye_in_hand", STANDARD_CAMERA)
    truth = Mount(CAMERA, board, "eye_in_hand")
    while len(made) < count:
        q = robot.clip(robot.home + rng.uniform(-1, 1, 6) * turned)
        seen = truth.pose_parent_camera.inverse().compose(
            robot.forward(q, "gripper").inverse().compose(truth.pose_other_board)
        )
        if seen.position[2] < 0.2 or seen.rotation[2, 2] > -0.5:
            continue
        pixels = STANDARD_CAMERA.project(seen.apply(POINTS)) + rng.normal(0, 0.1, (4, 2))
        if len(made) == 6:
            pixels[:, 0] += (8.0, -7.0, 6.0, -9.0)
        made.add(q, Observation(POINTS, pixels, seen))
    return made


@pytest.fixture
def samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SampleSet:
    """Return samples in which the wrist is turned, saved in an empty folder."""
    monkeypatch.chdir(tmp_path)
    made = seen_from_the_gripper((0.05, 0.05, 0.05, 0.5, 0.4, 1.0), 10)
    made.save(Path("some.samples.json"))
    return made


def test_samples_are_solved_again_without_moving(robot_ik: Any, samples: SampleSet) -> None:
    run = robot_ik("camera", "handeye", "--samples", "some.samples.json")
    assert run.code == 0, run
    assert run.out.count("contradicts the others") == 1
    for words in (
        "camera seen from gripper",
        "board seen from world",
        "uncertainty",
        "left out",
    ):
        assert words in run.out
    # The true error of real samples is unknown.
    assert "true error" not in run.out
    place = CameraExtrinsics.load("extrinsics.toml", STANDARD_CAMERA)
    assert place.parent == "gripper"
    position, angle = place.pose_parent_camera.distance(CAMERA)
    assert position < 2e-3 and angle < np.deg2rad(0.25)
    facts = json.loads(
        robot_ik("camera", "handeye", "--samples", "some.samples.json", "--json", "--overwrite").out
    )
    assert facts["outliers"] == [6] and len(facts["views"]) == 10 and facts["true_error"] is None
    assert "measurements of the arm disagree" not in run.err and facts["doubt"] == ""
    np.testing.assert_array_equal(facts["camera"]["position"], place.pose_parent_camera.position)


def test_an_arm_whose_zero_is_off_is_reported(
    robot_ik: Any, samples: SampleSet, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    tick = 2.0 * np.pi / 4096
    for q in samples.q:
        q += rng.uniform(-0.5, 0.5, 6) * tick
    assert handeye.handeye_from_samples(samples).doubt == "", "ticks alone are a sound arm's"
    for q in samples.q:
        q[[1, 4]] += np.deg2rad(1.5)
    samples.save(Path("off.json"))
    run = robot_ik("camera", "handeye", "--samples", "off.json", "--json")
    assert run.code == 0 and "the measurements of the arm disagree" in run.err, run
    doubt = json.loads(run.out)["doubt"]
    assert "robot-ik camera verify --fit" in doubt
    # Loading the file logs the doubt.
    with caplog.at_level("WARNING", "robot_ik.camera"):
        assert CameraExtrinsics.load("extrinsics.toml").doubt == doubt
    assert f"extrinsics.toml: {doubt}" in caplog.text


def test_a_zero_that_is_off_by_half_a_degree_is_named() -> None:
    made = seen_from_the_gripper((0.3, 0.3, 0.3, 0.8, 0.6, 1.0), 15)
    assert handeye.handeye_from_samples(made).doubt == ""
    for q in made.q:
        q[2] -= np.deg2rad(0.5)
    doubt = handeye.handeye_from_samples(made).doubt
    assert "the zero of joint3 seems to be off by 0.5" in doubt and "camera verify --fit" in doubt


def test_ctrl_c_prints_the_command_that_continues(
    robot_ik: Any, samples: SampleSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(request: Any, *, keep: Any, **rest: Any) -> None:
        keep(samples)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)

    monkeypatch.setattr(handeye, "run_handeye", interrupted)
    run = robot_ik("camera", "handeye", "--out", "mine.toml")
    assert run.code == 130 and "after 10 views" in run.err
    assert "--samples mine.samples.json" in run.err
    assert not Path("mine.toml").exists()
    assert len(SampleSet.load(Path("mine.samples.json"))) == 10


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--views", "3"], "--views: 3 is out of range"),
        (["--speed", "0"], "--speed: 0.0 is out of range"),
        (["--bus", "none"], "without servos"),
        (["--board", "plank"], "is not a board"),
        (["--camera-guess", "1", "2"], "--camera-guess"),
        (["--samples", "nowhere.json"], "nowhere.json: the file of samples cannot be read"),
        (["--camera", "0"], "has no calibration"),
    ],
)
def test_contradicting_options_are_reported(
    robot_ik: Any, arguments: list[str], words: str
) -> None:
    run = robot_ik("camera", "handeye", *arguments)
    run.assert_one_screen_error()
    assert words in run.err
