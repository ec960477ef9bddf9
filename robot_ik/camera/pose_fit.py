"""Least-squares pose of known points seen in one picture.

Residuals are differences of undistorted normalised coordinates, weighted by the derivative of the lens
mapping and by the covariance of the corners: they are in units of standard deviations.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robot_ik.camera.corner_refinement import RefinedCorners
from robot_ik.camera.image import square_poses
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import FX, FY, distort_point, lens_vector
from robot_ik.geometry import Pose
from robot_ik.kernels.jit import announce, kernel, outlined
from robot_ik.kernels.linalg import eliminate, normal_equations
from robot_ik.ports import Array

# ------------------------------------------------------------------------------------------
# Least-squares pose of known points seen in one picture, compiled: Levenberg-Marquardt (Nielsen's damping).
#
# Residuals are differences of undistorted normalised coordinates, turned into standard deviations by one
# matrix ("block") for each group of corners whose errors are correlated: the four of a marker.


_TRIALS = 31
# Relative gain below which the fit is finished.
_DONE = 1e-10
# Behind the camera there is no picture: a large residual turns the fit back.
_LEAST_DEPTH = 1e-6
_DOF = 6


@kernel
def whiten(normalized, covariance, lens, blocks, to_pixels):
    """Fills the blocks (m, 8, 8) of m markers, and ``to_pixels`` (4 m, 2, 2): pixels by normalized ones.

    A block is L^-1 times the derivative of the lens mapping, with L Lᵀ = ``covariance`` (m, 8, 8) in px^2.
    """
    lower = np.empty((8, 8))
    for m in range(len(blocks)):
        for i in range(8):
            for j in range(i + 1):
                total = covariance[m, i, j]
                for k in range(j):
                    total -= lower[i, k] * lower[j, k]
                lower[i, j] = total / lower[j, j] if i > j else math.sqrt(total)
        block = blocks[m]
        for k in range(4):
            _, _, xx, xy, yy = distort_point(lens, normalized[4 * m + k, 0], normalized[4 * m + k, 1])
            slope = to_pixels[4 * m + k]
            slope[0, 0], slope[0, 1] = lens[FX] * xx, lens[FX] * xy
            slope[1, 0], slope[1, 1] = lens[FY] * xy, lens[FY] * yy
            for column in range(2 * k, 2 * k + 2):
                for i in range(8):
                    total = slope[i - 2 * k, column - 2 * k] if 2 * k <= i < 2 * k + 2 else 0.0
                    for j in range(i):
                        total -= lower[i, j] * block[j, column]
                    block[i, column] = total / lower[i, i]


@kernel
def fit_poses(
    points, normalized, to_pixels, blocks, trials, work, poses, residuals, jacobians, pixels, costs
):
    """Fits from several starts; how well each result fits.

    Args:
        points: (n, 3) in the body's frame, metres.
        normalized: (n, 2) where they were seen.
        to_pixels: (n, 2, 2) pixels by normalized coordinates.
        blocks: (m, b, b) with m b = 2 n.
        trials: At most so many poses are tried from each start, itself among them; 0: it is the result.
        work: (2n + 16, 7) work space.
        poses: (k, 7) position and quaternion wxyz: starts in, results out.
        residuals: (k, 2n) out, standard deviations.
        jacobians: (k, 2n, 6) out: their derivatives by translation and rotation along the camera's axes.
        pixels: (k, m) out: RMS distance in px of each block's corners.
        costs: (k, m) out: sum of squares of each block.
    """
    slope, normal, damped, step, trial = work[16:], work[:7], work[7:14], work[14, :_DOF], work[15]
    size, rows = blocks.shape[1], 2 * len(points)
    for k in range(len(poses)):
        pose, residual, jacobian = poses[k], residuals[k], jacobians[k]
        cost, damping, growth = math.inf, 1e-3, 2.0
        for i in range(7):
            trial[i] = pose[i]
        for i in range(_DOF):
            step[i] = 0.0
        for _ in range(trials):
            trial_cost = whitened(points, normalized, blocks, trial, slope, residual, jacobian)
            if trial_cost < cost:
                done = cost - trial_cost < _DONE * (1.0 + trial_cost)
                for i in range(7):
                    pose[i] = trial[i]
                cost, damping, growth = trial_cost, max(0.1 * damping, 1e-9), 2.0
                normal_equations(jacobian, residual, normal, normal[_DOF])
            else:
                damping, growth = damping * growth, 2.0 * growth
                largest = 0.0
                for i in range(_DOF):
                    largest = max(largest, abs(step[i]))
                done = damping > 1e8 or not largest >= 1e-13
            if done or not lm_step(normal, damping, damped, step):
                break
            moved(pose, step, trial)
        whitened(points, normalized, blocks, pose, slope, residual, jacobian)
        for m in range(len(blocks)):
            pixels[k, m], costs[k, m] = 0.0, 0.0
        for i in range(0, rows, 2):
            p, m = i // 2, i // size
            dx = to_pixels[p, 0, 0] * slope[i, _DOF] + to_pixels[p, 0, 1] * slope[i + 1, _DOF]
            dy = to_pixels[p, 1, 0] * slope[i, _DOF] + to_pixels[p, 1, 1] * slope[i + 1, _DOF]
            pixels[k, m] += 2.0 * (dx * dx + dy * dy) / size
            costs[k, m] += residual[i] * residual[i] + residual[i + 1] * residual[i + 1]
        for m in range(len(blocks)):
            pixels[k, m] = math.sqrt(pixels[k, m])


@outlined
def whitened(points, normalized, blocks, pose, slope, residual, jacobian):
    """Residuals (2n,) and derivatives (2n, 6) in standard deviations; the sum of squares.

    As they are, (2n, 7), they are in ``slope``: residuals in its last column.
    """
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    for p in range(len(points)):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        tx = (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y - w * z) * b + 2.0 * (x * z + w * y) * c
        ty = 2.0 * (x * y + w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z - w * x) * c
        tz = 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c
        depth = max(tz + pose[2], _LEAST_DEPTH)
        u, v, inverse = (tx + pose[0]) / depth, (ty + pose[1]) / depth, 1.0 / depth
        r, s = slope[2 * p], slope[2 * p + 1]
        r[_DOF], s[_DOF] = u - normalized[p, 0], v - normalized[p, 1]
        # d(exp(w) r) / dw = -[r]x
        r[0], r[1], r[2] = inverse, 0.0, -u * inverse
        r[3], r[4], r[5] = -u * ty * inverse, (tz + u * tx) * inverse, -ty * inverse
        s[0], s[1], s[2] = 0.0, inverse, -v * inverse
        s[3], s[4], s[5] = -(tz + v * ty) * inverse, v * tx * inverse, tx * inverse
    size, cost = blocks.shape[1], 0.0
    for m in range(len(blocks)):
        for i in range(size):
            row = m * size + i
            residual[row] = 0.0
            for k in range(_DOF):
                jacobian[row, k] = 0.0
            for j in range(size):
                value = blocks[m, i, j]
                residual[row] += value * slope[m * size + j, _DOF]
                for k in range(_DOF):
                    jacobian[row, k] += value * slope[m * size + j, k]
            cost += residual[row] * residual[row]
    return cost


@outlined
def lm_step(normal, damping, damped, step):
    """The damped step; False when the system is singular."""
    n = len(step)
    for i in range(n):
        for j in range(i + 1):
            damped[i, j] = normal[i, j]
        damped[i, i] += damping * (normal[i, i] + 1e-12)
        step[i] = -normal[n, i]
    return eliminate(damped, step, n)


@outlined
def moved(pose, step, result):
    """``result`` (7,): the pose after a translation and a rotation along the camera's axes."""
    angle = math.sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    scale = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    a, b, c, d = math.cos(0.5 * angle), scale * step[3], scale * step[4], scale * step[5]
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    for i in range(3):
        result[i] = pose[i] + step[i]
    result[3] = a * w - b * x - c * y - d * z
    result[4] = a * x + b * w + c * z - d * y
    result[5] = a * y - b * z + c * w + d * x
    result[6] = a * z + b * y - c * x + d * w
    size = math.sqrt(result[3] ** 2 + result[4] ** 2 + result[5] ** 2 + result[6] ** 2)
    for i in range(3, 7):
        result[i] /= size


@dataclass(frozen=True, eq=False)
class FittedPose:
    """How well a pose fits.

    Attributes:
        residual: (2n,) in standard deviations.
        jacobian: (2n, 6) of the residual by translation and rotation along the camera's axes.
        pixels: (m,) RMS distance of each block's corners, px.
        costs: (m,) sum of squares of each block; a good marker has about 8.
    """

    residual: Array
    jacobian: Array
    pixels: Array
    costs: Array

    @property
    def cost(self) -> float:
        """Sum of squares in standard deviations."""
        return float(self.costs.sum())

    @property
    def pixel_error(self) -> float:
        """RMS distance of all corners, px."""
        return math.sqrt(float(self.pixels @ self.pixels) / len(self.pixels))


@dataclass(frozen=True, eq=False)
class CornerData:
    """Corners with what a fit needs to know of them.

    Attributes:
        points: (n, 3) in the body's frame, metres.
        normalized: (n, 2) where they were seen, undistorted normalised coordinates.
        blocks: (m, b, b) with m b = 2n: maps from normalized differences to standard deviations,
            one for each group of corners with errors of their own (a marker: b = 8).
        to_pixels: (n, 2, 2) map from differences of normalized coordinates to pixels.
    """

    points: Array
    normalized: Array
    blocks: Array
    to_pixels: Array

    @classmethod
    def of(cls, points: Array, seen: Sequence[RefinedCorners], intrinsics: CameraIntrinsics) -> CornerData:
        """The markers of one body; ``points`` (4 m, 3) in its frame."""
        announce(fit_poses, "the pose of markers")
        normalized = np.concatenate([s.normalized for s in seen])
        blocks, to_pixels = np.zeros((len(seen), 8, 8)), np.empty((len(normalized), 2, 2))
        covariance = np.array([s.covariance for s in seen])
        whiten(normalized, covariance, lens_vector(intrinsics), blocks, to_pixels)
        return cls(np.ascontiguousarray(points, dtype=float), normalized, blocks, to_pixels)

    def chosen(self, markers: Sequence[int] | Array, weights: Array | None = None) -> CornerData:
        """Some of the markers (numbers of blocks); ``weights`` (m,) of their squared residuals."""
        part = np.asarray(markers, dtype=int)
        blocks = self.blocks[part]
        if weights is not None:
            blocks = blocks * np.sqrt(weights)[:, None, None]
        of_points = [
            a.reshape(len(self.blocks), -1, *a.shape[1:])
            for a in (self.points, self.normalized, self.to_pixels)
        ]
        points, normalized, to_pixels = (a[part].reshape(-1, *a.shape[2:]) for a in of_points)
        return CornerData(points, normalized, blocks, to_pixels)

    def fit(self, pose: Pose) -> FittedPose:
        """How well ``pose`` fits."""
        return self.fit_from(pose_row(pose)[None], 0)[1][0]

    def fit_from(self, starts: Array, trials: int = _TRIALS) -> tuple[Array, list[FittedPose]]:
        """Levenberg-Marquardt from each start (k, 7): poses (k, 7) and how they fit, NaN where it failed.

        Args:
            starts: Rows of ``pose_row``.
            trials: Poses tried from each at most; 0: the starts are only judged.
        """
        poses, k, (m, b, _) = starts.copy(), len(starts), self.blocks.shape
        results = np.empty((k, m * b)), np.empty((k, m * b, _DOF)), np.empty((k, m)), np.empty((k, m))
        work = np.empty((m * b + 16, 7))
        fit_poses(self.points, self.normalized, self.to_pixels, self.blocks, trials, work, poses, *results)
        return poses, [FittedPose(*arrays) for arrays in zip(*results, strict=True)]


def pose_row(pose: Pose) -> Array:
    """(7,) position and quaternion wxyz, as compiled code wants them."""
    return np.concatenate([pose.position, pose.wxyz])


def fit_pose(corners: CornerData, start: Pose) -> tuple[Pose, float]:
    """Levenberg-Marquardt from ``start``: pose and cost; the start with infinite cost when there is none."""
    (row,), (fit,) = corners.fit_from(pose_row(start)[None])
    if not (np.isfinite(fit.cost) and np.isfinite(row).all()):
        return start, float("inf")
    return Pose(row[:3], row[3:]), fit.cost


def covariance_of(jacobian: Array, cost: float) -> Array:
    """(6, 6): (J^T J)^-1 of a Jacobian (n, 6), widened when ``cost`` is more than its degrees of freedom."""
    normal = jacobian.T @ jacobian
    dof = len(jacobian) - 6
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(normal)
    return np.asarray(inverse * max(1.0, cost / dof))


# ------------------------------------------------------------------------------------------
# The poses that fit a flat marker or board in one picture: one, or two that are hard to tell apart.
#
# Seen small or from the front, a flat object and its mirror image behind the plane of the picture look alike
# (Schweighofer and Pinz 2006).  Both are fitted; the ratio of their errors says how alike.


# Two branches closer than this are one: the fit ran from both starts into the same minimum.
SAME_ANGLE = np.deg2rad(0.5)
# A body is flat when its corners leave their plane by less than this part of its size.
_FLAT = 1e-3


@dataclass(frozen=True)
class BranchChoice:
    """Which branch to believe in, and its ambiguity as in ``MarkerObservation``."""

    index: int
    ambiguity: float


@dataclass(frozen=True, eq=False)
class Branches:
    """Fitted poses, best first, one or two.

    Attributes:
        poses: ``pose_camera_body`` each.
        fits: How well each fits; one of cost ``expected`` is good.
    """

    poses: tuple[Pose, ...]
    fits: tuple[FittedPose, ...]

    @cached_property
    def costs(self) -> tuple[float, ...]:
        """Sum of squares of each in standard deviations."""
        return tuple(fit.cost for fit in self.fits)

    @property
    def expected(self) -> float:
        """Cost of a right pose on average: degrees of freedom left, 2 for the four corners of a marker."""
        return float(len(self.fits[0].residual) - _DOF)

    @property
    def ambiguity(self) -> float:
        """Ratio of the errors of the two poses, the expected cost added to each; 0 when there is only one."""
        if len(self.costs) < 2:
            return 0.0
        return float(np.sqrt((self.costs[0] + self.expected) / (self.costs[1] + self.expected)))

    @property
    def alone(self) -> BranchChoice:
        """What this picture alone says."""
        return BranchChoice(0, self.ambiguity)

    @cached_property
    def covariances(self) -> tuple[Array, ...]:
        """(6, 6) of each pose."""
        return tuple(covariance_of(fit.jacobian, fit.cost) for fit in self.fits)

    def other(self, chosen: int) -> Pose | None:
        """The pose that was not chosen."""
        return self.poses[1 - chosen] if len(self.poses) > 1 else None


def fitted(data: CornerData, starts: Array) -> Branches | None:
    """Fits from each start (k, 7) and keeps what differs, in front of the camera; None when nothing fits."""
    rows, fits = data.fit_from(starts)
    costs = [fit.cost for fit in fits]
    found = sorted((cost, k) for k, cost in enumerate(costs) if _in_front(data.points, rows[k], cost))
    if not found:
        return None
    kept = found[:1]
    kept += [f for f in found[1:] if _angle(rows[f[1]], rows[found[0][1]]) >= SAME_ANGLE][:1]
    return Branches(tuple(Pose(rows[k, :3], rows[k, 3:]) for _, k in kept), tuple(fits[k] for _, k in kept))


def _in_front(points: Array, row: Array, cost: float) -> bool:
    """Whether a fit came to an end with all points before the camera."""
    if not math.isfinite(cost):
        return False
    _, _, z, qw, qx, qy, qz = row.tolist()
    depth = points @ (2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy))
    return bool(depth.min() + z > 0)


def _angle(one: Array, other: Array) -> float:
    """Between two poses (7,), rad."""
    return 2.0 * math.acos(min(1.0, abs(float(one[3:] @ other[3:]))))


def square_branches(points: Array, data: CornerData) -> Branches | None:
    """Both poses of one square; ``points`` (4, 3) in the square's own frame, which is that of the result."""
    starts = [
        p + _quaternion(rotation_vector)
        for rotation_vector, p in square_poses(points, data.normalized)
        if p[2] > 0
    ]
    return fitted(data, np.array(starts)) if starts else None


def _quaternion(rotation_vector: list[float]) -> list[float]:
    """(4,) wxyz of a rotation vector."""
    half = 0.5 * math.hypot(*rotation_vector)
    scale = math.sin(half) / (2.0 * half) if half > 0.0 else 0.5
    return [math.cos(half), *(scale * v for v in rotation_vector)]


def with_mirror_image(data: CornerData, pose: Pose) -> Branches | None:
    """The branches of a body near ``pose``: with the mirrored one where its points lie in a plane."""
    normal = flat_normal(data.points)
    starts = [pose] if normal is None else [pose, mirrored(pose, data.points, normal)]
    return fitted(data, np.array([pose_row(start) for start in starts]))


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
