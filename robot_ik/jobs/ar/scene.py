"""The synthetic scene of ``robot-ik ar``: a table, a printed board that a hand moves, a marker above."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_ik.camera.boards.board import MarkerBoard
from robot_ik.camera.bodies import grid_body
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.camera import SyntheticMarker, SyntheticScene, SyntheticSource, look_at
from robot_ik.camera.synthetic.scene import SceneTable
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import VirtualClock

#: The board of the scene: 2 x 2 markers of 50 mm, 12.5 mm apart, as `robot-ik camera print board` prints it.
BOARD = "grid:2x2:50:12.5"
#: Marker that can be followed: id and side in metres.
FOLLOWED = (9, 0.05)
_DICTIONARY = "DICT_5X5_50"
# An id that is not searched for.
_SHEET = 49
# Of the board's motion, seconds.
_PERIOD = 5.0
_EYE, _TARGET = (0.10, -0.80, 0.62), (0.0, 0.06, 0.10)


@dataclass(frozen=True)
class BoardMotion:
    """How the board is moved about: sines with an amplitude each.

    Metres to the side and away, radians about the vertical, about a ``middle`` on the table, metres.
    """

    slide: tuple[float, float] = (0.05, 0.03)
    yaw: float = 0.35
    middle: tuple[float, float] = (0.0, 0.04)

    def pose(self, t: float) -> Pose:
        """``pose_world_board`` at time t, on the table's top."""
        a = 2.0 * np.pi * t / _PERIOD
        x, y = self.middle
        position = (x + self.slide[0] * np.sin(a), y + self.slide[1] * np.sin(2.0 * a), 0.0005)
        return Pose(position, rotation_exp([0.0, 0.0, self.yaw * np.sin(a)]))


#: The board lies still in the middle, so that its frame is the table's.
AT_REST = BoardMotion((0.0, 0.0), 0.0, middle=(0.0, 0.0))


def lens(width: int, height: int) -> CameraIntrinsics:
    """A webcam's optics at this size: distortion, middle not quite in the middle."""
    base = CameraIntrinsics(1280, 960, 1150.0, 1150.0, 648.0, 471.0, (-0.14, 0.05, 0.0005, -0.0003, 0.0))
    share = width / base.width
    focal, cx = base.fx * share, (base.cx + 0.5) * share - 0.5
    # the picture is the middle strip of the sensor's
    cy = (base.cy + 0.5) * share - 0.5 - 0.5 * (base.height * share - height)
    return CameraIntrinsics(width, height, focal, focal, cx, cy, base.distortion)


def carried_marker(t: float) -> Pose:
    """Where the marker to follow is at time t: held up above the table."""
    a = 2.0 * np.pi * t / 4.0
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
    """The camera and its clock, which stands until somebody lets it go on.

    ``occluders`` stand on the table, in the world's frame; to ``follow``, the other marker is there, too.
    """
    board = MarkerBoard(grid_body(2, 2, 0.05, 0.0125).markers, _DICTIONARY)

    def on_board(pose: Pose) -> Callable[[float], Pose]:
        return lambda t: motion.pose(t).compose(pose)

    # one sheet of paper below all of them
    sheet = SyntheticMarker(_SHEET, 0.15, on_board(Pose((0.0, 0.0, -2e-4))), margin=0.0, condition="blank")
    markers = [sheet] + [
        SyntheticMarker(id, side, on_board(pose), dictionary=_DICTIONARY, margin=0.006)
        for id, (side, pose) in board.layout.items()
    ]
    if follow:
        markers.append(SyntheticMarker(FOLLOWED[0], FOLLOWED[1], carried_marker, dictionary=_DICTIONARY))
    scene = SyntheticScene(
        mujoco.MjSpec().compile() if occluders is None else occluders,
        lens(width, height),
        look_at(_EYE, _TARGET),
        tuple(markers),
        table=SceneTable(0.0, (-0.55, 0.55), (-0.40, 0.45)),
    )
    clock = VirtualClock()
    return SyntheticSource(scene, lambda: np.zeros(0), seed=seed, clock=clock, quality="fast"), clock
