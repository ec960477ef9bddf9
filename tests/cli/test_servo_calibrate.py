"""Calibration: a hand turns the shafts of limp virtual servos behind a real port; the truth is theirs."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.hardware.calibration_file import Calibration, JointCalibration
from robot_ik.hardware.config import ArmConfig

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")

Hand = Callable[[str, Callable[[], object]], None]
JOINTS = ("joint1", "joint2", "joint3")


@pytest.fixture
def nominal(desk: Any, tmp_path: Path) -> Path:
    """The arm file before calibration: zeros and directions nobody has looked at."""
    joints = tuple(replace(j, direction=1, zero_ticks=2048) for j in desk.config.joints)
    path = tmp_path / "nominal.toml"
    replace(desk.config, joints=joints, file=None).save(path)
    return path


@pytest.fixture
def calibrate(
    robot_ik: Any, desk: Any, nominal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Any:
    """``calibrate(hand, options …)``: ``hand(step, sample)`` does what the step asks for."""
    from robot_ik.cli import servo_calibrate

    def run(hand: Hand, *options: object) -> Any:
        class Scripted:
            def __init__(self, clock: object, seconds: object) -> None:
                pass

            def step(self, text: str, sample: Callable[[], object]) -> None:
                hand(text, sample)
                sample()

        monkeypatch.setattr(servo_calibrate, "Prompts", Scripted)
        monkeypatch.setattr(servo_calibrate, "STILL_SAMPLES", 2)
        where = ("--bus", desk.port, "--arm", nominal)
        return robot_ik("servo", "calibrate", tmp_path / "mine.toml", *where, *options)

    return run


def good_hand(desk: Any, *, reach: float = 95.0, pose: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Hand:
    """Sweeps each joint ``reach`` degrees both ways, goes to the pose, wiggles in the positive direction."""

    def hand(text: str, sample: Callable[[], object]) -> None:
        if text.startswith("1."):
            for joint in JOINTS:
                for way in (*[reach / 2] * 2, *[-reach / 2] * 4, *[reach / 2] * 2):
                    desk.turn(joint, way)
                    sample()
        elif text.startswith("2."):
            for joint, degrees in zip(JOINTS, pose, strict=True):
                desk.turn(joint, degrees)
        else:
            (joint,) = [name for name in JOINTS if name in text]
            desk.turn(joint, 10.0)

    return hand


def test_zeros_directions_and_ranges_are_found(
    calibrate: Any, desk: Any, robot_ik: Any, tmp_path: Path
) -> None:
    run = calibrate(good_hand(desk))
    assert run.code == 0, run.err
    mine = ArmConfig.load(tmp_path / "mine.toml")
    for joint, true in zip(mine.joints, desk.config.joints, strict=True):
        assert joint.direction == true.direction
        assert joint.zero_ticks == pytest.approx(true.zero_ticks, abs=2)
        assert np.degrees([joint.lower, joint.upper]) == pytest.approx([-95, 95], abs=0.3)
    # With it the arm goes where it is sent, by its own true angles.
    run = robot_ik(
        "servo", "move", 20, -30, 40, "--bus", desk.port, "--arm", tmp_path / "mine.toml", "--speed", 1
    )
    assert run.code == 0, run.err
    assert np.degrees(desk.bus.true_angles(desk.config)) == pytest.approx([20, -30, 40], abs=0.4)


def test_the_file_has_all_that_was_measured(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    desk.servo(2).memory.set("homing_offset", 40)
    assert calibrate(good_hand(desk)).code == 0
    path = tmp_path / "mine.calibration.toml"
    raw = tomllib.loads(path.read_text())
    assert raw["schema"] == 1 and raw["bus"] == {"baud": 1_000_000} and raw["arm"] == "three servos"
    second = raw["joints"][1]
    assert (second["name"], second["id"], second["model"], second["firmware"]) == (
        "joint2",
        2,
        "XL430-W250",
        48,
    )
    assert (second["drive_mode"], second["homing_offset"], second["direction"]) == (0, 40, -1)
    assert second["range_min"] == pytest.approx(1040 - 95 * 2 * 4096 / 360, abs=3)
    assert second["range_max"] == pytest.approx(1040 + 95 * 2 * 4096 / 360, abs=3)
    assert (second["urdf_lower"], second["urdf_upper"]) == (-110.0, 110.0)
    assert second["present_at_save"] == pytest.approx(1040 - 10 * 2 * 4096 / 360, abs=3)
    again = tmp_path / "again.calibration.toml"
    loaded = Calibration.load(path)
    loaded.save(again)
    assert again.read_text() == path.read_text()


def test_zeros_taken_in_another_pose(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    run = calibrate(good_hand(desk, pose=(0, 45, -30)), "--pose", "joint2=45", "joint3=-30")
    assert run.code == 0, run.err
    for joint, true in zip(ArmConfig.load(tmp_path / "mine.toml").joints, desk.config.joints, strict=True):
        assert joint.zero_ticks == pytest.approx(true.zero_ticks, abs=2)


def failing(run: Any, tmp_path: Path, *parts: str) -> None:
    run.assert_one_screen_error(code=1)
    for part in parts:
        assert part in run.err
    assert not (tmp_path / "mine.toml").exists() and not (tmp_path / "mine.calibration.toml").exists()


def test_a_joint_that_was_not_swept(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    hand = good_hand(desk)
    failing(
        calibrate(lambda text, sample: None if text[0] == "1" else hand(text, sample)), tmp_path, "joint1"
    )


def test_a_sweep_across_the_end_of_the_turn(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    desk.servo(3).turn_by_hand(-900)  # its horn sits so that -95 degrees are below tick 0
    failing(calibrate(good_hand(desk)), tmp_path, "joint3", "half a turn", "extended_position")


@pytest.mark.parametrize("folds", [False, True])
def test_ticks_that_start_anew_in_the_middle_are_counted_on(folds: bool, desk: Any) -> None:
    from robot_ik.hardware.calibration import Sweep

    sweep = Sweep(desk.config, {1: 4000, 2: 4000, 3: 100})
    for tick in (4050, 4099, 4150):
        sweep.take({1: tick % 4096 if folds else tick, 2: tick, 3: (100 - (tick - 4000)) % 4096})
    assert sweep.high[1] == 4150 and sweep.low[1] == 4000
    assert sweep.low[3] == -50 and sweep.now == {1: 4150, 2: 4150, 3: -50}


def test_a_limp_servo_that_counts_beyond_its_turn_is_taken_as_with_torque(desk: Any) -> None:
    from robot_ik.hardware.calibration import Sweep

    assert Sweep(desk.config, {1: 4096 + 7, 2: 5000, 3: -1}).now == {1: 7, 2: 5000, 3: 4095}


def test_a_hand_that_does_not_hold_still(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    hand, bus = good_hand(desk), desk.bus

    def restless(text: str, sample: Callable[[], object]) -> None:
        hand(text, sample)
        if text[0] == "2":
            from robot_ik.hardware.virtual.fault_kinds import Fault

            bus.inject(Fault("turn", id=2, value=30.0, at=bus.clock.now() - bus.schedule.start + 0.05))

    failing(calibrate(restless), tmp_path, "joint2", "still")


def test_the_wrong_joint_is_wiggled(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    hand = good_hand(desk)
    swapped = {"joint1": "joint3", "joint3": "joint1", "joint2": "joint2"}

    def crossed(text: str, sample: Callable[[], object]) -> None:
        if text[0] == "3":
            desk.turn(swapped[next(name for name in JOINTS if name in text)], 10.0)
        else:
            hand(text, sample)

    failing(calibrate(crossed), tmp_path, "'joint1' was to be turned, and 'joint3' did")


def test_nothing_is_wiggled(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    hand = good_hand(desk)
    failing(calibrate(lambda t, s: None if t[0] == "3" else hand(t, s)), tmp_path, "joint1", "did not turn")


def test_a_zero_that_is_half_a_turn_off(calibrate: Any, desk: Any, tmp_path: Path) -> None:
    run = calibrate(good_hand(desk, reach=40), "--pose", "joint1=110")
    failing(run, tmp_path, "joint1", "range, deg", "-100.0 .. 100.0")


def test_torque_must_be_off(calibrate: Any, desk: Any) -> None:
    desk.servo(2).memory.set("torque_enable", 1)
    run = calibrate(good_hand(desk))
    run.assert_one_screen_error()
    assert "joint2" in run.err and "torque off" in run.err


# ------------------------------------------------------------------------- files, servos and model


@pytest.fixture
def mine(calibrate: Any, desk: Any, tmp_path: Path) -> Path:
    """A calibrated arm."""
    assert calibrate(good_hand(desk)).code == 0
    return tmp_path / "mine.toml"


def test_what_agrees_is_said_to_agree(robot_ik: Any, mine: Path, desk: Any) -> None:
    run = robot_ik("servo", "calibrate", mine, "--bus", desk.port, "--check")
    assert run.code == 0 and "agree" in run.out


def test_servos_that_are_others_are_refused_with_a_table(robot_ik: Any, mine: Path, desk: Any) -> None:
    desk.servo(1).memory.set("homing_offset", 100)
    for words in (("calibrate", mine, "--check"), ("move", "joint1=3", "--arm", mine)):
        run = robot_ik("servo", *words, "--bus", desk.port)
        run.assert_one_screen_error()
        assert "joint1  homing_offset" in run.err and "100" in run.err
        assert desk.torque() == [False] * 3


def test_an_arm_file_or_model_that_was_changed_is_refused(robot_ik: Any, mine: Path, desk: Any) -> None:
    text = mine.read_text()
    mine.write_text(text.replace("direction = -1", "direction = 1"))
    run = robot_ik("servo", "calibrate", mine, "--bus", desk.port, "--check")
    run.assert_one_screen_error()
    assert "joint2  direction" in run.err
    mine.write_text(text)
    model = desk.arm.with_name("arm.xml")
    model.write_text(model.read_text().replace("-110 110", "-110 90"))
    run = robot_ik("servo", "calibrate", mine, "--bus", desk.port, "--check")
    run.assert_one_screen_error()
    assert "limits of the model" in run.err and "-110.0 .. 90.0" in run.err


def test_a_lost_turn_is_refused(robot_ik: Any, mine: Path, desk: Any) -> None:
    desk.servo(2).shaft.lose_turns(1)
    run = robot_ik("servo", "move", "joint1=3", "--bus", desk.port, "--arm", mine)
    run.assert_one_screen_error()
    assert "joint2  present position" in run.err


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("schema = 1", "schema = 2", "schema"),
        ("range_min", "range_mni", "range_mni"),
        ("direction = -1", "direction = 0", "direction"),
        ("[[joints]]", "[[joints", "read"),
        ("range_max = 900", "range_max = 10", "empty"),
        ("-9.0", "nan", "urdf_lower"),
    ],
)
def test_a_wrong_calibration_file(old: str, new: str, named: str, tmp_path: Path) -> None:
    row = JointCalibration("joint1", 1, "XL430-W250", 48, 0, 0, 10, 900, -1, 500, -9.0, 9.0, 500)
    path = tmp_path / "a.calibration.toml"
    Calibration("a", "b", "now", 57_600, (row,)).save(path)
    assert Calibration.load(path).joints == (row,)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=re.escape(named)):
        Calibration.load(path)


def test_the_calibration_of_another_arm(robot_ik: Any, mine: Path, desk: Any) -> None:
    beside = mine.with_name("mine.calibration.toml")
    beside.write_text(beside.read_text().replace('"joint1"', '"joint9"'))
    run = robot_ik("servo", "move", "joint1=3", "--bus", desk.port, "--arm", mine)
    run.assert_one_screen_error()
    assert "joint9" in run.err and desk.torque() == [False] * 3


def test_older_files_stay_unless_asked(robot_ik: Any, calibrate: Any, mine: Path, desk: Any) -> None:
    before = mine.read_bytes()
    calibrate(good_hand(desk)).assert_one_screen_error()
    assert mine.read_bytes() == before


@pytest.mark.parametrize(
    "options",
    [("x.json",), ("x.toml", "--seconds", 0), ("x.toml", "--pose", "joitn1=3"), ("no/where.toml",)],
)
def test_wrong_input(options: tuple[Any, ...], robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "calibrate", *options, *desk.at).assert_one_screen_error()


# ---------------------------------------------------------------------------------------- LeRobot


def test_out_to_lerobot_and_in_again(robot_ik: Any, mine: Path, desk: Any, tmp_path: Path) -> None:
    text = mine.with_name("mine.calibration.toml")
    text.write_text(  # within one turn, as LeRobot needs it
        "".join(
            "range_min = 700\n" if (at.startswith("range_min = -")) else at
            for at in text.read_text().splitlines(keepends=True)
        )
    )
    rows = tomllib.loads(text.read_text())["joints"]
    file = tmp_path / "koch.json"
    run = robot_ik("servo", "calibrate", mine, "--bus", desk.port, "--check", "--to-lerobot", file)
    assert run.code == 0, run.err
    written = json.loads(file.read_text())
    keys = {"id", "drive_mode", "homing_offset", "range_min", "range_max"}
    assert written == {row["name"]: {key: row[key] for key in keys} for row in rows}

    renamed = {f"motor{row['id']}": row for row in written.values()}  # LeRobot's own names: matched by id
    for k, (low, high) in enumerate([(1000, 3000), (500, 1700), (800, 2600)], 1):
        renamed[f"motor{k}"] |= {"range_min": low, "range_max": high}
    file.write_text(json.dumps(renamed))
    out = tmp_path / "theirs.toml"
    run = robot_ik("servo", "calibrate", out, *desk.at, "--from-lerobot", file)
    assert run.code == 0, run.err
    theirs = ArmConfig.load(out)
    assert [j.zero_ticks for j in theirs.joints] == [2000, 1100, 1700]
    assert theirs.joints[0].upper == pytest.approx(1000 * 2 * np.pi / 4096, abs=1e-6)
    assert Calibration.load(out.with_name("theirs.calibration.toml")).joints[2].range_max == 2600


def test_lerobot_cannot_have_more_than_a_turn(robot_ik: Any, mine: Path, desk: Any, tmp_path: Path) -> None:
    run = robot_ik(
        "servo", "calibrate", mine, "--bus", desk.port, "--check", "--to-lerobot", tmp_path / "x.json"
    )
    run.assert_one_screen_error()
    assert "joint2" in run.err and not (tmp_path / "x.json").exists()


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("{", "read"),
        ("{}", "LeRobot"),
        ('{"joint1": {"id": 1}}', "joint1.drive_mode"),
        ('{"m": {"id": 9, "drive_mode": 0, "homing_offset": 0, "range_min": 1, "range_max": 2}}', "joint1"),
        ('{"m": {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 2, "range_max": 2}}', "empty"),
    ],
)
def test_wrong_lerobot_files(content: str, named: str, robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    file = tmp_path / "koch.json"
    file.write_text(content)
    run = robot_ik("servo", "calibrate", tmp_path / "x.toml", *desk.at, "--from-lerobot", file)
    assert run.code != 0 and run.out == "" and named in run.err and "Traceback" not in run.err
    assert not (tmp_path / "x.toml").exists()


def test_lerobots_offset_must_be_the_servos(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    row = {"drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3000}
    file = tmp_path / "koch.json"
    file.write_text(json.dumps({f"joint{k}": {"id": k, **row} for k in (1, 2, 3)}))
    desk.servo(3).memory.set("homing_offset", -50)
    run = robot_ik("servo", "calibrate", tmp_path / "x.toml", *desk.at, "--from-lerobot", file)
    failing(run, tmp_path, "joint3  homing_offset")


# --------------------------------------------------------------------------------- at a keyboard


def test_steps_end_with_enter(desk: Any, nominal: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "robot_ik", "servo", "calibrate", str(tmp_path / "mine.toml")]
    child = subprocess.Popen(
        [*command, "--bus", desk.port, "--arm", str(nominal)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    hand = good_hand(desk)
    assert child.stdin is not None and child.stderr is not None
    try:
        for line in child.stderr:
            if line[0] in "123":
                hand(line, lambda: time.sleep(0.03))
                child.stdin.write("\n")
                child.stdin.flush()
        assert child.wait(timeout=30) == 0
    finally:
        child.kill()
        child.communicate()
    mine = ArmConfig.load(tmp_path / "mine.toml")
    assert [j.direction for j in mine.joints] == [1, -1, 1]


def test_an_input_that_ends_too_early(monkeypatch: pytest.MonkeyPatch) -> None:
    from robot_ik.cli.servo_prompt import Prompts
    from robot_ik.ports import RealClock

    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "__stdin__", nothing)
        prompts = Prompts(RealClock(), period=0.001)
        for _ in range(2):
            with pytest.raises(HardwareError, match="input ended"):
                prompts.step("turn it", lambda: None)


def test_steps_that_take_a_time() -> None:
    from robot_ik.cli.servo_prompt import Prompts
    from robot_ik.ports import VirtualClock

    clock, seen = VirtualClock(), []
    Prompts(clock, 2.0, 0.5).step("turn it", lambda: seen.append(clock.now()))
    assert seen == [0.0, 0.5, 1.0, 1.5, 2.0]
