"""The standard set of hand-eye calibration: views of one small marker with exact truth, to measure with.

The hardest usual case: a marker of 50 mm, 0.5 to 0.9 m away, whose pose is known to about 0.5 mm across, 1 mm
along the view and 0.3 degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.view import BoardView
from robot_ik.camera.handeye.model import HandEyeSample, Mount, Mounting
from robot_ik.camera.made_up.standard_set import STANDARD_CAMERA, STANDARD_SIZE
from robot_ik.camera.pose import marker_points
from robot_ik.geometry import Pose, rotation_exp

Array = NDArray[np.float64]

#: Standard deviation of corners (px) and of the arm's poses, each axis: metres, rad.
PIXEL, ARM = 0.1, (3e-4, float(np.deg2rad(0.05)))
# A pose estimated from four corners with 1 px of noise is off by about this: metres, rad.
_ROUGH = np.repeat((2.5e-3, 0.02), 3)


def handeye_set(
    count: int = 15,
    *,
    mounting: Mounting = "eye_in_hand",
    seed: int = 0,
    pixel: float = PIXEL,
    arm: tuple[float, float] = ARM,
    spread_deg: float = 25.0,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Mount, list[HandEyeSample]]:
    """The truth, and what an arm and a camera would say; the same seed gives the same.

    Args:
        count: Number of views.
        mounting: Who is carried.
        seed: Of everything.
        pixel: Standard deviation of the corners, px.
        arm: Standard deviation of the hand's pose, each axis: metres, rad.
        spread_deg: Standard deviation of the rotations about each axis of the camera.
        axes: Shares of it, by axis.
    """
    rng = np.random.default_rng(seed)
    points = marker_points(STANDARD_SIZE)
    truth = Mount(
        Pose(rng.normal(0, 0.05, 3), rotation_exp(rng.normal(0, 1, 3))),
        Pose(rng.normal(0, 0.3, 3), rotation_exp(rng.normal(0, 1, 3))),
        mounting,
    )
    samples = []
    for _ in range(count):
        turn = rotation_exp(np.deg2rad(spread_deg) * rng.normal(0, 1, 3) * axes)
        place = (*rng.normal(0, 0.04, 2), rng.uniform(0.5, 0.9))
        seen = Pose(place, (0, 1, 0, 0)).compose(Pose(wxyz=turn))  # facing the camera, then turned
        chain = truth.pose_parent_camera.compose(seen).compose(truth.pose_other_board.inverse())
        hand = chain if mounting == "eye_to_hand" else chain.inverse()
        pixels = STANDARD_CAMERA.project(seen.apply(points)) + rng.normal(0, 1, (4, 2)) * pixel
        said = Pose.exp(rng.normal(0, 1, 6) * np.repeat(arm, 3))
        rough = Pose.exp(rng.normal(0, pixel, 6) * _ROUGH)
        view = BoardView(points, pixels, seen.compose(rough), max(pixel, 0.01))
        samples.append(HandEyeSample(hand.compose(said), view))
    return truth, samples
