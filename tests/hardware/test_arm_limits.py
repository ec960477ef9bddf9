"""Whatever is commanded, only goals within limits are on the wire; and the recorder that says so works."""

from __future__ import annotations

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_ik.errors import UnsafeCommandError
from robot_ik.hardware import open_arm
from robot_ik.hardware.bus import BROADCAST_ID
from robot_ik.hardware.control_table import CONTROL_TABLES
from robot_ik.hardware.packets import build
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import Instruction
from robot_ik.ports import VirtualClock

GOAL = CONTROL_TABLES["XM430-W350"]["goal_position"]
angles = st.one_of(st.floats(-10, 10), st.floats(), st.sampled_from([np.pi, -np.pi, 1e9, 1e-300]))
commands = st.lists(st.lists(angles, min_size=6, max_size=6), min_size=1, max_size=12)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None)
@given(commands, st.integers(-300, 300))
def test_no_command_whatsoever_puts_a_goal_beyond_the_limits_on_the_wire(
    arm_config, goal_recorder, commands, turned
):
    """Also from a start outside the limits: joint1 is turned by hand up to 26 degrees beyond."""
    servos = VirtualBus.from_config(arm_config, VirtualClock(), start=[np.radians(159.0), 0, 0, 0, 0, 0])
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
    first, last = arm.config.joints[0].ticks_range
    arm.bus.sync_write(GOAL, {1: last, 2: 2048})
    assert goal_recorder.goals == 2 and not goal_recorder.forbidden
    arm.bus.sync_write(GOAL, {1: last + 10})
    arm.bus.write(1, GOAL, first - 10)
    arm.bus.exchange(GOAL, {1: last + 10}, {1: GOAL})
    bulk = [bytes((1,)) + struct.pack("<HHi", GOAL.address, 4, last + 10), bytes((2, 65, 0, 1, 0, 1))]
    arm.virtual_bus.handle(build(BROADCAST_ID, Instruction.BULK_WRITE, b"".join(bulk)))
    assert len(goal_recorder.forbidden) == 4
    assert "joint1" in goal_recorder.forbidden[0]
    goal_recorder.forbidden.clear()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_a_number_reaches_nobody(arm, goal_recorder, bad, start):
    arm.enable()
    before = goal_recorder.goals
    with pytest.raises(UnsafeCommandError):
        arm.send([*start[:5], bad], arm.clock.now())
    assert goal_recorder.goals == before
