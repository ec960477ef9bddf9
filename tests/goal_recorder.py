"""A pytest plugin that fails a test in which an ``Arm`` sends a goal beyond its limits.

It reads every packet to simulated servos, in process and behind a pty, for every servo family. It
has no cost in tests without an arm. It does not read packets of child processes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.abc import MetaPathFinder
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus

# Instruction codes. Protocol 1 and Protocol 2 share those that they both have.
_WRITE = 0x03
_REG_WRITE = 0x04
_SYNC_WRITE = 0x83
_BULK_WRITE = 0x93

Write = tuple[int, int, bytes]
"""(servo id, address, data) of one write."""


class _Watched(NamedTuple):
    """A bus with the servos of an arm.

    Attributes:
        bus: The bus. It is kept, so that its ``id`` is not reused.
        drives: Servo id -> joint and servo.
        parser: Finds the instruction packets of the bus.
    """

    bus: VirtualBus
    drives: dict[int, Any]
    parser: Any


class GoalRecorder:
    """Reads every packet to the servos of an arm and keeps the goals that no arm may send.

    A goal lies within the arm file's range. If the shaft is outside, the goal lies between the
    shaft and the range.

    Attributes:
        goals: Number of goals.
        forbidden: Text of every goal beyond the limits.
    """

    def __init__(self) -> None:
        self.goals = 0
        self.forbidden: list[str] = []
        self._watched: dict[int, _Watched] = {}

    def watch(self, bus: VirtualBus, config: ArmConfig) -> None:
        """Watch the goals to the servos of an arm."""
        drives = {drive.id: drive for drive in config.drives}
        self._watched[id(bus)] = _Watched(bus, drives, bus.side.parser())

    def read_bytes(self, bus: VirtualBus, data: bytes) -> None:
        """Read bytes for the servos, before the servos receive them."""
        watched = self._watched.get(id(bus))
        if watched is None:
            return
        writes = _writes_1 if bus.side.name.startswith("Protocol 1") else _writes_2
        for packet in watched.parser.feed(data, bus.clock.now()):
            for servo_id, address, written in writes(packet):
                drive = watched.drives.get(servo_id)
                if drive is None:
                    continue
                goal = drive.servo.table["goal_position"]
                if address <= goal.address < address + len(written):
                    offset = goal.address - address
                    self.check(bus, drive, goal.decode(written[offset : offset + goal.size]))

    def check(self, bus: VirtualBus, drive: Any, goal: int) -> None:
        """Count one goal of one servo, ticks, and keep it if it is beyond the limits."""
        self.goals += 1
        first, last = drive.ticks_range
        if first <= goal <= last:
            return
        for servo in bus.servos:
            if servo.id != drive.id:
                continue
            present = _present_position(servo)
            if not min(first, present) <= goal <= max(last, present):
                self.forbidden.append(
                    f"{drive.name}: {goal}, range {first}..{last}, shaft at {present}"
                )


def _present_position(servo: Any) -> int:
    register = servo.table["present_position"]
    data = servo.read(register.address, register.size)
    # A Dynamixel servo also returns an error code.
    return int(register.decode(data[0] if isinstance(data, tuple) else data))


def _writes_1(packet: Any) -> Iterator[Write]:
    """Yield every write in a Protocol 1 packet."""
    params = packet.params
    if packet.instruction in (_WRITE, _REG_WRITE) and params:
        yield packet.id, params[0], params[1:]
    elif packet.instruction == _SYNC_WRITE and len(params) > 2:
        address, size = params[:2]
        for at in range(2, len(params), 1 + size):
            yield params[at], address, params[at + 1 : at + 1 + size]


def _writes_2(packet: Any) -> Iterator[Write]:
    """Yield every write in a Protocol 2 packet."""
    params = packet.params
    if not packet.valid:
        return
    if packet.instruction in (_WRITE, _REG_WRITE):
        yield packet.id, _word(params, 0), params[2:]
    elif packet.instruction == _SYNC_WRITE:
        address = _word(params, 0)
        size = _word(params, 2)
        for at in range(4, len(params), 1 + size):
            yield params[at], address, params[at + 1 : at + 1 + size]
    elif packet.instruction == _BULK_WRITE:
        at = 0
        while at < len(params):
            address = _word(params, at + 1)
            size = _word(params, at + 3)
            yield params[at], address, params[at + 5 : at + 5 + size]
            at += 5 + size


def _word(params: bytes, at: int) -> int:
    return int.from_bytes(params[at : at + 2], "little")


_recorder = GoalRecorder()
"""Recorder of the running test."""


def _tap_bus(module: Any) -> None:
    respond = module.VirtualBus.respond

    def tapped(self: VirtualBus, data: bytes, baud: int | None = None) -> object:
        with self.lock:
            _recorder.read_bytes(self, data)
            return respond(self, data, baud)

    module.VirtualBus.respond = tapped


def _tap_arm(module: Any) -> None:
    initialise = module.Arm.__init__

    def tapped(self: Any, config: ArmConfig, *arguments: object, **options: object) -> None:
        initialise(self, config, *arguments, **options)
        servos = getattr(self.bus, "virtual_bus", None)
        if servos is not None:
            _recorder.watch(servos, config)

    module.Arm.__init__ = tapped


_TAPS = {"robot_ik.hardware.virtual.bus": _tap_bus, "robot_ik.hardware.arm": _tap_arm}


class _Tapper(MetaPathFinder):
    """Taps the modules when they are imported. Most tests import neither."""

    def find_spec(self, name: str, _path: Any = None, _target: Any = None) -> Any:
        tap = _TAPS.pop(name, None)
        if tap is None:
            return None
        from importlib.util import find_spec  # only when a module is tapped

        spec = find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        run = spec.loader.exec_module

        def tapped(module: Any) -> None:
            run(module)
            if module.__name__ == name:  # pytest's rewriting loader serves all modules
                tap(module)

        spec.loader.exec_module = tapped  # type: ignore[method-assign]
        return spec


def pytest_configure() -> None:
    """Watch every arm of this process."""
    for name in [name for name in _TAPS if name in sys.modules]:
        _TAPS.pop(name)(sys.modules[name])
    sys.meta_path.insert(0, _Tapper())


@pytest.fixture(autouse=True)
def goal_recorder() -> Iterator[GoalRecorder]:
    """Fail the test if a goal beyond the limits was on the wire."""
    global _recorder
    _recorder = GoalRecorder()
    recorder = _recorder
    yield recorder
    assert not recorder.forbidden, recorder.forbidden[:5]
