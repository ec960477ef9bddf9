"""Pose of a single square marker from its corners in one picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.pose.branches import Branches, square_branches
from robot_ik.camera.pose.corner_fit import CornerData
from robot_ik.camera.refine import RefinedCorners, unrefined
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

# A marker size beyond this is millimetres where metres are wanted.
_LARGEST_SIZE = 2.0


@dataclass(frozen=True, eq=False)
class MarkerObservation:
    """One marker in one picture.

    Attributes:
        id: The marker.
        corners: (4, 2) distorted pixels.
        pose: ``pose_camera_marker``: marker x right, y up, z out of the printed face.
        alternative: The other pose that a flat square allows, when there is one.
        reprojection_error: Root mean square distance of the four corners from where ``pose`` puts them, px.
        ambiguity: Error of ``pose`` over error of ``alternative``, 0 to 1: near 1 the two cannot be told
            apart; 0 when there is no alternative.  Both errors include the noise that is expected anyway,
            so a lucky fit to noise does not look certain.  A tracker with a memory counts the errors of
            the last pictures too.
        covariance: (6, 6) of ``pose``: translation (m) over rotation (rad), both along the camera's axes,
            rotation about the marker's origin.
        sigma: Standard deviation of the corners, px.
        refined: Whether the corners were measured on the marker's edges.
        time: When the picture was taken, seconds, monotonic; NaN when unknown.
    """

    id: int
    corners: Array
    pose: Pose
    alternative: Pose | None
    reprojection_error: float
    ambiguity: float
    covariance: Array
    sigma: float
    refined: bool
    time: float = float("nan")


def marker_points(size: float) -> Array:
    """Corners (4, 3) of a marker of side ``size`` in its own frame, metres, in the detector's order.

    Raises:
        CameraError: The size is not positive, or suspiciously large.
    """
    if not 0.0 < size <= _LARGEST_SIZE:
        raise CameraError(
            f"a marker size of {size} m cannot be right",
            hint=f"give the side of the black square in metres: {_in_metres(size)}",
        )
    h = 0.5 * size
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def _in_metres(size: float) -> str:
    return (
        f"{size} mm are {size / 1000:g}" if _LARGEST_SIZE < size <= 1000 * _LARGEST_SIZE else "50 mm are 0.05"
    )


def marker_branches(seen: RefinedCorners, size: float, intrinsics: CameraIntrinsics) -> Branches | None:
    """Both poses of a marker; None when its corners are no picture of a square.

    Raises:
        CameraError: The size cannot be right.
    """
    points = marker_points(size)
    if not np.isfinite(seen.ideal).all():
        return None
    return square_branches(points, CornerData.of(points, seen, intrinsics))


def marker_observation(
    id: int,
    seen: RefinedCorners,
    branches: Branches,
    time: float,
    chosen: int = 0,
    ambiguity: float | None = None,
) -> MarkerObservation:
    """The observation with the branch ``chosen``; ``ambiguity`` None: what this picture alone says."""
    return MarkerObservation(
        id=id,
        corners=seen.corners,
        pose=branches.poses[chosen],
        alternative=branches.other(chosen),
        reprojection_error=branches.pixel_error(chosen),
        ambiguity=branches.ambiguity if ambiguity is None else ambiguity,
        covariance=branches.covariances[chosen],
        sigma=seen.sigma,
        refined=seen.refined,
        time=time,
    )


def estimate_marker(
    corners: ArrayLike | RefinedCorners,
    size: float,
    intrinsics: CameraIntrinsics,
    *,
    id: int = -1,
    time: float = float("nan"),
) -> MarkerObservation | None:
    """Pose of a single square marker.

    Args:
        corners: Refined corners, or (4, 2) distorted pixels as a detector gives them.
        size: Side of the black square, metres.
        intrinsics: Of this picture's size.
        id: Copied into the result.
        time: Copied into the result.

    Returns:
        Both branches of the pose, or None when the four corners are no picture of a square.

    Raises:
        CameraError: The size cannot be right.
    """
    seen = corners if isinstance(corners, RefinedCorners) else unrefined(corners, intrinsics)
    branches = marker_branches(seen, size, intrinsics)
    return None if branches is None else marker_observation(id, seen, branches, time)
