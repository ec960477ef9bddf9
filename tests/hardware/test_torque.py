"""How an arm is left: its own servos only, each confirmed, with a true report."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys

import numpy as np
import pytest

from robot_ik.errors import HardwareError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.leaving import ExitReport
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock, VirtualClock

BROADCAST = 254


@pytest.fixture
def servos(arm_config, start):
    return VirtualBus.from_config(arm_config, VirtualClock(), start=start)


class SpiedBus(SimBus):
    """Keeps the ids of servos that were written."""

    def __init__(self, servos: VirtualBus) -> None:
        super().__init__(servos)
        self.written: set[int] = set()

    def write(self, id, register, value):
        self.written.add(id)
        return super().write(id, register, value)

    def sync_write(self, register, values):
        self.written |= set(values)
        super().sync_write(register, values)

    def exchange(self, register, values, reads, within=None):
        self.written |= set(values)
        return super().exchange(register, values, reads, within)


def test_an_enable_that_fails_and_leaves_torque_on_is_reported_so_at_the_end_too(
    arm_config, servos
):
    arm = open_arm(arm_config, "sim", virtual_bus=servos)
    arm.connect()
    original = arm.bus.sync_write

    def dies_with_torque_on(register, values):
        original(register, values)
        if register.name == "torque_enable" and 1 in values.values():
            servos.inject(*(Fault("silent", id=id) for id in range(1, 7)))

    arm.bus.sync_write = dies_with_torque_on
    with pytest.raises(HardwareError):
        arm.enable()
    assert [servo.torque for servo in servos.servos] == [True] * 6
    assert not arm.exit_report.ok and set(arm.exit_report.unverified) == set(arm.joints)
    arm.close()
    assert not arm.exit_report.ok and arm.exit_report.done == "torque_off"
    assert "torque may be ON" in arm.exit_report.text


def test_an_enable_that_is_refused_before_torque_touches_nothing(arm_config, servos):
    """Servos that another program left holding go on holding."""
    arm = open_arm(arm_config, "sim", virtual_bus=servos)
    arm.connect()
    for servo in servos.servos:
        servo.memory.set("torque_enable", 1)
    servos.servo(3).memory.set("profile_velocity", 0)  # as after a restart
    with pytest.raises(HardwareError, match="nothing was switched on"):
        arm.enable()
    arm.close()
    assert arm.exit_report.done == "untouched" and arm.exit_report.text == "not touched"
    assert [servo.torque for servo in servos.servos] == [True] * 6


CONFIRMED = ("joint1", "joint2")
SILENT = ("joint3",)
TEXTS = {
    "torque is off": ExitReport("torque_off", CONFIRMED),
    "torque is off (parked first)": ExitReport("torque_off", CONFIRMED, parked=True),
    "torque is off (not parked: the arm is in fault)": ExitReport(
        "torque_off", CONFIRMED, unparked="the arm is in fault"
    ),
    (
        "torque is off at joint1, joint2; not confirmed by joint3: torque may be ON, cut the power"
    ): ExitReport("torque_off", CONFIRMED, SILENT),
    "not confirmed by joint3: torque may be ON, cut the power": ExitReport(
        "torque_off", (), SILENT
    ),
    "it holds with torque ON at joint1, joint2; joint3 does NOT hold: no torque": ExitReport(
        "hold", CONFIRMED, SILENT, limp=SILENT
    ),
}


@pytest.mark.parametrize("text", TEXTS)
def test_no_report_contradicts_itself(text):
    assert TEXTS[text].text == text


def test_an_enable_that_fails_and_takes_torque_back_says_so(arm_config, servos, enable_fails):
    arm = open_arm(arm_config, "sim", virtual_bus=servos)
    arm.connect()
    enable_fails(arm)
    assert [servo.torque for servo in servos.servos] == [
        False
    ] * 6 and arm.state is ArmState.CONNECTED
    arm.close()
    assert arm.exit_report.ok and arm.exit_report.done == "torque_off"


@pytest.mark.parametrize("policy", ["torque_off", "hold", "park"])
def test_an_arm_of_some_joints_never_writes_to_the_others(arm_config, servos, start, policy):
    part = dataclasses.replace(arm_config, joints=arm_config.joints[4:])
    bus = SpiedBus(servos)
    for servo in servos.servos:
        servo.memory.set("torque_enable", 1)  # another program's
    for id in (5, 6):
        servos.servo(id).memory.set("torque_enable", 0)
    with Arm(part, bus, on_exit=policy) as arm:
        arm.enable()
        arm.move_to(start[4:] + 0.05)
    assert arm.exit_report.ok
    assert bus.written == {5, 6}
    assert [servo.torque for servo in servos.servos] == [True] * 4 + [policy == "hold"] * 2


def test_an_arm_of_some_joints_whose_enable_fails_leaves_the_others_alone(arm_config, servos):
    part = dataclasses.replace(arm_config, joints=arm_config.joints[4:])
    for servo in servos.servos[:4]:
        servo.memory.set("torque_enable", 1)
    bus = SpiedBus(servos)
    arm = Arm(part, bus)
    arm.connect()
    servos.servo(5).inject_error("overload")
    with pytest.raises(HardwareError):
        arm.enable()
    arm.close()
    assert BROADCAST not in bus.written
    assert [servo.torque for servo in servos.servos] == [True] * 4 + [False] * 2


def test_the_watchdog_of_a_held_servo_is_disarmed_again_if_a_write_was_lost(
    arm_config, servos, stream, start, registers
):
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, [start] * 3)
        original = arm.bus.sync_write
        lost = []

        def loses_one(register, values):
            if register.name == "bus_watchdog" and not lost:
                lost.append(values)
                values = {id: value for id, value in values.items() if id != 3}
            original(register, values)

        arm.bus.sync_write = loses_one
    assert lost and arm.exit_report.ok and registers(arm, "bus_watchdog") == [0] * 6


def test_a_limp_joint_is_named_when_the_arm_is_to_hold(arm_config, servos, stream, start):
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, [start] * 3)
        servos.servo(4).memory.set("torque_enable", 0)
    report = arm.exit_report
    assert report.done == "hold" and not report.ok
    assert report.limp == ("joint4",) and report.unverified == ("joint4",)
    assert "joint4 does NOT hold" in report.text


def test_a_joint_that_does_not_take_its_goal_is_not_confirmed_to_hold(
    arm_config, servos, stream, start, monkeypatch
):
    """It has torque and goes to its own goal, not to where the report would say that it holds."""
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, [start] * 3)
        memory = servos.servo(3).memory
        memory.set("goal_position", memory.values["goal_position"] + 100)
        keep = memory.set
        monkeypatch.setattr(
            memory,
            "set",
            lambda name, value: None if name == "goal_position" else keep(name, value),
        )
    report = arm.exit_report
    assert report.done == "hold" and report.unverified == ("joint3",) and report.limp == ()
    assert "not confirmed by joint3" in report.text
    assert [servo.torque for servo in servos.servos] == [True] * 6


def test_a_tripped_watchdog_is_cleared_and_a_silent_joint_is_not_confirmed(
    arm_config, servos, stream, start
):
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, [start] * 3)
        # A tripped watchdog refuses goals until it is cleared.
        servos.servo(2).memory.set("bus_watchdog", -1)
        servos.servo(3).silent = True
    assert arm.exit_report.unverified == ("joint3",) and arm.exit_report.limp == ()


def test_after_a_restarted_servo_hold_still_holds_the_others(arm_config, servos, stream, start):
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, [start] * 3)
        servos.servo(6).inject_error("overload")
        with pytest.raises(HardwareError):
            stream(arm, [start] * 2)
        arm.reset_fault()
    assert arm.exit_report.limp == ("joint6",)
    assert [servo.torque for servo in servos.servos] == [True] * 5 + [False]


def parked_with_signals(arm_config, start, stream, smooth, signals: int) -> Arm:
    """``signals`` times Ctrl-C during the parking of a normal end."""
    with (
        pytest.raises(KeyboardInterrupt),
        open_arm(arm_config, "sim", start=start, on_exit="park") as arm,
    ):
        arm.enable()
        stream(arm, smooth(start, start + 0.4, 1.0))
        exchange = arm.bus.exchange
        left = [signals]

        def interrupted(register, values, reads, within=None):
            if arm.state is ArmState.MOVING and left[0]:
                left[0] -= 1
                signal.raise_signal(signal.SIGINT)
            return exchange(register, values, reads, within)

        arm.bus.exchange = interrupted
    assert left == [0]
    return arm


def test_one_signal_during_the_parking_lets_it_finish(arm_config, start, stream, smooth):
    arm = parked_with_signals(arm_config, start, stream, smooth, 1)
    assert arm.exit_report.parked and arm.exit_report.ok
    assert np.allclose(arm.bus.virtual_bus.true_angles(arm_config), start, atol=0.01)


def test_the_second_signal_ends_the_parking(arm_config, start, stream, smooth):
    arm = parked_with_signals(arm_config, start, stream, smooth, 2)
    assert not arm.exit_report.parked and arm.exit_report.ok
    assert np.abs(arm.bus.virtual_bus.true_angles(arm_config) - start).max() > 0.1


def test_a_signal_in_motion_parks_and_does_not_shorten_it(arm_config, start, stream, smooth):
    with pytest.raises(SystemExit), open_arm(arm_config, "sim", start=start, on_exit="park") as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.4, 1.0))
        signal.raise_signal(signal.SIGTERM)
    assert arm.exit_report.parked
    assert np.allclose(arm.bus.virtual_bus.true_angles(arm_config), start, atol=0.01)


@pytest.mark.parametrize("policy", ["torque_off", "park"])
def test_bus_watchdogs_are_disarmed_with_the_torque_so_that_the_next_goals_are_taken(
    arm_config, servos, stream, start, policy
):
    with open_arm(arm_config, "sim", virtual_bus=servos, on_exit=policy) as arm:
        arm.enable()
        stream(arm, [start] * 3)
    assert [servo.memory.values["bus_watchdog"] for servo in servos.servos] == [0] * 6
    servos.clock.sleep_until(servos.clock.now() + 5.0)
    bus = SimBus(servos, real=True)
    bus.open()
    table = arm_config.joints[0].servo.table
    bus.write(1, table["torque_enable"], 1)
    bus.write(1, table["goal_position"], 2100)  # refused by a watchdog that has tripped


def test_a_servo_that_did_not_confirm_keeps_its_watchdog(arm_config, servos, stream, start):
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        servos.servo(3).silent = True
    armed = [servo.memory.values["bus_watchdog"] != 0 for servo in servos.servos]
    assert armed == [False, False, True, False, False, False]


def test_the_command_says_when_torque_may_still_be_on(arm_config, arm_path, start, real_time):
    """Of joint5, whose servo goes silent with its torque on: the others are not touched."""
    with PtyPort(VirtualBus.from_config(arm_config, RealClock(), start=start)) as port:
        servo = port.bus.servo(5)
        write = servo.write

        def then_silent(address, data, **how):
            result = write(address, data, **how)
            if address == 64 and data == b"\x01":
                servo.silent = True
            return result

        servo.write = then_silent
        for other in (1, 2, 3, 4, 6):
            port.bus.servo(other).memory.set("torque_enable", 1)
        words = ["servo", "torque", "on", "joint5", "--bus", port.path, "--arm", str(arm_path)]
        done = subprocess.run(
            [sys.executable, "-m", "robot_ik", *words], capture_output=True, text=True
        )
        assert done.returncode == 1, done.stderr
        assert "joint5" in done.stderr and "torque may be ON" in " ".join(done.stderr.split())
        assert "not touched" not in done.stderr
        assert [servo.torque for servo in port.bus.servos] == [True] * 6
