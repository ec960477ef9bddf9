"""What holds for any bytes in any order: the codec, both parsers, the servos and the driver.

Each law takes the bytes of a fuzzer, reads them as a story of pieces on a wire (``pieces``) and asserts.  The
pieces are noise, but also packets with a right checksum, which chance alone would not find; what is a packet
and what is not is reported by ``checked``, which is neither of the two parsers under test.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from robot_ik.errors import HardwareError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.bus import BROADCAST_ID, Counters
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.packets import FastParser, StatusParser
from robot_ik.hardware.packets import crc as host_crc
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct, Joint, Servo
from robot_ik.hardware.simulated import InProcessPort, SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import (
    HEADER,
    MAX_PACKET,
    Instruction,
    Parser,
    build,
    build_fast_status,
    crc16,
    stuff,
    unstuff,
)
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock

# It lies beside this file; the folder is nobody's package.
_spec = importlib.util.spec_from_file_location("fuzz_story", Path(__file__).with_name("story.py"))
assert _spec is not None and _spec.loader is not None
story: Any = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(story)
PAUSE, PRESENT, GOAL, HARMLESS, TORSO, known_inputs, random_input, pieces, checked = (
    story.PAUSE,
    story.PRESENT,
    story.GOAL,
    story.HARMLESS,
    story.TORSO,
    story.known_inputs,
    story.random_input,
    story.pieces,
    story.checked,
)


def codec(data: bytes) -> None:
    """What is stuffed has no header in it and comes back; both sides' checksums agree."""
    assert HEADER not in stuff(data) and unstuff(stuff(data)) == data
    assert crc16(data) == host_crc(data)


def servo_parser(data: bytes) -> None:
    """Pieces or single bytes: the same good packets, all of them real; what follows a pause is heard."""
    whole, bytewise, now = Parser(), Parser(), 0.0
    found, stream = [], b""
    for piece in pieces(data):
        if piece is None:
            now += PAUSE
            continue
        packets = [packet for packet in whole.feed(piece, now) if packet.valid]
        singles = [packet for byte in piece for packet in bytewise.feed(bytes((byte,)), now)]
        assert packets == [packet for packet in singles if packet.valid]
        assert len(whole._buffer) < MAX_PACKET
        found += packets
        stream += piece
    real = checked(stream)
    for packet in found:
        assert (packet.id, packet.instruction, packet.params) in real
    (last,) = whole.feed(build(7, Instruction.PING), now + PAUSE)
    assert last.valid and last.id == 7


def host_parser(data: bytes) -> None:
    """Replies are real, the same in pieces and at once; none is lost that is there whole."""
    story = [piece for piece in pieces(data) if piece]
    stream = b"".join(story)
    parser, at_once = StatusParser(), StatusParser()
    found = [answer for piece in story for answer in parser.feed(piece)] + parser.feed(b"", last=True)
    assert found == at_once.feed(stream) + at_once.feed(b"", last=True)
    real = [(id, p[:1], p[1:]) for id, kind, p in checked(stream) if kind == Instruction.STATUS and p]
    for answer in found:
        error = bytes((answer.code | 0x80 * answer.alert,))
        assert (answer.id, error, answer.data) in real


def fast_parser(data: bytes) -> None:
    """Servos in the order asked, each with a checksum over all before it; the same in pieces."""
    story = [piece for piece in pieces(data) if piece]
    stream = b"".join(story)
    expected = [(1, 4), (2, 4), (3, 4)]
    parser, at_once = FastParser(expected), FastParser(expected)
    found = [answer for piece in story for answer in parser.feed(piece)] + parser.feed(b"", last=True)
    assert found == at_once.feed(stream) + at_once.feed(b"", last=True)
    assert [answer.id for answer in found] == [1, 2, 3][: len(found)]
    if found:
        rows = [(a.code | 0x80 * a.alert, a.id, a.data) for a in found]
        assert build_fast_status(rows, 8 + 8 * len(expected)) in stream


# ----------------------------------------------------------------------------------------- servos


def servos(data: bytes) -> None:
    """Nothing moves or is written but by a whole packet; any packet is survived and answered rightly."""
    clock = VirtualClock()
    bus = VirtualBus(
        [
            VirtualServo("XM430-W350", 1, clock),
            VirtualServo("XL330-M288", 2, clock, mode=OperatingMode.CURRENT_BASED_POSITION),
            VirtualServo("XL430-W250", 3, clock, mode=OperatingMode.VELOCITY),
        ],
        clock,
    )
    for servo in bus.servos[:2]:
        assert not servo.write(64, b"\x01")
    before = [(dict(servo.memory.values), servo.true_ticks) for servo in bus.servos]
    stream = b""
    for piece in pieces(data):
        if piece is None:
            clock.sleep_until(clock.now() + PAUSE)
            continue
        stream += piece
        parser = StatusParser()
        parser.feed(bus.handle(piece))
        parser.feed(b"", last=True)
        fast = any(instruction in TORSO for _, instruction, _ in checked(stream))
        assert fast or not parser.damaged
    clock.sleep_until(clock.now() + 1.0)
    bus.advance()
    said = {instruction for _, instruction, _ in checked(stream)}
    if said <= HARMLESS:
        for servo, (values, ticks) in zip(bus.servos, before, strict=True):
            assert servo.true_ticks == ticks
            assert all(servo.memory.values[r.name] == values[r.name] for r in servo.table if r.writable)
    for servo in bus.servos:
        for register in (r for r in servo.table if r.writable and r.name != "bus_watchdog"):
            assert register.minimum <= servo.memory.values[register.name] <= register.maximum


# ----------------------------------------------------------------------------------------- driver


class Line(InProcessPort):
    """A port on which replies are what the fuzzer says, a piece for every request."""

    def __init__(self, story: Iterator[bytes | None], name: str, baud: int, counters: Counters) -> None:
        self._story = story
        super().__init__(_nobody(), name, baud, counters)
        self.said = b""

    def writePort(self, packet: Any) -> int:
        piece = next(self._story, None) or b""
        self.said += piece
        self._buffer += piece
        return len(packet)


def _nobody() -> VirtualBus:
    return VirtualBus([], VirtualClock())


def driver(data: bytes) -> None:
    """Every question ends: in a reply that was really given, or in an error of the hardware."""
    story, lines = iter(pieces(data)), []
    clock = VirtualClock()

    class LineBus(DynamixelBus):
        def _make_handler(self) -> Line:
            lines.append(Line(story, self.port, self.baud, self.counters))
            return lines[-1]

    bus = LineBus("fuzz", retries=1, clock=clock)
    bus.open()
    answers: list[tuple[int, int, int]] = []
    for ask in QUESTIONS:
        try:
            answers += ask(bus)
        except HardwareError:
            continue
    stream = lines[0].said
    real = {(id, bytes(p[1:5])) for id, kind, p in checked(stream) if kind == Instruction.STATUS}
    for id, size, value in answers:
        raw = value.to_bytes(size, "little", signed=size == 4)
        in_fast_status = bytes((id,)) + raw in stream
        assert in_fast_status or any(who == id and reported[:size] == raw for who, reported in real)


def _rows(statuses: Mapping[int, Any]) -> list[tuple[int, int, int]]:
    return [(s.id, 4, s.data) for s in statuses.values() if s.data is not None]


def _exchange(bus: DynamixelBus, fast: tuple[int, ...]) -> list[tuple[int, int, int]]:
    bus.use_fast_reads(fast)
    goals = dict.fromkeys((1, 2, 3), 7)
    return _rows(bus.exchange(GOAL, goals, dict.fromkeys((1, 2, 3), PRESENT), 0.01))


QUESTIONS: tuple[Callable[[DynamixelBus], list[tuple[int, int, int]]], ...] = (
    lambda bus: [(1, 2, bus.ping(1))],
    lambda bus: _rows({2: bus.read(2, PRESENT)}),
    lambda bus: _rows({3: bus.write(3, GOAL, 5)}),
    lambda bus: _rows(bus.sync_read((1, 2, 3), PRESENT)),
    lambda bus: _exchange(bus, ()),
    lambda bus: _exchange(bus, (1, 2, 3)),
    lambda bus: [(id, 2, number) for id, number in bus.broadcast_ping().items()],
    lambda bus: [(id, 2, who[0]) for id, who in bus.collect_pings(BROADCAST_ID, 0.0)[0].items()],
)


# -------------------------------------------------------------------------------------------- arm


def _arm_config() -> ArmConfig:
    joints = (
        Joint(
            f"joint{id}",
            Direct(),
            (Servo(id, "XM430-W350", OperatingMode.POSITION),),
            lower=-2.0,
            upper=2.0,
            velocity=2.0,
            acceleration=8.0,
        )
        for id in (1, 2)
    )
    return ArmConfig("fuzzed", "none", 1_000_000, 100.0, 200, "torque_off", tuple(joints), stale_ms=0)


def arm(data: bytes) -> None:
    """Damaged replies never move an arm: while it is asked to stay, every goal is where it stands."""
    config, clock = _arm_config(), VirtualClock()
    bus = VirtualBus.from_config(config, clock)
    driven = Arm(config, SimBus(bus), on_exit="torque_off")
    story = [piece for piece in pieces(data) if piece is not None]
    # A forged reply with a right checksum is a lie that no client can see: not what is asked here.
    noise = iter([p for p in story if not any(kind == Instruction.STATUS for _, kind, _ in checked(p))])
    before = [servo.true_ticks for servo in bus.servos]
    answer = bus.handle
    try:
        with driven:
            driven.enable()
            bus.handle = lambda sent, baud=None: _damaged(answer(sent, baud), noise)  # type: ignore[method-assign]
            for k in range(12):
                now = 0.01 * (k + 1)
                clock.sleep_until(now)
                driven.send([0.0, 0.0], now)
            driven.hold()
    except HardwareError:
        pass
    clock.sleep_until(clock.now() + 1.0)
    assert [servo.true_ticks for servo in bus.servos] == before
    bus.handle = answer  # type: ignore[method-assign]
    assert not any(s.torque for s in bus.servos) or not driven.exit_report.ok


def _damaged(true: bytes, noise: Iterator[bytes]) -> bytes:
    return next(noise, true)


LAWS: Mapping[str, Callable[[bytes], None]] = MappingProxyType(
    {law.__name__: law for law in (codec, servo_parser, host_parser, fast_parser, servos, driver, arm)}
)
"""Every law by name."""
