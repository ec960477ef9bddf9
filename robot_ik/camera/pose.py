"""Pose of a marker, or of a rigid body with several markers, from corners in one picture.

All fitting happens in undistorted normalised coordinates, with residuals weighted by the derivative of the
lens mapping and by the covariance of the corners, so they are in units of standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.corner_fit import CornerData, fit_pose, pose_covariance
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.opencv import square_poses
from robot_ik.camera.refine import RefinedCorners, unrefined
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

# A marker size beyond this is millimetres where metres are wanted.
_LARGEST_SIZE = 2.0
# Two branches closer than this are one: the fit ran from both starts into the same minimum.
_SAME_ANGLE = np.deg2rad(0.5)
# A marker of a body is left out when its corners miss by more than this many standard deviations (RMS) and
# by more than this many pixels: half hidden, or not where the layout says.
_OUTLIER_SIGMAS, _OUTLIER_PIXELS = 4.0, 0.3


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
            so a lucky fit to noise does not look certain.
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


@dataclass(frozen=True, eq=False)
class BodyObservation:
    """A rigid body that carries markers, in one picture.

    Attributes:
        pose_camera_body: Its pose.
        covariance: (6, 6) as in ``MarkerObservation``, about the body's origin.
        reprojection_error: RMS over the corners used, px.
        ids: Markers used.
        rejected: Markers seen but left out, because they contradict the others.
        ambiguity: As in ``MarkerObservation``; 0 for two markers or more.
        alternative: The other pose, when only one marker was used.
    """

    pose_camera_body: Pose
    covariance: Array
    reprojection_error: float
    ids: tuple[int, ...]
    rejected: tuple[int, ...] = ()
    ambiguity: float = 0.0
    alternative: Pose | None = None


def marker_points(size: float) -> Array:
    """Corners (4, 3) of a marker of side ``size`` in its own frame, metres, in the detector's order.

    Raises:
        CameraError: The size is not positive, or suspiciously large.
    """
    if not 0.0 < size <= _LARGEST_SIZE:
        raise CameraError(
            f"a marker size of {size} m cannot be right", hint="give the side of the black square in metres"
        )
    h = 0.5 * size
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def _branches(points: Array, corners: CornerData) -> list[tuple[Pose, float]]:
    """Fitted poses of one square and their costs, best first; one or two, none when degenerate."""
    found: list[tuple[Pose, float]] = []
    for rotation, position in square_poses(points, corners.ideal):
        if position[2] <= 0:
            continue
        pose, cost = fit_pose(corners, Pose.from_rotation(rotation, position))
        if pose.apply(points)[:, 2].min() > 0 and np.isfinite(cost):
            found.append((pose, cost))
    found.sort(key=lambda item: item[1])
    if len(found) == 2 and found[0][0].distance(found[1][0])[1] < _SAME_ANGLE:
        found.pop()
    return found


def _ambiguity(costs: list[float]) -> float:
    """Ratio of the errors of the two branches, each with the expected cost of four corners (8 - 6) added."""
    return float(np.sqrt((costs[0] + 2.0) / (costs[1] + 2.0))) if len(costs) == 2 else 0.0


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
    points = marker_points(size)
    seen = corners if isinstance(corners, RefinedCorners) else unrefined(corners, intrinsics)
    if not np.isfinite(seen.ideal).all():
        return None
    data = CornerData.of(points, seen, intrinsics)
    found = _branches(points, data)
    if not found:
        return None
    pose, cost = found[0]
    other = found[1] if len(found) > 1 else None
    return MarkerObservation(
        id=id,
        corners=seen.corners,
        pose=pose,
        alternative=other[0] if other else None,
        reprojection_error=data.pixel_error(pose),
        ambiguity=_ambiguity([cost for _, cost in found]),
        covariance=pose_covariance(data, pose, cost),
        sigma=seen.sigma,
        refined=seen.refined,
        time=time,
    )


def estimate_body(
    observed: Mapping[int, ArrayLike | RefinedCorners],
    layout: Mapping[int, tuple[float, Pose]],
    intrinsics: CameraIntrinsics,
) -> BodyObservation | None:
    """Pose of a rigid body from all of its markers together.

    Starts from the single marker that explains the others best, fits all corners, and leaves out markers
    that contradict the rest (half hidden, moved, misread).

    Args:
        observed: Marker id -> corners as in ``estimate_marker``; ids outside ``layout`` are ignored.
        layout: Marker id -> (side in metres, ``pose_body_marker``).
        intrinsics: Of this picture's size.

    Returns:
        The pose, or None when no marker of the body gives one.
    """
    parts: dict[int, CornerData] = {}
    starts: list[Pose] = []
    ambiguity: dict[int, float] = {}
    for i in sorted(set(observed) & set(layout)):
        size, pose_body_marker = layout[i]
        value = observed[i]
        seen = value if isinstance(value, RefinedCorners) else unrefined(value, intrinsics)
        if not np.isfinite(seen.ideal).all():
            continue
        points = marker_points(size)
        found = _branches(points, CornerData.of(points, seen, intrinsics))
        if not found:
            continue
        parts[i] = CornerData.of(pose_body_marker.apply(points), seen, intrinsics)
        starts += [pose.compose(pose_body_marker.inverse()) for pose, _ in found]
        ambiguity[i] = _ambiguity([cost for _, cost in found])
    if not parts:
        return None
    return _fit_body(parts, starts, ambiguity)


def _fit_body(
    parts: dict[int, CornerData], starts: list[Pose], ambiguity: dict[int, float]
) -> BodyObservation:
    # The median marker decides: up to half of them may be wrong.
    first = min(starts, key=lambda pose: float(np.median([p.pixel_error(pose) for p in parts.values()])))
    # One marker's tilt is loose, so nobody is judged by it yet: the better half makes the first fit.
    order = sorted(parts, key=lambda i: parts[i].pixel_error(first))
    used = sorted(order[: max(1, (len(order) + 1) // 2, min(2, len(order)))])
    pose, cost = fit_pose(CornerData.joined([parts[i] for i in used]), first)
    for _ in range(4):
        again = _agreeing(parts, pose)
        if again == used:
            break
        used = again
        pose, cost = fit_pose(CornerData.joined([parts[i] for i in used]), pose)
    data = CornerData.joined([parts[i] for i in used])
    single = len(used) == 1
    other = None
    if single:
        others = [p for p in starts if p.distance(pose)[1] > _SAME_ANGLE]
        other = min(others, key=data.cost) if others else None
    return BodyObservation(
        pose_camera_body=pose,
        covariance=pose_covariance(data, pose, cost),
        reprojection_error=data.pixel_error(pose),
        ids=tuple(used),
        rejected=tuple(i for i in parts if i not in used),
        ambiguity=ambiguity[used[0]] if single else 0.0,
        alternative=other,
    )


def _agreeing(parts: dict[int, CornerData], pose: Pose) -> list[int]:
    """Markers whose corners are where ``pose`` puts them; at least the best one."""
    errors = {i: part.pixel_error(pose) for i, part in parts.items()}
    # Measured against the others too: print and lens are never as good as the picture.
    limit = max(_OUTLIER_PIXELS, 3.0 * float(np.median(list(errors.values()))))
    kept = [i for i in parts if errors[i] < limit or parts[i].cost(pose) < 8 * _OUTLIER_SIGMAS**2]
    return kept or [min(errors, key=errors.__getitem__)]
