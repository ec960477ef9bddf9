"""How well the arm knows its own poses, judged by the views; and the fit that takes it into account.

Each view wishes for a twist of the hand, e_i, that differs from what camera and board would account for,
-R_i d, by the error of its pixels (covariance P_i, known) and by the arm's (position and angle, unknown).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from robot_ik.camera.calibration.handeye import Compressed
    from robot_ik.camera.calibration.kinematic import Linear

Array = NDArray[np.float64]

# Searched: metres and rad, from far better than servos to a thing that is loose.
_POSITIONS = np.geomspace(1e-6, 2e-2, 9)
_ANGLES = np.geomspace(1e-6, 5e-2, 9)
_NEARBY_ARM = np.geomspace(0.4, 2.5, 3)
_ZOOMS_ARM = 5
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
        pseudo_measurement: (6,) what the view left out still wishes for then.
        sigmas: Its length in standard deviations.
    """

    step: Array
    pseudo_measurement: Array
    sigmas: float


def fit_shared(data: Compressed, noise: ArmNoise) -> Fit:
    """Generalised least squares over all views."""
    weighted = np.linalg.solve(noise.covariances, data.by_shared)  # (n, 6, 12)
    normals = np.einsum("nik,nil->nkl", data.by_shared, weighted)
    rights = -np.einsum("nik,ni->nk", weighted, data.pseudo_measurement)
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
    pseudo_measurement = data.pseudo_measurement[view] + rows @ step
    expected = noise.covariances[view] * noise.weights[view] + rows @ covariance @ rows.T
    return Without(
        step,
        pseudo_measurement,
        float(np.sqrt(pseudo_measurement @ np.linalg.solve(expected, pseudo_measurement))),
    )


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
        rest = data.pseudo_measurement + data.by_shared @ fit_shared(data, noise).step
        squares = np.einsum("ni,ni->n", rest, np.linalg.solve(covariances, rest[..., None])[..., 0])
        again = np.minimum(1.0, (_FREEDOM + 6.0) / (_FREEDOM + squares))
        noise = ArmNoise(position, angle, covariances / again[:, None, None], again)
        weights, before = again, noise
    return noise


def _first_weights(data: Compressed) -> Array:
    """Views that are far off in the middle view's measure begin with little weight."""
    scale = np.maximum(1.4826 * np.median(np.abs(data.pseudo_measurement), axis=0), 1e-12)
    return np.asarray(1.0 / np.maximum(1.0, (np.abs(data.pseudo_measurement) / scale).max(axis=1) / 4.0) ** 2)


def _most_likely(
    data: Compressed, pixels: Array, weights: Array, near: ArmNoise | None
) -> tuple[float, float]:
    """Position and angle with the highest restricted likelihood, on a grid that is refined."""
    if near is None:
        positions, angles = _POSITIONS, _ANGLES
    else:
        positions, angles = near.position * _NEARBY_ARM, near.angle * _NEARBY_ARM
    for _ in range(_ZOOMS_ARM):
        pairs = np.array([(p, a) for p in positions for a in angles])
        best = pairs[int(np.argmax(_arm_likelihood(data, pixels, weights, pairs)))]
        factor = np.sqrt(positions[1] / positions[0]), np.sqrt(angles[1] / angles[0])
        positions = best[0] * factor[0] ** np.array([-1.0, 0.0, 1.0])
        angles = best[1] * factor[1] ** np.array([-1.0, 0.0, 1.0])
    return float(max(best[0], _POSITIONS[0])), float(max(best[1], _ANGLES[0]))


def _arm_likelihood(data: Compressed, pixels: Array, weights: Array, pairs: Array) -> Array:
    """Restricted log-likelihood (m,) of pairs (m, 2) of position and angle.

    The weights are given here, so their share of the determinants is the same everywhere.
    """
    arm = np.repeat(pairs**2, 3, axis=1)[:, :, None] * np.eye(6)
    covariances = (pixels + arm[:, None]) / weights[:, None, None]  # (m, n, 6, 6)
    inverse = np.linalg.inv(covariances)
    rows, pseudo_measurement = data.by_shared.reshape(-1, 12), data.pseudo_measurement.reshape(-1)
    normal = rows.T @ (inverse @ data.by_shared).reshape(len(pairs), -1, 12)
    weighted = (inverse @ data.pseudo_measurement[..., None]).reshape(len(pairs), -1)
    right = weighted @ rows
    fitted = np.linalg.solve(normal, right[..., None])[..., 0]
    squares = weighted @ pseudo_measurement - np.sum(right * fitted, axis=1)
    logs = np.linalg.slogdet(covariances)[1].sum(axis=1) + np.linalg.slogdet(normal)[1]
    return np.asarray(-0.5 * (logs + squares))


# ------------------------------------------------------------------------------------------
# Least squares over views of an arm whose joints are not exact either; how much, the views tell.
#
# In each view every joint is off by its own small error (ticks, play), all of one size, which is estimated by
# restricted maximum likelihood as in ``handeye_noise``; a view that contradicts the others counts less.


# Searched: rad at each joint, from nothing to a loose gear.
_SIZES = np.geomspace(1e-7, 3e-2, 12)
_NEARBY_JOINT = np.geomspace(0.5, 2.0, 3)
_ZOOMS_JOINT = 4
# Student's t with so many degrees of freedom: Gaussian views lose little, a wrong one hardly counts.
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
    rights = -np.einsum("nik,ni->nk", weighted, linear.pseudo_measurement)
    prior = linear.prior[np.ix_(free, free)]
    right = rights.sum(axis=0) - prior @ linear.off[free]
    return Normal(parts.sum(axis=0) + prior, right, parts, rights, free, len(linear.off))


def cost(linear: Linear, noise: JointNoise) -> float:
    """What is minimised, with the noise held: squares of the views and of what was known before."""
    weighted = np.linalg.solve(noise.covariances, linear.pseudo_measurement[..., None])[..., 0]
    squares = noise.weights * np.einsum("ni,ni->n", linear.pseudo_measurement, weighted)
    return float(squares.sum() + linear.off @ linear.prior @ linear.off)


def estimate_joint_noise(linear: Linear, free: NDArray[np.int64], before: JointNoise | None) -> JointNoise:
    """Size of the joints' error, then the weights of the views; one turn of each."""
    n = len(linear.pseudo_measurement)
    if before is None:
        scale = np.maximum(1.4826 * np.median(np.abs(linear.pseudo_measurement), axis=0), 1e-12)
        far = (np.abs(linear.pseudo_measurement) / scale).max(axis=1) / 4.0
        weights = np.maximum(1.0, far) ** -2.0
    else:
        weights = before.weights
    sizes = _SIZES if before is None else max(before.size, _SIZES[0]) * _NEARBY_JOINT
    for _ in range(_ZOOMS_JOINT):
        best = sizes[int(np.argmax([_joint_likelihood(linear, free, weights, size) for size in sizes]))]
        factor = np.sqrt(sizes[1] / sizes[0])
        sizes = best * factor ** np.array([-1.0, 0.0, 1.0])
    covariances = linear.pixels + best**2 * linear.arm
    noise = JointNoise(float(best), covariances, weights)
    rest = linear.pseudo_measurement + linear.rows @ normal_equations(linear, noise, free).step()
    squares = np.einsum("ni,ni->n", rest, np.linalg.solve(covariances, rest[..., None])[..., 0])
    again = np.minimum(1.0, (_FREEDOM + _TWIST) / (_FREEDOM + squares))
    return JointNoise(float(best), covariances, again if n > 1 else np.ones(n))


def inverse(matrix: Array) -> Array:
    """Of a positive matrix whose unknowns have other units and may hardly be determined."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    outer = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(matrix / outer, rcond=1e-14, hermitian=True) / outer)


def _joint_likelihood(linear: Linear, free: NDArray[np.int64], weights: Array, size: float) -> float:
    """Restricted log-likelihood of a size of the joints' error."""
    noise = JointNoise(size, linear.pixels + size**2 * linear.arm, weights)
    normal = normal_equations(linear, noise, free)
    squares = cost(linear, noise) - normal.right @ normal.step()[free]
    logs = np.linalg.slogdet(noise.covariances)[1].sum() + np.linalg.slogdet(normal.matrix)[1]
    return -0.5 * float(logs + squares)


# ------------------------------------------------------------------------------------------
# Which joint offsets the views cannot tell from each other or from the camera's and the board's places.
#
# Source: Hollerbach & Wampler, The calibration index and taxonomy for robot kinematic calibration methods,
# Int. J. Robotics Research 15(6), 1996; the singular values of the information matrix are the measure there.


# Parts of a direction that are smaller than this share of its largest are not mentioned.
_SHARE = 0.25
# A translation that goes with a degree of the joints and is shorter is not mentioned, metres a rad.
_LEVER = 0.02


@dataclass(frozen=True, eq=False)
class Unobservable:
    """A combination of joint offsets that the views do not determine.

    Attributes:
        joint: The one that is held at 0 for it.
        direction: (nv,) the combination, of length 1.
        sigma: Its standard deviation, rad; infinite where the views say nothing at all.
        words: What cannot be told apart, for people.
    """

    joint: str
    direction: Array
    sigma: float
    words: str


def joint_information(normal: Normal, joints: int) -> tuple[Array, Array, Array]:
    """What is known of the joints' offsets when the poses have taken the share that they can.

    Args:
        normal: With what is known of the poses beforehand, so that these are determined in any case.
        joints: How many unknowns are joints; the first of the free ones are.

    Returns:
        Singular values, 1/rad^2, the largest first; directions as columns; (poses, joints): how the poses
        go along with each joint without the views noticing.
    """
    h = normal.matrix
    count = int(np.sum(normal.free < joints))
    along = -inverse(h[count:, count:]) @ h[count:, :count]
    information = h[:count, :count] + h[:count, count:] @ along
    _, values, rows = np.linalg.svd(0.5 * (information + information.T), hermitian=True)
    return values, rows.T, along


def find_unobservable(
    normal: Normal, names: Sequence[str], unclear: float, parent: str, other: str
) -> Unobservable | None:
    """The worst determined combination of offsets, if its standard deviation is beyond ``unclear`` rad.

    Args:
        normal: At the answer.
        names: Of all joints.
        unclear: Largest standard deviation that counts as told apart.
        parent: What the camera is seen from.
        other: What the board is seen from.
    """
    values, directions, along = joint_information(normal, len(names))
    if len(values) == 0 or values[-1] >= unclear**-2:
        return None
    free = [names[k] for k in normal.free if k < len(names)]
    v = directions[:, -1] * np.sign(directions[int(np.argmax(np.abs(directions[:, -1]))), -1])
    whole = np.zeros(len(names))
    whole[normal.free[: len(free)]] = v
    known = values[-1] > 1e-12 * values[0] and values[-1] > 1e-6
    held = free[int(np.argmax(np.abs(v)))]
    return Unobservable(
        held, whole, float(values[-1] ** -0.5) if known else np.inf,
        _words(free, v, along @ v, parent, other),
    )  # fmt: skip


def _words(free: Sequence[str], v: Array, poses: Array, parent: str, other: str) -> str:
    big = np.abs(v) >= _SHARE * np.abs(v).max()
    order = [int(k) for k in np.argsort(-np.abs(v), kind="stable") if big[k]]
    parts = [f"the offset of {free[k]}" for k in order]
    for thing, seen_from, twist in (("camera", parent, poses[:6]), ("board", other, poses[6:])):
        turn, shift = float(np.linalg.norm(twist[3:])), float(np.linalg.norm(twist[:3]))
        if turn >= _SHARE:
            parts.append(f"the turn of the {thing} about {_axis(twist[3:])} of {seen_from}")
        elif shift >= _LEVER:
            parts.append(f"the shift of the {thing} along {_axis(twist[:3])} of {seen_from}")
    if len(parts) == 1:
        return f"{parts[0]} does not show in these views"
    return f"{', '.join(parts[:-1])} and {parts[-1]} look the same"


def _axis(vector: Array) -> str:
    """``z``, or the components of a direction that is along no axis."""
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > 0.98:
        return "xyz"[k]
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in unit) + ")"
