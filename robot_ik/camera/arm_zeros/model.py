"""What self-calibration sees: an arm whose joints may be off by constants, a camera and a board.

Each view is boiled down to the twist of the hand that its picture asks for (``handeye_model.compress``); a
change of the joints' offsets moves the hand too, so all unknowns enter those six numbers linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.boards.view import BoardView
from robot_ik.camera.handeye.model import Compressed, HandEyeSample, Mount, Mounting, compress
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose, quat_multiply, rotation_log
from robot_ik.robot_description import Robot

Array = NDArray[np.float64]

#: Numbers of the two poses: the camera's twist, then the board's.
POSES = 12


@dataclass(frozen=True, eq=False)
class KnownPose:
    """A pose and how well it is known.

    Attributes:
        pose: Best guess.
        covariance: (6, 6) translation (m) over rotation (rad), along the axes it is seen from, rotation about
            its own origin; as ``CameraPlace.covariance``.

    Raises:
        CalibrationError: The covariance is no positive definite (6, 6).
    """

    pose: Pose
    covariance: Array

    def __init__(self, pose: Pose, covariance: ArrayLike) -> None:
        c = np.array(covariance, dtype=float)
        if c.shape != (6, 6) or not np.isfinite(c).all() or np.linalg.eigvalsh(c)[0] <= 0.0:
            raise CalibrationError(
                "how well a pose is known is a positive definite (6, 6) covariance",
                hint="a pose known exactly: give a small standard deviation, not 0",
            )
        object.__setattr__(self, "pose", pose)
        object.__setattr__(self, "covariance", c)

    @classmethod
    def within(cls, pose: Pose, position: float, angle: float) -> KnownPose:
        """Known to these standard deviations of each axis, metres and rad."""
        return cls(pose, np.diag([position**2] * 3 + [angle**2] * 3))

    def off(self, pose: Pose) -> Array:
        """Twist (6,) from this pose to another: ``moved(self.pose, twist)`` is that one."""
        inverse = self.pose.wxyz * (1.0, -1.0, -1.0, -1.0)
        turn = rotation_log(quat_multiply(pose.wxyz, inverse))
        return np.concatenate([pose.position - self.pose.position, turn])


@dataclass(frozen=True, eq=False)
class ArmView:
    """The arm stood still, its joints were read, a picture was taken.

    Attributes:
        q: (nq,) as the servos say.
        view: The board in the picture.
    """

    q: Array
    view: BoardView


@dataclass(frozen=True, eq=False)
class ArmState:
    """The unknowns.

    Attributes:
        offsets: (nv,) to be added to what the servos say, rad (m for slides).
        mount: Camera and board.
    """

    offsets: Array
    mount: Mount

    def moved(self, step: Array) -> ArmState:
        """Moved by offsets (nv,) and the two twists (12,)."""
        n = len(self.offsets)
        return ArmState(self.offsets + step[:n], self.mount.moved(step[n:]))


@dataclass(frozen=True, eq=False)
class Linear:
    """All views, linear at one state, and what is known of the poses beforehand.

    Attributes:
        wish: (n, 6) twist of the hand, in its axes, that each picture asks for.
        pixels: (n, 6, 6) covariance of it from the corners alone.
        rows: (n, 6, nv + 12) by how much the unknowns change it.
        arm: (n, 6, 6) covariance that one rad of error in each joint would give it.
        prior: (nv + 12, nv + 12) information on the poses; ``off``: (nv + 12,) from where they were thought.
        data: What ``compress`` gave.
    """

    wish: Array
    pixels: Array
    rows: Array
    arm: Array
    prior: Array
    off: Array
    data: Compressed

    def scaled(self, pixel_scale: float) -> Linear:
        """The same with corners that are worse by a factor."""
        return replace(self, pixels=self.pixels * pixel_scale**2)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """What does not change while the unknowns are sought.

    Attributes:
        robot: All its joints are in ``q`` (nq = nv).
        frame: What carries board (eye to hand) or camera (eye in hand).
        intrinsics: Of the camera.
        views: The measurements.
        camera, board: What is known beforehand.
        mounting: Who is carried.
    """

    robot: Robot
    frame: str
    intrinsics: CameraIntrinsics
    views: Sequence[ArmView]
    camera: KnownPose
    board: KnownPose
    mounting: Mounting

    def start(self) -> ArmState:
        """No offsets, the poses as they are thought to be."""
        mount = Mount(self.camera.pose, self.board.pose, self.mounting)
        return ArmState(np.zeros(self.robot.nv), mount)

    def hand(self, state: ArmState, view: ArmView) -> Pose:
        """``pose_world_hand`` with the offsets."""
        return self.robot.forward(view.q + state.offsets, self.frame)

    def samples(self, state: ArmState) -> list[HandEyeSample]:
        """The views, with the hand where the offsets put it."""
        return [HandEyeSample(self.hand(state, one), one.view) for one in self.views]

    def linear(self, state: ArmState, weights: Sequence[Array] | None = None) -> Linear:
        """All views at ``state``; ``weights`` of their corners as for ``compress``."""
        samples = self.samples(state)
        data = compress(state.mount, samples, self.intrinsics, weights)
        by_joint = np.array([self._hand_jacobian(state, one) for one in self.views])
        rows = np.concatenate([-by_joint, data.by_shared], axis=2)
        n = self.robot.nv
        prior, off = np.zeros((n + POSES, n + POSES)), np.zeros(n + POSES)
        prior[n : n + 6, n : n + 6] = np.linalg.inv(self.camera.covariance)
        prior[n + 6 :, n + 6 :] = np.linalg.inv(self.board.covariance)
        off[n : n + 6] = self.camera.off(state.mount.pose_parent_camera)
        off[n + 6 :] = self.board.off(state.mount.pose_other_board)
        arm = by_joint @ by_joint.transpose(0, 2, 1)
        return Linear(data.wish, data.covariance, rows, arm, prior, off, data)

    def _hand_jacobian(self, state: ArmState, view: ArmView) -> Array:
        """(6, nv) twist of the hand, in its own axes, by the joints."""
        q = view.q + state.offsets
        turn = self.robot.forward(q, self.frame).rotation.T
        jacobian = self.robot.jacobian(q, self.frame)
        return np.concatenate([turn @ jacobian[:3], turn @ jacobian[3:]])

    def apart(self, state: ArmState, view: ArmView) -> tuple[Array, float]:
        """Where the picture shows the carried thing less where the joints put it: world, metres (3,), rad.

        Eye to hand it is the board; eye in hand, the camera.
        """
        mount, hand = state.mount, self.hand(state, view)
        seen = view.view.pose_camera_board
        if self.mounting == "eye_to_hand":
            found, expected = mount.pose_parent_camera.compose(seen), hand.compose(mount.pose_other_board)
        else:
            found = mount.pose_other_board.compose(seen.inverse())
            expected = hand.compose(mount.pose_parent_camera)
        return found.position - expected.position, found.distance(expected)[1]
