"""Learning a pose prior from motion: a Gaussian mixture by expectation-maximisation.

Frames in, ``PosePrior`` out, for a ``PosePriorGoal``: poses are mirrored, thinned to those that
differ, scaled by their spread, and a mixture is fitted whose covariances are shrunk towards spheres, so that
a few hundred poses are enough for forty joints.  It prefers poses like those that it was shown.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.kernels.tree import BALL, FREE, HINGE
from robot_ik.ports import Array
from robot_ik.pose_prior import PosePrior, feature_names
from robot_ik.robot import Robot

# Share of a covariance that is spread evenly over all directions, and the least standard deviation (of x).
# Narrow parts hold a pose fast in the part where it begins: of 52 poses of motions held out, the likelihood
# ended below that of the pose itself in 60 % with a deviation of 0.03, 17 % with 0.3, 6 % with 0.5.
_SHRINKAGE, _LEAST_DEVIATION = 0.05, 0.5
# rad, m: a joint that hardly moves is not taken for a law.
_LEAST_SPREAD = 0.03
# Rounds of EM, and the gain of log-likelihood a pose below which it ends.
_EM_ROUNDS, _EM_GAIN = 200, 1e-5
_CONTOUR = 0.99
# So many poses are kept, those that differ most.
_MOST_POSES = 3000


def mirrored(robot: Robot, q: ArrayLike) -> Array:
    """Poses (m, nq), or one, as in a mirror in the plane y = 0: ``left_…`` joints become ``right_…`` ones.

    Raises:
        InvalidGoalError: A joint of one side has no fellow, or one about another axis.
    """
    rows = np.atleast_2d(np.asarray(q, dtype=float))
    out = rows.copy()
    data = mujoco.MjData(robot.model)
    mujoco.mj_kinematics(robot.model, data)
    flip = np.array([-1.0, 1.0, -1.0])  # a rotation vector in a mirror across y
    for k, joint in enumerate(robot.joints):
        kind, to = int(robot.tree.kind[k]), int(robot.tree.qadr[k])
        fellow = other_side(joint)
        if fellow not in robot.joints:
            raise InvalidGoalError(f"joint {joint!r} of {robot.name!r} has no fellow {fellow!r}")
        other = robot.joints.index(fellow)
        source = int(robot.tree.qadr[other])
        if kind in (BALL, FREE):
            shift = 3 if kind == FREE else 0
            out[:, to : to + shift] = rows[:, source : source + shift] * [1.0, -1.0, 1.0][:shift]
            quaternion = slice(source + shift, source + shift + 4)
            out[:, to + shift : to + shift + 4] = rows[:, quaternion] * [1.0, -1.0, 1.0, -1.0]
            continue
        axes = data.xaxis[robot.tree.joint_ids[k]], data.xaxis[robot.tree.joint_ids[other]]
        along = float(axes[0] @ (axes[1] * (flip if kind == HINGE else -flip)))
        if abs(abs(along) - 1.0) > 1e-6:
            raise InvalidGoalError(f"joints {joint!r} and {fellow!r} of {robot.name!r} are no mirror image")
        out[:, to] = np.sign(along) * rows[:, source]
    return np.asarray(out[0] if np.ndim(q) == 1 else out)


def other_side(name: str) -> str:
    """``left_…`` of ``right_…`` and the other way round; the same for what has no side."""
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


def thinned(x: Array, count: int) -> NDArray[np.int64]:
    """Indices of ``count`` rows of x (m, n) that lie far from each other (farthest point, Gonzalez 1985)."""
    if len(x) <= count:
        return np.arange(len(x))
    chosen = [int(np.random.default_rng(0).integers(len(x)))]
    nearest = np.full(len(x), np.inf)
    for _ in range(count - 1):
        nearest = np.minimum(nearest, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
        chosen.append(int(np.argmax(nearest)))
    return np.sort(np.array(chosen))


def fit_pose_prior(
    robot: Robot,
    q: ArrayLike,
    *,
    parts: int = 8,
    mirror: bool = True,
) -> PosePrior:
    """Learns a prior from poses.

    Args:
        robot: Whose.
        q: (m, nq) frames of motions; of many, those poses that differ most are kept.
        parts: Of the mixture.
        mirror: Learn from each pose and its mirror image.

    Raises:
        InvalidGoalError: Fewer than ten poses a part, or no such joints to mirror.
    """
    rows = np.asarray(q, dtype=float)
    if mirror:
        rows = np.concatenate([rows, mirrored(robot, rows)])
    chosen = feature_names(robot)
    plain = PosePrior(
        chosen, np.zeros(len(chosen)), np.ones(len(chosen)), np.ones(1), np.zeros((1, len(chosen))),
        np.eye(len(chosen))[None],
    )  # fmt: skip
    x = plain.features(robot, rows)
    spread = np.maximum(x.std(axis=0), _LEAST_SPREAD)
    x = x[thinned(x / spread, _MOST_POSES)]
    if len(x) < 10 * parts:
        raise InvalidGoalError(
            f"{len(x)} poses are too few for {parts} parts", hint="ten poses a part at least"
        )
    middle, spread = x.mean(axis=0), np.maximum(x.std(axis=0), _LEAST_SPREAD)
    x = (x - middle) / spread
    weights, means, covariances = _mixture(x, parts)
    prior = PosePrior(chosen, middle, spread, weights, means, covariances)
    contour = float(np.quantile(prior.energy_of(x), _CONTOUR))
    return PosePrior(chosen, middle, spread, weights, means, covariances, contour)


def _mixture(x: Array, parts: int) -> tuple[Array, Array, Array]:
    """Weights, means and shrunk covariances of a Gaussian mixture, by expectation-maximisation."""
    shares = np.eye(parts)[_clusters(x, parts)]
    last = -np.inf
    weights, means, covariances = _m_step(x, shares)
    for _ in range(_EM_ROUNDS):
        logs = _part_logs(x, weights, means, covariances)
        best = logs.max(axis=1, keepdims=True)
        density = np.exp(logs - best)
        total = density.sum(axis=1, keepdims=True)
        mean_log = float((best + np.log(total)).mean())
        weights, means, covariances = _m_step(x, density / total)
        if mean_log - last < _EM_GAIN:
            break
        last = mean_log
    return weights, means, covariances


def _m_step(x: Array, shares: Array) -> tuple[Array, Array, Array]:
    n = x.shape[1]
    counts = shares.sum(axis=0) + 1e-9
    means = shares.T @ x / counts[:, None]
    covariances = np.empty((len(counts), n, n))
    for k, count in enumerate(counts):
        off = x - means[k]
        covariance = (shares[:, k, None] * off).T @ off / count
        even = max(float(np.trace(covariance)) / n, _LEAST_DEVIATION**2)
        covariances[k] = (1.0 - _SHRINKAGE) * covariance + _SHRINKAGE * even * np.eye(n)
        covariances[k] += _LEAST_DEVIATION**2 * np.eye(n)
    return counts / counts.sum(), means, covariances


def _part_logs(x: Array, weights: Array, means: Array, covariances: Array) -> Array:
    """(m, k) log w_k N(x; …), up to the constant that all parts share."""
    logs = np.empty((len(x), len(weights)))
    for k, covariance in enumerate(covariances):
        factor = np.linalg.cholesky(covariance)
        white = np.linalg.solve(factor, (x - means[k]).T)
        logs[:, k] = np.log(weights[k]) - np.log(np.diagonal(factor)).sum() - 0.5 * np.sum(white**2, axis=0)
    return logs


def _clusters(x: Array, count: int) -> NDArray[np.int64]:
    """(m,) cluster of each row: k-means from k-means++ (Arthur & Vassilvitskii 2007)."""
    rng = np.random.default_rng(0)
    centres = [x[rng.integers(len(x))]]
    for _ in range(count - 1):
        square = np.min([np.sum((x - c) ** 2, axis=1) for c in centres], axis=0)
        centres.append(x[rng.choice(len(x), p=square / square.sum())])
    middle = np.array(centres)
    label = np.zeros(len(x), dtype=int)
    for _ in range(30):
        label = np.argmin(np.stack([np.sum((x - c) ** 2, axis=1) for c in middle]), axis=0)
        middle = np.array(
            [x[label == k].mean(axis=0) if (label == k).any() else middle[k] for k in range(count)]
        )
    return label
