"""Hand-eye calibration: where a camera is that the arm carries, or that watches a board carried by the arm.

A start from the motions alone (AX = XB), then a fit of all corners of all pictures (``solve_handeye``).

Frames: the *parent* carries the camera, the *other* carries the board, and one of the two is the arm's hand:

* eye in hand: parent = hand, other = world; ``pose_parent_other`` = inverse of ``pose_world_hand``,
* eye to hand: parent = world, other = hand; ``pose_parent_other`` = ``pose_world_hand``.

In both, ``pose_camera_board`` = inverse(X) M Y with X = ``pose_parent_camera``, M = ``pose_parent_other``,
Y = ``pose_other_board``.  Twists are translation (m) over rotation (rad).  Those of X and Y are along the
axes of parent and other, the rotation about the origin of camera and board; that of the hand is in its axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from robot_ik.camera.calibration.least_squares import (
    LeftOut,
    LinearViews,
    cauchy_weight,
    fit_views,
)
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import Observation
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose, quat_multiply, rotation_log
from robot_ik.ports import Array

Mounting = Literal["eye_in_hand", "eye_to_hand"]
MOUNTINGS: tuple[Mounting, ...] = ("eye_in_hand", "eye_to_hand")

# Nearer than this (or behind) there is no picture; the derivative is taken here instead, metres.
_NEAREST = 1e-3


@dataclass(frozen=True, eq=False)
class HandEyeSample:
    """The arm stood still, by its own account with the hand at ``pose_world_hand``, and saw the board."""

    pose_world_hand: Pose
    view: Observation

    def pose_parent_other(self, mounting: Mounting) -> Pose:
        """M of the module's text."""
        return self.pose_world_hand.inverse() if mounting == "eye_in_hand" else self.pose_world_hand


@dataclass(frozen=True, eq=False)
class Mount:
    """The two unknowns.

    Attributes:
        pose_parent_camera: X.
        pose_other_board: Y.
        mounting: ``eye_in_hand``: parent is the hand, other the world; ``eye_to_hand``: the other way round.

    Raises:
        CalibrationError: Unknown mounting.
    """

    pose_parent_camera: Pose
    pose_other_board: Pose
    mounting: Mounting

    def __post_init__(self) -> None:
        if self.mounting not in MOUNTINGS:
            raise CalibrationError(f"unknown mounting {self.mounting!r}; known: {', '.join(MOUNTINGS)}")

    def moved(self, step: Array) -> Mount:
        """Both poses moved by twists (12,): the camera's, then the board's."""
        return Mount(
            self.pose_parent_camera.moved(step[:6]), self.pose_other_board.moved(step[6:]), self.mounting
        )

    def pose_camera_board(self, sample: HandEyeSample) -> Pose:
        """Where the board should be seen."""
        chain = sample.pose_parent_other(self.mounting).compose(self.pose_other_board)
        return self.pose_parent_camera.inverse().compose(chain)

    def pose_world_hand(self, seen: Pose) -> Pose:
        """Where the hand is when the board is ``seen`` (``pose_camera_board``)."""
        chain = self.pose_parent_camera.compose(seen).compose(self.pose_other_board.inverse())
        return chain.inverse() if self.mounting == "eye_in_hand" else chain

    def miss(self, sample: HandEyeSample, intrinsics: CameraIntrinsics) -> Array:
        """(n, 2) predicted minus seen, px; NaN behind the camera."""
        view = sample.view
        return np.asarray(intrinsics.project(self.pose_camera_board(sample).apply(view.points)) - view.pixels)


def view_derivatives(
    mount: Mount, sample: HandEyeSample, intrinsics: CameraIntrinsics
) -> tuple[Array, Array, Array]:
    """One view, linear at ``mount``.

    Returns:
        Miss (2n,) in px, its derivative (2n, 12) by the twists of camera and board, and (2n, 6) by a twist
        of the hand in the hand's axes.
    """
    x, y = mount.pose_parent_camera, mount.pose_other_board
    chain = sample.pose_parent_other(mount.mounting)
    in_other = y.apply(sample.view.points)
    in_parent = chain.apply(in_other)
    in_camera = x.inverse().apply(in_parent)
    in_camera[:, 2] = np.maximum(in_camera[:, 2], _NEAREST)
    miss = intrinsics.project(in_camera) - sample.view.pixels
    by_parent = intrinsics.point_jacobian(in_camera) @ x.rotation.T  # (n, 2, 3): pixels by points in parent
    by_other = by_parent @ chain.rotation
    n = len(in_other)
    shared = np.empty((n, 2, 12))
    shared[:, :, :3] = -by_parent
    shared[:, :, 3:6] = by_parent @ _cross(in_parent - x.position)
    shared[:, :, 6:9] = by_other
    shared[:, :, 9:] = -by_other @ _cross(in_other - y.position)
    # Eye in hand, the points of a resting board move backwards in the hand; eye to hand they go with it.
    along, at, sign = (
        (by_parent, in_parent, -1.0) if mount.mounting == "eye_in_hand" else (by_other, in_other, 1.0)
    )
    hand = np.concatenate([sign * along, -sign * along @ _cross(at)], axis=2)
    return miss.ravel(), shared.reshape(2 * n, 12), hand.reshape(2 * n, 6)


def _cross(vectors: Array) -> Array:
    """(n, 3, 3) matrices [v]x of vectors (n, 3)."""
    return np.cross(np.eye(3), vectors[:, None])


def compress(
    mount: Mount,
    samples: Sequence[HandEyeSample],
    intrinsics: CameraIntrinsics,
    weights: Sequence[Array] | None = None,
) -> tuple[LinearViews, list[Array]]:
    """All views, linear at ``mount``: n small Gaussians instead of all corners, and what is left of these.

    A change of camera or board moves a view's points exactly as some motion of the hand does.  So a view is
    summed up by the twist of the hand that it would like best, with a covariance: nothing is lost.

    ``weights`` (k,) are of the corners of each view; 1 when not given.

    Returns:
        The views, with the twists of camera and board (12,) as unknowns of which nothing is known, and no
        error of the arm; for each view (k,) how far each corner is off after that, in standard deviations.
    """
    pseudo_measurements, covariances, rows, left = [], [], [], []
    for k, sample in enumerate(samples):
        miss, shared, hand = view_derivatives(mount, sample, intrinsics)
        w = (np.ones(len(miss)) if weights is None else np.repeat(weights[k], 2)) / sample.view.sigma**2
        covariance = np.linalg.pinv(hand.T @ (w[:, None] * hand), rcond=1e-13, hermitian=True)
        pseudo_measurement = -covariance @ (hand.T @ (w * miss))
        pseudo_measurements.append(pseudo_measurement)
        covariances.append(covariance)
        rows.append(-covariance @ (hand.T @ (w[:, None] * shared)))
        rest = (miss + hand @ pseudo_measurement).reshape(-1, 2) / sample.view.sigma
        left.append(np.linalg.norm(rest, axis=1))
    views = LinearViews(
        np.array(pseudo_measurements), np.array(covariances), np.array(rows),
        np.zeros((0, len(samples), 6, 6)), np.zeros((12, 12)), np.zeros(12),
    )  # fmt: skip
    return views, left


# ------------------------------------------------------------------------------------------
# Means and spreads of rotations: what views from many sides have in common, and how many sides there are.


# Rounds of weighting again, and the least scale with which a miss is compared: metres and radians.
_AVERAGE_ROUNDS = 10
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


def robust_mean_pose(poses: Sequence[Pose]) -> Pose:
    """Mean that a minority of wrong poses hardly moves.

    Starts at the pose in the middle (least sum of distances to all others), then weights by Cauchy's
    function of the distance, in units of the median distance.
    """
    away = np.array([[one.distance(other) for other in poses] for one in poses])  # (n, n, 2)
    scale = np.maximum(np.median(away, axis=(0, 1)), _LEAST_SCALE)
    mean = poses[int(np.argmin((away / scale).sum(axis=(1, 2))))]
    for _ in range(_AVERAGE_ROUNDS):
        far = np.array([mean.distance(pose) for pose in poses])
        scale = np.maximum(_MEDIAN_TO_SIGMA * np.median(far, axis=0), _LEAST_SCALE)
        weights = cauchy_weight(np.linalg.norm(far / scale, axis=1))
        position = np.average([pose.position for pose in poses], axis=0, weights=weights)
        mean = Pose(position, mean_rotation(np.array([pose.wxyz for pose in poses]), weights))
    return mean


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


# ------------------------------------------------------------------------------------------
# An initial solution of the hand-eye problem AX = XB, and whether the motions can answer it at all.
#
# Two views i, j give A = M_i inverse(M_j), a motion known from the arm, and B = C_i inverse(C_j), the same
# motion seen by the camera; X turns one into the other.


LEAST_VIEWS = 4
#: Standard deviation of the rotations, in rad: about the axis they are spread most about, and the second.
LEAST_SPREAD = np.deg2rad((6.0, 3.0))
# Rotations by nearly half a circle have no axis that can be told from its opposite.
_LARGEST_ANGLE = np.deg2rad(170.0)
_START_ROUNDS = 8
_LEAST_ANGLE, _LEAST_LENGTH = np.deg2rad(0.05), 1e-4


def require_diversity(samples: Sequence[HandEyeSample]) -> Array:
    """Checks that the hand was turned enough, about more than one axis.

    With rotations about one axis only, the camera's position along it is free; small rotations magnify every
    error.  Source: Tsai & Lenz, A New Technique for Fully Autonomous and Efficient 3D Robotics Hand/Eye
    Calibration, IEEE Trans. Robotics and Automation 5(3), 1989, section III: the error goes with the inverse
    of the sine of the angle between the axes, and with the inverse of the angles of rotation.

    Returns:
        (3,) spread in rad, see ``rotation_spread``.

    Raises:
        CalibrationError: Too few views, or too little turning; says how much there is and is needed.
    """
    if len(samples) < LEAST_VIEWS:
        raise CalibrationError(
            f"{len(samples)} views are too few to find how a camera is mounted; {LEAST_VIEWS} are the least",
            hint="15 views, turned by 30 degrees and more about two axes and more, give a good answer",
        )
    spread = rotation_spread([sample.pose_world_hand.wxyz for sample in samples])
    first, second = np.degrees(spread[:2])
    hint = "turn the hand by 30 degrees and more to each side, about at least two axes"
    if spread[0] < LEAST_SPREAD[0]:
        raise CalibrationError(
            f"the hand was hardly turned between the views (standard deviation {first:.1f} degrees; "
            f"at least {np.degrees(LEAST_SPREAD[0]):.0f} are needed)",
            hint=hint,
        )
    if spread[1] < LEAST_SPREAD[1]:
        raise CalibrationError(
            f"the hand was turned about one axis only (standard deviation {first:.1f} degrees about it, "
            f"{second:.1f} about any other; at least {np.degrees(LEAST_SPREAD[1]):.0f} are needed), "
            "so the position of the camera along that axis cannot be known",
            hint=hint,
        )
    return spread


def start_handeye(samples: Sequence[HandEyeSample], mounting: Mounting) -> Mount:
    """Camera and board from the poses of the views, without looking at pixels.

    Rotation: the one that turns the rotation vectors of all B into those of A best.  Translation: linear
    least squares of (R_A - 1) t_X = R_X t_B - t_A.  Source: Park & Martin, Robot Sensor Calibration: Solving
    AX = XB on the Euclidean Group, IEEE Trans. Robotics and Automation 10(5), 1994.  Here every pair of views
    is used, and weighted: A and B of a sound pair turn by the same angle (Chen 1991), and what the
    others contradict counts less.
    """
    chains = [sample.pose_parent_other(mounting) for sample in samples]
    seen = [sample.view.pose for sample in samples]
    pairs = [(i, j) for i in range(len(samples)) for j in range(i)]
    motions = [(chains[i].compose(chains[j].inverse()), seen[i].compose(seen[j].inverse())) for i, j in pairs]
    rotation_a = np.array([rotation_log(a.wxyz) for a, _ in motions])
    rotation_b = np.array([rotation_log(b.wxyz) for _, b in motions])
    angle_a, angle_b = np.linalg.norm(rotation_a, axis=1), np.linalg.norm(rotation_b, axis=1)
    reliable = (angle_a < _LARGEST_ANGLE) & (angle_b < _LARGEST_ANGLE)
    weights = _weights(angle_a - angle_b, _LEAST_ANGLE) * reliable
    rotation = np.eye(3)
    for _ in range(_START_ROUNDS):
        rotation = _fit_rotation(rotation_a, rotation_b, weights)
        weights = (
            _weights(np.linalg.norm(rotation_a - rotation_b @ rotation.T, axis=1), _LEAST_ANGLE) * reliable
        )
    position = _translation(motions, rotation, weights)
    camera = Pose.from_rotation(rotation, position)
    boards = [chain.inverse().compose(camera).compose(pose) for chain, pose in zip(chains, seen, strict=True)]
    return Mount(camera, robust_mean_pose(boards), mounting)


def _weights(misses: Array, least: float) -> Array:
    scale = max(_MEDIAN_TO_SIGMA * float(np.median(np.abs(misses))), least)
    return cauchy_weight(misses / scale)


def _fit_rotation(a: Array, b: Array, weights: Array) -> Array:
    """Rotation (3, 3) with the least sum of w |a - R b|^2, of vectors (n, 3)."""
    u, _, vt = np.linalg.svd((weights[:, None] * a).T @ b)
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    return np.asarray(u @ flip @ vt)


def _translation(motions: Sequence[tuple[Pose, Pose]], rotation: Array, weights: Array) -> Array:
    left = np.array([a.rotation - np.eye(3) for a, _ in motions])
    right = np.array([rotation @ b.position - a.position for a, b in motions])
    position = np.zeros(3)
    for _ in range(_START_ROUNDS):
        normal = np.einsum("n,nij,nik->jk", weights, left, left)
        position = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weights, left, right))
        weights = _weights(np.linalg.norm(left @ position - right, axis=1), _LEAST_LENGTH)
    return np.asarray(position)


# The unknowns are twists of camera and board; the arm's error is one of the hand's position and its angle.
_ALL = np.arange(12)
_HAND = np.array([np.diag([1.0] * 3 + [0.0] * 3), np.diag([0.0] * 3 + [1.0] * 3)])
# What contradicts the others by fewer pixels is no outlier: print and lens are as good a reason.
_OUTLIER_PIXELS = 0.3
# Beyond this part of the picture's longer side a view's miss is no arm's error: 16 px of 640, 10 mm and more
# at half a metre.
_ABSURD = 0.025


@dataclass(frozen=True)
class ViewResidual:
    """How one view fits.

    Attributes:
        pixels: RMS distance of its corners from where the result puts them, px.
        left_out_pixels: The same, with the result of all the other views.
        left_out_position, left_out_angle: Where the other views expect the board, and where this one saw it:
            RMS over its points, metres; and rad.
        sigmas: The same distance in standard deviations of what is to be expected.
        outlier: It contradicts the others, and counts for almost nothing.
    """

    pixels: float
    left_out_pixels: float
    left_out_position: float
    left_out_angle: float
    sigmas: float
    outlier: bool


@dataclass(frozen=True, eq=False)
class HandEye(Mount):
    """The mount that ``solve_handeye`` finds, and how well.

    Attributes:
        covariance: (12, 12) of the two: translation (m) over rotation (rad), along the axes of parent and
            other, rotation about the origin of camera and board.
        residuals: Of each view, in order.
        residual_px, residual_mm: RMS of the views that are no outliers; the millimetres are left-out ones.
        arm_position, arm_angle: Estimated standard deviation of the arm's poses, one axis: metres, rad.
        spread: (3,) standard deviation of the hand's rotations, rad, by principal axis.
    """

    covariance: Array
    residuals: tuple[ViewResidual, ...]
    residual_px: float
    residual_mm: float
    arm_position: float
    arm_angle: float
    spread: Array

    @property
    def sigma_position(self) -> float:
        """Stated uncertainty of the camera's pose: standard deviation of the distance, metres."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_angle(self) -> float:
        """Stated uncertainty of the camera's orientation, rad."""
        return float(np.sqrt(np.trace(self.covariance[3:6, 3:6])))

    @property
    def outliers(self) -> tuple[int, ...]:
        """Indices of the views that contradict the others."""
        return tuple(k for k, one in enumerate(self.residuals) if one.outlier)


def solve_handeye(
    samples: Sequence[HandEyeSample], intrinsics: CameraIntrinsics, *, mounting: Mounting
) -> HandEye:
    """Where the camera is, from pictures of one board taken while the arm stood in many ways.

    All corners are fitted together over both poses.  The arm's own error, which moves all corners of one
    picture alike, is told from that of the pixels and estimated from the views, so that the stated
    uncertainty is consistent with the errors.  The bias that all views share (``Observation.bias``) is in it.

    Args:
        samples: At least 4, turned about two axes and more; 15 are good.
        intrinsics: Of the pictures' size.
        mounting: ``eye_in_hand``: the camera is carried, the board rests; ``eye_to_hand``: the camera rests,
            the board is carried.

    Raises:
        CalibrationError: Unknown mounting, too few views, too little turning, or views that no mounting
            explains.
    """
    spread = require_diversity(samples)
    # The hand is off, position and angle; nothing is known beforehand.
    hand = np.broadcast_to(_HAND[:, None], (2, len(samples), 6, 6))

    def linear(mount: Mount, weights: Sequence[Array] | None) -> tuple[LinearViews, Sequence[Array]]:
        views, left = compress(mount, samples, intrinsics, weights)
        scale = pixel_scale(left)
        return replace(views, pixels=scale**2 * views.pixels, sources=hand), corner_misses(left, scale)

    mount, normal = fit_views(linear, start_handeye(samples, mounting), _ALL)
    residuals = [_residual(mount, sample, intrinsics, normal.left_out(k)) for k, sample in enumerate(samples)]
    require_explained([one.pixels for one in residuals], [one.outlier for one in residuals], intrinsics)
    good = [one for one in residuals if not one.outlier] or residuals
    position, angle = normal.noise.sizes.tolist()
    # What all views have alike does not show in their scatter, nor does it become less with their number.
    off = normal.moved_by(np.array([_by_bias(mount, sample, intrinsics) for sample in samples]))
    return HandEye(
        mount.pose_parent_camera,
        mount.pose_other_board,
        mounting,
        covariance=normal.covariance + np.outer(off, off),
        residuals=tuple(residuals),
        residual_px=float(np.sqrt(np.mean([one.pixels**2 for one in good]))),
        residual_mm=float(1e3 * np.sqrt(np.mean([one.left_out_position**2 for one in good]))),
        arm_position=position,
        arm_angle=angle,
        spread=spread,
    )


def _by_bias(mount: Mount, sample: HandEyeSample, intrinsics: CameraIntrinsics) -> Array:
    """(6,) twist of the hand that a view asks for where its corners lie outwards by its ``bias``."""
    view = sample.view
    if view.bias == 0.0:
        return np.zeros(6)
    corners = view.pixels.reshape(-1, 4, 2)
    outwards = corners - corners.mean(axis=1, keepdims=True)
    outwards /= np.maximum(np.linalg.norm(outwards, axis=2, keepdims=True), 1e-9)
    _, _, hand = view_derivatives(mount, sample, intrinsics)
    return np.asarray(np.linalg.lstsq(hand, view.bias * outwards.ravel())[0])


def require_explained(
    pixels: Sequence[float], outliers: Sequence[bool], intrinsics: CameraIntrinsics
) -> None:
    """Checks that a result explains its views: given the RMS miss of each in ``pixels``, and the outliers.

    Raises:
        CalibrationError: It does not; there is nothing to be written then.
    """
    most = _ABSURD * max(intrinsics.size)
    middle = float(np.median(np.nan_to_num(pixels, nan=np.inf)))
    if middle <= most and 2 * sum(outliers) <= len(outliers):
        return
    raise CalibrationError(
        f"no answer explains what was seen: half of the {len(outliers)} views are {middle:.1f} px off and "
        f"more (at most {most:.0f} px can be an arm's), {sum(outliers)} contradict the others",
        hint="check which of camera and board the arm carries, that the pictures belong to these joint "
        "angles, the board's sizes, and the camera's calibration",
    )


def pixel_scale(left: Sequence[Array]) -> float:
    """Standard deviation of the pixels in units of the stated one; robust, and not from few numbers alone.

    ``left`` is what ``compress`` leaves of each view.
    """
    every = np.concatenate(left)
    # Median of the length of a Gaussian pair; the fit of six numbers a view has swallowed a part of it.
    robust = float(np.median(every)) / 1.1774
    dof, prior = 2.0 * len(every) - 6.0 * len(left), 10.0
    share = dof / (2 * len(every))
    if share < 0.1:
        return 1.0
    return float(np.sqrt((prior + dof * robust**2 / share) / (prior + dof)))


def corner_misses(left: Sequence[Array], scale: float) -> list[Array]:
    """What ``compress`` leaves, in standard deviations of one coordinate: ``scale`` times the stated ones."""
    return [one / np.sqrt(2.0) / scale for one in left]


def _residual(
    mount: Mount, sample: HandEyeSample, intrinsics: CameraIntrinsics, without: LeftOut
) -> ViewResidual:
    others, points = mount.moved(without.step), sample.view.points
    # The pseudo-measurement moves the hand so that the board is where it was seen.
    expected = others.pose_camera_board(sample)
    hand = sample.pose_world_hand.compose(Pose().moved(without.pseudo_measurement))
    found = others.pose_camera_board(HandEyeSample(hand, sample.view))
    deviation = np.linalg.norm(found.apply(points) - expected.apply(points), axis=1)
    left_out = rms_distance(others.miss(sample, intrinsics))
    return ViewResidual(
        pixels=rms_distance(mount.miss(sample, intrinsics)),
        left_out_pixels=left_out,
        left_out_position=float(np.sqrt(np.mean(deviation**2))),
        left_out_angle=expected.distance(found)[1],
        sigmas=without.sigmas,
        outlier=without.contradicts and left_out > _OUTLIER_PIXELS,
    )


def rms_distance(miss: Array) -> float:
    """Of misses (n, 2); NaN (a board behind the camera) counts as endlessly far."""
    return float(np.sqrt(np.mean(np.sum(np.nan_to_num(miss, nan=np.inf) ** 2, axis=1))))
