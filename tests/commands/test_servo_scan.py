"""Finding servos, over a real port with servos at rates of their own."""

from __future__ import annotations

import json
import os
from typing import Any

import pytest

from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import RealClock

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="pseudo terminals"),
    pytest.mark.usefixtures("quick_scan"),
]


def test_the_only_port_needs_no_name(robot_ik: Any, ports: Any, desk: Any) -> None:
    ports(desk.port)
    assert robot_ik("servo", "scan", "--baud", "1000000").code == 0
    ports(desk.port, "/dev/ttyUSB9")
    run = robot_ik("servo", "scan")
    run.assert_one_screen_error()
    assert "/dev/ttyUSB9" in run.err
    ports()
    robot_ik("servo", "scan").assert_one_screen_error()


def test_every_rate_is_tried(robot_ik: Any, desk: Any) -> None:
    desk.servo(2).memory.set("baud_rate", 7)  # 4.5 M, which the SDK alone cannot open
    desk.servo(3).memory.set("baud_rate", 1)
    desk.servo(3).set_supply(9.0)
    report = json.loads(robot_ik("servo", "scan", *desk.at, "--json").out)
    assert len(report["bauds"]) == 13
    seen = {s["id"]: s for s in report["servos"]}
    assert {id: s["baud"] for id, s in seen.items()} == {1: 1_000_000, 2: 4_500_000, 3: 57_600}
    assert {id: s["model"] for id, s in seen.items()} == {
        1: "XM430-W350",
        2: "XL430-W250",
        3: "XL330-M288",
    }
    assert seen[3]["errors"] == ["input_voltage"] and seen[3]["voltage"] == 9.0
    assert seen[1]["firmware"] == 48 and seen[1]["torque"] is False and not seen[1]["shared"]


def test_two_servos_with_one_id_are_suspected(robot_ik: Any, desk: Any) -> None:
    desk.bus.add(VirtualServo("XL430-W250", 2, RealClock()))
    run = robot_ik("servo", "scan", *desk.at, "--baud", "1000000", "--json")
    seen = {s["id"]: s["shared"] for s in json.loads(run.out)["servos"]}
    assert seen == {1: False, 2: True, 3: False}
    assert "id 2" in run.err and "another" in run.err


def test_nobody_answers(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "scan", *desk.at, "--baud", "2000000")
    run.assert_one_screen_error(code=1)
    assert "supply" in run.err and "57600" in run.err  # what to look at, and what was not tried


def test_scan_in_process(robot_ik: Any) -> None:
    run = robot_ik("servo", "scan", "--bus", "sim", "--baud", "1000000")
    assert run.code == 0 and run.out.count("XM430-W350") == 2


@pytest.mark.parametrize(
    "words",
    [
        ("--baud", "1000000", "--baud", "57600"),
        ("--baud=57600", "--json", "--baud", "1000000"),
        ("--baud", "1000000", "2000000", "--baud=57600"),
    ],
)
def test_rates_may_be_given_one_by_one(words: tuple[str, ...], robot_ik: Any, desk: Any) -> None:
    desk.servo(3).memory.set("baud_rate", 1)  # 57 600
    run = robot_ik("servo", "scan", *desk.at, *words, *(() if "--json" in words else ("--json",)))
    assert {(s["id"], s["baud"]) for s in json.loads(run.out)["servos"]} == {
        (1, 1_000_000),
        (2, 1_000_000),
        (3, 57_600),
    }


@pytest.mark.parametrize("rate", ["1234", "0", "x"])
def test_a_rate_that_no_servo_has(rate: str, robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "scan", *desk.at, "--baud", rate)
    assert run.code == 2 and run.out == "" and "Traceback" not in run.err
