"""Measured velocities, against differences of the true shaft positions and against MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.arm_part import ArmPart
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.world import World
from robot_ik.ports import Array, VirtualClock
from tests.hardware.family_arms import FAMILIES, PERIOD, START, family_config

STEP = 0.005
"""rad between two commands: 0.5 rad/s at 100 Hz, below every cap."""

COMMANDS = 60
"""Commands of a motion."""

MOMENT = 1e-6
"""s in which no servo changes its speed by more than 0.001 rad/s."""


def send(arm: Arm | ArmPart, clock: VirtualClock, q: Array) -> None:
    """Send a command one control period after the last one."""
    now = clock.now() + PERIOD
    clock.sleep_until(now)
    arm.send(q, now)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_velocity_is_the_change_of_the_shaft_positions(family, sign):
    config = family_config(family)
    with open_arm(config, "sim", start=START) as arm:
        servos = arm.bus.virtual_bus
        arm.enable()
        for _ in range(COMMANDS):
            send(arm, arm.clock, START + sign)
        # Between two commands every servo is on its way from one goal to the next.
        arm.clock.sleep_until(arm.clock.now() + 0.51 * PERIOD)
        reading = arm.read()
        before = np.array(servos.true_angles(config))
        arm.clock.sleep_until(arm.clock.now() + MOMENT)
        expected = (np.array(servos.true_angles(config)) - before) / MOMENT
    assert (sign * expected > 0.1).all()
    # One count of the register at the smallest ratio is 0.024 rad/s.
    assert reading.dq == pytest.approx(expected, abs=0.025)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_standing_arm_has_velocity_0_before_and_after_torque_comes_on(family):
    with open_arm(family_config(family), "sim", start=START) as arm:
        assert (arm.read().dq == 0.0).all()
        arm.enable()
        assert (arm.read().dq == 0.0).all()
        assert set(arm.velocities().values()) == {0.0}


@pytest.mark.parametrize("family", FAMILIES)
def test_the_first_reading_after_enable_has_a_velocity(family):
    with open_arm(family_config(family), "sim", start=START) as arm:
        arm.enable()
        assert (arm.read().dq == 0.0).all()


def test_a_part_of_an_arm_has_the_velocities_of_its_joints_in_its_order():
    with open_arm(family_config("feetech_sts"), "sim", start=START) as arm:
        arm.enable()
        part = ArmPart(arm, ["joint3", "joint1"])
        largest = 0.0
        for k in range(COMMANDS):
            send(part, arm.clock, np.array([START[2] + k * STEP, START[0]]))
            dq = part.read().dq
            assert (dq == arm.read().dq[[2, 0]]).all()
            assert dq[1] == 0.0
            largest = max(largest, dq[0])
    assert largest > 0.1


@pytest.mark.parametrize("name", ["so101", "koch_v11", "wx250s"])
@pytest.mark.parametrize("torque", [True, False])
def test_the_velocity_of_a_bundled_arm_is_that_of_mujoco(name, torque):
    """The grippers are hinges, and a slide behind a swing arm. Without torque the arm falls."""
    config = ArmConfig.load(name)
    clock = VirtualClock()
    servos = VirtualBus.from_config(config, clock, 0.5 * (config.lower + config.upper))
    world = World(rik.load_robot(config.robot).model, config, servos)
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        if torque:
            arm.enable()
        for _ in range(10):
            if torque:
                send(arm, clock, config.upper)
            else:
                clock.sleep_until(clock.now() + PERIOD)
        reading = arm.read()
        dofs = [world.model.joint(joint).dofadr[0] for joint in arm.joints]
        expected = world.data.qvel[dofs]
    levers = [joint.gear.lever(q) for joint, q in zip(config.joints, reading.q, strict=True)]
    count = config.family.velocity_unit * np.array(levers)
    assert np.abs(expected / count).max() > 5.0
    assert (np.abs(reading.dq - expected) < 1.1 * count).all()
