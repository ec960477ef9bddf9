"""A first answer for the hand-eye problem AX = XB, and whether the motions can answer it at all.

Two views i, j give A = M_i inverse(M_j), a motion known from the arm, and B = C_i inverse(C_j), the same
motion seen by the camera; X turns one into the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.handeye.model import HandEyeSample, Mount, Mounting
from robot_ik.camera.handeye.rotation_average import cauchy_weight, robust_mean_pose, rotation_spread
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose, rotation_log

Array = NDArray[np.float64]

LEAST_VIEWS = 4
#: Standard deviation of the rotations, in rad: about the axis they are spread most about, and the second.
LEAST_SPREAD = np.deg2rad((6.0, 3.0))
# Turns of nearly half a circle have no axis that can be told from its opposite.
_LARGEST_TURN = np.deg2rad(170.0)
_ROUNDS = 8
_LEAST_ANGLE, _LEAST_LENGTH = np.deg2rad(0.05), 1e-4
_MEDIAN_TO_SIGMA = 1.4826


def require_diversity(samples: Sequence[HandEyeSample]) -> Array:
    """Checks that the hand was turned enough, about more than one axis.

    With rotations about one axis only, the camera's place along it is free; small rotations magnify every
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
            "so the place of the camera along that axis cannot be known",
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
    seen = [sample.view.pose_camera_board for sample in samples]
    pairs = [(i, j) for i in range(len(samples)) for j in range(i)]
    motions = [(chains[i].compose(chains[j].inverse()), seen[i].compose(seen[j].inverse())) for i, j in pairs]
    turn_a = np.array([rotation_log(a.wxyz) for a, _ in motions])
    turn_b = np.array([rotation_log(b.wxyz) for _, b in motions])
    angle_a, angle_b = np.linalg.norm(turn_a, axis=1), np.linalg.norm(turn_b, axis=1)
    told = (angle_a < _LARGEST_TURN) & (angle_b < _LARGEST_TURN)
    weights = _weights(angle_a - angle_b, _LEAST_ANGLE) * told
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        rotation = _turning(turn_a, turn_b, weights)
        weights = _weights(np.linalg.norm(turn_a - turn_b @ rotation.T, axis=1), _LEAST_ANGLE) * told
    position = _translation(motions, rotation, weights)
    camera = Pose.from_rotation(rotation, position)
    boards = [chain.inverse().compose(camera).compose(pose) for chain, pose in zip(chains, seen, strict=True)]
    return Mount(camera, robust_mean_pose(boards)[0], mounting)


def _weights(misses: Array, least: float) -> Array:
    scale = max(_MEDIAN_TO_SIGMA * float(np.median(np.abs(misses))), least)
    return cauchy_weight(misses / scale)


def _turning(a: Array, b: Array, weights: Array) -> Array:
    """Rotation (3, 3) with the least sum of w |a - R b|^2, of vectors (n, 3)."""
    u, _, vt = np.linalg.svd((weights[:, None] * a).T @ b)
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    return np.asarray(u @ flip @ vt)


def _translation(motions: Sequence[tuple[Pose, Pose]], rotation: Array, weights: Array) -> Array:
    left = np.array([a.rotation - np.eye(3) for a, _ in motions])
    right = np.array([rotation @ b.position - a.position for a, b in motions])
    position = np.zeros(3)
    for _ in range(_ROUNDS):
        normal = np.einsum("n,nij,nik->jk", weights, left, left)
        position = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weights, left, right))
        weights = _weights(np.linalg.norm(left @ position - right, axis=1), _LEAST_LENGTH)
    return np.asarray(position)
