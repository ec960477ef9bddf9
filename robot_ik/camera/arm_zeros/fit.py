"""Kinematic self-calibration: joint zero offsets from pictures of a board that the arm carries.

All corners of all pictures are fitted together, over the joints' offsets and the poses of camera and board,
by Levenberg and Marquardt's method with robust weights.  What is known of the two poses beforehand enters
with its covariance.  Offsets that the views cannot tell from other unknowns are held at 0 and named.

Source: Hollerbach & Wampler, The calibration index and taxonomy for robot kinematic calibration methods,
Int. J. Robotics Research 15(6), 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.arm_zeros.errors import PoseError, pose_error
from robot_ik.camera.arm_zeros.model import ArmModel, ArmState, ArmView, KnownPose, Linear
from robot_ik.camera.arm_zeros.noise import (
    JointNoise,
    Normal,
    cost,
    estimate_joint_noise,
    inverse,
    normal_equations,
)
from robot_ik.camera.arm_zeros.words import Mixture, find_mixture, joint_information
from robot_ik.camera.handeye.model import MOUNTINGS, Mounting
from robot_ik.camera.handeye.rotation_average import cauchy_weight
from robot_ik.camera.handeye.solve import pixel_scale
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError, UnknownJointError
from robot_ik.geometry import Pose
from robot_ik.robot_description import Robot

__all__ = ["ArmView", "KnownPose", "Mixture", "PoseError", "ZeroOffsets", "fit_zero_offsets"]

Array = NDArray[np.float64]

#: Fewer views than this are refused.
LEAST_VIEWS = 4
#: Offsets known worse than this count as not told apart, rad.
UNCLEAR = float(np.deg2rad(0.25))
_ROUNDS, _TRIES = 30, 8
# Steps smaller than this (rad, metres) end the iteration; so small that nothing is bent: not tried first.
_DONE, _SMALL = 1e-6, 1e-3
_FIRST_DAMPING = 1e-9


@dataclass(frozen=True, eq=False)
class ZeroOffsets:
    """Result of ``fit_zero_offsets``.

    Attributes:
        joints: Names, in the order of the rest.
        offsets: (nv,) to be added to the angles that the servos say, rad; 0 for those held.
        covariance: (nv, nv); zeros for those held, given which the others are known so well.
        mixtures: What could not be told apart, and which joint is held for it.
        pose_parent_camera, pose_other_board: The poses, refined.
        pose_covariance: (12, 12) of their twists.
        errors: Of each view, as the fit to all *other* views has it.
        residual_px: RMS distance of the corners, px, of views that are no outliers.
        joint_noise: Standard deviation of a joint from view to view, rad.
        pixel_scale: Standard deviation of the pixels in units of the stated one.
        singular_values: Of the information on the free offsets, 1/rad.
    """

    joints: tuple[str, ...]
    offsets: Array
    covariance: Array
    mixtures: tuple[Mixture, ...]
    pose_parent_camera: Pose
    pose_other_board: Pose
    pose_covariance: Array
    errors: tuple[PoseError, ...]
    residual_px: float
    joint_noise: float
    pixel_scale: float
    singular_values: Array

    @property
    def sigma(self) -> Array:
        """(nv,) standard deviations, rad; 0 for those held."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def found(self) -> tuple[str, ...]:
        """Joints whose offset was determined."""
        return tuple(name for name, s in zip(self.joints, self.sigma, strict=True) if s > 0.0)

    @property
    def outliers(self) -> tuple[int, ...]:
        """Indices of the views that contradict the others."""
        return tuple(k for k, one in enumerate(self.errors) if one.outlier)


def fit_zero_offsets(
    views: Sequence[ArmView],
    robot: Robot,
    frame: str,
    intrinsics: CameraIntrinsics,
    *,
    camera: KnownPose,
    board: KnownPose,
    mounting: Mounting = "eye_to_hand",
    hold: Sequence[str] = (),
    unclear: float = UNCLEAR,
) -> ZeroOffsets:
    """By how much the joints are ahead of what their servos say.

    Args:
        views: At least 4; 30 that bend every joint are good.
        robot: Its joints are those of ``q``.
        frame: What carries the board (eye to hand) or the camera (eye in hand).
        intrinsics: Of the pictures' size.
        camera: Where it is, seen from the world or the frame, and how well that is known.
        board: The same of the board, seen from the other of the two.
        mounting: Who is carried.
        hold: Joints whose offset is 0 for sure.
        unclear: A combination of offsets with a larger standard deviation, rad, is not determined.

    Raises:
        CalibrationError: Too few views, an unknown mounting, or joints that are no vector.
        UnknownJointError: ``hold`` names a joint that is not there.
    """
    _check(views, robot, mounting, hold)
    model = ArmModel(robot, frame, intrinsics, tuple(views), camera, board, mounting)
    held = set(hold)
    mixtures: list[Mixture] = []
    parent, other = (frame, "the world") if mounting == "eye_in_hand" else ("the world", frame)
    state = model.start()
    while True:
        free = [k for k, name in enumerate(robot.joints) if name not in held]
        fitted = _fit(model, state, np.array([*free, *range(robot.nv, robot.nv + 12)]))
        mixture = find_mixture(fitted.normal, robot.joints, unclear, parent, other)
        if mixture is None:
            return _result(model, fitted, mixtures)
        mixtures.append(mixture)
        held.add(mixture.joint)
        # From the start again: an offset that nothing determines may have gone anywhere.
        state = model.start()


def _check(views: Sequence[ArmView], robot: Robot, mounting: str, hold: Sequence[str]) -> None:
    if mounting not in MOUNTINGS:
        raise CalibrationError(f"unknown mounting {mounting!r}; known: {', '.join(MOUNTINGS)}")
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(
            f"{len(views)} views are too few to tell how the joints are off; {LEAST_VIEWS} are the least",
            hint="take 30 that bend every joint",
        )
    if robot.nq != robot.nv:
        raise CalibrationError("zero offsets are for hinges and slides; this robot has ball or free joints")
    for name in hold:
        if name not in robot.joints:
            raise UnknownJointError(name, robot.joints)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """The end of an iteration: where, the views linear there, and what they are worth."""

    state: ArmState
    linear: Linear
    noise: JointNoise
    normal: Normal
    scale: float


def _fit(model: ArmModel, state: ArmState, free: NDArray[np.int64]) -> _Fitted:
    corners: list[Array] | None = None
    noise: JointNoise | None = None
    damping = _FIRST_DAMPING
    for _ in range(_ROUNDS):
        raw = model.linear(state, corners)
        scale = pixel_scale(raw.data)
        linear = raw.scaled(scale)
        noise = estimate_joint_noise(linear, free, noise)
        normal = normal_equations(linear, noise, free)
        step, damping = _downhill(model, state, corners, (linear, noise, normal), damping)
        state = state.moved(step)
        corners = [cauchy_weight(one / np.sqrt(2.0) / scale) for one in raw.data.left]
        if np.abs(step).max() < _DONE:
            break
    assert noise is not None  # there was a round
    return _Fitted(state, linear, noise, normal, scale)


def _downhill(
    model: ArmModel,
    state: ArmState,
    corners: list[Array] | None,
    equations: tuple[Linear, JointNoise, Normal],
    damping: float,
) -> tuple[Array, float]:
    """A step that lowers the cost, and the damping for the next one; zeros where none does."""
    linear, noise, normal = equations
    now = cost(linear, noise)
    for _ in range(_TRIES):
        step = normal.step(damping)
        if np.abs(step).max() < _SMALL:
            return step, damping
        there = model.linear(state.moved(step), corners)
        if cost(there, noise) < now:
            return step, max(0.1 * damping, 1e-9)
        damping = 10.0 * max(damping, 1e-6)
    return np.zeros_like(step), damping


def _result(model: ArmModel, fitted: _Fitted, mixtures: list[Mixture]) -> ZeroOffsets:
    n = model.robot.nv
    covariance = fitted.normal.spread_out(inverse(fitted.normal.matrix))
    errors = tuple(_left_out(model, fitted, k) for k in range(len(model.views)))
    mount = fitted.state.mount
    squares = [
        np.sum(np.nan_to_num(mount.miss(one, model.intrinsics), nan=np.inf) ** 2, axis=1)
        for one, error in zip(model.samples(fitted.state), errors, strict=True)
        if not error.outlier
    ]
    return ZeroOffsets(
        joints=model.robot.joints,
        offsets=fitted.state.offsets,
        covariance=covariance[:n, :n],
        mixtures=tuple(mixtures),
        pose_parent_camera=mount.pose_parent_camera,
        pose_other_board=mount.pose_other_board,
        pose_covariance=covariance[n:, n:],
        errors=errors,
        residual_px=float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else float("nan"),
        joint_noise=fitted.noise.size,
        pixel_scale=fitted.scale,
        singular_values=np.sqrt(joint_information(fitted.normal, n)[0]),
    )


def _left_out(model: ArmModel, fitted: _Fitted, view: int) -> PoseError:
    """How one view fits what all others say."""
    step, covariance = fitted.normal.without(view)
    rows = fitted.linear.rows[view]
    wish = fitted.linear.wish[view] + rows @ step
    expected = fitted.noise.covariances[view] + rows @ covariance @ rows.T
    sigmas = float(np.sqrt(max(wish @ np.linalg.solve(expected, wish), 0.0)))
    return pose_error(model, fitted.state.moved(step), view, expected, sigmas)
