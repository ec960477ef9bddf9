"""Protocol 1 on the host's side: packets, damage, and bytes equal to Feetech's SDK."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.hardware.arm_registers import shared_register
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.feetech_sts_table import STS3215
from robot_ik.hardware.protocol1 import Protocol1, Protocol1Parser, build
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.sts3215 import VirtualSts3215
from robot_ik.ports import VirtualClock

CONFIG = ArmConfig.load("so101")
IDS = CONFIG.servo_ids


@pytest.mark.parametrize("fault", ["corrupt", "truncate", "drop", "duplicate", "garbage", "late"])
def test_on_a_bad_wire_no_value_is_ever_wrong(fault):
    clock = VirtualClock()
    servos = [VirtualSts3215(i, clock, position_ticks=1000 + 100 * i) for i in IDS]
    virtual = VirtualBus(servos, clock, seed=3)
    bus = SimBus(virtual, CONFIG.family.protocol)
    bus.open()
    goal = shared_register(CONFIG, "goal_position")
    virtual.wire.chances[fault] = 0.05
    good = 0
    for _ in range(400):
        clock.sleep_until(clock.now() + 0.01)
        goals = {i: 1000 + 100 * i for i in IDS}
        for id, status in bus.exchange(
            goal, goals, dict.fromkeys(IDS, STS3215["present_position"])
        ).items():
            if status.data is not None:
                good += 1
                assert status.data == 1000 + 100 * id
    counters = bus.counters
    assert counters.answered + counters.refused + counters.timeouts == counters.asked
    assert good > 2000


@given(st.integers(0, 252), st.binary(max_size=40), st.binary(max_size=8), st.integers(1, 7))
@settings(max_examples=200)
def test_a_status_survives_noise_and_pieces(id, data, noise, piece):
    packet = bytearray(build(id, 0, data))
    stream = noise.replace(b"\xff", b"\x00") + bytes(packet)
    parser = Protocol1Parser(0)
    packets = []
    for at in range(0, len(stream), piece):
        packets += parser.feed(stream[at : at + piece])
    assert [(p.id, p.data) for p in packets] == [(id, data)]


@pytest.mark.parametrize(
    "stream",
    [
        "ff ff 03 04 00 fa" + "ff ff 04 04 00 01 00 f6",
        "ff ff 04 03 00 f9" + "ff ff 05 03 00 01 f6",
    ],
)
def test_a_broken_packet_is_not_completed_by_the_next_one(stream):
    """With the head of the next packet as its last bytes, the first one has a right checksum."""
    parser = Protocol1Parser(0)
    packets = parser.feed(bytes.fromhex(stream))
    assert [packet.data[0] for packet in packets] == [1]
    assert parser.damaged == 1


def test_a_checksum_of_ff_does_not_hide_the_next_packet():
    first = build(4, 0, b"\xf8\x00")
    assert first.endswith(b"\xff")
    packets = Protocol1Parser(0).feed(first + build(5, 0, b"\x01\x00"))
    assert [packet.id for packet in packets] == [4, 5]
    assert [packet.id for packet in Protocol1Parser(0).feed(first)] == [4]


@given(st.integers(-32767, 32767))
def test_sign_magnitude_round_trip(value):
    register = STS3215["goal_position"]
    assert register.decode(register.encode(value)) == value
    assert register.encode(-1) == b"\x01\x80"


def test_sync_requests_are_those_of_the_sdk():
    """Bytes that GroupSyncWrite and GroupSyncRead of feetech-servo-sdk 1.0.0 send."""
    protocol = Protocol1(STS3215["model_number"])
    write = protocol.sync_write(STS3215["goal_position"], {1: 2048, 2: 100})
    assert write == bytes.fromhex("ff ff fe 0a 83 2a 02 01 00 08 02 64 00 d9")
    registers = dict.fromkeys((1, 2), STS3215["present_position"])
    read = protocol.group_read(registers, ()).request
    assert read == bytes.fromhex("ff ff fe 06 82 38 02 01 02 3c")
