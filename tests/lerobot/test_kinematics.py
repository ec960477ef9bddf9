"""``Kinematics`` in place of LeRobot's class: units, gripper, no jumps, exact positions."""

import subprocess
import sys

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import ModelError, UnknownJointError
from robot_ik.lerobot import Kinematics
from tests.five_joint_arms import load

NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]


def so101():
    robot = load("so101")
    return robot, Kinematics(robot, "gripper", [*robot.joints[:5], "gripper"])


def test_forward_kinematics_equals_mujoco_in_degrees():
    robot, kinematics = so101()
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = robot.sample(rng)
        values = np.append(np.degrees(q[:5]), 42.0)
        matrix = kinematics.forward_kinematics(values)
        np.testing.assert_allclose(matrix, robot.measure(q, "gripper").matrix, atol=1e-12)


def test_reachable_poses_are_met_in_one_call_from_anywhere():
    robot, kinematics = so101()
    rng = np.random.default_rng(1)
    for _ in range(60):
        start = np.append(np.degrees(robot.sample(rng)[:5]), 42.0)
        goal = np.append(np.degrees(robot.sample(rng)[:5]), 0.0)
        target = kinematics.forward_kinematics(goal)
        found = kinematics.inverse_kinematics(start, target)
        assert found[5] == 42.0
        assert kinematics.last.error.position < 1e-5
        assert kinematics.last.error.angle < np.radians(1.01)


def test_a_path_of_small_steps_has_no_jumps():
    _, kinematics = so101()
    values = np.array([0.0, -30.0, 40.0, 50.0, 5.0, 10.0])
    first = kinematics.forward_kinematics(values)
    for angle in np.linspace(0.0, 2.0 * np.pi, 200):
        target = first.copy()
        target[:3, 3] += 0.04 * np.array([np.cos(angle) - 1.0, np.sin(angle), 0.0])
        found = kinematics.inverse_kinematics(values, target)
        assert np.abs(found - values).max() < 15.0
        assert np.linalg.norm(kinematics.forward_kinematics(found)[:3, 3] - target[:3, 3]) < 1e-5
        values = found


def test_a_position_out_of_reach_gives_the_nearest_point():
    _, kinematics = so101()
    target = np.eye(4)
    target[:3, 3] = (2.0, 0.0, 0.3)
    found = kinematics.inverse_kinematics(np.zeros(6), target)
    assert kinematics.last.status is rik.Status.UNREACHABLE
    tool = kinematics.forward_kinematics(found)[:3, 3]
    assert abs(np.degrees(np.arctan2(tool[1], tool[0]))) < 2.0


def test_without_orientation_only_the_position_counts():
    robot, kinematics = so101()
    target = robot.forward(robot.sample(np.random.default_rng(2)), "gripper").matrix
    found = kinematics.inverse_kinematics(np.zeros(6), target, orientation_weight=0.0)
    assert np.linalg.norm(kinematics.forward_kinematics(found)[:3, 3] - target[:3, 3]) < 1e-3


def test_six_joints_meet_the_full_pose():
    robot = rik.load_robot("puma560")
    kinematics = Kinematics("puma560")
    rng = np.random.default_rng(3)
    goal = np.degrees(robot.sample(rng))
    found = kinematics.inverse_kinematics(
        np.degrees(robot.home), kinematics.forward_kinematics(goal)
    )
    assert kinematics.last.converged
    np.testing.assert_allclose(
        kinematics.forward_kinematics(found), kinematics.forward_kinematics(goal), atol=2e-3
    )


def test_wrong_joints_are_refused():
    robot = load("so101")
    with pytest.raises(UnknownJointError, match="wrist_roll"):
        Kinematics(robot, "gripper", NAMES[:4])
    with pytest.raises(ModelError, match="shoulder_pan"):
        Kinematics(robot, "gripper", NAMES).forward_kinematics([1.0, 2.0])
    with pytest.raises(ModelError, match="floating base"):
        Kinematics("humanoid")


def test_neither_lerobot_nor_placo_is_imported():
    code = (
        "import sys, robot_ik.lerobot; "
        "assert not {'lerobot', 'placo', 'torch', 'gymnasium'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
