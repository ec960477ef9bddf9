"""How far a camera sees a carried board from where the joints say it is: the error map of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.arm_zeros.model import ArmModel, ArmState, ArmView, KnownPose
from robot_ik.camera.boards.view import cross_matrices
from robot_ik.camera.handeye.model import HandEyeSample, compress
from robot_ik.camera.handeye.solve import pixel_scale
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.robot_description import Robot

Array = NDArray[np.float64]

# A view that the others contradict by more than this many standard deviations (of 6 numbers: 1 view in 10^6)
# and by more than this distance: below, print and lens are as good a reason.
_OUTLIER, _OUTLIER_DISTANCE = 6.4, 5e-4


@dataclass(frozen=True, eq=False)
class PoseError:
    """How far the board is from where the joints put it, in one view.

    Attributes:
        place: (3,) where the joints put the board (eye in hand: the camera), world, metres.
        vector: (3,) from there to where the picture shows it, world, metres.
        angle: The same of the orientation, rad.
        sigma, sigma_angle: Standard deviation of the measurement (square root of the sum over the axes).
        sigmas: How far the view contradicts all others, in standard deviations; 0 where that is not asked.
        outlier: It contradicts them, and counts for almost nothing.
    """

    place: Array
    vector: Array
    angle: float
    sigma: float
    sigma_angle: float
    sigmas: float
    outlier: bool

    @property
    def distance(self) -> float:
        """Length of ``vector``."""
        return float(np.linalg.norm(self.vector))


def pose_error(
    model: ArmModel, state: ArmState, view: int, covariance: Array, sigmas: float = 0.0
) -> PoseError:
    """One view at a state.

    Args:
        model: Of all views.
        state: Offsets, camera and board.
        view: Which.
        covariance: (6, 6) of the twist of the hand, in its axes, that separates picture and joints.
        sigmas: As in ``PoseError``.
    """
    one, mount = model.views[view], state.mount
    carried = mount.pose_other_board if model.mounting == "eye_to_hand" else mount.pose_parent_camera
    vector, angle = model.apart(state, one)
    at_point = np.concatenate([np.eye(3), -cross_matrices(carried.position[None])[0]], axis=1)
    return PoseError(
        place=np.asarray(model.hand(state, one).apply(carried.position)),
        vector=vector,
        angle=angle,
        sigma=float(np.sqrt(np.trace(at_point @ covariance @ at_point.T))),
        sigma_angle=float(np.sqrt(np.trace(covariance[3:, 3:]))),
        sigmas=sigmas,
        outlier=sigmas > _OUTLIER and float(np.linalg.norm(vector)) > _OUTLIER_DISTANCE,
    )


def measure_errors(
    views: Sequence[ArmView],
    robot: Robot,
    frame: str,
    intrinsics: CameraIntrinsics,
    *,
    camera: KnownPose,
    board: KnownPose,
) -> tuple[PoseError, ...]:
    """The errors of an arm that carries a board before a standing camera; nothing is fitted.

    Args:
        views: What was measured.
        robot: Its joints are those of ``q``.
        frame: What carries the board.
        intrinsics: Of the pictures' size.
        camera: Where it is in the world, and how well that is known.
        board: Where the board is on ``frame``, and how well that is known.
    """
    model = ArmModel(robot, frame, intrinsics, tuple(views), camera, board, "eye_to_hand")
    state = model.start()
    mount = state.mount
    # The hand as the picture has it: what the corners and the two poses are worth is linear there.
    hands = [_seen_hand(one, mount.pose_parent_camera, mount.pose_other_board) for one in views]
    samples = [HandEyeSample(hand, one.view) for hand, one in zip(hands, views, strict=True)]
    data = compress(mount, samples, intrinsics)
    known = np.zeros((12, 12))
    known[:6, :6], known[6:, 6:] = camera.covariance, board.covariance
    rows = data.by_shared
    covariances = data.covariance * pixel_scale(data) ** 2 + rows @ known @ rows.transpose(0, 2, 1)
    return tuple(pose_error(model, state, k, covariances[k]) for k in range(len(views)))


def _seen_hand(one: ArmView, pose_world_camera: Pose, pose_hand_board: Pose) -> Pose:
    return pose_world_camera.compose(one.view.pose_camera_board).compose(pose_hand_board.inverse())
