"""Pose of a camera seen from the world or from the robot frame that carries it, and its file.

The file is TOML. It names its frames and units, and the calibration of the lens. The pose is valid
only with this calibration. Loading it with another one is an error.
"""

from __future__ import annotations

import datetime
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from robot_ik.camera.calibration.least_squares import cauchy_weight
from robot_ik.camera.calibration.pose_means import robust_mean_pose
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.minimise import Minimum, minimise
from robot_ik.camera.targets import Observation
from robot_ik.config import Position, SchemaVersion, Table, Wxyz, read_table
from robot_ik.errors import CalibrationError, CameraError, ConfigError
from robot_ik.files import plain, toml_value, write_atomically
from robot_ik.geometry import Pose
from robot_ik.ports import Array

logger = logging.getLogger("robot_ik.camera")

# Weight of the stated standard deviation of a pixel, in measured coordinates.
_PRIOR = 6.0
# Corners of a resting board before a resting camera move less than this between pictures, px: a
# hundred times their noise.
_MAX_MOTION = 2.0
# Median error of the corners beyond which no pose explains them, px.
_MAX_ERROR = 3.0
# Median of the length of a Gaussian pair, standard deviations.
_MEDIAN_LENGTH = 1.1774
# Points nearer than this, or behind the camera, are treated as if they were this far away, metres.
_MIN_DEPTH = 1e-3
# Largest number of fits. The weights of the corners change before each.
_REWEIGHTINGS = 30
# The weights have converged if the camera moves less than this, metres and rad.
_MOVE_TOLERANCE = 1e-8
# Smallest scale of the distances between pictures, px.
_MIN_DISTANCE = 0.01
# Points of the board are compared after rounding to this many decimal places of a metre.
_POINT_DIGITS = 7
_MADE_BY = "such files are made by: robot-ik camera locate, robot-ik camera handeye"


@dataclass(frozen=True, eq=False)
class CameraExtrinsics:
    """Pose of a camera and its origin.

    Attributes:
        pose_parent_camera: OpenCV camera axes (x right, y down, z forward) seen from the parent.
        parent: ``world``, or the robot frame that carries the camera.
        covariance: (6, 6) translation (m) over rotation (rad), along the parent's axes, rotation
            about the camera's origin.
        residual_px: RMS distance of the corners from their projection, px.
        residual_mm: The same at the board, mm. From hand-eye: of each view by all the others.
        date: Day, ISO 8601.
        intrinsics_hash: ``CameraIntrinsics.digest`` of the calibration of the lens.
        method: Method by which it was found.
        views: Number of pictures.
        doubt: Why the pose may be wrong by more than stated; empty if there is no doubt.
    """

    pose_parent_camera: Pose
    parent: str
    covariance: Array
    residual_px: float
    residual_mm: float
    date: str
    intrinsics_hash: str
    method: str = "board"
    views: int = 1
    doubt: str = ""

    def __post_init__(self) -> None:
        covariance = np.array(self.covariance, dtype=float)
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise CalibrationError(f"a covariance is (6, 6) and finite, not {covariance.shape}")
        object.__setattr__(self, "covariance", covariance)

    @property
    def sigma_position(self) -> float:
        """Standard deviation of the distance, m."""
        return float(np.sqrt(max(np.trace(self.covariance[:3, :3]), 0.0)))

    @property
    def sigma_angle(self) -> float:
        """Standard deviation of the angle, rad."""
        return float(np.sqrt(max(np.trace(self.covariance[3:, 3:]), 0.0)))

    def require_parent(self, parent: str) -> None:
        """Check the frame from which the camera is seen.

        Raises:
            CalibrationError: It is another frame.
        """
        if self.parent != parent:
            raise CalibrationError(
                f"the pose of the camera is given in the frame {self.parent!r}, not in {parent!r}",
                hint="use 'world' for a camera beside the arm, and the frame that carries it for a "
                "carried camera",
            )

    def save(self, path: Path | str) -> None:
        """Write the file atomically.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(Path(path), _text(self))

    @classmethod
    def load(cls, path: Path | str, intrinsics: CameraIntrinsics | None = None) -> CameraExtrinsics:
        """Load the file. Log a warning if the file states a doubt.

        Args:
            path: The file.
            intrinsics: Intrinsics that the pose must belong to; None: any.

        Raises:
            CalibrationError: The file is missing, a key is missing or wrong, or it belongs to other
                intrinsics.
        """
        try:
            file = read_table(_ExtrinsicsFile, Path(path), "the pose of the camera", _MADE_BY)
        except ConfigError as error:
            raise CalibrationError(error.args[0], hint=error.hint or _MADE_BY) from error
        extrinsics = CameraExtrinsics(
            Pose(file.position, file.wxyz),
            file.parent,
            np.array(file.covariance),
            file.residual_px,
            file.residual_mm,
            file.date,
            file.intrinsics,
            method=file.method,
            views=file.views,
            doubt=file.doubt,
        )
        if extrinsics.doubt:
            logger.warning("%s: %s", path, extrinsics.doubt)
        if intrinsics is not None and intrinsics.digest != extrinsics.intrinsics_hash:
            raise CalibrationError(
                "these extrinsics were found with another calibration "
                f"({extrinsics.intrinsics_hash}) than the one given ({intrinsics.digest})",
                hint="give that calibration, or find the pose again with robot-ik camera locate or "
                "handeye",
            )
        return extrinsics


def today() -> str:
    """Return the date in UTC, ISO 8601."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def locate_camera(
    views: Sequence[Observation],
    pose_world_board: Pose,
    intrinsics: CameraIntrinsics,
    *,
    parent: str = "world",
) -> CameraExtrinsics:
    """Find the pose of a resting camera from pictures of a resting board.

    The pictures are averaged point by point (median, then Cauchy weights). Then one pose is fitted
    to all points. Averaging removes noise, but not the errors that all pictures share (print,
    lens). The covariance is therefore that of the averaged points and does not shrink with the
    number of pictures.

    Args:
        views: Observations of the board in one or more pictures.
        pose_world_board: Pose of the board in the parent frame.
        intrinsics: Intrinsics of the pictures.
        parent: Name of that frame.

    Raises:
        CameraError: There is no observation, or no pose fits.
        CalibrationError: Board or camera moved between the pictures, or the error is too large.
    """
    if not views:
        raise CameraError("no picture shows the board, so the pose of the camera is unknown")
    start = robust_mean_pose([view.pose for view in views])
    view = _averaged(views, start)
    points = pose_world_board.apply(view.points)
    fit = _fit(points, view, intrinsics, pose_world_board.compose(start.inverse()))
    camera = fit.x

    # Error of each corner, in stated standard deviations.
    residual, _ = _linearise(camera, points, view, intrinsics)
    errors = np.linalg.norm(residual.reshape(-1, 2), axis=1)
    weights = _weights(errors)
    squares = float(weights @ errors**2)
    redundancy = max(2.0 * float(weights.sum()) - 6.0, 0.0)
    inverse = np.linalg.pinv(fit.jacobian.T @ fit.jacobian, hermitian=True)
    covariance = np.asarray((_PRIOR + squares) / (_PRIOR + redundancy) * inverse, dtype=float)
    pixels = view.sigma * float(np.sqrt(squares / max(float(weights.sum()), 1e-9)))
    depths = camera.inverse().apply(points)[:, 2]
    if not (np.isfinite(pixels) and depths.min() > 0.0):
        raise CameraError(
            "no pose of the camera fits the observations of the board",
            hint="check the sizes of the board, and that it is flat and completely in the picture",
        )
    median_error = view.sigma * float(np.median(errors))
    if median_error > _MAX_ERROR:
        raise CalibrationError(
            f"the median reprojection error of the board is {median_error:.1f} px at the best pose "
            f"of the camera; a few tenths are usual, at most {_MAX_ERROR:g} px are allowed",
            hint="check the sizes of the board as printed, its layout, and the calibration",
        )
    focal = 0.5 * (intrinsics.fx + intrinsics.fy)
    millimetres = 1e3 * pixels * float(np.median(depths)) / focal
    return CameraExtrinsics(
        camera,
        parent,
        covariance,
        pixels,
        millimetres,
        today(),
        intrinsics.digest,
        views=len(views),
    )


def _fit(
    points: Array, view: Observation, intrinsics: CameraIntrinsics, start: Pose
) -> Minimum[Pose]:
    """Fit the pose of the camera with Cauchy weights of the corners.

    Args:
        points: (n, 3) points of the board in the parent frame, metres.
        view: Their pixels.
        intrinsics: Intrinsics of the picture.
        start: First pose of the camera.
    """
    weights = np.ones(len(points))
    camera = start
    for _ in range(_REWEIGHTINGS):
        roots = np.repeat(np.sqrt(weights), 2)

        def weighted(pose: Pose, roots: Array = roots) -> tuple[Array, Array]:
            residual, jacobian = _linearise(pose, points, view, intrinsics)
            return roots * residual, roots[:, None] * jacobian

        fit = minimise(weighted, camera, Pose.plus)
        move = float(np.abs(fit.x.minus(camera)).max())
        camera = fit.x
        is_weighted = bool((weights < 1.0).any())
        if is_weighted and move < _MOVE_TOLERANCE:
            break
        residual, _ = _linearise(camera, points, view, intrinsics)
        weights = _weights(np.linalg.norm(residual.reshape(-1, 2), axis=1))
    return fit


def _linearise(
    camera: Pose, points: Array, view: Observation, intrinsics: CameraIntrinsics
) -> tuple[Array, Array]:
    """Return the residual (2 n,) in stated standard deviations and its Jacobian (2 n, 6).

    The unknowns are the step of ``Pose.plus``. ``points`` (n, 3) are in the parent frame.
    """
    in_camera = camera.inverse().apply(points)
    in_camera[:, 2] = np.maximum(in_camera[:, 2], _MIN_DEPTH)
    residual = intrinsics.project(in_camera) - view.pixels
    by_point = intrinsics.point_jacobian(in_camera) @ camera.rotation.T
    cross = np.cross(np.eye(3), (points - camera.position)[:, None])
    jacobian = np.concatenate([-by_point, by_point @ cross], axis=2)
    return residual.ravel() / view.sigma, jacobian.reshape(-1, 6) / view.sigma


def _weights(errors: Array) -> Array:
    """Return Cauchy's weights (n,) of the distances of corners, in stated standard deviations."""
    # Standard deviation of the pixels in units of the stated one.
    scale = max(float(np.median(errors)) / _MEDIAN_LENGTH, 1.0)
    return cauchy_weight(errors / np.sqrt(2.0) / scale)


def _averaged(views: Sequence[Observation], start: Pose) -> Observation:
    """Return one observation whose pixels are robust means of all pictures, point by point."""
    pixels_of: dict[tuple[float, ...], list[Array]] = {}
    for view in views:
        for point, pixel in zip(view.points, view.pixels, strict=True):
            pixels_of.setdefault(tuple(np.round(point, _POINT_DIGITS)), []).append(pixel)
    # A point that is visible in few pictures was probably hidden.
    frequent = [point for point, pixels in pixels_of.items() if 2 * len(pixels) >= len(views)]
    points = frequent if len(frequent) >= 4 else list(pixels_of)
    means = []
    motions = []
    for point in points:
        pixels = np.array(pixels_of[point])
        distances = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
        motion = float(np.median(distances))
        motions.append(motion)
        weights = cauchy_weight(distances / max(motion, _MIN_DISTANCE))
        means.append(np.average(pixels, axis=0, weights=weights))
    # Not checked for two pictures: the residuals of the fit show which of them is wrong.
    if len(views) > 2 and np.median(motions) > _MAX_MOTION:
        raise CalibrationError(
            f"the board's corners move by {np.median(motions):.1f} px between the pictures: a pose "
            "can be found only of a camera and a board that both rest",
            hint="take one picture, or a film in which nothing moves; for a carried camera use "
            "robot-ik camera handeye",
        )
    sigma = float(np.median([view.sigma for view in views]))
    return Observation(np.array(points), np.array(means), start, sigma)


def _text(extrinsics: CameraExtrinsics) -> str:
    names = (
        "covariance",
        "sigma_position",
        "sigma_angle",
        "residual_px",
        "residual_mm",
        "method",
        "views",
        "date",
        "doubt",
    )
    values = {"schema": 1, "parent": extrinsics.parent, **plain(extrinsics.pose_parent_camera)}
    values |= {name: getattr(extrinsics, name) for name in names}
    values["intrinsics"] = extrinsics.intrinsics_hash
    return (
        "# Pose of a camera. Lengths in m, angles in rad, quaternions w x y z; axes are OpenCV's:\n"
        "# x right, y down, z forward. Covariance: translation over rotation, parent's axes,\n"
        "# rotation about the camera's origin.\n"
        + "".join(f"{key} = {toml_value(value)}\n" for key, value in values.items())
    )


_Six = Annotated[tuple[float, float, float, float, float, float], Field(strict=False)]
#: (6, 6) in a file.
Covariance = Annotated[tuple[_Six, _Six, _Six, _Six, _Six, _Six], Field(strict=False)]


class _ExtrinsicsFile(Table):
    version: SchemaVersion = 1
    parent: str
    position: Position
    wxyz: Wxyz
    covariance: Covariance
    # For readers of the file. Computed from the covariance.
    sigma_position: float | None = None
    sigma_angle: float | None = None
    residual_px: float
    residual_mm: float
    date: str
    intrinsics: str
    method: str = ""
    views: int = 1
    doubt: str = ""
