"""After a fault: what comes back, in which state, and what is refused."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot_ik.errors import (
    ArmStateError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
    MotorFaultError,
    ServoMismatchError,
    UnsafeCommandError,
)
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.ports import VirtualClock


def torque(arm):
    return [servo.torque for servo in arm.bus.virtual_bus.servos]


def overloaded(arm, stream, start, id=6):
    arm.enable()
    stream(arm, [start] * 3)
    arm.bus.virtual_bus.servo(id).inject_error("overload")
    with pytest.raises(MotorFaultError):
        stream(arm, [start] * 2)


def comes_to_rest(arm, q):
    """Whether the arm is within 0.01 rad of ``q`` before five seconds of its clock are over."""
    end = arm.clock.now() + 5.0
    while not np.allclose(arm.read().q, q, atol=0.01):
        if arm.clock.now() > end:
            return False
        arm.clock.sleep_until(arm.clock.now() + 0.01)
    return True


def test_a_restarted_servo_joins_in_again_and_the_others_never_let_go(
    any_arm, stream, smooth, start
):
    overloaded(any_arm, stream, start)
    assert any_arm.reset_fault() == ("joint6",)
    assert any_arm.state is ArmState.CONNECTED and any_arm.fault is None
    assert torque(any_arm) == [True] * 5 + [False]  # no servo was enabled or dropped
    any_arm.enable()
    stream(any_arm, smooth(start, start + 0.2, 0.5))
    assert comes_to_rest(any_arm, start + 0.2)
    any_arm.close()
    assert torque(any_arm) == [False] * 6


def test_after_a_reset_the_limiter_starts_from_where_everything_stands(arm, stream, start):
    overloaded(arm, stream, start)
    arm.bus.virtual_bus.servo(6).rotate_by_hand(150)
    arm.reset_fault()
    arm.enable()
    before = arm.bus.virtual_bus.true_angles(arm.config)
    stream(arm, [start])  # a ramp, not a jump back
    after = arm.bus.virtual_bus.true_angles(arm.config)
    assert (
        np.abs(after - before).max()
        <= 2 * arm.config.acceleration.max() * 0.01**2 + arm.resolution.max()
    )


def test_a_failed_enable_sends_no_servo_back_to_older_goals(
    arm_config, stream, enable_fails, start
):
    """A joint hung limp and was moved, got torque where it is, and then was not heard."""
    servos = VirtualBus.from_config(arm_config, VirtualClock(), start)
    arm = open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold")
    arm.connect()
    overloaded(arm, stream, start)
    arm.reset_fault()
    servos.servo(6).rotate_by_hand(400)
    before = servos.true_angles(arm_config)
    enable_fails(arm)
    assert arm.exit_report.done == "hold" and arm.exit_report.ok
    arm.clock.sleep_until(arm.clock.now() + 3.0)
    assert np.abs(servos.true_angles(arm_config) - before).max() < 0.01
    arm.close()


def test_a_servo_that_lost_its_turns_with_the_restart_is_refused_and_the_fault_stays(
    arm_config, stream, smooth
):
    # joint3: ratio 2, its servo is beyond one revolution
    beyond = np.array([0.0, 0.0, 2.7, 0.0, 0.0, 0.0])
    with open_arm(arm_config, "sim", start=beyond) as arm:
        overloaded(arm, stream, beyond, id=3)
        with pytest.raises(HardwareError, match=r"(?s)joint3' was at 154.*lost count"):
            arm.reset_fault()
        assert arm.state is ArmState.FAULT and not arm.bus.virtual_bus.servo(3).torque
    assert torque(arm) == [False] * 6


def test_a_servo_that_does_not_come_back_keeps_the_fault(arm, stream, start):
    overloaded(arm, stream, start)
    arm.bus.virtual_bus.inject(Fault("silent", id=6, at_packet=None))
    with pytest.raises(BusTimeoutError, match="joint6"):
        arm.reset_fault()
    assert arm.state is ArmState.FAULT
    with pytest.raises(MotorFaultError):
        arm.send(start, arm.clock.now())


def test_without_a_fault_there_is_nothing_to_reset(arm):
    with pytest.raises(ArmStateError, match="allowed: fault"):
        arm.reset_fault()
    arm.enable()
    with pytest.raises(ArmStateError, match="enabled"):
        arm.reconnect()


def test_a_port_that_comes_back_is_verified_without_enabling(any_arm, stream, smooth, start):
    any_arm.enable()
    stream(any_arm, [start] * 3)
    any_arm.bus.virtual_bus.inject(Fault("port_unplugged"))
    begin = time.monotonic()
    with pytest.raises(BusDisconnectedError):
        stream(any_arm, [start] * 10)
    assert any_arm.state is ArmState.FAULT and time.monotonic() - begin < 5.0
    with pytest.raises(ArmStateError, match="port is gone"):
        any_arm.reset_fault()
    with pytest.raises((BusNotOpenError, BusDisconnectedError)):
        any_arm.reconnect(timeout=0.0)
    assert any_arm.state is ArmState.FAULT
    any_arm.bus.virtual_bus.unplugged = False
    # what happens meanwhile is not undone
    any_arm.bus.virtual_bus.servo(2).memory.set("torque_enable", 0)
    any_arm.reconnect()
    assert any_arm.state is ArmState.CONNECTED
    assert torque(any_arm) == [True, False, True, True, True, True]
    any_arm.enable()
    stream(any_arm, smooth(start, start + 0.1, 0.4))
    any_arm.close()
    assert torque(any_arm) == [False] * 6
    c = any_arm.bus.counters  # of the cycle in which the port went, too
    assert c.asked == c.answered + c.refused + c.timeouts and c.timeouts >= 6


def test_other_servos_behind_the_port_are_refused(arm, stream, start):
    arm.enable()
    arm.bus.virtual_bus.inject(Fault("port_unplugged", for_s=0.05))
    with pytest.raises(BusDisconnectedError):
        stream(arm, [start] * 3)
    arm.bus.virtual_bus.servo(3).memory.set("id", 33)
    with pytest.raises(ServoMismatchError):
        arm.reconnect()
    assert arm.state is ArmState.FAULT


def test_a_current_can_be_lowered_and_never_raised_beyond_the_file(arm_toml):
    from robot_ik.hardware.config import ArmConfig

    text = arm_toml.replace(
        '"extended_position"', '"current_based_position"\ncurrent_ma = 269.0', 1
    )
    config = ArmConfig.parse(text)
    with open_arm(config, "sim", virtual_bus=VirtualBus.from_config(config, VirtualClock())) as arm:
        goal = lambda: arm.bus.virtual_bus.servo(1).memory.values["goal_current"]  # noqa: E731
        arm.enable()
        arm.limit_current({"joint1": 26.9})
        assert goal() == 10
        arm.limit_current({"joint1": 5000.0})
        assert goal() == 100
        for wrong in ({"joint1": float("nan")}, {"joint1": -1.0}, {"joint2": 10.0}):
            with pytest.raises(UnsafeCommandError):
                arm.limit_current(wrong)
        assert goal() == 100
