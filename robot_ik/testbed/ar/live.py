"""Live augmented reality: reads a camera on a thread and draws robot and ball into each picture."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.target_files import parse_target
from robot_ik.errors import RobotIkError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Closing, Image
from robot_ik.testbed.ar.camera import ArCamera, ball_marker
from robot_ik.testbed.ar.caption import Caption
from robot_ik.testbed.ar.late_registrar import LateRegistrar, RecentBoards, Registered
from robot_ik.testbed.ar.scene import ArScene
from robot_ik.testbed.ar.setup import ArDelay, ArSetup
from robot_ik.testbed.ar.warm import warm_up
from robot_ik.testbed.captions import caption_lines
from robot_ik.testbed.commands import MoveGoal
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

_log = logging.getLogger(__name__)

RATE_WINDOW = 30
"""Pictures over which rate and times are averaged: about a second."""

_RETRY = 0.5
"""Seconds between two attempts to get a picture."""

_REST = 6e-3
"""Metres on the table. A smaller motion of the marker is noise: it counts as at rest."""

_CLOSE_LIMIT = 5.0
"""Seconds to wait for the thread to end."""


@dataclass(frozen=True, eq=False)
class ArPicture:
    """One finished picture.

    Attributes:
        image: (h, w, 3) BGR with robot, ball and text.
        number: Counts pictures from 1.
        time: Time of the camera's picture, seconds of the machine's monotonic clock.
        ball: Pixel (u, v) of the ball and its radius, pixels. NaN without a board.
    """

    image: Image
    number: int
    time: float
    ball: tuple[float, float, float]


@dataclass(frozen=True)
class ArStatus:
    """State of the camera, the tracking and the drawing.

    Attributes:
        on: Whether pictures are taken.
        rate_hz: Pictures a second.
        age_ms: Time from the camera's picture to the finished one.
        delay_ms: Time between the tracked picture and the shown one.
        error_px: Registration error, see ``Registered``. None: the board is not in the picture.
        track_ms: Mean time to track the board.
        draw_ms: Mean time to draw robot, ball and text.
        board: Whether the board is in the picture.
        marker: Whether the marker that is the ball is in the picture.
        note: What is assumed about the camera.
        problem: Why there is no picture. Empty: there are pictures.
    """

    on: bool = False
    rate_hz: float = 0.0
    age_ms: float = 0.0
    delay_ms: float = 0.0
    error_px: float | None = None
    track_ms: float = 0.0
    draw_ms: float = 0.0
    board: bool = False
    marker: bool = False
    note: str = ""
    problem: str = ""


@dataclass(eq=False)
class _Running:
    """The parts of one setup: they change together."""

    setup: ArSetup
    delay: ArDelay
    camera: ArCamera
    scene: ArScene
    tracker: RecentBoards
    registrar: LateRegistrar


class LiveAr(Closing):
    """Draws the first robot of a session and the ball into the pictures of a camera.

    Args:
        session: The session. It gets the ball's position if a marker is the ball.
        show: Called with each finished picture, on the camera's thread.
        tell: Called on that thread with each changed status.

    Attributes:
        writes: Whether ball, mode and decision are written into the pictures.
    """

    def __init__(
        self,
        session: Session,
        show: Callable[[ArPicture], None],
        tell: Callable[[ArStatus], None] = lambda _status: None,
    ) -> None:
        self.writes = True
        self._session = session
        self._show = show
        self._tell = tell
        self._view: View | None = None
        self._setup = ArSetup()
        self._delay = ArDelay()
        self._status = ArStatus()
        self._placed: tuple[ArScene, ArCamera, Pose] | None = None
        self._sent = np.full(3, np.inf)
        self._number = 0
        self._times: deque[tuple[float, float, float, float]] = deque(maxlen=RATE_WINDOW)
        self._caption = Caption()
        self._is_on = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="testbed-ar", daemon=True)
        self._thread.start()

    # Called from any thread

    @property
    def is_on(self) -> bool:
        """Whether pictures are taken."""
        return self._is_on.is_set()

    @property
    def status(self) -> ArStatus:
        """The latest status."""
        return self._status

    def show_view(self, view: View) -> None:
        """Take the view that is drawn from now on."""
        self._view = view

    def switch(self, on: bool) -> None:
        """Take pictures, or none."""
        if on:
            self._is_on.set()
        else:
            self._is_on.clear()

    def set_setup(self, setup: ArSetup) -> None:
        """Change camera, board and ball from the next picture on. The status reports errors."""
        self._setup = setup

    def set_delay(self, delay: ArDelay) -> None:
        """Change the delay and the measures against it from the next picture on."""
        self._delay = delay

    def ball_at(self, u: float, v: float) -> Array | None:
        """Return where the ball goes if the mouse takes it to a pixel, or None without a board.

        The ball stays at its distance from the camera's plane.

        Args:
            u: Column, pixels.
            v: Row, pixels.

        Returns:
            (3,) position in the robot's world, metres.
        """
        placed = self._placed
        view = self._view
        if placed is None or view is None:
            return None
        scene, camera, pose_camera_board = placed
        pose_world_camera = scene.drawn.camera(pose_camera_board.inverse())
        depth = pose_world_camera.inverse().apply(np.array(view.ball.position))[2]
        ray = np.array((*camera.intrinsics.undistort(np.array([[u, v]]))[0], 1.0))
        return np.asarray(pose_world_camera.apply(depth * ray))

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        self._is_on.set()
        self._thread.join(_CLOSE_LIMIT)

    # On the camera's thread

    def _work(self) -> None:
        with contextlib.ExitStack() as stack:
            running: _Running | None = None
            while not self._over.is_set():
                if not self._is_on.is_set():
                    stack.close()  # other programs may use the camera meanwhile
                    running = None
                    self._end()
                    self._is_on.wait()
                    continue
                try:
                    running = self._prepared(running, stack)
                    self._take_picture(running)
                except Exception as error:  # else the thread would end without a message
                    _log.debug("no picture", exc_info=True)
                    known = isinstance(error, RobotIkError)
                    text = str(error).splitlines()[0] if known else f"{type(error).__name__}"
                    self._set_status(ArStatus(on=True, problem=text))
                    stack.close()
                    running = None
                    self._over.wait(_RETRY)

    def _end(self) -> None:
        self._placed = None
        self._times.clear()
        self._set_status(ArStatus())

    def _prepared(self, before: _Running | None, stack: contextlib.ExitStack) -> _Running:
        """Return the parts for the present setup, delay and robot. What has not changed is kept."""
        setup = self._setup
        delay = self._delay
        robot = self._session.robot
        if before is None or before.setup != setup:
            stack.close()
            self._set_status(ArStatus(on=True, note="opening the camera …"))
            warm_up()
            camera = stack.enter_context(ArCamera(setup))
            board = parse_target(setup.board, setup.dictionary)
            marker = ball_marker(setup, board)
            tracker = RecentBoards(board, camera.intrinsics, marker)
            self._sent = np.full(3, np.inf)
        else:
            camera = before.camera
            tracker = before.tracker
        is_same = before is not None and before.scene.robot is robot
        scene = before.scene if before is not None and is_same else ArScene(robot)
        if before is not None and before.camera is camera and is_same and before.delay == delay:
            return before
        registrar = LateRegistrar(tracker, scene.drawn, camera.intrinsics, delay)
        return _Running(setup, delay, camera, scene, tracker, registrar)

    def _take_picture(self, running: _Running) -> None:
        frame = running.camera.read()
        view = self._view
        robot = running.scene.robot
        if view is None or len(view.instances[0].q) != robot.nq:
            return  # the view is of another robot: the next picture has the right one
        begin = time.monotonic()
        running.registrar.take(frame)
        tracked = time.monotonic()
        ball = np.array(view.ball.position)
        qpos = running.scene.qpos(view.instances[0].q, ball)
        done = running.registrar.composed(frame, qpos)
        image = done.image.copy() if done.image is done.shown.image else done.image
        if self.writes:
            self._caption.write(image, caption_lines(view))
        finished = time.monotonic()
        pose = done.pose_camera_board
        self._placed = None if pose is None else (running.scene, running.camera, pose)
        self._number += 1
        pixel = self._ball_pixel(running, pose, ball)
        self._show(ArPicture(image, self._number, done.shown.time, pixel))
        self._times.append((frame.time, tracked - begin, finished - tracked, finished))
        self._measure(running, done)
        self._follow_marker(running, done, view)

    def _measure(self, running: _Running, done: Registered) -> None:
        times = np.array(self._times)
        length = float(times[-1, 3] - times[0, 3])
        self._set_status(
            ArStatus(
                on=True,
                rate_hz=(len(times) - 1) / length if length > 0.0 else 0.0,
                age_ms=1e3 * (float(times[-1, 3]) - done.shown.time),
                delay_ms=1e3 * done.delay,
                error_px=done.error if math.isfinite(done.error) else None,
                track_ms=1e3 * float(times[:, 1].mean()),
                draw_ms=1e3 * float(times[:, 2].mean()),
                board=done.pose_camera_board is not None,
                marker=done.pose_board_marker is not None,
                note=running.camera.note,
            )
        )

    def _set_status(self, status: ArStatus) -> None:
        if status != self._status:
            self._status = status
            self._tell(status)

    def _ball_pixel(
        self, running: _Running, pose: Pose | None, ball: Array
    ) -> tuple[float, float, float]:
        """Return the pixel of the ball and its radius in pixels, NaN where it is not in front."""
        nowhere = (math.nan, math.nan, math.nan)
        if pose is None:
            return nowhere
        camera = running.scene.drawn.camera(pose.inverse())
        inside = camera.inverse().apply(ball)
        if inside[2] <= 0.0:
            return nowhere
        lens = running.camera.intrinsics
        u, v = lens.project(inside[None])[0].tolist()
        return u, v, lens.fx * running.scene.radius / float(inside[2])

    def _follow_marker(self, running: _Running, done: Registered, view: View) -> None:
        """Put the ball to the marker. While a passive figure acts, the ball is locked."""
        marker = done.pose_board_marker
        is_locked = view.figure is not None and view.figure.locked
        if running.setup.ball == "virtual" or marker is None or is_locked:
            return
        scene = running.scene
        position = scene.world_point(np.array(marker.position))
        if np.linalg.norm(position - self._sent) * scene.drawn.scale < _REST:
            return
        self._sent = position
        x, y, z = (float(value) for value in position)
        self._session.send(MoveGoal((x, y, z)))
