"""Laws of the codec, the parsers, the servos and the driver for any input.

Each law takes the bytes of a fuzzer, converts them to pieces on a wire (``pieces``) and asserts.
Some pieces are noise. Others are packets with a correct checksum, which random bytes would hardly
ever have. The reference decoder ``checked`` finds the packets. It uses none of the parsers under
test.
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

# The folder is not a package, so the module is loaded from its file.
_spec = importlib.util.spec_from_file_location("fuzz_story", Path(__file__).with_name("story.py"))
assert _spec is not None and _spec.loader is not None
story: Any = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(story)
PAUSE = story.PAUSE
PRESENT = story.PRESENT
GOAL = story.GOAL
HARMLESS = story.HARMLESS
TRUNCATED = story.TRUNCATED
known_inputs = story.known_inputs
random_input = story.random_input
pieces = story.pieces
checked = story.checked


def codec(data: bytes) -> None:
    """Stuffed bytes contain no header and can be restored. Both checksum functions agree."""
    assert HEADER not in stuff(data)
    assert unstuff(stuff(data)) == data
    assert crc16(data) == host_crc(data)


def servo_parser(data: bytes) -> None:
    """The servo's parser finds only real packets, and the same in pieces and in single bytes.

    A packet after a pause is always found.
    """
    piecewise = Parser()
    bytewise = Parser()
    now = 0.0
    accepted = []
    stream = b""
    for piece in pieces(data):
        if piece is None:
            now += PAUSE
            continue
        packets = [packet for packet in piecewise.feed(piece, now) if packet.valid]
        singles = [packet for byte in piece for packet in bytewise.feed(bytes((byte,)), now)]
        assert packets == [packet for packet in singles if packet.valid]
        assert len(piecewise._buffer) < MAX_PACKET
        accepted += packets
        stream += piece
    real = checked(stream)
    for packet in accepted:
        assert (packet.id, packet.instruction, packet.params) in real
    (last,) = piecewise.feed(build(7, Instruction.PING), now + PAUSE)
    assert last.valid
    assert last.id == 7


def host_parser(data: bytes) -> None:
    """The host's parser finds only real replies, and the same in pieces and all at once."""
    parts = [piece for piece in pieces(data) if piece]
    stream = b"".join(parts)
    replies = _fed(StatusParser(), parts)
    assert replies == _fed(StatusParser(), [stream])

    real = [
        (id, parameters[:1], parameters[1:])
        for id, instruction, parameters in checked(stream)
        if instruction == Instruction.STATUS and parameters
    ]
    for reply in replies:
        error = bytes((reply.code | 0x80 * reply.alert,))
        assert (reply.id, error, reply.data) in real


def _fed(parser: StatusParser | FastParser, parts: list[bytes]) -> list[Any]:
    """Return the replies that a parser finds in successive parts of a stream."""
    replies = [reply for part in parts for reply in parser.feed(part)]
    return replies + parser.feed(b"", last=True)


def fast_parser(data: bytes) -> None:
    """The parser of fast replies finds only real replies, in the requested order of the servos.

    Each reply has a checksum over all replies before it. The result is the same in pieces and all
    at once.
    """
    parts = [piece for piece in pieces(data) if piece]
    stream = b"".join(parts)
    expected = [(1, 4), (2, 4), (3, 4)]
    replies = _fed(FastParser(expected), parts)
    assert replies == _fed(FastParser(expected), [stream])
    assert [reply.id for reply in replies] == [1, 2, 3][: len(replies)]
    if replies:
        rows = [(reply.code | 0x80 * reply.alert, reply.id, reply.data) for reply in replies]
        assert build_fast_status(rows, 8 + 8 * len(expected)) in stream


def servos(data: bytes) -> None:
    """Only complete packets move or change a servo. Servos answer every packet correctly.

    The values of all registers stay in their ranges.
    """
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
        may_be_truncated = any(kind in TRUNCATED for _, kind, _ in checked(stream))
        assert may_be_truncated or not parser.damaged
    clock.sleep_until(clock.now() + 1.0)
    bus.advance()

    instructions = {instruction for _, instruction, _ in checked(stream)}
    if instructions <= HARMLESS:
        for servo, (values, ticks) in zip(bus.servos, before, strict=True):
            assert servo.true_ticks == ticks
            for register in servo.table:
                if register.writable:
                    assert servo.memory.values[register.name] == values[register.name]
    for servo in bus.servos:
        for register in (r for r in servo.table if r.writable and r.name != "bus_watchdog"):
            assert register.minimum <= servo.memory.values[register.name] <= register.maximum


class Line(InProcessPort):
    """A port that answers every request with the next piece of the fuzzer.

    Args:
        parts: The pieces.
        name: Name of the port.
        baud: Baud rate, bit/s.
        counters: Counters of the bus.
    """

    def __init__(
        self, parts: Iterator[bytes | None], name: str, baud: int, counters: Counters
    ) -> None:
        self._parts = parts
        empty_bus = VirtualBus([], VirtualClock())
        super().__init__(empty_bus, name, baud, counters)
        self.received = b""

    def writePort(self, packet: Any) -> int:
        piece = next(self._parts, None) or b""
        self.received += piece
        self._buffer += piece
        return len(packet)


def driver(data: bytes) -> None:
    """Every request of the driver ends with a real reply or with a ``HardwareError``."""
    parts = iter(pieces(data))
    lines = []
    clock = VirtualClock()

    class LineBus(DynamixelBus):
        def _make_handler(self) -> Line:
            lines.append(Line(parts, self.port, self.baud, self.counters))
            return lines[-1]

    bus = LineBus("fuzz", retries=1, clock=clock)
    bus.open()
    answers: list[tuple[int, int, int]] = []
    for request in REQUESTS:
        try:
            answers += request(bus)
        except HardwareError:
            continue
    stream = lines[0].received
    real = {
        (id, bytes(parameters[1:5]))
        for id, instruction, parameters in checked(stream)
        if instruction == Instruction.STATUS
    }
    for id, size, value in answers:
        raw = value.to_bytes(size, "little", signed=size == 4)
        in_fast_status = bytes((id,)) + raw in stream
        in_status = any(sender == id and parameters[:size] == raw for sender, parameters in real)
        assert in_fast_status or in_status


def _answers(statuses: Mapping[int, Any]) -> list[tuple[int, int, int]]:
    """Return id, size in bytes and value of each reply with data."""
    return [(s.id, 4, s.data) for s in statuses.values() if s.data is not None]


def _exchange(bus: DynamixelBus, fast: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Exchange goals and positions. The servos in ``fast`` use fast reads."""
    bus.use_fast_reads(fast)
    goals = dict.fromkeys((1, 2, 3), 7)
    return _answers(bus.exchange(GOAL, goals, dict.fromkeys((1, 2, 3), PRESENT), 0.01))


REQUESTS: tuple[Callable[[DynamixelBus], list[tuple[int, int, int]]], ...] = (
    lambda bus: [(1, 2, bus.ping(1))],
    lambda bus: _answers({2: bus.read(2, PRESENT)}),
    lambda bus: _answers({3: bus.write(3, GOAL, 5)}),
    lambda bus: _answers(bus.sync_read((1, 2, 3), PRESENT)),
    lambda bus: _exchange(bus, ()),
    lambda bus: _exchange(bus, (1, 2, 3)),
    lambda bus: [(id, 2, number) for id, number in bus.broadcast_ping().items()],
    lambda bus: [
        (id, 2, pings[0]) for id, pings in bus.collect_pings(BROADCAST_ID, 0.0)[0].items()
    ],
)


def _arm_config() -> ArmConfig:
    """Return an arm with two joints, one servo each."""
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
    return ArmConfig(
        "fuzzed", "none", 1_000_000, 100.0, 200, "torque_off", tuple(joints), stale_ms=0
    )


def arm(data: bytes) -> None:
    """Damaged replies never move an arm that holds its position."""
    config = _arm_config()
    clock = VirtualClock()
    bus = VirtualBus.from_config(config, clock)
    driven = Arm(config, SimBus(bus), on_exit="torque_off")

    # No driver can detect a false reply with a correct checksum, so those pieces are left out.
    noise = iter(
        [
            piece
            for piece in pieces(data)
            if piece is not None
            and not any(kind == Instruction.STATUS for _, kind, _ in checked(piece))
        ]
    )
    before = [servo.true_ticks for servo in bus.servos]
    handle = bus.handle

    def damaged_reply(sent: bytes, baud: int | None = None) -> bytes:
        return next(noise, handle(sent, baud))

    try:
        with driven:
            driven.enable()
            bus.handle = damaged_reply  # type: ignore[method-assign]
            for k in range(12):
                now = 0.01 * (k + 1)
                clock.sleep_until(now)
                driven.send([0.0, 0.0], now)
            driven.hold()
    except HardwareError:
        pass
    clock.sleep_until(clock.now() + 1.0)
    assert [servo.true_ticks for servo in bus.servos] == before
    bus.handle = handle  # type: ignore[method-assign]
    assert not any(servo.torque for servo in bus.servos) or not driven.exit_report.ok


LAWS: Mapping[str, Callable[[bytes], None]] = MappingProxyType(
    {
        law.__name__: law
        for law in (codec, servo_parser, host_parser, fast_parser, servos, driver, arm)
    }
)
"""Every law by name."""
