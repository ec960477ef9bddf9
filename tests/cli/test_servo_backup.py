"""Control tables saved and put back, over a real port."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from robot_ik.commands.main import main

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")


@pytest.fixture
def saved(robot_ik: Any, desk: Any, tmp_path: Path) -> Path:
    """A backup of the desk's servos, which have settings of their own."""
    desk.servo(1).memory.set("homing_offset", -321)
    desk.servo(1).memory.set("velocity_limit", 111)
    desk.servo(3).memory.set("min_position_limit", 700)
    desk.servo(3).memory.set("max_position_limit", 900)
    path = tmp_path / "tables.json"
    run = robot_ik("servo", "backup", path, *desk.at)
    assert run.code == 0, run.err
    return path


def eeprom(desk: Any) -> list[dict[str, int]]:
    return [
        {r.name: servo.memory.values[r.name] for r in servo.table if r.eeprom} for servo in desk.bus.servos
    ]


def test_what_is_saved_is_what_the_servos_have(saved: Path, desk: Any) -> None:
    content = json.loads(saved.read_text())
    assert content["schema"] == 1 and content["arm"] == "three servos"
    assert [row["model"] for row in content["servos"]] == ["XM430-W350", "XL430-W250", "XL330-M288"]
    for row, kept in zip(content["servos"], eeprom(desk), strict=True):
        assert {name: row["registers"][name] for name in kept} == kept
        assert {"position_p_gain", "present_position", "indirect_address_1"} <= set(row["registers"])


def test_restore_undoes_what_was_changed_since(robot_ik: Any, saved: Path, desk: Any) -> None:
    before = eeprom(desk)
    assert "nothing differs" in robot_ik("servo", "restore", saved, *desk.at).out
    memory = desk.servo(1).memory
    for name, value in {
        "homing_offset": 77,
        "operating_mode": 4,
        "velocity_limit": 200,
        "shutdown": 0,
    }.items():
        memory.set(name, value)
    desk.servo(3).memory.set("max_position_limit", 4000)
    desk.servo(3).memory.set("min_position_limit", 3000)  # above the saved maximum: order matters
    run = robot_ik("servo", "restore", saved, *desk.at, "--dry-run")
    assert run.code == 0 and "homing_offset" in run.out and memory.values["homing_offset"] == 77
    run = robot_ik("servo", "restore", saved, "joint1", *desk.at)
    assert run.code == 0 and eeprom(desk)[0] == before[0] and eeprom(desk)[2] != before[2]
    run = robot_ik("servo", "restore", saved, *desk.at)
    assert run.code == 0 and eeprom(desk) == before, run.err


def test_restore_refuses_another_model_before_it_writes(robot_ik: Any, saved: Path, desk: Any) -> None:
    content = json.loads(saved.read_text())
    content["servos"][2] |= {"id": 2, "joint": "joint2"}  # an XL330's table for the XL430
    content["servos"] = [content["servos"][0], content["servos"][2]]
    saved.write_text(json.dumps(content))
    desk.servo(1).memory.set("velocity_limit", 200)
    run = robot_ik("servo", "restore", saved, *desk.at)
    assert "are not those of the backup" in run.err
    run.assert_one_screen_error()
    assert "joint2: XL330-M288" in run.err and "XL430-W250" in run.err
    assert desk.servo(1).memory.values["velocity_limit"] == 200


def test_restore_refuses_while_torque_is_on(robot_ik: Any, saved: Path, desk: Any) -> None:
    desk.servo(1).memory.set("velocity_limit", 200)
    desk.servo(2).memory.set("torque_enable", 1)
    run = robot_ik("servo", "restore", saved, *desk.at)
    run.assert_one_screen_error()
    assert "joint2" in run.err and "torque off" in run.err
    assert desk.servo(1).memory.values["velocity_limit"] == 200


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of the six servos of the desk arm, in process."""
    path = tmp_path_factory.mktemp("good") / "f.json"
    assert main(["servo", "backup", str(path), "--bus", "sim"]) == 0
    return path.read_text()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("not json", "not valid JSON"),
        ("[]", "schema"),
        ('{"schema": 2}', "schema"),
        ('{"schema": 1, "servos": []}', "servos"),
        ('{"schema": 1, "servos": [{"id": 1}]}', "servos[0]"),
        ("velocity_limit=99999", "velocity_limit"),
        ("velocity_limit=true", "velocity_limit"),
        ("velocity_limit=1.5", "velocity_limit"),
        ("velocity_limti=1", "velocity_limti"),
    ],
)
def test_a_wrong_file(change: str, named: str, robot_ik: Any, good: str, tmp_path: Path) -> None:
    saved = tmp_path / "tables.json"
    name, equals, value = change.partition("=")
    if equals:
        content = json.loads(good)
        content["servos"][0]["registers"][name] = json.loads(value)
        change = json.dumps(content)
    saved.write_text(change)
    run = robot_ik("servo", "restore", saved, "--bus", "sim")
    run.assert_one_screen_error()
    assert named in run.err


def test_files_that_cannot_be(robot_ik: Any, saved: Path, desk: Any, tmp_path: Path) -> None:
    before = saved.read_bytes()
    robot_ik("servo", "backup", saved, *desk.at).assert_one_screen_error()
    assert saved.read_bytes() == before
    assert robot_ik("servo", "backup", saved, *desk.at, "--overwrite").code == 0
    robot_ik("servo", "backup", saved / "f.json", *desk.at).assert_one_screen_error()
    robot_ik("servo", "restore", tmp_path / "no.json", *desk.at).assert_one_screen_error()
    run = robot_ik("servo", "restore", saved, "joitn1", *desk.at)
    run.assert_one_screen_error()
    assert "joint1" in run.err


def test_backup_of_an_incomplete_arm(robot_ik: Any, desk: Any, tmp_path: Path) -> None:
    desk.servo(2).silent = True
    run = robot_ik("servo", "backup", tmp_path / "f.json", *desk.at)
    run.assert_one_screen_error()
    assert "missing" in run.err and not (tmp_path / "f.json").exists()


def test_in_process(robot_ik: Any, good: str, tmp_path: Path) -> None:
    (tmp_path / "f.json").write_text(good)
    run = robot_ik("servo", "restore", tmp_path / "f.json", "--bus", "sim")
    assert run.code == 0 and "nothing differs" in run.out
