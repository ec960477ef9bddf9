"""Watching, moving, torque and faults, over a real port with the real SDK."""

from __future__ import annotations

import json
import os
import time
from typing import Any

import numpy as np
import pytest

from robot_ik.hardware.virtual.faults import Fault

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")


def degrees(desk: Any) -> list[float]:
    """Where the joints really are."""
    return np.degrees(desk.bus.true_angles(desk.config)).tolist()


def test_monitor_in_lines_of_json(robot_ik: Any, desk: Any) -> None:
    desk.turn("joint2", 30.0)
    desk.servo(3).inject_error("overheating")
    run = robot_ik("servo", "monitor", *desk.at, "--json", "--count", 2, "--rate", 100)
    samples = [json.loads(line) for line in run.out.splitlines()]
    assert run.code == 0 and len(samples) == 2 and samples[0]["time"] < samples[1]["time"]
    first, second, third = samples[1]["servos"]
    assert second["position_deg"] == pytest.approx(30.0, abs=0.05) and second["joint"] == "joint2"
    assert (first["voltage"], second["voltage"], third["voltage"]) == (12.0, 12.0, 5.0)
    assert third["errors"] == ["overheating"] and first["errors"] == [] and first["torque"] is False
    assert (
        first["current_ma"] is not None and second["current_ma"] is None
    )  # an XL430 tells its load
    assert second["load_percent"] is not None


def test_monitor_tells_velocity_in_the_joints_direction(robot_ik: Any, desk: Any) -> None:
    servo = desk.servo(2)  # turns the other way round, twice as far
    servo.memory.set("operating_mode", 1)
    with desk.bus.lock:
        for name, value in (("torque_enable", 1), ("goal_velocity", 50)):
            register = servo.table[name]
            servo.write(register.address, register.encode(value))
    time.sleep(0.1)
    run = robot_ik("servo", "monitor", *desk.at, "--json", "--count", 1)
    velocity = json.loads(run.out)["servos"][1]["velocity_deg"]
    assert velocity == pytest.approx(-50 * 0.229 * 6.0 / 2.0, abs=1.5)


def test_monitor_as_a_table_and_a_silent_servo(robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "monitor", *desk.at, "--count", 1)
    assert run.code == 0 and "joint3" in run.out and "12.0 V" in run.out
    desk.servo(2).silent = True
    run = robot_ik("servo", "monitor", *desk.at, "--count", 1)
    assert run.code == 1 and "no answer" in run.out


@pytest.mark.parametrize(
    "options", [("--rate", 0), ("--rate", "nan"), ("--rate", 1e9), ("--count", -1)]
)
def test_monitor_wrong_input(options: tuple[Any, ...], robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "monitor", *desk.at, *options).assert_one_screen_error()


def test_torque_on_requires_a_bus(robot_ik: Any, desk: Any, ports: Any) -> None:
    ports(desk.port)
    run = robot_ik("servo", "torque", "on", "--arm", desk.arm)
    run.assert_one_screen_error()
    assert "--bus: torque on can move an arm" in run.err
    assert desk.bus.schedule.packets == 0
    assert robot_ik("servo", "torque", "off", "--arm", desk.arm).code == 0


def test_torque_on_holds_and_off_lets_go(robot_ik: Any, desk: Any) -> None:
    desk.turn("joint3", 25.0)
    run = robot_ik("servo", "torque", "on", *desk.at)
    assert run.code == 0 and desk.torque() == [True] * 3
    assert degrees(desk) == pytest.approx([0.0, 0.0, 25.0], abs=0.1)
    run = robot_ik("servo", "torque", "off", *desk.at)
    assert run.code == 0 and desk.torque() == [False] * 3 and "joint3" in run.out


def test_torque_of_some_joints(robot_ik: Any, desk: Any) -> None:
    assert robot_ik("servo", "torque", "on", "joint1", "joint3", *desk.at).code == 0
    assert desk.torque() == [True, False, True]
    assert robot_ik("servo", "torque", "off", "joint3", *desk.at).code == 0
    assert desk.torque() == [True, False, False]


def test_torque_off_by_id_of_a_stranger(robot_ik: Any, desk: Any) -> None:
    servo = desk.servo(3)
    servo.memory.set("id", 77)
    servo.memory.set("baud_rate", 1)
    servo.memory.set("torque_enable", 1)
    run = robot_ik("servo", "torque", "off", "--id", 77, "--baud", 57_600, *desk.at)
    assert run.code == 0 and desk.torque() == [False] * 3


def test_torque_off_with_one_dead_servo_reaches_the_others(robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "torque", "on", *desk.at)
    desk.servo(2).silent = True
    run = robot_ik("servo", "torque", "off", *desk.at)
    assert run.code == 1 and "torque off for joint2: no answer from servo id 2" in run.err
    assert "error: not confirmed by joint2: torque may be ON, cut the power" in run.err
    assert (
        desk.torque() == [False, True, False]
        and run.out == "torque off, read back: joint1, joint3\n"
    )


def test_torque_off_on_a_port_that_goes_away_is_not_confirmed(robot_ik: Any, desk: Any) -> None:
    robot_ik("servo", "torque", "on", *desk.at)
    desk.bus.inject(Fault("port_unplugged", at_packet=1))
    run = robot_ik("servo", "torque", "off", *desk.at)
    assert run.code == 1 and "went away" in run.err and run.out == ""
    assert "error: not confirmed by joint1, joint2, joint3: torque may be ON" in run.err


@pytest.mark.parametrize(
    "words",
    [
        ("maybe",),
        ("off", "joitn1"),
        ("on", "--id", 1),
        ("off", "--id", 300),
        ("off", "joint1", "--id", 1),
    ],
)
def test_torque_wrong_input(words: tuple[Any, ...], robot_ik: Any, desk: Any) -> None:
    run = robot_ik("servo", "torque", *words, *desk.at)
    assert run.code == 2 and "Traceback" not in run.err and desk.torque() == [False] * 3


def test_reset_fault_restarts_who_has_shut_down(robot_ik: Any, desk: Any) -> None:
    assert robot_ik("servo", "torque", "on", *desk.at).code == 0
    desk.servo(1).inject_error("overload")
    desk.servo(3).reboot_time = 0.2
    desk.servo(3).inject_error("overheating")
    run = robot_ik("servo", "move", "joint2=1", *desk.at, "--on-exit", "hold")
    assert run.code == 1 and "overload" in run.err
    run = robot_ik("servo", "reset-fault", *desk.at)
    assert run.code == 0, run.out
    assert "overload" in run.out and "overheating" in run.out
    assert [s.memory.values["hardware_error_status"] for s in desk.bus.servos] == [0, 0, 0]
    assert desk.torque() == [False, True, False]  # joint2 was not touched


def test_reset_fault_of_a_tripped_watchdog_needs_no_restart(robot_ik: Any, desk: Any) -> None:
    desk.servo(1).memory.set("bus_watchdog", -1)
    run = robot_ik("servo", "reset-fault", *desk.at)
    assert run.code == 0 and "bus_watchdog" in run.out
    assert desk.servo(1).memory.values["bus_watchdog"] == 0


def test_reset_fault_tells_of_turns_that_were_forgotten(robot_ik: Any, desk: Any) -> None:
    desk.turn(
        "joint2", -90.0
    )  # 3048 ticks; another half turn of the joint is a whole one of the servo
    desk.turn("joint2", -180.0)
    desk.servo(2).inject_error("overload")
    run = robot_ik("servo", "reset-fault", "joint2", *desk.at)
    assert run.code == 1 and "whole revolutions" in run.out


def test_reset_fault_of_the_silent(robot_ik: Any, desk: Any) -> None:
    desk.servo(2).silent = True
    run = robot_ik("servo", "reset-fault", *desk.at)
    assert run.code == 1 and "no answer" in run.out and "joint3" in run.out
    robot_ik("servo", "reset-fault", "joitn2", *desk.at).assert_one_screen_error()


def test_a_stop_that_finds_no_program_says_who_takes_torque(robot_ik: Any) -> None:
    run = robot_ik("stop", "--torque-off", "--bus", "/dev/nowhere")
    assert run.code == 1 and "robot-ik servo torque off --bus /dev/nowhere" in run.err
    assert "torque" not in robot_ik("stop", "--bus", "/dev/nowhere").err
