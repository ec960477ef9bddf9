"""Statements of the hardware pages: sources of packets, logged goals, tests of promises."""

from __future__ import annotations

import ast
import logging
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from dynamixel_sdk import Protocol2PacketHandler

from robot_ik import hardware, joint_move, load_robot
from robot_ik.execution import execute
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.family import FAMILY_MODULES
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import Instruction, Packet, Parser
from robot_ik.ports import VirtualClock

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
REFERENCE = DOCS / "reference"
ROBOT = load_robot("puma560")
assert ROBOT.arm_file is not None
CONFIG = ArmConfig.load(ROBOT.arm_file)
POSITION, GOAL = (X_TABLES["XM430-W350"][name] for name in ("present_position", "goal_position"))

CALLS: dict[str, Callable[[ServoBus], object]] = {
    "ping": lambda bus: bus.ping(1),
    "read": lambda bus: bus.read(1, POSITION),
    "write": lambda bus: bus.write(1, GOAL, 2048),
    "reboot": lambda bus: bus.reboot(2),
    "sync_write": lambda bus: bus.sync_write(GOAL, {1: 2048}),
    "sync_read": lambda bus: bus.sync_read([1, 3], POSITION),
    "exchange": lambda bus: bus.exchange(GOAL, {1: 2048}, {1: POSITION}),
    "broadcast_ping": lambda bus: bus.broadcast_ping(),
}


def _servos() -> VirtualBus:
    return VirtualBus.from_config(CONFIG, VirtualClock())


@pytest.mark.parametrize("call", CALLS)
def test_the_table_names_the_source_of_the_packets_of_each_call(
    call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: set[str] = set()
    for name in ("txPacket", "rxPacket"):
        plain = getattr(Protocol2PacketHandler, name)

        def noted(*arguments: Any, _plain: Any = plain, _name: str = name) -> Any:
            used.add(_name)
            return _plain(*arguments)

        monkeypatch.setattr(Protocol2PacketHandler, name, noted)
    bus = SimBus(_servos())
    bus.open()
    sent = bus.counters.bytes_sent
    CALLS[call](bus)
    bus.close()
    assert bus.counters.bytes_sent > sent
    page = (REFERENCE / "hardware.md").read_text(encoding="utf-8")
    packets = page.partition("\n## Packets\n")[2].partition("\n## ")[0]
    (row,) = [row for row in packets.splitlines() if row.startswith("|") and f"`{call}`" in row]
    assert ("the official Dynamixel SDK" in row.split("|")[3]) == (used == {"txPacket", "rxPacket"})
    assert ("hardware/packets.py" in row.split("|")[3]) == (not used)


def test_every_call_of_a_bus_is_in_that_table() -> None:
    calls = {name for name in vars(ServoBus) if not name.startswith("_")}
    assert calls - {"open", "close", "is_open", "use_fast_reads", "fileno"} == set(CALLS)


class Wire(VirtualBus):
    """Stores the goals that arrive in packets of all kinds."""

    def respond(self, data: bytes, baud: int | None = None) -> Any:
        for packet in Parser().feed(data, 0.0):
            self.goals_seen().update(_goals(packet))
        return super().respond(data, baud)

    def goals_seen(self) -> set[tuple[int, int]]:
        seen: set[tuple[int, int]] = self.__dict__.setdefault("_goals_seen", set())
        return seen


def _goals(packet: Packet) -> list[tuple[int, int]]:
    """(id, goal) of every goal in a packet."""
    params = packet.params
    word = lambda at: int.from_bytes(params[at : at + 2], "little")  # noqa: E731
    goal = lambda at: int.from_bytes(params[at : at + 4], "little", signed=True)  # noqa: E731
    if packet.instruction == Instruction.WRITE and word(0) == GOAL.address:
        return [(packet.id, goal(2))]
    if packet.instruction == Instruction.SYNC_WRITE and word(0) == GOAL.address:
        return [(params[at], goal(at + 1)) for at in range(4, len(params), 5)]
    return []


def test_the_bus_of_the_recipe_logs_every_sent_goal(
    caplog: pytest.LogCaptureFixture,
) -> None:
    page = (DOCS / "how-to" / "extend.md").read_text(encoding="utf-8")
    (code,) = [
        text
        for text in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        if "class LoggedBus" in text
    ]
    module = types.ModuleType("logged")
    exec(compile(code, "extend.md", "exec", dont_inherit=True), module.__dict__)
    (row,) = re.findall(r'```text\n(Bus\("logged".*?),\n```', page)
    made = {"_logged": lambda name, config, servos: module.LoggedBus(servos)}
    logged_bus = eval(row, vars(hardware) | made)
    assert logged_bus.virtual_time
    servos = Wire.from_config(CONFIG, VirtualClock(), ROBOT.home)
    bus = logged_bus.make("logged", CONFIG, servos)
    with (
        caplog.at_level(logging.INFO, logger=module.__name__),
        Arm(CONFIG, bus) as arm,
    ):
        arm.enable()
        execute(joint_move(ROBOT, arm.read().q, ROBOT.home + 0.1), [arm], clock=arm.clock)
        for call in ("write", "sync_write", "exchange"):
            CALLS[call](bus)
    logged: set[tuple[int, int]] = set()
    for record in caplog.records:
        if record.name == module.__name__:
            logged |= set(ast.literal_eval(record.getMessage().partition(": ")[2]).items())
    assert len(servos.goals_seen()) > 100
    assert servos.goals_seen() <= logged, "a goal that is in no log"


FAMILIES = tuple(FAMILY_MODULES)
HARDWARE_TESTS = ROOT / "tests" / "hardware"
PROMISES = "test_safety_promises.py"
"""File of the tests that the page names without a file."""

ROBOTS_OF = {"dynamixel_x": ("koch_v11", "[2"), "feetech_sts": ("so101", "[1")}
"""Family -> parts of test ids: its robot, or the number of its wire protocol."""


def _rows(heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without its head."""
    page = (REFERENCE / "safety.md").read_text(encoding="utf-8")
    part = page.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    rows = [
        [cell.strip() for cell in row.strip("|").split("|")]
        for row in part.splitlines()
        if row[:1] == "|"
    ]
    return rows[2:]


def _named_tests(cell: str) -> list[tuple[str, str]]:
    """Return (file, test) for every test in a cell."""
    names = re.findall(r"`(?:([\w/]+\.py)::)?(test_\w+)`", cell)
    return [(file or PROMISES, test) for file, test in names]


def _collected(files: set[str]) -> list[str]:
    """Return the ids of all tests in files of tests/hardware, as pytest collects them."""
    words = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
    paths = [str(HARDWARE_TESTS / file) for file in sorted(files)]
    run = subprocess.run([*words, *paths], capture_output=True, text=True, cwd=ROOT, check=False)
    assert run.returncode == 0, run.stdout
    return [line for line in run.stdout.splitlines() if "::" in line]


def test_every_promise_has_a_test_for_every_family() -> None:
    promises = [row[0] for row in _rows("What is guaranteed")]
    tests = {number: cells for number, *cells in _rows("Tests of the promises")}
    assert len(promises) >= 25
    assert list(tests) == promises
    cells_of_families = {
        number: dict(zip(FAMILIES, (f"{both} {single}" for single in singles), strict=True))
        for number, (both, *singles) in tests.items()
    }
    files = {
        file
        for cells in cells_of_families.values()
        for cell in cells.values()
        for file, _ in _named_tests(cell)
    }
    collected = _collected(files)
    for number, cells in cells_of_families.items():
        for family, cell in cells.items():
            assert _named_tests(cell), f"no test of {family} is named for promise {number}"
    for number, (both, *singles) in tests.items():
        for file, test in _named_tests(" ".join([both, *singles])):
            ids = [line for line in collected if f"{file}::{test}" in line]
            assert ids, f"{file}::{test} of promise {number} does not exist"
        for file, test in _named_tests(both):
            ids = [line for line in collected if f"{file}::{test}" in line]
            for family in FAMILIES:
                parts = (family, *ROBOTS_OF[family])
                runs = any(part in line for line in ids for part in parts)
                assert runs, f"{file}::{test} of promise {number} does not run for {family}"
