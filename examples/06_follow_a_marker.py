"""Follows a marker that moves in a circle, with camera and servos simulated in virtual time.

    python examples/06_follow_a_marker.py           goals for the time at which they are used
    python examples/06_follow_a_marker.py late      goals for the time of their picture

Prints the age of the pictures when they were used, and the errors of the goals and of the gripper.
"""

import sys

import numpy as np

import robot_ik as rik
from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import marker
from robot_ik.workcell.scene import scene_for


def main(late: bool = False) -> None:
    arm = rik.open_robot("puma560", bus="sim")
    robot = arm.robot
    scene = scene_for(robot)
    target = marker(scene.marker_id, scene.marker_size, scene.dictionary)

    def marker_pose(now: float) -> rik.Pose:
        angle = 2.0 * (now - begin)
        position = (0.04 * np.sin(angle), 0.04 - 0.04 * np.cos(angle), 0.0)
        return scene.pose_world_marker @ rik.Pose(position)

    errors = []

    def measure(tick) -> None:
        wanted = (marker_pose(arm.clock.now()) @ scene.pose_marker_tool).position
        tool = robot.forward(tick.measured).position
        errors.append([np.linalg.norm(wanted - p) for p in (tick.goal.target.position, tool)])

    with arm:
        arm.enable()
        begin = arm.clock.now()
        synthetic = scene.synthetic(robot).with_marker(scene.marker_id, pose=marker_pose)
        camera = SyntheticSource(synthetic, lambda: arm.read().q, clock=arm.clock)
        poses = (scene.pose_world_camera, scene.pose_marker_tool)
        options = {"frame": robot.tool, "predict": not late, "clock": arm.clock}
        goals = MarkerGoalSource(camera, scene.intrinsics, target, *poses, **options)
        follow = {"sinks": [arm], "solver": "lm", "source": arm, "duration": 3.0}
        with LatestGoals(goals, arm.clock, rate_hz=10.0) as latest:
            rik.follow(robot, latest, on_tick=measure, **follow)

    goal, tool = 1e3 * np.median(errors[-80:], axis=0)
    print(f"pictures when they were used: {goals.picture_ages.summary()}")
    print(f"goal {goal:.1f} mm, gripper {tool:.1f} mm from where the marker was by then")


if __name__ == "__main__":
    main("late" in sys.argv[1:])
