"""A joint that cannot hold is refused before torque; one that cannot follow stops the arm."""

from __future__ import annotations

import dataclasses
import logging

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import HardwareError, MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.following import BEHIND_TICKS, Following
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import GRIPPER
from robot_ik.hardware.virtual.bus import VirtualBus, home_of
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.world import World
from robot_ik.ports import VirtualClock
from tests.hardware.joints import with_servo

WEAK = [
    ("goal_pwm", 0, r"joint2.*servo id 2.*0 % of its voltage \(Goal PWM 0, PWM Limit 885\)"),
    ("goal_pwm", 200, r"joint2.*23 % of its voltage"),
    ("pwm_limit", 50, r"joint2.*6 % of its voltage \(Goal PWM \d+, PWM Limit 50\)"),
    ("position_p_gain", 0, r"joint2.*Position P Gain 0"),
]


@pytest.mark.parametrize(("register", "value", "text"), WEAK)
@pytest.mark.parametrize("when", ["before connect", "before enable"])
def test_a_servo_that_another_program_left_too_weak_gets_no_torque(
    arm_config, start, register, value, text, when
) -> None:
    servos = VirtualBus.from_config(arm_config, VirtualClock(), start=start)
    arm = open_arm(arm_config, "sim", virtual_bus=servos)
    if when == "before connect":
        servos.servo(2).memory.set(register, value)
        step = arm.connect
    else:
        arm.connect()
        servos.servo(2).memory.set(register, value)
        step = arm.enable
    with pytest.raises(HardwareError, match=text + ".*nothing was switched on"):
        step()
    assert not any(servo.torque for servo in servos.servos)
    arm.close()


def test_a_weaker_servo_and_one_without_shutdown_are_reported(arm_config, caplog) -> None:
    servos = VirtualBus.from_config(arm_config, VirtualClock())
    servos.servo(2).memory.set("goal_pwm", 600)
    servos.servo(3).memory.set("shutdown", 0)
    with caplog.at_level(logging.WARNING), open_arm(arm_config, "sim", virtual_bus=servos):
        pass
    assert "joint2' (servo id 2) may use 68 % of its voltage" in caplog.text
    assert "joint3: Shutdown is 0" in caplog.text


@pytest.mark.parametrize("id", [2, None], ids=["one", "all"])
def test_a_servo_that_restarts_at_any_packet_of_enable_is_seen(
    arm_config, start, stream, id
) -> None:
    """The last look before torque is not the last packet: a servo may restart in between."""
    with open_arm(arm_config, "sim", start=start) as arm:
        before = arm.bus.virtual_bus.schedule.packets
        arm.enable()
        packets = arm.bus.virtual_bus.schedule.packets - before
    assert packets > 10
    for packet in range(1, packets + 1):
        with open_arm(arm_config, "sim", start=start) as arm:
            arm.bus.virtual_bus.inject(Fault("reboot", id, at_packet=packet))
            with pytest.raises(HardwareError, match="restarted"):
                arm.enable()
                stream(arm, [start] * 3)
            assert not arm.bus.virtual_bus.servo(2).torque


# One lever, level at q = 0: about half of an XM430-W350's stall torque at the shoulder.
LEVER = """
<mujoco><worldbody><body><joint name="shoulder" axis="0 -1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".01" mass="1.2"/>
</body></worldbody></mujoco>
"""


def test_a_joint_without_force_falls_and_stops_the_arm(stream) -> None:
    config = ArmConfig.generic("lever", ["shoulder"], [-3], [3])
    servos = VirtualBus.from_config(config, VirtualClock(), [0.0])
    World(mujoco.MjModel.from_xml_string(LEVER), config, servos)
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, [[0.0]] * 200)  # it bears its load
        stream(arm, [[q] for q in np.linspace(0.0, 0.5, 200)])
        servos.servo(1).memory.set("goal_pwm", 0)
        begin = arm.clock.now()
        with pytest.raises(
            MotorFaultError, match=r"shoulder does not follow: \d+ deg behind"
        ) as caught:
            stream(arm, [[0.5]] * 500)
        assert caught.value.joint == "shoulder" and caught.value.status == ("not_following",)
        assert arm.state is ArmState.FAULT and arm.clock.now() - begin < 2.0


def test_a_blocked_joint_whose_goal_moves_on_stops_the_arm(
    arm_config, start, stream, smooth
) -> None:
    with open_arm(arm_config, "sim", start=start) as arm:
        arm.enable()
        arm.bus.virtual_bus.inject(Fault("stuck", 4))
        with pytest.raises(MotorFaultError, match="joint4 does not follow"):
            stream(arm, smooth(start, start + 1.2, 2.0))


def test_a_motion_at_the_caps_with_a_slow_profile_is_no_fault(arm_config, start, stream) -> None:
    joints = tuple(
        dataclasses.replace(j, profile_velocity=j.velocity, profile_acceleration=j.acceleration)
        for j in arm_config.joints
    )
    with open_arm(dataclasses.replace(arm_config, joints=joints), "sim", start=start) as arm:
        arm.enable()
        for sign in (1.0, -1.0, 1.0):
            stream(arm, [start + sign] * 200)
        assert arm.state is ArmState.ENABLED


def distances(config, ticks, period=0.01) -> None:
    """Joint 4 is so many ticks behind, cycle for cycle."""
    following = Following(config, longest_tick=0.02, pause=0.25)
    goals = {servo.id: 2048 for servo in config.servos}
    for k, behind in enumerate(ticks):
        following.check(goals, {**goals, 4: 2048 - behind}, period * k)


def test_a_hand_or_a_wall_that_keeps_a_distance_is_left_to_the_servo(arm_config) -> None:
    far = 10 * BEHIND_TICKS
    distances(arm_config, [far] * 500)
    distances(
        arm_config, [*np.linspace(0, far, 30).astype(int), *np.linspace(far, 0, 30).astype(int)] * 5
    )
    distances(
        arm_config, np.linspace(0, far, 20).astype(int), period=0.3
    )  # hold and command in turn
    with pytest.raises(MotorFaultError, match="joint4 does not follow"):
        distances(arm_config, np.linspace(0, far, 200).astype(int))


@pytest.mark.parametrize(
    "changed",
    [
        lambda joint: dataclasses.replace(joint, group=GRIPPER),
        lambda joint: with_servo(joint, mode=OperatingMode.CURRENT_BASED_POSITION),
    ],
    ids=["gripper", "presses"],
)
def test_fingers_that_close_on_something_are_no_fault(arm_config, start, stream, changed) -> None:
    joints = (*arm_config.joints[:5], changed(arm_config.joints[5]))
    config = dataclasses.replace(arm_config, joints=joints)
    with open_arm(config, "sim", start=start) as arm:
        arm.enable()
        servo = arm.bus.virtual_bus.servo(6)
        at = servo.shaft.reading
        servo.shaft.stops = (at - 50, at + 50)
        stream(arm, [start - np.eye(6)[5]] * 120)
        assert arm.state is ArmState.ENABLED


@pytest.mark.parametrize("name", ["koch_v11", "omx_f", "tabletop_puma", "vx300s", "wx250s"])
def test_a_shipped_arm_that_bears_its_weight_follows_at_its_caps(name, stream) -> None:
    """By MuJoCo, from pose to pose; the Puma of 50 kg is too heavy for its small servos."""
    config = ArmConfig.load(name)
    servos = VirtualBus.from_config(config, VirtualClock(), home_of(config))
    World(rik.load_robot(name).model, config, servos)
    rng = np.random.default_rng(1)
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        home = arm.read().q
        for _ in range(5):
            there = np.clip(home + rng.uniform(-0.8, 0.8, len(home)), arm.lower, arm.upper)
            stream(arm, [there] * 80)
        assert arm.state is ArmState.ENABLED
