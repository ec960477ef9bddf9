"""An arm with faults: which servo it names, how soon, and what the others do."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot_ik.errors import BusDisconnectedError, BusTimeoutError, MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.faults import Fault


def test_a_silent_servo_is_named_within_a_quarter_second_and_the_others_hold(
    arm, stream, smooth, start
):
    arm.enable()
    stream(arm, [start] * 5)
    arm.bus.virtual_bus.servo(3).silent = True
    begin = arm.clock.now()
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, smooth(start, start + 0.3, 1.0))
    assert arm.clock.now() - begin <= 0.25
    assert caught.value.joint == "joint3" and caught.value.status == ("no_status",)
    assert arm.state is ArmState.FAULT
    arm.clock.sleep_until(arm.clock.now() + 1.0)
    assert [s.torque for s in arm.bus.virtual_bus.servos] == [True] * 6
    sent = arm.bus.counters.bytes_sent
    with pytest.raises(MotorFaultError, match="joint3"):
        arm.send(start, arm.clock.now())  # latched, and nothing is sent
    assert arm.bus.counters.bytes_sent == sent
    reading = arm.read()  # the last good sample, with its age
    assert np.isfinite(reading.q).all() and arm.ages[2] > arm.ages[0] > 0.0
    arm.close()
    assert arm.exit_report.unverified == ("joint3",)
    assert [s.memory.values["torque_enable"] for s in arm.bus.virtual_bus.servos] == [
        0,
        0,
        1,
        0,
        0,
        0,
    ]


def test_a_silent_servo_on_the_wire_is_named_and_leaving_is_quick(
    arm_config, stream, start, real_time
):
    with open_arm(arm_config, "pty", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 5)
        arm.bus.virtual_bus.servo(3).silent = True
        begin = time.monotonic()
        with pytest.raises(MotorFaultError, match="joint3"):
            stream(arm, [start] * 100)
        assert time.monotonic() - begin < 8.0  # 0.2 s on an idle machine
        begin = time.monotonic()
        arm.close()
        assert time.monotonic() - begin < 10.0  # 0.5 s
        assert arm.exit_report.verified == ("joint1", "joint2", "joint4", "joint5", "joint6")


def test_a_silent_servo_is_noticed_in_a_slow_loop_too(arm, start):
    arm.enable()
    arm.bus.virtual_bus.servo(3).silent = True
    with pytest.raises(MotorFaultError, match="joint3"):
        for k in range(6):
            arm.clock.sleep_until(arm.clock.now() + 0.2)
            arm.send(start, 0.2 * k)


def test_one_lost_answer_is_no_fault(arm, stream, start):
    arm.enable()
    for k in range(60):
        arm.bus.virtual_bus.servo(3).silent = k % 10 < 2
        stream(arm, [start])
    assert arm.state is ArmState.ENABLED and arm.bus.counters.timeouts == 12


def test_silence_of_all_servos_is_reported(arm, arm_config, stream, start):
    arm.enable()
    stream(arm, [start] * 3)
    arm.bus.virtual_bus.inject(Fault("silent"))
    with pytest.raises(BusTimeoutError, match="no servo answers"):
        stream(arm, [start] * 100)
    begin = arm.clock.now()
    arm.close()
    assert len(arm.exit_report.unverified) == 6
    # By the arm's own clock, so that equal runs on virtual time ask equally often.
    assert 1.0 <= arm.clock.now() - begin <= 1.2


def test_a_fault_of_all_servos_does_not_contradict_how_the_arm_is_left(arm, stream, start):
    arm.enable()
    stream(arm, [start] * 3)
    arm.bus.virtual_bus.inject(Fault("silent"))
    with pytest.raises(BusTimeoutError) as caught:
        stream(arm, [start] * 100)
    arm.bus.virtual_bus.clear("silent")  # they hear again what leaving says
    arm.close()
    assert arm.exit_report.text == "torque is off"
    assert (
        "stays" not in str(caught.value) and "hears nothing keeps its torque" in caught.value.hint
    )


@pytest.mark.parametrize("error", ["overload", "overheating", "electrical_shock", "input_voltage"])
def test_a_servo_that_shuts_down_is_seen_in_the_same_cycle_with_its_cause(
    any_arm, error, stream, start
):
    any_arm.enable()
    stream(any_arm, [start] * 3)
    any_arm.bus.virtual_bus.servo(6).inject_error(error)
    with pytest.raises(MotorFaultError) as caught:
        stream(any_arm, [start])
    assert caught.value.joint == "joint6" and caught.value.status == (error,)
    assert any_arm.state is ArmState.FAULT and any_arm.fault is caught.value
    assert [s.torque for s in any_arm.bus.virtual_bus.servos][:5] == [True] * 5


def test_a_servo_that_restarts_by_itself_is_noticed_and_not_enabled_blindly(
    arm, stream, smooth, start
):
    arm.enable()
    stream(arm, [start] * 3)
    arm.bus.virtual_bus.servo(2).reboot()
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, smooth(start, start + 0.5, 1.0))
    assert caught.value.joint == "joint2" and caught.value.status == ("torque_lost",)
    assert not arm.bus.virtual_bus.servo(2).torque


def test_a_stuck_servo_is_read_where_it_stands(arm, stream, smooth, start):
    arm.enable()
    arm.bus.virtual_bus.servo(4).stuck = True
    stream(arm, smooth(start, start + 0.3, 1.0))
    away = np.abs(arm.read().q - start - 0.3)
    assert away[3] == pytest.approx(0.3, abs=0.002) and np.delete(away, 3).max() < 0.02


def test_a_pulled_cable_is_a_fault_and_leaving_does_not_raise(arm_config, stream, start, real_time):
    with open_arm(arm_config, "pty", start=start) as arm:
        arm.enable()
        arm.bus._pty.close()
        with pytest.raises(BusDisconnectedError):
            stream(arm, [start] * 3)
        assert arm.state is ArmState.FAULT
    assert arm.state is ArmState.DISCONNECTED and len(arm.exit_report.unverified) == 6
    # The bus watchdog is what is left: the shafts stand.
    time.sleep(0.3)
    assert all(s.tripped or s.torque for s in arm.bus.virtual_bus.servos)


def test_an_arm_can_be_connected_again_after_a_fault(arm, stream, start):
    arm.enable()
    arm.bus.virtual_bus.servo(1).inject_error("overload")
    with pytest.raises(MotorFaultError):
        stream(arm, [start] * 2)
    arm.close()
    arm.bus.virtual_bus.servo(1).reboot()
    arm.connect()
    arm.enable()
    stream(arm, [start] * 2)
    assert arm.state is ArmState.ENABLED
