"""An SO-101 arm of virtual STS3215 servos: set-up, motion, faults, exit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from robot_ik.errors import ConfigError, MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import StopAt
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.ports import VirtualClock

CONFIG = ArmConfig.load("so101")
IDS = CONFIG.servo_ids


@pytest.fixture
def arm():
    opened = open_arm(CONFIG, "sim", on_exit="torque_off")
    with opened:
        yield opened


def servo(arm, joint):
    return arm.bus.virtual_bus.servo(joint)


def drive(arm, q, seconds):
    end = arm.clock.now() + seconds
    while arm.clock.now() < end:
        arm.send(q, arm.clock.now())
        arm.clock.sleep_until(arm.clock.now() + 0.01)


def test_connect_sets_up_and_saves_only_what_differs(arm):
    for joint in CONFIG.joints:
        values = servo(arm, joint.name).values
        assert values["return_delay_time"] == 0
        assert values["lock"] == 1
        assert values["position_p_gain"] == 16
        assert values["goal_velocity"] > 0
        assert not servo(arm, joint.name).torque
    servo(arm, "elbow_flex").power_cycle()
    assert servo(arm, "elbow_flex").values["return_delay_time"] == 0, "it was written while locked"


def test_a_move_arrives_and_leaving_switches_torque_off(arm):
    arm.enable()
    target = np.radians([20.0, -15.0, 10.0, 30.0, -40.0, 20.0])
    arm.move_to(target)
    assert np.abs(arm.read().q - target).max() < math.radians(0.3)
    arm.close()
    assert arm.exit_report.ok
    assert not any(s.torque for s in arm.bus.virtual_bus.servos)


def test_the_gripper_is_the_sixth_joint():
    assert [joint.name for joint in CONFIG.joints][-1] == "gripper"
    assert [s.id for joint in CONFIG.joints for s in joint.servos] == list(IDS)


def test_enable_starts_from_where_the_arm_stands(arm):
    """Goal Position is 0 after power-on; it must be the present position before torque."""
    before = [s.encoder for s in arm.bus.virtual_bus.servos]
    arm.enable()
    drive(arm, arm.read().q, 0.2)
    assert [s.encoder for s in arm.bus.virtual_bus.servos] == pytest.approx(before, abs=2)


def test_an_overload_stops_the_arm_and_names_the_joint(arm):
    arm.enable()
    here = arm.read().q
    servo(arm, "elbow_flex").jammed = True
    away = here + np.radians([0, 0, 20, 0, 0, 0])
    with pytest.raises(MotorFaultError) as fault:
        drive(arm, away, 6.0)
    assert fault.value.joint == "elbow_flex"
    assert fault.value.status[0] in ("overload", "load_limit")


def test_a_blocked_joint_stops_the_arm_before_its_servo_is_overloaded(arm):
    """Every goal ends an overload, so load_percent in [joints.stop_at] takes its place."""
    arm.enable()
    here = arm.read().q
    servo(arm, "elbow_flex").jammed = True
    begin = arm.clock.now()
    with pytest.raises(MotorFaultError) as fault:
        drive(arm, here + np.radians([0, 0, 20, 0, 0, 0]), 6.0)
    assert fault.value.joint == "elbow_flex"
    assert fault.value.status == ("load_limit",)
    overload_time = 0.01 * servo(arm, "elbow_flex").values["protection_time"]
    assert arm.clock.now() - begin < overload_time
    assert all(s.torque for s in arm.bus.virtual_bus.servos)


def test_a_joint_without_a_load_threshold_is_reported(caplog):
    joints = tuple(replace(joint, stop_at=StopAt()) for joint in CONFIG.joints[:1])
    config = replace(CONFIG, joints=joints + CONFIG.joints[1:])
    with caplog.at_level("WARNING"), open_arm(config, "sim"):
        pass
    assert "shoulder_pan: without load_percent" in caplog.text
    caplog.clear()
    with caplog.at_level("WARNING"), open_arm(CONFIG, "sim"):
        pass
    assert "load_percent" not in caplog.text


def test_the_load_lag_follows_from_the_gain():
    """Rhoban/bam measured 0.166 of the full duty cycle for each rad and count, up to 0.97."""
    family = CONFIG.family
    for gain in (16, 32):
        measured = 0.97 / 0.166 / gain * 4096 / (2.0 * math.pi)
        assert family.load_lag(gain) == pytest.approx(measured, rel=0.03)
    assert family.load_lag(0) == 0.0


def test_a_fault_sends_no_goal_to_a_servo_without_torque(arm):
    """A goal switches torque on: a servo that lost its torque must stay limp."""
    arm.enable()
    here = arm.read().q
    drive(arm, here, 0.1)
    servo(arm, "wrist_flex").power_cycle()
    with pytest.raises(MotorFaultError) as fault:
        arm.send(here, arm.clock.now())
        for _ in range(20):
            arm.clock.sleep_until(arm.clock.now() + 0.01)
            arm.send(here, arm.clock.now())
    assert fault.value.joint == "wrist_flex"


def test_a_silent_servo_is_a_fault_and_the_others_hold(arm):
    arm.enable()
    here = arm.read().q
    drive(arm, here, 0.1)
    servo(arm, "wrist_roll").silent = True
    with pytest.raises(MotorFaultError) as fault:
        drive(arm, here, 2.0)
    assert fault.value.joint == "wrist_roll"


def test_servos_that_answer_no_writes_are_set_right():
    clock = VirtualClock()
    bus = VirtualBus.from_config(CONFIG, clock)
    bus.servo("gripper").values["status_return_level"] = 0
    with open_arm(CONFIG, "sim", virtual_bus=bus):
        assert bus.servo("gripper").values["status_return_level"] == 1


def test_limits_of_the_servo_that_cut_the_range_are_refused():
    bus = VirtualBus.from_config(CONFIG, VirtualClock())
    bus.servo("elbow_flex").values["min_position_limit"] = 2000
    with pytest.raises(ConfigError, match="narrower"), open_arm(CONFIG, "sim", virtual_bus=bus):
        pass


def test_a_bus_watchdog_is_refused():
    with pytest.raises(ConfigError, match="no bus watchdog"):
        replace(CONFIG, watchdog_ms=400)


def test_only_bit_4_of_phase_is_cleared():
    bus = VirtualBus.from_config(CONFIG, VirtualClock())
    servo = bus.servo("wrist_roll")
    servo.set_register("phase", 12 | 1 << 4 | 1 << 7)
    with open_arm(CONFIG, "sim", virtual_bus=bus):
        assert servo.values["phase"] == 12 | 1 << 7


def test_a_12_volt_servo_is_judged_by_its_own_limits():
    bus = VirtualBus.from_config(CONFIG, VirtualClock())
    for servo in bus.servos:
        servo.set_supply(12.0)
        servo.set_register("max_voltage_limit", 140)
    with open_arm(CONFIG, "sim", virtual_bus=bus) as arm:
        arm.enable()
    bus.servo("gripper").set_register("max_voltage_limit", 80)
    with (
        pytest.raises(MotorFaultError, match="input_voltage"),
        open_arm(CONFIG, "sim", virtual_bus=bus),
    ):
        pass


def test_the_gripper_presses_with_its_current_limit(arm):
    gripper = servo(arm, "gripper")
    assert gripper.values["protection_current"] == int(1250 / 6.5)
    assert gripper.values["torque_limit"] == 500
    arm.enable()
    gripper.jammed = True
    arm.send(dict(gripper=math.radians(20.0)), arm.clock.now())
    drive(arm, arm.read().q, 0.1)
    assert servo(arm, "elbow_flex").values["torque_limit"] == 1000


def test_a_restarted_gripper_gets_its_current_limit_back(arm):
    arm.enable()
    servo(arm, "gripper").power_cycle()
    here = arm.read().q
    with pytest.raises(MotorFaultError):
        drive(arm, here, 0.5)
    arm.reset_fault()
    arm.enable()
    assert servo(arm, "gripper").values["torque_limit"] == 500


def test_a_latched_overload_keeps_the_arm_in_fault_until_a_power_cycle(arm):
    arm.bus.virtual_bus.inject(Fault("latched_overload"))
    arm.enable()
    here = arm.read().q.copy()
    elbow = servo(arm, "elbow_flex")
    elbow.jammed = True
    away = here.copy()
    away[2] += math.radians(20.0)
    with pytest.raises(MotorFaultError):
        drive(arm, away, 6.0)
    elbow.inject_error("overload")
    elbow.jammed = False
    with pytest.raises(MotorFaultError, match="overload"):
        arm.reset_fault()
    elbow.power_cycle()
    arm.reset_fault()
    arm.enable()
    drive(arm, arm.read().q, 0.2)


@pytest.mark.parametrize("enables", [True, False])
def test_the_arm_does_not_depend_on_whether_a_goal_enables_torque(enables):
    bus = VirtualBus.from_config(CONFIG, VirtualClock())
    if not enables:
        bus.inject(Fault("goal_keeps_torque"))
    with open_arm(CONFIG, "sim", virtual_bus=bus, on_exit="torque_off") as arm:
        arm.enable()
        assert all(s.torque for s in bus.servos)
        target = arm.read().q.copy()
        target[0] += 0.3
        arm.move_to(target)
        assert arm.read().q == pytest.approx(target, abs=math.radians(0.3))
    assert arm.exit_report.ok
    assert not any(s.torque for s in bus.servos)
