"""Means and spreads of rotations and poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_ik.camera.calibration.least_squares import cauchy_weight
from robot_ik.geometry import Pose, quat_multiply, rotation_log
from robot_ik.ports import Array

# Rounds of reweighting. The mean settles after about five.
_ROUNDS = 10
# Smallest scale of the distances, metres and rad.
_MIN_SCALE = 1e-9
# The median of |x| of a Gaussian is 1 / 1.4826 standard deviations.
_MEDIAN_TO_SIGMA = 1.4826


def mean_rotation(wxyz: Array, weights: Array | None = None) -> Array:
    """Return the mean of unit quaternions (n, 4): the one nearest to all (chordal L2).

    The signs of the quaternions do not matter. Source: Markley et al., Averaging Quaternions,
    Journal of Guidance, Control, and Dynamics 30(4), 2007, eq. 12: the eigenvector of the largest
    eigenvalue of sum w q q^T.

    Args:
        wxyz: (n, 4) unit quaternions.
        weights: (n,); None for 1.

    Returns:
        (4,), w >= 0.
    """
    q = np.asarray(wxyz, dtype=float).reshape(-1, 4)
    w = np.ones(len(q)) if weights is None else np.asarray(weights, dtype=float)
    _, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", w, q, q))
    mean = vectors[:, -1]
    return np.asarray(-mean if mean[0] < 0 else mean)


def robust_mean_pose(poses: Sequence[Pose]) -> Pose:
    """Return a mean that a minority of wrong poses hardly moves.

    It starts at the pose with the least sum of distances to all others. Weights are Cauchy's, in
    units of the median distance.
    """
    distances = np.array([[pose.distance(other) for other in poses] for pose in poses])
    scale = np.maximum(np.median(distances, axis=(0, 1)), _MIN_SCALE)
    mean = poses[int(np.argmin((distances / scale).sum(axis=(1, 2))))]
    for _ in range(_ROUNDS):
        from_mean = np.array([mean.distance(pose) for pose in poses])
        scale = np.maximum(_MEDIAN_TO_SIGMA * np.median(from_mean, axis=0), _MIN_SCALE)
        weights = cauchy_weight(np.linalg.norm(from_mean / scale, axis=1))
        position = np.average([pose.position for pose in poses], axis=0, weights=weights)
        mean = Pose(position, mean_rotation(np.array([pose.wxyz for pose in poses]), weights))
    return mean


def rotation_spread(rotations: Sequence[Array]) -> Array:
    """Return the spread of rotations (unit quaternions (4,)).

    Returns:
        (3,) standard deviations in rad about the three principal axes, the largest first. Rotations
        about a single axis give (s, 0, 0).
    """
    mean = mean_rotation(np.array(rotations))
    inverse = mean * np.array([1.0, -1.0, -1.0, -1.0])
    vectors = np.array([rotation_log(quat_multiply(inverse, wxyz)) for wxyz in rotations])
    vectors -= vectors.mean(axis=0)
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    return np.asarray(np.concatenate([spread, np.zeros(3)])[:3])
