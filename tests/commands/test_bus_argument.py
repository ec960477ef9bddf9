"""Every command says --bus in the words of the table of buses."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import pytest

from robot_ik import hardware
from robot_ik.hardware import BUSES, Bus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.ports import NO_PORTS
from robot_ik.ports import VirtualClock
from robot_ik.script import load_script
from robot_ik.script.run import ScriptRequest, ScriptRun
from robot_ik.workcell.teleop import open_pair

COMMANDS = [("reach",), ("run",), ("servo", "scan"), ("servo", "calibrate"), ("camera", "handeye")]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_every_bus_of_the_table(command: tuple[str, ...], robot_ik: Any) -> None:
    run = robot_ik(*command, "--help")
    assert run.code == 0
    text = " ".join("".join(c if c.isascii() else " " for c in run.out).split())
    assert "|".join(BUSES) in text
    for bus in BUSES.values():
        assert f"{bus.name}: {bus.title.split(',')[0]}" in text


def test_messages_name_the_buses_of_simulated_servos() -> None:
    assert tuple(bus.name for bus in BUSES.values() if bus.virtual) == NO_PORTS
    assert hardware.SIMULATED == "--bus sim or pty"


@pytest.fixture
def own_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row more: servos on virtual time, as ``sim`` has them, by another name."""
    row = Bus("logged", "as sim, every goal in the log", True, BUSES["sim"].make, virtual_time=True)
    monkeypatch.setattr(hardware, "BUSES", MappingProxyType({**BUSES, "logged": row}))


@pytest.mark.usefixtures("own_bus")
def test_a_bus_of_ones_own_is_taken_where_sim_is(robot_ik: Any) -> None:
    found = robot_ik("servo", "scan", "--arm", "koch_v11", "--bus", "logged")
    assert found.code == 0 and "XL430-W250" in found.out
    run = ScriptRun(load_script("overload"), ScriptRequest("logged"))
    assert run.report.virtual_time
    config = ArmConfig.load("koch_v11")
    assert isinstance(open_pair(config, config, "logged", "sim")[1].clock, VirtualClock)
    led = (
        "--leader",
        "koch_v11",
        "--follower",
        "koch_v11",
        "--leader-bus",
        "logged",
        "--follower-bus",
        "logged",
    )
    assert robot_ik("teleop", *led, "--seconds", "0.1", "--on-exit", "torque_off").code == 0
