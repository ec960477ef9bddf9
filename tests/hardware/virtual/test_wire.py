"""The wire of the virtual bus: rates, time, packets in pieces, threads, and noise."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.protocol import Instruction, Packet, build, build_status
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.ports import VirtualClock

I = Instruction  # noqa: E741

# Sizes and addresses that are nearly right, and ids that exist: noise that gets past the first
# checks.
NEARLY = st.lists(
    st.sampled_from(
        [struct.pack("<H", n) for n in (0, 1, 4, 7, 8, 64, 98, 116, 132, 168, 224, 661, 65535)]
    )
    | st.sampled_from([b"\x01", b"\x02", b"\xff", b"\xff\xff\xfd", b"\x00"]),
    max_size=12,
).map(b"".join)


def test_only_servos_at_the_client_s_rate_hear(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    bus.servo(2).memory.set("baud_rate", 1)
    assert [a.id for a in parse(bus.handle(build(254, I.PING), 1_000_000))] == [1, 3]
    assert [a.id for a in parse(bus.handle(build(254, I.PING), 57_600))] == [2]
    assert [a.id for a in parse(bus.handle(build(254, I.PING)))] == [1, 2, 3]


def test_any_instruction_on_the_wire_keeps_the_bus_watchdog_quiet(
    bus: VirtualBus, clock: VirtualClock, parse: Callable[[bytes], list[Packet]]
) -> None:
    for register, value in ((98, 5), (64, 1)):
        bus.handle(build(1, I.WRITE, struct.pack("<HB", register, value)))
    for _ in range(10):
        clock.sleep_until(clock.now() + 0.09)
        bus.handle(build(77, I.PING))
    assert parse(bus.handle(build(1, I.READ, struct.pack("<HH", 98, 1))))[0].data == b"\x05"
    clock.sleep_until(clock.now() + 0.11)
    assert parse(bus.handle(build(1, I.READ, struct.pack("<HH", 98, 1))))[0].data == b"\xff"


def test_a_servo_that_starts_up_is_deaf(bus: VirtualBus, clock: VirtualClock) -> None:
    bus.servo(1).reboot_time = 0.3
    clock.sleep_until(5.0)
    assert bus.handle(build(1, I.REBOOT)) == build_status(1, 0)
    clock.sleep_until(5.29)
    assert bus.handle(build(1, I.PING)) == b""
    clock.sleep_until(5.31)
    assert bus.handle(build(1, I.PING)) != b""


def test_several_packets_and_pieces_at_once(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    stream = build(1, I.PING) + b"\xff\x00noise" + build(2, I.PING)
    assert bus.handle(stream[:3]) == b""
    assert [a.id for a in parse(bus.handle(stream[3:]))] == [1, 2]


def test_threads_do_not_mix_their_packets(bus: VirtualBus) -> None:
    wrong: list[bytes] = []

    def ask(id: int) -> None:
        for _ in range(200):
            reply = bus.handle(build(id, I.READ, struct.pack("<HH", 132, 4)))
            if reply != build_status(id, 0, struct.pack("<i", 100 * id)):
                wrong.append(reply)

    threads = [threading.Thread(target=ask, args=(id,)) for id in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@given(st.lists(st.binary(max_size=60) | NEARLY, max_size=10), st.integers(0, 1000))
def test_noise_moves_no_servo_and_a_spoiled_wire_brings_nothing_down(
    noise: list[bytes], seed: int
) -> None:
    clock = VirtualClock()
    servos = [VirtualServo("XM430-W350", id, clock, position_ticks=100 * id) for id in (1, 2, 3)]
    bus = VirtualBus(servos, clock, seed)
    bus.inject(*(Fault(name, value=0.2) for name in SPOILS))
    for data in noise:
        clock.sleep_until(clock.now() + 0.06)
        bus.handle(data)
        bus.handle(build(254, I.PING))
        bus.handle(build(254, I.SYNC_READ, struct.pack("<HH", 132, 4) + b"\x03\x01\x02"))
        bus.handle(build(254, I.FAST_SYNC_READ, struct.pack("<HH", 132, 4) + b"\x03\x01\x02"))
    assert [(s.torque, s.shaft.reading) for s in servos] == [
        (False, 100.0),
        (False, 200.0),
        (False, 300.0),
    ]


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
def test_no_packet_brings_the_bus_down(
    parse: Callable[[bytes], list[Packet]], packets: list[tuple[int, int, bytes]]
) -> None:
    clock = VirtualClock()
    bus = VirtualBus(
        [VirtualServo("XM430-W350", id, clock, position_ticks=100 * id) for id in (1, 2, 3)], clock
    )
    for id, instruction, params in packets:
        clock.sleep_until(clock.now() + 0.01)
        reply = bus.handle(build(id, instruction, params))
        # A fast read breaks off at a servo that does not answer.
        if instruction not in (I.FAST_SYNC_READ, I.FAST_BULK_READ):
            answers = parse(reply)
            ids = [s.id for s in bus.servos]
            assert all(a.is_status for a in answers if a.valid)
            assert len(set(ids)) < 3 or all(a.valid for a in answers)
    for servo in bus.servos:
        for register in servo.table:
            data, error = servo.read(register.address, register.size)
            assert len(data) == register.size and not error
