"""Joints with two servos, and servos that press with a set current."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from robot_ik.errors import ConfigError, HardwareError, MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock
from tests.hardware import joints as joint_helpers
from tests.hardware.joints import Twin, with_servo

TWIN = Twin(id=8, direction=1, zero_ticks=3000)
SHADOW = Twin(id=8, shadow=True)


def with_twin(config: ArmConfig, twin: Twin) -> ArmConfig:
    joints = (config.joints[0], joint_helpers.with_twin(config.joints[1], twin), *config.joints[2:])
    return dataclasses.replace(config, joints=joints)


@pytest.fixture(params=[TWIN, SHADOW], ids=["two ids", "shadow id"])
def config(request, arm_config):
    return with_twin(arm_config, request.param)


@pytest.fixture
def servos(config, start):
    return VirtualBus.from_config(config, VirtualClock(), start)


def test_both_servos_of_a_joint_move_and_both_are_left_without_torque(
    config, servos, stream, smooth, start
):
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        assert servos.servo(8).torque
        stream(arm, smooth(start, start + 0.3, 0.6))
        arm.clock.sleep_until(arm.clock.now() + 0.05)
        assert np.allclose(arm.read().q, start + 0.3, atol=0.01)
        second = config.drives[-1]
        assert second.id == 8
        assert second.value(servos.servo(8).true_ticks) == pytest.approx(start[1] + 0.3, abs=0.01)
    assert not servos.servo(8).torque and arm.exit_report.ok


def test_a_goal_for_a_shadow_is_on_the_wire_once(config, servos, stream, start):
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, [start] * 2)
        sent = arm.bus.counters.bytes_sent
        stream(arm, [start])
        goals = 6 if config.drives[-1].is_shadow else 7
        assert arm.bus.counters.bytes_sent - sent == (14 + 5 * goals) + (14 + 7)


def test_servos_that_do_not_agree_get_no_torque_together(config, servos):
    servos.servo(8).rotate_by_hand(200)
    with (
        open_arm(config, "sim", virtual_bus=servos) as arm,
        pytest.raises(HardwareError, match="two servos of joint 'joint2'"),
    ):
        arm.enable()
    assert not any(servo.torque for servo in servos.servos)


def test_a_second_servo_that_slips_is_a_fault(config, servos, stream, smooth, start):
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        servos.servo(8).stuck = True
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, smooth(start, start + 0.5, 1.0))
        assert (caught.value.joint, caught.value.status) == ("joint2", ("twisted",))


def test_a_silent_second_servo_is_a_fault_of_its_joint(config, servos, stream, start):
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        servos.servo(8).silent = True
        with pytest.raises(MotorFaultError, match="servo id 8") as caught:
            stream(arm, [start] * 40)
        assert caught.value.joint == "joint2"
    assert arm.exit_report.unverified == ("joint2",)


def test_secondary_ids_must_match_the_arm_file(arm_config, start):
    config = with_twin(arm_config, SHADOW)
    servos = VirtualBus.from_config(config, VirtualClock())
    servos.servo(8).memory.set("secondary_id", 255)
    with pytest.raises(HardwareError, match="shadow of id 2"):
        open_arm(config, "sim", virtual_bus=servos).connect()
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(3).memory.set("secondary_id", 2)  # would move along with joint2
    with pytest.raises(HardwareError, match="no shadow"):
        open_arm(arm_config, "sim", virtual_bus=servos).connect()


def test_the_file_keeps_twins_and_currents_and_refuses_what_cannot_be(arm_config, arm_toml):
    joints = list(with_twin(arm_config, TWIN).joints)
    joints[5] = dataclasses.replace(
        with_servo(joints[5], mode=OperatingMode.CURRENT_BASED_POSITION), current=269.0
    )
    config = dataclasses.replace(arm_config, joints=tuple(joints))
    again = ArmConfig.parse(config.to_toml())
    assert (
        again.joints[1].servos[1] == config.joints[1].servos[1] and again.joints[5].current == 269.0
    )
    assert again.servo_ids == (1, 2, 3, 4, 5, 6, 8)
    with pytest.raises(ConfigError, match=r"id 3 is already joints\[1\].twin"):
        with_twin(arm_config, dataclasses.replace(TWIN, id=3))
    wrong = [
        (
            '"extended_position"\ndirection = 1',
            '"extended_position"\ncurrent_ma = 100.0\ndirection = 1',
            "takes no current",
        ),
        (
            '"extended_position"\ndirection = 1',
            '"current_based_position"\ncurrent_ma = 1.0\ndirection = 1',
            "2.69 to",
        ),
        (
            "acceleration_deg = 360.0\n",
            "acceleration_deg = 360.0\ntwin = { id = 8, directon = 1 }\n",
            "did you mean direction",
        ),
    ]
    for old, new, said in wrong:
        with pytest.raises(ConfigError, match=said):
            ArmConfig.parse(arm_toml.replace(old, new, 1))


@pytest.fixture
def gripping(arm_config):
    joints = list(arm_config.joints)
    servo = with_servo(joints[5], mode=OperatingMode.CURRENT_BASED_POSITION, zero_ticks=2048)
    joints[5] = dataclasses.replace(servo, current=269.0, gear=Direct())
    return dataclasses.replace(arm_config, joints=tuple(joints))


def test_a_gripper_is_a_joint_that_presses_no_harder_than_it_is_reported(
    gripping, stream, smooth, start
):
    with open_arm(gripping, "sim", start=start) as arm:
        servo = arm.bus.virtual_bus.servo(6)
        assert servo.memory.values["goal_current"] == 100
        arm.enable()
        stream(arm, smooth(start, start + 0.2, 0.5))
        servo.jammed = True
        servo.stuck = True  # something is between its jaws
        stream(arm, smooth(start + 0.2, start + np.array([0.2] * 5 + [0.6]), 0.5))
        goal = servo.memory.values["goal_position"]
        arm.hold()
        assert servo.memory.values["goal_position"] == goal  # it does not let go
        assert servo.torque


def test_its_own_limit_is_never_passed(gripping):
    servos = VirtualBus.from_config(gripping, VirtualClock())
    servos.servo(6).memory.set("current_limit", 40)
    with open_arm(gripping, "sim", virtual_bus=servos):
        assert servos.servo(6).memory.values["goal_current"] == 40
