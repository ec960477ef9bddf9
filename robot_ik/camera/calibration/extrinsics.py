"""Pose of a camera seen from the world or from the robot frame that carries it, and its file.

The file is TOML. It names its frames and units, and the calibration of the lens. With another
calibration the pose is wrong, so the file is refused.
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

from robot_ik.camera.calibration.handeye import (
    HandEyeSample,
    Mount,
    compress,
    corner_residuals,
)
from robot_ik.camera.calibration.least_squares import LinearViews, cauchy_weight, fit_views
from robot_ik.camera.calibration.pose_means import robust_mean_pose
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import Observation
from robot_ik.config import Position, SchemaVersion, Table, Wxyz, read_table
from robot_ik.errors import CalibrationError, CameraError, ConfigError
from robot_ik.files import plain, toml_value, write_atomically
from robot_ik.geometry import Pose
from robot_ik.ports import Array

logger = logging.getLogger("robot_ik.camera")

# The unknowns: the twist of the camera. The board's is not free.
_UNKNOWNS = np.arange(6)
# The stated standard deviation of a pixel weighs as much as this many measured numbers.
_PRIOR = 6.0
# Corners of a resting board before a resting camera move less than this between pictures, px: a
# hundred times their noise.
_MAX_MOTION = 2.0
# Median error of the corners beyond which no pose explains them, px.
_MAX_ERROR = 3.0
# Median of the length of a Gaussian pair, standard deviations.
_MEDIAN_LENGTH = 1.1774
# Smallest scale of the distances between pictures, px.
_MIN_DISTANCE = 0.01
# Digits after the point, metres, with which a point is the same in two pictures.
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
                f"the pose is of a camera seen from {self.parent!r}; wanted is one seen from "
                f"{parent!r}",
                hint="a camera beside the arm is seen from 'world', a carried one from its carrier",
            )

    def save(self, path: Path | str) -> None:
        """Write the file. It is whole or not written.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(Path(path), _text(self))

    @classmethod
    def load(cls, path: Path | str, intrinsics: CameraIntrinsics | None = None) -> CameraExtrinsics:
        """Load the file. Its doubt is logged.

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
                f"({extrinsics.intrinsics_hash}) than "
                f"the one given ({intrinsics.digest})",
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
    to all points. Averaging removes noise, but no error that all pictures share (print, lens). The
    covariance is therefore that of the averaged points and does not shrink with the number of
    pictures.

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
        raise CameraError("the board was seen in no picture, so the camera's pose is not known")
    start = robust_mean_pose([view.pose for view in views])
    view = _averaged(views, start)
    sample = HandEyeSample(Pose(), view)

    def linear(
        mount: Mount, weights: Sequence[Array] | None
    ) -> tuple[LinearViews, Sequence[Array]]:
        views, left = compress(mount, [sample], intrinsics, weights)
        return views, corner_residuals(left, _scale(left[0]))

    mount = Mount(pose_world_board.compose(start.inverse()), pose_world_board, "eye_to_hand")
    mount, normal = fit_views(linear, mount, _UNKNOWNS)
    # Error of each corner, in stated standard deviations.
    left = np.linalg.norm(mount.residual(sample, intrinsics), axis=1) / view.sigma
    weights = cauchy_weight(left / np.sqrt(2.0) / _scale(left))
    squares = float(weights @ left**2)
    redundancy = max(2.0 * float(weights.sum()) - 6.0, 0.0)
    covariance = (_PRIOR + squares) / (_PRIOR + redundancy) * normal.covariance[:6, :6]
    pixels = view.sigma * float(np.sqrt(squares / max(float(weights.sum()), 1e-9)))
    depth = float(np.median(mount.pose_camera_board(sample).apply(view.points)[:, 2]))
    if not (np.isfinite(pixels) and depth > 0.0):
        raise CameraError(
            "no pose of the camera explains what was seen of the board",
            hint="check the sizes of the board and that the whole of it is flat and in the picture",
        )
    far = view.sigma * float(np.median(left))
    if far > _MAX_ERROR:
        raise CalibrationError(
            f"the best pose of the camera leaves the board's corners {far:.1f} px off (median); a "
            "good one "
            f"leaves some tenths, and beyond {_MAX_ERROR:g} px it is wrong",
            hint="check the sizes of the board as printed, its layout, and the calibration",
        )
    millimetres = 1e3 * pixels * depth / (0.5 * (intrinsics.fx + intrinsics.fy))
    return CameraExtrinsics(
        mount.pose_parent_camera,
        parent,
        covariance,
        pixels,
        millimetres,
        today(),
        intrinsics.digest,
        views=len(views),
    )


def _scale(left: Array) -> float:
    """Return the standard deviation of the pixels in units of the stated one, at least 1."""
    return max(float(np.median(left)) / _MEDIAN_LENGTH, 1.0)


def _averaged(views: Sequence[Observation], start: Pose) -> Observation:
    """Return one observation whose pixels are robust means of all pictures, point by point."""
    seen: dict[tuple[float, ...], list[Array]] = {}
    for view in views:
        for point, pixel in zip(view.points, view.pixels, strict=True):
            seen.setdefault(tuple(np.round(point, _POINT_DIGITS)), []).append(pixel)
    # Something hid a point that is visible in few pictures.
    enough = [point for point, pixels in seen.items() if 2 * len(pixels) >= len(views)]
    points = enough if len(enough) >= 4 else list(seen)
    means = []
    motions = []
    for point in points:
        pixels = np.array(seen[point])
        far = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
        motions.append(float(np.median(far)))
        weights = cauchy_weight(far / max(float(np.median(far)), _MIN_DISTANCE))
        means.append(np.average(pixels, axis=0, weights=weights))
    # Of two pictures the residuals show which one is wrong.
    if len(views) > 2 and np.median(motions) > _MAX_MOTION:
        raise CalibrationError(
            f"the board's corners move by {np.median(motions):.1f} px between the pictures: a "
            "pose can be "
            "found only of a camera and a board that both rest",
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
    # For readers of the file; the covariance says the same.
    sigma_position: float | None = None
    sigma_angle: float | None = None
    residual_px: float
    residual_mm: float
    date: str
    intrinsics: str
    method: str = ""
    views: int = 1
    doubt: str = ""
