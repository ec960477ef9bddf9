"""Finding servos and giving them an address, over a real port with servos at rates of their own."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace
from typing import Any

import pytest

from robot_ik.hardware import discovery
from robot_ik.hardware.discovery import FoundServo
from robot_ik.hardware.family import family_of
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import RealClock

X = family_of("dynamixel_x")

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="pseudo terminals"),
    pytest.mark.usefixtures("quick_scan"),
]


def test_ports_without_any(robot_ik: Any, ports: Any) -> None:
    ports("/dev/ttyS0")
    run = robot_ik("servo", "ports")
    run.assert_one_screen_error(code=1)


def test_ports_name_the_adapter_and_who_uses_it(robot_ik: Any, ports: Any, desk: Any) -> None:
    ports(desk.port)
    (row,) = json.loads(robot_ik("servo", "ports", "--json").out)["ports"]
    assert row["used_by"] == []  # this process serves it, which is no use of it
    client = os.open(desk.port, os.O_RDWR | os.O_NOCTTY)
    try:
        (row,) = json.loads(robot_ik("servo", "ports", "--json").out)["ports"]
    finally:
        os.close(client)
    assert (row["port"], row["usb"], row["adapter"], row["serial"]) == (
        desk.port,
        "0403:6014",
        "U2D2",
        "FT1",
    )
    assert any(f"({os.getpid()})" in user for user in row["used_by"])
    run = robot_ik("servo", "ports")
    assert run.code == 0 and "0403:6014" in run.out


def test_a_name_that_survives_replugging(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from robot_ik.hardware import ports

    names = tmp_path / "by-id"
    names.mkdir()
    (tmp_path / "ttyUSB0").write_text("")
    (names / "usb-FTDI-if00").symlink_to("../ttyUSB0")
    monkeypatch.setattr(ports, "BY_ID", names)
    listed = [
        SimpleNamespace(device=str(tmp_path / f"ttyUSB{k}"), description="U2D2") for k in (0, 1)
    ]
    assert [ports.port_row(port)["stable"] for port in listed] == [str(names / "usb-FTDI-if00"), ""]


def alone(desk: Any, *, baud_code: int = 1, id: int = 1) -> VirtualServo:
    """Only the servo of joint3 is connected, as bought."""
    for other in (1, 2):
        desk.bus.remove(desk.servo(other))
    servo = desk.servo(3)
    servo.memory.set("baud_rate", baud_code)
    servo.memory.set("id", id)
    return servo


def test_setup_by_joint(robot_ik: Any, desk: Any) -> None:
    servo = alone(desk)
    run = robot_ik("servo", "setup", *desk.at, "--joint", "joint3")
    assert run.code == 0, run.err
    assert (servo.id, servo.baud, servo.return_delay) == (3, 1_000_000, 0.0)


def test_setup_by_number(robot_ik: Any, desk: Any) -> None:
    servo = alone(desk, baud_code=3, id=9)
    run = robot_ik(
        "servo", "setup", *desk.at, "--id", 17, "--baud", 57_600, "--from-baud", 1_000_000
    )
    assert run.code == 0 and (servo.id, servo.baud) == (17, 57_600)


def test_setup_refuses_company(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "setup", *desk.at, "--id", 9, "--from-baud", 1_000_000)
    run.assert_one_screen_error()
    assert "3 servos" in run.err
    assert sorted(servo.id for servo in desk.bus.servos) == [1, 2, 3]


def test_setup_refuses_two_of_one_id(robot_ik: Any, desk: Any) -> None:
    alone(desk)
    other = VirtualServo("XL330-M288", 1, RealClock(), baud=57_600)
    desk.bus.add(other)
    robot_ik("servo", "setup", *desk.at, "--id", 9, "--from-baud", 57_600).assert_one_screen_error()
    assert other.id == 1


def test_setup_refuses_a_servo_with_torque(robot_ik: Any, desk: Any) -> None:
    servo = alone(desk)
    servo.memory.set("torque_enable", 1)
    run = robot_ik("servo", "setup", *desk.at, "--id", 9, "--from-baud", 57_600)
    run.assert_one_screen_error()
    assert servo.id == 1 and "torque off" in run.err


def test_setup_refuses_another_model(robot_ik: Any, desk: Any) -> None:
    servo = alone(desk)
    run = robot_ik("servo", "setup", *desk.at, "--joint", "joint1", "--from-baud", 57_600)
    assert run.code == 2 and "XM430-W350" in run.err and servo.id == 1


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--id", 3, "--joint", "joint1"),
        ("--id", 253),
        ("--joint", "joitn1"),
        ("--id", 3, "--baud", 7),
    ],
)
def test_setup_wrong_input(options: tuple[Any, ...], robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "setup", *desk.at, *options).assert_one_screen_error()


def test_setup_of_a_rate_that_the_model_has_not(robot_ik: Any, desk: Any) -> None:
    servo = alone(desk)
    run = robot_ik(
        "servo", "setup", *desk.at, "--id", 3, "--baud", 4_500_000, "--from-baud", 57_600
    )
    assert run.code == 2 and "4000000" in run.err and servo.id == 1


def test_setup_without_a_servo(robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "setup", *desk.at, "--id", 3, "--from-baud", 9600).assert_one_screen_error(
        code=1
    )


@pytest.mark.parametrize(
    ("found", "reported"),
    [
        ([FoundServo(1, 1_000_000, X), FoundServo(2, 1_000_000, X)], []),
        (
            [FoundServo(1, 57_600, X), FoundServo(2, 1_000_000, X)],
            ["different rates (57600: id 1; 1000000: id 2)"],
        ),
        (
            [FoundServo(id, rate, X) for rate in (1_000_000, 57_600, 2_000_000) for id in (1, 2)],
            ["answer at every rate: the port has no baud rate"],
        ),
        (
            [FoundServo(1, 57_600, X), FoundServo(1, 1_000_000, X)],
            ["different rates"],
        ),  # both as bought
        (
            [FoundServo(1, 57_600, X, shared=True), FoundServo(2, 57_600, X)],
            ["id 1 at 57600: damaged replies. Two"],
        ),
        (
            [FoundServo(id, 57_600, X, shared=True) for id in (1, 2)],
            ["every reply is damaged: check the cable"],
        ),
    ],
)
def test_problems_of_several_servos(found: list[FoundServo], reported: list[str]) -> None:
    notes = discovery.scan_notes(found)
    assert len(notes) == len(reported) and all(
        part in note for part, note in zip(reported, notes, strict=True)
    )
