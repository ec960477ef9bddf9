"""Verify an arm with a camera: errors of a carried board, and offsets of the joint zeros.

The camera's pose must not come from the arm. It comes from a board on the table (``robot-ik camera
locate``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
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
from robot_ik.jobs import Progress
from robot_ik.jobs.arm_camera.handeye import (
    ArmCameraReport,
    HandEyeRequest,
    HandEyeScene,
    open_scene,
    visit_stations,
)
from robot_ik.jobs.arm_camera.samples import SampleSet, VerifySamples
from robot_ik.jobs.results import png_of, require_plots
from robot_ik.jobs.robot_setup import RobotSetup, prepare_robot
from robot_ik.jobs.scene import scene_for
from robot_ik.robot import Robot

_AXES = "xyz"
#: Default standard deviation of the board's pose on the arm, each axis, metres and rad.
BOARD_SIGMA = (2e-4, float(np.deg2rad(0.1)))
# Pictures of the marker on the table that locate the simulated camera.
_LOCATE_PICTURES = 5
# Standard deviation of a camera's pose that was found by moving the arm, metres and rad. It has the
# errors of the arm.
_BY_THE_ARM = (0.05, float(np.deg2rad(5.0)))
# A view with more than this multiple of the median standard deviation is not counted.
_UNSURE = 5.0
# Least covariance of a known pose, m and rad, squared. It keeps the covariance regular.
_LEAST = 1e-12 * np.eye(6)
# Resolution of the picture of errors, dots per inch.
_DPI = 100
# Title of each view of the picture, and the world axes across and up.
_VIEWS = (("from above", 0, 1), ("from the side", 0, 2))
# Length of the longest arrow over the extent of the poses.
_LONGEST = 0.25


@dataclass(frozen=True)
class Region:
    """Summary of the errors of some poses.

    Attributes:
        name: Which poses.
        poses: Number of poses.
        rms_m: RMS of the distances, metres.
        median_m: Median of the distances, metres.
        largest_m: Largest distance, metres.
        rms_rad: RMS of the angles, rad.
        sigma_m: RMS of the stated standard deviations, metres.
    """

    name: str
    poses: int
    rms_m: float
    median_m: float
    largest_m: float
    rms_rad: float
    sigma_m: float


def summary(errors: Sequence[PoseError], name: str = "all") -> Region:
    """Return the summary of at least one pose."""
    distances = np.array([one.distance for one in errors])
    return Region(
        name,
        len(errors),
        float(np.sqrt(np.mean(distances**2))),
        float(np.median(distances)),
        float(distances.max()),
        float(np.sqrt(np.mean([one.angle**2 for one in errors]))),
        float(np.sqrt(np.mean([one.sigma**2 for one in errors]))),
    )


def regions(errors: Sequence[PoseError]) -> tuple[Region, ...]:
    """Return the summaries of all poses, and of the lower and upper half along each world axis."""
    positions = np.array([one.position for one in errors])
    found = [summary(errors)]
    for k, axis in enumerate(_AXES):
        middle = 0.5 * float(positions[:, k].min() + positions[:, k].max())
        for sign, side in (("<", positions[:, k] < middle), (">=", positions[:, k] >= middle)):
            chosen = [one for one, inside in zip(errors, side, strict=True) if inside]
            if chosen and len(chosen) < len(errors):
                found.append(summary(chosen, f"{axis} {sign} {1e3 * middle:.0f} mm"))
    return tuple(found)


@dataclass(frozen=True)
class VerifyRequest(HandEyeRequest):
    """An arm that carries a board (``pose_other_board``) in view of a camera that does not move.

    Attributes:
        views: Number of pictures.
        extrinsics: File of the camera's pose. A real camera needs one. The simulated camera is
            located first.
        board_sigma: Standard deviation of the board's pose, each axis, metres and rad.
        fit: Whether to estimate the joints' zero offsets.
    """

    views: int = 30
    extrinsics: Path | None = None
    board_sigma: tuple[float, float] = BOARD_SIGMA
    fit: bool = False


@dataclass(eq=False, kw_only=True)
class VerifyReport(ArmCameraReport):
    """Result of the verification.

    Attributes:
        samples: The measurements.
        robot: The robot.
        config: The arm file. None for a simulated arm without one.
        errors: Error of each view by the angles of the servos. Empty for a dry run.
        fit: Offsets of the joints. Its ``errors`` are of views that were left out of the fit. None
            if it was not requested.
    """

    samples: VerifySamples
    robot: Robot
    config: ArmConfig | None
    errors: tuple[PoseError, ...] = ()
    fit: ZeroOffsets | None = None

    def compare(self, *, fit: bool) -> None:
        """Compute the errors and, if requested, fit the offsets of the joints, without moving.

        Raises:
            MarkerNotFoundError: The board was seen at too few of the stations.
        """
        samples = self.samples
        samples.require(len(self.stations), "where camera and board are said to be")
        views = [
            CalibrationStation(q, view) for q, view in zip(samples.q, samples.views, strict=True)
        ]
        known = samples.camera, samples.board
        model = ArmModel(self.robot, samples.frame, samples.intrinsics, views, *known)
        if samples.by_arm:
            # The camera's pose fits the arm's views, so only errors that change from view to view
            # are left.
            self.errors = fit_zero_offsets(model, self.robot.joints).errors
        else:
            self.errors = measure_errors(model)
        self.fit = fit_zero_offsets(model) if fit else None

    @property
    def unsure(self) -> tuple[int, ...]:
        """Indices of the views that are far less accurate than the others or contradict them."""
        limit = _UNSURE * float(np.median([one.sigma for one in self.errors]))
        wrong = () if self.fit is None else self.fit.outliers
        return tuple(k for k, one in enumerate(self.errors) if one.sigma > limit or k in wrong)

    def judged(self, *, corrected: bool) -> tuple[PoseError, ...]:
        """Return the errors of the arm, as it is or corrected by the fit, without unsure views."""
        errors = self.fit.errors if corrected and self.fit is not None else self.errors
        unsure = self.unsure
        return tuple(one for k, one in enumerate(errors) if k not in unsure)

    def passed(self, allowed: float, *, corrected: bool = False) -> bool:
        """Return whether no error is larger than ``allowed``, metres."""
        return summary(self.judged(corrected=corrected)).largest_m <= allowed

    @property
    def better(self) -> bool:
        """Whether the fitted zeros reduce the errors of views that were left out of the fit."""
        return self.fit is not None and (
            summary(self.judged(corrected=True)).rms_m < summary(self.judged(corrected=False)).rms_m
        )

    def zero_ticks(self) -> dict[str, tuple[int, int]]:
        """Return by servo the present and the fitted zero, ticks, of servos whose zero changes."""
        if self.config is None:
            return {}
        pairs = zip(
            self.config.servos, zeros_moved(self.config, self.offsets()).servos, strict=True
        )
        zeros = {was.name: (was.zero_ticks, new.zero_ticks) for was, new in pairs}
        return {name: both for name, both in zeros.items() if both[0] != both[1]}

    def offsets(self) -> dict[str, float]:
        """Return by joint the fitted offset, rad, of joints whose offset is determined."""
        if self.fit is None:
            return {}
        return {
            name: float(value)
            for name, value in zip(self.fit.joints, self.fit.offsets, strict=True)
            if name in self.fit.found
        }


def run_verify(
    request: VerifyRequest,
    *,
    keep: Callable[[SampleSet], None] = lambda _samples: None,
    progress: Progress = lambda _phase, _share: None,
) -> VerifyReport:
    """Locate the camera, plan the views, visit them and compute the errors.

    Args:
        request: Arm, camera and board.
        keep: Called with all samples after each station.
        progress: Called with the phase and its finished share.

    Raises:
        RobotIkError: Wrong input or environment. The board was seen at too few stations, or the
            marker on the table was not seen.
    """
    if request.rehearsal.zero_offset_deg and request.camera != "synthetic":
        raise ConfigError(
            "a zero offset can be rehearsed before the synthetic camera only",
            file="command line",
            key="--rehearse-zero-offset",
            allowed=f"--camera synthetic, {SIMULATED}",
        )
    with contextlib.ExitStack() as stack:
        setup = prepare_robot(request)
        if request.camera != "synthetic" and request.extrinsics is None:
            raise CalibrationError(
                f"where the camera {request.camera!r} stands is not known, "
                "so it cannot judge the arm",
                hint="lay a board on the table, find it (robot-ik camera locate), "
                "give --camera-extrinsics",
            )
        scene = open_scene(request, setup, stack)
        extrinsics = _given_extrinsics(request, scene.task.intrinsics)
        stack.enter_context(setup.connected())
        samples = _locate(request, setup, scene, extrinsics, progress)
        report = VerifyReport(robot=setup.robot, config=setup.config, samples=samples)
        mount = Mount(samples.camera.pose, samples.board.pose, "eye_to_hand")
        scene = replace(scene, task=replace(scene.task, mount=mount))
        visit_stations(report, request, setup, scene, keep, progress)
    if request.dry_run:
        return report
    progress("comparing", 0.0)
    report.compare(fit=request.fit)
    return report


def verify_from_samples(
    samples: VerifySamples, request: VerifyRequest, *, board_sigma: bool
) -> VerifyReport:
    """Compute the errors from saved samples, without moving.

    Args:
        samples: The samples.
        request: Only ``fit``, ``arm_file``, ``intrinsics``, ``extrinsics``, ``pose_other_board``
            and ``board_sigma`` are used.
        board_sigma: Whether to use ``board_sigma`` of the request instead of the saved covariance.

    Raises:
        ConfigError: The arm file is not the one the joints were read with.
        CalibrationError: Other intrinsics without extrinsics that were found with them.
    """
    if request.intrinsics is not None:
        lens = CameraIntrinsics.load(request.intrinsics)
        lens.require_size(*samples.intrinsics.size)
        if lens.digest != samples.intrinsics.digest and request.extrinsics is None:
            raise CalibrationError(
                "the camera's pose on file was found with another calibration",
                hint="give the extrinsics that were found with this one: --camera-extrinsics FILE",
            )
        samples = replace(samples, intrinsics=lens)
    extrinsics = _given_extrinsics(request, samples.intrinsics)
    camera = {} if extrinsics is None else _known_camera(extrinsics)
    board = replace(samples.board, pose=request.pose_other_board or samples.board.pose)
    if board_sigma:
        board = KnownPose.within(board.pose, *request.board_sigma)
    config = None if request.arm_file is None else samples.arm(request.arm_file)
    robot = samples.load_robot()
    samples = replace(samples, board=board, **camera)
    report = VerifyReport(robot=robot, config=config, samples=samples, stations=tuple(samples.q))
    report.compare(fit=request.fit)
    return report


def _given_extrinsics(
    request: VerifyRequest, intrinsics: CameraIntrinsics
) -> CameraExtrinsics | None:
    if request.extrinsics is None:
        return None
    extrinsics = CameraExtrinsics.load(request.extrinsics, intrinsics)
    extrinsics.require_parent("world")
    return extrinsics


def _locate(
    request: VerifyRequest,
    setup: RobotSetup,
    scene: HandEyeScene,
    extrinsics: CameraExtrinsics | None,
    progress: Progress,
) -> VerifySamples:
    """Return samples with the prior knowledge only. Without extrinsics, locate the camera."""
    if extrinsics is None:
        progress("locating the camera", 0.0)
        extrinsics = _located(setup, scene)
    task = scene.task
    config = setup.config
    truth = scene.truth
    joints = setup.robot.joints
    pose = request.pose_other_board
    if pose is None:
        pose = Pose() if truth is None else truth.pose_other_board
    offsets_deg = [request.rehearsal.zero_offset_deg.get(name, 0.0) for name in joints]
    return VerifySamples(
        request.robot,
        joints,
        task.frame,
        "eye_to_hand",
        task.intrinsics,
        **_known_camera(extrinsics),
        board=KnownPose.within(pose, *request.board_sigma),
        true_offsets=None if truth is None else np.deg2rad(offsets_deg),
        servos=() if config is None else tuple(map(plain, config.joints)),
    )


def _located(setup: RobotSetup, scene: HandEyeScene) -> CameraExtrinsics:
    """Locate the simulated camera by the marker on the table, as ``robot-ik camera locate``."""
    around = scene_for(setup.robot, setup.frame)
    lens = scene.task.intrinsics
    sheet = marker(around.marker_id, around.marker_size, around.dictionary)
    views = [sheet.find(scene.take(), lens) for _ in range(_LOCATE_PICTURES)]
    seen = [view for view in views if view is not None]
    if not seen:
        raise MarkerNotFoundError(
            "the marker on the table is hidden, "
            "so the simulated camera does not know where it stands",
            hint="give where it is: --camera-extrinsics FILE",
        )
    return locate_camera(seen, around.pose_world_marker, lens)


def _known_camera(extrinsics: CameraExtrinsics) -> dict[str, Any]:
    """Return the fields ``camera`` and ``by_arm`` of ``VerifySamples``."""
    pose = extrinsics.pose_parent_camera
    if extrinsics.method.startswith("handeye"):
        return {"camera": KnownPose.within(pose, *_BY_THE_ARM), "by_arm": True}
    return {"camera": KnownPose(pose, extrinsics.covariance + _LEAST), "by_arm": False}


def error_picture(report: VerifyReport) -> bytes:
    """Return a PNG with an arrow for the error of each pose.

    All arrows of a row have the same scale and colours.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("drawing the errors")
    from matplotlib.figure import Figure

    rows = [("as it is", report.judged(corrected=False))]
    if report.fit is not None:
        rows.append(("with new zeros", report.judged(corrected=True)))
    figure = Figure(figsize=(10.0, 4.4 * len(rows)), dpi=_DPI, layout="constrained")
    grid = figure.subplots(len(rows), len(_VIEWS), squeeze=False)
    for line, (title, errors) in zip(grid, rows, strict=True):
        for axes, (view, across, up) in zip(line, _VIEWS, strict=True):
            arrows, scale = _draw(axes, errors, across, up)
            axes.set_title(f"{title}, {view}, arrows ×{scale:.0f}")
        figure.colorbar(arrows, ax=list(line), label="off by, mm")
    return png_of(figure)


def _draw(axes: Any, errors: Sequence[PoseError], across: int, up: int) -> tuple[Any, float]:
    positions = 1e3 * np.array([one.position for one in errors])
    vectors = 1e3 * np.array([one.vector for one in errors])
    length = np.linalg.norm(vectors, axis=1)
    scale = _LONGEST * float(np.ptp(positions, axis=0).max()) / max(float(length.max()), 1e-9)
    arrows = axes.quiver(
        positions[:, across],
        positions[:, up],
        vectors[:, across],
        vectors[:, up],
        length,
        angles="xy",
        scale_units="xy",
        scale=1.0 / max(scale, 1e-9),
        cmap="viridis",
        width=0.005,
    )
    arrows.set_clim(0.0, float(length.max()))
    axes.plot(positions[:, across], positions[:, up], ".", color="#999999", markersize=4, zorder=0)
    # The origin of the world: the base of the arm.
    axes.plot(0.0, 0.0, "s", color="#444444", markersize=8)
    # matplotlib ignores the tips of arrows when it chooses the limits.
    tips = positions + scale * vectors
    axes.update_datalim(tips[:, (across, up)])
    axes.autoscale_view()
    axes.set_xlabel(f"{'xyz'[across]}, mm")
    axes.set_ylabel(f"{'xyz'[up]}, mm")
    axes.set_aspect("equal", adjustable="datalim")
    return arrows, scale
