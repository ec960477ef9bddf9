"""The virtual bus packet by packet, its faults, and the in-process bus on top of it."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.errors import (
    BusCorruptError,
    BusNotOpenError,
    BusTimeoutError,
    ConfigError,
    ServoRefusedError,
    UnknownJointError,
)
from robot_ik.hardware.bus import BROADCAST_ID, ServoBus, Status
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import CONTROL_TABLES
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Faults
from robot_ik.hardware.virtual.inprocess import SimBus
from robot_ik.hardware.virtual.protocol2 import Instruction, Packet, Parser, build, build_status, crc16
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock

I = Instruction  # noqa: E741
TABLE = CONTROL_TABLES["XM430-W350"]
PRESENT, GOAL, TORQUE = TABLE["present_position"], TABLE["goal_position"], TABLE["torque_enable"]


def _hex(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


def _word(value: int) -> bytes:
    return value.to_bytes(2, "little")


def _int(value: int) -> bytes:
    return value.to_bytes(4, "little", signed=True)


def _answers(reply: bytes) -> list[Packet]:
    return Parser().feed(reply, 0.0)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def bus(clock: VirtualClock) -> VirtualBus:
    """Ids 1..3 at 100, 200, 300 ticks; ids are not in order on the wire."""
    return VirtualBus(
        [VirtualServo("XM430-W350", id, clock, position_ticks=100 * id) for id in (3, 1, 2)], clock
    )


@pytest.fixture
def arm_bus(arm_config: ArmConfig, clock: VirtualClock) -> VirtualBus:
    return VirtualBus.from_config(arm_config, clock)


@pytest.fixture
def sim(arm_bus: VirtualBus) -> SimBus:
    sim = SimBus(arm_bus)
    sim.open()
    return sim


def test_ping_of_the_manual(clock: VirtualClock) -> None:
    servo = VirtualServo("XM430-W350", 1, clock)
    servo.memory.set("model_number", 1030)
    servo.memory.set("firmware_version", 38)
    reply = VirtualBus([servo], clock).handle(_hex("FFFFFD00 01 0300 01 194E"))
    assert reply == _hex("FFFFFD00 01 0700 55 00 0604 26 655D")


def test_sync_read_of_the_manual(clock: VirtualClock) -> None:
    servos = [VirtualServo("XM430-W350", id, clock, position_ticks=p) for id, p in ((1, 166), (2, 2079))]
    reply = VirtualBus(servos, clock).handle(_hex("FFFFFD00 FE 0900 82 8400 0400 0102 CEFA"))
    assert reply == _hex("FFFFFD00 01 0800 55 00 A6000000 8CC0 FFFFFD00 02 0800 55 00 1F080000 BABE")


def test_broadcast_ping_is_answered_in_order_of_ids(bus: VirtualBus) -> None:
    assert [a.id for a in _answers(bus.handle(build(254, I.PING)))] == [1, 2, 3]


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
def test_nobody_answers(bus: VirtualBus, packet: bytes) -> None:
    assert bus.handle(packet) == b""


def test_broadcast_write_reaches_all(bus: VirtualBus) -> None:
    bus.handle(build(254, I.WRITE, _word(65) + b"\x01"))
    assert [s.memory.get("led") for s in bus.servos] == [1, 1, 1]


def test_sync_and_bulk_write_reach_those_named(bus: VirtualBus) -> None:
    bus.handle(build(254, I.SYNC_WRITE, _word(116) + _word(4) + b"\x01" + _int(150) + b"\x02" + _int(170)))
    bus.handle(
        build(
            254,
            I.BULK_WRITE,
            b"\x03" + _word(112) + _word(4) + _int(7) + b"\x01" + _word(65) + _word(1) + b"\x01",
        )
    )
    got = {
        s.id: (s.memory.get("goal_position"), s.memory.get("profile_velocity"), s.memory.get("led"))
        for s in bus.servos
    }
    assert got == {1: (150, 0, 1), 2: (170, 0, 0), 3: (300, 7, 0)}


def test_a_sync_write_with_lengths_that_do_not_add_up_is_ignored(bus: VirtualBus) -> None:
    bus.handle(build(254, I.SYNC_WRITE, _word(116) + _word(4) + b"\x01" + _int(150) + b"\x02\x01"))
    assert bus.servo(1).memory.get("goal_position") == 100


def test_bulk_read_may_ask_each_for_something_else(bus: VirtualBus) -> None:
    request = build(254, I.BULK_READ, b"\x02" + _word(132) + _word(4) + b"\x01" + _word(144) + _word(2))
    assert [(a.id, a.data) for a in _answers(bus.handle(request))] == [(2, _int(200)), (1, _word(120))]


def _split_fast(reply: bytes, sizes: list[int]) -> list[tuple[int, int, bytes]]:
    """(error, id, data) of each part, every part's own checksum checked over all bytes before it."""
    assert reply[:5] == _hex("FFFFFD00FE") and reply[7] == I.STATUS
    parts, at = [], 8
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
    bus.set_faults(Faults(silent=frozenset({2})))
    assert bus.handle(request) == whole[:16]
    bus.set_faults(Faults(silent=frozenset({1})))
    assert bus.handle(request) == b""


def test_a_sync_read_goes_on_behind_the_missing(bus: VirtualBus) -> None:
    bus.set_faults(Faults(silent=frozenset({2})))
    request = build(254, I.SYNC_READ, _word(132) + _word(4) + bytes([1, 2, 3]))
    assert [a.id for a in _answers(bus.handle(request))] == [1, 3]


@pytest.mark.parametrize(
    "level,answered", [(0, [I.PING]), (1, [I.PING, I.READ]), (2, [I.PING, I.READ, I.WRITE])]
)
def test_status_return_level(bus: VirtualBus, level: int, answered: list[Instruction]) -> None:
    bus.servo(1).memory.set("status_return_level", level)
    params = {I.PING: b"", I.READ: _word(132) + _word(4), I.WRITE: _word(65) + b"\x01"}
    assert [i for i in params if bus.handle(build(1, i, params[i]))] == answered
    fast = [build(254, i, _word(132) + _word(4) + b"\x01") for i in (I.SYNC_READ, I.FAST_SYNC_READ)]
    assert all(bool(bus.handle(f)) == (level > 0) for f in fast)
    assert bus.servo(1).memory.get("led") == 1  # obeyed, answered or not


def test_unknown_instruction_and_bad_checksum_are_answered_with_their_error(bus: VirtualBus) -> None:
    assert bus.handle(build(1, 0x77)) == build_status(1, 2)
    spoiled = bytearray(build(1, I.WRITE, _word(65) + b"\x01"))
    spoiled[-3] = 0
    assert bus.handle(bytes(spoiled)) == build_status(1, 3)
    assert bus.servo(1).memory.get("led") == 0
    assert bus.handle(build(1, I.ACTION)) == build_status(1, 2)


def test_reg_write_and_action(bus: VirtualBus) -> None:
    params = _word(65) + b"\x01"
    assert bus.handle(build(1, I.REG_WRITE, params)) == build_status(1, 0)
    assert bus.servo(1).memory.get("registered_instruction") == 1
    assert bus.servo(1).memory.get("led") == 0
    bus.handle(build(254, I.ACTION))
    assert (bus.servo(1).memory.get("led"), bus.servo(1).memory.get("registered_instruction")) == (1, 0)


def test_a_broadcast_factory_reset_of_everything_is_ignored(bus: VirtualBus) -> None:
    bus.handle(build(254, I.FACTORY_RESET, b"\xff"))
    assert sorted(s.id for s in bus.servos) == [1, 2, 3]
    assert bus.handle(build(3, I.FACTORY_RESET, b"\xff")) == build_status(3, 0)
    assert sorted(s.id for s in bus.servos) == [1, 1, 2]


def test_a_new_id_is_answered_under_the_old_and_heard_under_the_new(bus: VirtualBus) -> None:
    assert bus.handle(build(1, I.WRITE, _word(7) + b"\x09")) == build_status(1, 0)
    assert bus.handle(build(1, I.PING)) == b""
    assert _answers(bus.handle(build(9, I.PING)))[0].id == 9


def test_a_secondary_id_is_obeyed_in_silence(bus: VirtualBus) -> None:
    bus.servo(1).memory.set("secondary_id", 50)
    assert bus.handle(build(50, I.WRITE, _word(65) + b"\x01")) == b""
    assert bus.servo(1).memory.get("led") == 1


def test_servos_with_one_id_talk_over_each_other(clock: VirtualClock) -> None:
    servos = [VirtualServo("XM430-W350", 1, clock, position_ticks=p) for p in (1111, 2222)]
    reply = VirtualBus(servos, clock).handle(build(1, I.READ, _word(132) + _word(4)))
    assert reply and not [a for a in _answers(reply) if a.valid]


def test_only_servos_at_the_client_s_rate_hear(bus: VirtualBus) -> None:
    bus.servo(2).memory.set("baud_rate", 1)
    assert [a.id for a in _answers(bus.handle(build(254, I.PING), 1_000_000))] == [1, 3]
    assert [a.id for a in _answers(bus.handle(build(254, I.PING), 57_600))] == [2]
    assert [a.id for a in _answers(bus.handle(build(254, I.PING)))] == [1, 2, 3]


def test_any_instruction_on_the_wire_keeps_the_bus_watchdog_quiet(
    bus: VirtualBus, clock: VirtualClock
) -> None:
    for register, value in ((98, 5), (64, 1)):
        bus.handle(build(1, I.WRITE, _word(register) + bytes([value])))
    for _ in range(10):
        clock.sleep_until(clock.now() + 0.09)
        bus.handle(build(77, I.PING))
    assert _answers(bus.handle(build(1, I.READ, _word(98) + _word(1))))[0].data == b"\x05"
    clock.sleep_until(clock.now() + 0.11)
    assert _answers(bus.handle(build(1, I.READ, _word(98) + _word(1))))[0].data == b"\xff"


def test_a_servo_that_starts_up_is_deaf(bus: VirtualBus, clock: VirtualClock) -> None:
    bus.servo(1).reboot_time = 0.3
    clock.sleep_until(5.0)
    assert bus.handle(build(1, I.REBOOT)) == build_status(1, 0)
    clock.sleep_until(5.29)
    assert bus.handle(build(1, I.PING)) == b""
    clock.sleep_until(5.31)
    assert bus.handle(build(1, I.PING)) != b""


def test_several_packets_and_pieces_at_once(bus: VirtualBus) -> None:
    stream = build(1, I.PING) + b"\xff\x00noise" + build(2, I.PING)
    assert bus.handle(stream[:3]) == b""
    assert [a.id for a in _answers(bus.handle(stream[3:]))] == [1, 2]


def test_threads_do_not_mix_their_packets(bus: VirtualBus) -> None:
    wrong: list[bytes] = []

    def ask(id: int) -> None:
        for _ in range(200):
            reply = bus.handle(build(id, I.READ, _word(132) + _word(4)))
            if reply != build_status(id, 0, _int(100 * id)):
                wrong.append(reply)

    threads = [threading.Thread(target=ask, args=(id,)) for id in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


# Sizes and addresses that are nearly right, and ids that exist: noise that gets past the first checks.
NEARLY = st.lists(
    st.sampled_from([_word(n) for n in (0, 1, 4, 7, 8, 64, 98, 116, 132, 168, 224, 661, 65535)])
    | st.sampled_from([b"\x01", b"\x02", b"\xff", b"\xff\xff\xfd", b"\x00"]),
    max_size=12,
).map(b"".join)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([1, 2, 3, 9, 254]),
            st.sampled_from(list(Instruction)) | st.integers(0, 255),
            NEARLY | st.binary(max_size=30),
        ),
        max_size=12,
    )
)
def test_no_packet_brings_the_bus_down(packets: list[tuple[int, int, bytes]]) -> None:
    clock = VirtualClock()
    bus = VirtualBus(
        [VirtualServo("XM430-W350", id, clock, position_ticks=100 * id) for id in (1, 2, 3)], clock
    )
    for id, instruction, params in packets:
        clock.sleep_until(clock.now() + 0.01)
        reply = bus.handle(build(id, instruction, params))
        if instruction not in (I.FAST_SYNC_READ, I.FAST_BULK_READ):  # those may break off, as they should
            answers = _answers(reply)
            ids = [s.id for s in bus.servos]
            assert all(a.is_status for a in answers if a.valid)
            assert len(set(ids)) < 3 or all(a.valid for a in answers)
    for servo in bus.servos:
        for register in servo.table:
            data, error = servo.read(register.address, register.size)
            assert len(data) == register.size and not error


# ------------------------------------------------------------------------------------- arm and truth


def test_from_config_stands_at_the_start(arm_config: ArmConfig, clock: VirtualClock) -> None:
    start = np.array([0.3, -0.2, 0.1, 1.0, -1.0, 0.5])
    bus = VirtualBus.from_config(arm_config, clock, start)
    for joint, q, servo in zip(arm_config.joints, start, bus.servos, strict=True):
        assert servo.id == joint.id and servo.table.model == joint.model
        assert servo.memory.get("operating_mode") == joint.mode
        assert servo.baud == arm_config.baud
        assert not servo.torque
        assert servo.reading == joint.to_ticks(q)
    assert np.abs(bus.true_angles(arm_config) - start).max() <= arm_config.resolution.max() / 2
    with pytest.raises(ConfigError):
        VirtualBus.from_config(arm_config, clock, [0.0])
    with pytest.raises(ConfigError):
        VirtualBus.from_config(arm_config, clock, [np.nan] * 6)


def test_zero_offset_by_joint_moves_the_truth_only(
    arm_config: ArmConfig, arm_bus: VirtualBus, sim: SimBus
) -> None:
    before = sim.sync_read(arm_config.ids, PRESENT)
    honest = arm_bus.true_angles(arm_config)
    # joint2 is reversed, joint3 is geared: the offset is one of the joint all the same
    offsets = {"joint2": 2.0, "joint3": -1.0}
    arm_bus.set_faults(Faults.for_joints(arm_config, zero_offset_deg=offsets))
    assert sim.sync_read(arm_config.ids, PRESENT) == before
    moved = np.degrees(arm_bus.true_angles(arm_config) - honest)
    assert moved == pytest.approx([0, 2, -1, 0, 0, 0], abs=1e-9)
    arm_bus.set_faults(Faults())
    assert arm_bus.true_angles(arm_config) == pytest.approx(honest)


def test_faults_name_what_exists(arm_config: ArmConfig, arm_bus: VirtualBus) -> None:
    with pytest.raises(UnknownJointError, match="joint2"):
        Faults.for_joints(arm_config, stuck=["join2"])
    with pytest.raises(KeyError, match="99"):
        arm_bus.set_faults(Faults(silent=frozenset({99})))
    with pytest.raises(ValueError, match="probability"):
        Faults(corrupt=1.5)
    with pytest.raises(TypeError, match="corupt"):
        Faults.for_joints(arm_config, corupt=0.1)


# -------------------------------------------------------------------------------------- in process


def test_simbus_is_a_servo_bus(sim: SimBus, arm_config: ArmConfig) -> None:
    assert isinstance(sim, ServoBus)
    assert sim.ping(4) == 1060
    assert sim.broadcast_ping() == {1: 1020, 2: 1020, 3: 1020, 4: 1060, 5: 1060, 6: 1020}


def test_simbus_moves_the_arm_on_virtual_time(
    sim: SimBus, arm_bus: VirtualBus, arm_config: ArmConfig, clock: VirtualClock
) -> None:
    goal = np.array([0.5, -0.5, 0.25, 1.0, -1.0, 0.1])
    assert sim.write(BROADCAST_ID, TORQUE, 1) == Status(BROADCAST_ID, None)
    sim.sync_write(GOAL, {j.id: j.to_ticks(q) for j, q in zip(arm_config.joints, goal, strict=True)})
    clock.sleep_until(10.0)
    read = sim.sync_read(arm_config.ids, PRESENT)
    q = [j.to_radians(read[j.id].data or 0) for j in arm_config.joints]
    assert np.abs(q - goal).max() <= arm_config.resolution.max() / 2
    assert arm_bus.true_angles(arm_config) == pytest.approx(q)


def test_simbus_reads_signed_values(sim: SimBus, clock: VirtualClock) -> None:
    sim.write(1, TORQUE, 1)
    sim.write(1, GOAL, -12_345)
    clock.sleep_until(20.0)
    assert sim.read(1, PRESENT).data == -12_345
    with pytest.raises(ValueError, match="fit"):
        sim.write(1, TORQUE, 300)


@pytest.mark.parametrize(
    "call",
    [
        lambda sim: sim.ping(1),
        lambda sim: sim.broadcast_ping(),
        lambda sim: sim.read(1, PRESENT),
        lambda sim: sim.write(1, TORQUE, 1),
        lambda sim: sim.sync_read([1], PRESENT),
        lambda sim: sim.sync_write(TORQUE, {1: 1}),
        lambda sim: sim.reboot(1),
    ],
)
def test_simbus_must_be_open(sim: SimBus, arm_bus: VirtualBus, call: Callable[[SimBus], object]) -> None:
    sim.close()
    sim.close()
    with pytest.raises(BusNotOpenError):
        call(sim)
    assert not arm_bus.servo(1).torque


def test_simbus_names_the_silent_and_the_refusing(
    sim: SimBus, arm_bus: VirtualBus, clock: VirtualClock
) -> None:
    sim.read(3, PRESENT)
    clock.sleep_until(2.5)
    arm_bus.set_faults(Faults(silent=frozenset({3})))
    with pytest.raises(BusTimeoutError) as silent:
        sim.read(3, PRESENT)
    assert (silent.value.id, silent.value.register, silent.value.port) == (3, "present_position", "sim")
    assert silent.value.last_good == pytest.approx(2.5)
    with pytest.raises(ServoRefusedError) as refused:
        sim.write(1, GOAL, 1_048_576)
    assert (refused.value.id, refused.value.code) == (1, 4)


def test_simbus_sync_read_keeps_who_answered(sim: SimBus, arm_bus: VirtualBus, arm_config: ArmConfig) -> None:
    arm_bus.set_faults(Faults(silent=frozenset({2}), overload=frozenset({5})))
    read = sim.sync_read(arm_config.ids, PRESENT)
    assert list(read) == list(arm_config.ids)
    assert read[2] == Status(2, None)
    assert [id for id, status in read.items() if status.alert] == [5]
    assert read[5].data == 2048  # an alert is information: the data are good
    assert (sim.counters.timeouts, sim.counters.cycles, sim.counters.retries) == (1, 1, 2)


def test_simbus_sync_read_carries_refusals(sim: SimBus) -> None:
    # Current Limit is at 38 on an XM430 and nothing is there on an XL430 (id 4).
    read = sim.sync_read([1, 4], TABLE["current_limit"])
    assert read == {1: Status(1, 1193), 4: Status(4, None, 7)}


def test_simbus_reboot_clears_an_overload(sim: SimBus, arm_bus: VirtualBus) -> None:
    sim.write(5, CONTROL_TABLES["XL430-W250"]["torque_enable"], 1)
    arm_bus.set_faults(Faults(overload=frozenset({5})))
    assert sim.read(5, TABLE["hardware_error_status"]) == Status(5, 32, 0, True)
    assert sim.read(5, TORQUE).data == 0
    sim.reboot(5)
    assert sim.read(5, TABLE["hardware_error_status"]) == Status(5, 0, 0, False)


@pytest.mark.parametrize("fault", ["corrupt", "truncate", "drop", "garbage"])
def test_no_wrong_value_comes_through_a_bad_wire(
    sim: SimBus, arm_bus: VirtualBus, arm_config: ArmConfig, fault: str
) -> None:
    right = {id: status.data for id, status in sim.sync_read(arm_config.ids, PRESENT).items()}
    arm_bus.set_faults(Faults(seed=5, **{fault: 0.2}))  # type: ignore[arg-type]
    seen = [sim.sync_read(arm_config.ids, PRESENT) for _ in range(200)]
    values = [status.data for read in seen for status in read.values()]
    assert all(s.data in (None, right[id]) for read in seen for id, s in read.items())
    # Three tries at 0.2: 0.8 % stay without an answer; of 1200 that is about 10.
    missing = values.count(None)
    assert missing < 40
    assert sim.counters.timeouts == missing
    assert (sim.counters.retries > 20) or fault == "garbage"


def test_wire_faults_repeat_with_their_seed(arm_config: ArmConfig) -> None:
    def run(seed: int) -> list[bytes]:
        bus = VirtualBus.from_config(
            arm_config, VirtualClock(), faults=Faults(corrupt=0.3, drop=0.3, seed=seed)
        )
        return [bus.handle(build(254, I.PING)) for _ in range(20)]

    assert run(1) == run(1) != run(2)


def test_a_wire_that_spoils_everything_is_called_corrupt(sim: SimBus, arm_bus: VirtualBus) -> None:
    arm_bus.servo(1).memory.set("id", 2)  # two servos with one id at different places
    with pytest.raises(BusCorruptError, match="two servos"):
        sim.read(2, PRESENT)


def test_local_echo_is_read_over(sim: SimBus, arm_bus: VirtualBus) -> None:
    arm_bus.set_faults(Faults(echo=True))
    assert sim.read(1, PRESENT).data == 2048
    assert sim.broadcast_ping()[6] == 1020
