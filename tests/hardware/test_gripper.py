"""A gripper beside the arm: slides in mm, holding, named commands, soft grips."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    BusDisconnectedError,
    ConfigError,
    MotorFaultError,
    UnknownJointError,
    UnsafeCommandError,
)
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.arm_part import ArmPart
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.health import read_states
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import SwingArm
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.world import World, WorldObject, model_with
from robot_ik.ports import VirtualClock
from tests.hardware.joints import make_joint

ID = 7
TICKS_PER_MM = 4096 / (2 * math.pi * 8.0)


@pytest.fixture(scope="module")
def robot() -> rik.Robot:
    return rik.load_robot("tabletop_puma")


@pytest.fixture(scope="module")
def desk(robot: rik.Robot) -> ArmConfig:
    return ArmConfig.load(robot.arm_file)


@pytest.fixture
def desk_arm(desk: ArmConfig, robot: rik.Robot) -> Iterator[Arm]:
    with open_arm(desk, "sim", start=dict(zip(robot.joints, robot.home, strict=True))) as arm:
        arm.enable()
        yield arm


def put_between(arm: Arm, opening: float) -> None:
    """Something between the fingers at which the pinion stops."""
    finger = arm.config.joint("finger_left")
    arm.bus.virtual_bus.servo(ID).shaft.stops = (finger.nearest_ticks(opening), math.inf)


def test_a_slide_is_metres_outside_and_ticks_of_its_pinion_inside(
    desk: ArmConfig, robot: rik.Robot
) -> None:
    finger = desk.joint("finger_left")
    assert desk.chain.names == robot.joints and len(desk.servos) == 7
    assert desk.names == (*robot.joints, "finger_left") and desk.group("gripper") == (finger,)
    assert finger.nearest_ticks(0.009) - finger.nearest_ticks(0.004) == pytest.approx(
        5 * TICKS_PER_MM, abs=1
    )
    assert finger.value(2048) == pytest.approx(0.009, abs=finger.resolution)
    assert finger.limits == (0.0, pytest.approx(0.018)) and finger.text(0.0045) == "4.5 mm"
    # The fingers' range in the model, and one lead of the gear by MuJoCo: pinion angle times
    # radius.
    full = rik.load_robot("tabletop_puma", joints=desk.names)
    assert (full.lower[6], full.upper[6]) == pytest.approx(finger.limits)
    again = ArmConfig.parse(desk.to_toml())
    assert again.joints == desk.joints


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ("pinion_mm = 8.0", "pinion_mm = -8.0", "joints[6].pinion_mm", "> 0"),
        ("pinion_mm = 8.0\n", "", "joints[6].pinion_mm", "missing"),
        ("lower_mm = 0.0", "lower_deg = 0.0", "joints[6].lower_deg", "lower_mm"),
        ("lower_mm = 0.0", "lower_mm = 19.0", "joints[6].lower_mm", "19 to 18 mm"),
        ("upper_mm = 18.0", "upper_mm = 18.0\nlowr = 1", "joints[6].lowr", "unknown key"),
        ("current_ma = 450.0", "current_ma = 4500.0", "joints[6].current_ma", "1750"),
        ("id = 7", "id = 6", "joints[6].id", "already joints[5]"),
    ],
)
def test_a_wrong_value_of_a_slide_is_reported_with_its_key(
    robot: rik.Robot, old: str, new: str, key: str, said: str
) -> None:
    text = robot.arm_file.read_text()
    assert old in text
    with pytest.raises(ConfigError) as caught:
        ArmConfig.parse(text.replace(old, new))
    assert caught.value.key == key and said in str(caught.value)


def test_moves_of_the_arm_leave_the_gripper_where_it_is(desk_arm: Arm, robot: rik.Robot) -> None:
    servo = desk_arm.bus.virtual_bus.servo(ID)
    before = servo.memory.values["goal_position"]
    part = ArmPart(desk_arm, robot.joints)
    here = part.read().q
    assert here.shape == (6,) and desk_arm.joints == (*robot.joints, "finger_left") and servo.torque
    rik.execute(rik.joint_move(robot, here, here + 0.2, speed=0.5), [part], source=part, settle=0.2)
    assert servo.memory.values["goal_position"] == before
    assert desk_arm.positions()["finger_left"] == pytest.approx(0.009, abs=2e-5)
    with pytest.raises(UnsafeCommandError, match="7 angles, one for each of joint1"):
        desk_arm.send(np.zeros(6), desk_arm.clock.now())
    with pytest.raises(UnsafeCommandError, match="6 values, one for each of joint1"):
        part.send(np.zeros(7), desk_arm.clock.now())


def test_what_was_sent_is_returned(desk_arm: Arm, robot: rik.Robot) -> None:
    """The command of every joint, within limits and speed limits, grippers included."""
    begin = desk_arm.clock.now()
    for k in range(1, 101):
        desk_arm.clock.sleep_until(begin + 0.01 * k)
        sent = desk_arm.send({"finger_left": -1.0, "joint1": 9.0}, desk_arm.clock.now())
        assert sent.shape == (7,)
        goals = [
            desk_arm.bus.virtual_bus.servo(id).memory.values["goal_position"] for id in (1, ID)
        ]
        wanted = [desk_arm.config.joints[at].goal(sent[at]) for at in (0, 6)]
        assert goals == wanted
    assert sent[6] == 0.0 and sent[0] <= robot.upper[0]


def test_by_name_it_moves_within_its_limits_and_caps(desk_arm: Arm) -> None:
    desk_arm.move_to({"finger_left": 0.018, "joint6": 0.2})
    assert desk_arm.positions()["finger_left"] == pytest.approx(0.018, abs=3e-5)
    begin = desk_arm.clock.now()
    goals = []
    for k in range(1, 61):
        desk_arm.clock.sleep_until(begin + 0.01 * k)
        desk_arm.send({"finger_left": -1.0}, desk_arm.clock.now())
        goals.append(desk_arm.bus.virtual_bus.servo(ID).memory.values["goal_position"])
    assert desk_arm.reports.clipped == {"finger_left": 60}
    assert np.abs(np.diff(goals)).max() <= 0.050 * 0.01 * 1e3 * TICKS_PER_MM + 1  # 50 mm/s
    assert goals[-1] == desk_arm.config.joint("finger_left").nearest_ticks(0.0)


def test_a_grip_stops_at_an_object_and_presses_with_the_set_current(
    desk_arm: Arm, robot: rik.Robot
) -> None:
    (empty,) = desk_arm.grip(0.0)
    assert not empty.held and empty.q == pytest.approx(0.0, abs=1e-4)
    (opened,) = desk_arm.grip({"finger_left": 0.018})
    assert not opened.held
    put_between(desk_arm, 0.010)
    begin = desk_arm.clock.now()
    (grip,) = desk_arm.grip(0.0, current=200.0)
    assert grip.held and grip.q == pytest.approx(0.010, abs=1e-4)
    assert grip.current == pytest.approx(200.0, abs=2.0)
    assert desk_arm.clock.now() - begin < 1.0  # not the 2 s of patience
    # It presses on while the arm moves, is held, and comes back from a pause in which the watchdog
    # tripped.
    part = ArmPart(desk_arm, robot.joints)
    here = part.read().q
    rik.execute(rik.joint_move(robot, here, here + 0.1, speed=0.5), [part], source=part)
    desk_arm.clock.sleep_until(desk_arm.clock.now() + 1.0)
    assert desk_arm.bus.virtual_bus.servo(ID).torque and desk_arm.bus.virtual_bus.servo(ID).tripped
    desk_arm.hold()
    (state,) = [s for s in read_states(desk_arm.bus, desk_arm.config.drives) if s.id == ID]
    assert state.current_ma == pytest.approx(-200.0, abs=2.0)
    assert state.position_deg is None and state.position_mm == pytest.approx(10.0, abs=0.1)
    with pytest.raises(UnsafeCommandError, match=r"30.0 mm.*0.0 mm to 18.0 mm"):
        desk_arm.grip(0.030)
    with pytest.raises(UnsafeCommandError, match=r"18.0004 mm.*0.0000 mm to 18.0000 mm"):
        desk_arm.grip(0.0180004)


def test_a_current_after_a_pause_is_taken(desk_arm: Arm) -> None:
    desk_arm.clock.sleep_until(desk_arm.clock.now() + 5.0)  # every Bus Watchdog has tripped
    desk_arm.limit_current({"finger_left": 200.0})
    assert desk_arm.bus.virtual_bus.servo(ID).memory.values["goal_current"] == 200
    desk_arm.clock.sleep_until(desk_arm.clock.now() + 5.0)
    (grip,) = desk_arm.grip(0.002, current=150.0)
    assert not grip.held and grip.q == pytest.approx(0.002, abs=1e-4)


@pytest.mark.parametrize("way", ["reset_fault", "reconnect"])
def test_a_fault_of_another_joint_does_not_tighten_the_grip(desk_arm: Arm, way: str) -> None:
    """Never, not even for a moment: every Goal Current on the wire is looked at."""
    put_between(desk_arm, 0.006)
    servo = desk_arm.bus.virtual_bus.servo(ID)
    desk_arm.grip(0.0, current=50.0)
    written: list[int] = []
    put = servo.memory.set
    servo.memory.set = lambda name, value: (
        name == "goal_current" and written.append(value),
        put(name, value),
    )
    desk_arm.bus.virtual_bus.inject(Fault("overload", 3))
    with pytest.raises(MotorFaultError):
        desk_arm.read()
        desk_arm.clock.sleep_until(desk_arm.clock.now() + 0.02)
        desk_arm.read()
    if way == "reconnect":
        desk_arm.bus.virtual_bus.clear()
    getattr(desk_arm, way)()
    desk_arm.enable()
    assert set(written) <= {50} and servo.memory.values["goal_current"] == 50
    (grip,) = desk_arm.grip(0.0)
    assert grip.held and grip.current == pytest.approx(50.0, abs=2.0)
    desk_arm.close()
    desk_arm.connect()  # another program, perhaps: what the arm file says
    assert servo.memory.values["goal_current"] == 450


def test_a_port_that_is_gone_when_a_current_is_set_is_a_fault_of_the_arm(desk_arm: Arm) -> None:
    desk_arm.bus.virtual_bus.unplugged = True
    for _ in range(2):  # the same again, and not that the bus is not open
        with pytest.raises(BusDisconnectedError):
            desk_arm.limit_current({"finger_left": 200.0})
        assert desk_arm.state is ArmState.FAULT


def test_a_wrong_current_is_no_fault_of_the_arm(desk_arm: Arm) -> None:
    for name, error in (("finger", UnknownJointError), ("joint1", UnsafeCommandError)):
        with pytest.raises(error):
            desk_arm.limit_current({name: 200.0})
    assert desk_arm.state is ArmState.ENABLED


def test_it_is_part_of_torque_off_and_of_faults(desk: ArmConfig) -> None:
    with open_arm(desk, "sim") as arm:
        arm.enable()
        arm.bus.virtual_bus.servo(ID).inject_error("overload")
        with pytest.raises(rik.errors.MotorFaultError) as caught:
            arm.read(), arm.clock.sleep_until(1.0), arm.read()
        assert caught.value.joint == "finger_left"
    assert arm.exit_report.verified == desk.names
    assert not any(servo.torque for servo in arm.bus.virtual_bus.servos)


def test_all_joints_in_q_where_that_is_wanted(desk: ArmConfig) -> None:
    with open_arm(desk, "sim", start=[0.0] * 6 + [0.004]) as arm:
        arm.enable()
        assert arm.read().q[6] == pytest.approx(0.004, abs=1e-5)
        arm.move_to([*arm.read().q[:6], 0.012])
        assert arm.read().q[6] == pytest.approx(0.012, abs=3e-5)
        assert arm.bus.virtual_bus.true_angles(desk)[6] == pytest.approx(0.012, abs=3e-5)
    with open_arm(desk.chain, "sim") as arm:
        arm.enable()
        with pytest.raises(
            UnsafeCommandError, match="an arm file with joints of the group gripper"
        ):
            arm.grip(0.0)


BLOCK = 0.012


@pytest.fixture
def world_of(desk: ArmConfig, robot: rik.Robot) -> Callable[..., tuple[World, VirtualBus]]:
    def make(block: bool) -> tuple[World, VirtualBus]:
        place = tuple(robot.forward(robot.home).position)
        objects = [WorldObject("block", place, (BLOCK,) * 3, 0.05)] if block else []
        model = model_with(robot.path, objects)
        bus = VirtualBus.from_config(desk, VirtualClock(), robot.home)
        return World(model, desk, bus, contacts=block), bus

    return make


URDF = """<robot name="arm"><link name="base"/><link name="hand"/>
<joint name="j" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="2" effort="1"/></joint></robot>"""


def test_objects_stand_beside_a_robot_that_is_a_urdf_and_weighs_nothing(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(URDF, encoding="utf-8")
    model = model_with(file, [WorldObject("block", (0.2, 0.0, 0.5), (BLOCK,) * 3, 0.05)], floor=0.0)
    assert model.body("block").mass == pytest.approx(0.05)
    assert model.joint("j").range == pytest.approx((-1.0, 1.0)) and model.body("hand").id > 0


def test_both_fingers_of_the_world_follow_one_servo(world_of, desk: ArmConfig) -> None:
    world, bus = world_of(False)
    with open_arm(desk, "sim", virtual_bus=bus) as arm:
        arm.enable()
        (grip,) = arm.grip(0.016)
        assert not grip.held
        left, right = (world.data.joint(name).qpos[0] for name in ("finger_left", "finger_right"))
        assert left == pytest.approx(0.016, abs=2e-4) and right == pytest.approx(left, abs=2e-4)


def test_a_block_is_taken_lifted_and_let_go(world_of, desk: ArmConfig, robot: rik.Robot) -> None:
    """Nothing here says that it is held but MuJoCo's contacts."""
    world, bus = world_of(True)
    world.model.opt.gravity[:] = 0.0  # until it is held
    block = world.data.body("block")
    with open_arm(desk, "sim", virtual_bus=bus) as arm:
        arm.enable()
        arm.grip(0.016)
        (grip,) = arm.grip(0.0)
        assert grip.held and 2.0 * grip.q == pytest.approx(BLOCK, abs=0.0003)
        assert grip.current == pytest.approx(450.0, abs=5.0)
        world.model.opt.gravity[2] = -9.81
        part = ArmPart(arm, robot.joints)
        here = part.read().q
        up = rik.solve(
            robot,
            rik.PoseGoal(
                "gripper", (block.xpos[0], block.xpos[1], block.xpos[2] + 0.03), [0, 1, 0, 0]
            ),
            start=here,
        )
        rik.execute(
            rik.joint_move(robot, here, up.require().q, speed=0.4), [part], source=part, settle=0.2
        )
        hand = robot.forward(part.read().q).position
        assert block.xpos == pytest.approx(hand, abs=0.004)
        arm.grip(0.016)
        arm.clock.sleep_until(arm.clock.now() + 0.1)
        bus.advance()
        assert block.xpos[2] < hand[2] - 0.02


FINGER = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="finger" type="slide" axis="0 1 0" damping="1"/>
      <geom size=".005" mass=".03"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_finger_of_a_swing_arm_is_where_mujoco_has_it(direction: int, reverse: bool) -> None:
    """Interbotix' wx250s: the servo turns a horn, MuJoCo has a slide.

    The law is between them, both ways.
    """
    swing = SwingArm(0.014, 0.024)
    mode = OperatingMode.POSITION
    finger = make_joint(
        "finger",
        9,
        "XL430-W250",
        mode,
        direction,
        2048,
        0.015,
        0.037,
        0.05,
        0.5,
        gear=SwingArm(0.014, 0.024),
        reverse=reverse,
    )
    config = ArmConfig("f", "f", 1_000_000, 100.0, 400, "torque_off", (finger,))
    bus = VirtualBus.from_config(config, VirtualClock(), [0.02])
    world = World(mujoco.MjModel.from_xml_string(FINGER), config, bus)
    assert world.data.qpos[0] == pytest.approx(0.02, abs=finger.resolution)
    with open_arm(config, "sim", virtual_bus=bus) as arm:
        arm.enable()
        fastest = 0.0
        for goal in (0.0365, 0.0155, 0.026):
            begin = arm.clock.now()
            far = abs(goal - arm.read().q[0])
            arm.move_to([goal])
            bus.advance()
            assert world.data.qpos[0] == pytest.approx(goal, abs=1e-4)
            assert arm.read().q[0] == pytest.approx(goal, abs=1e-4)
            horn = (
                (bus.servo(9).memory.values["goal_position"] - 2048)
                * direction
                * 2
                * math.pi
                / 4096
            )
            assert swing.distance(horn) == pytest.approx(goal, abs=finger.resolution)
            fastest = max(fastest, far / (arm.clock.now() - begin))
        assert fastest < 0.05  # the cap in metres a second holds at the finger
        (state,) = read_states(arm.bus, config.drives)
        assert state.position_mm == pytest.approx(26.0, abs=0.1)
