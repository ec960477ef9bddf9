"""Least-squares pose of known points seen in one picture.

Residuals are differences of undistorted normalised coordinates, weighted by the derivative of the lens
mapping and by the covariance of the corners: they are in units of standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens_kernels import lens_vector
from robot_ik.camera.pose.kernel import evaluate, fit_poses, whiten
from robot_ik.camera.refine import RefinedCorners
from robot_ik.geometry import Pose
from robot_ik.kernels.jit import announce

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
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


@dataclass(frozen=True, eq=False)
class CornerData:
    """Corners with what a fit needs to know of them.

    Attributes:
        points: (n, 3) in the body's frame, metres.
        ideal: (n, 2) where they were seen, undistorted normalised coordinates.
        blocks: (m, b, b) with m b = 2n: maps from differences of ideal coordinates to standard deviations,
            one for each group of corners with errors of their own (a marker: b = 8).
        to_pixels: (n, 2, 2) map from differences of ideal coordinates to pixels.
    """

    points: Array
    ideal: Array
    blocks: Array
    to_pixels: Array

    @classmethod
    def of(cls, points: Array, seen: RefinedCorners, intrinsics: CameraIntrinsics) -> CornerData:
        """The four corners of one marker; ``points`` (4, 3) in the body's frame."""
        return cls.of_markers(points, [seen], intrinsics)

    @classmethod
    def of_markers(
        cls, points: Array, seen: Sequence[RefinedCorners], intrinsics: CameraIntrinsics
    ) -> CornerData:
        """Several markers of one body; ``points`` (4 m, 3) in its frame."""
        announce(fit_poses, "the pose of markers")
        ideal = np.concatenate([s.ideal for s in seen])
        blocks, to_pixels = np.zeros((len(seen), 8, 8)), np.empty((len(ideal), 2, 2))
        covariance = np.array([s.covariance for s in seen])
        whiten(ideal, covariance, lens_vector(intrinsics), blocks, to_pixels)
        return cls(np.ascontiguousarray(points, dtype=float), ideal, blocks, to_pixels)

    def chosen(self, markers: Sequence[int] | Array, weights: Array | None = None) -> CornerData:
        """Some of the markers (numbers of blocks); ``weights`` (m,) of their squared residuals."""
        part = np.asarray(markers, dtype=int)
        blocks = self.blocks[part]
        if weights is not None:
            blocks = blocks * np.sqrt(weights)[:, None, None]
        of_points = [
            a.reshape(len(self.blocks), -1, *a.shape[1:]) for a in (self.points, self.ideal, self.to_pixels)
        ]
        points, ideal, to_pixels = (a[part].reshape(-1, *a.shape[2:]) for a in of_points)
        return CornerData(points, ideal, blocks, to_pixels)

    @property
    def white(self) -> Array:
        """(2n, 2n) the blocks as one matrix."""
        m, b, _ = self.blocks.shape
        whole = np.zeros((m * b, m * b))
        for i in range(m):
            whole[i * b : (i + 1) * b, i * b : (i + 1) * b] = self.blocks[i]
        return whole

    def residual(self, pose: Pose) -> Array:
        """(n, 2) undistorted normalised coordinates: predicted minus seen."""
        p = pose.apply(self.points)
        # Behind the camera there is no picture: a large residual turns the fit back.
        z = np.where(p[:, 2:] > 1e-6, p[:, 2:], 1e-6)
        return np.asarray(p[:, :2] / z - self.ideal)

    def fit(self, pose: Pose) -> Fit:
        """How well ``pose`` fits."""
        m, b, _ = self.blocks.shape
        result = Fit(np.empty(m * b), np.empty((m * b, 6)), np.empty(m), np.empty(m))
        evaluate(
            self.points, self.ideal, self.to_pixels, self.blocks, pose_row(pose),
            result.residual, result.jacobian, result.pixels, result.costs,
        )  # fmt: skip
        return result

    def pixel_error(self, pose: Pose) -> float:
        """RMS distance of the corners in pixels."""
        return float(np.sqrt(np.mean(self.fit(pose).pixels ** 2)))

    def cost(self, pose: Pose) -> float:
        """Sum of squares in standard deviations."""
        return float(self.fit(pose).costs.sum())

    def jacobian(self, pose: Pose) -> Array:
        """(2n, 6) of the whitened residual by translation and rotation along the camera's axes."""
        return self.fit(pose).jacobian


def pose_row(pose: Pose) -> Array:
    """(7,) position and quaternion wxyz, as compiled code wants them."""
    return np.concatenate([pose.position, pose.wxyz])


def fit_rows(corners: CornerData, starts: Array) -> tuple[Array, Array]:
    """Levenberg-Marquardt from each start (k, 7): poses (k, 7) and costs (k,), not finite where it failed."""
    poses, costs = starts.copy(), np.empty(len(starts))
    fit_poses(corners.points, corners.ideal, corners.blocks, poses, costs)
    return poses, costs


def fit_pose(corners: CornerData, start: Pose) -> tuple[Pose, float]:
    """Levenberg-Marquardt from ``start``: pose and cost; the start with infinite cost when there is none."""
    (row,), (cost,) = fit_rows(corners, pose_row(start)[None])
    if not (np.isfinite(cost) and np.isfinite(row).all()):
        return start, float("inf")
    return Pose(row[:3], row[3:]), float(cost)


def pose_covariance(corners: CornerData, pose: Pose, cost: float) -> Array:
    """(J^T J)^-1, widened when the residuals are larger than the corners' covariance explains."""
    return covariance_of(corners.jacobian(pose), cost)


def covariance_of(jacobian: Array, cost: float) -> Array:
    """(6, 6): (J^T J)^-1 of a Jacobian (n, 6), widened when ``cost`` is more than its degrees of freedom."""
    normal = jacobian.T @ jacobian
    freedom = len(jacobian) - 6
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(normal)
    return np.asarray(inverse * max(1.0, cost / freedom))
