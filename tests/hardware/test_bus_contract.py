"""What every servo bus must do, on each of the ways to reach servos."""

from __future__ import annotations

import threading

import pytest

from robot_ik.errors import BusNotOpenError, BusTimeoutError, ServoRefusedError
from robot_ik.hardware import BUSES, open_bus
from robot_ik.hardware.bus import BROADCAST_ID, ServoBus
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.ports import RealClock, VirtualClock

XM = X_TABLES["XM430-W350"]
VIRTUAL = [row.name for row in BUSES.values() if row.virtual]


@pytest.fixture
def servos(arm_config):
    return VirtualBus.from_config(arm_config, RealClock(), start=[0.1, 0.2, 0.3, -0.4, 0.5, 0.6])


@pytest.fixture(params=VIRTUAL)
def bus(request, arm_config, servos, real_time):
    bus = open_bus(request.param, arm_config, virtual_bus=servos)
    yield bus
    bus.close()


def test_it_is_a_servo_bus(bus):
    assert isinstance(bus, ServoBus) and bus.is_open and bus.port


def test_ping_tells_the_model_and_broadcast_ping_everyone(bus, arm_config):
    expected = {joint.servo.id: joint.servo.table.number for joint in arm_config.joints}
    assert {id: bus.ping(id) for id in expected} == expected
    assert bus.broadcast_ping() == expected


def test_a_written_register_reads_back(bus):
    assert bus.write(1, XM["profile_velocity"], 123).data is None
    status = bus.read(1, XM["profile_velocity"])
    assert (status.id, status.data, status.error, status.alert) == (1, 123, 0, False)


@pytest.mark.parametrize("value", [-1, -1_048_575, 1_048_575, 0, -131_073])
def test_signed_registers_keep_their_sign_and_stuffed_bytes_their_value(bus, value):
    # -131073 is FF FF FD FF on the wire: a packet header in the data, to be stuffed both ways.
    bus.write(1, XM["goal_position"], value)
    assert bus.read(1, XM["goal_position"]).data == value
    assert bus.sync_read([1, 2], XM["goal_position"])[1].data == value


def test_sync_write_and_sync_read_reach_each_servo_with_its_own_value(bus, arm_config):
    goals = {id: 1000 - 700 * id for id in arm_config.servo_ids}
    bus.sync_write(XM["goal_position"], goals)
    replies = bus.sync_read(arm_config.servo_ids, XM["goal_position"])
    assert list(replies) == list(arm_config.servo_ids)
    assert {id: status.data for id, status in replies.items()} == goals


def test_a_broadcast_write_reaches_all_servos_without_waiting(bus, arm_config):
    assert bus.write(BROADCAST_ID, XM["led"], 1).data is None
    assert {s.data for s in bus.sync_read(arm_config.servo_ids, XM["led"]).values()} == {1}


def test_a_silent_servo_times_out_and_does_not_hide_the_others(bus, servos, arm_config):
    bus.ping(3)
    servos.inject(Fault("silent", 3))
    replies = bus.sync_read(arm_config.servo_ids, XM["present_position"])
    assert [id for id, status in replies.items() if status.data is None] == [3]
    before = bus.counters.timeouts
    assert before == 1
    with pytest.raises(BusTimeoutError) as caught:
        bus.read(3, XM["present_position"])
    assert (caught.value.id, caught.value.joint, caught.value.register) == (
        3,
        "joint3",
        "present_position",
    )
    assert caught.value.last_good is not None and caught.value.port == bus.port
    assert bus.counters.timeouts == before + 1
    servos.clear()
    assert bus.read(3, XM["present_position"]).data is not None


def test_an_unknown_id_never_answered(bus):
    with pytest.raises(BusTimeoutError, match="never answered"):
        bus.ping(77)


def test_an_alert_is_information_and_the_data_are_good(bus, servos, arm_config):
    servos.servo(2).inject_error("overload")
    replies = bus.sync_read(arm_config.servo_ids, XM["present_position"])
    assert [id for id, status in replies.items() if status.alert] == [2]
    assert all(status.data is not None for status in replies.values())
    status = bus.read(2, XM["hardware_error_status"])
    assert status.data == 1 << 5 and status.alert
    assert bus.counters.alerts == 2


def test_a_refusal_names_register_and_reason_and_is_not_repeated(bus):
    bus.write(1, XM["torque_enable"], 1)
    retries = bus.counters.retries
    with pytest.raises(ServoRefusedError) as caught:
        bus.write(1, XM["operating_mode"], 3)
    assert (caught.value.id, caught.value.joint, caught.value.code) == (1, "joint1", 7)
    assert "EEPROM" in str(caught.value)
    assert bus.counters.retries == retries


def test_a_value_that_does_not_fit_is_not_sent(bus):
    sent = bus.counters.bytes_sent
    with pytest.raises(ValueError):
        bus.write(1, XM["torque_enable"], 256)
    with pytest.raises(ValueError):
        bus.sync_write(XM["torque_enable"], {1: 0, 2: -1})
    assert bus.counters.bytes_sent == sent


def test_reboot_clears_errors_and_torque(bus, servos):
    bus.write(1, XM["torque_enable"], 1)
    servos.servo(1).inject_error("overheating")
    bus.reboot(1)
    assert bus.read(1, XM["torque_enable"]).data == 0
    assert not bus.read(1, XM["hardware_error_status"]).alert


def test_closed_means_closed(bus):
    bus.close()
    bus.close()
    assert not bus.is_open
    for action in (
        lambda: bus.ping(1),
        lambda: bus.sync_write(XM["led"], {1: 1}),
        bus.broadcast_ping,
    ):
        with pytest.raises(BusNotOpenError):
            action()


def test_open_again_after_close(bus):
    bus.close()
    bus.open()
    bus.open()
    assert bus.ping(1) == XM.number


def test_threads_do_not_mix_their_answers(bus, arm_config):
    wrong = []

    def ask(id: int) -> None:
        for value in range(25):
            bus.write(id, XM["profile_acceleration"], 100 * id + value)
            if bus.read(id, XM["profile_acceleration"]).data != 100 * id + value:
                wrong.append(id)

    threads = [threading.Thread(target=ask, args=(id,)) for id in arm_config.servo_ids[:3]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong and bus.counters.timeouts == 0


@pytest.mark.parametrize("fault", ["corrupt", "truncate", "drop", "garbage"])
def test_on_a_bad_wire_no_value_is_ever_wrong(bus, servos, arm_config, fault):
    goals = {id: -1000 - 111 * id for id in arm_config.servo_ids}
    bus.sync_write(XM["goal_position"], goals)
    servos.reseed(4)
    servos.inject(Fault(fault, value=0.05))
    good = 0
    for _ in range(60):
        for id, status in bus.sync_read(arm_config.servo_ids, XM["goal_position"]).items():
            assert status.data in (goals[id], None)
            good += status.data is not None
    assert good >= 0.97 * 60 * 6
    assert bus.counters.retries > 0 or fault == "garbage"


def test_local_echo_is_not_an_answer(bus, servos, arm_config):
    servos.inject(Fault("echo"))
    assert bus.ping(4) == arm_config.joints[3].servo.table.number
    assert all(
        s.data is not None
        for s in bus.sync_read(arm_config.servo_ids, XM["present_position"]).values()
    )


def test_the_simulated_bus_takes_no_virtual_time(arm_config):
    clock = VirtualClock()
    bus = open_bus("sim", arm_config, virtual_bus=VirtualBus.from_config(arm_config, clock))
    bus.sync_read(arm_config.servo_ids, XM["present_position"])
    assert clock.now() == 0.0
