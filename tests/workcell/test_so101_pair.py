"""The SO-101 leader leads the follower, and the follower repeats a guided motion."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock
from robot_ik.workcell.guided_recording import GuidedRecording, load_playable
from robot_ik.workcell.leader_arm import LeaderArm
from robot_ik.workcell.replay import replay
from robot_ik.workcell.teleop import teleoperate

MODELS = Path(__file__).resolve().parents[2] / "models"
FOLLOWER = ArmConfig.load("so101")
LEADER = ArmConfig.load(MODELS / "so101" / "leader.toml")
STEPS = 100
TURN = math.radians(20.0)
"""rad by which a hand turns every joint."""


def turn_by_hand(bus: VirtualBus, config: ArmConfig, angle: float) -> None:
    """Turn every joint by ``angle``, rad."""
    for joint in config.joints:
        ticks = joint.position(angle) - joint.position(0.0)
        bus.servo(joint.name).rotate_by_hand(ticks)


def test_leader_and_follower_have_the_same_joints():
    assert LEADER.names == FOLLOWER.names
    assert LEADER.lower == pytest.approx(FOLLOWER.lower)
    assert LEADER.upper == pytest.approx(FOLLOWER.upper)
    assert LEADER.uncalibrated
    assert LEADER.on_exit == "torque_off"


def test_the_follower_follows_the_leader_with_its_gripper():
    clock = VirtualClock()
    led = VirtualBus.from_config(LEADER, clock)
    following = VirtualBus.from_config(FOLLOWER, clock)
    with (
        open_arm(LEADER, "sim", virtual_bus=led) as leader,
        open_arm(FOLLOWER, "sim", virtual_bus=following, on_exit="hold") as follower,
    ):
        steps = iter(range(STEPS))

        def guide() -> bool:
            if next(steps, None) is not None:
                turn_by_hand(led, LEADER, TURN / STEPS)
            return False

        operator = LeaderArm(leader, FOLLOWER, "joints", 1.0)
        report = teleoperate(operator, follower, seconds=4.0, over=guide)
        assert report.engaged == 1
        target = led.true_angles(LEADER)
        assert following.true_angles(FOLLOWER) == pytest.approx(target, abs=math.radians(1.0))
        assert not any(servo.torque for servo in led.servos)
    assert follower.exit_report.ok


def test_the_arm_repeats_what_a_hand_has_shown(tmp_path):
    clock = VirtualClock()
    bus = VirtualBus.from_config(FOLLOWER, clock)
    start = bus.true_angles(FOLLOWER)
    with open_arm(FOLLOWER, "sim", virtual_bus=bus) as arm:
        taught = GuidedRecording(arm)
        for _ in range(STEPS):
            turn_by_hand(bus, FOLLOWER, TURN / STEPS)
            taught.sample()
            clock.sleep_until(clock.now() + 0.02)
        motion = taught.motion()
    shown = bus.true_angles(FOLLOWER)
    assert shown - start == pytest.approx(np.full(len(start), TURN), abs=math.radians(0.5))
    motion.save_csv(tmp_path / "shown.csv")
    turn_by_hand(bus, FOLLOWER, -TURN)

    config, playable, _ = load_playable(tmp_path / "shown.csv", replace(FOLLOWER, file=None), 1.0)
    with open_arm(config, "sim", virtual_bus=bus, on_exit="hold") as arm:
        report = replay(arm, playable, [], lambda _what, _seconds: nullcontext())
        report.require_arrived()
    assert bus.true_angles(FOLLOWER) == pytest.approx(shown, abs=math.radians(1.0))
