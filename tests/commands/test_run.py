"""``robot-ik run``: output, files and exit codes."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from robot_ik.script import shipped
from robot_ik.workcell.robot_setup import RobotSetup

WAIT = 'schema = 1\nname = "wait a little"\n[[steps]]\ndo = "wait"\nseconds = 0.2\n'
FAIL = WAIT + '[[steps]]\ndo = "expect"\nstate = "fault"\n[[steps]]\ndo = "hold"\n'


@pytest.fixture
def script(tmp_path: Path) -> Path:
    path = tmp_path / "wait.toml"
    path.write_text(WAIT)
    return path


def test_passed_is_0_and_leaves_reports(tmp_path: Path, script: Path, robot_ik: Any) -> None:
    run = robot_ik("run", script, "--junit", tmp_path / "r.xml", "--seed", 5)
    assert (run.code, run.err) == (0, "")
    assert (
        "wait a little: PASSED  2 of 2 steps, 0.20 s of virtual time, tabletop_puma on sim, seed 5"
        in run.out
    )
    facts = json.loads(robot_ik("run", script, "--json", "--seed", 5).out)
    assert (
        facts["schema"] == 1 and facts["passed"] and facts["seed"] == 5 and len(facts["steps"]) == 2
    )
    suite = ElementTree.parse(tmp_path / "r.xml").getroot()[0]
    assert (suite.get("tests"), suite.get("failures")) == ("2", "0")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.xml", "wait.toml"]


def test_a_report_is_the_same_whatever_signs_the_terminal_has(
    tmp_path: Path, script: Path, robot_ik: Any, robot_ik_child: Any
) -> None:
    script.write_text(WAIT.replace("a little", "20° long"), encoding="utf-8")
    run = robot_ik_child("run", script, "--json", PYTHONIOENCODING="ascii")
    assert run.code == 0 and run.out.isascii(), run.err
    assert json.loads(run.out) == json.loads(robot_ik("run", script, "--json").out)


def test_failed_is_1(script: Path, robot_ik: Any) -> None:
    script.write_text(FAIL)
    run = robot_ik("run", script, "--json")
    assert run.code == 1
    assert [step["outcome"] for step in json.loads(run.out)["steps"]] == [
        "passed",
        "failed",
        "not run",
        "passed",
    ]
    run = robot_ik("run", script)
    assert run.code == 1
    assert "state enabled instead of fault" in run.out and "FAILED" in run.out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["overlaod"], "did you mean overload"),
        (["missing.toml"], "cannot be read"),
        (["{script}", "--robot", "pma560"], "puma560"),
        (["{script}", "--bus", "/dev/nowhere"], "/dev/nowhere"),
        (["{script}", "--junit", "{script}/r.xml"], "is a file"),
        (["{script}", "--arm", "no.toml"], "no.toml"),
        (["overload", "--bus", "/dev/nowhere"], "steps[0].do"),
        (["{script}", "--seed", "-1"], "seed: not -1"),
    ],
)
def test_wrong_input_is_2(arguments: list[str], expected: str, script: Path, robot_ik: Any) -> None:
    run = robot_ik("run", *(word.format(script=script) for word in arguments))
    run.assert_one_screen_error()
    assert expected in run.err


def test_a_folder_is_named_with_a_script_in_it(
    tmp_path: Path, script: Path, monkeypatch: pytest.MonkeyPatch, robot_ik: Any
) -> None:
    monkeypatch.chdir(tmp_path.parent)
    for name in (str(tmp_path), tmp_path.name):
        run = robot_ik("run", name)
        run.assert_one_screen_error()
        assert f"{name}: this is a folder" in run.err
        assert f"robot-ik run {Path(name) / script.name}" in run.err
    (tmp_path / "empty").mkdir()
    assert "robot-ik run" not in robot_ik("run", tmp_path / "empty").err


def test_interrupted_is_130_and_leaves_its_report(
    tmp_path: Path, script: Path, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: RobotSetup, *rest: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)

    monkeypatch.setattr(RobotSetup, "repeat", interrupted)
    script.write_text(FAIL)
    run = robot_ik("run", script, "--json", "--junit", tmp_path / "r.xml")
    assert run.code == 130 and run.err == "torque is off\ninterrupted\n"
    facts = json.loads(run.out)
    assert (tmp_path / "r.xml").is_file()
    assert facts["interrupted"] and not facts["passed"]
    assert [step["outcome"] for step in facts["steps"]] == [
        "failed",
        "not run",
        "not run",
        "passed",
    ]
    assert "torque_off" in facts["steps"][-1]["found"]


def test_the_arm_may_be_named_by_its_robot(script: Path, robot_ik: Any) -> None:
    run = robot_ik("run", script, "--arm", "tabletop_puma")
    assert run.code == 0 and "tabletop_puma on sim" in run.out


def test_another_robot_and_a_pty(script: Path, robot_ik: Any, real_time: None) -> None:
    run = robot_ik("run", script, "--robot", "puma560", "--bus", "pty")
    assert run.code == 0 and "puma560 on pty" in run.out


def test_without_a_script_the_bundled_ones_are_listed(robot_ik: Any) -> None:
    run = robot_ik("run")
    assert run.code == 0
    rows = json.loads(robot_ik("run", "--json").out)["scripts"]
    assert [row["name"] for row in rows] == list(shipped())
    for name in shipped():
        assert name in run.out


@pytest.mark.parametrize("option", [("--junit", "f"), ("--seed", 3)])
def test_options_without_a_script_do_not_ask_for_the_list(
    tmp_path: Path, robot_ik: Any, option: tuple[Any, ...]
) -> None:
    run = robot_ik("run", *option)
    assert run.code == 2 and not run.out
    assert "no script is named" in run.err and "pick_and_place" in run.err
