"""The states of an arm: their order, and that every way out leaves the servos as asked."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik.errors import ArmStateError, HardwareError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.ports import VirtualClock


def test_each_step_needs_the_one_before(arm_config, start):
    arm = open_arm(arm_config, "sim")
    for action in (
        arm.enable,
        arm.read,
        arm.hold,
        lambda: arm.send(start, 0.0),
        lambda: arm.move_to(start),
    ):
        with pytest.raises(ArmStateError):
            action()
    arm.close()
    with arm:
        with pytest.raises(ArmStateError):
            arm.connect()
        for action in (arm.hold, lambda: arm.send(start, 0.0)):
            with pytest.raises(ArmStateError, match="the arm is connected; allowed: enabled, hold"):
                action()
    assert arm.exit_report.done == "untouched"


def test_hold_stays_and_send_goes_on(arm, stream, smooth, start):
    arm.enable()
    stream(arm, smooth(start, start + 0.4, 1.0)[:50])
    arm.hold()
    assert arm.state is ArmState.HOLD
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    here = arm.read().q
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    assert (arm.read().q == here).all()
    stream(arm, [here])
    assert arm.state is ArmState.ENABLED


def test_move_to_arrives_and_says_when_it_cannot(arm):
    arm.enable()
    arm.move_to([0.0] * 6)
    assert arm.state is ArmState.HOLD
    assert np.abs(arm.read().q).max() < 0.01
    arm.bus.virtual_bus.servo(2).stuck = True
    with pytest.raises(HardwareError, match="'joint2' is still"):
        arm.move_to([0.3] * 6)


def test_a_joint_that_cannot_arrive_stops_pressing(arm):
    arm.enable()
    arm.move_to([0.0] * 6)
    arm.bus.virtual_bus.inject(Fault("jammed", joint="joint2"))
    with pytest.raises(HardwareError, match="'joint2' is still"):
        arm.move_to({"joint2": 0.3}, timeout=0.6)
    memory = arm.bus.virtual_bus.servo(2).memory
    assert arm.state is ArmState.HOLD
    assert abs(memory.values["goal_position"] - arm.bus.virtual_bus.servo(2).shaft.reading) < 5


def test_leaving_switches_torque_off_and_verifies_it(any_arm, stream, registers, start):
    any_arm.enable()
    stream(any_arm, [start] * 3)
    any_arm.close()
    any_arm.close()
    assert registers(any_arm, "torque_enable") == [0] * 6
    report = any_arm.exit_report
    assert report.ok and report.done == "torque_off" and report.verified == any_arm.joints
    assert not any_arm.bus.is_open and any_arm.state is ArmState.DISCONNECTED


def test_hold_leaves_torque_on_and_the_next_program_takes_over_without_a_drop(
    arm_config, stream, smooth, registers, start
):
    servos = VirtualBus.from_config(arm_config, VirtualClock(), start=start)
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.2, 0.6))
        arm.clock.sleep_until(arm.clock.now() + 0.1)
    assert arm.exit_report.ok and arm.exit_report.done == "hold"
    assert registers(arm, "torque_enable") == [1] * 6 and registers(arm, "bus_watchdog") == [0] * 6
    assert np.allclose(servos.true_angles(arm_config), start + 0.2, atol=0.01)
    with open_arm(arm_config, "sim", virtual_bus=servos) as again:
        assert registers(again, "torque_enable") == [1] * 6
        again.enable()
        assert registers(again, "torque_enable") == [1] * 6
    assert registers(again, "torque_enable") == [0] * 6


def test_park_goes_back_to_where_it_stood_without_torque(
    arm_config, stream, smooth, registers, start
):
    with open_arm(arm_config, "sim", start=start, on_exit="park") as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.4, 1.0))
    assert arm.exit_report.parked and arm.exit_report.ok and arm.exit_report.done == "torque_off"
    assert np.allclose(arm.bus.virtual_bus.true_angles(arm_config), start, atol=0.01)
    assert registers(arm, "torque_enable") == [0] * 6


def test_a_fault_on_the_way_to_the_park_pose_still_ends_in_torque_off(
    arm_config, stream, registers, start
):
    with open_arm(arm_config, "sim", start=start, on_exit="park", park_at=np.zeros(6)) as arm:
        arm.enable()
        stream(arm, [start])
        arm.bus.virtual_bus.servo(2).inject_error("overload")
    assert arm.exit_report.done == "torque_off" and not arm.exit_report.parked
    assert registers(arm, "torque_enable") == [0] * 6


def test_a_servo_that_does_not_answer_at_the_end_is_reported_once(arm, caplog):
    arm.enable()
    arm.bus.virtual_bus.servo(3).silent = True
    with caplog.at_level("WARNING", logger="robot_ik"):
        arm.close()
    reported = [record.getMessage() for record in caplog.records]
    assert sum("joint3" in text and "no answer" in text for text in reported) == 1, reported
    assert reported[-1].startswith("torque_off not confirmed by joint3")
    assert [s.torque for s in arm.bus.virtual_bus.servos] == [
        False,
        False,
        True,
        False,
        False,
        False,
    ]


def test_without_a_port_nothing_is_tried_and_everybody_is_named(arm, caplog):
    arm.enable()
    arm.bus.close()
    with caplog.at_level("WARNING", logger="robot_ik"):
        arm.close()
    (reported,) = [record.getMessage() for record in caplog.records]
    assert all(name in reported for name in arm.joints) and "cut the power" in reported
