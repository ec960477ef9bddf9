"""Follows a marker that is pushed round in a circle, and prints how far the gripper lags behind.

    python examples/06_follow_a_marker.py           goals for the time they are used at
    python examples/06_follow_a_marker.py late      goals for the time their picture was taken at

Camera and servos are simulated, ten pictures a second, in virtual time.  Prints how old the pictures were
when they were used, and how far goals and gripper were from where the marker really was by then.
"""

import sys

import numpy as np

import robot_ik as rik
from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import marker as marker_target
from robot_ik.jobs.scene import scene_for


def main(late: bool = False) -> None:
    arm = rik.open_robot("puma560", bus="sim")
    robot = arm.robot
    scene = scene_for(robot)

    def marker(now: float) -> rik.Pose:
        angle = 2.0 * (now - begin)
        return scene.pose_world_marker @ rik.Pose((0.04 * np.sin(angle), 0.04 - 0.04 * np.cos(angle), 0.0))

    off = []

    def compare(tick) -> None:
        here = (marker(arm.clock.now()) @ scene.pose_marker_tool).position
        tool = robot.forward(tick.measured).position
        off.append([np.linalg.norm(here - p) for p in (tick.goal.target.position, tool)])

    with arm:
        arm.enable()
        begin = arm.clock.now()
        synthetic = scene.synthetic(robot).with_marker(scene.marker_id, pose=marker)
        camera = SyntheticSource(synthetic, lambda: arm.read().q, clock=arm.clock)
        lens = scene.intrinsics
        target = marker_target(scene.marker_id, scene.marker_size, scene.dictionary)
        eye, hover = scene.pose_world_camera, scene.pose_marker_tool
        options = {"predict": not late, "clock": arm.clock}
        goals = MarkerGoalSource(camera, lens, target, eye, hover, robot.tool, **options)
        with LatestGoals(goals, arm.clock, rate_hz=10.0) as latest:
            rik.follow(robot, latest, sinks=[arm], solver="lm", source=arm, duration=3.0, on_tick=compare)

    goal, tool = 1e3 * np.median(off[-80:], axis=0)
    print(f"pictures when they were used: {goals.picture_ages.summary()}")
    print(f"goal {goal:.1f} mm, gripper {tool:.1f} mm from where the marker was by then")


if __name__ == "__main__":
    main("late" in sys.argv[1:])
