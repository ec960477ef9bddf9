"""Learning a pose prior from motions: a Gaussian mixture by expectation-maximisation.

Poses are mirrored, thinned to those that differ, and scaled by their spread. The covariances of the
mixture are shrunk towards spheres, so that a few hundred poses are enough for forty joints. The
result is a ``PosePrior`` for a ``PosePriorGoal``, which prefers poses like the learned ones.
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

SHRINKAGE = 0.05
"""Share of a covariance that is spread evenly over all directions."""

SMALLEST_DEVIATION = 0.5
"""Smallest standard deviation of a scaled feature. Narrow parts keep a pose in the part where it
starts: of 52 poses of motions that were not learned, the likelihood ended below that of the pose
itself in 60 % with 0.03, in 17 % with 0.3 and in 6 % with 0.5."""

SMALLEST_SPREAD = 0.03
"""rad or m. Smallest spread of a feature. A joint that does not move is no constraint."""

EM_ROUNDS = 200
"""Largest number of rounds of expectation-maximisation."""

EM_GAIN = 1e-5
"""Gain of log-likelihood per pose below which the rounds end."""

CONTOUR = 0.99
"""Share of the learned poses inside the contour."""

MAX_POSES = 3000
"""Poses that are kept: those that differ most."""

MIN_POSES = 10
"""Poses for each part of the mixture."""

SAME_AXIS = 1e-6
"""Largest deviation of the cosine between mirrored axes from ±1."""


def mirrored(robot: Robot, q: ArrayLike) -> Array:
    """Return poses (m, nq) or one pose (nq,) mirrored in the plane y = 0.

    The values of ``left_…`` and ``right_…`` joints are exchanged.

    Raises:
        InvalidGoalError: A joint has no counterpart on the other side, or one about another axis.
    """
    rows = np.atleast_2d(np.asarray(q, dtype=float))
    out = rows.copy()
    data = mujoco.MjData(robot.model)
    mujoco.mj_kinematics(robot.model, data)
    flip = np.array([-1.0, 1.0, -1.0])  # a rotation vector in a mirror across y
    for k, joint in enumerate(robot.joints):
        kind = int(robot.tree.kind[k])
        to = int(robot.tree.qadr[k])
        counterpart = other_side(joint)
        if counterpart not in robot.joints:
            raise InvalidGoalError(
                f"joint {joint!r} of {robot.name!r} has no counterpart {counterpart!r}"
            )
        other = robot.joints.index(counterpart)
        source = int(robot.tree.qadr[other])
        if kind in (BALL, FREE):
            shift = 3 if kind == FREE else 0
            out[:, to : to + shift] = rows[:, source : source + shift] * [1.0, -1.0, 1.0][:shift]
            quaternion = slice(source + shift, source + shift + 4)
            out[:, to + shift : to + shift + 4] = rows[:, quaternion] * [1.0, -1.0, 1.0, -1.0]
            continue
        axes = data.xaxis[robot.tree.joint_ids[k]], data.xaxis[robot.tree.joint_ids[other]]
        along = float(axes[0] @ (axes[1] * (flip if kind == HINGE else -flip)))
        if abs(abs(along) - 1.0) > SAME_AXIS:
            raise InvalidGoalError(
                f"joints {joint!r} and {counterpart!r} of {robot.name!r} are not mirror images"
            )
        out[:, to] = np.sign(along) * rows[:, source]
    return np.asarray(out[0] if np.ndim(q) == 1 else out)


def other_side(name: str) -> str:
    """Return the name with left and right exchanged; the same name without a side."""
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


def thinned(x: Array, count: int) -> NDArray[np.int64]:
    """Return the indices of ``count`` distant rows of x (m, n) (farthest point, Gonzalez 1985)."""
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
    """Learn a prior from poses.

    Args:
        robot: The robot.
        q: Poses (m, nq). Of many, the ones that differ most are kept.
        parts: Number of parts of the mixture.
        mirror: Whether the mirror image of each pose is learned, too.

    Raises:
        InvalidGoalError: There are fewer than ten poses for each part, or the joints cannot be
            mirrored.
    """
    rows = np.asarray(q, dtype=float)
    if mirror:
        rows = np.concatenate([rows, mirrored(robot, rows)])
    chosen = feature_names(robot)
    plain = PosePrior(
        chosen,
        np.zeros(len(chosen)),
        np.ones(len(chosen)),
        np.ones(1),
        np.zeros((1, len(chosen))),
        np.eye(len(chosen))[None],
    )
    x = plain.features(robot, rows)
    spread = np.maximum(x.std(axis=0), SMALLEST_SPREAD)
    x = x[thinned(x / spread, MAX_POSES)]
    if len(x) < MIN_POSES * parts:
        raise InvalidGoalError(
            f"{len(x)} poses are too few for {parts} parts", hint="ten poses a part at least"
        )
    middle = x.mean(axis=0)
    spread = np.maximum(x.std(axis=0), SMALLEST_SPREAD)
    x = (x - middle) / spread
    weights, means, covariances = _mixture(x, parts)
    prior = PosePrior(chosen, middle, spread, weights, means, covariances)
    contour = float(np.quantile(prior.energy_of(x), CONTOUR))
    return PosePrior(chosen, middle, spread, weights, means, covariances, contour)


def _mixture(x: Array, parts: int) -> tuple[Array, Array, Array]:
    """Return weights, means and shrunk covariances, by expectation-maximisation."""
    shares = np.eye(parts)[_clusters(x, parts)]
    last = -np.inf
    weights, means, covariances = _m_step(x, shares)
    for _ in range(EM_ROUNDS):
        logs = _part_logs(x, weights, means, covariances)
        best = logs.max(axis=1, keepdims=True)
        density = np.exp(logs - best)
        total = density.sum(axis=1, keepdims=True)
        mean_log = float((best + np.log(total)).mean())
        weights, means, covariances = _m_step(x, density / total)
        if mean_log - last < EM_GAIN:
            break
        last = mean_log
    return weights, means, covariances


def _m_step(x: Array, shares: Array) -> tuple[Array, Array, Array]:
    n = x.shape[1]
    counts = shares.sum(axis=0) + 1e-9
    means = shares.T @ x / counts[:, None]
    covariances = np.empty((len(counts), n, n))
    for k, count in enumerate(counts):
        deviation = x - means[k]
        covariance = (shares[:, k, None] * deviation).T @ deviation / count
        even = max(float(np.trace(covariance)) / n, SMALLEST_DEVIATION**2)
        covariances[k] = (1.0 - SHRINKAGE) * covariance + SHRINKAGE * even * np.eye(n)
        covariances[k] += SMALLEST_DEVIATION**2 * np.eye(n)
    return counts / counts.sum(), means, covariances


def _part_logs(x: Array, weights: Array, means: Array, covariances: Array) -> Array:
    """Return (m, k) log w_k N(x; …), up to the constant that all parts share."""
    logs = np.empty((len(x), len(weights)))
    for k, covariance in enumerate(covariances):
        factor = np.linalg.cholesky(covariance)
        white = np.linalg.solve(factor, (x - means[k]).T)
        logs[:, k] = (
            np.log(weights[k]) - np.log(np.diagonal(factor)).sum() - 0.5 * np.sum(white**2, axis=0)
        )
    return logs


def _clusters(x: Array, count: int) -> NDArray[np.int64]:
    """Return the cluster (m,) of each row: k-means from k-means++ (Arthur & Vassilvitskii 2007)."""
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
