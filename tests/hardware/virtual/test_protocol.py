"""The codec against the manual's example packets, against the official SDK's checksum and against
noise.
"""

from __future__ import annotations

import pytest
from dynamixel_sdk import PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.hardware.virtual.protocol import (
    ALERT,
    HEADER,
    PACKET_GAP,
    Instruction,
    Packet,
    Parser,
    build,
    build_status,
    crc16,
    stuff,
    unstuff,
)

I = Instruction  # noqa: E741


def _hex(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


# Example packets of the e-manual's Protocol 2.0 page, and the (id, instruction, parameters) or (id,
# error, data) they are made of.
INSTRUCTIONS = {
    "ping": ((1, I.PING, ""), "FFFFFD00 01 0300 01 194E"),
    "broadcast ping": ((254, I.PING, ""), "FFFFFD00 FE 0300 01 3142"),
    "read": ((1, I.READ, "8400 0400"), "FFFFFD00 01 0700 02 8400 0400 1D15"),
    "write": ((1, I.WRITE, "7400 00020000"), "FFFFFD00 01 0900 03 7400 00020000 CA89"),
    "reg write": ((1, I.REG_WRITE, "6800 C8000000"), "FFFFFD00 01 0900 04 6800 C8000000 AE8E"),
    "action": ((1, I.ACTION, ""), "FFFFFD00 01 0300 05 02CE"),
    "factory reset": ((1, I.FACTORY_RESET, "01"), "FFFFFD00 01 0400 06 01 A1E6"),
    "reboot": ((1, I.REBOOT, ""), "FFFFFD00 01 0300 08 2F4E"),
    "clear": ((1, I.CLEAR, "0144584C22"), "FFFFFD00 01 0800 10 0144584C22 B1DC"),
    "sync read": ((254, I.SYNC_READ, "8400 0400 0102"), "FFFFFD00 FE 0900 82 8400 0400 0102 CEFA"),
    "sync write": (
        (254, I.SYNC_WRITE, "7400 0400 01 96000000 02 AA000000"),
        "FFFFFD00 FE 1100 83 7400 0400 01 96000000 02 AA000000 8287",
    ),
    "bulk read": (
        (254, I.BULK_READ, "01 9000 0200 02 9200 0100"),
        "FFFFFD00 FE 0D00 92 01 9000 0200 02 9200 0100 1A05",
    ),
    "bulk write": (
        (254, I.BULK_WRITE, "01 2000 0200 A000 02 1F00 0100 50"),
        "FFFFFD00 FE 1000 93 01 2000 0200 A000 02 1F00 0100 50 B768",
    ),
}
STATUSES = {
    "ping": ((1, 0, "0604 26"), "FFFFFD00 01 0700 55 00 0604 26 655D"),
    "position 166": ((1, 0, "A6000000"), "FFFFFD00 01 0800 55 00 A6000000 8CC0"),
    "empty": ((1, 0, ""), "FFFFFD00 01 0400 55 00 A10C"),
    "position 2079": ((2, 0, "1F080000"), "FFFFFD00 02 0800 55 00 1F080000 BABE"),
}


@pytest.mark.parametrize("name", INSTRUCTIONS)
def test_instruction_examples_of_the_manual(name: str) -> None:
    (id, instruction, params), expected = INSTRUCTIONS[name]
    assert build(id, instruction, _hex(params)) == _hex(expected)
    assert Parser().feed(_hex(expected), 0.0) == [Packet(id, instruction, _hex(params))]


@pytest.mark.parametrize("name", STATUSES)
def test_status_examples_of_the_manual(name: str) -> None:
    (id, error, data), expected = STATUSES[name]
    assert build_status(id, error, _hex(data)) == _hex(expected)
    (packet,) = Parser().feed(_hex(expected), 0.0)
    assert (packet.id, packet.params[0] & ~ALERT, packet.data, packet.is_status) == (
        id,
        error,
        _hex(data),
        True,
    )


@given(st.binary(max_size=200))
def test_checksum_is_the_official_sdk_s(data: bytes) -> None:
    official = PacketHandler(2.0).updateCRC(0, list(data), len(data))
    assert crc16(data) == official


# Bytes in which the pattern that needs stuffing is frequent.
PIECES = (b"\xff", b"\xff\xff", b"\xfd", b"\xff\xff\xfd", b"\x00", b"\x55")
BODIES = st.lists(st.sampled_from(PIECES)).map(b"".join)


@given(BODIES | st.binary(max_size=60))
def test_stuffing_is_undone_and_leaves_no_header(data: bytes) -> None:
    stuffed = stuff(data)
    assert unstuff(stuffed) == data
    assert HEADER not in stuffed


@given(st.integers(0, 252), BODIES | st.binary(max_size=60))
def test_what_is_built_is_parsed_back(id: int, data: bytes) -> None:
    assert Parser().feed(build(id, I.WRITE, data), 0.0) == [Packet(id, I.WRITE, data)]
    (status,) = Parser().feed(build_status(id, 0x85, data), 0.0)
    assert (status.id, status.params[0], status.data) == (id, 5 | ALERT, data)


@given(st.lists(st.tuples(st.integers(0, 252), BODIES), max_size=5), st.data())
def test_pieces_of_any_size_give_the_same_packets(
    packets: list[tuple[int, bytes]], data: st.DataObject
) -> None:
    stream = b"".join(build(id, I.WRITE, body) for id, body in packets)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    parser = Parser()
    found = []
    for first, last in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += parser.feed(stream[first:last], 0.0)
    assert [(p.id, p.params) for p in found] == packets


@given(st.binary(max_size=40).filter(lambda b: HEADER not in b))
def test_a_packet_is_found_behind_garbage(garbage: bytes) -> None:
    good = build(7, I.PING)
    parser = Parser()
    assert parser.feed(garbage, 0.0) == []
    assert parser.feed(good, 0.0) == [Packet(7, I.PING, b"")]


@given(BODIES.filter(lambda b: len(b) > 0), st.data())
def test_a_flipped_bit_is_never_a_valid_packet(body: bytes, data: st.DataObject) -> None:
    raw = bytearray(build(3, I.WRITE, body))
    bit = data.draw(st.integers(0, 8 * len(raw) - 1))
    raw[bit // 8] ^= 1 << bit % 8
    assert not [p for p in Parser().feed(bytes(raw), 0.0) if p.valid]


@given(st.integers(1, 13))
def test_a_truncated_packet_does_not_swallow_the_next(kept: int) -> None:
    torso = build(1, I.READ, b"\x84\x00\x04\x00")[:kept]
    found = Parser().feed(torso + build(2, I.PING), 0.0)
    assert [p for p in found if p.valid] == [Packet(2, I.PING, b"")]


def test_the_torso_of_a_long_packet_does_not_keep_the_next_one_waiting() -> None:
    torso = build(1, I.WRITE, bytes(200))[:60]
    assert Parser().feed(torso + build(2, I.PING), 0.0) == [Packet(2, I.PING, b"")]


def test_a_checksum_that_looks_like_a_header_is_read_through() -> None:
    # FF FF at the end of the data and a checksum FD 00 make a header where none is.
    data = next(
        d + b"\xff\xff"
        for d in (n.to_bytes(3, "little") for n in range(1 << 24))
        if build(1, I.WRITE, d + b"\xff\xff").endswith(b"\xff\xff\xfd\x00")
    )
    raw = build(1, I.WRITE, data)
    parser = Parser()
    found = [p for byte in raw for p in parser.feed(bytes([byte]), 0.0)]
    assert found == [Packet(1, I.WRITE, data)]


def test_a_partial_packet_is_dropped_after_a_gap() -> None:
    raw = build(1, I.READ, b"\x84\x00\x04\x00")
    late = Parser()
    soon = Parser()
    assert late.feed(raw[:-1], 0.0) == soon.feed(raw[:-1], 0.0) == []
    assert late.feed(raw[-1:], 1.1 * PACKET_GAP) == []
    assert len(soon.feed(raw[-1:], 0.9 * PACKET_GAP)) == 1
