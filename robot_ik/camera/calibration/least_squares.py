"""The one least-squares core of extrinsics, hand-eye and joint zeros: neither pixels nor the hand are exact.

Each view is boiled down to the twist of the hand that its picture asks for, e_i (6,).  A step x of the
unknowns leaves e_i + A_i x, with an error of covariance P_i + sum_k s_k^2 G_ki: P_i of the pixels, which is
known, and G_ki of a source of the arm's own error (position and angle of the hand, or its joints) whose size
s_k, one for all views, is found by restricted maximum likelihood.  A view that contradicts the others counts
less, and what was known of the unknowns before enters with its covariance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array

# Searched: metres or rad, from far better than servos to a loose mounting; then about the last solution.
_SIZES = np.geomspace(1e-7, 5e-2, 10)
_NEARBY = np.geomspace(0.4, 2.5, 3)
_ZOOMS = 5
# A view that the others contradict by more than this many standard deviations (of 6 numbers: 1 view in 10^6)
# is an outlier, where the miss is also more than print and lens explain.
_OUTLIER = 6.4
# Student's t with so many degrees of freedom: Gaussian views lose little, a wrong one hardly counts.
_FREEDOM, _TWIST = 5.0, 6
_ROUNDS = 3
# Of the fit: rounds, tries to find a step that lowers the cost, and the first damping.
_ITERATIONS, _TRIES, _FIRST_DAMPING = 30, 8, 1e-9
# Steps smaller than this (rad, metres) end the fit; so small that nothing is bent: not tried first.
_DONE, _SMALL = 1e-7, 1e-3
# A prior that weighs as much as nothing: keeps the fit solvable where the views say nothing.
_NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class LinearViews:
    """All views, linear at one state, and what is known of the m unknowns beforehand.

    Attributes:
        pseudo_measurement: (n, 6) twist of the hand, in its axes, that each picture asks for.
        pixels: (n, 6, 6) covariance of it from the corners alone.
        rows: (n, 6, m) by how much the unknowns change it.
        sources: (k, n, 6, 6) covariance that each source of the arm's error would give it, of size 1.
        prior: (m, m) information on the unknowns; ``off``: (m,) from where they were thought to be.
    """

    pseudo_measurement: Array
    pixels: Array
    rows: Array
    sources: Array
    prior: Array
    off: Array

    def covariances(self, sizes: Array) -> Array:
        """(..., n, 6, 6) of pixels and arm together, for sizes (..., k)."""
        return np.asarray(self.pixels + np.tensordot(sizes**2, self.sources, 1))

    def cost(self, noise: ArmNoise) -> float:
        """What is minimised, with the noise held: squares of the views and of what was known before."""
        weighted = np.linalg.solve(noise.covariances, self.pseudo_measurement[..., None])[..., 0]
        squares = noise.weights * np.einsum("ni,ni->n", self.pseudo_measurement, weighted)
        return float(squares.sum() + self.off @ self.prior @ self.off)


@dataclass(frozen=True, eq=False)
class ArmNoise:
    """The arm's own error from view to view, and how the views are believed.

    Attributes:
        sizes: (k,) standard deviation of each source.
        covariances: (n, 6, 6) of the pseudo-measurements, pixels and arm together.
        weights: (n,) at most 1; near 0 for a view that contradicts the others.
    """

    sizes: Array
    covariances: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class LeftOut:
    """What all views but one say of that one.

    Attributes:
        step: (m,) of the unknowns.
        pseudo_measurement: (6,) what its picture still asks for then; ``covariance``: (6, 6) to be expected.
        sigmas: Its length in standard deviations.
    """

    step: Array
    pseudo_measurement: Array
    covariance: Array
    sigmas: float

    @property
    def contradicts(self) -> bool:
        """Whether the view contradicts the others."""
        return self.sigmas > _OUTLIER


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the unknowns that are ``free``.

    Attributes:
        views, noise: What they are of.
        matrix: (f, f) with what was known before; ``right``: (f,).
        parts, rights: (n, f, f) and (n, f) of each view.
        free: (f,) indices of the unknowns among all.
    """

    views: LinearViews
    noise: ArmNoise
    matrix: Array
    right: Array
    parts: Array
    rights: Array
    free: NDArray[np.int64]

    def step(self, damping: float = 0.0) -> Array:
        """(m,) of all unknowns; 0 for those that are not free.  Levenberg and Marquardt's damping."""
        scaled, scale = _balanced(self.matrix, damping)
        return self._whole(np.linalg.lstsq(scaled, self.right / scale, rcond=1e-15)[0] / scale)

    @property
    def covariance(self) -> Array:
        """(m, m) of all unknowns; zeros for those that are not free."""
        return self._spread_out(inverse(self.matrix))

    def moved_by(self, errors: Array) -> Array:
        """(m,) how far the unknowns are off where the pseudo-measurements are off by ``errors`` (n, 6)."""
        weighted = np.linalg.solve(self.noise.covariances, errors[..., None])[..., 0]
        by_view = np.einsum("nik,ni->nk", self.views.rows, weighted)
        return np.asarray(self.covariance @ (self.noise.weights @ by_view))

    def left_out(self, view: int) -> LeftOut:
        """How one view fits what all others say."""
        _, scale = _balanced(self.matrix)
        outer = np.outer(scale, scale)
        others = (self.matrix - self.parts[view]) / outer + _NOTHING * np.eye(len(scale))
        covariance = np.linalg.inv(others) / outer
        step = self._whole(covariance @ (self.right - self.rights[view]))
        rows = self.views.rows[view]
        rest = self.views.pseudo_measurement[view] + rows @ step
        expected = self.noise.covariances[view] + rows @ self._spread_out(covariance) @ rows.T
        sigmas = float(np.sqrt(max(rest @ np.linalg.solve(expected, rest), 0.0)))
        return LeftOut(step, rest, expected, sigmas)

    def _whole(self, step: Array) -> Array:
        whole = np.zeros(len(self.views.off))
        whole[self.free] = step
        return whole

    def _spread_out(self, matrix: Array) -> Array:
        count = len(self.views.off)
        whole = np.zeros((count, count))
        whole[np.ix_(self.free, self.free)] = matrix
        return whole


def normal_equations(
    views: LinearViews, noise: ArmNoise, free: NDArray[np.int64]
) -> NormalEquations:
    """Weighted least squares; ``free``: (f,) places of the unknowns that are sought."""
    rows = views.rows[:, :, free]
    weighted = np.linalg.solve(noise.covariances, rows) * noise.weights[:, None, None]
    parts = np.einsum("nik,nil->nkl", rows, weighted)
    rights = -np.einsum("nik,ni->nk", weighted, views.pseudo_measurement)
    prior = views.prior[np.ix_(free, free)]
    right = rights.sum(axis=0) - prior @ views.off[free]
    return NormalEquations(views, noise, parts.sum(axis=0) + prior, right, parts, rights, free)


class State(Protocol):
    """Unknowns on a manifold."""

    def plus(self, step: Array) -> Self:
        """Moved by (m,) of all unknowns."""
        ...


S = TypeVar("S", bound=State)
#: All views linear at a state, with these weights of the corners of each (None: 1); and how far off each
#: corner is, in standard deviations of one coordinate.
Linear = Callable[[S, Sequence[Array] | None], tuple[LinearViews, Sequence[Array]]]


def fit_views(linear: Linear[S], state: S, free: NDArray[np.int64]) -> tuple[S, NormalEquations]:
    """The unknowns that all views agree on, by Levenberg and Marquardt's method with robust weights.

    Args:
        linear: The views.
        state: To start from.
        free: (f,) indices of the unknowns that are sought.

    Returns:
        The solution, and the normal equations there.
    """
    corners: list[Array] | None = None
    noise: ArmNoise | None = None
    damping = _FIRST_DAMPING
    for _ in range(_ITERATIONS):
        views, residuals = linear(state, corners)
        noise = estimate_noise(views, free, noise)
        normal = normal_equations(views, noise, free)
        step, damping = _descent_step(linear, state, corners, normal, damping)
        weighted, state, corners = (
            corners is not None,
            state.plus(step),
            [cauchy_weight(m) for m in residuals],
        )
        # A start may be the solution with all corners alike.
        if weighted and np.abs(step).max() < _DONE:
            break
    return state, normal


def _descent_step(
    linear: Linear[S],
    state: S,
    corners: list[Array] | None,
    normal: NormalEquations,
    damping: float,
) -> tuple[Array, float]:
    """A step that lowers the cost, and the damping for the next one; zeros where none does."""
    now = normal.views.cost(normal.noise)
    for _ in range(_TRIES):
        step = normal.step(damping)
        if np.abs(step).max() < _SMALL:
            return step, damping
        there, _ = linear(state.plus(step), corners)
        if there.cost(normal.noise) < now:
            return step, max(0.1 * damping, _FIRST_DAMPING)
        damping = 10.0 * max(damping, 1e-6)
    return np.zeros_like(step), damping


def cauchy_weight(residuals: Array) -> Array:
    """Weights of residuals in standard deviations: 1 at 0, 95 % efficient on Gaussian noise (c = 2.385)."""
    return np.asarray(1.0 / (1.0 + (residuals / 2.385) ** 2))


def estimate_noise(
    views: LinearViews, free: NDArray[np.int64], before: ArmNoise | None = None
) -> ArmNoise:
    """The sizes of the arm's error, by restricted maximum likelihood, and the weight of each view, in turns.

    Restricted: the unknowns are fitted to the same views, so plain maximum likelihood would find the arm
    better than it is.  Source: Patterson & Thompson, Recovery of inter-block information when block sizes are
    unequal, Biometrika 58(3), 1971.  Weights are those of a multivariate Student's t (Lange, Little &
    Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84, 1989).

    ``views`` are linear at the solution so far, ``before`` is that of an earlier round, to start from.
    """
    weights = _first_weights(views) if before is None else before.weights
    for _ in range(_ROUNDS if before is None else 1):
        sizes = _most_likely(views, free, weights, before)
        covariances = views.covariances(sizes)
        step = normal_equations(views, ArmNoise(sizes, covariances, weights), free).step()
        rest = views.pseudo_measurement + views.rows @ step
        squares = np.einsum("ni,ni->n", rest, np.linalg.solve(covariances, rest[..., None])[..., 0])
        weights = np.minimum(1.0, (_FREEDOM + _TWIST) / (_FREEDOM + squares))
        before = ArmNoise(sizes, covariances, weights)
    if before is None:
        raise RuntimeError("no round of the fit was made")
    return before


def _first_weights(views: LinearViews) -> Array:
    """Views that are far off in the middle view's measure begin with little weight."""
    off = np.abs(views.pseudo_measurement)
    scale = np.maximum(1.4826 * np.median(off, axis=0), 1e-12)
    return np.asarray(np.maximum(1.0, (off / scale).max(axis=1) / 4.0) ** -2.0)


def _most_likely(
    views: LinearViews, free: NDArray[np.int64], weights: Array, near: ArmNoise | None
) -> Array:
    """Sizes (k,) with the highest restricted likelihood, on a grid that is refined."""
    count = len(views.sources)
    grids = [_SIZES] * count if near is None else [size * _NEARBY for size in near.sizes]
    for _ in range(_ZOOMS):
        candidates = np.array(list(itertools.product(*grids)))
        best = candidates[int(np.argmax(_likelihood(views, free, weights, candidates)))]
        grids = [
            size * np.sqrt(grid[1] / grid[0]) ** np.array([-1.0, 0.0, 1.0])
            for size, grid in zip(best, grids, strict=True)
        ]
    return np.maximum(best, _SIZES[0])


def _likelihood(views: LinearViews, free: NDArray[np.int64], weights: Array, sizes: Array) -> Array:
    """Restricted log-likelihood (c,) of candidates (c, k).

    The weights are given here, so their share of the determinants is the same everywhere.
    """
    rows, prior, off = views.rows[:, :, free], views.prior[np.ix_(free, free)], views.off[free]
    covariances = views.covariances(sizes)  # (c, n, 6, 6)
    inverses = np.linalg.inv(covariances) * weights[:, None, None]
    flat, measured = rows.reshape(-1, len(free)), views.pseudo_measurement.reshape(-1)
    normal = flat.T @ (inverses @ rows).reshape(len(sizes), -1, len(free)) + prior
    weighted = (inverses @ views.pseudo_measurement[..., None]).reshape(len(sizes), -1)
    scaled, scale = _balanced(normal, _NOTHING)
    right = (weighted @ flat + prior @ off) / scale
    fitted = np.linalg.solve(scaled, right[..., None])[..., 0]
    squares = weighted @ measured - np.sum(right * fitted, axis=1)
    logs = np.linalg.slogdet(covariances)[1].sum(axis=1) + np.linalg.slogdet(scaled)[1]
    return np.asarray(-0.5 * (logs + squares) - np.log(scale).sum(axis=1))


def _balanced(matrix: Array, more: float = 0.0) -> tuple[Array, Array]:
    """A matrix (..., f, f) in units in which its diagonal is 1, ``more`` added to that; and the units."""
    scale = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    scaled = matrix / (scale[..., :, None] * scale[..., None, :])
    return scaled + more * np.eye(matrix.shape[-1]), scale


def inverse(matrix: Array) -> Array:
    """Of a positive matrix whose unknowns have other units and may hardly be determined."""
    scaled, scale = _balanced(matrix)
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-14, hermitian=True) / np.outer(scale, scale))
