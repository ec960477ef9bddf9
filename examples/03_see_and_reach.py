"""Sees a printed marker, moves the servos so that the gripper is above it, and lets the camera judge.

    python examples/03_see_and_reach.py          a healthy arm: REACHED
    python examples/03_see_and_reach.py 2        a hidden zero offset of 2 degrees in joint2: NOT REACHED

Camera and servos are simulated; nothing below looks at what they really know.  Prints the goal and how far
the gripper is from it: by the servos' registers, in which the offset does not show, and by the camera.
"""

import sys

import robot_ik as rik
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import MarkerTarget, marker
from robot_ik.hardware.virtual.faults import joint_offset
from robot_ik.jobs.scene import scene_for


def main(offset_deg: float = 0.0) -> None:
    arm = rik.open_robot("puma560", bus="sim")
    robot = arm.robot
    arm.virtual_bus.inject(joint_offset(arm.config.joint("joint2"), offset_deg))

    scene = scene_for(robot)  # where table, marker and camera stand: [reach] of robot.toml
    camera = SyntheticSource(scene.synthetic(robot), arm.true_q, clock=arm.clock)
    lens = scene.intrinsics
    eye = scene.pose_world_camera
    table = marker(scene.marker_id, scene.marker_size, scene.dictionary)
    cube = MarkerTarget(scene.cube, scene.dictionary)
    goals = MarkerGoalSource(camera, lens, table, eye, scene.pose_marker_tool, robot.tool)

    with camera, arm:
        goal = goals.poll(arm.clock.now())
        if goal is None:
            sys.exit("the marker was not found")
        print("goal:", goal.target)
        arm.enable()
        start = arm.read().q
        move = rik.joint_move(robot, start, rik.solve(robot, goal, start=start).require().q)
        rik.execute(move, [arm], source=arm, clock=arm.clock, settle=0.4)
        q, seen = arm.read().q, cube.find(camera.read(), lens)

    print(f"servos say: {1e3 * robot.measure(q).distance(goal.target)[0]:.2f} mm from the goal")
    if seen is None:
        sys.exit("the gripper's markers are not in view")
    pose_cube_gripper = robot.forward(q, scene.cube_frame).inverse() @ robot.forward(q)
    gripper = eye @ seen.pose @ pose_cube_gripper
    miss = gripper.distance(goal.target)[0]
    print(f"camera says: {1e3 * miss:.2f} mm from the goal: {'REACHED' if miss < 0.005 else 'NOT REACHED'}")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
