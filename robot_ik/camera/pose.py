"""Estimate the pose of a rigid body from points in one picture.

Residuals are differences of undistorted normalised coordinates, in standard deviations of the
points. A flat body may have a second pose that fits nearly as well (Schweighofer and Pinz 2006).
Both are estimated.

Points come in groups: the four corners of a marker, or a single corner of a chessboard. The errors
of a group are correlated, and a group is used or rejected as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from robot_ik.camera.corners import Corners
from robot_ik.camera.image import quiet
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.minimise import Minimum, minimise
from robot_ik.geometry import Pose
from robot_ik.kernels.jit import inlined, kernel
from robot_ik.ports import Array

# Rotation matrix (3, 3) and position (3,).
_Motion = tuple[Array, Array]

# A group is rejected if its error is above this many standard deviations (RMS) ...
_OUTLIER_SIGMAS = 4.0
# ... and by more than this, px, and by more than this factor times the median group.
_OUTLIER_PIXELS = 0.3
_OUTLIER_FACTOR = 3.0
# Largest number of times that the set of accepted groups is determined. It settles after one or
# two.
_CONSENSUS_ROUNDS = 4
# A group whose error is above this factor times that of the median group, in standard deviations,
# loses weight.
_DOUBTFUL_FACTOR = 1.5
_REWEIGHTINGS = 4
# Standard deviation of each corner of a marker beyond its covariance, px: model errors that differ
# from marker to marker.
_MODEL_SIGMA = 0.004
# Two poses that differ by less than this are the same minimum, rad.
_SAME_ANGLE = math.radians(0.5)
# A body is flat if its points leave their plane by less than this part of its size.
_FLATNESS = 1e-3
# Points behind the camera are treated as if they were this far in front of it, metres.
_MIN_DEPTH = 1e-6


@dataclass(frozen=True, eq=False)
class PoseFit:
    """One fitted pose.

    Attributes:
        pose: ``pose_camera_body``.
        covariance: (6, 6) translation (m) over rotation (rad), both along the camera's axes.
        cost: Sum of the squared residuals in standard deviations.
        redundancy: Its expected value for the right pose.
        pixel_errors: (m,) RMS distance of the points of each group, px.
        group_costs: (m,) sum of squares of each group. Its expected value is 2 k.
    """

    pose: Pose
    covariance: Array
    cost: float
    redundancy: float
    pixel_errors: Array
    group_costs: Array


class PoseProblem:
    """m groups of k points of one body.

    Args:
        points: (m, k, 3) in the body's frame, metres.
        normalized: (m, k, 2) undistorted normalised coordinates of the same points.
        covariances: (m, 2 k, 2 k) of the pixels, px^2, order x0 y0 x1 y1 ....
        intrinsics: Intrinsics of the picture.
        weights: (m,) of the squared residuals of each group; None for 1.
    """

    def __init__(
        self,
        points: Array,
        normalized: Array,
        covariances: Array,
        intrinsics: CameraIntrinsics,
        weights: Array | None = None,
    ) -> None:
        self.points = np.ascontiguousarray(points, dtype=float)
        self.normalized = np.ascontiguousarray(normalized, dtype=float)
        self.covariances = covariances
        self.intrinsics = intrinsics
        self.count = len(points)
        self.size = points.shape[1]
        self.to_pixels = np.asarray(intrinsics.pixel_jacobian(normalized.reshape(-1, 2)))
        # Block diagonal derivative of the pixels of a group by its normalised coordinates.
        blocks = np.zeros((self.count, self.size, 2, self.size, 2))
        for k in range(self.size):
            blocks[:, k, :, k, :] = self.to_pixels[k :: self.size]
        numbers = 2 * self.size
        self.whiteners = np.linalg.solve(
            np.linalg.cholesky(covariances), blocks.reshape(self.count, numbers, numbers)
        )
        if weights is not None:
            self.whiteners *= np.sqrt(weights)[:, None, None]

    def part(self, chosen: Sequence[int], weights: Array | None = None) -> PoseProblem:
        """Return the problem of some of the groups."""
        k = list(chosen)
        return PoseProblem(
            self.points[k], self.normalized[k], self.covariances[k], self.intrinsics, weights
        )

    def linearise(self, motion: _Motion) -> tuple[Array, Array]:
        """Return the residual (2 m k,) in standard deviations and its Jacobian (2 m k, 6)."""
        rotation, position = motion
        return linearise_points(self.points, self.normalized, self.whiteners, rotation, position)

    def group_errors(self, motion: _Motion) -> tuple[Array, Array]:
        """Return the RMS distance of the points in px and the sum of squares of each group (m,)."""
        difference = self._differences([motion])[0]
        residual = self.whiteners @ difference.reshape(self.count, -1, 1)
        return self.pixel_errors([motion])[0], (residual[:, :, 0] ** 2).sum(axis=1)

    def pixel_errors(self, motions: Sequence[_Motion]) -> Array:
        """Return the RMS distance of the points of each group (s, m), px, for s poses."""
        differences = self._differences(motions)
        pixels = np.einsum("pij,spj->spi", self.to_pixels, differences)
        squares = (pixels**2).reshape(len(motions), self.count, -1).sum(axis=2)
        return np.asarray(np.sqrt(squares / self.size))

    def _differences(self, motions: Sequence[_Motion]) -> Array:
        """Return projected minus measured normalised coordinates (s, m k, 2) for s poses."""
        rotations = np.array([rotation for rotation, _ in motions])
        positions = np.array([position for _, position in motions])
        points = self.points.reshape(-1, 3)
        camera = points @ rotations.transpose(0, 2, 1) + positions[:, None]
        projected = camera[:, :, :2] / np.maximum(camera[:, :, 2:], _MIN_DEPTH)
        return np.asarray(projected - self.normalized.reshape(-1, 2))

    def fit(self, start: _Motion) -> Minimum[_Motion]:
        """Return the pose of the least squares from ``start``."""
        return minimise(self.linearise, start, _move)


@kernel
def linearise_points(
    points: Array, normalized: Array, whiteners: Array, rotation: Array, position: Array
) -> tuple[Array, Array]:
    """Return the whitened residual (2 m k,) and its Jacobian (2 m k, 6) at a pose.

    Args:
        points: (m, k, 3) in the body's frame, metres.
        normalized: (m, k, 2) measured normalised coordinates.
        whiteners: (m, 2 k, 2 k).
        rotation: (3, 3) from the body to the camera.
        position: (3,) of the body in the camera's frame, metres.
    """
    groups, size, _ = points.shape
    coordinates = 2 * size
    difference = np.empty(coordinates)
    point_jacobian = np.empty((coordinates, 6))
    residual = np.zeros(groups * coordinates)
    jacobian = np.zeros((groups * coordinates, 6))
    for group in range(groups):
        for k in range(size):
            point = points[group, k]
            x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2]
            y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2]
            z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2]
            inverse_depth = 1.0 / max(z + position[2], _MIN_DEPTH)
            u = (x + position[0]) * inverse_depth
            v = (y + position[1]) * inverse_depth
            difference[2 * k] = u - normalized[group, k, 0]
            difference[2 * k + 1] = v - normalized[group, k, 1]
            _write_jacobian_row(
                point_jacobian[2 * k], inverse_depth, 0.0, -u * inverse_depth, x, y, z
            )
            _write_jacobian_row(
                point_jacobian[2 * k + 1], 0.0, inverse_depth, -v * inverse_depth, x, y, z
            )
        for i in range(coordinates):
            row = group * coordinates + i
            for j in range(coordinates):
                whitener = whiteners[group, i, j]
                residual[row] += whitener * difference[j]
                for axis in range(6):
                    jacobian[row, axis] += whitener * point_jacobian[j, axis]
    return residual, jacobian


@inlined
def _write_jacobian_row(
    row: Array, by_x: float, by_y: float, by_z: float, x: float, y: float, z: float
) -> None:
    """Write the derivatives of one coordinate by position and rotation vector to ``row`` (6,).

    d(exp(w) p) / dw = -[p]x with the rotated point p = (x, y, z).
    """
    row[0] = by_x
    row[1] = by_y
    row[2] = by_z
    row[3] = by_z * y - by_y * z
    row[4] = by_x * z - by_z * x
    row[5] = by_y * x - by_x * y


def _move(motion: _Motion, step: Array) -> _Motion:
    rotation, _ = cv2.Rodrigues(step[3:])
    return rotation @ motion[0], motion[1] + step[:3]


def fit_pose(
    points: Array, corners: Sequence[Corners], intrinsics: CameraIntrinsics
) -> tuple[list[PoseFit], list[int]] | None:
    """Fit the pose of a body to the corners of its markers.

    Args:
        points: (m, 4, 3) corners in the body's frame, metres.
        corners: The same corners in the picture, with finite normalised coordinates.
        intrinsics: Intrinsics of the picture.

    Returns:
        One or two poses, the better one first, and the markers used; None if no pose fits. Markers
        that contradict the others are not used: partly hidden, displaced or misread markers.
    """
    normalized = np.array([c.normalized for c in corners])
    covariances = np.array([c.covariance for c in corners]) + _MODEL_SIGMA**2 * np.eye(8)
    starts = []
    for square, square_normalized in zip(points, normalized, strict=True):
        starts += _square_motions(square, square_normalized)
    return _fit(PoseProblem(points, normalized, covariances, intrinsics), starts)


def fit_flat_pose(
    points: Array, pixels: Array, sigma: float, intrinsics: CameraIntrinsics
) -> tuple[list[PoseFit], list[int]] | None:
    """Fit the pose of a flat pattern to its points.

    Args:
        points: (n, 3) in the pattern's frame, metres, z = 0. At least four.
        pixels: (n, 2) distorted pixels of the same points.
        sigma: Standard deviation of the pixels, px.
        intrinsics: Intrinsics of the picture.

    Returns:
        One or two poses, the better one first, and the points used; None if no pose fits.
    """
    normalized = intrinsics.undistort(pixels)
    if not np.isfinite(normalized).all():
        return None
    covariances = np.tile(sigma**2 * np.eye(2), (len(points), 1, 1))
    problem = PoseProblem(points[:, None], normalized[:, None], covariances, intrinsics)
    return _fit(problem, _solve_pnp(points, normalized, cv2.SOLVEPNP_IPPE))


def _fit(problem: PoseProblem, starts: Sequence[_Motion]) -> tuple[list[PoseFit], list[int]] | None:
    """Fit the groups that agree, from the best of some starts."""
    if not starts:
        return None
    used = list(range(problem.count))
    if problem.count > 1:
        used, motion = _consensus(problem, starts)
        problem = _reweighted(problem.part(used), motion)
        points = problem.points.reshape(-1, 3)
        normal = _plane_normal(points)
        starts = [motion] if normal is None else [motion, _mirrored(motion, points, normal)]
    fits = sorted((problem.fit(start) for start in starts), key=lambda fit: fit.cost)
    fits = [fit for fit in fits if math.isfinite(fit.cost) and _is_in_front(problem.points, fit.x)]
    if not fits:
        return None
    if len(fits) > 1 and _angle(fits[0].x, fits[1].x) < _SAME_ANGLE:
        fits = fits[:1]
    return [_pose_fit(problem, fit) for fit in fits[:2]], used


def _pose_fit(problem: PoseProblem, fit: Minimum[_Motion]) -> PoseFit:
    pixel_errors, costs = problem.group_errors(fit.x)
    pose = Pose.from_rotation(*fit.x)
    return PoseFit(pose, fit.covariance, fit.cost, len(fit.residual) - 6.0, pixel_errors, costs)


def _consensus(problem: PoseProblem, starts: Sequence[_Motion]) -> tuple[list[int], _Motion]:
    """Return the groups that agree with each other, and their pose."""
    errors = problem.pixel_errors(starts)
    # The median decides: up to half of the groups may be wrong.
    best = int(np.argmin(np.median(errors, axis=1)))
    # The tilt of a single marker is inaccurate, so no group is rejected yet. The first fit uses the
    # better half of the groups.
    order = np.argsort(errors[best], kind="stable")
    half = max((len(order) + 1) // 2, min(2, len(order)))
    used = sorted(order[:half].tolist())
    motion = problem.part(used).fit(starts[best]).x
    for _ in range(_CONSENSUS_ROUNDS):
        agreeing = _agreeing(problem, motion)
        if agreeing == used:
            break
        used = agreeing
        motion = problem.part(used).fit(motion).x
    return used, motion


def _agreeing(problem: PoseProblem, motion: _Motion) -> list[int]:
    """Return the groups that a pose explains, at least the best one."""
    pixels, costs = problem.group_errors(motion)
    limit = max(_OUTLIER_PIXELS, _OUTLIER_FACTOR * float(np.median(pixels)))
    expected = 2.0 * problem.size
    agree = np.flatnonzero((pixels < limit) | (costs < expected * _OUTLIER_SIGMAS**2))
    return agree.tolist() or [int(np.argmin(pixels))]


def _reweighted(problem: PoseProblem, motion: _Motion) -> PoseProblem:
    """Return the problem with less weight for groups that agree less than the others."""
    if problem.count < 3:
        return problem
    weighted = problem
    for _ in range(_REWEIGHTINGS):
        sigmas = np.sqrt(problem.group_errors(motion)[1] / (2.0 * problem.size))
        limit = _DOUBTFUL_FACTOR * max(1.0, float(np.median(sigmas)))
        weights = np.minimum(1.0, (limit / np.maximum(sigmas, 1e-12)) ** 2)
        if weights.min() == 1.0:
            break
        weighted = problem.part(range(problem.count), weights)
        motion = weighted.fit(motion).x
    return weighted


def _square_motions(points: Array, normalized: Array) -> list[_Motion]:
    """Return both poses of a square (4, 3) anywhere in the body's frame."""
    x_axis = points[1] - points[0]
    y_axis = points[0] - points[3]
    side = np.linalg.norm(x_axis)
    axes = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis) / side]) / side
    center = points.mean(axis=0)
    square = np.ascontiguousarray((points - center) @ axes)
    motions = []
    for rotation, position in _solve_pnp(square, normalized, cv2.SOLVEPNP_IPPE_SQUARE):
        body_rotation = rotation @ axes.T
        motions.append((body_rotation, position - body_rotation @ center))
    return motions


def _solve_pnp(points: Array, normalized: Array, method: int) -> list[_Motion]:
    """Return OpenCV's poses of flat points (n, 3), z = 0, at normalised coordinates (n, 2)."""
    try:
        with quiet():
            count, rotations, translations, _ = cv2.solvePnPGeneric(
                points, normalized.reshape(-1, 1, 2), np.eye(3), None, flags=method
            )
    except cv2.error:
        # The points are degenerate.
        return []
    motions: list[_Motion] = []
    for vector, translation in zip(rotations[:count], translations[:count], strict=True):
        rotation = np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=float))[0], dtype=float)
        position = np.asarray(translation, dtype=float).ravel()
        if np.isfinite(rotation).all() and np.isfinite(position).all() and position[2] > 0.0:
            motions.append((rotation, position))
    return motions


def _is_in_front(points: Array, motion: _Motion) -> bool:
    rotation, position = motion
    return bool((points.reshape(-1, 3) @ rotation[2] + position[2]).min() > 0.0)


def _angle(first: _Motion, second: _Motion) -> float:
    vector, _ = cv2.Rodrigues(first[0].T @ second[0])
    return float(np.linalg.norm(vector))


def _plane_normal(points: Array) -> Array | None:
    """Return the unit normal (3,) of the plane of points (n, 3), or None without a plane."""
    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    return np.asarray(axes[2]) if size[2] < _FLATNESS * size[0] else None


def _mirrored(motion: _Motion, points: Array, normal: Array) -> _Motion:
    """Return the pose with inverted depths of points of a plane: a start for the second pose.

    With the direction v to the centre and the normal m: R' = (2 v v^T - 1) R (2 m m^T - 1).
    """
    rotation, position = motion
    middle = points.mean(axis=0)
    center = rotation @ middle + position
    v = center / np.linalg.norm(center)
    flip_sight = 2.0 * np.outer(v, v) - np.eye(3)
    flip_normal = 2.0 * np.outer(normal, normal) - np.eye(3)
    mirrored = flip_sight @ rotation @ flip_normal
    return mirrored, center - mirrored @ middle
