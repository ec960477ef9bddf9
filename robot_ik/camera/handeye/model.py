"""Where a carried camera or a carried board puts the board's points in the picture, and its derivatives.

Frames: the *parent* carries the camera, the *other* carries the board, and one of the two is the arm's hand:

* eye in hand: parent = hand, other = world; ``pose_parent_other`` = inverse of ``pose_world_hand``,
* eye to hand: parent = world, other = hand; ``pose_parent_other`` = ``pose_world_hand``.

In both, ``pose_camera_board`` = inverse(X) M Y with X = ``pose_parent_camera``, M = ``pose_parent_other``,
Y = ``pose_other_board``.  Twists are translation (m) over rotation (rad).  Those of X and Y are along the
axes of parent and other, the rotation about the origin of camera and board; that of the hand is in its axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.view import BoardView, cross_matrices, point_jacobian
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose, quat_multiply, rotation_exp

Array = NDArray[np.float64]
Mounting = Literal["eye_in_hand", "eye_to_hand"]
MOUNTINGS: tuple[Mounting, ...] = ("eye_in_hand", "eye_to_hand")

# Nearer than this (or behind) there is no picture; the derivative is taken here instead, metres.
_NEAREST = 1e-3


@dataclass(frozen=True, eq=False)
class HandEyeSample:
    """The arm stood still, and a picture was taken.

    Attributes:
        pose_world_hand: Where the arm says that its hand was.
        view: The board in the picture.
    """

    pose_world_hand: Pose
    view: BoardView

    def pose_parent_other(self, mounting: Mounting) -> Pose:
        """M of the module's text."""
        return self.pose_world_hand.inverse() if mounting == "eye_in_hand" else self.pose_world_hand


@dataclass(frozen=True, eq=False)
class Mount:
    """The two unknowns.

    Attributes:
        pose_parent_camera: X.
        pose_other_board: Y.
        mounting: Who is carried.
    """

    pose_parent_camera: Pose
    pose_other_board: Pose
    mounting: Mounting

    def moved(self, step: Array) -> Mount:
        """Both poses moved by twists (12,): the camera's, then the board's."""
        return Mount(
            moved(self.pose_parent_camera, step[:6]), moved(self.pose_other_board, step[6:]), self.mounting
        )

    def pose_camera_board(self, sample: HandEyeSample) -> Pose:
        """Where the board should be seen."""
        chain = sample.pose_parent_other(self.mounting).compose(self.pose_other_board)
        return self.pose_parent_camera.inverse().compose(chain)

    def miss(self, sample: HandEyeSample, intrinsics: CameraIntrinsics) -> Array:
        """(n, 2) predicted minus seen, px; NaN behind the camera."""
        view = sample.view
        return np.asarray(intrinsics.project(self.pose_camera_board(sample).apply(view.points)) - view.pixels)


def moved(pose: Pose, twist: Array) -> Pose:
    """``pose`` moved by a twist (6,) along the axes it is seen from, rotation about its own origin."""
    return Pose(pose.position + twist[:3], quat_multiply(rotation_exp(twist[3:]), pose.wxyz))


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
    by_parent = point_jacobian(intrinsics, in_camera) @ x.rotation.T  # (n, 2, 3): pixels by points in parent
    by_other = by_parent @ chain.rotation
    n = len(in_other)
    shared = np.empty((n, 2, 12))
    shared[:, :, :3] = -by_parent
    shared[:, :, 3:6] = by_parent @ cross_matrices(in_parent - x.position)
    shared[:, :, 6:9] = by_other
    shared[:, :, 9:] = -by_other @ cross_matrices(in_other - y.position)
    # Eye in hand, the points of a resting board move backwards in the hand; eye to hand they go with it.
    along, at, sign = (
        (by_parent, in_parent, -1.0) if mount.mounting == "eye_in_hand" else (by_other, in_other, 1.0)
    )
    hand = np.concatenate([sign * along, -sign * along @ cross_matrices(at)], axis=2)
    return miss.ravel(), shared.reshape(2 * n, 12), hand.reshape(2 * n, 6)


@dataclass(frozen=True, eq=False)
class Compressed:
    """All views, each boiled down to what it says of the hand: n small Gaussians instead of all corners.

    A change of camera or board moves a view's points exactly as some motion of the hand does.  So a view is
    summed up by the twist of the hand that it would like best, with a covariance: nothing is lost.

    Attributes:
        wish: (n, 6) twist of the hand with which the view's own corners fit best.
        covariance: (n, 6, 6) of the wish, from the pixels alone.
        by_shared: (n, 6, 12) by how much camera and board (12,) change it.
        left: For each view (k,) how far each corner is off after that, in its standard deviations.
        freedom: How many numbers ``left`` is made of, less those that were fitted.
    """

    wish: Array
    covariance: Array
    by_shared: Array
    left: tuple[Array, ...]
    freedom: int


def compress(
    mount: Mount,
    samples: Sequence[HandEyeSample],
    intrinsics: CameraIntrinsics,
    weights: Sequence[Array] | None = None,
) -> Compressed:
    """Each view linear at ``mount``.

    Args:
        mount: Where camera and board are thought to be.
        samples: The views.
        intrinsics: Of the pictures' size.
        weights: Of each corner of each view, (k,) each; 1 when not given.
    """
    wishes, covariances, rows, left = [], [], [], []
    for k, sample in enumerate(samples):
        miss, shared, hand = view_derivatives(mount, sample, intrinsics)
        w = (np.ones(len(miss)) if weights is None else np.repeat(weights[k], 2)) / sample.view.sigma**2
        covariance = np.linalg.pinv(hand.T @ (w[:, None] * hand), rcond=1e-13, hermitian=True)
        wish = -covariance @ (hand.T @ (w * miss))
        wishes.append(wish)
        covariances.append(covariance)
        rows.append(-covariance @ (hand.T @ (w[:, None] * shared)))
        rest = (miss + hand @ wish).reshape(-1, 2) / sample.view.sigma
        left.append(np.linalg.norm(rest, axis=1))
    freedom = sum(2 * len(one) - 6 for one in left)
    return Compressed(np.array(wishes), np.array(covariances), np.array(rows), tuple(left), freedom)
