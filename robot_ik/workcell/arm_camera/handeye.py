"""The hand-eye job: plan views, drive the arm through them, find the board, and solve."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, today
from robot_ik.camera.calibration.handeye import HandEye, Mount, solve_handeye
from robot_ik.camera.calibration.kinematic import CalibrationStation, doubted_zeros
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.workcell.arm_camera.camera_and_board import HandEyeRequest, open_camera_and_board
from robot_ik.workcell.arm_camera.samples import SampleSet
from robot_ik.workcell.arm_camera.stations import ArmCameraReport, visit_stations
from robot_ik.workcell.progress import Progress
from robot_ik.workcell.robot_setup import prepare_robot

# Limits of the error of an arm with correct zeros, each axis: a part of its reach, and rad. With 8
# views and more, servo ticks alone give up to 0.0004 and 0.09 deg, twice the ticks 0.0007 and
# 0.13 deg, a second joint with a zero error of 1.5 deg gives 0.0015 and 0.23 deg.
_MAX_ARM_POSITION = 8e-4
_MAX_ARM_ANGLE = math.radians(0.15)
# Largest share of views that are rejected because of their pictures. One view is always allowed.
_MAX_REJECTED = 0.1


@dataclass(eq=False, kw_only=True)
class HandEyeReport(ArmCameraReport):
    """Result of the job.

    Attributes:
        truth: True poses of camera and board. None if they are unknown.
        result: Result of the calibration. None for a dry run.
        doubt: Why the result may be wrong by more than stated. Empty if there is no doubt.
    """

    truth: Mount | None = None
    result: HandEye | None = None
    doubt: str = ""

    @property
    def parent(self) -> str:
        """The frame from which the camera is seen."""
        return self.samples.frame if self.samples.mounting == "eye_in_hand" else "world"

    @property
    def true_error(self) -> tuple[float, float] | None:
        """Distance of the camera from its true pose, metres and rad. None if it is unknown."""
        if self.truth is None or self.result is None:
            return None
        return self.result.pose_parent_camera.distance(self.truth.pose_parent_camera)

    def solve(self, robot: Robot) -> None:
        """Find the camera from the samples, and judge the arm. Nothing moves.

        Args:
            robot: Robot of the samples.

        Raises:
            CalibrationError: The views do not determine the pose of the camera.
        """
        samples = self.samples
        self.result = solve_handeye(
            samples.samples(robot), samples.intrinsics, mounting=samples.mounting
        )
        stations = [
            CalibrationStation(q, view) for q, view in zip(samples.q, samples.views, strict=True)
        ]
        zeros = doubted_zeros(stations, robot, samples.frame, samples.intrinsics, self.result)
        self.doubt = self_contradiction(self.result, robot.reach(samples.frame), zeros)

    def extrinsics(self) -> CameraExtrinsics:
        """Return the pose of the camera with its origin.

        Raises:
            CalibrationError: There is no result.
        """
        result = self.result
        if result is None:
            raise CalibrationError("the samples have not been solved: a dry run has no result")
        return CameraExtrinsics(
            result.pose_parent_camera,
            self.parent,
            result.covariance[:6, :6],
            result.residual_px,
            result.residual_mm,
            today(),
            self.samples.intrinsics.digest,
            method=f"handeye, {result.mounting.replace('_', ' ')}",
            views=len(self.samples),
            doubt=self.doubt,
        )


def run_handeye(
    request: HandEyeRequest,
    *,
    keep: Callable[[SampleSet], None] = lambda _samples: None,
    progress: Progress = lambda _phase, _share: None,
) -> HandEyeReport:
    """Run the job.

    Args:
        request: Arm, camera and board.
        keep: Called with all samples after each station, so that an interruption loses none.
        progress: Called with the phase and its finished share.

    Raises:
        MarkerNotFoundError: The board was found at fewer than four stations.
        RobotIkError: The input or the environment is wrong, or the views do not determine the pose
            of the camera.
    """
    with contextlib.ExitStack() as stack:
        setup = prepare_robot(request)
        scene = open_camera_and_board(request, setup, stack)
        task = scene.task
        samples = SampleSet(
            request.robot, setup.robot.joints, task.frame, request.mounting, task.intrinsics
        )
        report = HandEyeReport(samples=samples, truth=scene.truth)
        stack.enter_context(setup.connected())
        visit_stations(report, request, setup, scene, keep, progress)
    if request.dry_run:
        return report
    samples.require(len(report.stations), "give better rough poses of camera and board")
    progress("solving", 0.0)
    report.solve(setup.robot)
    return report


def handeye_from_samples(
    samples: SampleSet, intrinsics: CameraIntrinsics | None = None
) -> HandEyeReport:
    """Solve earlier measurements again. Nothing moves.

    Args:
        samples: The measurements. Their intrinsics are replaced by ``intrinsics``.
        intrinsics: Newer intrinsics of the same camera. None: those of the samples.

    Raises:
        CalibrationError: The intrinsics are for another picture size, or the views do not determine
            the pose of the camera.
    """
    if intrinsics is not None:
        intrinsics.require_size(*samples.intrinsics.size)
        samples.intrinsics = intrinsics
    report = HandEyeReport(samples=samples, stations=tuple(samples.q))
    report.solve(samples.load_robot())
    return report


def self_contradiction(
    result: HandEye, ball: tuple[Array, float] | None, zeros: Mapping[str, tuple[float, float]]
) -> str:
    """Return the reasons to doubt the arm of a calibration. Empty without a reason.

    The views of an arm with correct joint zeros agree with small errors.

    Args:
        result: Result of the calibration.
        ball: Centre and radius of the robot's reach. None if it is unknown; the position is not
            judged then.
        zeros: Result of ``doubted_zeros``.
    """
    reasons = [
        f"the zero of {name} seems to be off by "
        f"{math.degrees(offset):.2f} ± {math.degrees(sigma):.2f} deg"
        for name, (offset, sigma) in zeros.items()
    ]
    views = len(result.residuals)
    rejected = len(result.outliers)
    max_position = math.inf if ball is None else _MAX_ARM_POSITION * ball[1]
    if (
        result.arm_position > max_position
        or result.arm_angle > _MAX_ARM_ANGLE
        or rejected > max(1.0, _MAX_REJECTED * views)
    ):
        error = f"{1e3 * result.arm_position:.2f} mm and {math.degrees(result.arm_angle):.2f} deg"
        limit = f"{math.degrees(_MAX_ARM_ANGLE):.2f} deg"
        if ball is not None:
            limit = f"{1e3 * max_position:.2f} mm and {limit}"
        reasons.append(
            f"the error of the arm is {error} (usual: below {limit}) and {rejected} of {views} "
            "views are rejected"
        )
    if not reasons:
        return ""
    return (
        f"the measurements of the arm disagree: {'; '.join(reasons)}; so the pose may be wrong by "
        "far more than is stated; check the joints' zeros: robot-ik camera verify --fit"
    )


def samples_path(out: Path) -> Path:
    """Return the path of the samples of a result: beside it."""
    return out.with_name(f"{out.stem}.samples.json")
