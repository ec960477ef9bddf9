"""Guiding by hand and playing back, over a real port with the real SDK."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.hardware.config import ArmConfig
from robot_ik.motion import Trajectory
from robot_ik.workcell import guided_motion, guided_recording

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")

JOINTS = ("joint1", "joint2", "joint3")


def guide(desk: Any, seconds: float, done: threading.Event) -> threading.Thread:
    """A hand moves joint1 up by 30 degrees and joint3 down by 15, evenly."""

    def move() -> None:
        for _ in range(30):
            desk.turn("joint1", 1.0)
            desk.turn("joint3", -0.5)
            time.sleep(seconds / 30)
        done.set()

    thread = threading.Thread(target=move, name="hand")
    thread.start()
    return thread


def true_degrees(desk: Any) -> list[float]:
    return np.degrees(desk.bus.true_angles(desk.config)).tolist()


def test_what_a_hand_shows_is_played_again(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    file = tmp_path / "wave.csv"
    done = threading.Event()
    hand = guide(desk, 0.15, done)
    run = robot_ik("servo", "record", file, *desk.at, "--seconds", 0.4, "--rate", 100)
    hand.join()
    assert run.code == 0 and done.is_set(), run.err
    motion = guided_recording.load_motion(file, JOINTS)
    assert np.degrees(motion.q[0] - motion.q[-1])[1] == pytest.approx(0.0, abs=0.1)
    assert np.degrees(motion.q[-1]) == pytest.approx([30.0, 0.0, -15.0], abs=0.3)
    assert 0.3 < motion.duration < 3.0 and motion.times[0] == 0.0
    # At another pose, as after a pause.
    for joint, degrees in zip(JOINTS, (-26.0, 4.0, 11.0), strict=True):
        desk.turn(joint, degrees)
    run = robot_ik("servo", "replay", file, *desk.at, "--on-exit", "hold")
    assert run.code == 0, run.err
    assert true_degrees(desk) == pytest.approx([30.0, 0.0, -15.0], abs=0.4)
    assert desk.torque() == [True] * 3


def record(path: Path, degrees: list[list[float]], seconds: float) -> Path:
    times = np.linspace(0.0, seconds, len(degrees))
    Trajectory(times, np.radians(degrees), JOINTS).save_csv(path)
    return path


def test_what_is_too_fast_is_played_slower(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    file = record(tmp_path / "fast.csv", [[0, 0, 0], [90, 0, 0]], 0.1)  # 900 deg/s; the cap is 300
    run = robot_ik("servo", "replay", file, *desk.at)
    assert run.code == 0 and "3.00 x" in run.out, run.err
    assert true_degrees(desk)[0] == pytest.approx(90.0, abs=0.4) and desk.torque() == [False] * 3


def test_what_leaves_the_limits_is_refused(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    file = record(tmp_path / "far.csv", [[0, 0, 0], [0, 105, 0]], 2.0)
    run = robot_ik("servo", "replay", file, *desk.at)
    run.assert_one_screen_error()
    assert "joint2" in run.err and "5.0 deg" in run.err and "-100.0 to 100.0" in run.err
    assert true_degrees(desk)[1] == pytest.approx(0.0, abs=0.1)


def test_a_soft_stop_is_played_at_the_limit(desk: Any) -> None:
    motion = Trajectory([0.0, 1.0], np.radians([[0, 0, 0], [100.5, 0, 0]]), JOINTS)
    played, stretch = guided_motion.playable(motion, desk.config, 0.5)
    assert stretch == 2.0
    assert played.duration == pytest.approx(2.0 * (1.0 + guided_motion.SMOOTHING), abs=0.03)
    assert np.degrees(played.q.max()) == pytest.approx(100.0)


@pytest.mark.parametrize(
    "name", ["puma560", "tabletop_puma", "omx_f", "wx250s", "vx300s", "koch_v11"]
)
def test_what_begins_a_few_ticks_beyond_a_limit_is_playable(name: str, tmp_path: Path) -> None:
    arm = ArmConfig.load(name)
    config = arm
    ticks = 3.0 * np.array([abs(joint.value(1) - joint.value(0)) for joint in config.joints])
    middle = 0.5 * (config.lower + config.upper)
    # Servos measure an arm at rest a few ticks beyond its limits.
    for start in (config.lower - ticks, config.upper + ticks):
        file = tmp_path / "motion.csv"
        Trajectory([0.0, 5.0], [start, middle], config.names).save_csv(file)
        _, motion, _ = guided_recording.load_playable(file, arm, 1.0)
        assert (config.lower <= motion.q).all() and (motion.q <= config.upper).all()


def test_repeated_ticks_do_not_slow_the_replay_down(desk: Any) -> None:
    """Ticks read twice within a millisecond: a degree in no time."""
    times = np.sort(np.concatenate([np.arange(0.0, 2.0, 0.02), np.arange(0.0, 2.0, 0.02) + 0.0005]))
    # 50 deg/s in steps of a degree.
    degrees = np.outer(np.floor(50.0 * times - 0.0125), [1.0, 0.0, -1.0])
    motion = Trajectory(times, np.radians(degrees), JOINTS)
    assert motion.peak_velocity.max() > 4.0 * desk.config.velocity.max()
    played, stretch = guided_motion.playable(motion, desk.config, 1.0)
    assert stretch == 1.0
    assert played.q[0] == pytest.approx(motion.q[0]) and played.q[-1] == pytest.approx(motion.q[-1])
    assert np.degrees(played.at(1.05)) == pytest.approx([49.0, 0.0, -49.0], abs=1.5)


def test_the_way_to_the_beginning_keeps_its_share_of_the_caps(desk: Any) -> None:
    way = guided_motion.approach(np.zeros(3), np.array([1.0, -0.4, 0.0]), desk.config)
    share = guided_motion.APPROACH * 1.01
    assert (way.peak_velocity <= share * desk.config.velocity).all()
    assert (way.peak_acceleration <= share * desk.config.acceleration).all()
    assert way.q[-1] == pytest.approx([1.0, -0.4, 0.0])


def test_a_joint_that_does_not_follow_is_reported(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    desk.servo(3).stuck = True
    file = record(tmp_path / "m.csv", [[0, 0, 0], [0, 0, 5]], 0.1)
    run = robot_ik("servo", "replay", file, *desk.at)
    assert run.code == 1 and "joint3" in run.err and desk.torque() == [False] * 3


def test_torque_must_be_off_to_be_guided(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    desk.servo(1).memory.set("torque_enable", 1)
    desk.servo(1).memory.set("return_delay_time", 0)
    run = robot_ik("servo", "record", tmp_path / "m.csv", *desk.at, "--seconds", 0.1)
    run.assert_one_screen_error()
    assert "joint1" in run.err and not (tmp_path / "m.csv").exists()


def test_a_recording_beyond_the_limits_prints_a_warning(
    robot_ik: Any, desk: Any, tmp_path: Path
) -> None:
    desk.turn("joint2", 108.0)
    run = robot_ik("servo", "record", tmp_path / "m.csv", *desk.at, "--seconds", 0.05)
    assert run.code == 0 and "joint2 was 8.0 deg beyond" in run.err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("record", "m.txt"), "m.txt; allowed: a name that ends in .csv"),
        (("record", "m.csv", "--seconds", "nan"), "--seconds"),
        (("record", "m.csv", "--rate", 0), "--rate"),
        (("replay", "no.csv"), "no.csv"),
    ],
)
def test_wrong_input(
    words: tuple[Any, ...],
    named: str,
    robot_ik: Any,
    desk: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    run = robot_ik("servo", *words, *desk.at)
    run.assert_one_screen_error()
    assert named in run.err


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("[]", "table of joint positions"),
        ("time_s,commanded.joint1\n0.0,1.0\n", "joint1"),
        ("time_s,commanded.a\n0.0,1.0\n", "ar --motion"),
        ("time_s,commanded.joint1\n0.0,x\n", "line 2"),
        ("time_s,commanded.joint1\n0.0,1.0\n0.0,1.0\n", "increase"),
    ],
)
def test_wrong_recordings(
    content: str, named: str, robot_ik: Any, desk: Any, tmp_path: Path
) -> None:
    file = tmp_path / "m.csv"
    file.write_text(content)
    run = robot_ik("servo", "replay", file, *desk.at)
    assert run.code in (1, 2) and named in run.err and "Traceback" not in run.err
    assert desk.torque() == [False] * 3


def test_a_recording_without_the_gripper_moves_the_arm_alone(robot_ik: Any, tmp_path: Path) -> None:
    arm = ArmConfig.load("tabletop_puma")
    file = tmp_path / "reach.csv"
    record = tmp_path / "played.csv"
    chain = arm.chain
    home = np.clip(np.zeros(len(chain.joints)), chain.lower, chain.upper)
    Trajectory([0.0, 1.0], [home, home + 0.1 * (chain.upper - home)], chain.names).save_csv(file)
    run = robot_ik("servo", "replay", file, "--bus", "sim", "--record", record)
    assert run.code == 0 and "finger_left: held at the present value" in run.err, run.err
    assert "finger_left" not in Trajectory.load_csv(record).joints
    config, motion, _ = guided_recording.load_playable(file, arm, 1.0)
    assert config == chain and motion.joints == chain.names


def test_joints_in_another_order_are_put_right(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    file = tmp_path / "m.csv"
    Trajectory([0.0, 0.2], np.radians([[0, 0, 0], [5, 10, 15]]), JOINTS[::-1]).save_csv(file)
    assert np.degrees(guided_recording.load_motion(file, JOINTS).q[-1]) == pytest.approx(
        [15, 10, 5]
    )


def test_ctrl_c_while_recording_keeps_what_was_recorded(desk: Any, tmp_path: Path) -> None:
    file = tmp_path / "m.csv"
    child = subprocess.Popen(
        [sys.executable, "-m", "robot_ik", "servo", "record", str(file), *desk.at],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stderr is not None and "recording" in child.stderr.readline()
        time.sleep(0.2)
        child.send_signal(signal.SIGINT)
        out, err = child.communicate()
    finally:
        child.kill()
    assert child.returncode == 130 and "Traceback" not in err
    assert f"{file}: " in out and "samples" in out
    assert len(guided_recording.load_motion(file, JOINTS)) > 2


def test_without_standard_input_nothing_is_recorded(robot_ik_child: Any, tmp_path: Path) -> None:
    run = robot_ik_child("servo", "record", tmp_path / "m.csv", "--bus", "sim")
    run.assert_one_screen_error()
    assert "--seconds S" in run.err and "recording" not in run.err and not list(tmp_path.iterdir())


def test_in_process(robot_ik: Any, tmp_path: Path) -> None:
    run = robot_ik("servo", "record", tmp_path / "m.csv", "--bus", "sim", "--seconds", 1)
    assert run.code == 0, run.err
    assert len((tmp_path / "m.csv").read_text().splitlines()) == 1 + 51
    kept = tmp_path / "kept.csv"
    kept.write_text("mine")
    play = ("servo", "replay", tmp_path / "m.csv", "--bus", "sim", "--record", kept)
    run = robot_ik(*play)
    assert run.code == 2 and "--overwrite" in run.err and kept.read_text() == "mine"
    assert robot_ik(*play, "--overwrite").code == 0 and kept.read_text().startswith("time_s")
