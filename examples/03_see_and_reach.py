"""Detect a printed marker, move the gripper above it, and verify the result with a camera.

    python examples/03_see_and_reach.py      no fault: REACHED
    python examples/03_see_and_reach.py 2    zero offset of 2 degrees in joint2: NOT REACHED

Camera and servos are simulated, and the program does not read their true state. It prints the goal
and the distance of the gripper from it, by the registers of the servos and by the camera. The
registers do not show the offset.
"""

import sys

import robot_ik as rik
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import MarkerTarget, marker
from robot_ik.hardware.virtual.faults import joint_offset
from robot_ik.workcell.scene import scene_for


def main(offset_deg: float = 0.0) -> None:
    arm = rik.open_robot("puma560", bus="sim")
    robot = arm.robot
    arm.virtual_bus.inject(joint_offset(arm.config.joint("joint2"), offset_deg))

    scene = scene_for(robot)  # poses of table, marker and camera: [reach] of robot.toml
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
        q = arm.read().q
        observation = cube.find(camera.read(), lens)

    print(f"by the servos: {1e3 * robot.measure(q).distance(goal.target)[0]:.2f} mm from the goal")
    if observation is None:
        sys.exit("the gripper's markers are not in view")
    pose_cube_gripper = robot.forward(q, scene.cube_frame).inverse() @ robot.forward(q)
    gripper = eye @ observation.pose @ pose_cube_gripper
    error = gripper.distance(goal.target)[0]
    print(
        f"by the camera: {1e3 * error:.2f} mm from the goal: "
        f"{'REACHED' if error < 0.005 else 'NOT REACHED'}"
    )


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
