"""The front end without a screen: it turns each view into a picture.

The painter draws robots, balls and a tiled floor. It needs no OpenGL. Pictures are BGR.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache

import cv2
import mujoco
import numpy as np

from robot_ik.camera.drawing.studio import Body, ball_model, photograph, tiled_room
from robot_ik.camera.drawing.text import write as put_text
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
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
    rgba_of,
)
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

_INK = (60, 50, 45)
"""Colour of letters, BGR."""

_TILE_SIDE = 0.5
"""Side of a tile of the floor, in extents of the model."""

_PLATE_RADIUS = 0.21
"""Of the plate under an instance, in extents of the model."""

_PLATE_HALF_HEIGHT = 0.002
"""Likewise."""

_PLATE_TINT = 0.4
"""Part of the plate's tone that is that of its instance. The rest is white."""

_LETTER = 0.022
"""Height of letters over that of the picture."""

_NEAR = 0.05
"""Metres before the lens. Nearer points are not drawn."""


class Recorder:
    """The front end ``recorder``.

    Args:
        session: The session that is filmed.
        size: Width and height of the pictures, pixels.
        write: Called with each picture (height, width, 3) BGR and its time, s. None: no
            picture is taken.
    """

    def __init__(
        self,
        session: Session,
        size: tuple[int, int] = (1280, 720),
        write: Callable[[Image, float], None] | None = None,
    ) -> None:
        self.session = session
        self._size = size
        self._write = write
        self._robot: Robot | None = None
        self._count = 0

    def draw(self, view: View) -> None:
        """Take one picture."""
        if self._write is not None:
            self._write(self.picture(view), view.now)

    def picture(self, view: View) -> Image:
        """Return what a camera in front of the robots sees, with the statistics in a corner."""
        if self._robot is not self.session.robot or self._count != view.count:
            self._robot = self.session.robot
            self._count = view.count
            self._set_up(self._robot, view.count)
        bodies = [body for k in range(view.count) for body in self._bodies(view, k)]
        photo = photograph(bodies, self._lens, self._camera, self._room)
        image = photo.image
        thickness = max(1, self._size[1] // 300)
        for k, one in enumerate(view.instances):
            if len(one.trail) > 1:
                trail = one.trail + self._arrangement.offsets[k]
                self._lines(image, [trail], INSTANCE_COLOURS[k][::-1], thickness)
        self._caption(image, view)
        return image

    def _bodies(self, view: View, k: int) -> Iterator[Body]:
        """Yield robot and ball of an instance, and its plate if there are several."""
        one = view.instances[k]
        offset = self._arrangement.offsets[k]
        extent = self._arrangement.extent
        if view.count > 1:
            rgba = _plate_rgba(INSTANCE_COLOURS[k])
            yield Body(_plate_model(extent, rgba), [], Pose(offset))
        yield Body(self.session.robot.model, self.session.robot.qpos(one.q), Pose(offset))
        ball = ball_model(BALL_RADIUS * extent, rgba_of(GOAL_COLOUR))
        yield Body(ball, [], Pose(np.array(view.ball.position) + offset))

    def _set_up(self, robot: Robot, count: int) -> None:
        """Choose lens, camera and ground for a robot."""
        width, height = self._size
        focal = 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW)
        centre = (width - 1) / 2, (height - 1) / 2
        self._lens = CameraIntrinsics(width, height, focal, focal, *centre)
        self._arrangement: Arrangement = arranged(robot, count)
        position, look = self._arrangement.camera(self.session.ball_path(), width / height)
        self._camera = Pose.look_at(position, look)
        extent = self._arrangement.extent
        size = extent + float(np.ptp(self._arrangement.offsets))
        self._room = tiled_room(size, _TILE_SIDE * extent)

    def _projected(self, points: Array) -> tuple[Array, Array]:
        """Return pixels (n, 2) and depths (n,) of points (n, 3)."""
        inside = (points - self._camera.position) @ self._camera.rotation
        return self._lens.project(inside), inside[:, 2]

    def _lines(self, image: Image, lines: list[Array], colour: Colour, thickness: int) -> None:
        for line in lines:
            pixels, depth = self._projected(line)
            good = (depth > _NEAR) & (np.abs(pixels) < 1e4).all(axis=1)
            if good.sum() > 1:
                row = np.round(16.0 * pixels[good]).astype(np.int32)
                cv2.polylines(image, [row], False, colour, thickness, cv2.LINE_AA, 4)

    def _caption(self, image: Image, view: View) -> None:
        """Write a line for each instance: method, steps, share solved, error."""
        size = max(10, round(_LETTER * image.shape[0]))
        for k, one in enumerate(view.instances):
            y = round((1.6 * k + 1.5) * size)
            colour = INSTANCE_COLOURS[k][::-1]
            cv2.rectangle(image, (size, y - size), (2 * size, y), colour, -1)
            put_text(image, f"{one.method}: {one.summary}", (round(2.5 * size), y), size, _INK)


def _plate_rgba(colour: Colour) -> tuple[float, float, float, float]:
    """Return the light tone of the plate of an instance of that colour."""
    red, green, blue, _ = (1.0 - _PLATE_TINT * (1.0 - value) for value in rgba_of(colour))
    return (red, green, blue, 1.0)


@lru_cache(maxsize=16)
def _plate_model(extent: float, rgba: tuple[float, float, float, float]) -> mujoco.MjModel:
    """Return a round plate on the floor."""
    half = _PLATE_HALF_HEIGHT * extent
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[_PLATE_RADIUS * extent, half, 0],
        pos=[0, 0, -half],
        rgba=rgba,
    )
    return spec.compile()
