"""Torque, velocity and position of every servo in one read, and servos that are read plainly."""

from __future__ import annotations

import dataclasses

import pytest

from robot_ik.errors import MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct, Drive, Pinion
from robot_ik.hardware.servo_faults import jump_fault
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock
from tests.hardware.joints import make_joint, with_servo


def test_torque_that_another_program_switches_off_is_noticed_at_once(any_arm, stream, start):
    any_arm.enable()
    stream(any_arm, [start] * 3)
    any_arm.bus.virtual_bus.servo(4).memory.set("torque_enable", 0)
    with pytest.raises(MotorFaultError) as caught:
        stream(any_arm, [start])
    assert (caught.value.joint, caught.value.status) == ("joint4", ("torque_lost",))


def test_a_restart_at_rest_is_seen_in_the_same_cycle_and_its_zeros_are_not_believed(
    arm, stream, start
):
    arm.enable()
    stream(arm, [start] * 3)
    before = arm.read().q
    arm.bus.virtual_bus.servo(2).reboot()  # the shaft stays: nothing else would show
    arm.clock.sleep_until(arm.clock.now() + 0.01)
    with pytest.raises(MotorFaultError, match="joint2") as caught:
        arm.send(start, arm.clock.now())
    assert caught.value.status == ("torque_lost",)
    assert (arm.read().q == before).all()


def test_a_cycle_brings_seven_bytes_of_every_servo(arm, stream, start):
    arm.enable()
    stream(arm, [start] * 2)
    counters = arm.bus.counters
    sent = counters.bytes_sent
    received = counters.bytes_received
    stream(arm, [start])
    assert counters.bytes_received - received == 8 + 6 * (4 + 7)  # one fast status
    assert counters.bytes_sent - sent == (14 + 6 * 5) + (14 + 6)


@pytest.mark.parametrize("firmware", [44, None])
def test_every_firmware_is_read_the_way_it_can_be(arm_config, stream, smooth, start, firmware):
    clock = VirtualClock()
    config = arm_config
    servos = [
        VirtualServo(
            j.servo.model,
            j.servo.id,
            clock,
            position_ticks=j.nearest_ticks(q),
            mode=j.servo.mode,
            firmware=firmware,
        )
        for j, q in zip(config.joints, start, strict=True)
    ]
    with open_arm(config, "sim", virtual_bus=VirtualBus(servos, clock)) as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.2, 0.5))
        assert abs(arm.read().q - start - 0.2).max() < 0.01
        assert arm.bus.counters.fallbacks == 0  # no servo is asked for a read that it does not know


def test_models_whose_indirect_data_lie_elsewhere_share_a_cycle(arm_config, stream, smooth, start):
    joints = list(arm_config.joints)
    joints[4] = with_servo(joints[4], model="XL330-M288")
    config = dataclasses.replace(arm_config, joints=tuple(joints))
    with open_arm(config, "sim", start=start) as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.2, 0.5))
        assert abs(arm.read().q - start - 0.2).max() < 0.01
        arm.bus.virtual_bus.servo(5).memory.set("torque_enable", 0)
        with pytest.raises(MotorFaultError, match="joint5"):
            stream(arm, [start])


def test_a_servo_with_changed_indirect_addresses_is_read_plainly(arm, stream, start):
    arm.enable()
    stream(arm, [start] * 2)
    servo = arm.bus.virtual_bus.servo(3)
    servo.memory.set("indirect_address_1", 65)  # its LED, which is off
    stream(arm, [start] * 3)
    assert arm.state is ArmState.ENABLED and servo.torque
    assert arm.ages[2] <= 0.011


def test_servos_read_plainly_are_all_seen_in_every_cycle(arm, stream, start):
    arm.enable()
    for id in (2, 4, 5):
        arm._cycle.feedback.read_plainly(id)
    stream(arm, [start] * 10)
    received = arm.bus.counters.bytes_received
    stream(arm, [start])
    assert arm.bus.counters.bytes_received - received == 8 + 6 * 4 + 3 * 7 + 3 * 83
    arm.bus.virtual_bus.servo(4).memory.set("torque_enable", 0)
    with pytest.raises(MotorFaultError, match="joint4") as caught:
        stream(arm, [start])
    assert caught.value.status == ("torque_lost",)


@pytest.mark.parametrize("model", ["XM430-W350", "XL430-W250", "XL330-M288"])
@pytest.mark.parametrize("loses", ["its torque", "its supply for a moment"])
def test_a_servo_read_plainly_at_rest_shows_its_lost_torque_in_the_same_cycle(
    arm_config, stream, start, model, loses
):
    joints = list(arm_config.joints)
    joints[4] = with_servo(joints[4], model=model)
    with open_arm(dataclasses.replace(arm_config, joints=tuple(joints)), "sim", start=start) as arm:
        arm.enable()
        servo = arm.bus.virtual_bus.servo(5)
        servo.memory.set("indirect_address_1", 65)  # its LED, which is off
        stream(arm, [start] * 100)
        assert arm.state is ArmState.ENABLED and arm.ages[4] <= 0.011
        if loses == "its torque":
            servo.memory.set("torque_enable", 0)
        else:
            servo.reboot()
            arm.clock.sleep_until(arm.clock.now() + 0.01)
        with pytest.raises(MotorFaultError, match="joint5") as caught:
            stream(arm, [start])
        assert caught.value.status == ("torque_lost",)


def test_a_slide_that_jumps_is_reported_in_millimetres():
    mode = OperatingMode.EXTENDED_POSITION
    rack = make_joint("rack", 2, "XL330-M288", mode, 1, 0, 0.0, 0.03, 0.05, 0.4, gear=Pinion(0.01))
    assert "it read 0.0 mm, now 62.8 mm:" in (
        jump_fault(Drive(rack, rack.servo), 0, 4096).hint or ""
    )
    assert "it read 0.0 deg, now 360.0 deg:" in (
        jump_fault(Drive(dataclasses.replace(rack, gear=Direct()), rack.servo), 0, 4096).hint or ""
    )
