"""The promises of ``docs/reference/safety.md`` for every servo family, on virtual servos.

The page names these tests. The judges are the registers and shafts of the virtual servos and the
goals on the wire, not the arm's own reports.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_ik.errors import (
    ArmStateError,
    BusNotOpenError,
    BusTimeoutError,
    ConfigError,
    HardwareError,
    MotorFaultError,
    ServoMismatchError,
    StopRequestedError,
    UnsafeCommandError,
)
from robot_ik.hardware import open_arm, stop_file
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.calibration import CalibrationMismatchError
from robot_ik.hardware.calibration_file import (
    Calibration,
    JointCalibration,
    calibration_beside,
)
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.servo import Gains, StopAt
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.stop_file import running_arms
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.hardware.virtual.world import World
from robot_ik.ports import RealClock, VirtualClock
from tests.hardware.family_arms import FAMILIES, IDS, PERIOD, START, family_config
from tests.hardware.joints import with_servo
from tests.waiting import wait_for

POLICIES = ("torque_off", "hold", "park")

FAR = 2.5
"""rad. A command that no motion of these tests reaches."""

SLACK = 1.0 + 1e-5
"""Rounding of speeds and accelerations."""


@pytest.fixture(params=FAMILIES)
def family(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def config(family: str) -> ArmConfig:
    return family_config(family)


@pytest.fixture
def servos(config: ArmConfig) -> VirtualBus:
    return VirtualBus.from_config(config, VirtualClock(), start=START)


@pytest.fixture
def arm(config: ArmConfig, servos: VirtualBus) -> Iterator[Arm]:
    """A connected arm in process, on virtual time."""
    with open_arm(config, "sim", virtual_bus=servos) as opened:
        yield opened


@pytest.fixture
def make_arm(config: ArmConfig, tmp_path, monkeypatch) -> Iterator[Callable[..., Arm]]:
    """Makes arms with a heartbeat on real time, in process, so that system load delays no reply."""
    monkeypatch.setattr(stop_file, "FOLDER", tmp_path / "running")
    opened: list[Arm] = []

    def make(**options: Any) -> Arm:
        servos = VirtualBus.from_config(config, RealClock(), start=START)
        arm = Arm(config, SimBus(servos, config.family.protocol), **options)
        opened.append(arm)
        return arm

    yield make
    for arm in opened:
        arm.close()


def torque(source: Arm | VirtualBus) -> list[bool]:
    servos = source.bus.virtual_bus if isinstance(source, Arm) else source
    return [servo.torque for servo in servos.servos]


def registers(source: Arm | VirtualBus, name: str) -> list[int]:
    servos = source.bus.virtual_bus if isinstance(source, Arm) else source
    return [servo.register(name) for servo in servos.servos]


def servo_of(arm: Arm, id: int) -> Any:
    return arm.bus.virtual_bus.servo(id)


def joint_values(arm: Arm) -> np.ndarray:
    return arm.bus.virtual_bus.true_angles(arm.config)


def stream(arm: Arm, q: Any, cycles: int, period: float = PERIOD) -> None:
    """Send the same command for a number of cycles."""
    for _ in range(cycles):
        arm.clock.sleep_until(arm.clock.now() + period)
        arm.send(q, arm.clock.now())


class SentGoals:
    """Goals of the control cycles: times on the arm's clock (s) and joint values (rad)."""

    def __init__(self, arm: Arm) -> None:
        self.times: list[float] = []
        self.rows: list[np.ndarray] = []
        exchange = arm.bus.exchange

        def recorded(register, values, reads, within=None):
            if values:
                self.times.append(arm.clock.now())
                q = [drive.value(values[drive.id]) for drive in arm.config.drives]
                self.rows.append(np.array(q))
            return exchange(register, values, reads, within)

        arm.bus.exchange = recorded


angles = st.one_of(st.floats(-10, 10), st.floats(), st.sampled_from([np.pi, -np.pi, 1e9, 1e-300]))
commands = st.lists(st.lists(angles, min_size=6, max_size=6), min_size=1, max_size=12)
laws = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None
)


@laws
@given(commands=commands, turned=st.integers(-300, 300))
def test_no_command_puts_a_goal_beyond_the_limits_on_the_wire(
    config, goal_recorder, commands, turned
):
    """The first joint may start up to 16 degrees outside its limits."""
    servos = VirtualBus.from_config(
        config, VirtualClock(), start=[np.radians(150.0), 0, 0, 0, 0, 0]
    )
    servos.servo(1).rotate_by_hand(turned)
    before = goal_recorder.goals
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        for number, q in enumerate(commands):
            arm.clock.sleep_until(arm.clock.now() + PERIOD * (1 + number % 3))
            with contextlib.suppress(UnsafeCommandError):
                arm.send(q, arm.clock.now())
        arm.hold()
    assert goal_recorder.goals > before
    assert not goal_recorder.forbidden


@laws
@given(targets=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=6))
def test_goals_keep_the_speed_and_acceleration_caps(config, targets):
    servos = VirtualBus.from_config(config, VirtualClock(), start=START)
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        goals = SentGoals(arm)
        for target in targets:
            stream(arm, np.full(6, target), 20)
    q = np.array(goals.rows)
    speeds = np.diff(q, axis=0) / PERIOD
    rounding = config.resolution / PERIOD
    assert (np.abs(speeds) <= config.velocity * SLACK + 2.0 * rounding).all()
    # Over five cycles rounding to whole ticks is small beside the change of speed.
    span = 5
    changes = speeds[span:] - speeds[:-span]
    allowed = config.acceleration * span * PERIOD * SLACK + 4.0 * rounding
    assert (np.abs(changes) <= allowed).all()


@pytest.mark.parametrize("pause", [0.05, 0.2])
def test_after_a_pause_the_goals_start_from_rest(arm, pause):
    arm.enable()
    stream(arm, np.full(6, FAR), 40)
    goals = SentGoals(arm)
    arm.clock.sleep_until(arm.clock.now() + pause)
    arm.send(np.full(6, FAR), arm.clock.now())
    stream(arm, np.full(6, FAR), 1)
    moved = np.abs(goals.rows[1] - goals.rows[0])
    # Two steps from rest. At the speed before the pause one step is 0.0157 rad.
    allowed = 3.0 * arm.config.acceleration * PERIOD**2 * SLACK + 2.0 * arm.resolution
    assert (moved <= allowed).all()


def test_running_into_a_limit_at_speed_stops_before_it(arm, config):
    arm.enable()
    stream(arm, np.full(6, 9.0), 400)
    assert (joint_values(arm) <= config.upper + 1e-9).all()
    assert joint_values(arm) == pytest.approx(config.upper, abs=0.01)


WRONG_COMMANDS = [
    [np.nan, 0, 0, 0, 0, 0],
    [0, 0, np.inf, 0, 0, 0],
    [0.0] * 5,
    ["0.1"] * 6,
    [1j] * 6,
    np.zeros(6, "datetime64[s]"),
    np.ma.masked_array(np.zeros(6), mask=[0, 0, 1, 0, 0, 0]),
    {"no_joint": 0.0},
    {"joint1": np.nan},
]


@pytest.mark.parametrize("q", WRONG_COMMANDS, ids=str)
def test_no_wrong_command_reaches_a_servo(arm, goal_recorder, q):
    arm.enable()
    before = goal_recorder.goals
    for command in (lambda: arm.send(q, arm.clock.now()), lambda: arm.move_to(q)):
        with pytest.raises(UnsafeCommandError, match="Nothing was sent"):
            command()
    assert goal_recorder.goals == before


def test_torque_comes_on_where_the_arm_stands(arm):
    """A hand has turned the arm since the servos got their last goals."""
    for servo in arm.bus.virtual_bus.servos:
        servo.rotate_by_hand(150)
    before = joint_values(arm)
    goals: list[list[int]] = []
    write = arm.bus.sync_write

    def watched(register, values):
        if register.name == "torque_enable":
            goals.append(registers(arm, "goal_position"))
        write(register, values)

    arm.bus.sync_write = watched
    shafts = [round(servo.true_ticks) for servo in arm.bus.virtual_bus.servos]
    arm.enable()
    assert goals[0] == pytest.approx(shafts, abs=1)
    assert all(torque(arm))
    arm.clock.sleep_until(arm.clock.now() + 0.2)
    assert joint_values(arm) == pytest.approx(before, abs=float(arm.resolution.max()))


def lose_a_servo(servos: VirtualBus) -> None:
    servos.servo(3).silent = True


def change_the_model(servos: VirtualBus) -> None:
    servos.servo(4).set_register("model_number", 1)


def raise_the_supply(servos: VirtualBus) -> None:
    servos.servo(1).set_supply(25.0)


def lower_the_supply(servos: VirtualBus) -> None:
    servos.servo(1).set_register("present_input_voltage", 50)


def overheat(servos: VirtualBus) -> None:
    servos.servo(5).inject_error("overheating")


def reverse_a_servo(servos: VirtualBus) -> None:
    servos.servo(1).set_register("drive_mode", 1)


def narrow_the_limits(servos: VirtualBus) -> None:
    servos.servo(2).set_register("min_position_limit", 2000)


WRONG_SERVOS = [
    ("dynamixel_x", lose_a_servo, ServoMismatchError, "missing"),
    ("feetech_sts", lose_a_servo, ServoMismatchError, "missing"),
    ("dynamixel_x", change_the_model, ServoMismatchError, "joint4"),
    ("feetech_sts", change_the_model, ServoMismatchError, "joint4"),
    ("dynamixel_x", raise_the_supply, MotorFaultError, "input_voltage"),
    ("feetech_sts", raise_the_supply, MotorFaultError, "input_voltage"),
    ("dynamixel_x", lower_the_supply, MotorFaultError, r"5\.0 V"),
    ("dynamixel_x", overheat, MotorFaultError, "overheating"),
    ("feetech_sts", overheat, MotorFaultError, "overheating"),
    ("dynamixel_x", reverse_a_servo, HardwareError, "reverse"),
    ("feetech_sts", narrow_the_limits, ConfigError, "narrower"),
]
"""(family, what is wrong, error, text). STS servos have no reverse bit."""


@pytest.mark.parametrize(
    ("family", "spoil", "error", "text"),
    WRONG_SERVOS,
    ids=[f"{family}-{spoil.__name__}" for family, spoil, _, _ in WRONG_SERVOS],
)
def test_wrong_servos_get_no_torque(config, servos, spoil, error, text):
    spoil(servos)
    arm = open_arm(config, "sim", virtual_bus=servos)
    with pytest.raises(error, match=text):
        arm.connect()
    assert not any(torque(servos))


@pytest.mark.parametrize("family", ["dynamixel_x"])
def test_a_servo_that_lost_revolutions_gets_no_torque(config, servos):
    """STS servos count one revolution and lose none."""
    servos.servo(1).rotate_by_hand(2 * 4096)
    with (
        open_arm(config, "sim", virtual_bus=servos) as arm,
        pytest.raises(HardwareError, match="lost count of its revolutions"),
    ):
        arm.enable()
    assert not any(torque(servos))


def test_an_arm_that_differs_from_its_calibration_gets_no_torque(config, tmp_path):
    """Servo 2 has another Homing Offset than when the arm was calibrated."""
    file = tmp_path / "arm.toml"
    config.save(file)
    loaded = ArmConfig.load(file)
    servos = VirtualBus.from_config(loaded, VirtualClock(), start=START)
    rows = tuple(
        JointCalibration(
            drive.name,
            drive.id,
            drive.servo.model,
            0,
            5 if drive.id == 2 else 0,
            *drive.ticks_range,
            drive.servo.direction,
            drive.servo.zero_ticks,
            -160.0,
            160.0,
        )
        for drive in loaded.drives
    )
    calibration = Calibration(loaded.name, loaded.robot, "2026-01-01T00:00:00", rows)
    calibration.save(calibration_beside(file))
    arm = Arm(loaded, SimBus(servos, loaded.family.protocol, real=True))
    with pytest.raises(CalibrationMismatchError, match=r"joint2 *homing_offset"), arm:
        arm.enable()
    assert not any(torque(servos))


def finish(_arm: Arm) -> None:
    """End normally."""


def fail(_arm: Arm) -> None:
    raise RuntimeError("a bug of the program")


def interrupt(_arm: Arm) -> None:
    signal.raise_signal(signal.SIGINT)


def terminate(_arm: Arm) -> None:
    signal.raise_signal(signal.SIGTERM)


ENDS = {finish: None, fail: RuntimeError, interrupt: KeyboardInterrupt, terminate: SystemExit}
"""How a program ends -> what it raises."""


@pytest.mark.parametrize("end", ENDS, ids=lambda end: end.__name__)
@pytest.mark.parametrize("policy", POLICIES)
def test_an_arm_is_left_as_on_exit_says(config, servos, policy, end):
    error = ENDS[end]
    with (
        contextlib.nullcontext() if error is None else pytest.raises(error),
        open_arm(config, "sim", virtual_bus=servos, on_exit=policy) as arm,
    ):
        arm.enable()
        stream(arm, START + 0.3, 50)
        end(arm)
    assert arm.exit_report.ok
    assert torque(servos) == [policy == "hold"] * 6
    if policy == "park":
        assert servos.true_angles(config) == pytest.approx(START, abs=0.01)
    if policy == "hold":
        before = servos.true_angles(config)
        servos.clock.sleep_until(servos.clock.now() + 2.0)
        assert servos.true_angles(config) == pytest.approx(before, abs=0.01)


def test_a_joint_that_does_not_take_its_goal_is_not_confirmed_to_hold(config, servos):
    with open_arm(config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, START, 3)
        write = arm.bus.sync_write

        def lossy(register, values):
            if register.name == "goal_position":
                values = {id: value for id, value in values.items() if id != 3}
            write(register, values)

        arm.bus.sync_write = lossy
        servo = servos.servo(3)
        servo.set_register("goal_position", servo.register("goal_position") + 100)
    assert arm.exit_report.done == "hold"
    assert arm.exit_report.unverified == ("joint3",)


def park_with_signals(config: ArmConfig, signals: int) -> Arm:
    """Raise SIGINT a number of times while an arm is parked at a normal end."""
    servos = VirtualBus.from_config(config, VirtualClock(), start=START)
    remaining = [signals]
    with (
        pytest.raises(KeyboardInterrupt),
        open_arm(config, "sim", virtual_bus=servos, on_exit="park") as arm,
    ):
        arm.enable()
        stream(arm, START + 0.4, 100)
        exchange = arm.bus.exchange

        def interrupted(register, values, reads, within=None):
            if arm.state is ArmState.MOVING and remaining[0]:
                remaining[0] -= 1
                signal.raise_signal(signal.SIGINT)
            return exchange(register, values, reads, within)

        arm.bus.exchange = interrupted
    assert remaining == [0]
    return arm


def test_one_signal_does_not_cut_a_parking_short(config):
    arm = park_with_signals(config, 1)
    assert arm.exit_report.parked
    assert arm.exit_report.ok
    assert joint_values(arm) == pytest.approx(START, abs=0.01)


def test_the_second_signal_ends_a_parking(config):
    arm = park_with_signals(config, 2)
    assert not arm.exit_report.parked
    assert arm.exit_report.ok
    assert np.abs(joint_values(arm) - START).max() > 0.1
    assert not any(torque(arm))


def test_torque_that_a_failed_enable_left_on_is_reported(config, servos):
    arm = open_arm(config, "sim", virtual_bus=servos)
    arm.connect()
    write = arm.bus.sync_write

    def silenced(register, values):
        write(register, values)
        if register.name == "torque_enable" and 1 in values.values():
            servos.inject(*(Fault("silent", id=id) for id in IDS))

    arm.bus.sync_write = silenced
    with pytest.raises(HardwareError):
        arm.enable()
    assert all(torque(servos))
    for _ in range(2):
        assert not arm.exit_report.ok
        assert set(arm.exit_report.unverified) == set(arm.joints)
        assert "torque may be ON" in arm.exit_report.text
        arm.close()


def test_torque_that_a_failed_enable_took_back_is_reported(arm, enable_fails):
    enable_fails(arm)
    assert not any(torque(arm))
    arm.close()
    assert arm.exit_report.ok
    assert arm.exit_report.done == "torque_off"


def test_a_joint_without_torque_is_not_reported_to_hold(config, servos):
    """It gets no torque either: only ``enable`` gives torque."""
    with open_arm(config, "sim", virtual_bus=servos, on_exit="hold") as arm:
        arm.enable()
        stream(arm, START, 3)
        servos.servo(4).set_register("torque_enable", 0)
    assert arm.exit_report.unverified == ("joint4",)
    assert arm.exit_report.limp == ("joint4",)
    assert torque(servos) == [True, True, True, False, True, True]


@pytest.mark.parametrize("policy", POLICIES)
def test_leaving_an_arm_touches_its_own_servos_only(config, servos, policy):
    """Servos 1 to 4 hold for another program."""
    part = config.only(("joint5", "joint6"))
    for id in (1, 2, 3, 4):
        servos.servo(id).set_register("torque_enable", 1)
    before = [servo.register("goal_position") for servo in servos.servos[:4]]
    with open_arm(part, "sim", virtual_bus=servos, on_exit=policy) as arm:
        arm.enable()
        stream(arm, START[4:] + 0.1, 20)
    assert arm.exit_report.ok
    assert torque(servos) == [True] * 4 + [policy == "hold"] * 2
    assert [servo.register("goal_position") for servo in servos.servos[:4]] == before


@pytest.mark.parametrize("policy", ["torque_off", "park"])
def test_a_dead_servo_does_not_keep_the_others_on(config, servos, policy):
    with open_arm(config, "sim", virtual_bus=servos, on_exit=policy) as arm:
        arm.enable()
        stream(arm, START, 3)
        servos.servo(3).silent = True
    assert torque(servos) == [False, False, True, False, False, False]
    assert arm.exit_report.unverified == ("joint3",)


def test_a_pulled_cable_does_not_hang_the_program(config, servos):
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, START, 3)
        servos.unplugged = True
        begin = servos.clock.now()
    assert servos.clock.now() - begin <= 1.2
    assert len(arm.exit_report.unverified) == 6


LEVER = """
<mujoco><worldbody><body><joint name="joint1" axis="0 -1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".01" mass=".5"/>
</body></worldbody></mujoco>
"""
"""A lever that is level at q = 0."""

SINKING = np.radians(0.1)
"""rad by which a held arm may sink in a minute."""


@pytest.fixture
def lever(config: ArmConfig) -> Iterator[tuple[Arm, World]]:
    part = config.only(("joint1",))
    servos = VirtualBus.from_config(part, VirtualClock(), start=[0.0])
    world = World(mujoco.MjModel.from_xml_string(LEVER), part, servos)
    with open_arm(part, "sim", virtual_bus=servos) as arm:
        yield arm, world


def test_a_held_arm_does_not_sink_in_a_minute(lever):
    """The program sends the same pose twice a second; a bus watchdog trips in every pause."""
    arm, world = lever
    arm.enable()
    stream(arm, [0.0], 100)
    heights = []
    for number in range(120):
        arm.clock.sleep_until(arm.clock.now() + 0.5)
        arm.send([0.0], arm.clock.now())
        if number >= 2:
            heights.append(float(world.data.qpos[0]))
    assert max(heights) - min(heights) < SINKING
    assert abs(heights[-1]) < 0.2


def push_dynamixel_x(servo: Any, torque: float) -> None:
    """A Dynamixel servo without a world gives way only if its shaft is placed elsewhere."""
    servo.stuck = True
    servo.shaft.stuck_at += 10.0 * torque


def push_feetech_sts(servo: Any, torque: float) -> None:
    servo.push = torque


PUSHES = {"dynamixel_x": push_dynamixel_x, "feetech_sts": push_feetech_sts}


def test_a_held_joint_that_is_pushed_keeps_its_goal(arm, family):
    arm.enable()
    stream(arm, START, 3)
    arm.hold()
    servo = servo_of(arm, 2)
    goal = servo.register("goal_position")
    # A pause of 0.5 s trips a bus watchdog.
    for pushed, pause in ((20.0, 0.05), (-50.0, 0.05), (60.0, 0.5)):
        PUSHES[family](servo, pushed)
        arm.clock.sleep_until(arm.clock.now() + pause)
        arm.read()
        arm.hold()
        assert abs(servo.true_ticks - goal) > 100
        assert servo.register("goal_position") == goal


steps = st.tuples(
    st.one_of(st.just(PERIOD), st.floats(-0.5, 0.5), st.just(0.0)),
    st.one_of(st.just(PERIOD), st.floats(0.0, 0.3)),
)
"""Steps of the caller's clock and of the arm's clock, s."""


@laws
@given(steps=st.lists(steps, min_size=20, max_size=60), sign=st.sampled_from([1.0, -1.0]))
def test_no_clock_of_a_program_moves_the_arm_faster_than_its_caps(config, steps, sign):
    servos = VirtualBus.from_config(config, VirtualClock())
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        goals = SentGoals(arm)
        time = 0.0
        for caller_step, arm_step in steps:
            time += caller_step
            arm.clock.sleep_until(arm.clock.now() + arm_step)
            arm.send(np.full(6, sign * FAR), time)
    pairs = itertools.combinations(zip(goals.times, goals.rows, strict=True), 2)
    for (first_time, first), (last_time, last) in pairs:
        if last_time - first_time >= 0.1:
            allowed = config.velocity * (last_time - first_time + PERIOD) * SLACK
            assert (np.abs(last - first) <= allowed + config.resolution).all()


@pytest.mark.parametrize("policy", ["hold", "torque_off"])
def test_another_process_can_stop_a_running_arm(make_arm, policy):
    """As ``robot-ik stop`` does, through the request files; the program sends no commands."""
    arm = make_arm()
    arm.connect()
    arm.enable()
    (running,) = running_arms()
    ok, text = running.stop(policy, timeout=60.0)
    assert ok, text
    assert torque(arm) == [policy == "hold"] * 6
    with pytest.raises(StopRequestedError):
        arm.send(START, arm.clock.now())


def test_a_stop_that_a_servo_does_not_confirm_is_no_success(make_arm):
    arm = make_arm()
    arm.connect()
    arm.enable()
    servo_of(arm, 3).silent = True
    (running,) = running_arms()
    ok, text = running.stop(timeout=60.0)
    assert not ok
    assert "joint3" in text


@pytest.mark.parametrize("connected", [False, True])
def test_a_request_before_enable_is_carried_out(config, servos, connected):
    arm = open_arm(config, "sim", virtual_bus=servos)
    if connected:
        arm.connect()
        arm.request_stop()
    else:
        arm.request_stop()
        arm.connect()
    with pytest.raises(StopRequestedError):
        arm.enable()
    assert not any(torque(servos))
    arm.close()


@pytest.mark.parametrize("policy", ["hold", "torque_off"])
@pytest.mark.parametrize("name", ["goal_position", "torque_enable"])
def test_a_request_during_enable_is_carried_out(config, servos, name, policy):
    arm = open_arm(config, "sim", virtual_bus=servos)
    arm.connect()
    write = arm.bus.sync_write
    requested = []

    def watched(register, values):
        write(register, values)
        if register.name == name and not requested:
            requested.append(policy)
            arm.request_stop(policy)

    arm.bus.sync_write = watched
    with pytest.raises(StopRequestedError):
        arm.enable()
    assert requested
    assert arm.state is ArmState.FAULT
    # Before torque came on, no servo of either family gets any.
    untouched = name == "goal_position" and arm.exit_report.done == "untouched"
    assert torque(servos) == [policy == "hold" and not untouched] * 6
    with pytest.raises(StopRequestedError):
        arm.send(START, arm.clock.now())
    arm.close()


def test_a_request_in_a_fault_holds_the_arm_until_it_was_raised(arm):
    arm.enable()
    servo_of(arm, 6).inject_error("overheating")
    with pytest.raises(MotorFaultError):
        stream(arm, START, 3)
    arm.request_stop()
    with pytest.raises(StopRequestedError):
        arm.reset_fault()
    assert torque(arm) == [True] * 5 + [False]
    servo_of(arm, 6).reboot()
    arm.reset_fault()
    arm.enable()
    stream(arm, START, 3)
    assert all(torque(arm))


@pytest.mark.parametrize("policy", POLICIES)
def test_close_of_another_thread_ends_a_motion(make_arm, policy):
    arm = make_arm(on_exit=policy)
    arm.connect()
    arm.enable()
    raised: list[BaseException] = []

    def move() -> None:
        try:
            arm.move_to(START + 1.5)
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=move)
    thread.start()
    wait_for(lambda: joint_values(arm)[0] > START[0] + 0.05)
    arm.close()
    goals = registers(arm, "goal_position")
    thread.join()
    assert [type(error) for error in raised] == [ArmStateError]
    assert arm.exit_report.ok
    assert torque(arm) == [policy == "hold"] * 6
    assert np.abs(joint_values(arm) - START).max() < 1.4
    assert registers(arm, "goal_position") == goals


SHUTDOWNS = [
    ("dynamixel_x", "overheating"),
    ("dynamixel_x", "input_voltage"),
    ("dynamixel_x", "overload"),
    ("feetech_sts", "overheating"),
    ("feetech_sts", "input_voltage"),
    ("feetech_sts", "encoder"),
]
"""(family, error that switches the motor off).

An overload of an STS servo ends with the next goal, so `[joints.stop_at]` takes its place.
"""


@pytest.mark.parametrize(("family", "error"), SHUTDOWNS)
def test_a_servo_that_shuts_down_stops_the_arm_in_the_same_cycle(arm, error):
    arm.enable()
    stream(arm, START, 3)
    servo_of(arm, 6).inject_error(error)
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, START, 1)
    assert caught.value.joint == "joint6"
    assert caught.value.status == (error,)
    assert torque(arm)[:5] == [True] * 5


@pytest.mark.parametrize("loses", ["torque", "power"])
def test_a_servo_that_loses_its_torque_stops_the_arm_in_the_same_cycle(arm, loses):
    arm.enable()
    stream(arm, START, 3)
    servo = servo_of(arm, 4)
    if loses == "torque":
        # The goal of the same cycle may switch torque on again, so the servo must ignore it.
        arm.bus.virtual_bus.inject(*keeps_torque(arm))
        servo.set_register("torque_enable", 0)
    else:
        servo.reboot()
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, START, 1)
    assert caught.value.joint == "joint4"
    assert caught.value.status == ("torque_lost",)
    assert torque(arm)[:3] == [True] * 3


def keeps_torque(arm: Arm, for_packets: int | None = None) -> list[Fault]:
    """Return the fault by which a goal does not switch torque on, in families where it may."""
    enables = arm.config.family.capabilities.goal_enables_torque
    return [Fault("goal_keeps_torque", for_packets=for_packets)] if enables else []


LONGEST_SILENCE = {"dynamixel_x": 0.25, "feetech_sts": 0.42}
"""Family -> s after which a silent servo is a fault, as the page says for a wire."""


def test_a_silent_servo_stops_the_arm_and_the_others_hold(arm, family):
    arm.enable()
    stream(arm, START, 3)
    servo_of(arm, 3).silent = True
    begin = arm.clock.now()
    with pytest.raises(MotorFaultError) as caught:
        stream(arm, START, 100)
    assert caught.value.joint == "joint3"
    assert arm.clock.now() - begin <= LONGEST_SILENCE[family]
    assert all(torque(arm))


def test_a_bus_on_which_all_servos_are_silent_stops_the_arm(arm):
    arm.enable()
    stream(arm, START, 3)
    arm.bus.virtual_bus.inject(Fault("silent"))
    with pytest.raises(BusTimeoutError, match="no servo answers"):
        stream(arm, START, 100)


def test_a_threshold_stops_the_arm_before_the_servo_shuts_down(config, servos):
    joints = list(config.joints)
    joints[1] = dataclasses.replace(joints[1], stop_at=StopAt(temperature_c=50.0))
    watched = dataclasses.replace(config, joints=tuple(joints))
    with open_arm(watched, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, START, 50)
        servos.servo(2).heat_to(60.0)
        begin = arm.clock.now()
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, START, 200)
        assert caught.value.joint == "joint2"
        assert caught.value.status == ("temperature_limit",)
        assert 0.5 <= arm.clock.now() - begin <= 0.6
        assert all(torque(servos))


def test_a_short_peak_beyond_a_threshold_does_not_stop_the_arm(config, servos):
    joints = list(config.joints)
    joints[1] = dataclasses.replace(joints[1], stop_at=StopAt(temperature_c=50.0))
    watched = dataclasses.replace(config, joints=tuple(joints))
    with open_arm(watched, "sim", virtual_bus=servos) as arm:
        arm.enable()
        for _ in range(10):
            servos.servo(2).heat_to(60.0)
            stream(arm, START, 40)
            servos.servo(2).heat_to(35.0)
            stream(arm, START, 4)
        assert arm.state is ArmState.ENABLED


SPEED_REGISTERS = {
    "dynamixel_x": ("profile_velocity", "profile_acceleration"),
    "feetech_sts": ("goal_velocity", "acceleration"),
}
"""Family -> RAM registers that limit speed and acceleration."""


@pytest.fixture
def tuned(config: ArmConfig) -> ArmConfig:
    """The arm with gains of its own in every servo."""
    joints = tuple(with_servo(joint, gains=Gains(position_p=20)) for joint in config.joints)
    return dataclasses.replace(config, joints=joints)


def settings_of(servo: Any) -> tuple[int, ...]:
    names = ("position_p_gain", *SPEED_REGISTERS[servo.table.family])
    return tuple(servo.register(name) for name in names)


def test_settings_of_the_arm_file_are_in_the_servos_after_every_restart(tuned, servos):
    with open_arm(tuned, "sim", virtual_bus=servos) as arm:
        servo = servos.servo(1)
        settings = settings_of(servo)
        assert settings[0] == 20
        assert all(settings)
        arm.enable()
        stream(arm, START, 3)
        servo.reboot()
        with pytest.raises(MotorFaultError):
            stream(arm, START, 50)
        assert settings_of(servo) != settings
        arm.reset_fault()
        assert settings_of(servo) == settings


@pytest.mark.parametrize("id", [1, 6])
def test_a_servo_that_restarted_since_connect_gets_no_torque(tuned, servos, id):
    with open_arm(tuned, "sim", virtual_bus=servos) as arm:
        settings = settings_of(servos.servo(id))
        servos.servo(id).reboot()
        with pytest.raises(HardwareError, match=rf"joint{id}.*restarted.*nothing was switched on"):
            arm.enable()
        assert not any(torque(servos))
        arm.reconnect()
        assert settings_of(servos.servo(id)) == settings
        arm.enable()
        stream(arm, START, 3)


def test_a_servo_that_restarts_at_any_packet_of_enable_is_noticed(config):
    def opened() -> Arm:
        servos = VirtualBus.from_config(config, VirtualClock(), start=START)
        return open_arm(config, "sim", virtual_bus=servos)

    with opened() as arm:
        before = arm.bus.virtual_bus.schedule.packets
        arm.enable()
        packets = arm.bus.virtual_bus.schedule.packets - before
    assert packets >= 10
    for packet in range(1, packets + 1):
        with opened() as arm:
            arm.bus.virtual_bus.inject(Fault("reboot", 2, at_packet=packet))
            with pytest.raises(HardwareError, match="restarted"):
                arm.enable()
                stream(arm, START, 3)


WEAK_SERVOS = [
    ("dynamixel_x", "position_p_gain", 0),
    ("dynamixel_x", "goal_pwm", 200),
    ("dynamixel_x", "pwm_limit", 50),
    ("feetech_sts", "position_p_gain", 0),
    ("feetech_sts", "torque_limit", 200),
]
"""(family, register, value with which a servo could not hold the arm)."""


@pytest.mark.parametrize(("family", "name", "value"), WEAK_SERVOS)
@pytest.mark.parametrize("connected", [False, True])
def test_a_servo_too_weak_to_hold_the_arm_gets_no_torque(config, servos, name, value, connected):
    arm = open_arm(config, "sim", virtual_bus=servos)
    if connected:
        arm.connect()
        servos.servo(2).set_register(name, value)
        step = arm.enable
    else:
        servos.servo(2).set_register(name, value)
        step = arm.connect
    with pytest.raises(HardwareError, match=r"joint2.*nothing was switched on"):
        step()
    assert not any(torque(servos))
    arm.close()


def test_a_joint_that_falls_behind_its_commands_stops_the_arm(arm):
    arm.enable()
    stream(arm, START, 3)
    servo_of(arm, 4).stuck = True
    with pytest.raises(MotorFaultError, match="joint4 does not follow") as caught:
        for step in range(200):
            stream(arm, START + 0.006 * step, 1)
    assert caught.value.status == ("not_following",)
    assert all(torque(arm))


def test_a_motion_at_the_caps_is_no_fault(arm):
    arm.enable()
    for sign in (1.0, -1.0, 1.0):
        stream(arm, START + sign, 200)
    assert arm.state is ArmState.ENABLED


def test_an_arm_follows_on_a_wire_with_every_fault(config, servos):
    """Every position that the arm reads is a true one, as old as the arm says."""
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        servos.reseed(5)
        servos.inject(*(Fault(name, value=3e-3) for name in SPOILS))
        begin = arm.clock.now()
        for cycle in range(500):
            now = begin + PERIOD * (cycle + 1)
            arm.clock.sleep_until(now)
            wanted = START + 0.3 * np.sin(0.5 * (now - begin))
            arm.send(wanted, now)
            error = np.abs(arm.read().q - joint_values(arm))
            assert (error <= arm.resolution + 1.6 * config.velocity * arm.ages).all()
            assert np.abs(joint_values(arm) - wanted).max() < 0.03
        assert arm.state is ArmState.ENABLED
        assert arm.bus.counters.corrupt > 0
        servos.clear()
    assert arm.exit_report.ok


def test_only_enable_switches_torque_on(arm):
    assert not any(torque(arm))
    arm.enable()
    stream(arm, START, 3)
    servo_of(arm, 6).reboot()
    with pytest.raises(MotorFaultError):
        stream(arm, START, 3)
    expected = [*torque(arm)[:5], False]
    servo_of(arm, 6).set_register("torque_enable", 0)
    arm.reset_fault()
    assert arm.state is ArmState.CONNECTED
    assert torque(arm) == expected
    arm.reconnect()
    assert torque(arm) == expected
    arm.enable()
    assert all(torque(arm))


def test_a_servo_that_lost_its_torque_gets_no_goal_in_a_fault(arm):
    arm.enable()
    stream(arm, START, 3)
    servo = servo_of(arm, 4)
    # The goal and the read of one cycle. A later goal would switch torque on.
    arm.bus.virtual_bus.inject(*keeps_torque(arm, for_packets=2))
    servo.set_register("torque_enable", 0)
    with pytest.raises(MotorFaultError):
        stream(arm, START, 1)
    assert arm.state is ArmState.FAULT
    arm.clock.sleep_until(arm.clock.now() + 1.0)
    arm.read()
    assert not servo.torque


@pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")
def test_a_second_program_is_refused(config, real_time):
    from robot_ik.hardware.virtual.pty import PtyPort  # not on Windows

    protocol = config.family.protocol
    with PtyPort(VirtualBus.from_config(config, RealClock())) as port:
        first = SerialBus(port.path, config.baud, protocol)
        second = SerialBus(port.path, config.baud, protocol)
        first.open()
        with pytest.raises(BusNotOpenError, match=f"already open.*process {os.getpid()}"):
            second.open()
        assert first.ping(1) == config.drives[0].servo.table.number
        first.close()
        second.open()
        second.close()
