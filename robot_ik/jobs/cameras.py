"""Opens the camera that a request asks for, with its calibration."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.camera.goals.lost import WhenLost
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.synthetic import SyntheticSource
from robot_ik.camera.sources import FrameSource, ImageSource, open_source
from robot_ik.errors import CalibrationError, CameraError, ConfigError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PostureGoal
from robot_ik.jobs.eyes import FREEDOMS_OF_AN_AXIS, Eyes
from robot_ik.jobs.stage import Stage, stage_for

if TYPE_CHECKING:
    from robot_ik.jobs.limbs import Limbs
    from robot_ik.jobs.reach_request import ReachRequest


def open_eyes(request: ReachRequest, limbs: Limbs, frame: str, stack: contextlib.ExitStack) -> Eyes | None:
    """Opens the camera of a request; None when a goal was given and no camera can watch.

    Raises:
        CameraError, CalibrationError: It cannot be opened, or not be used without a calibration.
    """
    synthetic = request.camera == "synthetic"
    if not synthetic:
        return None if request.goal is not None else _real_eyes(request, limbs, frame, stack)
    try:
        stage = _stage(request, limbs, frame)
    except CameraError:
        if request.goal is None:
            raise
        return None  # a goal was given, and nothing can be seen: the read-back must do
    scene = stage.scene(limbs.robot)
    if request.rehearsal.blank_marker:
        scene = scene.blank(stage.marker_id)
    source = stack.enter_context(SyntheticSource(scene, limbs.true_q, seed=request.seed, clock=limbs.clock))
    metal = limbs.arm is not None and limbs.arm.virtual_bus is None
    eyes = Eyes(
        stage, source, stage.intrinsics, stage.pose_world_camera, limbs, frame, synthetic=source,
        why_blind="the synthetic camera cannot see real servos" if metal else "", seed=request.seed,
        when_lost=_when_lost(request, limbs), lead=request.lead,
    )  # fmt: skip
    if request.rehearsal.cover_gripper:
        eyes.cover_gripper_later()
    return eyes


def _real_eyes(request: ReachRequest, limbs: Limbs, frame: str, stack: contextlib.ExitStack) -> Eyes:
    rehearsal = request.rehearsal
    if rehearsal.blank_marker or rehearsal.cover_gripper or rehearsal.marker_at is not None:
        raise ConfigError(
            "what a camera sees can be rehearsed with the synthetic camera only",
            file="command line", key="--rehearse", allowed="--camera synthetic",
        )  # fmt: skip
    calibration = calibration_of(request.camera, request.intrinsics)
    if request.marker_size is None:
        raise CameraError(
            "the size of the printed marker is not given, so its distance cannot be known",
            hint="give the side of its black square in metres: --marker-size 0.05",
        )
    source, intrinsics = open_calibrated(request.camera, calibration, stack)
    stage = _stage(request, limbs, frame)
    if request.follow > 0.0 and isinstance(source, ImageSource):
        raise ConfigError(
            "a photograph does not go on, so there is nothing to follow",
            file="command line", key="--follow", allowed="a camera, stream, film or folder of pictures",
        )  # fmt: skip
    pose = request.pose_world_camera or stage.pose_world_camera
    why = ""
    if not source.live:
        why = "the pictures are recorded, so nothing looked at the arm afterwards"
    elif limbs.arm is None or limbs.arm.virtual_bus is not None:
        why = "the arm is simulated, so a real camera cannot see it"
    elif stage.made_up:
        why = "robot.toml says of no marker on this robot's gripper"
    return Eyes(
        stage, source, intrinsics, pose, limbs, frame, why_blind=why,
        when_lost=_when_lost(request, limbs), lead=request.lead,
    )  # fmt: skip


def _when_lost(request: ReachRequest, limbs: Limbs) -> WhenLost:
    park = PostureGoal(q=limbs.robot.home) if request.when_lost == "park" else None
    return WhenLost(request.when_lost, request.lost_after, park)


def _stage(request: ReachRequest, limbs: Limbs, frame: str) -> Stage:
    """The robot's stage, with what the request says about the target marker."""
    stage = stage_for(limbs.robot, frame, upright=limbs.freedoms < FREEDOMS_OF_AN_AXIS)
    changes: dict[str, Any] = {}
    if request.marker_id is not None:
        changes["marker_id"] = request.marker_id
    if request.marker_size is not None:
        changes["marker_size"] = request.marker_size
    if request.dictionary is not None:
        changes["dictionary"] = request.dictionary
    if request.rehearsal.marker_at is not None:
        x, y, z, yaw = request.rehearsal.marker_at
        if not np.isfinite(request.rehearsal.marker_at).all():
            raise ConfigError(
                f"no marker can be put at {request.rehearsal.marker_at}",
                file="command line", key="--rehearse.marker-at", allowed="finite numbers",
            )  # fmt: skip
        changes["pose_world_marker"] = Pose((x, y, z), rotation_exp([0.0, 0.0, np.deg2rad(yaw)]))
    return replace(stage, **changes)


def calibration_of(camera: str, intrinsics: Path | None) -> Path:
    """The file, for a camera that shall measure.

    Raises:
        CalibrationError: None was given.
    """
    if intrinsics is None:
        raise CalibrationError(
            f"the camera {camera!r} has no calibration, so nothing can be measured in its pictures",
            hint="give its calibration file (OpenCV or ROS YAML): --intrinsics FILE; "
            "make one with: robot-ik camera calibrate",
        )
    return intrinsics


def open_calibrated(
    camera: str,
    intrinsics: Path | None,
    stack: contextlib.ExitStack,
    *,
    size: tuple[int, int] | None = None,
    scaled: bool = False,
) -> tuple[FrameSource, CameraIntrinsics]:
    """A camera that can measure.

    Args:
        camera: What ``open_source`` opens.
        intrinsics: Its calibration file.
        stack: Closes it.
        size: (width, height) to ask of it.
        scaled: Whether a calibration for the same picture at another size will do.

    Raises:
        CalibrationError: There is no calibration, or it is for other pictures.
        CameraError: The camera cannot be opened.
    """
    lens = CameraIntrinsics.load(calibration_of(camera, intrinsics))
    source = stack.enter_context(open_source(camera, size=size))
    delivered = tuple(getattr(source, "size", lens.size))
    if scaled and delivered != lens.size:
        return source, lens.scaled(*delivered)
    lens.require_size(*delivered)
    return source, lens
