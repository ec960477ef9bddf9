"""Where a camera is: seen from the world or from the robot frame that carries it, with what is known of it.

The file is TOML.  It names its frames and units, and the calibration it was made with: with another one the
numbers mean nothing, so it is refused.
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

_CAMERA = np.arange(6)
# The stated standard deviation of a pixel weighs as much as so many measured ones.
_PRIOR = 6.0
# Corners of a board at rest before a camera at rest stay within this from picture to picture, and are met
# within that by a pose of it, px: a hundred times what they are measured to.
_RESTLESS_PX, _ABSURD_PX = 2.0, 3.0


@dataclass(frozen=True, eq=False)
class CameraExtrinsics:
    """A camera's pose and how it was found.

    Attributes:
        pose_parent_camera: OpenCV camera axes (x right, y down, z forward) seen from the parent.
        parent: ``world``, or the robot frame that carries the camera.
        covariance: (6, 6) translation (m) over rotation (rad), along the parent's axes, rotation about the
            camera's origin.
        residual_px: RMS distance of the corners from where this pose puts them, px.
        residual_mm: The same at the board, millimetres; from hand-eye: of each view by all the others.
        date: Day, ISO 8601.
        intrinsics_hash: ``CameraIntrinsics.digest`` of the calibration it was found with.
        method: How it was found.
        views: Pictures used.
        doubt: Why the pose may be wrong by more than is stated; empty: nothing speaks against it.
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
        """Standard deviation of the whole distance, m."""
        return float(np.sqrt(max(np.trace(self.covariance[:3, :3]), 0.0)))

    @property
    def sigma_angle(self) -> float:
        """Standard deviation of the whole angle, rad."""
        return float(np.sqrt(max(np.trace(self.covariance[3:, 3:]), 0.0)))

    def require_parent(self, parent: str) -> None:
        """Checks whose camera this is.

        Raises:
            CalibrationError: Another frame carries it.
        """
        if self.parent != parent:
            raise CalibrationError(
                f"the pose is of a camera seen from {self.parent!r}; wanted is one seen from {parent!r}",
                hint="a camera beside the arm is seen from 'world', a carried one from what carries it",
            )

    def save(self, path: Path | str) -> None:
        """Writes the file, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(Path(path), _text(self))

    @classmethod
    def load(cls, path: Path | str, intrinsics: CameraIntrinsics | None = None) -> CameraExtrinsics:
        """Reads the file; with ``intrinsics``, only if it was found with them.  Its doubt is logged.

        Raises:
            CalibrationError: Missing, no such file, a key is missing or wrong, or other intrinsics.
        """
        made_by = "such files are made by: robot-ik camera locate, robot-ik camera handeye"
        try:
            file = read_table(_ExtrinsicsFile, Path(path), "the pose of the camera", made_by)
        except ConfigError as error:
            raise CalibrationError(error.args[0], hint=error.hint or made_by) from error
        extrinsics = CameraExtrinsics(
            Pose(file.position, file.wxyz), file.parent, np.array(file.covariance), file.residual_px,
            file.residual_mm, file.date, file.intrinsics, method=file.method, views=file.views,
            doubt=file.doubt,
        )  # fmt: skip
        if extrinsics.doubt:
            logger.warning("%s: %s", path, extrinsics.doubt)
        if intrinsics is not None and intrinsics.digest != extrinsics.intrinsics_hash:
            raise CalibrationError(
                f"these extrinsics were found with another calibration ({extrinsics.intrinsics_hash}) than "
                f"the one given ({intrinsics.digest})",
                hint="give that calibration, or find the pose again: robot-ik camera locate or handeye",
            )
        return extrinsics


def today() -> str:
    """The date in UTC, ISO 8601."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def locate_camera(
    views: Sequence[Observation],
    pose_world_board: Pose,
    intrinsics: CameraIntrinsics,
    *,
    parent: str = "world",
) -> CameraExtrinsics:
    """Where a camera stands that sees a board at a known place; camera and board rest.

    The frames are averaged point by point (median, then Cauchy weights), then one pose is fitted to all
    points.  Averaging takes away noise, not what is wrong in each frame alike (print, lens), so the
    covariance is of the residuals of the averaged points: it does not shrink with the number of frames.

    Args:
        views: Of one or more frames.
        pose_world_board: Where the board is in the parent frame.
        intrinsics: Of the frames' size.
        parent: Name of that frame.

    Raises:
        CameraError: No view, or a fit that leads nowhere.
        CalibrationError: Board or camera moved between the pictures, or no pose meets the corners.
    """
    if not views:
        raise CameraError("the board was seen in no picture, so the camera's pose is not known")
    start = robust_mean_pose([view.pose for view in views])
    view = _averaged(views, start)
    sample = HandEyeSample(Pose(), view)

    def linear(mount: Mount, weights: Sequence[Array] | None) -> tuple[LinearViews, Sequence[Array]]:
        views, left = compress(mount, [sample], intrinsics, weights)
        return views, corner_residuals(left, _scale(left[0]))

    mount = Mount(pose_world_board.compose(start.inverse()), pose_world_board, "eye_to_hand")
    mount, normal = fit_views(linear, mount, _CAMERA)
    # How far off each corner is, in standard deviations as stated.
    left = np.linalg.norm(mount.residual(sample, intrinsics), axis=1) / view.sigma
    weights = cauchy_weight(left / np.sqrt(2.0) / _scale(left))
    squares, dof = float(weights @ left**2), max(2.0 * float(weights.sum()) - 6.0, 0.0)
    covariance = (_PRIOR + squares) / (_PRIOR + dof) * normal.covariance[:6, :6]
    pixels = view.sigma * float(np.sqrt(squares / max(float(weights.sum()), 1e-9)))
    depth = float(np.median(mount.pose_camera_board(sample).apply(view.points)[:, 2]))
    if not (np.isfinite(pixels) and depth > 0.0):
        raise CameraError(
            "no pose of the camera explains what was seen of the board",
            hint="check the sizes of the board and that the whole of it is flat and in the picture",
        )
    far = view.sigma * float(np.median(left))
    if far > _ABSURD_PX:
        raise CalibrationError(
            f"the best pose of the camera leaves the board's corners {far:.1f} px off (median); a good one "
            f"leaves some tenths, and beyond {_ABSURD_PX:g} px it is none",
            hint="check the sizes of the board as printed, its layout, and the camera's calibration",
        )
    millimetres = 1e3 * pixels * depth / (0.5 * (intrinsics.fx + intrinsics.fy))
    return CameraExtrinsics(
        mount.pose_parent_camera, parent, covariance, pixels, millimetres, today(), intrinsics.digest,
        views=len(views),
    )  # fmt: skip


def _scale(left: Array) -> float:
    """Standard deviation of the pixels in units of the stated one, which is the least that is believed."""
    return max(float(np.median(left)) / 1.1774, 1.0)


def _averaged(views: Sequence[Observation], start: Pose) -> Observation:
    """One view whose pixels are robust means of all frames, point by point."""
    seen: dict[tuple[float, ...], list[Array]] = {}
    for view in views:
        for point, pixel in zip(view.points, view.pixels, strict=True):
            seen.setdefault(tuple(np.round(point, 7)), []).append(pixel)
    # A point that is seen in few frames only is where something passed by.
    enough = [point for point, pixels in seen.items() if 2 * len(pixels) >= len(views)]
    points = enough if len(enough) >= 4 else list(seen)
    means, restless = [], []
    for point in points:
        pixels = np.array(seen[point])
        far = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
        restless.append(float(np.median(far)))
        weights = cauchy_weight(far / max(float(np.median(far)), 0.01))
        means.append(np.average(pixels, axis=0, weights=weights))
    # Of two pictures it is unknown which one is wrong: their residuals say so.
    if len(views) > 2 and np.median(restless) > _RESTLESS_PX:
        raise CalibrationError(
            f"the board's corners move by {np.median(restless):.1f} px between the pictures: a pose can be "
            "found only of a camera and a board that both rest",
            hint="take one picture, or a film in which nothing moves; for a carried camera there is "
            "robot-ik camera handeye",
        )
    sigma = float(np.median([view.sigma for view in views]))
    return Observation(np.array(points), np.array(means), start, sigma)


# --------------------------------------------------------------------------------------- file


def _text(extrinsics: CameraExtrinsics) -> str:
    names = (
        "covariance", "sigma_position", "sigma_angle", "residual_px", "residual_mm", "method", "views",
        "date", "doubt",
    )  # fmt: skip
    values = {"schema": 1, "parent": extrinsics.parent, **plain(extrinsics.pose_parent_camera)}
    values |= {name: getattr(extrinsics, name) for name in names}
    values["intrinsics"] = extrinsics.intrinsics_hash
    return (
        "# Where a camera is.  Lengths in m, angles in rad, quaternions w x y z; camera axes are OpenCV's:\n"
        "# x right, y down, z forward.  Covariance: translation over rotation, along the parent's axes,\n"
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
    sigma_position: float | None = None  # what the covariance says, for people
    sigma_angle: float | None = None
    residual_px: float
    residual_mm: float
    date: str
    intrinsics: str
    method: str = ""
    views: int = 1
    doubt: str = ""
