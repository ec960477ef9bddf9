"""Least squares of hand-eye calibration and joint zeros, with errors of pixels and of the arm.

Each view is reduced to the twist of the hand that fits its picture best, e_i (6,). A step x of the
unknowns changes it to e_i + A_i x, with an error of covariance P_i + sum_k s_k^2 G_ki. P_i is the
known covariance from the pixels. G_ki is the covariance of a source of the arm's error (position
and angle of the hand, or its joints). The size s_k of a source is the same for all views and is
estimated by restricted maximum likelihood. A view that contradicts the others has less weight.
Prior knowledge of the unknowns enters with its covariance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array

# Sizes of the arm's error that are tried first, metres or rad: from far better than servos to a
# loose mounting. Then factors of the last size.
_SIZES = np.geomspace(1e-7, 5e-2, 10)
_NEAR_FACTORS = np.geomspace(0.4, 2.5, 3)
# Number of refinements of the grid of sizes.
_ZOOMS = 5
# A view that the others contradict by more than this many standard deviations (of 6 numbers: 1 view
# in 10^6) is an outlier, if the error is also more than print and lens explain.
_OUTLIER_SIGMAS = 6.4
# Degrees of freedom of Student's t: Gaussian views lose little weight, a wrong one nearly all.
_FREEDOM = 5.0
# Numbers of a twist.
_TWIST = 6
# Rounds of sizes and weights in the first estimate.
_ROUNDS = 3
# Of the fit: rounds, trials for a step that lowers the cost, and dampings.
_MAX_ROUNDS = 30
_MAX_TRIALS = 8
_FIRST_DAMPING = 1e-9
_MIN_TRIAL_DAMPING = 1e-6
# The fit ends with a step smaller than this, rad or metres.
_STEP_TOLERANCE = 1e-7
# A smaller step is linear and is not tried first, rad or metres.
_LINEAR_STEP = 1e-3
# A prior without weight. It keeps the fit regular where the views contain no information.
_NO_PRIOR = 1e-9
# Scale of Cauchy's weights: 95 % efficient on Gaussian noise, standard deviations.
_CAUCHY = 2.385


@dataclass(frozen=True, eq=False)
class LinearViews:
    """All views, linear at one state, and the prior of the m unknowns.

    Attributes:
        pseudo_measurement: (n, 6) twist of the hand, in its axes, that fits each picture best.
        pixels: (n, 6, 6) its covariance from the noise of the corners alone.
        rows: (n, 6, m) its derivative with respect to the unknowns.
        sources: (k, n, 6, 6) its covariance from each source of the arm's error, of size 1.
        prior: (m, m) information on the unknowns.
        prior_error: (m,) unknowns minus their prior means.
    """

    pseudo_measurement: Array
    pixels: Array
    rows: Array
    sources: Array
    prior: Array
    prior_error: Array

    def covariances(self, sizes: Array) -> Array:
        """Return the covariances (..., n, 6, 6) of pixels and arm for sizes (..., k)."""
        return np.asarray(self.pixels + np.tensordot(sizes**2, self.sources, 1))

    def cost(self, noise: ArmNoise) -> float:
        """Return the cost with fixed noise: squares of the views and of the prior."""
        weighted = np.linalg.solve(noise.covariances, self.pseudo_measurement[..., None])[..., 0]
        squares = noise.weights * np.einsum("ni,ni->n", self.pseudo_measurement, weighted)
        return float(squares.sum() + self.prior_error @ self.prior @ self.prior_error)


@dataclass(frozen=True, eq=False)
class ArmNoise:
    """Errors of the arm from view to view, and the weights of the views.

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
    """One view compared with the fit to all others.

    Attributes:
        step: (m,) step of the unknowns to the fit without the view.
        pseudo_measurement: (6,) twist that fits the picture best after this step.
        covariance: (6, 6) expected covariance of the twist.
        sigmas: Its length in standard deviations.
    """

    step: Array
    pseudo_measurement: Array
    covariance: Array
    sigmas: float

    @property
    def contradicts(self) -> bool:
        """Whether the view contradicts the others."""
        return self.sigmas > _OUTLIER_SIGMAS


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the free unknowns.

    Attributes:
        views: The views.
        noise: Errors of the arm and weights of the views.
        matrix: (f, f) with the prior.
        right: (f,) right side.
        parts: (n, f, f) matrix of each view.
        rights: (n, f) right side of each view.
        free: (f,) indices of the free unknowns.
    """

    views: LinearViews
    noise: ArmNoise
    matrix: Array
    right: Array
    parts: Array
    rights: Array
    free: NDArray[np.int64]

    def step(self, damping: float = 0.0) -> Array:
        """Return the step (m,), damped (Levenberg-Marquardt); 0 for unknowns that are not free."""
        scaled, scale = _balanced(self.matrix, damping)
        return self._with_fixed(np.linalg.lstsq(scaled, self.right / scale, rcond=1e-15)[0] / scale)

    @property
    def covariance(self) -> Array:
        """Covariance (m, m); zeros for unknowns that are not free."""
        return self._spread_out(inverse(self.matrix))

    def moved_by(self, errors: Array) -> Array:
        """Return the error (m,) of the unknowns that ``errors`` (n, 6) of the twists cause."""
        weighted = np.linalg.solve(self.noise.covariances, errors[..., None])[..., 0]
        by_view = np.einsum("nik,ni->nk", self.views.rows, weighted)
        return np.asarray(self.covariance @ (self.noise.weights @ by_view))

    def left_out(self, view: int) -> LeftOut:
        """Compare one view with the fit to all others."""
        _, scale = _balanced(self.matrix)
        outer = np.outer(scale, scale)
        others = (self.matrix - self.parts[view]) / outer + _NO_PRIOR * np.eye(len(scale))
        covariance = np.linalg.inv(others) / outer
        step = self._with_fixed(covariance @ (self.right - self.rights[view]))
        rows = self.views.rows[view]
        residual = self.views.pseudo_measurement[view] + rows @ step
        expected = self.noise.covariances[view] + rows @ self._spread_out(covariance) @ rows.T
        sigmas = float(np.sqrt(max(residual @ np.linalg.solve(expected, residual), 0.0)))
        return LeftOut(step, residual, expected, sigmas)

    def _with_fixed(self, step: Array) -> Array:
        """Return the step (m,) of all unknowns for a step (f,) of the free unknowns."""
        full = np.zeros(len(self.views.prior_error))
        full[self.free] = step
        return full

    def _spread_out(self, matrix: Array) -> Array:
        """Return the matrix (m, m) of all unknowns for a matrix (f, f) of the free unknowns."""
        count = len(self.views.prior_error)
        full = np.zeros((count, count))
        full[np.ix_(self.free, self.free)] = matrix
        return full


def normal_equations(
    views: LinearViews, noise: ArmNoise, free: NDArray[np.int64]
) -> NormalEquations:
    """Return the normal equations of weighted least squares.

    Args:
        views: The views.
        noise: Errors of the arm and weights of the views.
        free: (f,) indices of the free unknowns.
    """
    rows = views.rows[:, :, free]
    weighted = np.linalg.solve(noise.covariances, rows) * noise.weights[:, None, None]
    parts = np.einsum("nik,nil->nkl", rows, weighted)
    rights = -np.einsum("nik,ni->nk", weighted, views.pseudo_measurement)
    prior = views.prior[np.ix_(free, free)]
    right = rights.sum(axis=0) - prior @ views.prior_error[free]
    return NormalEquations(views, noise, parts.sum(axis=0) + prior, right, parts, rights, free)


class State(Protocol):
    """Unknowns on a manifold."""

    def plus(self, step: Array) -> Self:
        """Return the state moved by a step (m,)."""
        ...


S = TypeVar("S", bound=State)
#: Linearises all views at a state, with weights of the corners of each (None: 1). Returns also the
#: error of each corner, in standard deviations of one coordinate.
Linear = Callable[[S, Sequence[Array] | None], tuple[LinearViews, Sequence[Array]]]


def fit_views(linear: Linear[S], state: S, free: NDArray[np.int64]) -> tuple[S, NormalEquations]:
    """Fit the unknowns by Levenberg-Marquardt with robust weights.

    Args:
        linear: Linearises the views.
        state: First value.
        free: (f,) indices of the free unknowns.

    Returns:
        The solution, and the normal equations there.
    """
    corners: list[Array] | None = None
    noise: ArmNoise | None = None
    damping = _FIRST_DAMPING
    for _ in range(_MAX_ROUNDS):
        views, residuals = linear(state, corners)
        noise = estimate_noise(views, free, noise)
        normal = normal_equations(views, noise, free)
        step, damping = _descent_step(linear, state, corners, normal, damping)
        state = state.plus(step)
        is_weighted = corners is not None
        corners = [cauchy_weight(m) for m in residuals]
        # A start may be the solution with equal weights.
        if is_weighted and np.abs(step).max() < _STEP_TOLERANCE:
            break
    return state, normal


def _descent_step(
    linear: Linear[S],
    state: S,
    corners: list[Array] | None,
    normal: NormalEquations,
    damping: float,
) -> tuple[Array, float]:
    """Return a step that lowers the cost, or zeros, and the damping of the next one."""
    cost = normal.views.cost(normal.noise)
    for _ in range(_MAX_TRIALS):
        step = normal.step(damping)
        if np.abs(step).max() < _LINEAR_STEP:
            return step, damping
        moved, _ = linear(state.plus(step), corners)
        if moved.cost(normal.noise) < cost:
            return step, max(0.1 * damping, _FIRST_DAMPING)
        damping = 10.0 * max(damping, _MIN_TRIAL_DAMPING)
    return np.zeros_like(step), damping


def cauchy_weight(residuals: Array) -> Array:
    """Return Cauchy's weights of errors in standard deviations: 1 at 0."""
    return np.asarray(1.0 / (1.0 + (residuals / _CAUCHY) ** 2))


def estimate_noise(
    views: LinearViews, free: NDArray[np.int64], before: ArmNoise | None = None
) -> ArmNoise:
    """Estimate the sizes of the arm's error and the weights of the views, alternately.

    Plain maximum likelihood would find an arm that is too accurate, because the unknowns are fitted
    to the same views. Restricted likelihood corrects that. Source: Patterson & Thompson, Recovery
    of inter-block information when block sizes are unequal, Biometrika 58(3), 1971. Weights are
    those of a multivariate Student's t (Lange, Little & Taylor, Robust Statistical Modeling Using
    the t Distribution, JASA 84, 1989).

    Args:
        views: Views, linear at the solution so far.
        free: (f,) indices of the free unknowns.
        before: Estimate of an earlier round to start from.
    """
    weights = _first_weights(views) if before is None else before.weights
    for _ in range(_ROUNDS if before is None else 1):
        sizes = _most_likely(views, free, weights, before)
        covariances = views.covariances(sizes)
        step = normal_equations(views, ArmNoise(sizes, covariances, weights), free).step()
        residuals = views.pseudo_measurement + views.rows @ step
        weighted = np.linalg.solve(covariances, residuals[..., None])[..., 0]
        squares = np.einsum("ni,ni->n", residuals, weighted)
        weights = np.minimum(1.0, (_FREEDOM + _TWIST) / (_FREEDOM + squares))
        before = ArmNoise(sizes, covariances, weights)
    if before is None:
        raise RuntimeError("no round of the fit was made")
    return before


def _first_weights(views: LinearViews) -> Array:
    """Return small weights for views whose errors are far larger than the median."""
    size = np.abs(views.pseudo_measurement)
    scale = np.maximum(1.4826 * np.median(size, axis=0), 1e-12)
    return np.asarray(np.maximum(1.0, (size / scale).max(axis=1) / 4.0) ** -2.0)


def _most_likely(
    views: LinearViews, free: NDArray[np.int64], weights: Array, near: ArmNoise | None
) -> Array:
    """Return the sizes (k,) of the highest restricted likelihood, on a refined grid."""
    count = len(views.sources)
    grids = [_SIZES] * count if near is None else [size * _NEAR_FACTORS for size in near.sizes]
    for _ in range(_ZOOMS):
        candidates = np.array(list(itertools.product(*grids)))
        best = candidates[int(np.argmax(_likelihood(views, free, weights, candidates)))]
        grids = [
            size * np.sqrt(grid[1] / grid[0]) ** np.array([-1.0, 0.0, 1.0])
            for size, grid in zip(best, grids, strict=True)
        ]
    return np.maximum(best, _SIZES[0])


def _likelihood(views: LinearViews, free: NDArray[np.int64], weights: Array, sizes: Array) -> Array:
    """Return the restricted log-likelihood (c,) of candidates (c, k).

    The weights are fixed, so their share of the determinants is the same for all candidates.
    """
    rows = views.rows[:, :, free]
    prior = views.prior[np.ix_(free, free)]
    prior_error = views.prior_error[free]
    covariances = views.covariances(sizes)
    inverses = np.linalg.inv(covariances) * weights[:, None, None]
    flat = rows.reshape(-1, len(free))
    measured = views.pseudo_measurement.reshape(-1)
    normal = flat.T @ (inverses @ rows).reshape(len(sizes), -1, len(free)) + prior
    weighted = (inverses @ views.pseudo_measurement[..., None]).reshape(len(sizes), -1)
    scaled, scale = _balanced(normal, _NO_PRIOR)
    right = (weighted @ flat + prior @ prior_error) / scale
    fitted = np.linalg.solve(scaled, right[..., None])[..., 0]
    squares = weighted @ measured - np.sum(right * fitted, axis=1)
    logs = np.linalg.slogdet(covariances)[1].sum(axis=1) + np.linalg.slogdet(scaled)[1]
    return np.asarray(-0.5 * (logs + squares) - np.log(scale).sum(axis=1))


def _balanced(matrix: Array, more: float = 0.0) -> tuple[Array, Array]:
    """Return a matrix (..., f, f) scaled to a diagonal of 1, plus ``more``, and the scale."""
    scale = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    scaled = matrix / (scale[..., :, None] * scale[..., None, :])
    return scaled + more * np.eye(matrix.shape[-1]), scale


def inverse(matrix: Array) -> Array:
    """Return the inverse of a positive definite matrix whose unknowns have different units."""
    scaled, scale = _balanced(matrix)
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-14, hermitian=True) / np.outer(scale, scale))
