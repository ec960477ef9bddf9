"""The poses that fit a flat marker or board in one picture: one, or two that are hard to tell apart.

Seen small or from the front, a flat thing and its mirror image behind the plane of the picture look alike
(Schweighofer and Pinz 2006).  Both are fitted; the ratio of their errors says how alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.opencv import square_poses
from robot_ik.camera.pose.corner_fit import CornerData, Fit, covariance_of, fit_starts
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

# Two branches closer than this are one: the fit ran from both starts into the same minimum.
SAME_ANGLE = np.deg2rad(0.5)
# A body is flat when its corners leave their plane by less than this part of its size.
_FLAT = 1e-3


@dataclass(frozen=True, eq=False)
class Branches:
    """Fitted poses, best first, one or two.

    Attributes:
        data: What they were fitted to.
        poses: ``pose_camera_body`` each.
        costs: Sum of squares of each in standard deviations; ``expected`` for a good one.
    """

    data: CornerData
    poses: tuple[Pose, ...]
    costs: tuple[float, ...]

    @property
    def expected(self) -> float:
        """Cost of a right pose on average: degrees of freedom left, 2 for the four corners of a marker."""
        return float(2 * len(self.data.points) - 6)

    @property
    def ambiguity(self) -> float:
        """Ratio of the errors of the two poses, the expected cost added to each; 0 when there is only one."""
        if len(self.costs) < 2:
            return 0.0
        return float(np.sqrt((self.costs[0] + self.expected) / (self.costs[1] + self.expected)))

    @cached_property
    def fits(self) -> tuple[Fit, ...]:
        """How well each pose fits."""
        return tuple(self.data.fit(pose) for pose in self.poses)

    def pixel_error(self, chosen: int = 0) -> float:
        """RMS distance of the corners, px."""
        return float(np.sqrt(np.mean(self.fits[chosen].pixels ** 2)))

    @cached_property
    def covariances(self) -> tuple[Array, ...]:
        """(6, 6) of each pose."""
        return tuple(covariance_of(f.jacobian, cost) for f, cost in zip(self.fits, self.costs, strict=True))

    def other(self, chosen: int = 0) -> Pose | None:
        """The pose that was not chosen."""
        return self.poses[1 - chosen] if len(self.poses) > 1 else None


def fitted(data: CornerData, starts: Sequence[Pose]) -> Branches | None:
    """Fits from each start and keeps what differs, in front of the camera; None when nothing fits."""
    found = [
        (cost, pose) for pose, cost in fit_starts(data, starts) if pose.apply(data.points)[:, 2].min() > 0
    ]
    found.sort(key=lambda item: item[0])
    kept = found[:1]
    kept += [f for f in found[1:] if f[1].distance(kept[0][1])[1] >= SAME_ANGLE][:1]
    if not kept:
        return None
    return Branches(data, tuple(pose for _, pose in kept), tuple(cost for cost, _ in kept))


def square_branches(points: Array, data: CornerData) -> Branches | None:
    """Both poses of one square; ``points`` (4, 3) in the square's own frame, which is that of the result."""
    starts = [Pose.from_rotation(r, p) for r, p in square_poses(points, data.ideal) if p[2] > 0]
    return fitted(data, starts)


def with_mirror_image(data: CornerData, pose: Pose) -> Branches | None:
    """The branches of a body near ``pose``: with the mirrored one where its points lie in a plane."""
    normal = flat_normal(data.points)
    return fitted(data, [pose] if normal is None else [pose, mirrored(pose, data.points, normal)])


def flat_normal(points: Array) -> Array | None:
    """Unit normal (3,) of the plane of points (n, 3), None when they do not lie in one."""
    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    return np.asarray(axes[2]) if size[2] < _FLAT * size[0] else None


def mirrored(pose: Pose, points: Array, normal: Array) -> Pose:
    """The pose whose points (n, 3) of one plane have their depths turned round: the other branch, nearly.

    With v the way to the points' centre and m the normal: R' = (2 v vᵀ - 1) R (2 m mᵀ - 1) turns every R p
    of the plane into R p - 2 v (v . R p).
    """
    middle = points.mean(axis=0)
    centre = pose.apply(middle)
    v = centre / np.linalg.norm(centre)
    rotation = (2 * np.outer(v, v) - np.eye(3)) @ pose.rotation @ (2 * np.outer(normal, normal) - np.eye(3))
    return Pose.from_rotation(rotation, centre - rotation @ middle)
