"""Follow a marker that moves in a circle, and print the lag of the gripper.

    python examples/06_follow_a_marker.py           goals for the time at which they are used
    python examples/06_follow_a_marker.py late      goals for the time of their picture

Camera and servos are simulated in virtual time, with ten pictures a second. The example prints the
age of the pictures when they were used, and the distances of goal and gripper from the marker.
"""

import sys

import numpy as np

import robot_ik as rik
from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import marker
from robot_ik.jobs.scene import scene_for

# Circle of the marker: radius in metres, angular speed in rad/s. The marker moves at 80 mm/s.
RADIUS = 0.04
SPEED = 2.0


def main(late: bool = False) -> None:
    """Follow the marker for three seconds."""
    arm = rik.open_robot("puma560", bus="sim")
    robot = arm.robot
    scene = scene_for(robot)

    def marker_pose(now: float) -> rik.Pose:
        angle = SPEED * (now - begin)
        position = (RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), 0.0)
        return scene.pose_world_marker @ rik.Pose(position)

    goal_errors = []
    tool_errors = []

    def measure(tick) -> None:
        target = (marker_pose(arm.clock.now()) @ scene.pose_marker_tool).position
        tool = robot.forward(tick.measured).position
        goal_errors.append(np.linalg.norm(target - tick.goal.target.position))
        tool_errors.append(np.linalg.norm(target - tool))

    with arm:
        arm.enable()
        begin = arm.clock.now()
        synthetic = scene.synthetic(robot).with_marker(scene.marker_id, pose=marker_pose)
        goals = MarkerGoalSource(
            SyntheticSource(synthetic, lambda: arm.read().q, clock=arm.clock),
            scene.intrinsics,
            marker(scene.marker_id, scene.marker_size, scene.dictionary),
            scene.pose_world_camera,
            scene.pose_marker_tool,
            robot.tool,
            predict=not late,
            clock=arm.clock,
        )
        with LatestGoals(goals, arm.clock, rate_hz=10.0) as latest:
            rik.follow(
                robot, latest, sinks=[arm], solver="lm", source=arm, duration=3.0, on_tick=measure
            )

    goal = 1e3 * np.median(goal_errors[-80:])
    tool = 1e3 * np.median(tool_errors[-80:])
    print(f"pictures when they were used: {goals.picture_ages.summary()}")
    print(f"goal {goal:.1f} mm, gripper {tool:.1f} mm from where the marker was by then")


if __name__ == "__main__":
    main("late" in sys.argv[1:])
