"""Means and spreads of rotations: what views from many sides have in common, and how many sides there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose, quat_multiply, rotation_log

Array = NDArray[np.float64]

# Rounds of weighting again, and the least scale with which a miss is compared: metres and radians.
_ROUNDS = 10
_LEAST_SCALE = 1e-9
# Median of |x| of a Gaussian is 0.6745 standard deviations.
_MEDIAN_TO_SIGMA = 1.4826


def mean_rotation(wxyz: Array, weights: Array | None = None) -> Array:
    """Mean of unit quaternions (n, 4), wxyz: the one that is nearest to all (chordal L2).

    The signs of the quaternions do not matter.  Source: Markley et al., Averaging Quaternions, Journal of
    Guidance, Control, and Dynamics 30(4), 2007, eq. 12: the eigenvector of the largest eigenvalue of
    sum w q q^T.

    Returns:
        (4,), w >= 0.
    """
    q = np.asarray(wxyz, dtype=float).reshape(-1, 4)
    w = np.ones(len(q)) if weights is None else np.asarray(weights, dtype=float)
    _, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", w, q, q))
    mean = vectors[:, -1]
    return np.asarray(-mean if mean[0] < 0 else mean)


def mean_pose(poses: Sequence[Pose], weights: Array | None = None) -> Pose:
    """Weighted mean of positions and, by itself, of rotations."""
    w = np.ones(len(poses)) if weights is None else np.asarray(weights, dtype=float)
    position = np.average([pose.position for pose in poses], axis=0, weights=w)
    return Pose(position, mean_rotation(np.array([pose.wxyz for pose in poses]), w))


def robust_mean_pose(poses: Sequence[Pose]) -> tuple[Pose, Array]:
    """Mean that a minority of wrong poses hardly moves, and the weights (n,), 0 to 1, that it ended with.

    Starts at the pose in the middle (least sum of distances to all others), then weights by Cauchy's
    function of the distance, in units of the median distance.
    """
    away = np.array([[one.distance(other) for other in poses] for one in poses])  # (n, n, 2)
    scale = np.maximum(np.median(away, axis=(0, 1)), _LEAST_SCALE)
    mean = poses[int(np.argmin((away / scale).sum(axis=(1, 2))))]
    weights = np.ones(len(poses))
    for _ in range(_ROUNDS):
        far = np.array([mean.distance(pose) for pose in poses])
        scale = np.maximum(_MEDIAN_TO_SIGMA * np.median(far, axis=0), _LEAST_SCALE)
        weights = cauchy_weight(np.linalg.norm(far / scale, axis=1))
        mean = mean_pose(poses, weights)
    return mean, weights


def cauchy_weight(misses: Array) -> Array:
    """Weights of misses in standard deviations: 1 at 0, 95 % efficient on Gaussian noise (c = 2.385)."""
    return np.asarray(1.0 / (1.0 + (misses / 2.385) ** 2))


def rotation_spread(rotations: Sequence[Array]) -> Array:
    """How widely rotations (unit quaternions (4,)) are spread, by axis.

    Returns:
        (3,) standard deviations in rad about the three principal axes, the largest first.  Rotations about
        one axis only give (s, 0, 0).
    """
    mean = mean_rotation(np.array(rotations))
    back = mean * np.array([1.0, -1.0, -1.0, -1.0])
    vectors = np.array([rotation_log(quat_multiply(back, wxyz)) for wxyz in rotations])
    vectors -= vectors.mean(axis=0)
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    return np.asarray(np.concatenate([spread, np.zeros(3)])[:3])
