"""The arm: what it refuses, how it moves, what it notices, how it is left."""

from __future__ import annotations

import dataclasses
import math
import time
from types import SimpleNamespace

import numpy as np
import pytest

from robot_ik.errors import (
    ArmStateError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    ConfigError,
    HardwareError,
    MotorFaultError,
    ServoMismatchError,
    UnsafeCommandError,
)
from robot_ik.hardware import BUSES, open_arm
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.control_table import CONTROL_TABLES, OperatingMode
from robot_ik.hardware.startup import shared_register
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Faults
from robot_ik.ports import JointSink, JointSource, RealClock, VirtualClock

START = np.array([0.1, 0.2, 0.3, -0.4, 0.5, 0.6])
DT = 0.01
VIRTUAL = [row.name for row in BUSES.values() if row.virtual]


@pytest.fixture(params=VIRTUAL)
def any_arm(request, arm_config):
    with open_arm(arm_config, request.param, start=START) as arm:
        yield arm


@pytest.fixture
def arm(arm_config):
    """In process, on virtual time."""
    with open_arm(arm_config, "sim", start=START) as arm:
        yield arm


def registers(arm: Arm, name: str) -> list[int]:
    """Straight from the servos' memories: not over the bus under test."""
    return [servo.memory.get(name) for servo in arm.virtual_bus.servos]


def stream(arm: Arm, commands) -> None:
    begin = arm.clock.now()
    for k, q in enumerate(commands):
        now = begin + (k + 1) * DT
        arm.clock.sleep_until(now)
        arm.send(q, now)


def smooth(start, end, seconds):
    """A quintic from rest to rest: another motion law than anything in the arm."""
    s = np.linspace(0, 1, round(seconds / DT))
    return start + np.outer(10 * s**3 - 15 * s**4 + 6 * s**5, np.asarray(end) - start)


# ------------------------------------------------------------------------------ coming up


def test_it_is_a_sink_and_a_source(any_arm):
    assert isinstance(any_arm, JointSink) and isinstance(any_arm, JointSource)
    assert any_arm.joints == tuple(f"joint{k}" for k in range(1, 7))


def test_connect_sets_the_servos_up_and_gives_no_torque(any_arm, arm_config):
    assert any_arm.state is ArmState.CONNECTED
    assert registers(any_arm, "torque_enable") == [0] * 6
    assert registers(any_arm, "return_delay_time") == [0] * 6
    assert registers(any_arm, "operating_mode") == [OperatingMode.EXTENDED_POSITION] * 6
    for joint, units in zip(arm_config.joints, registers(any_arm, "profile_velocity"), strict=True):
        speed = units * 0.229 * 2 * math.pi / 60 / joint.ratio  # rad/s at the joint
        assert 1.2 * joint.velocity < speed < 2 * joint.velocity  # room to catch up, yet bounded
    assert np.allclose(any_arm.read().q, START, atol=0.6 * any_arm.resolution.max())


def test_eeprom_is_not_written_again_when_it_is_right(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    with open_arm(arm_config, "sim", virtual_bus=servos):
        pass
    written = []
    for servo in servos.servos:
        original = servo.write
        servo.write = lambda address, data, w=original: (written.append(address), w(address, data))[1]
    with open_arm(arm_config, "sim", virtual_bus=servos):
        pass
    assert written and min(written) >= 64


def test_enable_moves_nothing_and_arms_the_watchdog(any_arm, arm_config):
    for servo in any_arm.virtual_bus.servos:
        servo.memory.set("goal_position", 5000)  # a stale goal of an earlier program
    before = any_arm.virtual_bus.true_angles(arm_config)
    any_arm.enable()
    any_arm.clock.sleep_until(any_arm.clock.now() + 0.05)
    assert registers(any_arm, "torque_enable") == [1] * 6
    assert registers(any_arm, "bus_watchdog") == [10] * 6
    assert np.allclose(any_arm.virtual_bus.true_angles(arm_config), before, atol=any_arm.resolution.max())


def test_a_missing_and_a_wrong_servo_are_refused_with_a_table(arm_config):
    joints = list(arm_config.joints)
    joints[1] = dataclasses.replace(joints[1], id=9)
    joints[3] = dataclasses.replace(joints[3], model="XM430-W350")
    wanted = dataclasses.replace(arm_config, joints=tuple(joints))
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    arm = open_arm(wanted, "sim", virtual_bus=servos)
    with pytest.raises(ServoMismatchError) as caught:
        arm.connect()
    assert caught.value.expected[9] == "joint2: XM430-W350" and 9 not in caught.value.found
    assert caught.value.found[2] == "XM430-W350"  # there is one with an id nobody named
    assert caught.value.found[4] == "XL430-W250" and caught.value.expected[4] == "joint4: XM430-W350"
    assert "missing" in str(caught.value)
    assert arm.state is ArmState.DISCONNECTED and not arm.bus.is_open
    assert not any(servo.torque for servo in servos.servos)


def test_nobody_there_points_at_power_and_baud_rate(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.set_faults(Faults(silent=frozenset(arm_config.ids)))
    with pytest.raises(ServoMismatchError, match="power"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()


@pytest.mark.parametrize("level", [0, 1])
def test_a_servo_told_not_to_answer_is_told_to(arm_config, level):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(3).memory.set("status_return_level", level)
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        assert registers(arm, "status_return_level") == [2] * 6


def test_a_watchdog_that_tripped_before_is_cleared(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(2).memory.set("bus_watchdog", -1)
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, smooth(np.zeros(6), [0.1] * 6, 0.5))
        assert np.allclose(arm.read().q, 0.1, atol=0.01)


def test_a_hardware_error_left_from_before_is_named(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(5).inject_error("overheating")
    with pytest.raises(MotorFaultError) as caught:
        open_arm(arm_config, "sim", virtual_bus=servos).connect()
    assert caught.value.joint == "joint5" and caught.value.status == ("overheating",)


def test_a_wrong_supply_is_refused(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).memory.set("present_input_voltage", 50)
    with pytest.raises(MotorFaultError, match=r"5\.0 V") as caught:
        open_arm(arm_config, "sim", virtual_bus=servos).connect()
    assert caught.value.status == ("input_voltage",)


def test_a_servo_that_reverses_by_itself_is_refused(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).memory.set("drive_mode", 1)
    with pytest.raises(HardwareError, match="reverse"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()


def test_lost_turns_are_refused_before_torque(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).turn_by_hand(2 * 4096)
    with (
        open_arm(arm_config, "sim", virtual_bus=servos) as arm,
        pytest.raises(HardwareError, match="half a servo turn outside"),
    ):
        arm.enable()
    assert not any(servo.torque for servo in servos.servos)


def test_a_servo_that_refuses_torque_is_named_and_all_are_off(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        servos.servo(4).inject_error("overload")
        with pytest.raises(MotorFaultError) as caught:
            arm.enable()
        assert caught.value.joint == "joint4" and caught.value.status == ("overload",)
        assert registers(arm, "torque_enable") == [0] * 6
        assert arm.state is ArmState.CONNECTED


def test_mode_with_torque_on_asks_before_it_lets_the_arm_drop(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servo = servos.servo(2)
    servo.memory.set("operating_mode", OperatingMode.POSITION)
    servo.memory.set("torque_enable", 1)
    with pytest.raises(ArmStateError, match="torque is on"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()
    assert servo.torque


def test_one_turn_limits_of_the_servo_narrower_than_the_file_are_an_error(arm_config):
    joints = (dataclasses.replace(arm_config.joints[0], mode=OperatingMode.POSITION), *arm_config.joints[1:])
    config = dataclasses.replace(arm_config, joints=joints)
    servos = VirtualBus.from_config(config, VirtualClock())
    with open_arm(config, "sim", virtual_bus=servos):
        pass
    servos.servo(1).memory.set("max_position_limit", 3000)
    with pytest.raises(ConfigError, match="narrower"):
        open_arm(config, "sim", virtual_bus=servos).connect()


# ---------------------------------------------------------------------------------- moving


def test_a_trajectory_within_the_caps_arrives_unchanged(any_arm, arm_config):
    any_arm.enable()
    start, end = any_arm.read().q, np.array([0.5, -0.2, 0.6, 0.1, 0.9, 0.2])
    stream(any_arm, smooth(start, end, 1.0))
    stream(any_arm, [end] * 30)  # so that it arrives even where this machine stalled on the way
    assert not any_arm.reports.clipped
    assert (np.abs(any_arm.read().q - end) <= 1.5 * any_arm.resolution).all()
    assert (np.abs(any_arm.virtual_bus.true_angles(arm_config) - end) <= 1.5 * any_arm.resolution).all()
    assert any_arm.bus.counters.timeouts == 0
    if any_arm.bus.port == "sim":  # where time is exact, a shaft is where it was told to be a cycle ago
        assert any_arm.reports.largest_tracking_error.max() < 0.01
        assert not any_arm.reports.capped


def test_one_send_is_one_write_and_one_read(arm):
    arm.enable()
    before = dataclasses.replace(arm.bus.counters)
    stream(arm, [START] * 10)
    after = arm.bus.counters
    assert after.cycles - before.cycles == 10
    # sync write 14 + 6 x 5 bytes, sync read 14 + 6; answers 6 x 15
    assert after.bytes_sent - before.bytes_sent == 10 * (44 + 20)
    arm.read()
    assert arm.bus.counters.cycles == after.cycles  # the read of the same cycle costs nothing
    arm.clock.sleep_until(arm.clock.now() + DT)
    arm.read()
    assert arm.bus.counters.cycles == before.cycles + 11


@pytest.mark.parametrize(
    "bad",
    [[math.nan] * 6, [0.0] * 5, [0.0, 0, 0, 0, 0, math.inf], {"elbow": 0.1}, None, [["0"] * 6]],
    ids=repr,
)
def test_what_must_not_be_obeyed_sends_not_one_byte(any_arm, bad):
    any_arm.enable()
    any_arm.send(START, any_arm.clock.now())
    sent = any_arm.bus.counters.bytes_sent
    for _ in range(2):
        with pytest.raises(UnsafeCommandError):
            any_arm.send(bad, any_arm.clock.now())
    with pytest.raises(UnsafeCommandError):
        any_arm.send(START, math.nan)
    assert any_arm.bus.counters.bytes_sent == sent
    assert any_arm.state is ArmState.ENABLED
    any_arm.send(START, any_arm.clock.now() + DT)  # and the arm goes on


def test_joints_by_name(arm):
    arm.enable()
    stream(arm, [{"joint2": 0.21}] * 20)
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    wanted = START.copy()
    wanted[1] = 0.21
    assert np.allclose(arm.read().q, wanted, atol=1.5 * arm.resolution.max())


def test_beyond_the_limits_is_clipped_and_reported_by_name(arm, arm_config):
    arm.enable()
    q = START.copy()
    q[2] = 9.0
    stream(arm, [q] * 300)
    assert arm.reports.clipped == {"joint3": 300} and "joint3" in arm.reports.capped
    assert arm.read().q[2] == pytest.approx(arm.upper[2], abs=1.5 * arm.resolution[2])
    goals = registers(arm, "goal_position")
    assert all(
        j.ticks_range[0] <= g <= j.ticks_range[1] for j, g in zip(arm_config.joints, goals, strict=True)
    )


def test_a_jump_is_walked(arm, arm_config):
    """Position sampled from the shafts, not from what the arm says."""
    arm.enable()
    positions = [arm.virtual_bus.true_angles(arm_config)]
    for _ in range(250):
        stream(arm, [START - 1.0])
        positions.append(arm.virtual_bus.true_angles(arm_config))
    speed = np.abs(np.diff(positions, axis=0)) / DT
    assert (speed <= 1.6 * arm_config.velocity).all()  # the servo's own profile: the last word
    assert np.convolve(speed[:, 0], np.ones(10) / 10, "valid").max() <= 1.02 * arm_config.velocity[0]
    assert np.allclose(positions[-1], START - 1.0, atol=0.01)


def test_a_start_outside_the_limits_is_walked_back(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).turn_by_hand(arm_config.joints[0].to_ticks(arm_config.upper[0] + 0.3) - 2048)
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        q = arm.read().q
        assert q[0] > arm.upper[0] + 0.29  # measured, not clipped
        stream(arm, [q] * 3)
        assert arm.read().q[0] > arm.upper[0] + 0.28  # no jump
        stream(arm, [q] * 100)
        assert arm.read().q[0] == pytest.approx(arm.upper[0], abs=2 * arm.resolution[0])


def test_sending_the_same_time_again_does_not_outrun_the_caps(arm, arm_config):
    arm.enable()
    for _ in range(500):
        arm.send(START + 0.5, 1.0)
    goals = [j.to_radians(g) for j, g in zip(arm_config.joints, registers(arm, "goal_position"), strict=True)]
    assert np.abs(goals - START).max() < 0.01


def test_after_a_pause_the_tripped_watchdog_is_cleared_and_the_arm_goes_on(arm):
    arm.enable()
    stream(arm, smooth(START, START + 0.1, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 5.0)
    assert all(servo.torque for servo in arm.virtual_bus.servos)
    assert registers(arm, "bus_watchdog") == [-1] * 6
    stream(arm, smooth(START + 0.1, START + 0.2, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    assert np.allclose(arm.read().q, START + 0.2, atol=0.01)
    assert registers(arm, "bus_watchdog") == [10] * 6


def test_a_read_after_a_pause_does_not_hide_the_tripped_watchdog(arm):
    arm.enable()
    arm.clock.sleep_until(arm.clock.now() + 5.0)
    arm.read()
    stream(arm, smooth(START, START + 0.1, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 0.05)
    assert np.allclose(arm.read().q, START + 0.1, atol=0.01)


def test_a_stall_inside_a_cycle_is_noticed_as_well(arm):
    """The process is suspended after the arm has looked at the time and before its packet is out."""
    arm.enable()
    stream(arm, [START] * 3)
    original = arm.bus.sync_write

    def stalled(register, values):
        arm.clock.sleep_until(arm.clock.now() + 0.3)
        original(register, values)

    arm.bus.sync_write = stalled
    stream(arm, [START])
    arm.bus.sync_write = original
    stream(arm, [START])
    assert registers(arm, "bus_watchdog") == [10] * 6
    stream(arm, smooth(START, START + 0.1, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 0.05)
    assert np.allclose(arm.read().q, START + 0.1, atol=0.01)


def test_a_silent_servo_is_noticed_in_a_slow_loop_too(arm):
    arm.enable()
    arm.virtual_bus.servo(3).silent = True
    with pytest.raises(MotorFaultError, match="joint3"):
        for k in range(6):
            arm.clock.sleep_until(arm.clock.now() + 0.2)
            arm.send(START, 0.2 * k)


def test_hold_stays_and_send_goes_on(arm):
    arm.enable()
    stream(arm, smooth(START, START + 0.4, 1.0)[:50])
    arm.hold()
    assert arm.state is ArmState.HOLD
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    here = arm.read().q
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    assert (arm.read().q == here).all()
    stream(arm, [here])
    assert arm.state is ArmState.ENABLED


def test_park_arrives_and_says_when_it_cannot(arm):
    arm.enable()
    arm.park([0.0] * 6)
    assert arm.state is ArmState.HOLD
    assert np.abs(arm.read().q).max() < 0.01
    arm.virtual_bus.servo(2).stuck = True
    with pytest.raises(HardwareError, match="'joint2' is still"):
        arm.park([0.3] * 6)


# ---------------------------------------------------------------------------------- faults


def test_a_silent_servo_is_named_within_a_quarter_second_and_the_others_hold(arm):
    arm.enable()
    stream(arm, [START] * 5)
    arm.virtual_bus.servo(3).silent = True
    begin = arm.clock.now()
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, smooth(START, START + 0.3, 1.0))
    assert arm.clock.now() - begin <= 0.25
    assert caught.value.joint == "joint3" and caught.value.status == ("no_status",)
    assert arm.state is ArmState.FAULT
    arm.clock.sleep_until(arm.clock.now() + 1.0)
    assert [s.torque for s in arm.virtual_bus.servos] == [True] * 6
    sent = arm.bus.counters.bytes_sent
    with pytest.raises(MotorFaultError, match="joint3"):
        arm.send(START, arm.clock.now())  # latched, and nothing is sent
    assert arm.bus.counters.bytes_sent == sent
    reading = arm.read()  # the last good sample, with its age
    assert np.isfinite(reading.q).all() and arm.ages[2] > arm.ages[0] > 0.0
    arm.close()
    assert arm.exit_report.unverified == ("joint3",)
    assert [s.memory.get("torque_enable") for s in arm.virtual_bus.servos] == [0, 0, 1, 0, 0, 0]


def test_a_silent_servo_on_the_wire_is_named_and_leaving_is_quick(arm_config):
    with open_arm(arm_config, "pty", start=START) as arm:
        arm.enable()
        stream(arm, [START] * 5)
        arm.virtual_bus.servo(3).silent = True
        begin = time.monotonic()
        with pytest.raises(MotorFaultError, match="joint3"):
            stream(arm, [START] * 100)
        assert time.monotonic() - begin < 8.0  # 0.2 s on an idle machine
        begin = time.monotonic()
        arm.close()
        assert time.monotonic() - begin < 10.0  # 0.5 s
        assert arm.exit_report.verified == ("joint1", "joint2", "joint4", "joint5", "joint6")


def test_one_lost_answer_is_no_fault(arm):
    arm.enable()
    for k in range(60):
        arm.virtual_bus.servo(3).silent = k % 10 < 2
        stream(arm, [START])
    assert arm.state is ArmState.ENABLED and arm.bus.counters.timeouts == 12


def test_all_silent_is_said_as_such(arm, arm_config):
    arm.enable()
    stream(arm, [START] * 3)
    arm.virtual_bus.set_faults(Faults(silent=frozenset(arm_config.ids)))
    with pytest.raises(BusTimeoutError, match="no servo answers"):
        stream(arm, [START] * 100)
    begin = time.monotonic()
    arm.close()
    assert time.monotonic() - begin < 2.0 and len(arm.exit_report.unverified) == 6


@pytest.mark.parametrize("error", ["overload", "overheating", "electrical_shock", "input_voltage"])
def test_a_servo_that_shuts_down_is_seen_in_the_same_cycle_with_its_cause(any_arm, error):
    any_arm.enable()
    stream(any_arm, [START] * 3)
    any_arm.virtual_bus.servo(6).inject_error(error)
    with pytest.raises(MotorFaultError) as caught:
        stream(any_arm, [START])
    assert caught.value.joint == "joint6" and caught.value.status == (error,)
    assert any_arm.state is ArmState.FAULT and any_arm.fault is caught.value
    assert [s.torque for s in any_arm.virtual_bus.servos][:5] == [True] * 5


def test_a_servo_that_restarts_by_itself_is_noticed_and_not_enabled_blindly(arm):
    arm.enable()
    stream(arm, [START] * 3)
    arm.virtual_bus.servo(2).reboot()
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, smooth(START, START + 0.5, 1.0))
    assert caught.value.joint == "joint2" and caught.value.status == ("torque_lost",)
    assert not arm.virtual_bus.servo(2).torque


def test_a_stuck_servo_shows_as_tracking_error(arm):
    arm.enable()
    arm.virtual_bus.servo(4).stuck = True
    stream(arm, smooth(START, START + 0.3, 1.0))
    error = arm.reports.largest_tracking_error
    assert error[3] == pytest.approx(0.3, abs=0.01) and np.delete(error, 3).max() < 0.02
    assert arm.read().q[3] == pytest.approx(START[3], abs=0.002)


def test_a_pulled_cable_is_a_fault_and_leaving_does_not_raise(arm_config):
    with open_arm(arm_config, "pty", start=START) as arm:
        arm.enable()
        arm.bus._pty.close()
        with pytest.raises(BusDisconnectedError):
            stream(arm, [START] * 3)
        assert arm.state is ArmState.FAULT
    assert arm.state is ArmState.DISCONNECTED and len(arm.exit_report.unverified) == 6
    # The bus watchdog is what is left: the shafts stand.
    time.sleep(0.3)
    assert all(s._tripped or s.torque for s in arm.virtual_bus.servos)


def test_an_arm_can_be_connected_again_after_a_fault(arm):
    arm.enable()
    arm.virtual_bus.servo(1).inject_error("overload")
    with pytest.raises(MotorFaultError):
        stream(arm, [START] * 2)
    arm.close()
    arm.virtual_bus.servo(1).reboot()
    arm.connect()
    arm.enable()
    stream(arm, [START] * 2)
    assert arm.state is ArmState.ENABLED


# ------------------------------------------------------------------------ states and leaving


def test_each_step_needs_the_one_before(arm_config):
    arm = open_arm(arm_config, "sim")
    for action in (arm.enable, arm.read, arm.hold, lambda: arm.send(START, 0.0), lambda: arm.park(START)):
        with pytest.raises(ArmStateError):
            action()
    arm.close()
    with arm:
        with pytest.raises(ArmStateError):
            arm.connect()
        for action in (arm.hold, lambda: arm.send(START, 0.0)):
            with pytest.raises(ArmStateError, match="connected, not enabled"):
                action()
    assert arm.exit_report.done == "untouched"


def test_leaving_switches_torque_off_and_verifies_it(any_arm):
    any_arm.enable()
    stream(any_arm, [START] * 3)
    any_arm.close()
    any_arm.close()
    assert registers(any_arm, "torque_enable") == [0] * 6
    report = any_arm.exit_report
    assert report.ok and report.done == "torque_off" and report.verified == any_arm.joints
    assert not any_arm.bus.is_open and any_arm.state is ArmState.DISCONNECTED


def test_hold_leaves_torque_on_and_the_next_program_takes_over_without_a_drop(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock(), start=START)
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, smooth(START, START + 0.2, 0.6))
        arm.clock.sleep_until(arm.clock.now() + 0.1)
    assert arm.exit_report.ok and arm.exit_report.done == "hold"
    assert registers(arm, "torque_enable") == [1] * 6 and registers(arm, "bus_watchdog") == [0] * 6
    assert np.allclose(servos.true_angles(arm_config), START + 0.2, atol=0.01)
    with open_arm(arm_config, "sim", virtual_bus=servos) as again:
        assert registers(again, "torque_enable") == [1] * 6
        again.enable()
        assert registers(again, "torque_enable") == [1] * 6
    assert registers(again, "torque_enable") == [0] * 6


def test_park_goes_back_to_where_it_stood_without_torque(arm_config):
    with open_arm(arm_config, "sim", start=START, on_exit="park") as arm:
        arm.enable()
        stream(arm, smooth(START, START + 0.4, 1.0))
    assert arm.exit_report.parked and arm.exit_report.ok and arm.exit_report.done == "torque_off"
    assert np.allclose(arm.virtual_bus.true_angles(arm_config), START, atol=0.01)
    assert registers(arm, "torque_enable") == [0] * 6


def test_a_fault_on_the_way_to_the_park_pose_still_ends_in_torque_off(arm_config):
    with open_arm(arm_config, "sim", start=START, on_exit="park", park_at=np.zeros(6)) as arm:
        arm.enable()
        stream(arm, [START])
        arm.virtual_bus.servo(2).inject_error("overload")
    assert arm.exit_report.done == "torque_off" and not arm.exit_report.parked
    assert registers(arm, "torque_enable") == [0] * 6


def test_an_unknown_policy_and_servos_for_a_real_port_are_refused(arm_config):
    with pytest.raises(ConfigError, match="torque_off, hold, park"):
        open_arm(arm_config, "sim", on_exit="drop")
    with pytest.raises(ValueError, match="real port"):
        open_arm(arm_config, "/dev/ttyUSB0", virtual_bus=VirtualBus.from_config(arm_config, RealClock()))
    with pytest.raises(BusNotOpenError):
        open_arm(arm_config, "/dev/no_such_port").connect()


def test_models_with_another_layout_cannot_share_a_cycle():
    here = CONTROL_TABLES["XM430-W350"]["goal_position"]
    there = dataclasses.replace(here, address=30)
    joints = [SimpleNamespace(model=m, table={"goal_position": r}) for m, r in (("A", here), ("B", there))]
    with pytest.raises(ConfigError, match="elsewhere in B than in A"):
        shared_register(SimpleNamespace(joints=joints, file=None, name="arm"), "goal_position")
