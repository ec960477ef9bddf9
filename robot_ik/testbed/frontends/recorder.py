"""The front end without a screen: each view becomes a picture and a row of numbers.

Robots are drawn by the artists of ``robot-ik ar``: MuJoCo's OpenGL renderer where it works, else the painter,
which needs nothing.  Pictures are BGR.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.drawing.overlay import write as put_text
from robot_ik.camera.drawing.renderers import Artist, DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.files import write_atomically
from robot_ik.geometry import Pose
from robot_ik.motion.keyframes import column_names
from robot_ik.motion.trajectory import csv_table
from robot_ik.ports import Array, Image
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import (
    BALL_RADIUS,
    FIELD_OF_VIEW,
    GOAL_COLOUR,
    INSTANCE_COLOURS,
    Arrangement,
    Colour,
    arranged,
)
from robot_ik.testbed.session import Session, View

_GROUND, _CELL = (249, 247, 246), (226, 219, 214)
_INK = (60, 50, 45)
_GRID_STEP, _GRID_CELLS = 0.5, 12
_LETTER = 0.022  # height of letters over the picture's
_NEAR = 0.05  # metres before the lens: what is nearer is not drawn


class Recorder:
    """The front end ``recorder``.

    Args:
        session: What is filmed.
        artist: Draws a robot.
        size: Width and height of the pictures, pixels.
        write: Takes the pictures (height, width, 3) BGR with their times, s; None: only numbers are kept.
    """

    def __init__(
        self,
        session: Session,
        artist: Artist,
        size: tuple[int, int] = (1280, 720),
        write: Callable[[Image, float], None] | None = None,
    ) -> None:
        self.session, self._artist, self._size, self._write = session, artist, size, write
        self._robot: Robot | None = None
        self._count = 0
        self._rows: list[list[object]] = []

    def draw(self, view: View) -> None:
        """One picture and one row for each instance."""
        if self._write is not None:
            self._write(self.picture(view), view.now)
        names = column_names(self.session.robot)
        for k, one in enumerate(view.instances):
            angles = zip(names, one.q.tolist(), strict=True)
            self._rows.append(
                [
                    view.tick, f"{view.now:.6f}", view.robot, k + 1, one.method, one.status, one.iterations,
                    *view.ball.position.tolist(), one.error, one.angle,
                    f"{one.statistics.mean:.9f}", f"{one.statistics.solved:.4f}",
                    " ".join(f"{name}={value!r}" for name, value in angles),
                ]
            )  # fmt: skip

    def save_numbers(self, path: Path) -> None:
        """Writes a CSV file: a row for each instance of each view.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(path, csv_table(COLUMNS, self._rows))

    def picture(self, view: View) -> Image:
        """What a camera in front of the robots sees, with the statistics in a corner."""
        if self._robot is not self.session.robot or self._count != view.count:
            self._robot, self._count = self.session.robot, view.count
            self._set_up(self._robot, view.count)
        width, height = self._size
        image = np.full((height, width, 3), _GROUND, np.uint8)
        self._lines(image, self._grid, _CELL, 1)
        for k in self._order:
            one, offset = view.instances[k], self._arrangement.offsets[k]
            if view.count > 1:
                self._plate(image, k)
            figure = DrawnRobot(self.session.robot.model)
            seen_from = Pose(self._camera.position - offset, self._camera.wxyz)
            qpos = self.session.robot.qpos(one.q)
            self._artist.draw(figure, qpos, self._lens, seen_from).over(image)
            if len(one.trail) > 1:
                self._lines(image, [one.trail + offset], INSTANCE_COLOURS[k][::-1], max(1, height // 300))
            self._ball(image, np.array(view.ball.position) + offset)
        self._caption(image, view)
        return image

    def _set_up(self, robot: Robot, count: int) -> None:
        """Lens, camera and ground for a robot."""
        width, height = self._size
        focal = 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW)
        self._lens = CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self._arrangement: Arrangement = arranged(robot, count)
        position, look = self._arrangement.camera(self.session.ball_path(), width / height)
        self._camera = Pose.look_at(position, look)
        away = np.linalg.norm(self._arrangement.offsets - position, axis=1)
        self._order = np.argsort(-away).tolist()
        reach = _GRID_CELLS * _GRID_STEP * max(0.5, self._arrangement.extent)
        ticks = np.linspace(-reach, reach, 2 * _GRID_CELLS + 1)
        along = np.linspace(-reach, reach, 60)
        self._grid = [np.column_stack([np.full(60, x), along, np.zeros(60)]) for x in ticks]
        self._grid += [np.column_stack([along, np.full(60, x), np.zeros(60)]) for x in ticks]

    def _seen(self, points: Array) -> tuple[Array, Array]:
        """Pixels (n, 2) and depths (n,) of points (n, 3)."""
        inside = (points - self._camera.position) @ self._camera.rotation
        return self._lens.project(inside), inside[:, 2]

    def _lines(self, image: Image, lines: list[Array], colour: Colour, thickness: int) -> None:
        for line in lines:
            pixels, depth = self._seen(line)
            good = (depth > _NEAR) & (np.abs(pixels) < 1e4).all(axis=1)
            if good.sum() > 1:
                row = np.round(16.0 * pixels[good]).astype(np.int32)
                cv2.polylines(image, [row], False, colour, thickness, cv2.LINE_AA, 4)

    def _plate(self, image: Image, k: int) -> None:
        angle = np.linspace(0.0, 2.0 * np.pi, 48)
        radius = 0.21 * self._arrangement.extent
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(48)])
        pixels, depth = self._seen(ring + self._arrangement.offsets[k])
        if (depth > _NEAR).all():
            shade = image.copy()
            cv2.fillPoly(shade, [np.round(pixels).astype(np.int32)], INSTANCE_COLOURS[k][::-1], cv2.LINE_AA)
            cv2.addWeighted(shade, 0.4, image, 0.6, 0.0, image)

    def _ball(self, image: Image, position: Array) -> None:
        pixels, depth = self._seen(position[None])
        if depth[0] > _NEAR and (np.abs(pixels) < 1e4).all():
            radius = BALL_RADIUS * self._arrangement.extent * self._lens.fx / float(depth[0])
            x, y = np.round(16.0 * pixels[0]).astype(int).tolist()
            cv2.circle(image, (x, y), round(16.0 * radius), GOAL_COLOUR[::-1], -1, cv2.LINE_AA, 4)

    def _caption(self, image: Image, view: View) -> None:
        """A line for each instance: method, steps, share solved, error."""
        size = max(10, round(_LETTER * image.shape[0]))
        for k, one in enumerate(view.instances):
            y = round((1.6 * k + 1.5) * size)
            colour = INSTANCE_COLOURS[k][::-1]
            cv2.rectangle(image, (size, y - size), (2 * size, y), colour, -1)
            put_text(image, f"{one.method}: {one.summary}", (round(2.5 * size), y), size, _INK)


COLUMNS = (
    "tick", "time_s", "robot", "instance", "method", "status", "iterations", "ball_x", "ball_y", "ball_z",
    "error_m", "angle_rad", "mean_s", "solved", "q",
)  # fmt: skip
"""Of the CSV file."""
