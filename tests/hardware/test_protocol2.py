"""Replies to single requests, parsed by the Dynamixel SDK: in pieces, in noise and damaged."""

from __future__ import annotations

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.protocol2 import PROTOCOL_2
from robot_ik.hardware.virtual.protocol import build, build_status
from robot_ik.hardware.wire_protocol import StatusParser

XM = X_TABLES["XM430-W350"]
HEADER = b"\xff\xff\xfd\x00"

ids = st.integers(0, 252)
# Bytes that are full of headers and of bytes that must be stuffed.
headers = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 0x01]), max_size=40).map(bytes)
data = st.one_of(st.binary(max_size=12), headers.map(lambda b: b[:12]))


def feed(stream: bytes, step: int) -> tuple[StatusParser, list[tuple[int, int, bool, bytes]]]:
    """Feed a stream in pieces of ``step`` bytes, and say at its end that no more will come."""
    parser = PROTOCOL_2.parser(None, ())
    packets = []
    for begin in range(0, len(stream), step):
        packets += parser.feed(stream[begin : begin + step])
    packets += parser.feed(b"", last=True)
    return parser, [tuple(packet) for packet in packets]


@given(ids, st.integers(0, 127), st.booleans(), data, headers, st.integers(1, 7))
def test_a_status_is_found_between_noise_and_in_pieces(id, code, alert, data, noise, step):
    stream = noise.replace(HEADER, b"") + build_status(id, code | 0x80 * alert, data)
    _, packets = feed(stream, step)
    assert packets == [(id, code, alert, data)]


@given(st.lists(st.tuples(ids, data), min_size=1, max_size=4), st.integers(1, 9))
def test_every_status_of_a_stream_is_found(rows, step):
    parser, packets = feed(b"".join(build_status(id, 0, data) for id, data in rows), step)
    assert packets == [(id, 0, False, data) for id, data in rows]
    assert parser.damaged == 0


@given(st.lists(st.tuples(ids, data), min_size=1, max_size=4), st.data())
def test_a_flipped_bit_gives_no_wrong_status_and_costs_one(rows, draw):
    stream = bytearray(b"".join(build_status(id, 0, data) for id, data in rows))
    bit = draw.draw(st.integers(0, 8 * len(stream) - 1))
    stream[bit // 8] ^= 1 << bit % 8
    _, packets = feed(bytes(stream), len(stream))
    assert {(id, data) for id, _, _, data in packets} <= set(rows)
    assert len(packets) >= len(rows) - 1


def test_a_damaged_status_is_counted_and_the_next_one_is_found():
    damaged = bytearray(build_status(3, 0, b"\x01\x02"))
    damaged[-1] ^= 0xFF
    parser, packets = feed(bytes(damaged) + build_status(3, 0, b"\x01\x02"), 5)
    assert packets == [(3, 0, False, b"\x01\x02")]
    assert parser.damaged == 1


def test_a_head_without_its_packet_hides_no_status_behind_it():
    head = HEADER + bytes((7, 200, 0, 0x55))
    parser, packets = feed(head + build_status(3, 0, b"\x05"), 4)
    assert packets == [(3, 0, False, b"\x05")]
    assert parser.damaged == 1


def test_an_echo_of_the_request_is_no_status():
    request = PROTOCOL_2.read(3, XM["present_position"])
    _, packets = feed(request + build_status(3, 0, b"\x01\x02\x03\x04"), 3)
    assert packets == [(3, 0, False, b"\x01\x02\x03\x04")]


@given(st.binary(max_size=200), st.integers(1, 50))
def test_any_bytes_are_survived(noise, step):
    feed(noise, step)


@pytest.mark.parametrize("id", [0, 1, 252])
def test_requests_are_those_of_the_servos_own_codec(id):
    goal = XM["goal_position"]
    address = goal.address.to_bytes(2, "little")
    assert PROTOCOL_2.ping(id) == build(id, 0x01)
    assert PROTOCOL_2.reboot(id) == build(id, 0x08)
    assert PROTOCOL_2.read(id, goal) == build(id, 0x02, address + b"\x04\x00")
    value = int.from_bytes(b"\xff\xff\xfd\x00", "little")
    assert PROTOCOL_2.write(id, goal, value) == build(id, 0x03, address + b"\xff\xff\xfd\x00")


def test_virtual_servos_answer_without_the_sdk():
    code = (
        "import sys\n"
        "from robot_ik.hardware.config import ArmConfig\n"
        "from robot_ik.hardware.virtual.bus import VirtualBus\n"
        "from robot_ik.hardware.virtual.protocol import build\n"
        "from robot_ik.ports import VirtualClock\n"
        "bus = VirtualBus.from_config(ArmConfig.load('tabletop_puma'), VirtualClock())\n"
        "assert bus.handle(build(1, 1))\n"
        "print([name for name in ('serial', 'dynamixel_sdk') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
