"""What holds for any bytes in any order: the codec, both parsers, the servos and the driver.

Each law takes the bytes of a fuzzer, reads them as a story of pieces on a wire (``pieces``) and asserts.  The
pieces are noise, but also packets with a right checksum, which chance alone would not find; what is a packet
and what is not is told by ``checked``, which is neither of the two parsers under test.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from robot_ik.errors import HardwareError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.bus import Counters
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import CONTROL_TABLES, OperatingMode
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.packets import FastParser, StatusParser
from robot_ik.hardware.packets import crc as host_crc
from robot_ik.hardware.scan import ScanBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.inprocess import InProcessPort, SimBus
from robot_ik.hardware.virtual.protocol2 import (
    HEADER,
    MAX_PACKET,
    Instruction,
    Parser,
    build,
    build_fast_status,
    build_status,
    crc16,
    stuff,
    unstuff,
)
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock

INPUTS = Path(__file__).with_name("inputs.txt")

PAUSE = 0.06
"""s; longer than a servo waits for the rest of a packet."""

TABLE = CONTROL_TABLES["XM430-W350"]
PRESENT, GOAL = TABLE["present_position"], TABLE["goal_position"]

HARMLESS = frozenset(
    Instruction[name]
    for name in ("PING", "READ", "SYNC_READ", "BULK_READ", "FAST_SYNC_READ", "FAST_BULK_READ", "STATUS")
)
"""Instructions after which a servo stands where it stood."""

TORSO = frozenset((Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ))
"""Instructions to which the answer breaks off at the first servo that is missing."""


def known_inputs() -> list[tuple[str, bytes]]:
    """(law, bytes) that once broke it: lines of ``inputs.txt``."""
    lines = INPUTS.read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    return [(name, bytes.fromhex(digits)) for name, digits in rows]


def made_up(dice: random.Random) -> bytes:
    """A story for ``pieces``: of all kinds and lengths, full of what headers and addresses are made of."""
    data = bytearray()
    for _ in range(dice.randint(1, 10)):
        size = dice.choice((0, 2, 3, 6, 7, 10, 20, 31))
        data.append(dice.randrange(8) | size << 3)
        data += bytes(
            dice.choice((*b"\x00\x01\x02\x03\xff\xfd\x55\x40\x74", dice.randrange(256))) for _ in range(size)
        )
    return bytes(data)


def pieces(data: bytes) -> list[bytes | None]:
    """Bytes of a fuzzer -> what comes over the wire, piece by piece; None is a pause.

    A piece is a byte (kind: low three bits; length: the rest) and so many bytes of content.
    """
    found: list[bytes | None] = []
    at = 0
    while at < len(data):
        kind, size = data[at] & 7, data[at] >> 3
        found.append(_piece(kind, data[at + 1 : at + 1 + size]))
        at += 1 + size
    return found


def _piece(kind: int, content: bytes) -> bytes | None:
    if kind == 7:
        return None
    if kind <= 1 or len(content) < 2:
        return content
    id, code, rest = content[0] % 5 if content[0] < 0xF0 else content[0], content[1], content[2:]
    instructions = list(Instruction)
    if kind == 2:
        return build(id, code, rest)
    if kind == 3:
        return build(id, instructions[code % len(instructions)], rest)
    if kind == 4:
        return build_status(id, code, rest)
    if kind == 5:
        rows = [(rest[k], k // 5 + 1, rest[k + 1 : k + 5].ljust(4, b"\0")) for k in range(0, len(rest), 5)]
        return build_fast_status(rows, 8 + 8 * code % 8)
    packet = bytearray(build_status(id, 0, rest) if code & 1 else build(id, Instruction.WRITE, rest))
    where = code >> 1
    if where & 1:
        return bytes(packet[: where % len(packet)])
    packet[where % len(packet)] ^= 1 << (where & 7)
    return bytes(packet)


def checked(stream: bytes) -> list[tuple[int, int, bytes]]:
    """(id, instruction, parameters) of every stretch of bytes that is a packet with a right checksum."""
    found, at = [], stream.find(HEADER)
    while at >= 0:
        size = 7 + int.from_bytes(stream[at + 5 : at + 7], "little")
        raw = stream[at : at + size]
        if 10 <= size <= len(raw) and host_crc(raw[:-2]) == int.from_bytes(raw[-2:], "little"):
            body = unstuff(raw[7:-2])
            found.append((raw[4], body[0], body[1:]))
        at = stream.find(HEADER, at + 1)
    return found


# ------------------------------------------------------------------------------ codec and parsers


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
    """Answers are real, the same in pieces and at once; none is lost that is there whole."""
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
    """A port on which answers are what the fuzzer says, a piece for every request."""

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
    """Every question ends: in an answer that was really given, or in an error of the hardware."""
    story, lines = iter(pieces(data)), []
    clock = VirtualClock()

    def line(name: str, baud: int, counters: Counters, answer_time: float) -> Line:
        lines.append(Line(story, name, baud, counters))
        return lines[-1]

    bus = ScanBus("fuzz", retries=1, make_handler=line, now=clock.now)
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
        assert in_fast_status or any(who == id and told[:size] == raw for who, told in real)


def _rows(statuses: Mapping[int, Any]) -> list[tuple[int, int, int]]:
    return [(s.id, 4, s.data) for s in statuses.values() if s.data is not None]


def _exchange(bus: DynamixelBus, fast: tuple[int, ...]) -> list[tuple[int, int, int]]:
    bus.use_fast_reads(fast)
    goals = dict.fromkeys((1, 2, 3), (GOAL, 7))
    return _rows(bus.exchange(goals, dict.fromkeys((1, 2, 3), PRESENT), 0.01))


QUESTIONS: tuple[Callable[[ScanBus], list[tuple[int, int, int]]], ...] = (
    lambda bus: [(1, 2, bus.ping(1))],
    lambda bus: _rows({2: bus.read(2, PRESENT)}),
    lambda bus: _rows({3: bus.write(3, GOAL, 5)}),
    lambda bus: _rows(bus.sync_read((1, 2, 3), PRESENT)),
    lambda bus: _exchange(bus, ()),
    lambda bus: _exchange(bus, (1, 2, 3)),
    lambda bus: [(id, 2, number) for id, number in bus.broadcast_ping().items()],
    lambda bus: [(id, 2, who[0]) for id, who in bus.shout(0.0)[0].items()],
)


# -------------------------------------------------------------------------------------------- arm


def _arm_config() -> ArmConfig:
    joints = (
        JointMap(f"joint{id}", id, "XM430-W350", OperatingMode.POSITION, 1, 2048, 1.0, -2.0, 2.0, 2.0, 8.0)
        for id in (1, 2)
    )
    return ArmConfig("fuzzed", "none", 1_000_000, 100.0, 200, "torque_off", tuple(joints), stale_ms=0)


def arm(data: bytes) -> None:
    """Damaged answers never move an arm: while it is told to stay, every goal is where it stands."""
    config, clock = _arm_config(), VirtualClock()
    bus = VirtualBus.from_config(config, clock)
    driven = Arm(config, SimBus(bus), clock, virtual_bus=bus, on_exit="torque_off")
    story = [piece for piece in pieces(data) if piece is not None]
    # A forged answer with a right checksum is a lie that no client can see: not what is asked here.
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
