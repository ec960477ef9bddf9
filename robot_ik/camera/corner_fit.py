"""Least-squares pose of known points seen in one picture: Levenberg-Marquardt in numpy.

Residuals are differences of undistorted normalised coordinates, weighted by the derivative of the lens
mapping and by the covariance of the corners: they are in units of standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.refine import RefinedCorners
from robot_ik.geometry import Pose, quat_multiply, rotation_exp

Array = NDArray[np.float64]

_LM_STEPS = 30
# Relative gain below which the fit is finished.
_LM_DONE = 1e-10


@dataclass(frozen=True, eq=False)
class CornerData:
    """Corners with what a fit needs to know of them.

    Attributes:
        points: (n, 3) in the body's frame, metres.
        ideal: (n, 2) where they were seen, undistorted normalised coordinates.
        white: (2n, 2n) map from differences of ideal coordinates to standard deviations.
        to_pixels: (n, 2, 2) map from differences of ideal coordinates to pixels.
    """

    points: Array
    ideal: Array
    white: Array
    to_pixels: Array

    @classmethod
    def of(cls, points: Array, seen: RefinedCorners, intrinsics: CameraIntrinsics) -> CornerData:
        """The four corners of one marker; ``points`` (4, 3) in the body's frame."""
        to_pixels = intrinsics.pixel_jacobian(seen.ideal)
        # Whitening: L^-1 with L L^T = covariance turns pixel residuals into standard deviations.
        lower = np.linalg.cholesky(seen.covariance)
        block = np.zeros((8, 8))
        for k in range(4):
            block[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = to_pixels[k]
        return cls(points, seen.ideal, np.linalg.solve(lower, block), to_pixels)

    @classmethod
    def joined(cls, parts: list[CornerData]) -> CornerData:
        """Several markers of one body."""
        n = 8 * len(parts)
        white = np.zeros((n, n))
        for i, part in enumerate(parts):
            white[8 * i : 8 * i + 8, 8 * i : 8 * i + 8] = part.white
        return cls(
            np.concatenate([p.points for p in parts]),
            np.concatenate([p.ideal for p in parts]),
            white,
            np.concatenate([p.to_pixels for p in parts]),
        )

    def residual(self, pose: Pose) -> Array:
        """(n, 2) undistorted normalised coordinates: predicted minus seen."""
        p = pose.apply(self.points)
        # Behind the camera there is no picture: a large residual turns the fit back.
        z = np.where(p[:, 2:] > 1e-6, p[:, 2:], 1e-6)
        return np.asarray(p[:, :2] / z - self.ideal)

    def pixel_error(self, pose: Pose) -> float:
        """RMS distance of the corners in pixels."""
        miss = np.einsum("nij,nj->ni", self.to_pixels, self.residual(pose))
        return float(np.sqrt((miss**2).sum(axis=1).mean()))

    def cost(self, pose: Pose) -> float:
        """Sum of squares in standard deviations."""
        return float(((self.white @ self.residual(pose).ravel()) ** 2).sum())

    def jacobian(self, pose: Pose) -> Array:
        """(2n, 6) of the whitened residual by translation and rotation along the camera's axes."""
        turned = self.points @ pose.rotation.T
        p = turned + pose.position
        n, z = len(p), p[:, 2]
        by_point = np.zeros((n, 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
        by_point[:, 0, 2] = -p[:, 0] / z**2
        by_point[:, 1, 2] = -p[:, 1] / z**2
        # d(exp(w) r) / dw = -[r]x
        cross = np.zeros((n, 3, 3))
        cross[:, 0, 1], cross[:, 0, 2] = turned[:, 2], -turned[:, 1]
        cross[:, 1, 0], cross[:, 1, 2] = -turned[:, 2], turned[:, 0]
        cross[:, 2, 0], cross[:, 2, 1] = turned[:, 1], -turned[:, 0]
        rows = np.concatenate([by_point, by_point @ cross], axis=2).reshape(2 * n, 6)
        return np.asarray(self.white @ rows)


def _moved(pose: Pose, step: Array) -> Pose:
    return Pose(pose.position + step[:3], quat_multiply(rotation_exp(step[3:]), pose.wxyz))


def fit_pose(corners: CornerData, start: Pose) -> tuple[Pose, float]:
    """Levenberg-Marquardt (Nielsen's damping) from ``start``: pose and cost."""
    pose, cost = start, corners.cost(start)
    damping, growth = 1e-4, 2.0
    for _ in range(_LM_STEPS):
        jacobian = corners.jacobian(pose)
        normal = jacobian.T @ jacobian
        right = jacobian.T @ (corners.white @ corners.residual(pose).ravel())
        try:
            step = np.asarray(
                -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), right), float
            )
        except np.linalg.LinAlgError:
            break
        trial = _moved(pose, step)
        trial_cost = corners.cost(trial)
        if trial_cost < cost:
            done = cost - trial_cost < _LM_DONE * (1.0 + cost)
            pose, cost = trial, trial_cost
            damping, growth = max(damping * 0.1, 1e-9), 2.0
            if done:
                break
        else:
            damping *= growth
            growth *= 2.0
            if damping > 1e8 or np.abs(step).max() < 1e-13:
                break
    return pose, cost


def pose_covariance(corners: CornerData, pose: Pose, cost: float) -> Array:
    """(J^T J)^-1, widened when the residuals are larger than the corners' covariance explains."""
    jacobian = corners.jacobian(pose)
    freedom = len(jacobian) - 6
    return np.asarray(np.linalg.pinv(jacobian.T @ jacobian) * max(1.0, cost / freedom))
