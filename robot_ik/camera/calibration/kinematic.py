"""Errors of an arm measured by a camera, and the zero offsets of its joints.

Self-calibration fits all corners of all pictures together, over the joint offsets and the poses of
camera and board. What is known of the poses enters as a prior with its covariance. A change of
offsets moves the hand, so all unknowns act on the six numbers to which a view is reduced
(``handeye.compress``). Offsets that the views cannot tell from other unknowns are held at 0 and
reported.

Source: Hollerbach & Wampler, The calibration index and taxonomy for robot kinematic calibration
methods, Int. J. Robotics Research 15(6), 1996.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.calibration.handeye import (
    MIN_VIEWS,
    HandEye,
    HandEyeSample,
    Mount,
    Mounting,
    compress,
    corner_residuals,
    pixel_scale,
    require_explained,
    rms_distance,
)
from robot_ik.camera.calibration.least_squares import LinearViews, NormalEquations, fit_views
from robot_ik.camera.calibration.observability import (
    Unobservable,
    find_unobservable,
    joint_information,
)
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import Observation
from robot_ik.errors import CalibrationError, UnknownJointError
from robot_ik.geometry import Pose
from robot_ik.kernels.tree import SLIDE
from robot_ik.ports import Array
from robot_ik.robot import Robot

#: Numbers of the two poses: the camera's twist, then the board's.
POSES = 12
#: Standard deviations of the poses from hand-eye calibration before the zeros are known, each axis,
#: m and rad.
HANDEYE_PRIOR = (0.05, math.radians(5.0))
# A view that contradicts the others by less than this is not an outlier, metres. Errors of print
# and lens can cause it.
_OUTLIER_DISTANCE = 5e-4
# Standard deviation of a combination of offsets up to which it is determined, rad.
_MAX_SIGMA = math.radians(0.25)
# A zero is doubted if its offset is larger than this, rad, and than this many standard deviations.
# With 12 views an offset of 0.5 degrees is detected. Servo ticks and the noise of corners raise no
# doubt.
_DOUBTED_ZERO = math.radians(0.25)
_DOUBTED_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class KnownPose:
    """A pose and its uncertainty.

    Attributes:
        pose: Best estimate.
        covariance: (6, 6) translation (m) over rotation (rad), along the axes of its parent,
            rotation about its own origin; as ``CameraExtrinsics.covariance``.

    Raises:
        CalibrationError: The covariance is not a positive definite (6, 6).
    """

    pose: Pose
    covariance: Array

    def __post_init__(self) -> None:
        c = np.array(self.covariance, dtype=float)
        if c.shape != (6, 6) or not np.isfinite(c).all() or np.linalg.eigvalsh(c)[0] <= 0.0:
            raise CalibrationError(
                "the covariance of a pose must be a positive definite (6, 6)",
                hint="for a pose known exactly give a small standard deviation, not 0",
            )
        object.__setattr__(self, "covariance", c)

    @classmethod
    def within(cls, pose: Pose, position: float, angle: float) -> KnownPose:
        """Return a pose known to these standard deviations of each axis, metres and rad."""
        return cls(pose, np.diag([position**2] * 3 + [angle**2] * 3))


@dataclass(frozen=True, eq=False)
class CalibrationStation:
    """Joint angles ``q`` (nq,) of the resting arm from its servos, and the board in a picture."""

    q: Array
    view: Observation


@dataclass(frozen=True, eq=False)
class ArmEstimate:
    """The unknowns.

    Attributes:
        offsets: (nv,) to be added to the angles of the servos, rad (m for slides).
        mount: The two poses.
    """

    offsets: Array
    mount: Mount

    def plus(self, step: Array) -> ArmEstimate:
        """Return the estimate moved by offsets (nv,) and the two twists (12,)."""
        n = len(self.offsets)
        return ArmEstimate(self.offsets + step[:n], self.mount.plus(step[n:]))


@dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm, its measurements, and what is known beforehand.

    Attributes:
        robot: All its joints are in ``q`` (nq = nv).
        frame: Frame that carries the board (eye to hand) or the camera (eye in hand).
        intrinsics: Intrinsics of the pictures.
        views: Measurements. Zero offsets need at least 4; 30 that bend every joint are good.
        camera: Pose of the camera, seen from the world or the frame.
        board: Pose of the board, seen from the other of the two.
        mounting: What the arm carries.
    """

    robot: Robot
    frame: str
    intrinsics: CameraIntrinsics
    views: Sequence[CalibrationStation]
    camera: KnownPose
    board: KnownPose
    mounting: Mounting = "eye_to_hand"

    def start(self) -> ArmEstimate:
        """Return the estimate without offsets, with the known poses."""
        mount = Mount(self.camera.pose, self.board.pose, self.mounting)
        return ArmEstimate(np.zeros(self.robot.nv), mount)

    def hand(self, state: ArmEstimate, view: CalibrationStation) -> Pose:
        """Return ``pose_world_hand`` with the offsets."""
        return self.robot.forward(view.q + state.offsets, self.frame)

    def samples(self, state: ArmEstimate) -> list[HandEyeSample]:
        """Return the views with the hand at its pose with the offsets."""
        return [HandEyeSample(self.hand(state, view), view.view) for view in self.views]

    def linear(
        self, state: ArmEstimate, weights: Sequence[Array] | None
    ) -> tuple[LinearViews, Sequence[Array]]:
        """Linearise all views at a state, for ``fit_views``.

        The unknowns are the joint offsets and the poses (nv + 12,). The source of the arm's error
        is an error of each joint.
        """
        views, corner_errors = compress(state.mount, self.samples(state), self.intrinsics, weights)
        by_joint = np.array([self._hand_jacobian(state, view) for view in self.views])
        n = self.robot.nv
        prior = np.zeros((n + POSES, n + POSES))
        prior[n : n + 6, n : n + 6] = np.linalg.inv(self.camera.covariance)
        prior[n + 6 :, n + 6 :] = np.linalg.inv(self.board.covariance)
        prior_error = np.zeros(n + POSES)
        prior_error[n : n + 6] = state.mount.pose_parent_camera.minus(self.camera.pose)
        prior_error[n + 6 :] = state.mount.pose_other_board.minus(self.board.pose)
        scale = pixel_scale(corner_errors)
        views = LinearViews(
            views.pseudo_measurement,
            scale**2 * views.pixels,
            rows=np.concatenate([-by_joint, views.rows], axis=2),
            sources=(by_joint @ by_joint.transpose(0, 2, 1))[None],
            prior=prior,
            prior_error=prior_error,
        )
        return views, corner_residuals(corner_errors, scale)

    def _hand_jacobian(self, state: ArmEstimate, view: CalibrationStation) -> Array:
        """Return the twist of the hand, in its own axes, by the joints (6, nv)."""
        q = view.q + state.offsets
        rotation = self.robot.forward(q, self.frame).rotation.T
        jacobian = self.robot.jacobian(q, self.frame)
        return np.concatenate([rotation @ jacobian[:3], rotation @ jacobian[3:]])


@dataclass(frozen=True, eq=False)
class PoseError:
    """Difference of a measured pose of the board from its pose by the joint angles.

    Attributes:
        position: (3,) of the board (eye in hand: the camera) from the joint angles, world, metres.
        vector: (3,) from ``position`` to the position measured in the picture, world, metres.
        angle: Angle between the two orientations, rad.
        sigma: Standard deviation of the measured position, metres: root of the sum over the axes.
        sigma_angle: The same for the orientation, rad.
        outlier: Whether it contradicts all others and has almost no weight.
    """

    position: Array
    vector: Array
    angle: float
    sigma: float
    sigma_angle: float
    outlier: bool

    @property
    def distance(self) -> float:
        """Length of ``vector``, metres."""
        return float(np.linalg.norm(self.vector))


def pose_error(
    model: ArmModel,
    state: ArmEstimate,
    view: int,
    covariance: Array,
    *,
    contradicts: bool = False,
) -> PoseError:
    """Return the error of one view at a state.

    Args:
        model: The arm.
        state: The unknowns.
        view: Index of the view.
        covariance: (6, 6) of the twist of the hand, in its axes, between picture and joints.
        contradicts: Whether the view contradicts the others.
    """
    station = model.views[view]
    mount = state.mount
    pose_camera_board = station.view.pose
    if model.mounting == "eye_to_hand":
        carried = mount.pose_other_board
        measured = mount.pose_parent_camera.compose(pose_camera_board)
    else:
        carried = mount.pose_parent_camera
        measured = mount.pose_other_board.compose(pose_camera_board.inverse())
    expected = model.hand(state, station).compose(carried)
    vector = measured.position - expected.position
    at_point = np.concatenate([np.eye(3), np.cross(carried.position, np.eye(3))], axis=1)
    return PoseError(
        position=expected.position,
        vector=vector,
        angle=measured.distance(expected)[1],
        sigma=float(np.sqrt(np.trace(at_point @ covariance @ at_point.T))),
        sigma_angle=float(np.sqrt(np.trace(covariance[3:, 3:]))),
        outlier=contradicts and float(np.linalg.norm(vector)) > _OUTLIER_DISTANCE,
    )


def measure_errors(model: ArmModel) -> tuple[PoseError, ...]:
    """Return the errors of the arm without a fit of its offsets."""
    state = model.start()
    # The covariances are linearised at the pose of the hand that fits the picture.
    samples = []
    for view in model.views:
        samples.append(HandEyeSample(state.mount.pose_world_hand(view.view.pose), view.view))
    views, corner_errors = compress(state.mount, samples, model.intrinsics)
    known = np.zeros((POSES, POSES))
    known[:6, :6] = model.camera.covariance
    known[6:, 6:] = model.board.covariance
    by_poses = views.rows @ known @ views.rows.transpose(0, 2, 1)
    covariances = views.pixels * pixel_scale(corner_errors) ** 2 + by_poses
    return tuple(pose_error(model, state, k, covariances[k]) for k in range(len(samples)))


@dataclass(frozen=True, eq=False)
class ZeroOffsets:
    """Result of ``fit_zero_offsets``.

    Attributes:
        joints: Names, in the order of the arrays.
        offsets: (nv,) to be added to the angles of the servos, rad; 0 for joints that are held.
        covariance: (nv, nv) of the offsets, given those that are held; zeros for these.
        unobservable: Combinations that are not determined, and the joint held for each.
        pose_parent_camera: Pose of the camera, refined.
        pose_other_board: Pose of the board, refined.
        errors: Error of each view by the fit to all *other* views.
        residual_px: RMS distance of the corners, px, of views that are not outliers.
        joint_noise: Standard deviation of a joint from view to view, rad.
        singular_values: Of the information on the free offsets, 1/rad.
    """

    joints: tuple[str, ...]
    offsets: Array
    covariance: Array
    unobservable: tuple[Unobservable, ...]
    pose_parent_camera: Pose
    pose_other_board: Pose
    errors: tuple[PoseError, ...]
    residual_px: float
    joint_noise: float
    singular_values: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations (nv,), rad; 0 for joints that are held."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def determined(self) -> tuple[str, ...]:
        """Joints whose offset was determined."""
        return tuple(name for name, s in zip(self.joints, self.sigma, strict=True) if s > 0.0)

    @property
    def outliers(self) -> tuple[int, ...]:
        """Indices of the views that contradict the others."""
        return tuple(k for k, error in enumerate(self.errors) if error.outlier)


def fit_zero_offsets(model: ArmModel, hold: Sequence[str] = ()) -> ZeroOffsets:
    """Fit the zero offsets of the joints: true joint angle minus angle of the servo.

    Args:
        model: The arm and its measurements.
        hold: Joints whose offset is known to be 0.

    Raises:
        CalibrationError: Too few views, an unknown mounting, ball or free joints, or views that no
            offsets explain.
        UnknownJointError: ``hold`` names an unknown joint.
    """
    robot = model.robot
    count = len(model.views)
    if count < MIN_VIEWS:
        raise CalibrationError(
            f"{count} views are too few to find the offsets of joints; "
            f"at least {MIN_VIEWS} are needed",
            hint="take 30 that bend every joint",
        )
    if robot.nq != robot.nv:
        raise CalibrationError(
            "zero offsets are for hinges and slides; this robot has ball or free joints"
        )
    for name in hold:
        if name not in robot.joints:
            raise UnknownJointError(name, robot.joints)

    held = set(hold)
    unobservable: list[Unobservable] = []
    while True:
        free = [k for k, name in enumerate(robot.joints) if name not in held]
        unknowns = np.array([*free, *range(robot.nv, robot.nv + POSES)])
        # Each fit begins at the start, because an offset without information may have drifted.
        state, normal = fit_views(model.linear, model.start(), unknowns)
        worst = find_unobservable(normal, robot.joints, _MAX_SIGMA)
        if worst is None:
            # If the caller holds all joints, it measures the errors of the arm. Any size is valid.
            check_fit = not set(hold) >= set(robot.joints)
            return _result(model, state, normal, unobservable, check_fit=check_fit)
        unobservable.append(worst)
        held.add(worst.joint)


def _result(
    model: ArmModel,
    state: ArmEstimate,
    normal: NormalEquations,
    unobservable: list[Unobservable],
    *,
    check_fit: bool,
) -> ZeroOffsets:
    n = model.robot.nv
    errors = []
    for k in range(len(model.views)):
        without = normal.left_out(k)
        others = state.plus(without.step)
        error = pose_error(model, others, k, without.covariance, contradicts=without.contradicts)
        errors.append(error)
    mount = state.mount
    residuals = [mount.residual(sample, model.intrinsics) for sample in model.samples(state)]
    outliers = [error.outlier for error in errors]
    if check_fit:
        require_explained(
            [rms_distance(residual) for residual in residuals], outliers, model.intrinsics
        )
    good = [residual for residual, outlier in zip(residuals, outliers, strict=True) if not outlier]
    return ZeroOffsets(
        joints=model.robot.joints,
        offsets=state.offsets,
        covariance=normal.covariance[:n, :n],
        unobservable=tuple(unobservable),
        pose_parent_camera=mount.pose_parent_camera,
        pose_other_board=mount.pose_other_board,
        errors=tuple(errors),
        residual_px=rms_distance(np.concatenate(good)) if good else math.nan,
        joint_noise=float(normal.noise.sizes[0]),
        singular_values=np.sqrt(joint_information(normal, n)[0]),
    )


def doubted_zeros(
    views: Sequence[CalibrationStation],
    robot: Robot,
    frame: str,
    intrinsics: CameraIntrinsics,
    result: HandEye,
) -> dict[str, tuple[float, float]]:
    """Return the joints whose zero is wrong according to the views of a hand-eye calibration.

    Args:
        views: The views of the calibration.
        robot: The robot.
        frame: As in ``ArmModel``.
        intrinsics: Intrinsics of the pictures.
        result: Result of the calibration.

    Returns:
        By joint: its offset and the standard deviation of the offset, rad. Joints that these views
        do not determine, slides, and robots with ball or free joints are left out.
    """
    if robot.nq != robot.nv:
        return {}
    kinds = zip(robot.joints, robot.tree.kind, strict=True)
    slides = [name for name, kind in kinds if kind == SLIDE]
    camera = KnownPose.within(result.pose_parent_camera, *HANDEYE_PRIOR)
    board = KnownPose.within(result.pose_other_board, *HANDEYE_PRIOR)
    model = ArmModel(robot, frame, intrinsics, views, camera, board, result.mounting)
    try:
        fit = fit_zero_offsets(model, slides)
    except CalibrationError:
        # No zeros explain the views: something else is wrong.
        return {}
    doubted = {}
    for name, offset, sigma in zip(fit.joints, fit.offsets, fit.sigma, strict=True):
        if sigma > 0.0 and abs(offset) > max(_DOUBTED_ZERO, _DOUBTED_SIGMAS * sigma):
            doubted[name] = (float(offset), float(sigma))
    return doubted
