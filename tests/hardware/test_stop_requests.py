"""Every request to stop is carried out, and no program goes on without an error."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from robot_ik.errors import ArmStateError, MotorFaultError, StopRequestedError
from robot_ik.hardware import open_arm, stop_file
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.stop_file import running_arms
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.watchdogs import BEAT
from robot_ik.ports import RealClock
from tests.waiting import wait_for


@pytest.fixture(autouse=True)
def private_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(stop_file, "FOLDER", tmp_path / "running")


@pytest.fixture
def make_arm(arm_config, start) -> Iterator[Callable[..., Arm]]:
    """An arm with a heartbeat, on real time, without a serial line that load would delay."""
    made = []

    def make(config: ArmConfig = arm_config, **options: object) -> Arm:
        servos = VirtualBus.from_config(config, RealClock(), start=start)
        arm = Arm(config, SimBus(servos), **options)
        made.append(arm)
        return arm

    yield make
    for arm in made:
        arm.close()


def torque(arm: Arm) -> list[bool]:
    return [servo.torque for servo in arm.bus.virtual_bus.servos]


def bring_into_fault(arm: Arm, start, id: int = 6) -> None:
    arm.bus.virtual_bus.servo(id).inject_error("overload")
    with pytest.raises(MotorFaultError):
        for _ in range(3):
            arm.send(start, arm.clock.now())


def at_write(arm: Arm, name: str, action: Callable[[], None]) -> None:
    """Calls ``action`` after the next write of a register to all servos."""
    original = arm.bus.sync_write
    called = []

    def spied(register, values):
        original(register, values)
        if register.name == name and not called:
            called.append(True)
            action()

    arm.bus.sync_write = spied


@pytest.mark.parametrize("policy", ["hold", "torque_off"])
@pytest.mark.parametrize("register", ["goal_position", "torque_enable"])
def test_a_stop_while_a_program_enables_again_is_not_lost(
    make_arm, arm_config, start, policy, register
):
    """The heartbeat does not carry out the request in the middle of ``enable``."""
    arm = make_arm(replace(arm_config, watchdog_ms=1000))
    arm.connect()
    arm.enable()
    bring_into_fault(arm, start)
    arm.reset_fault()

    def ask() -> None:
        arm.request_stop(policy)
        time.sleep(4 * BEAT)

    at_write(arm, register, ask)
    with pytest.raises(StopRequestedError):
        arm.enable()
    assert arm.state is ArmState.FAULT and isinstance(arm.fault, StopRequestedError)
    assert arm.exit_report.done == policy and arm.exit_report.ok
    assert torque(arm) == [policy == "hold"] * 6
    with pytest.raises(StopRequestedError):
        arm.send(start, arm.clock.now())
    time.sleep(4 * BEAT)
    assert torque(arm) == [policy == "hold"] * 6
    arm.close()
    assert arm.exit_report.done == policy


def test_a_stop_while_enabling_again_fails_is_carried_out_as_asked(arm, start, enable_fails):
    """The arm's own way to be left is torque off: it would drop what the request asks to hold."""
    arm.enable()
    bring_into_fault(arm, start)
    arm.reset_fault()
    at_write(arm, "goal_position", arm.request_stop)
    enable_fails(arm)
    assert arm.state is ArmState.FAULT and torque(arm) == [True] * 6
    assert arm.exit_report.done == "hold" and arm.exit_report.ok
    with pytest.raises(StopRequestedError):
        arm.reset_fault()
    arm.reset_fault()
    arm.enable()
    assert arm.state is ArmState.ENABLED


def test_another_process_can_stop_an_arm_while_it_is_enabled_for_the_first_time(make_arm):
    arm = make_arm()
    arm.connect()
    answers = []

    def ask() -> None:
        (running,) = running_arms()
        threading.Thread(target=lambda: answers.append(running.stop(timeout=60.0))).start()
        wait_for(running.stem.with_suffix(".stop").exists)

    at_write(arm, "goal_position", ask)
    with pytest.raises(StopRequestedError):
        arm.enable()
    wait_for(lambda: answers)
    assert answers == [(True, "it holds with torque ON")] and torque(arm) == [True] * 6


def test_a_request_before_torque_switches_nothing_on(arm):
    at_read = arm.bus.sync_read

    def ask(ids, register):
        if register.name == "profile_velocity":
            arm.request_stop()
        return at_read(ids, register)

    arm.bus.sync_read = ask
    with pytest.raises(StopRequestedError):
        arm.enable()
    assert torque(arm) == [False] * 6 and arm.exit_report.done == "untouched"


def test_a_request_before_torque_replaces_no_report(arm, enable_fails):
    enable_fails(arm)
    report = arm.exit_report
    assert report.done == "torque_off"
    arm.request_stop()
    with pytest.raises(StopRequestedError, match="not touched"):
        arm.enable()
    assert arm.exit_report is report


@pytest.mark.parametrize("connected", [False, True])
def test_a_request_before_enable_is_not_forgotten(arm_config, start, stream, connected):
    arm = open_arm(arm_config, "sim", start=start)
    steps = [arm.request_stop, arm.connect]
    for step in reversed(steps) if connected else steps:
        step()
    with pytest.raises(StopRequestedError, match="not touched"):
        arm.enable()
    assert arm.state is ArmState.FAULT and torque(arm) == [False] * 6
    arm.reset_fault()
    arm.enable()
    stream(arm, [arm.read().q] * 3)
    arm.close()
    assert arm.exit_report.done == "torque_off" and arm.exit_report.ok


def test_a_request_in_a_fault_holds_the_arm_and_a_reset_continues(arm, start, stream):
    arm.enable()
    bring_into_fault(arm, start)
    arm.request_stop()
    with pytest.raises(StopRequestedError):
        arm.reset_fault()
    assert arm.exit_report.done == "hold" and torque(arm) == [True] * 5 + [False]
    assert isinstance(arm.fault, MotorFaultError)  # it says more
    assert arm.reset_fault() == ("joint6",)
    arm.enable()
    stream(arm, [start] * 3)
    assert torque(arm) == [True] * 6
    arm.close()
    assert arm.exit_report.done == "torque_off"


WITHOUT_ASSERTIONS = """
import sys
from robot_ik.errors import HardwareError, StopRequestedError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

arm = open_arm(ArmConfig.load(sys.argv[1]), "sim")
arm.connect()
arm.enable()
home = arm.read().q
arm.bus.virtual_bus.servo(6).inject_error("overload")
try:
    for _ in range(3):
        arm.send(home, arm.clock.now())
except HardwareError as error:
    print(type(error).__name__)
arm.request_stop()
try:
    arm.reset_fault()
except StopRequestedError as error:
    print(type(error).__name__)
arm.reset_fault()
arm.enable()
arm.send(home, arm.clock.now())
print([int(servo.torque) for servo in arm.bus.virtual_bus.servos], __debug__)
"""


def test_a_request_to_hold_in_a_fault_never_drops_an_arm_without_assertions(arm_path):
    done = subprocess.run(
        [sys.executable, "-O", "-c", WITHOUT_ASSERTIONS, str(arm_path)],
        capture_output=True,
        text=True,
    )
    said = ["MotorFaultError", "StopRequestedError", "[1, 1, 1, 1, 1, 1] False"]
    assert done.stdout.splitlines() == said, done.stderr


def test_a_stop_that_the_heartbeat_carried_out_in_a_fault_is_raised_before_a_reset(make_arm, start):
    """A program that resets its own faults does not move on after a confirmed stop."""
    arm = make_arm()
    arm.connect()
    arm.enable()
    bring_into_fault(arm, start)
    (running,) = running_arms()
    ok, text = running.stop(timeout=60.0)
    assert not ok and "joint6 does NOT hold" in text  # it is the one that has shut down
    with pytest.raises(StopRequestedError):
        arm.reset_fault()
    assert arm.reset_fault() == ("joint6",)
    arm.enable()
    arm.send(start, arm.clock.now())
    assert arm.state is ArmState.ENABLED


def test_a_stop_that_a_call_has_raised_is_not_raised_again(make_arm, start):
    arm = make_arm()
    arm.connect()
    arm.enable()
    arm.request_stop()
    wait_for(lambda: arm.state is ArmState.FAULT)
    with pytest.raises(StopRequestedError):
        arm.send(start, arm.clock.now())
    arm.reset_fault()
    arm.enable()
    assert arm.state is ArmState.ENABLED


def moving_in_a_thread(arm: Arm, q) -> tuple[threading.Thread, list[BaseException]]:
    """A thread in the middle of a motion to ``q``, and what the motion raises."""
    raised: list[BaseException] = []

    def move() -> None:
        try:
            arm.move_to(q)
        except BaseException as error:
            raised.append(error)

    begin = arm.bus.virtual_bus.true_angles(arm.config)[0]
    thread = threading.Thread(target=move)
    thread.start()
    wait_for(lambda: abs(arm.bus.virtual_bus.true_angles(arm.config)[0] - begin) > 0.05)
    return thread, raised


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("policy", ["torque_off", "hold", "park"])
def test_close_of_another_thread_ends_a_motion_and_reports_the_truth(
    make_arm, start, policy, shared
):
    arm = make_arm(on_exit=policy)
    if shared:
        arm.bus.open()
    arm.connect()
    arm.enable()
    thread, raised = moving_in_a_thread(arm, start + 1.5)
    arm.close()
    report = arm.exit_report
    goals = [servo.memory.values["goal_position"] for servo in arm.bus.virtual_bus.servos]
    thread.join()
    assert [type(error) for error in raised] == [ArmStateError]
    assert report.ok and report.done == ("hold" if policy == "hold" else "torque_off")
    assert arm.exit_report is report and arm.state is ArmState.DISCONNECTED
    assert torque(arm) == [policy == "hold"] * 6
    assert [servo.memory.values["goal_position"] for servo in arm.bus.virtual_bus.servos] == goals
    true = arm.bus.virtual_bus.true_angles(arm.config)
    if policy == "park":
        assert report.parked and np.allclose(true, start, atol=0.02)
    else:
        assert np.abs(true - start).max() < 1.4
    arm.bus.close()


def test_close_while_the_heartbeat_parks_the_arm_finishes_the_parking(
    make_arm, arm_config, start, monkeypatch
):
    monkeypatch.setattr("robot_ik.hardware.arm.GIVE_UP", 0.2)
    arm = make_arm(replace(arm_config, on_stale="park"), on_exit="park")
    arm.connect()
    arm.enable()
    arm.move_to(start + 1.0)
    arm.send(start + 1.0, arm.clock.now())
    wait_for(lambda: arm.state is ArmState.MOVING)
    arm.close()
    assert arm.exit_report.ok and arm.exit_report.parked
    assert np.allclose(arm.bus.virtual_bus.true_angles(arm.config), start, atol=0.02)


def test_close_of_another_thread_during_enable_leaves_no_torque_on(make_arm, arm_config):
    arm = make_arm(replace(arm_config, watchdog_ms=2500))  # it does not trip in the pause below
    arm.bus.open()
    arm.connect()
    closer = threading.Thread(target=arm.close)

    def close() -> None:
        closer.start()
        closer.join(1.5)  # longer than it waits for this thread

    at_write(arm, "torque_enable", close)
    with pytest.raises(ArmStateError, match="another thread has closed the arm"):
        arm.enable()
    closer.join()
    assert (
        torque(arm) == [False] * 6 and arm.exit_report.ok and arm.exit_report.done == "torque_off"
    )
    assert arm.state is ArmState.DISCONNECTED
    arm.bus.close()


def test_an_arm_that_another_thread_has_closed_can_be_connected_again(make_arm, start):
    arm = make_arm()
    arm.connect()
    closer = threading.Thread(target=arm.close)
    closer.start()
    closer.join()
    with pytest.raises(ArmStateError, match="another thread"):
        arm.enable()
    arm.connect()
    arm.enable()
    arm.send(start, arm.clock.now())
    assert arm.state is ArmState.ENABLED


def test_parking_that_is_not_possible_is_reported_with_its_reason(arm_config, start):
    with open_arm(arm_config, "sim", start=start, on_exit="park") as arm:
        arm.enable()
        bring_into_fault(arm, start)
    report = arm.exit_report
    assert report.ok and not report.parked
    assert report.text == "torque is off (not parked: the arm is in fault)"
