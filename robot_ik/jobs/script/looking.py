"""The world of a script: its synthetic camera, and things that lie about."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from robot_ik.camera.made_up.synthetic import SyntheticSource
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.jobs.eyes import FREEDOMS_OF_AN_AXIS, Eyes
from robot_ik.jobs.limbs import Limbs
from robot_ik.jobs.script.steps import ThingTable
from robot_ik.jobs.stage import stage_for
from robot_ik.robot import Robot

SMALLER = 2
"""A script looks often, and pictures take longer than all else: half the size is a quarter of the work."""


def open_camera(limbs: Limbs, marker_at: list[float] | None, seed: int, stack: contextlib.ExitStack) -> Eyes:
    """The camera of the robot's stage, ready: the first picture, which takes longest, has been taken.

    Args:
        limbs: What it looks at.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker; None: the stage's own.
        seed: Of its noise.
        stack: Closes it.

    Raises:
        CameraError: The robot's model says of no stage, and none can be made up.
    """
    stage = stage_for(limbs.robot, limbs.frame, upright=limbs.freedoms < FREEDOMS_OF_AN_AXIS)
    width, height = stage.intrinsics.size
    stage = replace(stage, intrinsics=stage.intrinsics.scaled(width // SMALLER, height // SMALLER))
    if marker_at is not None:
        yaw = marker_at[3] if len(marker_at) == 4 else 0.0
        pose = Pose(marker_at[:3], rotation_exp([0.0, 0.0, np.radians(yaw)]))
        stage = replace(stage, pose_world_marker=pose)
    scene = replace(stage, cube={}).scene(limbs.robot)  # nobody judges by the gripper's markers here
    source = SyntheticSource(scene, limbs.true_q, seed=seed, clock=limbs.clock, quality="fast")
    eyes = Eyes(
        stage,
        stack.enter_context(source),
        stage.intrinsics,
        stage.pose_world_camera,
        limbs,
        limbs.frame,
        synthetic=source,
        seed=seed,
    )
    eyes.picture()
    return eyes


def with_things(robot: Robot, things: Sequence[ThingTable]) -> mujoco.MjModel:
    """The robot's model with things on the plane z = 0."""
    from robot_ik.hardware.virtual.things import Thing, model_with

    boxes = []
    for thing in things:
        (x, y, z), half = thing.position, 0.5 * float(np.radians(thing.yaw_deg))
        wide, deep, high = (1e-3 * edge for edge in thing.size_mm)
        turn = (float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))
        boxes.append(Thing(thing.name, (x, y, z), (wide, deep, high), 1e-3 * thing.mass_g, turn))
    return model_with(robot.path, boxes, floor=0.0)
