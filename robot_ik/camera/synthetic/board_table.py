"""Synthetic scene for augmented reality: a table, a moving printed board, a marker above it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.camera import (
    SyntheticMarker,
    SyntheticScene,
    SyntheticSource,
)
from robot_ik.camera.synthetic.painted import SceneTable
from robot_ik.camera.targets import marker_grid
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import VirtualClock

#: The board of the scene: 2 x 2 markers of 50 mm, 12.5 mm apart, as `robot-ik camera print board`
#: prints it.
BOARD = "grid:2x2:50:12.5"
#: Marker that can be followed: id and side in metres.
FOLLOWED = (9, 0.05)
_DICTIONARY = "DICT_5X5_50"
# Id of the sheet of paper below the markers. It is not on the board.
_SHEET = 49
# Period of the board's motion, s.
_PERIOD = 5.0
# Period of the carried marker's motion, s.
_CARRIED_PERIOD = 4.0
# Position of the camera, world, metres.
_EYE = (0.10, -0.80, 0.62)
# Point that the camera looks at, world, metres.
_TARGET = (0.0, 0.06, 0.10)


@dataclass(frozen=True)
class BoardMotion:
    """Motion of the board: a sine along each direction.

    Attributes:
        slide: Amplitudes to the side and away from the camera, metres.
        yaw: Amplitude about the vertical, rad.
        middle: Middle of the motion on the table, metres.
    """

    slide: tuple[float, float] = (0.05, 0.03)
    yaw: float = 0.35
    middle: tuple[float, float] = (0.0, 0.04)

    def pose(self, t: float) -> Pose:
        """Return ``pose_world_board`` at time ``t``, s, on top of the table."""
        a = 2.0 * np.pi * t / _PERIOD
        x, y = self.middle
        position = (x + self.slide[0] * np.sin(a), y + self.slide[1] * np.sin(2.0 * a), 0.0005)
        return Pose(position, rotation_exp([0.0, 0.0, self.yaw * np.sin(a)]))


#: The board lies still in the middle, so that its frame is the table's.
AT_REST = BoardMotion((0.0, 0.0), 0.0, middle=(0.0, 0.0))


def lens(width: int, height: int) -> CameraIntrinsics:
    """Return a webcam's intrinsics at this size, with distortion and a decentred lens."""
    base = CameraIntrinsics(
        1280, 960, 1150.0, 1150.0, 648.0, 471.0, (-0.14, 0.05, 0.0005, -0.0003, 0.0)
    )
    share = width / base.width
    focal = base.fx * share
    cx = (base.cx + 0.5) * share - 0.5
    # The picture is the middle strip of the sensor.
    cy = (base.cy + 0.5) * share - 0.5 - 0.5 * (base.height * share - height)
    return CameraIntrinsics(width, height, focal, focal, cx, cy, base.distortion)


def carried_marker(t: float) -> Pose:
    """Return the pose of the marker to follow at time ``t``, s: above the table."""
    a = 2.0 * np.pi * t / _CARRIED_PERIOD
    position = (0.20 + 0.05 * np.sin(a), 0.10, 0.22 + 0.06 * np.cos(a))
    return Pose(position, rotation_exp([1.0, 0.0, 0.0]))


def synthetic_scene(
    width: int = 1280,
    height: int = 720,
    *,
    motion: BoardMotion = BoardMotion(),
    occluders: mujoco.MjModel | None = None,
    follow: bool = False,
    seed: int = 0,
) -> tuple[SyntheticSource, VirtualClock]:
    """Return the camera and its virtual clock.

    Args:
        width: Of the pictures, px.
        height: Of the pictures, px.
        motion: How the board moves.
        occluders: Objects on the table, in the world's frame.
        follow: Whether the marker to follow is in the scene.
        seed: Of the camera's noise.
    """
    scene = board_table(width, height, motion=motion, occluders=occluders, follow=follow)
    clock = VirtualClock()
    return SyntheticSource(scene, lambda: np.zeros(0), seed=seed, clock=clock), clock


def board_table(
    width: int,
    height: int,
    *,
    motion: BoardMotion = BoardMotion(),
    occluders: mujoco.MjModel | None = None,
    follow: bool = False,
) -> SyntheticScene:
    """Return the scene. The arguments are those of ``synthetic_scene``."""
    board = marker_grid(2, 2, 0.05, 0.0125, dictionary=_DICTIONARY)

    def on_board(pose: Pose) -> Callable[[float], Pose]:
        return lambda t: motion.pose(t).compose(pose)

    # One sheet of paper lies below all markers.
    sheet = SyntheticMarker(
        _SHEET, 0.15, on_board(Pose((0.0, 0.0, -2e-4))), margin=0.0, condition="blank"
    )
    markers = [sheet] + [
        SyntheticMarker(id, side, on_board(pose), dictionary=_DICTIONARY, margin=0.006)
        for id, (side, pose) in board.markers.items()
    ]
    if follow:
        markers.append(
            SyntheticMarker(FOLLOWED[0], FOLLOWED[1], carried_marker, dictionary=_DICTIONARY)
        )
    return SyntheticScene(
        mujoco.MjSpec().compile() if occluders is None else occluders,
        lens(width, height),
        Pose.look_at(_EYE, _TARGET),
        tuple(markers),
        table=SceneTable(0.0, (-0.55, 0.55), (-0.40, 0.45)),
    )
