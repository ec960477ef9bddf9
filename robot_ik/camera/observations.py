"""Where a marker or a rigid body with markers is, from corners in one picture.

``marker_branches`` and ``estimate_body`` are what others call.  The least squares are in ``pose_fit``, in
undistorted normalised coordinates with residuals in standard deviations of the corners; those are fitted to
the pixels in ``corner_refinement``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.corner_refinement import RefinedCorners, unrefined
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.pose_fit import (
    BranchChoice,
    Branches,
    CornerData,
    FittedPose,
    fit_pose,
    square_branches,
    with_mirror_image,
)
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array

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
        refined: Whether the marker's print was fitted; else the corners are the detector's.
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
        millimetres = _LARGEST_SIZE < size <= 1000 * _LARGEST_SIZE
        example = f"{size} mm are {size / 1000:g}" if millimetres else "50 mm are 0.05"
        raise CameraError(
            f"a marker size of {size} m cannot be right",
            hint=f"give the side of the black square in metres: {example}",
        )
    h = 0.5 * size
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def marker_branches(seen: RefinedCorners, size: float, intrinsics: CameraIntrinsics) -> Branches | None:
    """Both poses of a marker; None when its corners are no picture of a square.

    Raises:
        CameraError: The size cannot be right.
    """
    points = marker_points(size)
    if not np.isfinite(seen.normalized).all():
        return None
    return square_branches(points, CornerData.of(points, [seen], intrinsics))


def marker_observation(
    id: int, seen: RefinedCorners, branches: Branches, choice: BranchChoice, time: float
) -> MarkerObservation:
    """The observation with the branch of choice."""
    chosen = choice.index
    return MarkerObservation(
        id=id,
        corners=seen.corners,
        pose=branches.poses[chosen],
        alternative=branches.other(chosen),
        reprojection_error=branches.fits[chosen].pixel_error,
        ambiguity=choice.ambiguity,
        covariance=branches.covariances[chosen],
        sigma=seen.sigma,
        refined=seen.refined,
        time=time,
    )


# A marker of a body is left out when its corners miss by more than this many standard deviations (RMS) and
# by more than this many pixels: half hidden, or not where the layout says.
_OUTLIER_SIGMAS, _OUTLIER_PIXELS = 4.0, 0.3
# A marker whose corners miss by more standard deviations than this, and by so much more than the others do,
# counts less, with the square of it.
_DOUBTED, _REWEIGHTINGS = 1.5, 4
_CORNER_NUMBERS = 8
# The corners of several markers are each this much less certain, px: what the model of an edge leaves out
# differs from marker to marker, and a sharp picture must not make it count.
_MODEL_SIGMA = 0.004


@dataclass(frozen=True, eq=False)
class BodyObservation:
    """A rigid body that carries markers, in one picture.

    Attributes:
        pose_camera_body: Its pose.
        covariance: (6, 6) as in ``MarkerObservation``, about the body's origin.
        reprojection_error: RMS over the corners used, px.
        ids: Markers used.
        rejected: Markers seen but left out, because they contradict the others.
        ambiguity: As in ``MarkerObservation``; 0 for markers that do not lie in one plane.
        alternative: The other pose, when the markers used lie in one plane and it fits at all.
        time: When the picture was taken, seconds, monotonic; NaN when unknown.
    """

    pose_camera_body: Pose
    covariance: Array
    reprojection_error: float
    ids: tuple[int, ...]
    rejected: tuple[int, ...] = ()
    ambiguity: float = 0.0
    alternative: Pose | None = None
    time: float = float("nan")


@dataclass(frozen=True, eq=False)
class BodyBranches:
    """The poses that fit the markers ``ids`` of a body; ``rejected`` were seen but left out."""

    branches: Branches
    ids: tuple[int, ...]
    rejected: tuple[int, ...]

    def observation(self, choice: BranchChoice, time: float = float("nan")) -> BodyObservation:
        """The observation with the branch of choice."""
        b, chosen = self.branches, choice.index
        return BodyObservation(
            pose_camera_body=b.poses[chosen],
            covariance=b.covariances[chosen],
            reprojection_error=b.fits[chosen].pixel_error,
            ids=self.ids,
            rejected=self.rejected,
            ambiguity=choice.ambiguity,
            alternative=b.other(chosen),
            time=time,
        )


def estimate_body(
    observed: Mapping[int, ArrayLike | RefinedCorners],
    layout: Mapping[int, tuple[float, Pose]],
    intrinsics: CameraIntrinsics,
) -> BodyObservation | None:
    """Pose of a rigid body from all of its markers together.

    Starts from the single marker that explains the others best, fits all corners, leaves out markers that
    contradict the rest (half hidden, moved, misread) and trusts those less that hardly agree.

    Args:
        observed: Marker id -> refined corners, or (4, 2) distorted pixels as a detector gives them; ids
            outside ``layout`` are ignored.
        layout: Marker id -> (side in metres, ``pose_body_marker``).
        intrinsics: Of this picture's size.

    Returns:
        The pose, or None when no marker of the body gives one.

    Raises:
        CameraError: A size of the layout cannot be right.
    """
    found = body_branches(observed, layout, intrinsics)
    return None if found is None else found.observation(found.branches.alone)


def body_branches(
    observed: Mapping[int, ArrayLike | RefinedCorners],
    layout: Mapping[int, tuple[float, Pose]],
    intrinsics: CameraIntrinsics,
) -> BodyBranches | None:
    """The poses that fit; arguments and errors as in ``estimate_body``."""
    ids, seen, points, starts = [], [], [], []
    for i in sorted(set(observed) & set(layout)):
        size, pose_body_marker = layout[i]
        value = observed[i]
        corners = value if isinstance(value, RefinedCorners) else unrefined(value, intrinsics)
        found = marker_branches(corners, size, intrinsics)
        if found is None:
            continue
        ids.append(i)
        seen.append(replace(corners, covariance=corners.covariance + _MODEL_SIGMA**2 * np.eye(8)))
        points.append(pose_body_marker.apply(marker_points(size)))
        starts += [pose.compose(pose_body_marker.inverse()) for pose in found.poses]
    if not ids:
        return None
    data = CornerData.of(np.concatenate(points), seen, intrinsics)
    chosen, pose = _consensus(data, starts)
    branches = with_mirror_image(_weighted(data, chosen, pose), pose)
    if branches is None:
        return None
    rejected = tuple(i for k, i in enumerate(ids) if k not in chosen)
    return BodyBranches(branches, tuple(ids[k] for k in chosen), rejected)


def _consensus(data: CornerData, starts: list[Pose]) -> tuple[list[int], Pose]:
    """Which markers (numbers of blocks) agree with each other, and the pose that they agree on."""
    # The median marker decides: up to half of them may be wrong.
    fits = [data.fit(pose).pixels for pose in starts]
    best = min(range(len(starts)), key=lambda k: float(np.median(fits[k])))
    # One marker's tilt is loose, so no marker is judged by it yet: the better half makes the first fit.
    order = np.argsort(fits[best], kind="stable")
    used = sorted(int(k) for k in order[: max(1, (len(order) + 1) // 2, min(2, len(order)))])
    pose, _ = fit_pose(data.chosen(used), starts[best])
    for _ in range(4):
        again = _agreeing(data.fit(pose))
        if again == used:
            break
        used = again
        pose, _ = fit_pose(data.chosen(used), pose)
    return used, pose


def _agreeing(fit: FittedPose) -> list[int]:
    """Markers whose corners are where the pose puts them; at least the best one."""
    # Measured against the others too: print and lens are never as good as the picture.
    limit = max(_OUTLIER_PIXELS, 3.0 * float(np.median(fit.pixels)))
    kept = np.flatnonzero((fit.pixels < limit) | (fit.costs < _CORNER_NUMBERS * _OUTLIER_SIGMAS**2))
    return [int(k) for k in kept] or [int(np.argmin(fit.pixels))]


def _weighted(data: CornerData, chosen: list[int], pose: Pose) -> CornerData:
    """The chosen markers, with less weight for those that agree less than the others."""
    if len(chosen) < 3:
        return data.chosen(chosen)
    part = data.chosen(chosen)
    weighted = part
    for _ in range(_REWEIGHTINGS):
        size = np.sqrt(part.fit(pose).costs / _CORNER_NUMBERS)
        limit = _DOUBTED * max(1.0, float(np.median(size)))
        weights = np.minimum(1.0, (limit / np.maximum(size, 1e-12)) ** 2)
        if weights.min() == 1.0:
            break
        weighted = part.chosen(range(len(chosen)), weights)
        pose, _ = fit_pose(weighted, pose)
    return weighted
