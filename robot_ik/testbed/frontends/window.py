"""A desktop window that mirrors joint angles: MuJoCo's passive viewer, used kinematically.

Each ``send`` writes ``qpos`` and runs ``mj_forward``. No physics step is taken, so ``data.time``
stays 0. Closing the window does not stop the motion.
"""

from __future__ import annotations

import contextlib
import copy
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_ik.camera.drawing.probe import probe_display
from robot_ik.errors import ViewerError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Closing
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import GOAL_COLOUR, Colour

OPEN_LIMIT = 20.0
"""Seconds in which the window must appear. It takes one; several in software on a busy machine."""

CLOSE_LIMIT = 5.0
"""Seconds to wait for the drawing thread. A remaining thread can crash Python's exit."""

_AXIS_LENGTH = 0.12
"""Of the axes of a goal, m."""

_AXIS_WIDTH = 0.0048
"""Likewise."""

_POLL = 0.05
"""Seconds between two checks whether the window is closed."""

_NOWHERE = np.array([0.0, 0.0, -99.0])
"""Position of a hidden ball, m."""

_AMBIENT = 0.35
"""Of the light at the camera, if the model has no light."""

_DIFFUSE = 0.55
"""Likewise."""

_AXIS_COLOURS = ((0.9, 0.1, 0.1, 1.0), (0.1, 0.75, 0.1, 1.0), (0.15, 0.3, 1.0, 1.0))


@dataclass(frozen=True)
class Solid:
    """A box near the robot.

    Attributes:
        pose: Pose of its centre, world.
        half: Half its sides, m.
        rgba: Its colour.
    """

    pose: Pose
    half: tuple[float, float, float]
    rgba: tuple[float, ...]


_WITHOUT_WINDOW = (
    "run it without --viewer: the pictures are written to the output folder without a display"
)


def _call_with_limit(call: Callable[[], Any], instead: str) -> Any:
    """Return the result of ``call``, run on another thread.

    Raises:
        ViewerError: It took more than ``OPEN_LIMIT`` seconds, or failed.
    """
    opened: Future[Any] = Future()

    def body() -> None:
        try:
            opened.set_result(call())
        except BaseException as error:  # raised below
            opened.set_exception(error)

    threading.Thread(target=body, daemon=True, name="viewer-opening").start()
    if not wait([opened], OPEN_LIMIT).done:
        raise ViewerError(
            f"the viewer window did not open within {OPEN_LIMIT:.0f} s",
            hint=f"{instead}\nlook closer with: robot-ik doctor",
        )
    if failure := opened.exception():
        raise ViewerError(f"the viewer window failed to open: {failure}") from failure
    return opened.result()


def add_light(model: Any) -> None:
    """Brighten the light at the camera if the model has no light."""
    if not model.nlight:
        model.vis.headlight.ambient[:] = _AMBIENT
        model.vis.headlight.diffuse[:] = _DIFFUSE


def launch(
    model: Any, data: Any, instead: str, **options: Any
) -> tuple[Any, list[threading.Thread]]:
    """Open MuJoCo's passive viewer without its side panels. Return it with its threads.

    Args:
        model: What is shown.
        data: Its state.
        instead: What to run if there can be no window.
        **options: Of ``launch_passive``.

    Raises:
        ViewerError: No display, no OpenGL on it, or macOS without ``mjpython``.
    """
    try:
        import mujoco.viewer as viewer
    except (ImportError, AttributeError) as reason:
        raise ViewerError(
            f"MuJoCo's viewer cannot be loaded: {reason}", hint="look closer with: robot-ik doctor"
        ) from reason
    if sys.platform == "darwin":
        # macOS draws only on the main thread, which mjpython keeps free for the window.
        if getattr(viewer, "_MJPYTHON", None) is None:
            raise ViewerError(
                "on macOS the window needs MuJoCo's own Python",
                hint=f"run: mjpython -m robot_ik …\nor {instead}",
            )
    elif not (probe := probe_display(timeout=OPEN_LIMIT)).ok:  # MuJoCo would wait forever
        raise ViewerError(
            f"no window can be opened: {probe.text}",
            hint=f"{instead}\nor on a machine with a desktop (ssh -X), or with: xvfb-run -a …",
        )
    options |= {"show_left_ui": False, "show_right_ui": False}
    before = set(threading.enumerate())
    window = _call_with_limit(lambda: viewer.launch_passive(model, data, **options), instead)
    return window, [thread for thread in threading.enumerate() if thread not in before]


def point_camera(camera: Any, position: Array, target: Array) -> None:
    """Put MuJoCo's camera to a position (3,), looking at a target (3,)."""
    direction = target - position
    camera.lookat[:] = target
    camera.distance = float(np.linalg.norm(direction))
    camera.azimuth = float(np.degrees(np.arctan2(direction[1], direction[0])))
    camera.elevation = float(np.degrees(np.arcsin(direction[2] / camera.distance)))


def rgba_of(colour: Colour) -> tuple[float, ...]:
    """Return an opaque colour as MuJoCo has it."""
    return (*(part / 255.0 for part in colour), 1.0)


def add_geom(
    scene: Any,
    kind: int,
    rgba: Sequence[float],
    size: Array | None = None,
    pose: Pose | None = None,
) -> Any | None:
    """Add a geom to a scene of MuJoCo and return it, or None if the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    pose = pose or Pose()
    size = np.zeros(3) if size is None else size
    colour = np.array(rgba, dtype=np.float32)
    rotation = pose.rotation.ravel()
    mujoco.mjv_initGeom(geom, kind, size, np.array(pose.position), rotation, colour)
    scene.ngeom += 1
    return geom


def add_connector(
    scene: Any, kind: int, rgba: Sequence[float], width: float, a: Array, b: Array
) -> None:
    """Add a line or an arrow from one point (3,) to another."""
    if (geom := add_geom(scene, kind, rgba)) is not None:
        mujoco.mjv_connector(geom, kind, width, a, b)


class ViewerWindow(Closing):
    """A window of MuJoCo's viewer."""

    _viewer: Any
    _threads: list[threading.Thread]

    def close(self) -> None:
        """Close the window and wait for its drawing thread. It may be called twice."""
        self._viewer.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(CLOSE_LIMIT)


class WindowSink(ViewerWindow):
    """Mirrors joint angles into a window: a ``JointSink`` and a context manager.

    The window has its own copy of the model, because its user may change the model there.

    Args:
        robot: The robot.
        start: (nq,) first joint angles, rad or m. None for the robot's home.
        solids: Boxes near the robot.
        see: (n, 3) points in view beside the robot, m.
        viewpoint: (3,) position of the camera. None for that of MuJoCo.
        ball: Radius of the ball that ``show_ball`` moves, m. 0: there is none.
        instead: What to run if there can be no window, for the hint of the error.

    Attributes:
        data: The ``MjData`` that is shown. Only its owner may write it.

    Raises:
        ViewerError: No display, no OpenGL on it, or macOS without ``mjpython``. The hint says what
            to run instead.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        start: Array | None = None,
        solids: Sequence[Solid] = (),
        see: Array | None = None,
        viewpoint: Array | None = None,
        ball: float = 0.0,
        instead: str = _WITHOUT_WINDOW,
    ) -> None:
        self._robot = robot
        self._model = copy.deepcopy(robot.model)
        add_light(self._model)
        self.data = mujoco.MjData(self._model)
        self._write(robot.home if start is None else start)
        self._viewer, self._threads = launch(self._model, self.data, instead)
        with self._lock():
            self._aim_camera(see, viewpoint)
            scene = self._viewer.user_scn
            for solid in solids:
                half = np.array(solid.half)
                add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, solid.rgba, half, solid.pose)
            self._ball = None
            if ball > 0.0:
                sphere = mujoco.mjtGeom.mjGEOM_SPHERE
                size = np.full(3, ball)
                self._ball = add_geom(scene, sphere, rgba_of(GOAL_COLOUR), size, Pose(_NOWHERE))
        self._viewer.sync()

    def _aim_camera(self, see: Array | None, viewpoint: Array | None) -> None:
        """Turn the camera so that the robot and the points ``see`` (n, 3) fill the view."""
        model = self._model
        data = self.data
        solid = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
        points = np.zeros((0, 3)) if see is None else np.reshape(see, (-1, 3))
        positions = data.geom_xpos[solid]
        sizes = model.geom_rbound[solid][:, None]
        corners = np.vstack([positions - sizes, positions + sizes, points])
        if not len(corners):
            return
        lower = corners.min(axis=0)
        upper = corners.max(axis=0)
        middle = 0.5 * (lower + upper)
        radius = 0.5 * float(np.linalg.norm(upper - lower))
        camera = self._viewer.cam
        if viewpoint is not None:
            point_camera(camera, viewpoint, middle)
        camera.lookat[:] = middle
        camera.distance = radius / np.sin(0.5 * np.deg2rad(model.vis.global_.fovy))

    def _write(self, q: Array) -> None:
        self.data.qpos[:] = self._robot.qpos(q)
        mujoco.mj_forward(self._model, self.data)

    def send(self, q: Array, now: float) -> None:  # noqa: ARG002 (of ``JointSink``)
        """Show ``q`` (nq,), rad or m, in joint order. A closed window shows nothing."""
        if not self.is_running():
            return
        with self._lock():
            self._write(q)
        self._viewer.sync()

    def show_goal(self, pose: Pose) -> None:
        """Draw the axes of a goal at ``pose`` in the world: red x, green y, blue z."""
        arrow = mujoco.mjtGeom.mjGEOM_ARROW
        scene = self._viewer.user_scn
        with self._lock():
            for axis, colour in enumerate(_AXIS_COLOURS):
                tip = pose.position + _AXIS_LENGTH * pose.rotation[:, axis]
                add_connector(scene, arrow, colour, _AXIS_WIDTH, pose.position, tip)
        self._viewer.sync()

    def show_ball(self, position: Array) -> None:
        """Put the ball to ``position`` (3,), world. The next ``send`` shows it. NaN hides it."""
        if self._ball is not None:
            with self._lock():
                self._ball.pos[:] = position if np.isfinite(position).all() else _NOWHERE

    def show_text(self, left: str, right: str) -> None:
        """Write two columns into the corner of the window. They replace older text."""
        if self.is_running():
            font = mujoco.mjtFontScale.mjFONTSCALE_100
            corner = mujoco.mjtGridPos.mjGRID_TOPLEFT
            self._viewer.set_texts([(font, corner, left, right)])

    def is_running(self) -> bool:
        """Return whether the window is open."""
        return bool(self._viewer.is_running())

    def wait(self) -> None:
        """Return when the window is closed, or at Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            while self.is_running():
                time.sleep(_POLL)

    def _lock(self) -> AbstractContextManager[Any]:
        lock: AbstractContextManager[Any] = self._viewer.lock()
        return lock
