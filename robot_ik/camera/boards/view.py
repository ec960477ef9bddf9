"""One look at a board: its known points, and where they were seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.pose import estimate_body, marker_points
from robot_ik.camera.sources import Frame
from robot_ik.camera.track import MarkerTracker
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

#: Marker id -> (side in metres, ``pose_board_marker``).
Layout = Mapping[int, tuple[float, Pose]]


@dataclass(frozen=True, eq=False)
class BoardView:
    """Points of a rigid board (or cube, or single marker) in one picture.

    Attributes:
        points: (n, 3) in the board's frame, metres.
        pixels: (n, 2) where they were seen, distorted pixels.
        pose_camera_board: A first estimate of the pose.
        sigma: Standard deviation of the pixels, px.

    Raises:
        CameraError: The arrays do not belong together, a number is not finite, or points are fewer than 4.
    """

    points: Array
    pixels: Array
    pose_camera_board: Pose
    sigma: float = 0.1

    def __init__(
        self, points: ArrayLike, pixels: ArrayLike, pose_camera_board: Pose, sigma: float = 0.1
    ) -> None:
        p, x = np.array(points, dtype=float), np.array(pixels, dtype=float)
        if p.ndim != 2 or p.shape[1] != 3 or x.shape != (len(p), 2):
            raise CameraError(f"points (n, 3) and pixels (n, 2) are asked for, not {p.shape} and {x.shape}")
        if len(p) < 4:
            raise CameraError(f"{len(p)} points do not fix a pose", hint="at least 4 are needed")
        if not (np.isfinite(p).all() and np.isfinite(x).all() and 0.0 < sigma < np.inf):
            raise CameraError("a point, a pixel or the standard deviation of the pixels is not finite")
        object.__setattr__(self, "points", p)
        object.__setattr__(self, "pixels", x)
        object.__setattr__(self, "pose_camera_board", pose_camera_board)
        object.__setattr__(self, "sigma", float(sigma))


def see_board(tracker: MarkerTracker, frame: Frame, layout: Layout) -> BoardView | None:
    """The markers of ``layout`` in a frame; None when none of them gives a pose.

    Ids that come twice are left out, markers that contradict the others, and those whose edges could not be
    measured where others' could.
    """
    seen = tracker.observe(frame)
    seen = [one for one in seen if one.refined] or seen
    count = Counter(one.id for one in seen)
    used = {one.id: one for one in seen if one.id in layout and count[one.id] == 1}
    if not used:
        return None
    body = estimate_body({i: one.corners for i, one in used.items()}, layout, tracker.intrinsics)
    if body is None:
        return None
    points = [layout[i][1].apply(marker_points(layout[i][0])) for i in body.ids]
    pixels = [used[i].corners for i in body.ids]
    sigma = float(np.sqrt(np.mean([used[i].sigma ** 2 for i in body.ids])))
    return BoardView(np.concatenate(points), np.concatenate(pixels), body.pose_camera_body, sigma)


def point_jacobian(intrinsics: CameraIntrinsics, points: Array) -> Array:
    """Derivative (n, 2, 3) of distorted pixels by points (n, 3) in front of the camera, camera frame."""
    z = points[:, 2]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
    by_point[:, :, 2] = -points[:, :2] / z[:, None] ** 2
    return np.asarray(intrinsics.pixel_jacobian(points[:, :2] / z[:, None]) @ by_point)


def cross_matrices(vectors: Array) -> Array:
    """(n, 3, 3) matrices [v]x of vectors (n, 3)."""
    made = np.zeros((len(vectors), 3, 3))
    made[:, 0, 1], made[:, 0, 2], made[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    return made - made.transpose(0, 2, 1)
