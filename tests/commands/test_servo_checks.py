"""The doctor's checks of servos name each fault and its remedy, and write nothing."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

import pytest

from robot_ik.commands import doctor_checks as doctor
from robot_ik.hardware import checks
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import RealClock

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch, desk: Any) -> None:
    from robot_ik.hardware import discovery

    monkeypatch.setattr(discovery.SerialBus, "listening_time", 0.1)
    monkeypatch.setattr(discovery, "RESPONSE_TIME", 0.05)
    monkeypatch.setattr(discovery, "IDS", range(8))
    monkeypatch.setattr(doctor, "CHECKS", [])
    for servo in desk.bus.servos:
        servo.memory.set("return_delay_time", 0)


@pytest.fixture
def rows(robot_ik: Any, desk: Any) -> Callable[[], Any]:
    """``rows()``: the exit code, and the rows of the servos by id."""

    def look() -> tuple[int, dict[int, dict[str, str]]]:
        run = robot_ik("doctor", *desk.at, "--json")
        checked = [
            row
            for row in json.loads(run.out)["rows"]
            if row["what"].split()[1:] and row["what"].split()[1].isdigit()
        ]
        return run.code, {int(row["what"].split()[1]): row for row in checked}

    return look


def test_healthy_servos(rows: Any) -> None:
    code, found = rows()
    assert code == 0 and [row["status"] for row in found.values()] == [checks.OK] * 3
    assert "12.0 V" in found[1]["found"] and "firmware 48" in found[1]["found"]


def memory(name: str, value: int) -> Callable[[Any], object]:
    return lambda desk: desk.servo(2).memory.set(name, value)


@pytest.mark.parametrize(
    ("illness", "status", "found", "cure"),
    [
        (
            lambda d: setattr(d.servo(2), "silent", True),
            checks.PROBLEM,
            "no XL430-W250 answers",
            "cable",
        ),
        (memory("baud_rate", 1), checks.PROBLEM, "baud rate is 57600", "setup --joint joint2"),
        (memory("model_number", 1020), checks.PROBLEM, "says XL430-W250", "arm file"),
        (lambda d: d.servo(2).set_supply(5.0), checks.PROBLEM, "6.0 to 14.0 V", "power supply"),
        (lambda d: d.servo(2).inject_error("overload"), checks.PROBLEM, "overload", "reset-fault"),
        (memory("firmware_version", 37), checks.PROBLEM, "Bus Watchdog", "Wizard"),
        (memory("firmware_version", 42), checks.NOTE, "fast reads", "update"),
        (memory("status_return_level", 0), checks.NOTE, "pings only", "sets 2"),
        (memory("return_delay_time", 250), checks.NOTE, "500 us", "sets 0"),
        (memory("torque_enable", 1), checks.NOTE, "torque is on", "torque off"),
        (
            lambda d: d.bus.add(VirtualServo("XL430-W250", 2, RealClock())),
            checks.PROBLEM,
            "two",
            "--id N",
        ),
    ],
)
def test_cause_and_cure(
    illness: Any, status: str, found: str, cure: str, rows: Any, desk: Any
) -> None:
    illness(desk)
    code, seen = rows()
    row = seen[2]
    assert row["status"] == status and found in row["found"] and cure in row["do"], row
    assert code == (2 if status == checks.PROBLEM else 0)
    assert seen[1]["status"] == seen[3]["status"] == checks.OK


@pytest.mark.parametrize(("late_ms", "status"), [(0.0, checks.OK), (16.0, checks.NOTE)])
def test_the_latency_of_an_adapter_is_measured(
    late_ms: float, status: str, desk: Any, robot_ik: Any
) -> None:
    desk.bus.inject(Fault("latency", value=late_ms))
    run = robot_ik("doctor", *desk.at, "--json")
    (row,) = [row for row in json.loads(run.out)["rows"] if row["what"] == "servo speed"]
    late = float(row["found"].split()[3])
    # A busy machine adds latency.
    assert late_ms <= late + 0.1 and (row["status"] == status or late > late_ms + 3.0), row
    assert run.code == 0 and ("latency timer" in row["do"]) == (row["status"] == checks.NOTE)


def test_a_stranger_on_the_bus(rows: Any, desk: Any) -> None:
    desk.bus.add(VirtualServo("XM540-W270", 7, RealClock()))
    code, found = rows()
    assert code == 0 and "XM540-W270" in found[7]["found"] and found[7]["status"] == checks.NOTE


def test_no_such_port_and_no_such_arm(
    robot_ik: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a short path, which no table wraps
    run = robot_ik("doctor", "--bus", "no")
    assert run.code == 2 and "no such port" in run.out
    robot_ik("doctor", "--bus", "x", "--arm", "pmua560").assert_one_screen_error()


def test_simulated_servos_are_checked_and_a_typing_error_is_named(robot_ik: Any) -> None:
    run = robot_ik("doctor", "--bus", "sim", "--arm", "koch_v11", "--json")
    subjects = {row["what"] for row in json.loads(run.out)["rows"]}
    assert run.code == 0 and {"servo 1 shoulder_pan", "servo 6 gripper"} <= subjects
    run = robot_ik("doctor", "--bus", "smi")
    assert run.code == 2 and "did you mean sim?" in run.out
