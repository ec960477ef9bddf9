"""Bytes of the control cycle against the SDK, the virtual servos, and under damage."""

from __future__ import annotations

import pytest
from dynamixel_sdk import COMM_SUCCESS, Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.packets import (
    FastParser,
    StatusParser,
    build,
    crc,
    read_request,
    write_request,
)
from robot_ik.hardware.virtual.protocol import build_fast_status, build_status

XM = X_TABLES["XM430-W350"]
XL = X_TABLES["XL330-M288"]
GOAL = XM["goal_position"]
PRESENT = XM["present_position"]
INDIRECT = (XM["indirect_data_1"], XL["indirect_data_1"])

ids = st.integers(0, 252)
positions = st.integers(-(2**31), 2**31 - 1)
goals = st.dictionaries(ids, positions, min_size=1, max_size=8)
# bytes that are full of headers and of what must be stuffed
nasty = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 0x01]), max_size=40).map(bytes)
data = st.one_of(st.binary(max_size=12), nasty.map(lambda b: b[:12]))


class Tap:
    """What the SDK takes for a port: keeps what is written, gives what is to be read."""

    is_using = False

    def __init__(self, incoming: bytes = b"") -> None:
        self.sent = b""
        self.incoming = incoming

    def clearPort(self) -> None: ...

    def setPacketTimeout(self, length: int) -> None: ...

    def isPacketTimeout(self) -> bool:
        return not self.incoming

    def writePort(self, packet: list[int]) -> int:
        self.sent += bytes(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:
        data = self.incoming[:length]
        self.incoming = self.incoming[length:]
        return data


SDK = Protocol2PacketHandler()


@given(goals)
def test_group_requests_are_those_of_the_sdk(values):
    body = [b for id, goal in values.items() for b in (id, *GOAL.encode(goal))]
    tap = Tap()
    SDK.syncWriteTxOnly(tap, GOAL.address, GOAL.size, body, len(body))
    assert write_request(GOAL, values) == tap.sent
    for fast in (False, True):
        tap = Tap()
        listed = list(values)
        SDK.syncReadTx(tap, PRESENT.address, PRESENT.size, listed, len(listed), fast)
        assert read_request(dict.fromkeys(values, PRESENT), fast=fast) == tap.sent


@given(goals)
def test_bulk_requests_are_those_of_the_sdk(values):
    registers = {id: INDIRECT[k % 2] for k, id in enumerate(values)}
    if len({r.address for r in registers.values()}) == 1:
        return  # one place: a sync request is shorter
    body = [
        b for id, r in registers.items() for b in (id, r.address & 255, r.address >> 8, r.size, 0)
    ]
    for fast in (False, True):
        tap = Tap()
        SDK.bulkReadTx(tap, body, len(body), fast)
        assert read_request(registers, fast=fast) == tap.sent


@pytest.mark.parametrize(
    "text", ["FFFFFD00FE090082840004000102CEFA", "FFFFFD00FE0D0092019000020002920001001A05"]
)
def test_examples_of_the_manual(text):
    packet = bytes.fromhex(text)
    assert build(packet[4], packet[7], packet[8:-2]) == packet
    assert crc(packet[:-2]) == int.from_bytes(packet[-2:], "little")


@given(ids, st.integers(0, 127), st.booleans(), data, nasty, st.integers(1, 7))
def test_a_status_is_found_between_noise_in_pieces_and_read_as_the_sdk_reads_it(
    id, code, alert, data, noise, step
):
    packet = build_status(id, code | 0x80 * alert, data)
    parser = StatusParser()
    found = []
    stream = noise.replace(b"\xff\xff\xfd\x00", b"") + packet
    for k in range(0, len(stream), step):
        found += parser.feed(stream[k : k + step])
    found += parser.feed(b"", last=True)
    assert [(a.id, a.code, a.alert, a.data) for a in found] == [(id, code, alert, data)]
    packet_of_sdk, result = SDK.rxPacket(Tap(packet), False)
    assert result == COMM_SUCCESS
    assert bytes(packet_of_sdk[9 : 9 + len(data)]) == data


@given(st.lists(st.tuples(ids, data), min_size=1, max_size=4), st.data())
def test_one_flipped_bit_never_gives_a_wrong_answer(rows, draw):
    stream = bytearray(b"".join(build_status(id, 0, data) for id, data in rows))
    bit = draw.draw(st.integers(0, 8 * len(stream) - 1))
    stream[bit // 8] ^= 1 << bit % 8
    parser = StatusParser()
    found = parser.feed(bytes(stream)) + parser.feed(b"", last=True)
    assert {(a.id, a.data) for a in found} <= set(rows)
    assert len(found) >= len(rows) - 1  # and no other packet is lost


@given(st.binary(max_size=200), st.integers(1, 50))
def test_any_bytes_are_survived(noise, step):
    fast = FastParser([(1, 4), (2, 4)])
    plain = StatusParser()
    for k in range(0, len(noise), step):
        fast.feed(noise[k : k + step])
        plain.feed(noise[k : k + step])
    assert plain.feed(b"", last=True) is not None and fast.feed(b"", last=True) is not None


fast_rows = st.lists(
    st.tuples(st.integers(0, 255), ids, st.binary(min_size=5, max_size=5)), min_size=1, max_size=6
)


@given(fast_rows, nasty, st.integers(1, 9))
def test_a_fast_status_gives_everyone_as_soon_as_he_is_there(rows, noise, step):
    packet = build_fast_status(rows, 8 + 9 * len(rows))
    stream = noise.replace(b"\xff\xff\xfd", b"") + packet
    parser = FastParser([(id, 5) for _, id, _ in rows])
    found = []
    for k in range(0, len(stream), step):
        found += parser.feed(stream[k : k + step])
    assert [(a.id, a.code, a.alert, a.data) for a in found] == [
        (id, error & 127, error > 127, data) for error, id, data in rows
    ]


@given(fast_rows, st.data())
def test_in_a_damaged_fast_status_only_what_comes_before_the_damage_is_believed(rows, draw):
    stream = bytearray(build_fast_status(rows, 8 + 9 * len(rows)))
    bit = draw.draw(st.integers(0, 8 * len(stream) - 1))
    stream[bit // 8] ^= 1 << bit % 8
    found = FastParser([(id, 5) for _, id, _ in rows]).feed(bytes(stream))
    good = max(0, (bit // 8 - 8) // 9)
    assert [(a.id, a.data) for a in found] == [(id, data) for _, id, data in rows[:good]]


def test_a_silent_servo_ends_a_fast_status_and_those_before_it_count():
    torso = build_fast_status([(0, 1, b"abcd"), (0, 2, b"efgh")], 8 + 8 * 3)
    assert [a.id for a in FastParser([(1, 4), (2, 4), (3, 4)]).feed(torso)] == [1, 2]


@pytest.mark.parametrize("more", [-1, 1, 256])
def test_a_fast_status_of_another_length_is_given_up_at_once(more):
    packet = bytearray(build_fast_status([(0, 1, b"abcd"), (0, 2, b"efgh")], 8 + 8 * 2))
    # as a servo that stuffs bytes, or a damaged bit, makes it
    length = (packet[5] | packet[6] << 8) + more
    packet[5:7] = length.to_bytes(2, "little")
    parser = FastParser([(1, 4), (2, 4)])
    assert not parser.feed(bytes(packet[:8])) and parser.damaged  # the rest is not waited for
