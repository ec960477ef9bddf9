"""The virtual bus packet by packet: which servos answer which instruction, and how."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.protocol import Instruction, Packet, build, build_status, crc16
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock

I = Instruction  # noqa: E741


def _hex(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


def _word(value: int) -> bytes:
    return value.to_bytes(2, "little")


def _int(value: int) -> bytes:
    return value.to_bytes(4, "little", signed=True)


def test_ping_of_the_manual(clock: VirtualClock) -> None:
    servo = VirtualServo("XM430-W350", 1, clock)
    servo.memory.set("model_number", 1030)
    servo.memory.set("firmware_version", 38)
    reply = VirtualBus([servo], clock).handle(_hex("FFFFFD00 01 0300 01 194E"))
    assert reply == _hex("FFFFFD00 01 0700 55 00 0604 26 655D")


def test_sync_read_of_the_manual(clock: VirtualClock) -> None:
    servos = [
        VirtualServo("XM430-W350", id, clock, position_ticks=p) for id, p in ((1, 166), (2, 2079))
    ]
    reply = VirtualBus(servos, clock).handle(_hex("FFFFFD00 FE 0900 82 8400 0400 0102 CEFA"))
    assert reply == _hex(
        "FFFFFD00 01 0800 55 00 A6000000 8CC0 FFFFFD00 02 0800 55 00 1F080000 BABE"
    )


def test_broadcast_ping_is_answered_in_order_of_ids(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    assert [a.id for a in parse(bus.handle(build(254, I.PING)))] == [1, 2, 3]


@pytest.mark.parametrize(
    "packet",
    [
        build(254, I.READ, _word(132) + _word(4)),
        build(254, I.WRITE, _word(65) + b"\x01"),
        build(254, I.SYNC_WRITE, _word(65) + _word(1) + b"\x01\x01"),
        build(254, I.BULK_WRITE, b"\x01" + _word(65) + _word(1) + b"\x01"),
        build(254, I.ACTION),
        build(254, I.REBOOT),
        build(9, I.PING),
        build_status(1, 0),
        build(254, 0x77),
    ],
)
def test_requests_without_a_reply(bus: VirtualBus, packet: bytes) -> None:
    assert bus.handle(packet) == b""


def test_broadcast_write_reaches_all(bus: VirtualBus) -> None:
    bus.handle(build(254, I.WRITE, _word(65) + b"\x01"))
    assert [s.memory.values["led"] for s in bus.servos] == [1, 1, 1]


def test_sync_and_bulk_write_reach_those_named(bus: VirtualBus) -> None:
    bus.handle(
        build(254, I.SYNC_WRITE, _word(116) + _word(4) + b"\x01" + _int(150) + b"\x02" + _int(170))
    )
    bus.handle(
        build(
            254,
            I.BULK_WRITE,
            b"\x03" + _word(112) + _word(4) + _int(7) + b"\x01" + _word(65) + _word(1) + b"\x01",
        )
    )
    got = {
        s.id: (
            s.memory.values["goal_position"],
            s.memory.values["profile_velocity"],
            s.memory.values["led"],
        )
        for s in bus.servos
    }
    assert got == {1: (150, 0, 1), 2: (170, 0, 0), 3: (300, 7, 0)}


def test_a_sync_write_with_lengths_that_do_not_add_up_is_ignored(bus: VirtualBus) -> None:
    bus.handle(build(254, I.SYNC_WRITE, _word(116) + _word(4) + b"\x01" + _int(150) + b"\x02\x01"))
    assert bus.servo(1).memory.values["goal_position"] == 100


def test_bulk_read_may_ask_each_for_something_else(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    request = build(
        254, I.BULK_READ, b"\x02" + _word(132) + _word(4) + b"\x01" + _word(144) + _word(2)
    )
    assert [(a.id, a.data) for a in parse(bus.handle(request))] == [(2, _int(200)), (1, _word(120))]


def _split_fast(reply: bytes, sizes: list[int]) -> list[tuple[int, int, bytes]]:
    """Return (error, id, data) of each part after checking the checksum of each part."""
    assert reply[:5] == _hex("FFFFFD00FE") and reply[7] == I.STATUS
    parts = []
    at = 8
    for size in sizes:
        end = at + 2 + size
        assert crc16(reply[:end]) == int.from_bytes(reply[end : end + 2], "little")
        parts.append((reply[at], reply[at + 1], reply[at + 2 : end]))
        at = end + 2
    assert at == len(reply)
    return parts


def test_fast_sync_and_bulk_read(bus: VirtualBus) -> None:
    reply = bus.handle(build(254, I.FAST_SYNC_READ, _word(132) + _word(4) + bytes([3, 1])))
    assert _split_fast(reply, [4, 4]) == [(0, 3, _int(300)), (0, 1, _int(100))]
    assert int.from_bytes(reply[5:7], "little") == len(reply) - 7 == 8 + 2 * 8 - 7
    request = b"\x02" + _word(132) + _word(4) + b"\x01" + _word(146) + _word(1)
    reply = bus.handle(build(254, I.FAST_BULK_READ, request))
    assert _split_fast(reply, [4, 1]) == [(0, 2, _int(200)), (0, 1, b"\x20")]


def test_a_fast_read_ends_before_the_first_that_is_missing(bus: VirtualBus) -> None:
    request = build(254, I.FAST_SYNC_READ, _word(132) + _word(4) + bytes([1, 2, 3]))
    whole = bus.handle(request)
    bus.inject(Fault("silent", 2))
    assert bus.handle(request) == whole[:16]
    bus.inject(Fault("silent", 1))
    assert bus.handle(request) == b""


def test_a_sync_read_continues_behind_a_missing_servo(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    bus.inject(Fault("silent", 2))
    request = build(254, I.SYNC_READ, _word(132) + _word(4) + bytes([1, 2, 3]))
    assert [a.id for a in parse(bus.handle(request))] == [1, 3]


@pytest.mark.parametrize(
    "level,answered", [(0, [I.PING]), (1, [I.PING, I.READ]), (2, [I.PING, I.READ, I.WRITE])]
)
def test_status_return_level(bus: VirtualBus, level: int, answered: list[Instruction]) -> None:
    bus.servo(1).memory.set("status_return_level", level)
    params = {I.PING: b"", I.READ: _word(132) + _word(4), I.WRITE: _word(65) + b"\x01"}
    assert [i for i in params if bus.handle(build(1, i, params[i]))] == answered
    fast = [build(254, i, _word(132) + _word(4) + b"\x01") for i in (I.SYNC_READ, I.FAST_SYNC_READ)]
    assert all(bool(bus.handle(f)) == (level > 0) for f in fast)
    assert bus.servo(1).memory.values["led"] == 1  # obeyed, answered or not


def test_unknown_instruction_and_bad_checksum_are_answered_with_their_error(
    bus: VirtualBus,
) -> None:
    assert bus.handle(build(1, 0x77)) == build_status(1, 2)
    spoiled = bytearray(build(1, I.WRITE, _word(65) + b"\x01"))
    spoiled[-3] = 0
    assert bus.handle(bytes(spoiled)) == build_status(1, 3)
    assert bus.servo(1).memory.values["led"] == 0
    assert bus.handle(build(1, I.ACTION)) == build_status(1, 2)


def test_reg_write_and_action(bus: VirtualBus) -> None:
    params = _word(65) + b"\x01"
    assert bus.handle(build(1, I.REG_WRITE, params)) == build_status(1, 0)
    assert bus.servo(1).memory.values["registered_instruction"] == 1
    assert bus.servo(1).memory.values["led"] == 0
    bus.handle(build(254, I.ACTION))
    assert (
        bus.servo(1).memory.values["led"],
        bus.servo(1).memory.values["registered_instruction"],
    ) == (1, 0)


def test_a_broadcast_factory_reset_of_everything_is_ignored(bus: VirtualBus) -> None:
    bus.handle(build(254, I.FACTORY_RESET, b"\xff"))
    assert sorted(s.id for s in bus.servos) == [1, 2, 3]
    assert bus.handle(build(3, I.FACTORY_RESET, b"\xff")) == build_status(3, 0)
    assert sorted(s.id for s in bus.servos) == [1, 1, 2]


def test_a_new_id_is_answered_under_the_old_and_heard_under_the_new(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    assert bus.handle(build(1, I.WRITE, _word(7) + b"\x09")) == build_status(1, 0)
    assert bus.handle(build(1, I.PING)) == b""
    assert parse(bus.handle(build(9, I.PING)))[0].id == 9


def test_a_servo_that_is_set_to_another_protocol_is_not_heard_any_more(bus: VirtualBus) -> None:
    assert bus.handle(build(1, I.WRITE, _word(13) + b"\x01")) == build_status(1, 0)
    assert bus.handle(build(1, I.PING)) == b""
    assert bus.handle(build(2, I.PING)) != b""


def test_a_330_has_no_protocol_1_and_those_of_remote_controls_only_with_their_signal(
    clock: VirtualClock,
) -> None:
    bus = VirtualBus([VirtualServo("XL330-M288", 1, clock)], clock)
    for value, error in ((1, 4), (3, 4), (19, 4), (20, 0), (22, 0), (23, 4)):
        assert bus.handle(build(1, I.WRITE, _word(13) + bytes([value]))) == build_status(1, error)


def test_a_secondary_id_is_obeyed_in_silence(bus: VirtualBus) -> None:
    bus.servo(1).memory.set("secondary_id", 50)
    assert bus.handle(build(50, I.WRITE, _word(65) + b"\x01")) == b""
    assert bus.servo(1).memory.values["led"] == 1


def test_a_secondary_id_changes_no_eeprom(bus: VirtualBus) -> None:
    """ROBOTIS-GIT/emanual _includes/en/dxl/x/shadow_id.md."""
    servo = bus.servo(1)
    servo.memory.set("secondary_id", 2)
    new_id = _word(7) + b"\x09"
    delay = _word(9)
    assert bus.handle(build(2, I.WRITE, new_id)) == build_status(2, 0)
    bus.handle(build(254, I.SYNC_WRITE, delay + _word(1) + b"\x02\x00" + b"\x09\x00"))
    assert (servo.id, servo.memory.values["return_delay_time"]) == (1, 250)
    bus.handle(build(2, I.FACTORY_RESET, b"\x01"))
    bus.handle(build(2, I.REG_WRITE, new_id))
    bus.handle(build(254, I.ACTION))
    assert (servo.id, servo.memory.values["secondary_id"]) == (1, 2)


@pytest.mark.parametrize("secondary", [1, 253, 254, 255])
def test_a_secondary_id_that_is_none(bus: VirtualBus, secondary: int) -> None:
    bus.servo(1).memory.set("secondary_id", secondary)
    params = _word(9) + _word(1) + b"\x01\x07" + bytes([secondary]) + b"\x08"
    bus.handle(build(254, I.SYNC_WRITE, params if secondary != 1 else params[:-2]))
    assert bus.servo(1).memory.values["return_delay_time"] == 7


def test_servos_with_one_id_talk_over_each_other(
    clock: VirtualClock, parse: Callable[[bytes], list[Packet]]
) -> None:
    servos = [VirtualServo("XM430-W350", 1, clock, position_ticks=p) for p in (1111, 2222)]
    reply = VirtualBus(servos, clock).handle(build(1, I.READ, _word(132) + _word(4)))
    assert reply and not [a for a in parse(reply) if a.valid]
