"""Faults 14 to 26 of docs/reference/safety.md, one test a row by its number."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from robot_ik.errors import (
    BusDisconnectedError,
    BusNotOpenError,
    HardwareError,
    MotorFaultError,
    UnsafeCommandError,
)
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.ports import RealClock

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals and signals")


def test_row_14(lab):
    """a servo that shuts down"""
    for kind in ("overload", "overheating", "input_voltage"):
        with lab.arm() as arm:
            fault = lab.fault(arm, MotorFaultError, Fault(kind, id=6))
            assert (fault.joint, fault.status) == ("joint6", (kind,))
            assert arm.ages.max() < 0.011  # in the same cycle
            assert lab.torque(arm)[:5] == [True] * 5
            assert arm.reset_fault() == ("joint6",) and arm.state is ArmState.CONNECTED


def test_every_servo_in_fault_is_named_at_connect(lab):
    with pytest.raises(MotorFaultError, match="joint2") as caught:
        lab.arm(Fault("overload", id=2), Fault("overheating", id=5)).connect()
    assert "likewise joint5 (overheating)" in caught.value.hint


def test_row_15(lab):
    """a servo that replies only to some instructions"""
    faults = Fault("status_level", id=2, value=0), Fault("status_level", id=3, value=1)
    with lab.arm(*faults) as arm:
        assert lab.registers(arm, "status_return_level") == [2] * 6


def test_row_16(lab):
    """a servo that restarts by itself"""
    with lab.arm() as arm:
        fault = lab.fault(arm, MotorFaultError, Fault("reboot", id=2))
        assert (fault.joint, fault.status) == ("joint2", ("torque_lost",))
        arm.clock.sleep_until(arm.clock.now() + 1.0)
        assert lab.torque(arm) == [True, False, True, True, True, True]  # it is not enabled again


def test_row_17(lab):
    """the cable pulled, and put back"""
    with lab.arm() as arm:
        begin = arm.clock.now()
        lab.fault(arm, BusDisconnectedError, Fault("port_unplugged", for_s=0.05))
        assert arm.clock.now() - begin < 0.045  # three cycles before, one in which it was noticed
        arm.bus.virtual_bus.servo(2).memory.set("torque_enable", 0)
        arm.reconnect()
        assert arm.state is ArmState.CONNECTED and not lab.torque(arm)[1]


def test_row_18(lab, real_time):
    """a second program on the port"""
    with (
        PtyPort(VirtualBus.from_config(lab.config, RealClock())) as port,
        open_arm(lab.config, port.path) as arm,
    ):
        with pytest.raises(BusNotOpenError, match=rf"already open in .*process {os.getpid()}"):
            DynamixelBus(port.path).open()
        assert arm.bus.ping(1) == 1020


def test_row_19(lab):
    """Ctrl-C and SIGTERM at any moment"""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # a test run in the background ignores it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for k in range(12):
            number = (signal.SIGINT, signal.SIGTERM)[k % 2]
            arm = lab.arm()
            with pytest.raises((KeyboardInterrupt, SystemExit)), arm:
                arm.enable()
                # inside a transaction: between question and answer
                schedule = arm.bus.virtual_bus.schedule
                schedule.at_packet(schedule.upcoming + k, lambda n=number: os.kill(os.getpid(), n))
                lab.drive(arm, 40)
            assert arm.exit_report.ok and not any(lab.torque(arm))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_row_20(lab):
    """SIGKILL"""
    with lab.arm() as arm:
        arm.enable()
        lab.stream(arm, lab.smooth(lab.start, lab.start + 0.4, 0.8)[:40])
        # no packet comes any more, as after a SIGKILL
        arm.clock.sleep_until(arm.clock.now() + 0.3)
        here = arm.bus.virtual_bus.true_angles(lab.config)
        arm.clock.sleep_until(arm.clock.now() + 5.0)
        assert lab.torque(arm) == [True] * 6 and lab.registers(arm, "bus_watchdog") == [-1] * 6
        assert np.array_equal(arm.bus.virtual_bus.true_angles(lab.config), here)


def test_row_21(lab):
    """a program that stops, commands NaN, or commands a jump"""
    with lab.arm() as arm:
        arm.enable()
        lab.drive(arm)
        sent = arm.bus.counters.bytes_sent
        with pytest.raises(UnsafeCommandError):
            arm.send(lab.start * np.nan, arm.clock.now())
        assert arm.bus.counters.bytes_sent == sent
        before = arm.bus.virtual_bus.true_angles(lab.config)
        for _ in range(30):
            lab.stream(arm, [lab.start + np.array([np.pi, 0, 0, 0, 0, 0])])
            now = arm.bus.virtual_bus.true_angles(lab.config)
            assert np.abs(now - before).max() <= 1.5 * lab.config.velocity.max() * 0.01 + 1e-3
            before = now
        assert arm.reports.capped["joint1"] > 0
        arm.clock.sleep_until(arm.clock.now() + 3.0)  # the program stops: held where it is
        assert np.abs(arm.bus.virtual_bus.true_angles(lab.config) - before).max() < 0.1 and all(
            lab.torque(arm)
        )


def test_row_22(lab):
    """positions beyond a revolution, below zero, forgotten"""
    with lab.arm(start=np.zeros(6)) as arm:
        arm.enable()
        for q in lab.smooth(np.zeros(6), np.array([2.6, 2.6, 2.6, 0, 0, -2.6]), 3.5):
            before = arm.read().q
            lab.stream(arm, [q])
            assert np.abs(arm.read().q - before).max() < 0.05  # no jump at 4095 and none at 0
        ticks = lab.registers(arm, "present_position")
        assert max(ticks) > 4095 and min(ticks) < 0
    with lab.arm(Fault("lost_turns", id=1, value=1)) as arm:  # as after its supply was off
        with pytest.raises(HardwareError, match="joint1"):
            arm.enable()
        assert not any(lab.torque(arm))


@pytest.mark.parametrize("turns", [1, -1, 3])
def test_a_servo_that_loses_count_in_motion_is_held_where_it_stands(lab, turns):
    """The servo itself goes where its goal seems to be: the arm must not let it."""
    with lab.arm() as arm:
        before = arm.bus.virtual_bus.true_angles(lab.config)
        fault = lab.fault(arm, MotorFaultError, Fault("lost_turns", id=2, value=turns))
        assert (fault.joint, fault.status) == ("joint2", ("position_jump",))
        arm.clock.sleep_until(arm.clock.now() + 3.0)
        assert np.abs(arm.bus.virtual_bus.true_angles(lab.config) - before).max() < 0.1 and all(
            lab.torque(arm)
        )
        with pytest.raises(HardwareError, match="joint 'joint2' was at"):
            arm.reset_fault()  # the angle is still wrong
        arm.bus.virtual_bus.servo(2).shaft.lose_revolutions(-turns)
        arm.reset_fault()
        arm.enable()
        lab.stream(arm, lab.smooth(arm.read().q, lab.start, 1.0))
        assert np.abs(arm.bus.virtual_bus.true_angles(lab.config) - lab.start).max() < 0.05


def test_a_servo_that_loses_count_while_the_arm_holds_is_held_where_it_stands(lab):
    with lab.arm() as arm:
        arm.enable()
        lab.drive(arm)
        arm.hold()
        before = arm.bus.virtual_bus.true_angles(lab.config)
        arm.bus.virtual_bus.inject(Fault("lost_turns", id=2, value=1))
        arm.clock.sleep_until(arm.clock.now() + 0.02)
        with pytest.raises(MotorFaultError, match="position_jump"):
            arm.read()
        arm.clock.sleep_until(arm.clock.now() + 3.0)
        assert np.abs(arm.bus.virtual_bus.true_angles(lab.config) - before).max() < 0.1 and all(
            lab.torque(arm)
        )


def test_a_joint_that_presses_and_loses_count_is_held_too(lab, arm_toml):
    """What it grips keeps such a joint from its goal; here nothing would."""
    text = arm_toml.replace(
        '"extended_position"', '"current_based_position"\ncurrent_ma = 269.0', 1
    )
    with lab.arm(config=ArmConfig.parse(text)) as arm:
        before = arm.bus.virtual_bus.true_angles(lab.config)
        fault = lab.fault(arm, MotorFaultError, Fault("lost_turns", id=1, value=1))
        assert fault.status == ("position_jump",)
        arm.clock.sleep_until(arm.clock.now() + 3.0)
        assert np.abs(arm.bus.virtual_bus.true_angles(lab.config) - before).max() < 0.1


def test_an_arm_turned_by_hand_without_torque_has_not_jumped(lab):
    with lab.arm() as arm:
        arm.read()
        arm.bus.virtual_bus.servo(1).rotate_by_hand(-2100)
        arm.read()
        arm.bus.virtual_bus.servo(1).rotate_by_hand(2100)
        arm.read()
        arm.reconnect()
        arm.bus.virtual_bus.servo(1).rotate_by_hand(-2100)
        arm.enable()
        lab.drive(arm)


def test_row_23(lab, real_time):
    """the header bytes FF FF FD within data"""
    for on in ("sim", "pty"):
        with lab.arm(on=on) as arm:
            offset = lab.config.joints[0].servo.table["homing_offset"]
            # little end first: FF FF FD FF, FF FD FF FF, FF FD FE FF
            for value in (-131_073, -513, -66_049):
                arm.bus.write(1, offset, value)
                assert arm.bus.read(1, offset).data == value
                assert arm.bus.sync_read([1, 2], offset)[1].data == value
            arm.bus.write(1, offset, 0)


def test_row_24(lab):
    """a watchdog that had tripped before"""
    with lab.arm(Fault("watchdog_tripped")) as arm:
        arm.enable()
        lab.stream(arm, lab.smooth(lab.start, lab.start + 0.1, 0.5))
        assert np.abs(arm.bus.virtual_bus.true_angles(lab.config) - lab.start).min() > 0.05
        assert lab.registers(arm, "bus_watchdog") == [10] * 6


def test_row_25(lab, real_time, monkeypatch):
    """a change of the computer's clock"""
    jumps = iter(range(10**9))
    with lab.arm(on="pty") as arm:
        arm.enable()
        monkeypatch.setattr(time, "time", lambda: 1e9 - 3600.0 * next(jumps))
        lab.drive(arm, 5)
        assert arm.state is ArmState.ENABLED and 0.0 <= arm.ages.max() < 1.0
    assert arm.exit_report.ok


def test_row_26(lab):
    """all faults of the wire at a low rate"""
    counters = lab.follows_a_bad_wire(300, 0.8, **dict.fromkeys(SPOILS, 3e-3)).bus.counters
    assert counters.asked == counters.answered + counters.refused + counters.timeouts
