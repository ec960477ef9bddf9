"""Films of the figure and its ball on a tiled floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robot_ik.camera.drawing.overlay import put_label
from robot_ik.camera.drawing.studio import Body, ball_model, photograph, tiled_room
from robot_ik.camera.drawing.text import text_size
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.figure.figure import RATE
from robot_ik.figure.session import FigureFrame
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image
from robot_ik.robot import Robot
from robot_ik.testbed.ar.overlay import PictureProgress, heights
from robot_ik.workcell.films import open_sink

SIZE = (960, 720)
"""Width and height of a film, px. Those of a GIF are half as large."""

FRAMES_PER_PICTURE = 2
"""Frames of the figure for each picture of a film."""

FRAMES_PER_GIF_PICTURE = 4
"""Frames of the figure for each picture of a GIF, which is a large file."""

CAMERA_FOLLOW_RATE = 2.0
"""1/s. The distance of the camera's target from the figure shrinks at this rate."""

CAMERA_OFFSET = np.array([1.5, -1.95, 0.52])
"""Position of the camera from its target, in heights of the robot."""

FOCAL = 1.35
"""Focal length of the camera, in heights of the picture."""

TARGET_HEIGHT = 0.54
"""Height of the camera's target above the floor, in heights of the robot."""

BALL_SHARE = 0.3
"""Part of the way to the ball by which the target of the camera moves."""

LONGEST_BALL_OFFSET = 2.0
"""m. A ball that is farther away moves the target of the camera as one at this distance."""

BALL_RADIUS = 0.05
"""Radius of the ball, m."""

BALL_RGBA = (0.85, 0.2, 0.15, 1.0)
"""Colour of the ball."""

TILE_SIDE = 1.0
"""Side of a tile of the floor, m."""

TILE_SHADES = ((0.87, 0.87, 0.85, 1.0), (0.80, 0.80, 0.78, 1.0))
"""Colours rgba of the tiles in the MuJoCo window."""

TILE_COUNT = 8
"""Tiles of the floor in the MuJoCo window, in each direction from the middle one."""

TILES = tuple(
    ((float(i), float(j), -0.011), (0.5, 0.5, 0.01), TILE_SHADES[(i + j) % 2])
    for i in range(-TILE_COUNT, TILE_COUNT + 1)
    for j in range(-TILE_COUNT, TILE_COUNT + 1)
)
"""Floor of the MuJoCo window: middle (m), half sides (m) and colour rgba of each tile."""

MARGIN = 8
"""Distance of the caption from the border of the picture, px."""


class FilmMaker:
    """Takes pictures of frames. The camera follows the figure.

    Args:
        robot: The robot.
        size: Width and height of the pictures, px.
    """

    def __init__(self, robot: Robot, size: tuple[int, int] = SIZE) -> None:
        width, height = size
        self._robot = robot
        self._height = heights(robot)[1]
        self._letter_size = max(11, width // 44)
        focal = FOCAL * height
        self._lens = CameraIntrinsics(*size, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self._room = tiled_room(4.0 * self._height, TILE_SIDE)
        self._ball = ball_model(BALL_RADIUS, BALL_RGBA)
        self._target: Array | None = None

    def picture(self, frame: FigureFrame) -> Image:
        """Return the picture (h, w, 3) of the next frame, BGR."""
        bodies = [Body(self._robot.model, frame.q)]
        if np.isfinite(frame.ball).all():
            bodies.append(Body(self._ball, [], Pose(frame.ball)))
        target = self._next_target(frame)
        camera = Pose.look_at(target + self._height * CAMERA_OFFSET, target)
        subject = (float(target[0]), float(target[1]))
        photo = photograph(bodies, self._lens, camera, self._room, subject=subject)
        corner = (MARGIN, self._lens.height - MARGIN)
        return put_label(photo.image, self.caption(frame), corner, size=self._letter_size)

    def caption(self, frame: FigureFrame) -> str:
        """Return action and reason, in lines that fit into the picture."""
        width = self._lens.width - 2 * MARGIN - 2 * self._letter_size
        return "\n".join([frame.action, *_lines(frame.decision.reason, width, self._letter_size)])

    def _next_target(self, frame: FigureFrame) -> Array:
        """Return the point (3,) at which the camera looks, m. It moves a step to the figure."""
        target = np.array([frame.q[0], frame.q[1], TARGET_HEIGHT * self._height])
        if np.isfinite(frame.ball).all():
            offset = (frame.ball - target) * [1, 1, 0]
            distance = max(float(np.linalg.norm(frame.ball - target)), 1e-9)
            target = target + BALL_SHARE * min(1.0, LONGEST_BALL_OFFSET / distance) * offset
        if self._target is None:
            self._target = target
        self._target = self._target + (target - self._target) * min(1.0, CAMERA_FOLLOW_RATE / RATE)
        return self._target


def _lines(text: str, width: int, size: int) -> list[str]:
    """Return text in lines that are at most ``width`` px wide, with letters of ``size`` px."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_size(longer, size)[0] > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def save_film(
    robot: Robot,
    frames: Sequence[FigureFrame],
    path: Path,
    progress: PictureProgress = lambda _done, _total: None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a film of frames, as ``open_sink`` opens it.

    Raises:
        MissingExtraError: The extra ``video`` is not installed.
        OutputError: The file cannot be written.
    """
    size = SIZE
    step = FRAMES_PER_PICTURE
    if path.suffix.lower() == ".gif":
        size = (SIZE[0] // 2, SIZE[1] // 2)
        step = FRAMES_PER_GIF_PICTURE
    maker = FilmMaker(robot, size)
    shown = frames[::step]
    with open_sink(path, RATE / step, overwrite=overwrite) as sink:
        for done, frame in enumerate(shown, start=1):
            sink.write(maker.picture(frame), frame.t)
            progress(done, len(shown))
