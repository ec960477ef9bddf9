"""Wrong command lines: one sentence, exit code 2, and no suggestion that misleads."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from robot_ik.commands import main
from robot_ik.commands.main import GROUPS, Row

COMMANDS = [row.name for rows in GROUPS.values() for row in rows]
HEAVY = ["mujoco", "numba", "cv2", "numpy", "pydantic", "serial", "dynamixel_sdk"]


@pytest.mark.parametrize(
    ("line", "reported"),
    [
        ("slove", "did you mean `robot-ik solve`?"),
        ("SOLVE", "did you mean `robot-ik solve`?"),
        ("help slove", "did you mean `robot-ik solve`?"),
        ("scan", "did you mean `robot-ik servo scan`?"),
        ("skan", "did you mean `robot-ik servo scan`?"),
        ("servo skan", "did you mean `robot-ik servo scan`?"),
        ("servo --bus pty scan", "options follow the command: robot-ik servo scan --bus"),
        ("--verison", "did you mean --version?"),
        ("solve --gaol 1 2 3", "unknown option --gaol; did you mean --goal?"),
        (
            "solve --speed 1",
            "robot-ik solve has no option --speed (an option of: reach, ",
        ),
        ("solve --method lm", "unknown option --method; here it is --solver"),
        ("servo torque onn", "unknown value 'onn'; did you mean 'on'?; allowed: on, off"),
        ("servo torque", "on|off: this argument is required"),
        ("servo calibrate", "OUT.toml: this argument is required"),
        ("servo monitor --rate nan", "--rate: nan is out of range; allowed: above 0, at most 200"),
        ("servo monitor --rate 200.1", "--rate: 200.1 is out of range"),
        ("sim-bus --wire-baud 99999999", "--wire-baud: 99999999 is out of range"),
        ("solve --seed many", "--seed: 'many' is not a whole number"),
        ("solve --robot", "--robot: a value is missing; allowed: NAME|FILE"),
        ("solve --robot=", "--robot: the value is empty"),
        ("solve --goal 1 b 3", "--goal: 'b' is not a number; allowed: X Y Z [W X Y Z]"),
        ("solve --goal 1 2 3 --robot ur5e --goal 4 5 6", "--goal: given twice"),
        (
            "servo move a=1 --bus sim --speed fast",
            "--speed: 'fast' is not a number; allowed: above 0, at most 1",
        ),
        (
            "servo move a=1 --bus sim --speed 2",
            "--speed: 2.0 is out of range; allowed: above 0, at most 1",
        ),
        ("reach --when-lost holt", "did you mean 'hold'?; allowed: hold, park, stop"),
        ("reach --marker x", "--marker: 'x' is not a whole number"),
        ("reach --over", "did you mean --overwrite?"),
        ("video a.png", "did you mean `robot-ik view`?"),
        ("view --method lm", "unknown option --method; here it is --solver"),
        ("view --csv a.csv", "unknown option --csv; here it is --record"),
        ("view --seconds 0", "--seconds: 0.0 is out of range; allowed: above 0"),
        ("view --rate 241", "--rate: 241.0 is out of range; allowed: at least 1, at most 240"),
        ("reach --camera-extrinsics a", "here it is --extrinsics"),
        ("reach --nonsense", "robot-ik reach has no option --nonsense"),
        ("reach --follow inf", "--follow: inf is out of range; allowed: above 0"),
        ("servo scan extra", "unexpected argument extra"),
        ("robots a b c", "unexpected argument b c"),
        ("doctor --jsn", "unknown option --jsn; did you mean --json?"),
        ("servo move", "JOINT=DEG …: this argument is required"),
        ("servo move a=1", "--bus: this argument is required; allowed: sim|pty|PORT"),
        (
            "servo move joint1=1 --bus sim --on_exit hold --on-exit torque_off",
            "--on-exit: given twice",
        ),
    ],
)
def test_wrong_lines_are_explained(line: str, reported: str, robot_ik: Any) -> None:
    run = robot_ik(*line.split())
    run.assert_one_screen_error()
    assert reported in run.err


@pytest.mark.parametrize(
    "line",
    [
        "solve --overwrite",
        "solve --record a",
        "servo scan --rate 3",
        "reach --rate 3",
    ],
)
def test_no_suggestion_is_better_than_a_wrong_one(line: str, robot_ik: Any) -> None:
    run = robot_ik(*line.split())
    run.assert_one_screen_error()
    assert "did you mean" not in run.err


def test_a_group_without_a_command_shows_its_help(robot_ik: Any) -> None:
    run = robot_ik("servo")
    assert run.code == 2 and "scan" in run.out


def test_an_alias_works_and_is_not_listed(robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    aliases = ("find-servos", "servo list")
    row = Row("servo scan", "List servos.", "servo_scan:ServoScan", aliases=aliases)
    monkeypatch.setattr(main, "GROUPS", {"Servos": (row,)})
    for alias in row.aliases:
        assert "--baud" in robot_ik(*alias.split(), "--help").out
    assert "find-servos" not in robot_ik("--help").out
    assert "list" not in robot_ik("servo", "--help").out
    assert "did you mean `robot-ik find-servos`?" in robot_ik("find-servo").err


@pytest.mark.parametrize("name", COMMANDS)
def test_help(name: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    run = robot_ik(*name.split(), "--help")
    assert run.code == 0 and run.err == ""
    assert max(map(len, run.out.splitlines())) <= 80
    assert run.out.startswith(f"Usage: robot-ik {name}")
    assert "None" not in run.out


def test_help_imports_nothing_heavy() -> None:
    lines = ["--help", *(f"{name} --help" for name in COMMANDS)]
    code = (
        "import contextlib, io, sys\n"
        "from robot_ik.commands.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        f"    [main(line.split()) for line in {lines}]\n"
        f"print([name for name in {HEAVY} if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
