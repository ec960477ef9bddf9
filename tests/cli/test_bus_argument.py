"""Every command says --bus in the words of the table of buses."""

from __future__ import annotations

from typing import Any

import pytest

from robot_ik.hardware import BUSES

COMMANDS = [("reach",), ("run",), ("servo", "scan"), ("servo", "calibrate"), ("camera", "handeye")]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_every_bus_of_the_table(command: tuple[str, ...], robot_ik: Any) -> None:
    run = robot_ik(*command, "--help")
    assert run.code == 0
    text = " ".join("".join(c if c.isascii() else " " for c in run.out).split())
    assert "|".join(BUSES) in text
    for bus in BUSES.values():
        assert f"{bus.name}: {bus.title.split(',')[0]}" in text
