"""The LeRobot robot ``robot_ik_arm`` on simulated servos, without LeRobot."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robot_ik.lerobot
from robot_ik.errors import ArmStateError, UnknownRobotError, UnsafeCommandError
from robot_ik.hardware.arm import ArmState
from tests.lerobot.stand_in import ConnectionStateError, install

PERIOD = 1.0 / 30.0
"""Period of LeRobot's loop, s."""

SOLVE_TOLERANCE = 1e-4
"""Largest position error of a goal that is met, m."""

MakeArm = Callable[..., Any]


@pytest.fixture
def make_arm(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[MakeArm]:
    """Return a function that creates a robot with the given options."""
    install(monkeypatch)
    from robot_ik.lerobot.arm import RobotIkArm
    from robot_ik.lerobot.config_arm import RobotIkArmConfig

    arms = []

    def make(**options: Any) -> Any:
        config = RobotIkArmConfig(id="test", calibration_dir=tmp_path, **options)
        arms.append(RobotIkArm(config))
        return arms[-1]

    yield make
    for arm in arms:
        arm.disconnect()


def _step_to(robot: Any, action: dict[str, float], steps: int = 200) -> dict[str, float]:
    """Repeat an action until the limiter sends it unchanged; return the last command."""
    sent: dict[str, float] = {}
    for _ in range(steps):
        sent = robot.send_action(action)
        if all(abs(sent[key] - value) < 1e-6 for key, value in action.items()):
            break
        robot.arm.clock.sleep_until(robot.arm.clock.now() + PERIOD)
    return sent


def test_features_name_every_joint_in_the_order_of_the_arm_file(make_arm: MakeArm) -> None:
    robot = make_arm(arm="so101", observe_tool=True)
    keys = list(robot.observation_features)
    assert keys[:6] == [
        "shoulder_pan.pos",
        "shoulder_lift.pos",
        "elbow_flex.pos",
        "wrist_flex.pos",
        "wrist_roll.pos",
        "gripper.pos",
    ]
    assert keys[6:] == ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz"]
    assert list(robot.action_features) == keys[:6]
    tool = make_arm(arm="so101", control="tool")
    assert list(tool.action_features) == [*keys[6:], "ee.gripper_pos"]


def test_a_command_beyond_the_speed_limit_is_shortened_and_reported(make_arm: MakeArm) -> None:
    robot = make_arm(arm="so101")
    robot.connect()
    before = robot.get_observation()["shoulder_pan.pos"]
    sent = robot.send_action({"shoulder_pan.pos": before + 60.0})
    assert 0.0 < sent["shoulder_pan.pos"] - before < 30.0
    assert robot.send_action({"gripper.pos": 100.0}).keys() == robot.action_features.keys()


@pytest.mark.parametrize("arm", ["so101", "koch_v11", "tabletop_puma"])
def test_joint_actions_arrive_at_the_servos(make_arm: MakeArm, arm: str) -> None:
    robot = make_arm(arm=arm)
    robot.connect()
    joint = next(iter(robot.action_features))
    target = robot.get_observation()[joint] + 5.0
    sent = _step_to(robot, {joint: target})
    assert sent[joint] == pytest.approx(target, abs=1e-6)
    for _ in range(30):
        robot.send_action({joint: target})
        robot.arm.clock.sleep_until(robot.arm.clock.now() + PERIOD)
    assert robot.get_observation()[joint] == pytest.approx(target, abs=0.3)


@pytest.mark.parametrize("arm", ["so101", "koch_v11"])
def test_velocities_are_observed_on_request_in_the_units_of_the_positions(
    make_arm: MakeArm, arm: str
) -> None:
    robot = make_arm(arm=arm, observe_velocity=True)
    assert "gripper.vel" not in make_arm(arm=arm).observation_features
    names = [key.removesuffix(".pos") for key in robot.action_features]
    assert list(robot.observation_features)[len(names) :] == [f"{name}.vel" for name in names]
    robot.connect()
    before = robot.get_observation()
    assert all(before[f"{name}.vel"] == 0.0 for name in names)
    joint = names[0]
    opens = before["gripper.pos"] < 50.0
    goals = {f"{joint}.pos": before[f"{joint}.pos"] + 60.0, "gripper.pos": 100.0 * opens}
    positive = set()
    for _ in range(60):
        robot.send_action(goals)
        robot.arm.clock.sleep_until(robot.arm.clock.now() + 0.5 * PERIOD)
        after = robot.get_observation()
        velocities = robot.arm.velocities()
        assert after.keys() == robot.observation_features.keys()
        assert after[f"{joint}.vel"] == pytest.approx(math.degrees(velocities[joint]))
        positive |= {name for name in names if after[f"{name}.vel"] > 1.0}
        if (after["gripper.vel"] > 1.0) == opens and joint in positive:
            break
    assert joint in positive
    assert ("gripper" in positive) == opens


def test_tool_actions_move_the_tool(make_arm: MakeArm) -> None:
    robot = make_arm(arm="so101", control="tool", observe_tool=True)
    robot.connect()
    pose = {key: robot.get_observation()[key] for key in ("ee.x", "ee.y", "ee.z")}
    orientation = {key: robot.get_observation()[key] for key in ("ee.wx", "ee.wy", "ee.wz")}
    action = {**pose, **orientation, "ee.z": pose["ee.z"] + 0.01}
    for _ in range(60):
        sent = robot.send_action({**action, "ee.gripper_pos": 50.0})
        robot.arm.clock.sleep_until(robot.arm.clock.now() + PERIOD)
    assert sent["ee.z"] == pytest.approx(action["ee.z"], abs=SOLVE_TOLERANCE)
    assert sent["ee.gripper_pos"] == pytest.approx(50.0, abs=1e-6)
    assert robot.get_observation()["ee.z"] == pytest.approx(action["ee.z"], abs=1e-3)


def test_a_small_tool_step_that_needs_a_large_motion_is_refused(
    make_arm: MakeArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make_arm(arm="so101", control="tool", observe_tool=True)
    robot.connect()
    before = robot.get_observation()
    action = {key: before[key] for key in robot.action_features if key in before}
    # 60 degrees in each joint: another branch.
    far = lambda joints, _pose: np.asarray(joints) + 60.0  # noqa: E731
    monkeypatch.setattr(robot.kinematics, "inverse_kinematics", far)
    sent = robot.send_action(action)
    assert robot.refused == 1
    for key, value in action.items():
        assert sent[key] == pytest.approx(value, abs=1e-3)


@pytest.mark.parametrize(
    "action",
    [
        {"sholder_pan.pos": 0.0},
        {"shoulder_pan.pos": float("nan")},
        {"ee.x": 0.2},
        {"ee.x": 0.2, "ee.y": 0.0, "ee.z": 0.1, "ee.wx": 0.0, "ee.wy": float("nan"), "ee.wz": 0.0},
        {},
    ],
)
def test_wrong_actions_are_refused_and_nothing_is_sent(
    make_arm: MakeArm, action: dict[str, float]
) -> None:
    robot = make_arm(arm="so101")
    robot.connect()
    before = robot.arm.bus.virtual_bus.servo(1).register("goal_position")
    with pytest.raises(UnsafeCommandError):
        robot.send_action(action)
    assert robot.arm.bus.virtual_bus.servo(1).register("goal_position") == before
    assert robot.arm.state is not ArmState.FAULT


def test_connect_without_calibration_gives_no_torque(make_arm: MakeArm) -> None:
    robot = make_arm(arm="so101")
    robot.connect(calibrate=False)
    assert robot.is_connected
    assert robot.arm.state is ArmState.CONNECTED
    with pytest.raises(ArmStateError):
        robot.send_action({"shoulder_pan.pos": 0.0})


def test_the_handlers_of_the_host_program_stay(make_arm: MakeArm) -> None:
    def handler(number: int, frame: object) -> None:
        raise AssertionError(number, frame)

    before = signal.signal(signal.SIGINT, handler)
    try:
        robot = make_arm(arm="so101")
        robot.connect()
        assert signal.getsignal(signal.SIGINT) is handler
        robot.disconnect()
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_disconnect_leaves_the_arm_and_may_be_repeated(make_arm: MakeArm) -> None:
    robot = make_arm(arm="so101", disable_torque_on_disconnect=False)
    robot.connect()
    servos = robot.arm.bus.virtual_bus
    robot.disconnect()
    robot.disconnect()
    assert not robot.is_connected
    assert servos.servo(1).register("torque_enable") == 1
    with pytest.raises(ConnectionStateError):
        robot.get_observation()


def test_a_simulated_arm_writes_a_calibration_that_lerobot_reads(
    make_arm: MakeArm, tmp_path: Path
) -> None:
    robot = make_arm(arm="so101")
    robot.connect(calibrate=False)
    robot.calibrate()
    rows = json.loads((tmp_path / "test.json").read_text())
    assert list(rows) == list(robot.bus.motors)
    assert rows["wrist_roll"]["range_min"] == 0
    assert rows["wrist_roll"]["range_max"] == 4095
    for row in rows.values():
        assert set(row) == {"id", "drive_mode", "homing_offset", "range_min", "range_max"}


def test_scene_camera_draws_the_measured_pose(make_arm: MakeArm) -> None:
    from robot_ik.lerobot.config_scene_camera import SceneCameraConfig

    robot = make_arm(arm="so101", cameras={"front": SceneCameraConfig(width=160, height=120)})
    assert robot.observation_features["front"] == (120, 160, 3)
    robot.connect()
    first = robot.get_observation()["front"]
    assert first.shape == (120, 160, 3)
    assert first.dtype == np.uint8
    pan = robot.get_observation()["shoulder_pan.pos"]
    _step_to(robot, {"shoulder_pan.pos": pan + 20.0})
    for _ in range(30):
        robot.send_action({"shoulder_pan.pos": pan + 20.0})
        robot.arm.clock.sleep_until(robot.arm.clock.now() + PERIOD)
    second = robot.get_observation()["front"]
    assert (np.abs(first.astype(int) - second) > 20).mean() > 0.01


def test_bus_view_reads_and_commands_joints(make_arm: MakeArm) -> None:
    robot = make_arm(arm="so101")
    robot.connect()
    positions = robot.bus.sync_read("Present_Position")
    assert list(positions) == list(robot.bus.motors)
    robot.bus.sync_write("Goal_Position", {"gripper": positions["gripper"]})
    with pytest.raises(NotImplementedError, match="Present_Position"):
        robot.bus.sync_read("Present_Velocity")


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("control", "tools", r"'tools' \(allowed: joints or tool\)"),
        ("fps", 0.0, r"fps 0\.0 is not allowed \(allowed: above 0"),
    ],
)
def test_wrong_options_are_refused(
    make_arm: MakeArm, option: str, value: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_arm(**{option: value})


def test_an_unknown_arm_is_refused(make_arm: MakeArm) -> None:
    with pytest.raises(UnknownRobotError, match="so102"):
        make_arm(arm="so102")


def test_an_unknown_name_of_the_package_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="RobotIkArms"):
        robot_ik.lerobot.RobotIkArms  # noqa: B018
