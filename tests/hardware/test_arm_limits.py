"""Only goals within limits are on the wire, whatever is commanded, and the recorder works."""

from __future__ import annotations

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_ik.errors import HardwareError, UnsafeCommandError
from robot_ik.hardware import open_arm, simulated_servos
from robot_ik.hardware.bus import BROADCAST_ID
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.packets import build
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import Instruction
from robot_ik.ports import VirtualClock
from robot_ik.robot_file import catalogue

GOAL = X_TABLES["XM430-W350"]["goal_position"]
angles = st.one_of(st.floats(-10, 10), st.floats(), st.sampled_from([np.pi, -np.pi, 1e9, 1e-300]))
commands = st.lists(st.lists(angles, min_size=6, max_size=6), min_size=1, max_size=12)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None
)
@given(commands, st.integers(-300, 300))
def test_no_command_puts_a_goal_beyond_the_limits_on_the_wire(
    arm_config, goal_recorder, commands, turned
):
    """Also from a start outside the limits: joint1 is turned by hand up to 26 degrees beyond."""
    servos = VirtualBus.from_config(
        arm_config, VirtualClock(), start=[np.radians(159.0), 0, 0, 0, 0, 0]
    )
    servos.servo(1).rotate_by_hand(turned)
    before = goal_recorder.goals
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        for k, q in enumerate(commands):
            arm.clock.sleep_until(arm.clock.now() + 0.01 * (1 + k % 3))
            with contextlib.suppress(UnsafeCommandError):
                arm.send(q, arm.clock.now())
        arm.hold()
    assert goal_recorder.goals > before
    assert not goal_recorder.forbidden


def test_the_recorder_sees_a_goal_beyond_the_limits_however_it_is_written(arm, goal_recorder):
    first, last = arm.config.joints[0].ticks_range()
    arm.bus.sync_write(GOAL, {1: last, 2: 2048})
    assert goal_recorder.goals == 2 and not goal_recorder.forbidden
    arm.bus.sync_write(GOAL, {1: last + 1})
    arm.bus.write(1, GOAL, first - 1)
    arm.bus.exchange(GOAL, {1: last + 1}, {1: GOAL})
    bulk = [
        bytes((1,)) + struct.pack("<HHi", GOAL.address, 4, last + 1),
        bytes((2, 65, 0, 1, 0, 1)),
    ]
    arm.bus.virtual_bus.handle(build(BROADCAST_ID, Instruction.BULK_WRITE, b"".join(bulk)))
    assert len(goal_recorder.forbidden) == 4
    assert "joint1" in goal_recorder.forbidden[0]
    goal_recorder.forbidden.clear()


ARMS = [name for name, folder in catalogue().items() if (folder / "arm.toml").is_file()]


@pytest.mark.parametrize("name", ARMS)
def test_the_ends_of_the_range_are_the_last_goals_of_every_shipped_arm(name, goal_recorder):
    """Beyond both ends, the last goals are the last whole ticks whose angles lie within."""
    config = ArmConfig.load(name)
    servos = simulated_servos(config, VirtualClock(), (config.lower + config.upper) / 2)
    sent: dict[int, set[int]] = {servo.id: set() for servo in config.servos}
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        exchange = arm.bus.exchange

        def recorded(register, values, reads, within=None):
            for id, goal in values.items():
                sent[id].add(goal)
            return exchange(register, values, reads, within)

        arm.bus.exchange = recorded
        arm.enable()
        for end in (config.upper, config.lower):
            arm.move_to(end, timeout=60.0)
            with contextlib.suppress(HardwareError):
                arm.move_to(end + np.sign(end - (config.lower + config.upper) / 2), timeout=1.0)
    assert not goal_recorder.forbidden
    for servo in config.drives:
        if servo.is_shadow:  # it hears the goals of its first servo
            continue
        first = min(sent[servo.id])
        last = max(sent[servo.id])
        lower, upper = servo.joint.limits
        assert (first, last) == servo.ticks_range
        for ticks in (first, last):
            assert lower <= servo.value(ticks) <= upper
        beyond = sorted(servo.value(ticks) for ticks in (first - 1, last + 1))
        assert beyond[0] < lower and beyond[1] > upper


HOSTILE = [
    "1",
    None,
    [],
    object(),
    10**400,
    [10**400] * 6,
    ["0.1"] * 6,
    [1j] * 6,
    np.zeros(6, complex),
    np.zeros(6, "datetime64[s]"),
    np.zeros(6, "timedelta64[s]"),
    np.ones(6, bool),
    np.array(["1"] * 6, object),
    np.ma.masked_array(np.zeros(6), mask=[0, 0, 1, 0, 0, 0]),
    np.zeros((6, 1)),
    {"joint1": "0"},
    {"joint1": 10**400},
    {"joint1": None},
    {1: 0.0},
    {"joint1": 1j},
    {"joint1": [0.0, 1.0]},
]


@pytest.mark.parametrize("q", HOSTILE, ids=lambda q: type(q).__name__)
def test_what_is_no_angle_is_refused_and_sends_nothing(arm, goal_recorder, q):
    arm.enable()
    before = goal_recorder.goals
    for command in (lambda: arm.send(q, arm.clock.now()), lambda: arm.move_to(q)):
        with pytest.raises(UnsafeCommandError, match="Nothing was sent"):
            command()
    assert goal_recorder.goals == before


@pytest.mark.parametrize(
    "time", ["1", None, 1j, 10**400, np.datetime64("2026-01-01"), [1.0], np.nan]
)
def test_what_is_no_time_is_refused_and_sends_nothing(arm, goal_recorder, start, time):
    arm.enable()
    before = goal_recorder.goals
    with pytest.raises(UnsafeCommandError, match="a command for the time"):
        arm.send(start, time)
    if time is not None:
        with pytest.raises(UnsafeCommandError, match="a timeout of"):
            arm.move_to(start, timeout=time)
    assert goal_recorder.goals == before


def test_numbers_of_every_kind_are_taken(arm, start):
    arm.enable()
    for q in (
        start.astype(np.float32),
        list(start),
        tuple(map(np.float64, start)),
        [0] * 6,
        np.ma.array(start),
    ):
        arm.clock.sleep_until(arm.clock.now() + 0.01)
        arm.send(q, arm.clock.now())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_a_number_reaches_no_servo(arm, goal_recorder, bad, start):
    arm.enable()
    before = goal_recorder.goals
    with pytest.raises(UnsafeCommandError):
        arm.send([*start[:5], bad], arm.clock.now())
    assert goal_recorder.goals == before
