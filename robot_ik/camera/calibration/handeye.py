"""Hand-eye calibration: the pose of a camera that the arm carries, or that watches a carried board.

The start values come from the motions alone (AX = XB). Then all corners of all pictures are fitted.

Frames: the *parent* carries the camera, the *other* carries the board. One of the two is the hand:

* eye in hand: parent = hand, other = world; ``pose_parent_other`` = inverse of ``pose_world_hand``,
* eye to hand: parent = world, other = hand; ``pose_parent_other`` = ``pose_world_hand``.

In both, ``pose_camera_board`` = inverse(X) M Y with X = ``pose_parent_camera``,
M = ``pose_parent_other``, Y = ``pose_other_board``. Twists are translation (m) over rotation (rad).
Those of X and Y are along the axes of parent and other, with the rotation about the origin of
camera and board. The twist of the hand is in the axes of the hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from robot_ik.camera.calibration.least_squares import (
    LeftOut,
    LinearViews,
    fit_views,
)
from robot_ik.camera.calibration.pose_means import robust_mean_pose, rotation_spread
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import Observation
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose, rotation_log
from robot_ik.ports import Array

Mounting = Literal["eye_in_hand", "eye_to_hand"]
MOUNTINGS: tuple[Mounting, ...] = ("eye_in_hand", "eye_to_hand")

#: Smallest number of views.
MIN_VIEWS = 4
#: Smallest standard deviation of the rotations, rad: about the axis they are spread most about, and
#: about the second one.
MIN_SPREAD = np.deg2rad((6.0, 3.0))
# Largest rotation between two views that is used, rad. Near half a turn the sign of the axis is
# undetermined.
_MAX_ANGLE = np.deg2rad(170.0)
# Points nearer than this, or behind the camera, are treated as if they were this far away, metres.
_MIN_DEPTH = 1e-3
# A view that contradicts the others by fewer pixels is not an outlier. Errors of print and lens can
# cause it.
_OUTLIER_PIXELS = 0.3
# Largest error of a view that an arm can cause, as a part of the longer side of the picture: 16 px
# of 640 are 10 mm and more at half a metre.
_MAX_ERROR = 0.025
# Weight of the stated standard deviation of a pixel, in measured coordinates.
_SCALE_PRIOR = 10.0
# Smallest part of redundant coordinates from which the standard deviation of the pixels is
# estimated.
_MIN_REDUNDANCY = 0.1
# Median of the length of a Gaussian pair, standard deviations.
_MEDIAN_LENGTH = 1.1774

# The unknowns are the twists of camera and board.
_UNKNOWNS = np.arange(12)
# Sources of the arm's error: position and angle of the hand.
_HAND_SOURCES = np.array([np.diag([1.0] * 3 + [0.0] * 3), np.diag([0.0] * 3 + [1.0] * 3)])


@dataclass(frozen=True, eq=False)
class HandEyeSample:
    """Pose of the resting hand from the servo positions, and the observation of the board there."""

    pose_world_hand: Pose
    view: Observation

    def pose_parent_other(self, mounting: Mounting) -> Pose:
        """Return M of the docstring of the module."""
        return self.pose_world_hand.inverse() if mounting == "eye_in_hand" else self.pose_world_hand


@dataclass(frozen=True, eq=False)
class Mount:
    """The two unknown poses.

    Attributes:
        pose_parent_camera: X.
        pose_other_board: Y.
        mounting: ``eye_in_hand``: parent is the hand, other the world; ``eye_to_hand``: reversed.

    Raises:
        CalibrationError: Unknown mounting.
    """

    pose_parent_camera: Pose
    pose_other_board: Pose
    mounting: Mounting

    def __post_init__(self) -> None:
        if self.mounting not in MOUNTINGS:
            raise CalibrationError(
                f"unknown mounting {self.mounting!r}", hint=f"use {' or '.join(MOUNTINGS)}"
            )

    def plus(self, step: Array) -> Mount:
        """Return both poses moved by twists (12,): the camera's, then the board's."""
        return Mount(
            self.pose_parent_camera.plus(step[:6]),
            self.pose_other_board.plus(step[6:]),
            self.mounting,
        )

    def pose_camera_board(self, sample: HandEyeSample) -> Pose:
        """Return the expected pose of the board."""
        chain = sample.pose_parent_other(self.mounting).compose(self.pose_other_board)
        return self.pose_parent_camera.inverse().compose(chain)

    def pose_world_hand(self, pose_camera_board: Pose) -> Pose:
        """Return the pose of the hand at which the board has a pose in the camera's frame."""
        chain = self.pose_parent_camera.compose(pose_camera_board)
        chain = chain.compose(self.pose_other_board.inverse())
        return chain.inverse() if self.mounting == "eye_in_hand" else chain

    def residual(self, sample: HandEyeSample, intrinsics: CameraIntrinsics) -> Array:
        """Return expected minus measured pixels (n, 2); NaN behind the camera."""
        expected = self.pose_camera_board(sample).apply(sample.view.points)
        return np.asarray(intrinsics.project(expected) - sample.view.pixels)


def view_derivatives(
    mount: Mount, sample: HandEyeSample, intrinsics: CameraIntrinsics
) -> tuple[Array, Array, Array]:
    """Linearise one view.

    Returns:
        Expected minus measured pixels (2n,), their derivative (2n, 12) by the twists of camera and
        board, and (2n, 6) by a twist of the hand in the hand's axes.
    """
    x = mount.pose_parent_camera
    y = mount.pose_other_board
    chain = sample.pose_parent_other(mount.mounting)
    in_other = y.apply(sample.view.points)
    in_parent = chain.apply(in_other)
    in_camera = x.inverse().apply(in_parent)
    in_camera[:, 2] = np.maximum(in_camera[:, 2], _MIN_DEPTH)
    residual = intrinsics.project(in_camera) - sample.view.pixels

    # (n, 2, 3): pixels by points in the parent's and in the other's frame.
    by_parent = intrinsics.point_jacobian(in_camera) @ x.rotation.T
    by_other = by_parent @ chain.rotation
    n = len(in_other)
    shared = np.empty((n, 2, 12))
    shared[:, :, :3] = -by_parent
    shared[:, :, 3:6] = by_parent @ _cross(in_parent - x.position)
    shared[:, :, 6:9] = by_other
    shared[:, :, 9:] = -by_other @ _cross(in_other - y.position)
    if mount.mounting == "eye_in_hand":
        # The points of a resting board move backwards in the hand.
        hand = np.concatenate([-by_parent, by_parent @ _cross(in_parent)], axis=2)
    else:
        hand = np.concatenate([by_other, -by_other @ _cross(in_other)], axis=2)
    return residual.ravel(), shared.reshape(2 * n, 12), hand.reshape(2 * n, 6)


def _cross(vectors: Array) -> Array:
    """Return the matrices [v]x (n, 3, 3) of vectors (n, 3)."""
    return np.cross(np.eye(3), vectors[:, None])


def compress(
    mount: Mount,
    samples: Sequence[HandEyeSample],
    intrinsics: CameraIntrinsics,
    weights: Sequence[Array] | None = None,
) -> tuple[LinearViews, list[Array]]:
    """Linearise all views as small Gaussians instead of all corners.

    A change of camera or board moves the points of a view exactly as some motion of the hand does.
    Each view is therefore reduced to the twist of the hand that fits it best, and its covariance.
    The reduction loses no information.

    Args:
        mount: Point of linearisation.
        samples: The views.
        intrinsics: Intrinsics of the pictures.
        weights: (k,) weights of the corners of each view; None for 1.

    Returns:
        The views, with the twists of camera and board (12,) as unknowns without prior, and without
        errors of the arm. Then the length (k,) of the residual that the twist leaves at each corner
        of each view, in standard deviations.
    """
    measurements = []
    covariances = []
    rows = []
    corner_errors = []
    for k, sample in enumerate(samples):
        residual, shared, hand = view_derivatives(mount, sample, intrinsics)
        w = np.ones(len(residual)) if weights is None else np.repeat(weights[k], 2)
        w = w / sample.view.sigma**2
        covariance = np.linalg.pinv(hand.T @ (w[:, None] * hand), rcond=1e-13, hermitian=True)
        measurement = -covariance @ (hand.T @ (w * residual))
        measurements.append(measurement)
        covariances.append(covariance)
        rows.append(-covariance @ (hand.T @ (w[:, None] * shared)))
        remaining = (residual + hand @ measurement).reshape(-1, 2) / sample.view.sigma
        corner_errors.append(np.linalg.norm(remaining, axis=1))
    views = LinearViews(
        np.array(measurements),
        np.array(covariances),
        np.array(rows),
        sources=np.zeros((0, len(samples), 6, 6)),
        prior=np.zeros((12, 12)),
        prior_error=np.zeros(12),
    )
    return views, corner_errors


def require_diversity(samples: Sequence[HandEyeSample]) -> Array:
    """Check that the rotations of the hand determine the mount.

    With rotations about one axis only, the camera's position along it is free. Small rotations
    magnify every error. Source: Tsai & Lenz, A New Technique for Fully Autonomous and Efficient 3D
    Robotics Hand/Eye Calibration, IEEE Trans. Robotics and Automation 5(3), 1989, section III: the
    error goes with the inverse of the sine of the angle between the axes, and with the inverse of
    the angles of rotation.

    Returns:
        (3,) spread in rad, see ``rotation_spread``.

    Raises:
        CalibrationError: Too few views, or too small rotations.
    """
    if len(samples) < MIN_VIEWS:
        raise CalibrationError(
            f"{len(samples)} views are too few to find how a camera is mounted; at least "
            f"{MIN_VIEWS} are needed",
            hint="15 views, rotated by 30 degrees and more about two axes, give a good result",
        )
    spread = rotation_spread([sample.pose_world_hand.wxyz for sample in samples])
    first, second = np.degrees(spread[:2])
    hint = "rotate the hand by 30 degrees and more to each side, about at least two axes"
    if spread[0] < MIN_SPREAD[0]:
        raise CalibrationError(
            f"the hand was hardly turned between the views (standard deviation {first:.1f} "
            f"degrees; at least {np.degrees(MIN_SPREAD[0]):.0f} are needed)",
            hint=hint,
        )
    if spread[1] < MIN_SPREAD[1]:
        raise CalibrationError(
            f"the hand was turned about one axis only (standard deviation {first:.1f} degrees "
            f"about it, {second:.1f} about any other; at least "
            f"{np.degrees(MIN_SPREAD[1]):.0f} are needed), so the position of the camera along "
            "that axis is undetermined",
            hint=hint,
        )
    return spread


def start_handeye(samples: Sequence[HandEyeSample], mounting: Mounting) -> Mount:
    """Return camera and board from the poses of the views alone, without their pixels.

    Two views i, j give A = M_i inverse(M_j), a motion by the arm, and B = C_i inverse(C_j), the
    same motion seen by the camera. R_X is the rotation that turns the rotation vectors of all B
    into those of A best. t_X is the linear least squares of (R_A - 1) t_X = R_X t_B - t_A.

    Source: Park & Martin, Robot Sensor Calibration: Solving AX = XB on the Euclidean Group, IEEE
    Trans. Robotics and Automation 10(5), 1994. OpenCV 5 has no ``calibrateHandEye``.
    """
    chains = [sample.pose_parent_other(mounting) for sample in samples]
    boards = [sample.view.pose for sample in samples]
    a = []
    b = []
    for i in range(len(samples)):
        for j in range(i):
            motion = chains[i].compose(chains[j].inverse())
            if motion.distance(Pose())[1] < _MAX_ANGLE:
                a.append(motion)
                b.append(boards[i].compose(boards[j].inverse()))
    vectors_a = np.array([rotation_log(motion.wxyz) for motion in a])
    vectors_b = np.array([rotation_log(motion.wxyz) for motion in b])
    u, _, vt = np.linalg.svd(vectors_a.T @ vectors_b)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    left = np.concatenate([motion.rotation - np.eye(3) for motion in a])
    right = [rotation @ y.position - x.position for x, y in zip(a, b, strict=True)]
    position = np.linalg.lstsq(left, np.concatenate(right), rcond=None)[0]
    camera = Pose.from_rotation(rotation, position)
    on_other = [
        chain.inverse().compose(camera).compose(board)
        for chain, board in zip(chains, boards, strict=True)
    ]
    return Mount(camera, robust_mean_pose(on_other), mounting)


@dataclass(frozen=True)
class ViewResidual:
    """Residual of one view.

    Attributes:
        pixels: RMS distance of its corners from their projection, px.
        left_out_pixels: The same, with the result of all other views.
        left_out_position: RMS distance of its points between where the other views expect the board
            and where this view measured it, metres.
        left_out_angle: The same for the orientation, rad.
        sigmas: The same distance in standard deviations of the expected one.
        outlier: Whether it contradicts the others and has almost no weight.
    """

    pixels: float
    left_out_pixels: float
    left_out_position: float
    left_out_angle: float
    sigmas: float
    outlier: bool


@dataclass(frozen=True, eq=False)
class HandEye(Mount):
    """Result of ``solve_handeye``.

    Attributes:
        covariance: (12, 12) of the two poses: translation (m) over rotation (rad), along the axes
            of parent and other, rotation about the origin of camera and board.
        residuals: One of each view, in order.
        residual_px: RMS of the views that are not outliers, px.
        residual_mm: RMS of the left-out distances of the same views, mm.
        arm_position: Estimated standard deviation of the arm's position, one axis, metres.
        arm_angle: Estimated standard deviation of the arm's orientation, one axis, rad.
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
        """Standard deviation of the camera's position: of the distance, metres."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_angle(self) -> float:
        """Standard deviation of the camera's orientation, rad."""
        return float(np.sqrt(np.trace(self.covariance[3:6, 3:6])))

    @property
    def outliers(self) -> tuple[int, ...]:
        """Indices of the views that contradict the others."""
        return tuple(k for k, residual in enumerate(self.residuals) if residual.outlier)


def solve_handeye(
    samples: Sequence[HandEyeSample], intrinsics: CameraIntrinsics, *, mounting: Mounting
) -> HandEye:
    """Find the pose of a camera from pictures of one board at many poses of the arm.

    All corners are fitted together over both poses. The error of the arm moves all corners of one
    picture alike. It is therefore separated from the noise of the pixels and estimated from the
    views. The stated uncertainty is then consistent with the errors. It includes the bias that all
    views share (``Observation.bias``).

    Args:
        samples: At least 4, rotated about two axes; 15 are good.
        intrinsics: Intrinsics of the pictures.
        mounting: ``eye_in_hand``: the camera is carried, the board rests; ``eye_to_hand``: the
            camera rests, the board is carried.

    Raises:
        CalibrationError: Unknown mounting, too few views, too small rotations, or views that no
            mount explains.
    """
    spread = require_diversity(samples)
    sources = np.broadcast_to(_HAND_SOURCES[:, None], (2, len(samples), 6, 6))

    def linear(
        mount: Mount, weights: Sequence[Array] | None
    ) -> tuple[LinearViews, Sequence[Array]]:
        views, corner_errors = compress(mount, samples, intrinsics, weights)
        scale = pixel_scale(corner_errors)
        scaled = replace(views, pixels=scale**2 * views.pixels, sources=sources)
        return scaled, corner_residuals(corner_errors, scale)

    mount, normal = fit_views(linear, start_handeye(samples, mounting), _UNKNOWNS)
    residuals = []
    for k, sample in enumerate(samples):
        residuals.append(_residual(mount, sample, intrinsics, normal.left_out(k)))
    pixels = [residual.pixels for residual in residuals]
    require_explained(pixels, [residual.outlier for residual in residuals], intrinsics)
    good = [residual for residual in residuals if not residual.outlier] or residuals
    arm_position, arm_angle = normal.noise.sizes.tolist()
    # An error that all views share does not show in their scatter and does not decrease with their
    # number.
    bias_twists = np.array([_bias_twist(mount, sample, intrinsics) for sample in samples])
    shared = normal.moved_by(bias_twists)
    return HandEye(
        mount.pose_parent_camera,
        mount.pose_other_board,
        mounting,
        covariance=normal.covariance + np.outer(shared, shared),
        residuals=tuple(residuals),
        residual_px=float(np.sqrt(np.mean([r.pixels**2 for r in good]))),
        residual_mm=float(1e3 * np.sqrt(np.mean([r.left_out_position**2 for r in good]))),
        arm_position=arm_position,
        arm_angle=arm_angle,
        spread=spread,
    )


def _bias_twist(mount: Mount, sample: HandEyeSample, intrinsics: CameraIntrinsics) -> Array:
    """Return the twist of the hand (6,) that the bias of the corners of a view causes."""
    view = sample.view
    if view.bias == 0.0:
        return np.zeros(6)
    corners = view.pixels.reshape(-1, 4, 2)
    outwards = corners - corners.mean(axis=1, keepdims=True)
    outwards /= np.maximum(np.linalg.norm(outwards, axis=2, keepdims=True), 1e-9)
    _, _, hand = view_derivatives(mount, sample, intrinsics)
    return np.asarray(np.linalg.lstsq(hand, view.bias * outwards.ravel(), rcond=None)[0])


def require_explained(
    pixels: Sequence[float], outliers: Sequence[bool], intrinsics: CameraIntrinsics
) -> None:
    """Check that a result explains its views.

    Args:
        pixels: RMS distance of the corners of each view, px.
        outliers: Whether each view is an outlier.
        intrinsics: Intrinsics of the pictures.

    Raises:
        CalibrationError: Half of the views have a large error, or more than half are outliers.
    """
    limit = _MAX_ERROR * max(intrinsics.size)
    median = float(np.median(np.nan_to_num(pixels, nan=np.inf)))
    if median <= limit and 2 * sum(outliers) <= len(outliers):
        return
    raise CalibrationError(
        f"no result explains the views: the median error of {len(outliers)} views is "
        f"{median:.1f} px (an arm causes at most {limit:.0f} px), and {sum(outliers)} views "
        "contradict the others",
        hint="check which of camera and board the arm carries, that the pictures belong to these "
        "joint angles, the board's sizes, and the camera's calibration",
    )


def pixel_scale(corner_errors: Sequence[Array]) -> float:
    """Return the standard deviation of the pixels in units of the stated one.

    The estimate is robust. With few corners it stays near 1.

    Args:
        corner_errors: Second result of ``compress``.
    """
    lengths = np.concatenate(corner_errors)
    robust = float(np.median(lengths)) / _MEDIAN_LENGTH
    # The fit of six unknowns per view removes a part of the variance.
    redundancy = 2.0 * len(lengths) - 6.0 * len(corner_errors)
    share = redundancy / (2 * len(lengths))
    if share < _MIN_REDUNDANCY:
        return 1.0
    squares = _SCALE_PRIOR + redundancy * robust**2 / share
    return float(np.sqrt(squares / (_SCALE_PRIOR + redundancy)))


def corner_residuals(corner_errors: Sequence[Array], scale: float) -> list[Array]:
    """Return the corner errors of ``compress`` in standard deviations of one coordinate."""
    return [errors / np.sqrt(2.0) / scale for errors in corner_errors]


def _residual(
    mount: Mount, sample: HandEyeSample, intrinsics: CameraIntrinsics, without: LeftOut
) -> ViewResidual:
    others = mount.plus(without.step)
    points = sample.view.points
    expected = others.pose_camera_board(sample)
    # The pseudo-measurement moves the hand so that the board is where it was measured.
    hand = sample.pose_world_hand.compose(Pose().plus(without.pseudo_measurement))
    measured = others.pose_camera_board(HandEyeSample(hand, sample.view))
    deviation = np.linalg.norm(measured.apply(points) - expected.apply(points), axis=1)
    left_out = rms_distance(others.residual(sample, intrinsics))
    return ViewResidual(
        pixels=rms_distance(mount.residual(sample, intrinsics)),
        left_out_pixels=left_out,
        left_out_position=float(np.sqrt(np.mean(deviation**2))),
        left_out_angle=expected.distance(measured)[1],
        sigmas=without.sigmas,
        outlier=without.contradicts and left_out > _OUTLIER_PIXELS,
    )


def rms_distance(residual: Array) -> float:
    """Return the RMS length of residuals (n, 2). NaN, a board behind the camera, gives infinity."""
    squares = np.sum(np.nan_to_num(residual, nan=np.inf) ** 2, axis=1)
    return float(np.sqrt(np.mean(squares)))
