"""An arm under way: what it obeys, what it clips and slows down, what it refuses."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest

from robot_ik.errors import UnsafeCommandError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock


def test_a_trajectory_within_the_caps_arrives_unchanged(any_arm, arm_config, stream, smooth):
    any_arm.enable()
    start = any_arm.read().q
    end = np.array([0.5, -0.2, 0.6, 0.1, 0.9, 0.2])
    lag = 0.0
    for before, q in itertools.pairwise(smooth(start, end, 1.0)):
        stream(any_arm, [q])
        lag = max(lag, np.abs(any_arm.read().q - before).max())
    stream(any_arm, [end] * 30)  # so that it arrives even where this machine stalled on the way
    assert not any_arm.reports.clipped
    assert (np.abs(any_arm.read().q - end) <= 1.5 * any_arm.resolution).all()
    assert (
        np.abs(any_arm.bus.virtual_bus.true_angles(arm_config) - end) <= 1.5 * any_arm.resolution
    ).all()
    counters = any_arm.bus.counters
    assert counters.timeouts <= 0.01 * counters.asked  # a stalled process answers late
    # On virtual time a shaft stands at its goal of the cycle before.
    if any_arm.bus.port == "sim":
        assert counters.timeouts == 0
        assert lag < 0.01
        assert not any_arm.reports.capped


def test_one_send_is_one_write_and_one_read(arm, stream, start, dt):
    arm.enable()
    before = dataclasses.replace(arm.bus.counters)
    stream(arm, [start] * 10)
    after = arm.bus.counters
    assert after.cycles - before.cycles == 10
    # sync write 14 + 6 x 5 bytes, sync read 14 + 6; answers 6 x 15
    assert after.bytes_sent - before.bytes_sent == 10 * (44 + 20)
    arm.read()
    assert arm.bus.counters.cycles == after.cycles  # the read of the same cycle costs nothing
    arm.clock.sleep_until(arm.clock.now() + dt)
    arm.read()
    assert arm.bus.counters.cycles == before.cycles + 11


@pytest.mark.parametrize(
    "bad",
    [[math.nan] * 6, [0.0] * 5, [0.0, 0, 0, 0, 0, math.inf], {"elbow": 0.1}, None, [["0"] * 6]],
    ids=repr,
)
def test_what_must_not_be_obeyed_sends_not_one_byte(any_arm, bad, start, dt):
    any_arm.enable()
    any_arm.send(start, any_arm.clock.now())
    sent = any_arm.bus.counters.bytes_sent
    for _ in range(2):
        with pytest.raises(UnsafeCommandError):
            any_arm.send(bad, any_arm.clock.now())
    with pytest.raises(UnsafeCommandError):
        any_arm.send(start, math.nan)
    assert any_arm.bus.counters.bytes_sent == sent
    assert any_arm.state is ArmState.ENABLED
    any_arm.send(start, any_arm.clock.now() + dt)  # and the arm goes on


def test_joints_by_name(arm, stream, start):
    arm.enable()
    stream(arm, [{"joint2": 0.21}] * 20)
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    wanted = start.copy()
    wanted[1] = 0.21
    assert np.allclose(arm.read().q, wanted, atol=1.5 * arm.resolution.max())


def test_beyond_the_limits_is_clipped_and_reported_by_name(
    arm, arm_config, stream, registers, start
):
    arm.enable()
    q = start.copy()
    q[2] = 9.0
    stream(arm, [q] * 300)
    assert arm.reports.clipped == {"joint3": 300} and "joint3" in arm.reports.capped
    assert arm.read().q[2] == pytest.approx(arm.upper[2], abs=1.5 * arm.resolution[2])
    goals = registers(arm, "goal_position")
    assert all(
        j.ticks_range()[0] <= g <= j.ticks_range()[1]
        for j, g in zip(arm_config.joints, goals, strict=True)
    )


def test_a_jump_is_walked(arm, arm_config, stream, start, dt):
    """Position sampled from the shafts, not from what the arm says."""
    arm.enable()
    positions = [arm.bus.virtual_bus.true_angles(arm_config)]
    for _ in range(250):
        stream(arm, [start - 1.0])
        positions.append(arm.bus.virtual_bus.true_angles(arm_config))
    speed = np.abs(np.diff(positions, axis=0)) / dt
    assert (speed <= 1.6 * arm_config.velocity).all()  # the servo's own profile: the last word
    assert (
        np.convolve(speed[:, 0], np.ones(10) / 10, "valid").max() <= 1.02 * arm_config.velocity[0]
    )
    assert np.allclose(positions[-1], start - 1.0, atol=0.01)


def test_a_start_outside_the_limits_is_walked_back(arm_config, stream):
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(1).rotate_by_hand(
        arm_config.joints[0].nearest_ticks(arm_config.upper[0] + 0.3) - 2048
    )
    with open_arm(arm_config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        q = arm.read().q
        assert q[0] > arm.upper[0] + 0.29  # measured, not clipped
        stream(arm, [q] * 3)
        assert arm.read().q[0] > arm.upper[0] + 0.28  # no jump
        stream(arm, [q] * 100)
        assert arm.read().q[0] == pytest.approx(arm.upper[0], abs=2 * arm.resolution[0])


def test_sending_the_same_time_again_does_not_outrun_the_caps(arm, arm_config, registers, start):
    arm.enable()
    for _ in range(500):
        arm.send(start + 0.5, 1.0)
    goals = [
        j.value(g) for j, g in zip(arm_config.joints, registers(arm, "goal_position"), strict=True)
    ]
    assert np.abs(goals - start).max() < 0.01
