"""Arms with five joints for tests: bundled ones, the geometry of an SO-101, and random ones."""

import numpy as np

import robot_ik as rik

# Frames and ranges of the SO-101 (TheRobotStudio/SO-ARM100, Apache-2.0), without shapes.
SO101 = """<mujoco model="so101_geometry"><compiler angle="radian"/><worldbody>
<body name="shoulder" pos="0.0388353 0 0.0624" quat="0 0 1 0">
 <joint name="shoulder_pan" axis="0 0 1" range="-1.91986 1.91986"/><geom size="0.01"/>
 <body name="upper_arm" pos="-0.0303992 -0.0182778 -0.0542" quat="0.5 -0.5 -0.5 -0.5">
  <joint name="shoulder_lift" axis="0 0 1" range="-1.74533 1.74533"/><geom size="0.01"/>
  <body name="lower_arm" pos="-0.11257 -0.028 0" quat="0.7071067811865475 0 0 0.7071067811865475">
   <joint name="elbow_flex" axis="0 0 1" range="-1.69 1.69"/><geom size="0.01"/>
   <body name="wrist" pos="-0.1349 0.0052 0" quat="0.7071067811865475 0 0 -0.7071067811865475">
    <joint name="wrist_flex" axis="0 0 1" range="-1.65806 1.65806"/><geom size="0.01"/>
    <body name="gripper" pos="0 -0.0611 0.0181"
     quat="0.01720910823057101 -0.01720910823057101 0.7068973380865913 0.7068973380865913">
     <joint name="wrist_roll" axis="0 0 1" range="-2.74385 2.84121"/><geom size="0.01"/>
     <site name="gripper" pos="-0.0079 -0.000218121 -0.0981274"
      quat="0 0.7071067811865476 0.7071067811865476 0"/>
     <site name="marker" pos="0.004 0.042 -0.022" quat="0 0.7071067811865476 0.7071067811865476 0"/>
     <site name="on_roll_axis" pos="0 0 -0.09"/>
     <body pos="0.02 0.0188 -0.0234"><joint name="jaw" axis="0 1 0" range="-0.17 1.7"/>
      <geom size="0.01"/></body>
    </body></body></body></body></body></worldbody></mujoco>"""

NAMES = ("koch_v11", "omx_f", "so101")


def load(name: str, tool: str | None = None) -> rik.Robot:
    """Return an arm by its name in ``NAMES``."""
    if name == "so101":
        return rik.load_robot(SO101, tool=tool or "gripper")
    return rik.load_robot(name, tool=tool)


def random_pose(robot: rik.Robot, rng: np.random.Generator) -> rik.Pose:
    """Return a pose whose position the arm reaches, with a random orientation."""
    return rik.Pose(robot.forward(robot.sample(rng)).position, rng.normal(size=4))


def arm_joints(robot: rik.Robot) -> list[int]:
    """Return the indices of the five joints that move the tool."""
    node, _ = robot.attachment()
    return list(robot.tree.ancestors(node))
