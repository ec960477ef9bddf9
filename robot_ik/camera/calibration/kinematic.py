"""How far a camera sees a carried board from where the joints say it is; and joint zeros found by that.

Self-calibration fits all corners of all pictures together, over the joints' offsets and the poses of camera
and board; what is known of the poses beforehand enters with its covariance.  A change of offsets moves the
hand, so all unknowns enter the six numbers to which a view is boiled down (``handeye.compress``).  Offsets
that the views cannot tell from other unknowns are held at 0 and named.

Source: Hollerbach & Wampler, The calibration index and taxonomy for robot kinematic calibration methods,
Int. J. Robotics Research 15(6), 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.calibration.handeye import (
    LEAST_VIEWS,
    HandEye,
    HandEyeSample,
    Mount,
    Mounting,
    compress,
    corner_misses,
    pixel_scale,
    require_explained,
    rms_distance,
)
from robot_ik.camera.calibration.least_squares import (
    LinearViews,
    NormalEquations,
    Unobservable,
    find_unobservable,
    fit_views,
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


@dataclass(frozen=True, eq=False)
class KnownPose:
    """A pose and how well it is known.

    Attributes:
        pose: Best guess.
        covariance: (6, 6) translation (m) over rotation (rad), along the axes it is seen from, rotation about
            its own origin; as ``CameraExtrinsics.covariance``.

    Raises:
        CalibrationError: The covariance is no positive definite (6, 6).
    """

    pose: Pose
    covariance: Array

    def __post_init__(self) -> None:
        c = np.array(self.covariance, dtype=float)
        if c.shape != (6, 6) or not np.isfinite(c).all() or np.linalg.eigvalsh(c)[0] <= 0.0:
            raise CalibrationError(
                "how well a pose is known is a positive definite (6, 6) covariance",
                hint="a pose known exactly: give a small standard deviation, not 0",
            )
        object.__setattr__(self, "covariance", c)

    @classmethod
    def within(cls, pose: Pose, position: float, angle: float) -> KnownPose:
        """Known to these standard deviations of each axis, metres and rad."""
        return cls(pose, np.diag([position**2] * 3 + [angle**2] * 3))


@dataclass(frozen=True, eq=False)
class CalibrationStation:
    """The arm stood still with its joints at ``q`` (nq,), as the servos say, and the board was seen."""

    q: Array
    view: Observation


@dataclass(frozen=True, eq=False)
class ArmEstimate:
    """The unknowns: ``offsets`` (nv,) to be added to what the servos say, rad (m for slides); poses."""

    offsets: Array
    mount: Mount

    def moved(self, step: Array) -> ArmEstimate:
        """Moved by offsets (nv,) and the two twists (12,)."""
        n = len(self.offsets)
        return ArmEstimate(self.offsets + step[:n], self.mount.moved(step[n:]))


@dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm, what was seen of it, and what is known beforehand.

    Attributes:
        robot: All its joints are in ``q`` (nq = nv).
        frame: What carries the board (eye to hand) or the camera (eye in hand).
        intrinsics: Of the pictures' size.
        views: What was measured; for zero offsets at least 4, and 30 that bend every joint are good.
        camera: Where it is, seen from the world or the frame, and how well that is known.
        board: The same of the board, seen from the other of the two.
        mounting: Who is carried.
    """

    robot: Robot
    frame: str
    intrinsics: CameraIntrinsics
    views: Sequence[CalibrationStation]
    camera: KnownPose
    board: KnownPose
    mounting: Mounting = "eye_to_hand"

    def start(self) -> ArmEstimate:
        """No offsets, the poses as they are thought to be."""
        mount = Mount(self.camera.pose, self.board.pose, self.mounting)
        return ArmEstimate(np.zeros(self.robot.nv), mount)

    def hand(self, state: ArmEstimate, view: CalibrationStation) -> Pose:
        """``pose_world_hand`` with the offsets."""
        return self.robot.forward(view.q + state.offsets, self.frame)

    def samples(self, state: ArmEstimate) -> list[HandEyeSample]:
        """The views, with the hand where the offsets put it."""
        return [HandEyeSample(self.hand(state, one), one.view) for one in self.views]

    def linear(
        self, state: ArmEstimate, weights: Sequence[Array] | None
    ) -> tuple[LinearViews, Sequence[Array]]:
        """All views at ``state``, for ``fit_views``.

        The unknowns are the joints' offsets and the poses (nv + 12,), the arm's error one rad in each joint.
        """
        views, left = compress(state.mount, self.samples(state), self.intrinsics, weights)
        by_joint = np.array([self._hand_jacobian(state, one) for one in self.views])
        n = self.robot.nv
        prior, off = np.zeros((n + POSES, n + POSES)), np.zeros(n + POSES)
        prior[n : n + 6, n : n + 6] = np.linalg.inv(self.camera.covariance)
        prior[n + 6 :, n + 6 :] = np.linalg.inv(self.board.covariance)
        off[n : n + 6] = state.mount.pose_parent_camera.change_from(self.camera.pose)
        off[n + 6 :] = state.mount.pose_other_board.change_from(self.board.pose)
        rows = np.concatenate([-by_joint, views.rows], axis=2)
        joints, scale = by_joint @ by_joint.transpose(0, 2, 1), pixel_scale(left)
        views = LinearViews(views.pseudo_measurement, scale**2 * views.pixels, rows, joints[None], prior, off)
        return views, corner_misses(left, scale)

    def _hand_jacobian(self, state: ArmEstimate, view: CalibrationStation) -> Array:
        """(6, nv) twist of the hand, in its own axes, by the joints."""
        q = view.q + state.offsets
        rotation = self.robot.forward(q, self.frame).rotation.T
        jacobian = self.robot.jacobian(q, self.frame)
        return np.concatenate([rotation @ jacobian[:3], rotation @ jacobian[3:]])


# What contradicts the others by less than this distance is no outlier: print and lens are as good a reason.
_OUTLIER_DISTANCE = 5e-4


@dataclass(frozen=True, eq=False)
class PoseError:
    """How far the board is from where the joints put it, in one view.

    Attributes:
        position: (3,) where the joints put the board (eye in hand: the camera), world, metres.
        vector: (3,) from there to where the picture shows it, world, metres.
        angle: The same of the orientation, rad.
        sigma, sigma_angle: Standard deviation of the measurement (square root of the sum over the axes).
        outlier: It contradicts all others, and counts for almost nothing.
    """

    position: Array
    vector: Array
    angle: float
    sigma: float
    sigma_angle: float
    outlier: bool

    @property
    def distance(self) -> float:
        """Length of ``vector``."""
        return float(np.linalg.norm(self.vector))


def pose_error(
    model: ArmModel, state: ArmEstimate, view: int, covariance: Array, *, contradicts: bool = False
) -> PoseError:
    """View number ``view`` at a state, and whether it contradicts the others.

    ``covariance`` (6, 6) is of the twist of the hand, in its axes, that separates picture and joints.
    """
    one, mount = model.views[view], state.mount
    seen = one.view.pose
    if model.mounting == "eye_to_hand":
        carried, found = mount.pose_other_board, mount.pose_parent_camera.compose(seen)
    else:
        carried, found = mount.pose_parent_camera, mount.pose_other_board.compose(seen.inverse())
    expected = model.hand(state, one).compose(carried)
    vector = found.position - expected.position
    at_point = np.concatenate([np.eye(3), np.cross(carried.position, np.eye(3))], axis=1)
    return PoseError(
        position=expected.position,
        vector=vector,
        angle=found.distance(expected)[1],
        sigma=float(np.sqrt(np.trace(at_point @ covariance @ at_point.T))),
        sigma_angle=float(np.sqrt(np.trace(covariance[3:, 3:]))),
        outlier=contradicts and float(np.linalg.norm(vector)) > _OUTLIER_DISTANCE,
    )


def measure_errors(model: ArmModel) -> tuple[PoseError, ...]:
    """The errors of the arm as it is; nothing is fitted."""
    state, known = model.start(), np.zeros((POSES, POSES))
    # The hand as the picture has it: what the corners and the two poses are worth is linear there.
    samples = [HandEyeSample(state.mount.pose_world_hand(one.view.pose), one.view) for one in model.views]
    linear, left = compress(state.mount, samples, model.intrinsics)
    known[:6, :6], known[6:, 6:] = model.camera.covariance, model.board.covariance
    rows = linear.rows
    covariances = linear.pixels * pixel_scale(left) ** 2 + rows @ known @ rows.transpose(0, 2, 1)
    return tuple(pose_error(model, state, k, covariances[k]) for k in range(len(samples)))


# A combination of offsets with a larger standard deviation than this, rad, is not determined.
_UNCLEAR = float(np.deg2rad(0.25))


@dataclass(frozen=True, eq=False)
class ZeroOffsets:
    """Result of ``fit_zero_offsets``.

    Attributes:
        joints: Names, in the order of the rest.
        offsets: (nv,) to be added to the angles that the servos say, rad; 0 for those held.
        covariance: (nv, nv); zeros for those held, given which the others are known so well.
        unobservable: What could not be told apart, and which joint is held for it.
        pose_parent_camera, pose_other_board: The poses, refined.
        errors: Of each view, as the fit to all *other* views has it.
        residual_px: RMS distance of the corners, px, of views that are no outliers.
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


def fit_zero_offsets(model: ArmModel, hold: Sequence[str] = ()) -> ZeroOffsets:
    """By how much the joints are ahead of what their servos say.

    ``hold``: joints whose offset is 0 for sure.

    Raises:
        CalibrationError: Too few views, an unknown mounting, joints that are no vector, or views that no
            offsets explain.
        UnknownJointError: ``hold`` names a joint that is not there.
    """
    robot, count = model.robot, len(model.views)
    if count < LEAST_VIEWS:
        raise CalibrationError(
            f"{count} views are too few to tell how the joints are off; {LEAST_VIEWS} are the least",
            hint="take 30 that bend every joint",
        )
    if robot.nq != robot.nv:
        raise CalibrationError("zero offsets are for hinges and slides; this robot has ball or free joints")
    for name in hold:
        if name not in robot.joints:
            raise UnknownJointError(name, robot.joints)
    held = set(hold)
    unobservable: list[Unobservable] = []
    carried = model.mounting == "eye_in_hand"
    parent, other = (model.frame, "the world") if carried else ("the world", model.frame)
    while True:
        free = [k for k, name in enumerate(robot.joints) if name not in held]
        # From the start each time: an offset that nothing determines may have gone anywhere.
        unknowns = np.array([*free, *range(robot.nv, robot.nv + POSES)])
        state, normal = fit_views(model.linear, model.start(), unknowns)
        worst = find_unobservable(normal, robot.joints, _UNCLEAR, parent, other)
        if worst is None:
            # With all joints held it is the arm's errors that are asked for, however large.
            return _result(model, state, normal, unobservable, judge=not set(hold) >= set(robot.joints))
        unobservable.append(worst)
        held.add(worst.joint)


def _result(
    model: ArmModel,
    state: ArmEstimate,
    normal: NormalEquations,
    unobservable: list[Unobservable],
    *,
    judge: bool,
) -> ZeroOffsets:
    n = model.robot.nv
    # How each view fits what all others say.
    others = [normal.left_out(k) for k in range(len(model.views))]
    errors = tuple(
        pose_error(model, state.moved(without.step), k, without.covariance, contradicts=without.contradicts)
        for k, without in enumerate(others)
    )
    mount = state.mount
    misses = [mount.miss(one, model.intrinsics) for one in model.samples(state)]
    outliers = [one.outlier for one in errors]
    if judge:
        require_explained([rms_distance(miss) for miss in misses], outliers, model.intrinsics)
    good = [miss for miss, out in zip(misses, outliers, strict=True) if not out]
    return ZeroOffsets(
        joints=model.robot.joints,
        offsets=state.offsets,
        covariance=normal.covariance[:n, :n],
        unobservable=tuple(unobservable),
        pose_parent_camera=mount.pose_parent_camera,
        pose_other_board=mount.pose_other_board,
        errors=errors,
        residual_px=rms_distance(np.concatenate(good)) if good else float("nan"),
        joint_noise=float(normal.noise.sizes[0]),
        singular_values=np.sqrt(joint_information(normal, n)[0]),
    )


# What hand-eye calibration says of camera and board is worth no more than this, each axis, m and rad, before
# the zeros are known.
ANYWHERE = (0.05, float(np.deg2rad(5.0)))
# A zero is doubted where it is off by more than this, rad, and by so many standard deviations: 12 views then
# show one that is off by 0.5 degrees, and ticks of servos and noise of corners make no right one doubtful.
_DOUBTED_ZERO, _SURE = float(np.deg2rad(0.25)), 5.0


def doubted_zeros(
    views: Sequence[CalibrationStation],
    robot: Robot,
    frame: str,
    intrinsics: CameraIntrinsics,
    found: HandEye,
) -> dict[str, tuple[float, float]]:
    """Joints whose zero is off by what the views of a hand-eye calibration say themselves.

    ``views`` are those that ``found`` was found from; the rest as in ``ArmModel``.

    Returns:
        By joint: by how much it is ahead of what its servo says, and the standard deviation of that, rad.
        Joints that these views do not observe, slides, and robots with ball or free joints are left out.
    """
    if robot.nq != robot.nv:
        return {}
    slides = [name for name, kind in zip(robot.joints, robot.tree.kind, strict=True) if kind == SLIDE]
    poses = found.pose_parent_camera, found.pose_other_board
    camera, board = (KnownPose.within(pose, *ANYWHERE) for pose in poses)
    model = ArmModel(robot, frame, intrinsics, views, camera, board, found.mounting)
    try:
        fit = fit_zero_offsets(model, slides)
    except CalibrationError:  # no zeros explain the views: what is wrong is something else
        return {}
    return {
        name: (float(offset), float(sigma))
        for name, offset, sigma in zip(fit.joints, fit.offsets, fit.sigma, strict=True)
        if sigma > 0.0 and abs(offset) > max(_DOUBTED_ZERO, _SURE * sigma)
    }
