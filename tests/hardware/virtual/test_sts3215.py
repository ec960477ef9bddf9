"""The virtual STS3215: memory, motion, protection and every fault that its family has."""

from __future__ import annotations

import pytest

from robot_ik.config import KeyProblem
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.feetech_sts_table import STS3215
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import FAULTS, Fault
from robot_ik.hardware.virtual.protocol1 import Instruction, build_status, checksum
from robot_ik.hardware.virtual.sts3215 import MIDDLE_TICKS, VirtualSts3215
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.hardware.virtual.world import World
from robot_ik.ports import VirtualClock
from robot_ik.robot import load_robot

FAMILY = ArmConfig.load("so101").family
STS_FAULTS = [name for name, row in FAULTS.items() if FAMILY.name in row.families]
STS_FAULTS += [name for name, row in FAULTS.items() if not row.families]
IDS = (1, 2, 3)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def bus(clock) -> VirtualBus:
    return VirtualBus([VirtualSts3215(id, clock) for id in IDS], clock)


@pytest.fixture
def servo(bus) -> VirtualSts3215:
    return bus.servo(1)


@pytest.fixture
def host(bus) -> SimBus:
    opened = SimBus(bus, FAMILY.protocol, retries=0)
    opened.open()
    return opened


def write(servo: VirtualSts3215, name: str, value: int) -> None:
    servo.write(STS3215[name].address, STS3215[name].encode(value))


def read(servo: VirtualSts3215, name: str) -> int:
    register = STS3215[name]
    return register.decode(servo.read(register.address, register.size))


def request(id: int, instruction: int, *params: int) -> bytes:
    body = bytes((id, len(params) + 2, instruction, *params))
    return b"\xff\xff" + body + bytes((checksum(body),))


def after(clock: VirtualClock, seconds: float) -> None:
    clock.sleep_until(clock.now() + seconds)


# Packets of the Feetech manual and of the magnetic encoder's memory table.


@pytest.mark.parametrize(
    ("sent", "received"),
    [
        ("ff ff 01 02 01 fb", "ff ff 01 02 00 fc"),
        ("ff ff 01 04 02 38 02 be", "ff ff 01 04 00 00 08 f2"),
        ("ff ff 01 04 02 03 02 f3", "ff ff 01 04 00 09 03 ee"),
    ],
)
def test_raw_packets_are_answered_as_the_manual_says(bus, sent, received):
    assert bus.handle(bytes.fromhex(sent)) == bytes.fromhex(received)


def test_every_servo_answers_a_broadcast_ping_in_the_order_of_ids(bus):
    reply = bus.handle(request(0xFE, Instruction.PING))
    assert reply == b"".join(build_status(id, 0) for id in IDS)


def test_a_damaged_request_has_no_reply(bus):
    assert bus.handle(bytes.fromhex("ff ff 01 02 01 00")) == b""


def test_two_servos_with_one_id_answer_at_once(bus):
    bus.inject(Fault("id", 2, 1))
    reply = bus.handle(request(1, Instruction.PING))
    assert reply != build_status(1, 0)


# Memory.


def test_an_eeprom_write_while_locked_is_lost_at_the_next_power_cycle(servo):
    write(servo, "lock", 1)
    write(servo, "return_delay_time", 7)
    assert read(servo, "return_delay_time") == 7
    servo.power_cycle()
    assert read(servo, "return_delay_time") == 250


def test_an_eeprom_write_while_unlocked_is_saved(servo):
    write(servo, "lock", 0)
    write(servo, "return_delay_time", 7)
    servo.power_cycle()
    assert read(servo, "return_delay_time") == 7


def test_some_firmware_drops_eeprom_writes_while_locked(bus, servo):
    bus.inject(Fault("drops_locked_writes"))
    write(servo, "lock", 1)
    write(servo, "return_delay_time", 7)
    assert read(servo, "return_delay_time") == 250


def test_value_128_of_torque_enable_makes_the_present_position_the_middle(servo):
    servo.rotate_by_hand(300)
    write(servo, "torque_enable", 128)
    assert read(servo, "present_position") == MIDDLE_TICKS
    assert read(servo, "homing_offset") == 300


def test_the_homing_offset_is_subtracted(servo):
    write(servo, "homing_offset", 100)
    assert read(servo, "present_position") == MIDDLE_TICKS - 100


def test_positions_leave_one_revolution_only_with_multi_turn_feedback(servo):
    servo.rotate_by_hand(-3000)
    assert read(servo, "present_position") == MIDDLE_TICKS - 3000 + 4096
    write(servo, "phase", 12 | 1 << 4)
    assert read(servo, "present_position") == MIDDLE_TICKS - 3000


# Torque.


def test_by_default_a_goal_switches_torque_on(servo, clock):
    write(servo, "goal_position", 2200)
    assert read(servo, "torque_enable") == 1
    after(clock, 1.0)
    assert read(servo, "present_position") == 2200


def test_with_the_other_answer_a_goal_leaves_the_servo_limp(bus, servo, clock):
    bus.inject(Fault("goal_keeps_torque"))
    write(servo, "goal_position", 2200)
    after(clock, 1.0)
    assert read(servo, "torque_enable") == 0
    assert read(servo, "present_position") == MIDDLE_TICKS


def press(servo: VirtualSts3215, clock: VirtualClock) -> None:
    """Press against an obstacle until the servo reports an overload."""
    servo.jammed = True
    write(servo, "torque_enable", 1)
    write(servo, "goal_position", 2400)
    servo.update()
    after(clock, 2.5)


def test_an_overload_lowers_the_torque_until_the_next_goal(servo, clock):
    press(servo, clock)
    assert read(servo, "hardware_error_status") == 1 << 5
    assert read(servo, "present_load") == 200
    write(servo, "goal_position", 2400)
    assert read(servo, "hardware_error_status") == 0
    assert read(servo, "present_load") == 1000


def test_a_latched_overload_needs_a_power_cycle(bus, servo, clock):
    bus.inject(Fault("latched_overload"))
    press(servo, clock)
    write(servo, "goal_position", 2400)
    write(servo, "torque_enable", 0)
    assert read(servo, "hardware_error_status") == 1 << 5
    servo.power_cycle()
    assert read(servo, "hardware_error_status") == 0


# Faults.


@pytest.mark.parametrize("kind", STS_FAULTS)
def test_every_fault_of_the_family_can_begin_and_end(bus, clock, host, kind):
    row = FAULTS[kind]
    value = {"baud": 500_000.0, "extra": 9.0}.get(kind, row.low if row.span else None)
    bus.inject(Fault(kind, 1 if row.servo else None, value, for_s=0.01))
    after(clock, 0.5)
    bus.advance()
    bus.clear()
    after(clock, 0.5)
    assert sorted(s.id for s in bus.servos) == list(IDS)
    assert [bus.handle(request(id, Instruction.PING))[2] for id in IDS] == list(IDS)


@pytest.mark.parametrize("kind", ["watchdog_tripped", "lost_turns", "electrical_shock"])
def test_a_fault_of_another_family_is_refused(bus, kind):
    value = 1 if FAULTS[kind].span else None
    with pytest.raises(KeyProblem, match="feetech_sts servos have no fault"):
        bus.inject(Fault(kind, 1, value))


def test_a_brown_out_restarts_the_servo_with_a_stale_goal(bus, servo, clock):
    write(servo, "goal_velocity", 500)
    write(servo, "goal_position", 2100)
    bus.inject(Fault("supply", 1, 1.0, for_s=0.1))
    bus.advance()
    assert servo.deaf
    after(clock, 0.2)
    bus.advance()
    assert not servo.deaf
    assert (read(servo, "torque_enable"), read(servo, "goal_velocity")) == (0, 0)
    assert read(servo, "goal_position") == 0


def test_a_servo_on_usb_power_is_slower_and_has_no_error(bus, servo, clock):
    positions = []
    for volts in (7.4, 5.0):
        bus.inject(Fault("supply", 1, volts))
        write(servo, "goal_position", 1000)
        after(clock, 2.0)
        write(servo, "goal_position", 3500)
        after(clock, 0.5)
        positions.append(read(servo, "present_position"))
        assert read(servo, "hardware_error_status") == 0
    assert positions[1] < positions[0] - 200


def test_a_supply_above_the_limit_of_the_servo_is_an_error(bus, servo):
    bus.inject(Fault("supply", 1, 12.0))
    assert read(servo, "hardware_error_status") == 1 << 0
    write(servo, "max_voltage_limit", 140)
    assert read(servo, "hardware_error_status") == 0


def test_a_hot_servo_reports_it_and_lets_go(bus, servo):
    write(servo, "torque_enable", 1)
    bus.inject(Fault("hot", 1, 80.0))
    assert read(servo, "hardware_error_status") == 1 << 2
    assert not servo.torque
    assert read(servo, "torque_enable") == 1


def test_a_stripped_gear_neither_moves_nor_feels_a_load(bus, servo, clock):
    bus.inject(Fault("stuck", 1))
    write(servo, "goal_position", 2400)
    after(clock, 3.0)
    assert read(servo, "present_position") == MIDDLE_TICKS
    assert read(servo, "present_load") == 0


def test_a_pushed_shaft_sags(bus, servo, clock):
    write(servo, "position_p_gain", 16)
    write(servo, "goal_position", MIDDLE_TICKS)
    bus.inject(Fault("push", 1, -1.47))
    after(clock, 0.5)
    sag_deg = (MIDDLE_TICKS - read(servo, "present_position")) * 360 / 4096
    assert 1.8 <= abs(sag_deg) <= 2.6


def test_with_backlash_the_shaft_stops_short_on_each_side(bus, servo, clock):
    bus.inject(Fault("backlash", 1, 1.0))
    write(servo, "goal_position", 2400)
    after(clock, 2.0)
    from_below = read(servo, "present_position")
    write(servo, "goal_position", 2800)
    after(clock, 2.0)
    write(servo, "goal_position", 2400)
    after(clock, 2.0)
    from_above = read(servo, "present_position")
    assert from_above - from_below == pytest.approx(1.0 * 4096 / 360, abs=1.5)


def test_a_range_across_the_wrap_reads_beyond_the_end(bus, servo):
    bus.inject(Fault("homing_offset", 1, 2040))
    servo.rotate_by_hand(-100)
    assert read(servo, "present_position") == (MIDDLE_TICKS - 100 - 2040) % 4096


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_spoilt_reply_is_never_a_value(bus, host, clock, spoil):
    bus.inject(Fault(spoil, value=0.3))
    for k, servo in enumerate(bus.servos):
        servo.rotate_by_hand(100 * k)
    register = STS3215["present_position"]
    values = 0
    for _ in range(150):
        after(clock, 0.01)
        reads = dict.fromkeys(IDS, register)
        for id, status in host.exchange(STS3215["goal_velocity"], {}, reads).items():
            assert status.data in (None, MIDDLE_TICKS + 100 * (id - 1))
            values += status.data is not None
    assert values > 100


# A world: gravity shows up as load, and a limp arm falls.


def test_in_a_world_an_arm_carries_its_weight_and_falls_without_torque(clock):
    config = ArmConfig.load("so101")
    robot = load_robot("so101")
    servos = VirtualBus.from_config(config, clock, [0.0, 0.0, 0.0, 0.0, 0.0])
    World(robot.model, config, servos)
    with open_arm(config, "sim", virtual_bus=servos, on_exit="torque_off") as arm:
        arm.enable()
        start = arm.read().q.copy()
        target = start + 0.1
        arm.move_to(target)
        assert arm.read().q == pytest.approx(target, abs=0.03)
        loads = [read(servo, "present_load") for servo in servos.servos]
        assert max(map(abs, loads[1:3])) > 50
    before = servos.true_angles(config)
    after(clock, 1.0)
    servos.advance()
    assert max(abs(servos.true_angles(config) - before)) > 0.2
