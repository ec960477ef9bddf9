"""A synthetic camera on the hand has the pose that follows from the joint angles."""

from __future__ import annotations

import numpy as np

from robot_ik.camera.synthetic.camera import SyntheticMarker, SyntheticScene, SyntheticSource
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import marker
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import VirtualClock
from robot_ik.robot import load_robot


def test_each_picture_is_taken_from_the_pose_of_the_hand() -> None:
    robot = load_robot("puma560")
    lens = STANDARD_CAMERA.scaled(320, 240)
    carried = Pose((0.1, 0.0, -0.05), rotation_exp([0.0, -0.2, 0.3]))
    home = robot.home
    board = (
        robot.forward(home, "gripper")
        .compose(carried)
        .compose(Pose((0.02, 0.01, 0.5), (0, 1, 0, 0)))
    )
    markers = (SyntheticMarker(7, 0.1, board),)
    scene = SyntheticScene(robot, lens, carried, markers, camera_frame="gripper")
    places = iter([home, robot.clip(home + np.array([0.03, -0.02, 0.02, 0.02, 0.02, 0.3]))])
    target = marker(7, 0.1)
    poses = []
    clock = VirtualClock(2.0)
    with SyntheticSource(scene, lambda: next(places), clock=clock) as source:
        for number in range(2):
            frame = source.read()
            assert (frame.size, frame.sequence, frame.time) == ((320, 240), number, 2.0)
            seen = target.find(frame, lens)
            assert seen is not None
            true = frame.truth["pose_camera_marker"][7]  # type: ignore[index]
            assert seen.pose.distance(true)[0] < 2e-3
            poses.append(seen.pose)
    assert poses[0].distance(Pose((0.02, 0.01, 0.5), (0, 1, 0, 0)))[0] < 2e-3
    assert poses[0].distance(poses[1])[0] > 0.01
