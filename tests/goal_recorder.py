"""A pytest plugin: in a test with an ``Arm`` no command beyond limits reaches the servos.

It reads every packet to simulated servos, in this process and behind a pty. It costs nothing in
tests without an arm. It does not read the packets of other processes, such as a command line.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.abc import MetaPathFinder
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.protocol import Packet, Parser

_WRITE = 0x03
_REG_WRITE = 0x04
_SYNC_WRITE = 0x83
_BULK_WRITE = 0x93


class GoalRecorder:
    """Reads every packet to the servos of an arm, and records goals that are not allowed.

    A goal must be inside the range of the arm file. If the shaft is outside, the goal may be
    between shaft and range.
    """

    def __init__(self) -> None:
        self.goals = 0
        self.forbidden: list[str] = []
        self._watched: dict[int, tuple[VirtualBus, dict[int, Any], Parser]] = {}

    def watch(self, bus: VirtualBus, config: ArmConfig) -> None:
        """Record the goals of an arm. The reference to the bus keeps its id unique."""
        from robot_ik.hardware.virtual.protocol import Parser

        self._watched[id(bus)] = (bus, {drive.id: drive for drive in config.drives}, Parser())

    def see(self, bus: VirtualBus, data: bytes) -> None:
        """Called with what goes to the servos, before they have it."""
        if id(bus) not in self._watched:
            return
        _, servos, parser = self._watched[id(bus)]
        for packet in parser.feed(data, bus.clock.now()):
            for servo_id, address, written in self._writes(packet):
                servo = servos.get(servo_id)
                if servo is None:
                    continue
                goal = servo.servo.table["goal_position"]
                if address <= goal.address < address + len(written):
                    at = goal.address - address
                    self.check(bus, servo, goal.decode(written[at : at + goal.size]))

    def check(self, bus: VirtualBus, servo: Any, goal: int) -> None:
        """One goal for one servo."""
        self.goals += 1
        first, last = servo.ticks_range
        if first <= goal <= last:
            return
        at = servo.servo.table["present_position"]
        for present in (
            at.decode(s.read(at.address, at.size)[0]) for s in bus.servos if s.id == servo.id
        ):
            if not min(first, present) <= goal <= max(last, present):
                self.forbidden.append(
                    f"{servo.name}: {goal}, range {first}..{last}, shaft at {present}"
                )

    @staticmethod
    def _writes(packet: Packet) -> Iterator[tuple[int, int, bytes]]:
        """(id, address, data) of every write in a packet."""
        params = packet.params
        if not packet.valid:
            return
        if packet.instruction in (_WRITE, _REG_WRITE):
            yield packet.id, int.from_bytes(params[:2], "little"), params[2:]
        elif packet.instruction == _SYNC_WRITE:
            address = int.from_bytes(params[:2], "little")
            size = int.from_bytes(params[2:4], "little")
            for at in range(4, len(params), 1 + size):
                yield params[at], address, params[at + 1 : at + 1 + size]
        elif packet.instruction == _BULK_WRITE:
            at = 0
            while at < len(params):
                size = int.from_bytes(params[at + 3 : at + 5], "little")
                address = int.from_bytes(params[at + 1 : at + 3], "little")
                yield params[at], address, params[at + 5 : at + 5 + size]
                at += 5 + size


_now = GoalRecorder()
"""Of the test that is running."""


def _tap_bus(module: Any) -> None:
    respond = module.VirtualBus.respond

    def tapped(self: VirtualBus, data: bytes, baud: int | None = None) -> object:
        with self.lock:
            _now.see(self, data)
            return respond(self, data, baud)

    module.VirtualBus.respond = tapped


def _tap_arm(module: Any) -> None:
    make = module.Arm.__init__

    def made(self: Any, config: ArmConfig, *arguments: object, **options: object) -> None:
        make(self, config, *arguments, **options)
        servos = getattr(self.bus, "virtual_bus", None)
        if servos is not None:
            _now.watch(servos, config)

    module.Arm.__init__ = made


_TAPS = {"robot_ik.hardware.virtual.bus": _tap_bus, "robot_ik.hardware.arm": _tap_arm}


class _Tapper(MetaPathFinder):
    """Taps the modules when somebody imports them: most tests never do."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        tap = _TAPS.pop(name, None)
        if tap is None:
            return None
        from importlib.util import find_spec

        spec = find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        run = spec.loader.exec_module

        def tapped(module: Any) -> None:
            run(module)
            if module.__name__ == name:  # pytest's rewriting loader is one for all modules
                tap(module)

        spec.loader.exec_module = tapped  # type: ignore[method-assign]
        return spec


def pytest_configure() -> None:
    """From here on every arm is watched."""
    for name in [name for name in _TAPS if name in sys.modules]:
        _TAPS.pop(name)(sys.modules[name])
    sys.meta_path.insert(0, _Tapper())


@pytest.fixture(autouse=True)
def goal_recorder() -> Iterator[GoalRecorder]:
    """No command beyond limits reaches the wire."""
    global _now
    _now = recorder = GoalRecorder()
    yield recorder
    assert not recorder.forbidden, recorder.forbidden[:5]
