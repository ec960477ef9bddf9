"""Moving joints, over a real port with the real SDK."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")


def degrees(desk: Any) -> list[float]:
    """Return the true joint values."""
    return np.degrees(desk.bus.true_angles(desk.config)).tolist()


def test_move_one_joint(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "move", "joint2=20", *desk.at)
    assert run.code == 0, run.err
    assert degrees(desk) == pytest.approx([0.0, 20.0, 0.0], abs=0.3)
    assert desk.torque() == [False] * 3 and "torque is off" in run.err


def test_move_all_joints_then_by_some(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "move", 10, -20, 5.5, *desk.at, "--speed", 1, "--on-exit", "hold")
    assert run.code == 0, run.err
    assert desk.torque() == [True] * 3 and "torque ON" in run.err
    assert [s.memory.values["bus_watchdog"] for s in desk.bus.servos] == [0] * 3
    run = robot_ik("servo", "move", "joint1=-15", "--relative", *desk.at, "--speed", 1)
    assert run.code == 0, run.err
    assert degrees(desk) == pytest.approx([-5.0, -20.0, 5.5], abs=0.3)


def test_a_joint_that_is_held_fast_is_reported(
    robot_ik: Any, desk: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from robot_ik.hardware import cycle

    monkeypatch.setattr(cycle, "GRACE", 0.1)
    desk.servo(2).stuck = True
    run = robot_ik("servo", "move", "joint2=5", *desk.at, "--speed", 1)
    assert run.code == 1 and "joint2" in run.err and desk.torque() == [False] * 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("joint1=101",), "-100.0 to 100.0"),
        (("joint1=nan",), "joint1"),
        (("joint1=",), "joint1"),
        (("joitn1=3",), "joint1"),
        (("joint1=3", "joint1=4"), "twice"),
        ((1, 2), "3 numbers"),
        ((1, 2, 3, 4), "3 numbers"),
        (("joint1=3", 4), "3 numbers"),
        (("joint1=3", "--speed", 0), "--speed"),
        (("joint1=3", "--on-exit", "fly"), "--on-exit: unknown value 'fly'"),
        (("joint1=3", "--on-exit", "holt"), "did you mean 'hold'?"),
    ],
)
def test_move_wrong_input(words: tuple[Any, ...], named: str, robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "move", *words, *desk.at)
    run.assert_one_screen_error()
    assert named in run.err and desk.torque() == [False] * 3


def test_move_by_too_far(robot_ik: Any, desk: Any) -> None:
    desk.turn("joint1", 90.0)
    run = robot_ik("servo", "move", "joint1=20", "--relative", *desk.at)
    run.assert_one_screen_error()
    assert degrees(desk)[0] == pytest.approx(90.0, abs=0.1) and desk.torque() == [False] * 3


def test_move_on_the_wrong_arm(robot_ik: Any, desk: Any) -> None:
    desk.servo(3).memory.set("model_number", 1060)
    run = robot_ik("servo", "move", "joint1=3", *desk.at)
    run.assert_one_screen_error()
    assert "joint3: XL330-M288" in run.err and "XL430-W250" in run.err


def test_ctrl_c_leaves_the_arm_by_its_exit_policy(desk: Any) -> None:
    command = [
        sys.executable,
        "-m",
        "robot_ik",
        "servo",
        "move",
        "joint1=90",
        *desk.at,
        "--speed",
        "0.02",
    ]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: desk.servo(1).shaft.reading > 2050)  # it is on its way
        child.send_signal(signal.SIGINT)
        _, err = child.communicate()
    finally:
        child.kill()
    assert child.returncode == 130 and "Traceback" not in err and "torque is off" in err
    assert desk.torque() == [False] * 3
    assert degrees(desk)[0] < 45.0


def test_a_value_just_outside_shows_the_digits_that_differ(robot_ik: Any, desk: Any) -> None:
    upper = float(np.degrees(desk.config.upper[0]))
    run = robot_ik("servo", "move", *desk.at, f"joint1={upper + 0.01!r}")
    asked, allowed = run.err.partition(" deg is outside its limits; allowed: ")[::2]
    assert run.code == 2 and asked.split()[-1] not in allowed.partition(" deg")[0], run
    assert float(asked.split()[-1]) == pytest.approx(upper + 0.01, abs=0.006)


def test_move_in_json(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "move", "joint2=20", *desk.at, "--json")
    facts = json.loads(run.out)
    assert run.code == 0 and facts["schema"] == 1
    assert facts["goal"] == {"joint2": pytest.approx(np.radians(20.0))}
    assert np.degrees(facts["end"]["joint2"]) == pytest.approx(20.0, abs=0.3)


def test_without_a_bus_nothing_moves(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "move", "joint2=20", "--arm", desk.arm)
    run.assert_one_screen_error()
    assert "--bus: this argument is required; allowed: sim|pty|PORT" in run.err


def test_lines_appear_above_the_progress_bar() -> None:
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "robot_ik", "servo", "move", "joint1=3", "--bus", "sim"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    with open(master, "rb", buffering=0) as screen:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=slave, stderr=slave, env=environment
        )
        os.close(slave)
        shown = b""
        with contextlib.suppress(OSError):  # the child has closed the other end
            while part := screen.read(4096):
                shown += part
        child.wait()
    assert child.returncode == 0, shown
    assert b"moving" in shown, "the phase is in the bar"
    assert re.search(rb"\x1b\[2K(\x1b\[2m)?torque is off", shown), "the bar is erased first"
