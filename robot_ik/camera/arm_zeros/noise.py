"""Least squares over views of an arm whose joints are not exact either; how much, the views tell.

In each view every joint is off by its own small error (ticks, play), all of one size, which is estimated by
restricted maximum likelihood as in ``handeye_noise``; a view that contradicts the others counts less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.arm_zeros.model import Linear

Array = NDArray[np.float64]

# Searched: rad at each joint, from nothing to a loose gear.
_SIZES = np.geomspace(1e-7, 3e-2, 12)
_NEARBY = np.geomspace(0.5, 2.0, 3)
_ZOOMS = 4
# Student's t with so many degrees of freedom: Gaussian views lose little, a wrong one hardly counts.
_FREEDOM = 5.0
_TWIST = 6


@dataclass(frozen=True, eq=False)
class JointNoise:
    """Error of the joints from view to view, and how the views are believed.

    Attributes:
        size: Standard deviation, rad at each joint.
        covariances: (n, 6, 6) of the wishes, pixels and joints together.
        weights: (n,) at most 1; near 0 for a view that contradicts the others.
    """

    size: float
    covariances: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of the unknowns that are ``free``.

    Attributes:
        matrix: (m, m) with what was known before; ``right``: (m,).
        parts, rights: (n, m, m) and (n, m) of each view.
        free: (m,) places of the unknowns among all.
        count: How many there are in all.
    """

    matrix: Array
    right: Array
    parts: Array
    rights: Array
    free: NDArray[np.int64]
    count: int

    def step(self, damping: float = 0.0) -> Array:
        """Of all unknowns; 0 for those that are not free.  Levenberg and Marquardt's damping."""
        scale = np.sqrt(np.maximum(np.diag(self.matrix), 1e-300))
        scaled = self.matrix / np.outer(scale, scale) + damping * np.eye(len(scale))
        return self._whole(np.linalg.lstsq(scaled, self.right / scale, rcond=1e-15)[0] / scale)

    def without(self, view: int) -> tuple[Array, Array]:
        """Step and covariance of all unknowns as the other views have it."""
        covariance = inverse(self.matrix - self.parts[view])
        step = self._whole(covariance @ (self.right - self.rights[view]))
        return step, self.spread_out(covariance)

    def spread_out(self, matrix: Array) -> Array:
        """(m, m) of the free ones as one of all, zeros elsewhere."""
        whole = np.zeros((self.count, self.count))
        whole[np.ix_(self.free, self.free)] = matrix
        return whole

    def _whole(self, step: Array) -> Array:
        whole = np.zeros(self.count)
        whole[self.free] = step
        return whole


def normal_equations(linear: Linear, noise: JointNoise, free: NDArray[np.int64]) -> Normal:
    """Weighted least squares; ``free``: (m,) places of the unknowns that are sought."""
    rows = linear.rows[:, :, free]
    weighted = np.linalg.solve(noise.covariances, rows) * noise.weights[:, None, None]
    parts = np.einsum("nik,nil->nkl", rows, weighted)
    rights = -np.einsum("nik,ni->nk", weighted, linear.wish)
    prior = linear.prior[np.ix_(free, free)]
    right = rights.sum(axis=0) - prior @ linear.off[free]
    return Normal(parts.sum(axis=0) + prior, right, parts, rights, free, len(linear.off))


def cost(linear: Linear, noise: JointNoise) -> float:
    """What is minimised, with the noise held: squares of the views and of what was known before."""
    weighted = np.linalg.solve(noise.covariances, linear.wish[..., None])[..., 0]
    squares = noise.weights * np.einsum("ni,ni->n", linear.wish, weighted)
    return float(squares.sum() + linear.off @ linear.prior @ linear.off)


def estimate_joint_noise(linear: Linear, free: NDArray[np.int64], before: JointNoise | None) -> JointNoise:
    """Size of the joints' error, then the weights of the views; one turn of each."""
    n = len(linear.wish)
    if before is None:
        scale = np.maximum(1.4826 * np.median(np.abs(linear.wish), axis=0), 1e-12)
        far = (np.abs(linear.wish) / scale).max(axis=1) / 4.0
        weights = np.maximum(1.0, far) ** -2.0
    else:
        weights = before.weights
    sizes = _SIZES if before is None else max(before.size, _SIZES[0]) * _NEARBY
    for _ in range(_ZOOMS):
        best = sizes[int(np.argmax([_likelihood(linear, free, weights, size) for size in sizes]))]
        factor = np.sqrt(sizes[1] / sizes[0])
        sizes = best * factor ** np.array([-1.0, 0.0, 1.0])
    covariances = linear.pixels + best**2 * linear.arm
    noise = JointNoise(float(best), covariances, weights)
    rest = linear.wish + linear.rows @ normal_equations(linear, noise, free).step()
    squares = np.einsum("ni,ni->n", rest, np.linalg.solve(covariances, rest[..., None])[..., 0])
    again = np.minimum(1.0, (_FREEDOM + _TWIST) / (_FREEDOM + squares))
    return JointNoise(float(best), covariances, again if n > 1 else np.ones(n))


def inverse(matrix: Array) -> Array:
    """Of a positive matrix whose unknowns have other units and may hardly be determined."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    outer = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(matrix / outer, rcond=1e-14, hermitian=True) / outer)


def _likelihood(linear: Linear, free: NDArray[np.int64], weights: Array, size: float) -> float:
    """Restricted log-likelihood of a size of the joints' error."""
    noise = JointNoise(size, linear.pixels + size**2 * linear.arm, weights)
    normal = normal_equations(linear, noise, free)
    squares = cost(linear, noise) - normal.right @ normal.step()[free]
    logs = np.linalg.slogdet(noise.covariances)[1].sum() + np.linalg.slogdet(normal.matrix)[1]
    return -0.5 * float(logs + squares)
