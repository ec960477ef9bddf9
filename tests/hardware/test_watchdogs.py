"""An arm without commands, on real time: it is held, watched, and left as its file says."""

from __future__ import annotations

import dataclasses
import signal
import time

import numpy as np
import pytest

from robot_ik.errors import HardwareError, MotorFaultError, UnsafeCommandError
from robot_ik.hardware import open_arm, watchdogs
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.watchdogs import Heartbeat
from robot_ik.signals import SIGNALS
from tests.waiting import wait_for

pytestmark = pytest.mark.usefixtures("real_time")


@pytest.fixture
def arm(arm_config, start):
    with open_arm(arm_config, "pty", start=start) as arm:
        yield arm


def bus_watchdogs(arm):
    assert all(
        servo.torque for servo in arm.bus.virtual_bus.servos
    )  # a servo sees the time when it is looked at
    return [servo.memory.values["bus_watchdog"] for servo in arm.bus.virtual_bus.servos]


def test_a_stale_command_is_held_watched_and_the_bus_watchdog_does_not_trip(
    arm, stream, smooth, start
):
    arm.enable()
    stream(arm, smooth(start, start + 0.3, 0.6)[:30])
    wait_for(lambda: arm.state is ArmState.HOLD)
    assert arm.reports.stale == 1
    time.sleep(0.4)
    assert bus_watchdogs(arm) == [10] * 6
    assert arm.ages.max() < 0.3  # the heartbeat reads
    here = arm.read().q
    stream(arm, smooth(here, here + 0.1, 0.3))  # and the program goes on
    assert arm.state is ArmState.ENABLED and arm.reports.stale == 1


def test_a_program_that_says_nothing_but_nan_is_stale(arm_config, stream, smooth, start):
    with open_arm(arm_config, "sim", start=start) as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.3, 0.6)[:30])
        for _ in range(11):
            arm.clock.sleep_until(arm.clock.now() + 0.01)
            with pytest.raises(UnsafeCommandError):
                arm.send(np.full(6, np.nan), arm.clock.now())
        arm._beat()  # on virtual time there is no thread that does
        assert arm.state is ArmState.HOLD and arm.reports.stale == 1


def test_a_fault_in_the_meantime_is_raised_by_the_next_command(arm, stream, start):
    arm.enable()
    stream(arm, [start] * 3)
    arm.bus.virtual_bus.servo(2).inject_error("overheating")
    wait_for(lambda: arm.state is ArmState.FAULT)
    with pytest.raises(MotorFaultError, match=r"joint2.*overheating"):
        arm.send(start, 0.0)


@pytest.mark.parametrize("policy", ["park", "torque_off"])
def test_a_program_that_hangs_is_replaced_by_the_policy_of_the_file(
    arm_config, stream, smooth, start, policy, monkeypatch
):
    monkeypatch.setattr("robot_ik.hardware.arm.GIVE_UP", 0.5)
    config = dataclasses.replace(arm_config, on_stale=policy)
    with open_arm(config, "pty", start=start) as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.2, 0.4))
        wait_for(lambda: arm.state is ArmState.FAULT)
        assert not any(servo.torque for servo in arm.bus.virtual_bus.servos)
        off = np.abs(arm.bus.virtual_bus.true_angles(config) - start).max()
        assert off < 0.02 if policy == "park" else off > 0.1
        with pytest.raises(HardwareError, match="no command came"):
            arm.send(start, 0.0)


def test_hold_has_no_time_limit(arm_config, stream, start, monkeypatch):
    monkeypatch.setattr("robot_ik.hardware.arm.GIVE_UP", 0.3)
    with open_arm(
        dataclasses.replace(arm_config, on_stale="torque_off"), "pty", start=start
    ) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        arm.hold()
        time.sleep(0.8)
        assert arm.state is ArmState.HOLD and all(
            servo.torque for servo in arm.bus.virtual_bus.servos
        )


def test_it_can_be_switched_off(arm_config, stream, start):
    with open_arm(dataclasses.replace(arm_config, stale_ms=0), "pty", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        time.sleep(0.5)
        assert arm.state is ArmState.ENABLED
        assert bus_watchdogs(arm) == [-1] * 6


def test_no_look_begins_after_stop(monkeypatch):
    monkeypatch.setattr(watchdogs, "BEAT", 0.001)
    looks = []
    beat = Heartbeat(lambda: looks.append(time.monotonic()))
    beat.start()
    beat.start()  # not twice
    wait_for(lambda: len(looks) > 3)
    beat.stop()
    beat.stop()
    count = len(looks)
    time.sleep(0.02)
    assert len(looks) == count


def test_a_dismissed_heartbeat_can_be_started_at_once():
    """As by an arm that is enabled again right after a signal came while it was enabled."""
    looks = []
    beat = Heartbeat(lambda: looks.append(time.monotonic()))
    beat.start()
    beat.dismiss()
    beat.start()
    wait_for(lambda: len(looks) >= 2)
    beat.stop()


def test_a_host_program_keeps_its_own_signal_handlers(arm_config):
    before = [signal.getsignal(number) for number in SIGNALS]
    with open_arm(arm_config, "sim") as arm:
        arm.enable(handle_signals=False)
        assert [signal.getsignal(number) for number in SIGNALS] == before
        arm.send(arm.read().q, arm.clock.now())
    assert arm.exit_report.ok and arm.exit_report.done == "torque_off"
