"""Measure the errors of an arm with a camera, and the zero offsets of its joints.

The arm carries a board. The pose of the camera must not be measured with the arm: it comes from a
board on the table (``robot-ik camera locate``).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, locate_camera
from robot_ik.camera.calibration.handeye import Mount
from robot_ik.camera.calibration.kinematic import (
    ArmModel,
    CalibrationStation,
    KnownPose,
    PoseError,
    ZeroOffsets,
    fit_zero_offsets,
    measure_errors,
)
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import marker
from robot_ik.errors import CalibrationError, ConfigError, MarkerNotFoundError
from robot_ik.files import plain
from robot_ik.geometry import Pose
from robot_ik.hardware import SIMULATED
from robot_ik.hardware.calibration_file import zeros_moved
from robot_ik.hardware.config import ArmConfig
from robot_ik.robot import Robot
from robot_ik.workcell.arm_camera.camera_and_board import (
    CameraAndBoard,
    HandEyeRequest,
    open_camera_and_board,
)
from robot_ik.workcell.arm_camera.error_map import summary
from robot_ik.workcell.arm_camera.samples import SampleSet, VerifySamples
from robot_ik.workcell.arm_camera.stations import ArmCameraReport, visit_stations
from robot_ik.workcell.progress import Progress
from robot_ik.workcell.robot_setup import RobotSetup, prepare_robot
from robot_ik.workcell.scene import scene_for

#: Standard deviation of the board's pose on the arm by default, each axis: metres, rad.
BOARD_SIGMA = (2e-4, math.radians(0.1))
# Number of pictures of the marker on the table by which the simulated camera is located.
_LOCATE_PICTURES = 5
# Standard deviation of a camera's pose that was measured with the arm, each axis: metres, rad. It
# contains the errors of the arm.
_SIGMA_BY_ARM = (0.05, math.radians(5.0))
# A view is uncertain if its standard deviation is larger than the median by this factor.
_UNCERTAIN_FACTOR = 5.0
# Added to the covariance of the camera's pose, m^2 and rad^2. It keeps the covariance regular.
_MIN_COVARIANCE = 1e-12 * np.eye(6)


@dataclass(frozen=True)
class VerifyRequest(HandEyeRequest):
    """An arm that carries a board (``pose_other_board``) in front of a resting camera.

    Attributes:
        views: Number of pictures.
        extrinsics: File with the pose of the camera. A real camera needs it. The simulated camera
            is located first.
        board_sigma: Standard deviation of the board's pose, each axis: metres, rad.
        fit: Whether to estimate the zero offsets of the joints.
    """

    views: int = 30
    extrinsics: Path | None = None
    board_sigma: tuple[float, float] = BOARD_SIGMA
    fit: bool = False


@dataclass(eq=False, kw_only=True)
class VerifyReport(ArmCameraReport):
    """Result of the measurement.

    Attributes:
        samples: The measurements and the prior knowledge.
        robot: The robot.
        config: The arm file. None without servos.
        errors: Error of each view with the joint angles of the servos. Empty for a dry run.
        fit: Zero offsets of the joints. Its ``errors`` are those of views that were left out. None
            unless requested.
    """

    samples: VerifySamples
    robot: Robot
    config: ArmConfig | None
    errors: tuple[PoseError, ...] = ()
    fit: ZeroOffsets | None = None

    def compare(self, *, fit: bool) -> None:
        """Compute the errors and, if requested, the zero offsets. Nothing moves.

        Args:
            fit: Whether to fit the zero offsets.

        Raises:
            MarkerNotFoundError: The board was found at too few stations.
        """
        samples = self.samples
        samples.require(len(self.stations), "the given poses of camera and board")
        views = [
            CalibrationStation(q, view) for q, view in zip(samples.q, samples.views, strict=True)
        ]
        model = ArmModel(
            self.robot, samples.frame, samples.intrinsics, views, samples.camera, samples.board
        )
        if samples.by_arm:
            # The views determine the camera's pose. Only errors that differ between views remain.
            self.errors = fit_zero_offsets(model, self.robot.joints).errors
        else:
            self.errors = measure_errors(model)
        self.fit = fit_zero_offsets(model) if fit else None

    @property
    def excluded(self) -> tuple[int, ...]:
        """Indices of the views that do not count.

        They are far less certain than the others or contradict them.
        """
        limit = _UNCERTAIN_FACTOR * float(np.median([error.sigma for error in self.errors]))
        outliers = () if self.fit is None else self.fit.outliers
        return tuple(
            k for k, error in enumerate(self.errors) if error.sigma > limit or k in outliers
        )

    def judged(self, *, corrected: bool) -> tuple[PoseError, ...]:
        """Return the errors that count.

        Args:
            corrected: Use the errors with the zero offsets of the fit, if there is one.
        """
        errors = self.fit.errors if corrected and self.fit is not None else self.errors
        excluded = self.excluded
        return tuple(error for k, error in enumerate(errors) if k not in excluded)

    def error_maps(self) -> list[tuple[str, tuple[PoseError, ...]]]:
        """Return the errors that count, with a title: as measured and, if fitted, corrected."""
        maps = [("as it is", self.judged(corrected=False))]
        if self.fit is not None:
            maps.append(("with new zeros", self.judged(corrected=True)))
        return maps

    def passed(self, allowed: float, *, corrected: bool = False) -> bool:
        """Return whether no error is larger than ``allowed``, metres."""
        return summary(self.judged(corrected=corrected)).largest_m <= allowed

    @property
    def better(self) -> bool:
        """Whether the zero offsets reduce the errors of views that were left out of the fit."""
        if self.fit is None:
            return False
        before = summary(self.judged(corrected=False)).rms_m
        return summary(self.judged(corrected=True)).rms_m < before

    def zero_ticks(self) -> dict[str, tuple[int, int]]:
        """Return the zeros that change, by servo: that of the arm file and the new one, ticks."""
        if self.config is None:
            return {}
        corrected = zeros_moved(self.config, self.offsets())
        zeros = {
            old.name: (old.servo.zero_ticks, new.servo.zero_ticks)
            for old, new in zip(self.config.drives, corrected.drives, strict=True)
        }
        return {name: (old, new) for name, (old, new) in zeros.items() if old != new}

    def offsets(self) -> dict[str, float]:
        """Return the offsets that could be determined, by joint, rad."""
        if self.fit is None:
            return {}
        return {
            name: float(value)
            for name, value in zip(self.fit.joints, self.fit.offsets, strict=True)
            if name in self.fit.determined
        }


def run_verify(
    request: VerifyRequest,
    *,
    keep: Callable[[SampleSet], None] = lambda _samples: None,
    progress: Progress = lambda _phase, _share: None,
) -> VerifyReport:
    """Locate the camera, plan views, drive the arm through them, and compare.

    Args:
        request: Arm, camera and board.
        keep: Called with all samples after each station.
        progress: Called with the phase and its finished share.

    Raises:
        RobotIkError: The input or the environment is wrong, or the board on the arm or on the table
            was found in too few pictures.
    """
    if request.rehearsal.zero_offset_deg and request.camera != "synthetic":
        raise ConfigError(
            "a zero offset can be rehearsed before the synthetic camera only",
            file="command line",
            key="--fault",
            allowed=f"--camera synthetic, {SIMULATED}",
        )
    with contextlib.ExitStack() as stack:
        setup = prepare_robot(request)
        if request.camera != "synthetic" and request.extrinsics is None:
            raise CalibrationError(
                f"the pose of the camera {request.camera!r} is unknown, so it cannot measure the "
                "arm",
                hint="lay a board on the table, find it (robot-ik camera locate), give "
                "--extrinsics",
            )
        scene = open_camera_and_board(request, setup, stack)
        extrinsics = _load_extrinsics(request, scene.task.intrinsics)
        stack.enter_context(setup.connected())
        if extrinsics is None:
            progress("locating the camera", 0.0)
            extrinsics = _locate(setup, scene)
        samples = _empty_samples(request, setup, scene, extrinsics)
        report = VerifyReport(robot=setup.robot, config=setup.config, samples=samples)
        mount = Mount(samples.camera.pose, samples.board.pose, "eye_to_hand")
        scene = replace(scene, task=replace(scene.task, mount=mount))
        visit_stations(report, request, setup, scene, keep, progress)
    if request.dry_run:
        return report
    progress("comparing", 0.0)
    report.compare(fit=request.fit)
    return report


def verify_from_samples(samples: VerifySamples, request: VerifyRequest) -> VerifyReport:
    """Compare earlier measurements again. Nothing moves.

    Args:
        samples: The measurements.
        request: Its ``fit`` and ``arm_file`` are used. Its ``intrinsics``, ``extrinsics`` and
            ``pose_other_board`` replace those of the samples if they are given.

    Raises:
        ConfigError: The joints were read with another arm file.
        CalibrationError: The intrinsics differ, but no extrinsics found with them are given.
    """
    if request.intrinsics is not None:
        intrinsics = CameraIntrinsics.load(request.intrinsics)
        intrinsics.require_size(*samples.intrinsics.size)
        if intrinsics.digest != samples.intrinsics.digest and request.extrinsics is None:
            raise CalibrationError(
                "the camera's pose on file was found with another calibration",
                hint="give the extrinsics that were found with this one: --extrinsics FILE",
            )
        samples = replace(samples, intrinsics=intrinsics)
    extrinsics = _load_extrinsics(request, samples.intrinsics)
    if extrinsics is not None:
        samples = replace(samples, **_camera_knowledge(extrinsics))
    board = replace(samples.board, pose=request.pose_other_board or samples.board.pose)
    config = None if request.arm_file is None else samples.arm(request.arm_file)
    samples = replace(samples, board=board)
    report = VerifyReport(
        robot=samples.load_robot(), config=config, samples=samples, stations=tuple(samples.q)
    )
    report.compare(fit=request.fit)
    return report


def _load_extrinsics(
    request: VerifyRequest, intrinsics: CameraIntrinsics
) -> CameraExtrinsics | None:
    if request.extrinsics is None:
        return None
    extrinsics = CameraExtrinsics.load(request.extrinsics, intrinsics)
    extrinsics.require_parent("world")
    return extrinsics


def _empty_samples(
    request: VerifyRequest, setup: RobotSetup, scene: CameraAndBoard, extrinsics: CameraExtrinsics
) -> VerifySamples:
    """Return the prior knowledge of the measurement, without a sample."""
    joints = setup.robot.joints
    truth = scene.truth
    pose = request.pose_other_board
    if pose is None:
        pose = Pose() if truth is None else truth.pose_other_board
    true_offsets = None
    if truth is not None:
        offsets_deg = [request.rehearsal.zero_offset_deg.get(name, 0.0) for name in joints]
        true_offsets = np.deg2rad(offsets_deg)
    return VerifySamples(
        request.robot,
        joints,
        scene.task.frame,
        "eye_to_hand",
        scene.task.intrinsics,
        **_camera_knowledge(extrinsics),
        board=KnownPose.within(pose, *request.board_sigma),
        true_offsets=true_offsets,
        servos=() if setup.config is None else tuple(map(plain, setup.config.joints)),
    )


def _locate(setup: RobotSetup, scene: CameraAndBoard) -> CameraExtrinsics:
    """Locate the simulated camera by the marker on the table.

    Raises:
        MarkerNotFoundError: The marker is hidden.
    """
    surroundings = scene_for(setup.robot, setup.frame)
    intrinsics = scene.task.intrinsics
    sheet = marker(surroundings.marker_id, surroundings.marker_size, surroundings.dictionary)
    observations = [sheet.find(scene.take(), intrinsics) for _ in range(_LOCATE_PICTURES)]
    views = [view for view in observations if view is not None]
    if not views:
        raise MarkerNotFoundError(
            "the marker on the table is hidden, so the pose of the simulated camera is unknown",
            hint="give its pose: --extrinsics FILE",
        )
    return locate_camera(views, surroundings.pose_world_marker, intrinsics)


def _camera_knowledge(extrinsics: CameraExtrinsics) -> dict[str, Any]:
    """Return the fields ``camera`` and ``by_arm`` of ``VerifySamples``."""
    pose = extrinsics.pose_parent_camera
    if extrinsics.method.startswith("handeye"):
        return {"camera": KnownPose.within(pose, *_SIGMA_BY_ARM), "by_arm": True}
    return {"camera": KnownPose(pose, extrinsics.covariance + _MIN_COVARIANCE), "by_arm": False}
