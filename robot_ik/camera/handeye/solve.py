"""Hand-eye calibration: where a camera sits on the arm, or stands beside it.

A first answer from AX = XB (``handeye_start``), then the joint least squares of all corners in all pictures
over both unknown poses.  Two errors are told apart: that of the pixels, and that of the arm, which moves all
corners of a picture together (servo ticks, gear play, geometry).  How large the arm's is, is estimated from
the views themselves (restricted maximum likelihood), so the stated uncertainty is an honest one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.handeye.model import MOUNTINGS, Compressed, HandEyeSample, Mount, Mounting, compress
from robot_ik.camera.handeye.noise import ArmNoise, Fit, estimate_noise, fit_shared, fit_without
from robot_ik.camera.handeye.rotation_average import cauchy_weight
from robot_ik.camera.handeye.start import require_diversity, start_handeye
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose

__all__ = ["HandEye", "HandEyeSample", "Mounting", "ViewResidual", "solve_handeye"]

Array = NDArray[np.float64]

_ROUNDS = 25
# Steps smaller than this (metres, rad) end the iteration; larger than _LARGEST_STEP they are shortened.
_DONE, _LARGEST_STEP = 1e-7, 0.5
# A view that the others contradict by more than this many standard deviations (of 6 numbers: 1 view in 10^6)
# and by more than this many pixels: below, print and lens are as good a reason.
_OUTLIER, _OUTLIER_PIXELS = 6.4, 0.3


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
class HandEye:
    """Result of ``solve_handeye``.

    Attributes:
        mounting: ``eye_in_hand``: parent is the hand, other the world; ``eye_to_hand``: the other way round.
        pose_parent_camera, pose_other_board: What was asked for.
        covariance: (12, 12) of the two: translation (m) over rotation (rad), along the axes of parent and
            other, rotation about the origin of camera and board.
        residuals: Of each view, in order.
        residual_px, residual_mm: RMS of the views that are no outliers; the millimetres are left-out ones.
        arm_position, arm_angle: Estimated standard deviation of the arm's poses, one axis: metres, rad.
        spread: (3,) standard deviation of the hand's rotations, rad, by principal axis.
    """

    mounting: Mounting
    pose_parent_camera: Pose
    pose_other_board: Pose
    covariance: Array
    residuals: tuple[ViewResidual, ...]
    residual_px: float
    residual_mm: float
    arm_position: float
    arm_angle: float
    spread: Array

    @property
    def sigma_position(self) -> float:
        """Stated uncertainty of the camera's place: standard deviation of the distance, metres."""
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

    Args:
        samples: At least 4, turned about two axes and more; 15 are good.
        intrinsics: Of the pictures' size.
        mounting: ``eye_in_hand``: the camera is carried, the board rests; ``eye_to_hand``: the camera rests,
            the board is carried.

    Raises:
        CalibrationError: Unknown mounting, too few views, or too little turning.
    """
    if mounting not in MOUNTINGS:
        raise CalibrationError(f"unknown mounting {mounting!r}; known: {', '.join(MOUNTINGS)}")
    spread = require_diversity(samples)
    mount = start_handeye(samples, mounting)
    corners: list[Array] | None = None
    before: ArmNoise | None = None
    for _ in range(_ROUNDS):
        data = compress(mount, samples, intrinsics, corners)
        scale = pixel_scale(data)
        corners = [cauchy_weight(one / np.sqrt(2.0) / scale) for one in data.left]
        before = noise = estimate_noise(data, scale, before)
        fit = fit_shared(data, noise)
        step = fit.step * min(1.0, _LARGEST_STEP / max(float(np.abs(fit.step).max()), 1e-300))
        mount = mount.moved(step)
        if np.abs(step).max() < _DONE:
            break
    return _result(mount, samples, intrinsics, data, noise, fit, spread)


def pixel_scale(data: Compressed) -> float:
    """Standard deviation of the pixels in units of the stated one; robust, and not from few numbers alone."""
    left = np.concatenate(data.left)
    # Median of the length of a Gaussian pair; the fit of six numbers a view has swallowed a part of it.
    robust = float(np.median(left)) / 1.1774
    share = data.freedom / (2 * len(left))
    if share < 0.1:
        return 1.0
    freedom, prior = float(data.freedom), 10.0
    return float(np.sqrt((prior + freedom * robust**2 / share) / (prior + freedom)))


def _result(
    mount: Mount,
    samples: Sequence[HandEyeSample],
    intrinsics: CameraIntrinsics,
    data: Compressed,
    noise: ArmNoise,
    fit: Fit,
    spread: Array,
) -> HandEye:
    residuals = []
    for k, sample in enumerate(samples):
        without = fit_without(data, noise, fit, k)
        points = sample.view.points
        residuals.append(
            _residual(mount, sample, intrinsics, without.step, without.wish, without.sigmas, points)
        )
    good = [one for one in residuals if not one.outlier] or residuals
    return HandEye(
        mounting=mount.mounting,
        pose_parent_camera=mount.pose_parent_camera,
        pose_other_board=mount.pose_other_board,
        covariance=fit.covariance,
        residuals=tuple(residuals),
        residual_px=float(np.sqrt(np.mean([one.pixels**2 for one in good]))),
        residual_mm=float(1e3 * np.sqrt(np.mean([one.left_out_position**2 for one in good]))),
        arm_position=noise.position,
        arm_angle=noise.angle,
        spread=spread,
    )


def _residual(
    mount: Mount,
    sample: HandEyeSample,
    intrinsics: CameraIntrinsics,
    step: Array,
    wish: Array,
    sigmas: float,
    points: Array,
) -> ViewResidual:
    others = mount.moved(step)
    # The wish moves the hand so that the board is where it was seen.
    expected = others.pose_camera_board(sample)
    moved = HandEyeSample(sample.pose_world_hand.compose(Pose.exp(wish)), sample.view)
    found = others.pose_camera_board(moved)
    apart = np.linalg.norm(found.apply(points) - expected.apply(points), axis=1)
    left_out = _rms_distance(others.miss(sample, intrinsics))
    return ViewResidual(
        pixels=_rms_distance(mount.miss(sample, intrinsics)),
        left_out_pixels=left_out,
        left_out_position=float(np.sqrt(np.mean(apart**2))),
        left_out_angle=expected.distance(found)[1],
        sigmas=sigmas,
        outlier=sigmas > _OUTLIER and left_out > _OUTLIER_PIXELS,
    )


def _rms_distance(miss: Array) -> float:
    """NaN (a board behind the camera) counts as endlessly far."""
    return float(np.sqrt(np.mean(np.sum(np.nan_to_num(miss, nan=np.inf) ** 2, axis=1))))
