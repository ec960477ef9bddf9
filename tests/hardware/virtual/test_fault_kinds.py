"""Faults while a virtual bus runs: each kind, its time, its end, and the random ones."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusTimeoutError,
    ServoRefusedError,
)
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import FAULTS, Fault
from robot_ik.hardware.virtual.protocol import Instruction, Packet, build
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.ports import VirtualClock

TABLE = X_TABLES["XM430-W350"]
PRESENT = TABLE["present_position"]
IDS = (1, 2, 3)


@pytest.fixture
def sim(bus: VirtualBus) -> SimBus:
    sim = SimBus(bus, retries=0)
    sim.open()
    return sim


def answering(sim: SimBus) -> list[int]:
    """Of a control cycle: other reads wait for late replies after a miss."""
    reads = sim.exchange(TABLE["goal_position"], {}, dict.fromkeys(IDS, PRESENT))
    return [id for id, status in reads.items() if status.data is not None]


def test_silent_for_one_cycle_and_at_its_time(
    bus: VirtualBus, sim: SimBus, clock: VirtualClock
) -> None:
    bus.inject(Fault("silent", 2, at_s=1.0, for_s=0.05))
    seen = []
    for k in range(10):
        clock.sleep_until(0.93 + 0.02 * k)
        seen.append(answering(sim))
    assert seen == [[1, 2, 3]] * 4 + [[1, 3]] * 2 + [[1, 2, 3]] * 4 or seen.count([1, 3]) == 3


def test_by_number_of_packets(bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(Fault("silent", 1, at_packet=3, for_packets=2))
    assert [len(answering(sim)) for _ in range(6)] == [3, 3, 2, 2, 3, 3]


def test_everybody_silent_and_power_lost(bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(Fault("silent", for_packets=1))
    assert answering(sim) == [] and answering(sim) == [1, 2, 3]
    sim.write(1, TABLE["led"], 1)
    bus.inject(Fault("supply", value=0.0, for_packets=1))
    assert answering(sim) == [] and answering(sim) == [1, 2, 3]
    assert sim.read(1, TABLE["led"]).data == 0  # the servo has restarted
    assert sim.read(1, TABLE["present_input_voltage"]).data == 120


def test_each_servo_gets_its_own_supply_back_whichever_fault_of_it_ends_first(
    bus: VirtualBus, sim: SimBus, clock: VirtualClock
) -> None:
    bus.servo(2).set_supply(11.0)
    bus.inject(
        Fault("supply", value=9.7, for_s=3.0), Fault("supply", value=10.0, at_s=1.0, for_s=1.0)
    )
    seen = {}
    for now in (0.5, 1.5, 2.5, 3.5):
        clock.sleep_until(now)
        seen[now] = [sim.read(id, TABLE["present_input_voltage"]).data for id in (1, 2, 3)]
    assert seen == {0.5: [97] * 3, 1.5: [100] * 3, 2.5: [97] * 3, 3.5: [120, 110, 120]}
    bus.inject(Fault("supply", value=9.7, for_s=1.0), Fault("supply", value=0.0, for_s=2.0))
    clock.sleep_until(5.0)  # the first has ended under the second
    assert answering(sim) == []
    clock.sleep_until(6.0)
    assert answering(sim) == [1, 2, 3]
    assert [bus.servo(id).shaft.volts for id in (1, 2, 3)] == [12.0, 11.0, 12.0]


@pytest.mark.parametrize(
    ("kind", "id", "low", "high", "read"),
    [
        ("drop", None, 0.2, 0.5, lambda bus: bus.wire.chances["drop"]),
        ("latency", None, 2.0, 5.0, lambda bus: bus.latency),
        ("zero_offset", 1, 2.0, 5.0, lambda bus: bus.servo(1).zero_offset_ticks),
        ("return_delay", 1, 2, 5, lambda bus: bus.servo(1).return_delay),
        ("push", 1, 2.0, 5.0, lambda bus: bus.servo(1).shaft.load.push),
    ],
)
def test_of_two_faults_the_later_one_counts_and_both_leave_nothing(
    kind: str,
    id: int | None,
    low: float,
    high: float,
    read: Callable[[VirtualBus], float],
    bus: VirtualBus,
    clock: VirtualClock,
) -> None:
    own = read(bus)
    seen = []
    bus.inject(Fault(kind, id, low, for_s=1.0), Fault(kind, id, high, at_s=0.5, for_s=1.0))
    for now in (0.2, 0.7, 1.2, 1.7):
        clock.sleep_until(now)
        bus.advance()
        seen.append(read(bus))
    assert len({own, *seen}) == 3 and seen[1] == seen[2] and seen[3] == own


def test_faults_are_taken_back_by_kind_or_all(bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(
        Fault("silent", 1),
        Fault("overload", 2),
        Fault("silent", 3, at_s=9.0),
        Fault("drop", value=1.0),
    )
    assert bus.clear("drop") == 1 and answering(sim) == [2, 3]
    assert bus.clear("silent") == 2 and answering(sim) == [1, 2, 3]
    assert sim.read(2, TABLE["hardware_error_status"]).data
    assert bus.clear() == 1 and bus.clear() == 0
    assert sim.read(2, TABLE["hardware_error_status"]).data == 0  # the servo has restarted
    bus.clock.sleep_until(10.0)
    assert answering(sim) == [1, 2, 3]  # what was cleared before its time does not come


def test_a_brown_out_of_one_servo(bus: VirtualBus, sim: SimBus, clock: VirtualClock) -> None:
    sim.write(3, TABLE["torque_enable"], 1)
    clock.sleep_until(5.0)
    ticks = sim.read(3, TABLE["realtime_tick"]).data
    bus.inject(Fault("reboot", 3))
    assert ticks == 5000 and sim.read(3, TABLE["realtime_tick"]).data == 0
    assert sim.read(3, TABLE["torque_enable"]).data == 0
    status = sim.read(3, TABLE["hardware_error_status"])
    assert (status.data, status.alert) == (0, False)


@pytest.mark.parametrize("name", ["overload", "overheating", "input_voltage", "electrical_shock"])
def test_hardware_errors_stay_until_reboot(name: str, bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(Fault(name, 1))
    for _ in range(3):
        status = sim.read(1, TABLE["hardware_error_status"])
        assert status.data and status.alert
    sim.reboot(1)
    assert not sim.read(1, PRESENT).alert


def test_what_a_servo_says_of_itself(bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(Fault("model", 1, 1060), Fault("status_level", 2, 0), Fault("return_delay", 3, 100))
    assert sim.ping(1) == 1060
    with pytest.raises(BusTimeoutError):
        sim.read(2, PRESENT)
    assert sim.ping(2) == 1020
    ask = build(3, Instruction.READ, b"\x84\x00\x04\x00")
    assert bus.respond(ask)[1] == pytest.approx(200e-6)
    bus.inject(Fault("latency", value=16.0, for_packets=1))
    assert bus.respond(ask)[1] == pytest.approx(16.2e-3)
    assert bus.respond(ask)[1] == pytest.approx(0.2e-3)
    bus.inject(Fault("model", 1, 999))  # a model that is not known here
    assert sim.ping(1) == 999
    with pytest.raises(ValueError, match=r"70000.*a whole number, 0\.\.65535"):
        Fault("model", 1, 70_000)


def test_a_servo_with_another_baud_rate(
    bus: VirtualBus, parse: Callable[[bytes], list[Packet]]
) -> None:
    bus.inject(Fault("baud", 2, 57_600, for_packets=2))
    ping = build(254, Instruction.PING)
    assert [p.id for p in parse(bus.handle(ping, 1_000_000))] == [1, 3]
    assert [p.id for p in parse(bus.handle(ping, 57_600))] == [2]
    assert [p.id for p in parse(bus.handle(ping, 1_000_000))] == [1, 2, 3]


def test_two_servos_with_one_id_are_not_understood(bus: VirtualBus, sim: SimBus) -> None:
    """Equal replies too: they do not begin at the same instant."""
    bus.servo(1).rotate_by_hand(1900.0)
    bus.inject(Fault("id", 2, 1, for_packets=21))
    understood = 0
    for _ in range(20):
        try:
            sim.read(1, PRESENT)
            understood += 1
        except (BusTimeoutError, BusCorruptError):
            pass
    assert understood == 0 and sim.counters.corrupt > 10
    assert 1 not in sim.broadcast_ping()  # garbled there as well
    assert sim.broadcast_ping() == {1: 1020, 2: 1020, 3: 1020}


def test_missing_and_extra(bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(Fault("extra", value=9, for_packets=1), Fault("unplugged", 2, for_packets=1))
    assert sorted(sim.broadcast_ping()) == [1, 3, 9]
    assert sorted(sim.broadcast_ping()) == [1, 2, 3]


def test_watchdog_tripped_before(bus: VirtualBus, sim: SimBus) -> None:
    bus.inject(Fault("watchdog_tripped", 1))
    with pytest.raises(ServoRefusedError, match="watchdog"):
        sim.write(1, TABLE["goal_position"], 200)
    sim.write(1, TABLE["bus_watchdog"], 0)
    sim.write(1, TABLE["goal_position"], 200)


def test_shafts(bus: VirtualBus, sim: SimBus, clock: VirtualClock) -> None:
    bus.inject(Fault("turn", 1, 90.0), Fault("lost_turns", 2, 1), Fault("zero_offset", 3, -45.0))
    found = [status.data for status in sim.sync_read(IDS, PRESENT).values()]
    assert found == [100 + 1024, 200 + 4096, 300]
    assert bus.servo(3).true_ticks == 300 - 512
    bus.inject(Fault("push", 1, 2.0))
    sim.write(1, TABLE["torque_enable"], 1)
    amperes = (sim.read(1, TABLE["present_current"]).data or 0) * 2.69e-3
    assert amperes * 4.1 / 2.3 > 1.7
    bus.inject(Fault("hot", 1, 90.0))
    clock.sleep_until(0.1)
    assert sim.read(1, TABLE["present_temperature"]).data == 90
    assert sim.read(1, TABLE["hardware_error_status"]).data == 0b100


def test_the_port_goes_away_in_process_too(
    bus: VirtualBus, sim: SimBus, clock: VirtualClock
) -> None:
    bus.inject(Fault("port_unplugged", at_s=1.0, for_s=0.5))
    assert answering(sim) == [1, 2, 3]
    clock.sleep_until(1.2)
    with pytest.raises(BusDisconnectedError):
        sim.read(1, PRESENT)
    clock.sleep_until(1.6)
    sim.open()
    assert answering(sim) == [1, 2, 3]


@pytest.mark.parametrize("rate", sorted({*SPOILS, "echo"}))
def test_no_fault_of_the_wire_ever_gives_a_wrong_value(rate: str, bus: VirtualBus) -> None:
    sim = SimBus(bus, retries=2)
    sim.open()
    bus.inject(Fault(rate, value=0.3) if rate in SPOILS else Fault(rate))
    got = 0
    for _ in range(400 if rate == "wrong_id" else 60):
        for id, status in sim.sync_read(IDS, PRESENT).items():
            assert status.data in (None, 100 * id)
            got += status.data is not None
    assert got > 60
    bus.inject(*(Fault(name, value=0.0) for name in SPOILS))
    sim.sync_read(IDS, PRESENT)
    assert [s.data for s in sim.sync_read(IDS, PRESENT).values()] == [100, 200, 300]


def test_equal_seeds_give_equal_runs(arm_config: ArmConfig) -> None:
    def run(seed: int) -> list[bytes]:
        bus = VirtualBus.from_config(arm_config, VirtualClock(), seed=seed)
        bus.inject(*(Fault(rate, value=0.1) for rate in SPOILS), Fault("id", 2, 1))
        return [bus.handle(build(254, Instruction.PING)) for _ in range(30)]

    assert run(1) == run(1) != run(2)


def test_every_kind_can_be_begun_and_ended(bus: VirtualBus, clock: VirtualClock) -> None:
    values = {"baud": 57_600.0, "extra": 9.0}
    for name, kind in FAULTS.items():
        if kind.families and bus.family not in kind.families:
            continue
        value = values.get(name, kind.low if kind.span else None)
        bus.inject(Fault(name, 1 if kind.servo else None, value, for_s=0.01))
        clock.sleep_until(clock.now() + 0.02)
        bus.advance()
    assert sorted(s.id for s in bus.servos) == [1, 2, 3] and not bus.unplugged
    assert bus.handle(build(2, Instruction.PING)) != b""


def test_what_cannot_be_is_refused(bus: VirtualBus) -> None:
    with pytest.raises(ValueError, match="silent"):
        Fault("silnt")
    with pytest.raises(ValueError, match="takes no value"):
        Fault("silent", value=1.0)
    with pytest.raises(ValueError, match="joint and id exclude each other"):
        Fault("silent", 1, joint="joint1")
    with pytest.raises(ValueError, match=r"0\.\.1"):
        Fault("drop", value=2.0)
    with pytest.raises(KeyError):
        bus.inject(Fault("silent", 99))
