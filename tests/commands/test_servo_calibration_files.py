"""Calibration files: held against servos, arm file and model; LeRobot's in and out."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware.calibration_file import Calibration, JointCalibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import load_lerobot
from robot_ik.hardware.registers import OperatingMode
from tests.hardware.joints import with_servo

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")

Hand = Callable[[str, Callable[[], object]], None]
JOINTS = ("joint1", "joint2", "joint3")


def test_an_agreeing_calibration_is_reported(robot_ik: Any, mine: Path, desk: Any) -> None:
    run = robot_ik("servo", "calibrate", mine, "--bus", desk.port, "--check")
    assert run.code == 0 and "agree" in run.out


def test_servos_that_are_others_are_refused_with_a_table(
    robot_ik: Any, mine: Path, desk: Any
) -> None:
    desk.servo(1).memory.set("homing_offset", 100)
    for words in (("calibrate", mine, "--check"), ("move", "joint1=3", "--arm", mine)):
        run = robot_ik("servo", *words, "--bus", desk.port)
        run.assert_one_screen_error()
        assert "joint1  homing_offset" in run.err and "100" in run.err
        assert desk.torque() == [False] * 3


def test_an_arm_file_or_model_that_was_changed_is_refused(
    robot_ik: Any, mine: Path, desk: Any
) -> None:
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
    desk.servo(2).shaft.lose_revolutions(1)
    run = robot_ik("servo", "move", "joint1=3", "--bus", desk.port, "--arm", mine)
    run.assert_one_screen_error()
    assert "joint2  present position" in run.err


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("schema = 1", "schema = 2", "schema"),
        ("range_min", "range_mni", "range_mni"),
        ("direction = -1", "direction = 0", "direction"),
        ("[[joints]]", "[[joints", "not valid TOML"),
        ("range_max = 900", "range_max = 10", "empty"),
        ("-9.0", "nan", "urdf_lower"),
    ],
)
def test_a_wrong_calibration_file(old: str, new: str, named: str, tmp_path: Path) -> None:
    row = JointCalibration("joint1", 1, "XL430-W250", 0, 0, 10, 900, -1, 500, -9.0, 9.0)
    path = tmp_path / "a.calibration.toml"
    Calibration("a", "b", "now", (row,)).save(path)
    assert Calibration.load(path).joints == (row,)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=re.escape(named)):
        Calibration.load(path)


def test_an_older_calibration_file_with_more_keys_is_read(tmp_path: Path) -> None:
    row = JointCalibration("joint1", 1, "XL430-W250", 0, 0, 10, 900, -1, 500, -9.0, 9.0)
    found = Calibration("a", "b", "now", (row,), (replace(row, id=2),))
    path = tmp_path / "a.calibration.toml"
    found.save(path)
    text = path.read_text().replace(
        "drive_mode", "firmware = 48\npresent_at_save = 500\ndrive_mode"
    )
    path.write_text(text.replace("[[joints]]", "[bus]\nbaud = 57600\n\n[[joints]]", 1))
    assert Calibration.load(path) == replace(found, file=path)
    assert len(tomllib.loads(path.read_text())["twins"][0]) == 13


def test_the_calibration_of_another_arm(robot_ik: Any, mine: Path, desk: Any) -> None:
    beside = mine.with_name("mine.calibration.toml")
    beside.write_text(beside.read_text().replace('"joint1"', '"joint9"'))
    run = robot_ik("servo", "move", "joint1=3", "--bus", desk.port, "--arm", mine)
    run.assert_one_screen_error()
    assert "joint9" in run.err and desk.torque() == [False] * 3


def test_older_files_stay_without_overwrite(good_hand: Any, calibrate: Any, mine: Path) -> None:
    before = mine.read_bytes()
    calibrate(good_hand()).assert_one_screen_error()
    assert mine.read_bytes() == before


@pytest.mark.parametrize(
    "options",
    [("x.json",), ("x.toml", "--pose", "joitn1=3")],
)
def test_wrong_input(options: tuple[Any, ...], robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "calibrate", *options, *desk.at).assert_one_screen_error()


def test_out_to_lerobot_and_in_again(robot_ik: Any, mine: Path, desk: Any, tmp_path: Path) -> None:
    text = mine.with_name("mine.calibration.toml")
    text.write_text(  # within one revolution, as LeRobot needs it
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

    # With LeRobot's joint names the servos are matched by id.
    renamed = {f"motor{row['id']}": row for row in written.values()}
    for k, (low, high) in enumerate([(1000, 3000), (500, 1700), (800, 2600)], 1):
        renamed[f"motor{k}"] |= {"range_min": low, "range_max": high}
    file.write_text(json.dumps(renamed))
    out = tmp_path / "theirs.toml"
    run = robot_ik("servo", "calibrate", out, *desk.at, "--from-lerobot", file)
    assert run.code == 0, run.err
    theirs = ArmConfig.load(out)
    assert [j.servo.zero_ticks for j in theirs.joints] == [2000, 1100, 1700]
    assert theirs.joints[0].upper == pytest.approx(1000 * 2 * np.pi / 4096, abs=1e-6)
    assert Calibration.load(out.with_name("theirs.calibration.toml")).joints[2].range_max == 2600


def test_lerobot_cannot_have_more_than_a_turn(
    robot_ik: Any, mine: Path, desk: Any, tmp_path: Path
) -> None:
    run = robot_ik(
        "servo",
        "calibrate",
        mine,
        "--bus",
        desk.port,
        "--check",
        "--to-lerobot",
        tmp_path / "x.json",
    )
    run.assert_one_screen_error()
    assert "joint2" in run.err and not (tmp_path / "x.json").exists()


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("{", "not valid JSON"),
        ("{}", "LeRobot"),
        ('{"joint1": {"id": 1}}', "joint1.drive_mode"),
        ('{"joint1": {"id": 253}}', "joint1.id: 253 is not right; allowed: 0..252"),
        ('{"joint1": {"id": true}}', "joint1.id: True is not right; allowed: 0..252"),
        ('{"joint1": 5}', "joint1: 5 is not right; allowed: a table"),
        ("[]", "LeRobot"),
        (
            '{"m": {"id": 9, "drive_mode": 0, "homing_offset": 0, "range_min": 1, "range_max": 2}}',
            "joint1",
        ),
        (
            '{"m": {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 2, "range_max": 2}}',
            "empty",
        ),
    ],
)
def test_wrong_lerobot_files(
    content: str, named: str, robot_ik: Any, desk: Any, tmp_path: Path
) -> None:
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
    run.assert_one_screen_error(code=1)
    assert "joint3  homing_offset" in run.err and not (tmp_path / "x.toml").exists()


def _lerobot(path: Path, **row: int) -> Path:
    usual = {"drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3000}
    rows = {f"joint{k}": {"id": k, **usual, **(row if k == 1 else {})} for k in (1, 2, 3)}
    path.write_text(json.dumps(rows))
    return path


# LeRobot's file has no limits. They are those of the model.
NO_LIMITS = defaultdict(lambda: (0.0, 0.0))


@pytest.mark.parametrize("offset", [1025, -2047])
def test_an_offset_of_lerobots_that_position_mode_ignores_is_refused_before_it_is_used(
    offset: int, desk: Any, tmp_path: Path
) -> None:
    """LeRobot runs mode 4, where it counts; the same servo in mode 3 would have another zero."""
    joints = desk.config.joints
    first = with_servo(joints[0], mode=OperatingMode.POSITION)
    file = _lerobot(tmp_path / "koch.json", homing_offset=offset)
    config = replace(desk.config, joints=(first, *joints[1:]))
    with pytest.raises(ConfigError) as caught:
        load_lerobot(file, config, NO_LIMITS)
    assert (caught.value.file, caught.value.key) == (file, "joint1.homing_offset")
    assert str(offset) in str(caught.value) and "extended_position" in str(caught.value)
    many = with_servo(first, mode=OperatingMode.EXTENDED_POSITION)
    found = load_lerobot(file, replace(config, joints=(many, *joints[1:])), NO_LIMITS)
    assert found.joints[0].homing_offset == offset


@pytest.mark.parametrize("reverse", [False, True])
def test_lerobots_drive_mode_is_compared_with_reverse(
    reverse: bool, desk: Any, tmp_path: Path
) -> None:
    first = with_servo(desk.config.joints[0], reverse=reverse)
    config = replace(desk.config, joints=(first, *desk.config.joints[1:]))
    right = _lerobot(tmp_path / "right.json", drive_mode=int(reverse))
    assert load_lerobot(right, config, NO_LIMITS).joints[0].drive_mode == reverse
    with pytest.raises(ConfigError, match=f"reverse = {str(not reverse).lower()}") as caught:
        load_lerobot(
            _lerobot(tmp_path / "wrong.json", drive_mode=int(not reverse)), config, NO_LIMITS
        )
    assert caught.value.key == "joint1.drive_mode"


@pytest.mark.parametrize(
    "words",
    [
        ("torque", "on"),
        ("torque", "on", "joint3"),
        ("move", "joint1=3"),
        ("record", "a.csv", "--seconds", "0.1"),
    ],
)
def test_whoever_drives_compares_servos_and_model(
    words: tuple[str, ...],
    robot_ik: Any,
    mine: Path,
    desk: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    at = ("--bus", desk.port, "--arm", mine)
    desk.servo(3).memory.set("homing_offset", 100)
    run = robot_ik("servo", *words, *at)
    run.assert_one_screen_error()
    assert "joint3  homing_offset" in run.err
    desk.servo(3).memory.set("homing_offset", 0)
    model = desk.arm.with_name("arm.xml")
    model.write_text(model.read_text().replace("-110 110", "-110 90"))
    run = robot_ik("servo", *words, *at)
    run.assert_one_screen_error()
    assert "limits of the model, deg" in run.err and "-110.0 .. 90.0" in run.err
    assert desk.torque() == [False] * 3


def test_joints_of_a_calibrated_arm_are_used_alone(robot_ik: Any, mine: Path, desk: Any) -> None:
    run = robot_ik("servo", "torque", "on", "joint1", "--bus", desk.port, "--arm", mine)
    assert run.code == 0, run.err
    assert desk.torque() == [True, False, False]


def test_reach_compares_the_arm_with_its_calibration(robot_ik: Any, mine: Path, desk: Any) -> None:
    goal = ("reach", "--robot", desk.arm.with_name("arm.xml"), "--arm", mine, "--bus", desk.port)
    desk.servo(2).memory.set("homing_offset", 100)
    run = robot_ik(*goal, "--goal", 0.1, 0.1, 0.1)
    run.assert_one_screen_error()
    assert "joint2  homing_offset" in run.err and desk.torque() == [False] * 3
    desk.servo(2).memory.set("homing_offset", 0)
    model = desk.arm.with_name("arm.xml")
    model.write_text(model.read_text().replace("-110 110", "-110 90"))
    run = robot_ik(*goal, "--goal", 0.1, 0.1, 0.1)
    run.assert_one_screen_error()
    assert "limits of the model" in run.err


def test_a_calibrated_arm_is_calibrated_again(
    calibrate: Any, good_hand: Any, mine: Path, desk: Any, tmp_path: Path
) -> None:
    desk.servo(1).memory.set("homing_offset", 100)
    text = mine.with_name("mine.calibration.toml").read_text()
    assert calibrate(good_hand(), "--arm", mine, "--overwrite").code == 0
    assert mine.with_name("mine.calibration.toml").read_text() != text
