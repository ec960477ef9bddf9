"""How well the arm knows its own poses, judged by the views; and the fit that takes it into account.

Each view wishes for a twist of the hand, e_i, that differs from what camera and board would account for,
-R_i d, by the error of its pixels (covariance P_i, known) and by the arm's (position and angle, unknown).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.handeye.model import Compressed

Array = NDArray[np.float64]

# Searched: metres and rad, from far better than servos to a thing that is loose.
_POSITIONS = np.geomspace(1e-6, 2e-2, 9)
_ANGLES = np.geomspace(1e-6, 5e-2, 9)
_NEARBY = np.geomspace(0.4, 2.5, 3)
_ZOOMS = 5
# Student's t with so many degrees of freedom: Gaussian views lose little, a wrong one hardly counts.
_FREEDOM = 5.0
_ROUNDS = 3
# A prior that weighs as much as nothing: keeps the fit solvable when a view is left out of the fewest.
_NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class ArmNoise:
    """Standard deviations of one axis of the hand's pose, and how the views are believed.

    Attributes:
        position, angle: Metres, rad.
        covariances: (n, 6, 6) of the wishes: pixels and arm together, divided by the weight of the view.
        weights: (n,) around 1; near 0 for a view that contradicts the others.
    """

    position: float
    angle: float
    covariances: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Step (12,) of camera and board, its covariance (12, 12), and the parts it is summed from.

    Attributes:
        normals: (n, 12, 12); ``rights``: (n, 12).
    """

    step: Array
    covariance: Array
    normals: Array
    rights: Array


@dataclass(frozen=True, eq=False)
class Without:
    """What all views but one say.

    Attributes:
        step: (12,) of camera and board.
        wish: (6,) what the view left out still wishes for then.
        sigmas: Its length in standard deviations.
    """

    step: Array
    wish: Array
    sigmas: float


def fit_shared(data: Compressed, noise: ArmNoise) -> Fit:
    """Generalised least squares over all views."""
    weighted = np.linalg.solve(noise.covariances, data.by_shared)  # (n, 6, 12)
    normals = np.einsum("nik,nil->nkl", data.by_shared, weighted)
    rights = -np.einsum("nik,ni->nk", weighted, data.wish)
    covariance = np.linalg.pinv(normals.sum(axis=0), rcond=1e-15, hermitian=True)
    return Fit(covariance @ rights.sum(axis=0), covariance, normals, rights)


def fit_without(data: Compressed, noise: ArmNoise, fit: Fit, view: int) -> Without:
    """The fit that does not know one view, and how that view contradicts it."""
    normal = fit.normals.sum(axis=0) - fit.normals[view]
    scale = np.sqrt(np.maximum(np.diag(fit.normals.sum(axis=0)), 1e-300))
    covariance = np.linalg.inv(normal / np.outer(scale, scale) + _NOTHING * np.eye(12))
    covariance = covariance / np.outer(scale, scale)
    step = covariance @ (fit.rights.sum(axis=0) - fit.rights[view])
    rows = data.by_shared[view]
    wish = data.wish[view] + rows @ step
    expected = noise.covariances[view] * noise.weights[view] + rows @ covariance @ rows.T
    return Without(step, wish, float(np.sqrt(wish @ np.linalg.solve(expected, wish))))


def estimate_noise(data: Compressed, pixel_scale: float, before: ArmNoise | None = None) -> ArmNoise:
    """The arm's error, by restricted maximum likelihood, and the weight of each view, in turns.

    Restricted: twelve numbers are fitted to the same views, so plain maximum likelihood would find the arm
    better than it is.  Source: Patterson & Thompson, Recovery of inter-block information when block sizes are
    unequal, Biometrika 58(3), 1971.  Weights are those of a multivariate Student's t (Lange, Little &
    Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84, 1989).

    Args:
        data: Of the views.
        pixel_scale: Standard deviation of the pixels in units of the stated one.
        before: The answer of an earlier round, to start from.
    """
    pixels = data.covariance * pixel_scale**2
    weights = _first_weights(data) if before is None else before.weights
    for _ in range(_ROUNDS if before is None else 1):
        position, angle = _most_likely(data, pixels, weights, before)
        covariances = pixels + np.diag([position**2] * 3 + [angle**2] * 3)
        noise = ArmNoise(position, angle, covariances / weights[:, None, None], weights)
        rest = data.wish + data.by_shared @ fit_shared(data, noise).step
        squares = np.einsum("ni,ni->n", rest, np.linalg.solve(covariances, rest[..., None])[..., 0])
        again = np.minimum(1.0, (_FREEDOM + 6.0) / (_FREEDOM + squares))
        noise = ArmNoise(position, angle, covariances / again[:, None, None], again)
        weights, before = again, noise
    return noise


def _first_weights(data: Compressed) -> Array:
    """Views that are far off in the middle view's measure begin with little weight."""
    scale = np.maximum(1.4826 * np.median(np.abs(data.wish), axis=0), 1e-12)
    return np.asarray(1.0 / np.maximum(1.0, (np.abs(data.wish) / scale).max(axis=1) / 4.0) ** 2)


def _most_likely(
    data: Compressed, pixels: Array, weights: Array, near: ArmNoise | None
) -> tuple[float, float]:
    """Position and angle with the highest restricted likelihood, on a grid that is refined."""
    if near is None:
        positions, angles = _POSITIONS, _ANGLES
    else:
        positions, angles = near.position * _NEARBY, near.angle * _NEARBY
    for _ in range(_ZOOMS):
        pairs = np.array([(p, a) for p in positions for a in angles])
        best = pairs[int(np.argmax(_likelihood(data, pixels, weights, pairs)))]
        factor = np.sqrt(positions[1] / positions[0]), np.sqrt(angles[1] / angles[0])
        positions = best[0] * factor[0] ** np.array([-1.0, 0.0, 1.0])
        angles = best[1] * factor[1] ** np.array([-1.0, 0.0, 1.0])
    return float(max(best[0], _POSITIONS[0])), float(max(best[1], _ANGLES[0]))


def _likelihood(data: Compressed, pixels: Array, weights: Array, pairs: Array) -> Array:
    """Restricted log-likelihood (m,) of pairs (m, 2) of position and angle.

    The weights are given here, so their share of the determinants is the same everywhere.
    """
    arm = np.repeat(pairs**2, 3, axis=1)[:, :, None] * np.eye(6)
    covariances = (pixels + arm[:, None]) / weights[:, None, None]  # (m, n, 6, 6)
    inverse = np.linalg.inv(covariances)
    rows, wish = data.by_shared.reshape(-1, 12), data.wish.reshape(-1)
    normal = rows.T @ (inverse @ data.by_shared).reshape(len(pairs), -1, 12)
    weighted = (inverse @ data.wish[..., None]).reshape(len(pairs), -1)
    right = weighted @ rows
    fitted = np.linalg.solve(normal, right[..., None])[..., 0]
    squares = weighted @ wish - np.sum(right * fitted, axis=1)
    logs = np.linalg.slogdet(covariances)[1].sum(axis=1) + np.linalg.slogdet(normal)[1]
    return np.asarray(-0.5 * (logs + squares))
