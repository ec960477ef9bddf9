"""An arm starting up: what it sets in the servos, and what it refuses before torque."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from robot_ik.errors import (
    ArmStateError,
    BusNotOpenError,
    ConfigError,
    HardwareError,
    MotorFaultError,
    ServoMismatchError,
)
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.arm_registers import shared_register
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import JointSink, JointSource, RealClock, VirtualClock
from tests.hardware.joints import with_servo


def test_it_is_a_sink_and_a_source(any_arm):
    assert isinstance(any_arm, JointSink) and isinstance(any_arm, JointSource)
    assert any_arm.joints == tuple(f"joint{k}" for k in range(1, 7))


def test_connect_sets_the_servos_up_and_gives_no_torque(any_arm, arm_config, registers, start):
    assert any_arm.state is ArmState.CONNECTED
    assert registers(any_arm, "torque_enable") == [0] * 6
    assert registers(any_arm, "return_delay_time") == [0] * 6
    assert registers(any_arm, "operating_mode") == [OperatingMode.EXTENDED_POSITION] * 6
    for joint, units in zip(arm_config.joints, registers(any_arm, "profile_velocity"), strict=True):
        speed = units * 0.229 * 2 * math.pi / 60 / joint.gear.ratio  # rad/s at the joint
        assert 1.2 * joint.velocity < speed < 2 * joint.velocity  # room to catch up, yet bounded
    assert np.allclose(any_arm.read().q, start, atol=0.6 * any_arm.resolution.max())


def test_eeprom_is_not_written_again_when_it_is_right(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    with open_arm(arm_config, "sim", virtual_bus=servos):
        pass
    written = []
    for servo in servos.servos:

        def noted(address, data, original=servo.write, **how):
            written.append(address)
            return original(address, data, **how)

        servo.write = noted
    with open_arm(arm_config, "sim", virtual_bus=servos):
        pass
    assert written and min(written) >= 64


def test_enable_moves_nothing_and_arms_the_watchdog(any_arm, arm_config, registers):
    for servo in any_arm.bus.virtual_bus.servos:
        servo.memory.set("goal_position", 5000)  # a stale goal of an earlier program
    before = any_arm.bus.virtual_bus.true_angles(arm_config)
    any_arm.enable()
    any_arm.clock.sleep_until(any_arm.clock.now() + 0.05)
    assert registers(any_arm, "torque_enable") == [1] * 6
    assert registers(any_arm, "bus_watchdog") == [10] * 6
    assert np.allclose(
        any_arm.bus.virtual_bus.true_angles(arm_config), before, atol=any_arm.resolution.max()
    )


def test_the_watchdog_is_armed_before_torque_comes_on(arm, registers):
    """A program that is killed between the two would leave torque on, with nothing to stop the
    servos.
    """
    original = arm.bus.sync_write
    armed = []

    def spied(register, values):
        if register.name == "torque_enable":
            armed.append(registers(arm, "bus_watchdog"))
        original(register, values)

    arm.bus.sync_write = spied
    arm.enable()
    assert armed == [[10] * 6]
    arm.bus.sync_write = original


def test_a_missing_and_a_wrong_servo_are_refused_with_a_table(arm_config):
    joints = list(arm_config.joints)
    joints[1] = with_servo(joints[1], id=9)
    joints[3] = with_servo(joints[3], model="XM430-W350")
    wanted = dataclasses.replace(arm_config, joints=tuple(joints))
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    arm = open_arm(wanted, "sim", virtual_bus=servos)
    with pytest.raises(ServoMismatchError) as caught:
        arm.connect()
    assert caught.value.expected[9] == "joint2: XM430-W350" and 9 not in caught.value.detected
    assert caught.value.detected[2] == "XM430-W350"  # a servo whose id the file does not name
    assert (
        caught.value.detected[4] == "XL430-W250"
        and caught.value.expected[4] == "joint4: XM430-W350"
    )
    assert "missing" in str(caught.value)
    assert arm.state is ArmState.DISCONNECTED and not arm.bus.is_open
    assert not any(servo.torque for servo in servos.servos)


def test_a_lost_ping_is_no_missing_servo_if_all_answer_the_ping_to_all(arm_config):
    """Else the table would show no difference."""
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.inject(Fault("silent", 3, for_packets=5))
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        assert arm.state is ArmState.CONNECTED


def test_an_empty_bus_points_at_power_and_baud_rate(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.inject(Fault("silent"))
    with pytest.raises(ServoMismatchError, match="power"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()


@pytest.mark.parametrize("level", [0, 1])
def test_a_servo_that_answers_too_little_is_set_to_answer_everything(arm_config, level, registers):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(3).memory.set("status_return_level", level)
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        assert registers(arm, "status_return_level") == [2] * 6


def test_a_watchdog_that_tripped_before_is_cleared(arm_config, stream, smooth):
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


def test_a_servo_with_an_unexpected_reverse_bit_is_refused(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).memory.set("drive_mode", 1)
    with pytest.raises(HardwareError, match="reverse"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()


def test_firmware_without_a_watchdog_needs_watchdog_ms_0(arm_config, stream, smooth):
    clock = VirtualClock()
    servos = VirtualBus(
        [
            VirtualServo(j.servo.model, j.servo.id, clock, firmware=37, mode=j.servo.mode)
            for j in arm_config.joints
        ],
        clock,
    )
    with pytest.raises(HardwareError, match="no bus watchdog"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()
    with open_arm(dataclasses.replace(arm_config, watchdog_ms=0), "sim", virtual_bus=servos) as arm:
        arm.enable()
        here = arm.read().q
        arm.clock.sleep_until(arm.clock.now() + 5.0)
        stream(arm, smooth(here, here + 0.1, 0.4))
        assert np.allclose(arm.read().q, here + 0.1, atol=0.01)


def test_lost_turns_are_refused_before_torque(arm_config):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).rotate_by_hand(2 * 4096)
    with (
        open_arm(arm_config, "sim", virtual_bus=servos) as arm,
        pytest.raises(
            HardwareError, match=r"lost count of its revolutions(.|\n)*zero_ticks = 10240"
        ),
    ):
        arm.enable()
    assert not any(servo.torque for servo in servos.servos)


def test_a_lost_turn_beside_a_wide_range_is_no_joint_outside(arm_config):
    """At 160 of +-170 degrees a lost revolution reads -200; moving back would reach 190."""
    joints = (
        dataclasses.replace(arm_config.joints[0], lower=-2.967, upper=2.967),
        *arm_config.joints[1:],
    )
    config = dataclasses.replace(arm_config, joints=joints)
    servos = VirtualBus.from_config(config, VirtualClock(), np.radians([160.0, 0, 0, 0, 0, 0]))
    servos.servo(1).shaft.lose_revolutions(-1)
    with (
        open_arm(config, "sim", virtual_bus=servos) as arm,
        pytest.raises(HardwareError, match=r"joint1(.|\n)*zero_ticks = -2048"),
    ):
        arm.enable()
    assert not any(servo.torque for servo in servos.servos)


def test_a_servo_that_refuses_torque_is_named_and_all_are_off(arm_config, registers):
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
    joints = (with_servo(arm_config.joints[0], mode=OperatingMode.POSITION), *arm_config.joints[1:])
    config = dataclasses.replace(arm_config, joints=joints)
    servos = VirtualBus.from_config(config, VirtualClock())
    with open_arm(config, "sim", virtual_bus=servos):
        pass
    servos.servo(1).memory.set("max_position_limit", 3000)
    with pytest.raises(ConfigError, match="narrower"):
        open_arm(config, "sim", virtual_bus=servos).connect()


def test_models_with_another_layout_cannot_share_a_cycle(arm_config):
    here = X_TABLES["XM430-W350"]["goal_position"]
    there = dataclasses.replace(here, address=30)
    joints = [
        SimpleNamespace(model=m, table={"goal_position": r}) for m, r in (("A", here), ("B", there))
    ]
    vars(arm_config)["servos"] = joints
    with pytest.raises(ConfigError, match="elsewhere in B than in A"):
        shared_register(arm_config, "goal_position")


def test_an_unknown_policy_and_servos_for_a_real_port_are_refused(arm_config):
    with pytest.raises(ConfigError, match="torque_off, hold, park"):
        open_arm(arm_config, "sim", on_exit="drop")
    with pytest.raises(ValueError, match="real port"):
        open_arm(
            arm_config, "/dev/ttyUSB0", virtual_bus=VirtualBus.from_config(arm_config, RealClock())
        )
    with pytest.raises(BusNotOpenError):
        open_arm(arm_config, "/dev/no_such_port").connect()
