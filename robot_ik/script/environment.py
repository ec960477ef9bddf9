"""The simulated environment of a script: the synthetic camera, and objects to grip."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.robot import Robot
from robot_ik.script.file import ObjectTable
from robot_ik.workcell.robot_setup import RobotSetup
from robot_ik.workcell.scene import scene_for
from robot_ik.workcell.vision import AXIS_DOF, Vision

#: Divisor of the scene's picture size. Rendering takes most of the time of a script with a camera,
#: and pictures of half the size have a quarter of the pixels.
PICTURE_DIVISOR = 2


def open_camera(
    setup: RobotSetup, marker_at: Sequence[float] | None, seed: int, stack: contextlib.ExitStack
) -> Vision:
    """Open the synthetic camera of the robot's scene and take the first picture.

    The first picture takes longest.

    Args:
        setup: Robot, arm and clock.
        marker_at: Pose of the marker as in ``Scene.with_marker_at``. None: the pose in the scene.
        seed: Random seed of the camera's noise.
        stack: Exit stack that closes the camera.

    Raises:
        CameraError: The robot's model has no scene, and none can be generated.
    """
    scene = scene_for(setup.robot, setup.frame, upright=setup.dof < AXIS_DOF)
    width, height = scene.intrinsics.size
    intrinsics = scene.intrinsics.scaled(width // PICTURE_DIVISOR, height // PICTURE_DIVISOR)
    scene = replace(scene, intrinsics=intrinsics)
    if marker_at is not None:
        scene = scene.with_marker_at(*marker_at)

    # Scripts do not measure the markers on the gripper, so these are not rendered.
    synthetic = replace(scene, cube={}).synthetic(setup.robot)
    source = SyntheticSource(synthetic, setup.true_q, seed=seed, clock=setup.clock)
    stack.enter_context(source)
    vision = Vision(scene, source, setup, synthetic=source)
    vision.picture()
    return vision


def with_objects(robot: Robot, objects: Sequence[ObjectTable]) -> mujoco.MjModel:
    """Return the robot's model with objects on the plane z = 0."""
    # Only scripts with physics need this import. It loads the simulated world.
    from robot_ik.hardware.virtual.world import WorldObject, model_with

    boxes = []
    for table in objects:
        x, y, z = table.position
        length, width, height = (1e-3 * edge for edge in table.size_mm)
        half_yaw = 0.5 * float(np.radians(table.yaw_deg))
        wxyz = (float(np.cos(half_yaw)), 0.0, 0.0, float(np.sin(half_yaw)))
        mass = 1e-3 * table.mass_g
        boxes.append(WorldObject(table.name, (x, y, z), (length, width, height), mass, wxyz))
    return model_with(robot.path, boxes, floor=0.0)
