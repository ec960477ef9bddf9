"""A desktop window that mirrors joint angles: MuJoCo's classic passive viewer, used kinematically.

The window shows; it decides nothing.  Each ``send`` writes ``qpos`` and runs ``mj_forward``: no physics
step is ever taken, so ``data.time`` stays 0.  Closing the window stops the picture, not the motion.
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
from robot_ik.model import compiled, read_spec
from robot_ik.ports import Array, Closing
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import (
    BALL_RADIUS,
    GOAL_COLOUR,
    INSTANCE_COLOURS,
    Colour,
    arranged,
)
from robot_ik.testbed.commands import MoveGoal
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

#: Seconds the window may take to appear; it takes about one, several in software on a busy machine.
OPEN_LIMIT = 20.0
#: Seconds to wait for the drawing thread to end; a thread left behind can crash Python's own exit.
CLOSE_LIMIT = 5.0
#: Of a goal's axes, metres.
_AXIS_LENGTH, _AXIS_WIDTH = 0.12, 0.0048
#: Seconds between two checks whether the window is closed.
_POLL = 0.05
# Where a ball is that shall not be seen, metres.
_NOWHERE = np.array([0.0, 0.0, -99.0])
# Of the light at the camera, where the model has none.
_AMBIENT, _DIFFUSE = 0.35, 0.55
_AXIS_COLOURS = ((0.9, 0.1, 0.1, 1.0), (0.1, 0.75, 0.1, 1.0), (0.15, 0.3, 1.0, 1.0))


@dataclass(frozen=True)
class Solid:
    """A box that stands round the robot: ``pose`` in the world, half its sides in metres, colour rgba."""

    pose: Pose
    half: tuple[float, float, float]
    rgba: tuple[float, ...]


_WITHOUT_WINDOW = "run it without --view: the pictures are written to the output folder without a display"
_WITHOUT_VIEWER = "run it with --viewer browser or --viewer recorder, which need no display"


def _call_with_limit(call: Callable[[], Any], instead: str) -> Any:
    """Result of ``call``, run on a thread of its own; ``ViewerError`` after ``OPEN_LIMIT`` seconds."""
    opened: Future[Any] = Future()

    def body() -> None:
        try:
            opened.set_result(call())
        except BaseException as error:  # handed to the caller below
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


def _light(model: Any) -> None:
    """A model without a light of its own is lit from the camera alone, and then more brightly."""
    if not model.nlight:
        model.vis.headlight.ambient[:] = _AMBIENT
        model.vis.headlight.diffuse[:] = _DIFFUSE


def _launch(model: Any, data: Any, instead: str, **options: Any) -> tuple[Any, list[threading.Thread]]:
    """MuJoCo's passive viewer without its side panels, and its threads.

    ``instead`` says what to run where there can be no window.

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
    elif not (probe := probe_display(timeout=OPEN_LIMIT)).ok:  # MuJoCo would wait for ever
        raise ViewerError(
            f"no window can be opened: {probe.text}",
            hint=f"{instead}\nor on a machine with a desktop (ssh -X), or with: xvfb-run -a …",
        )
    options |= {"show_left_ui": False, "show_right_ui": False}
    before = set(threading.enumerate())
    window = _call_with_limit(lambda: viewer.launch_passive(model, data, **options), instead)
    return window, [thread for thread in threading.enumerate() if thread not in before]


def _point_camera(camera: Any, position: Array, target: Array) -> None:
    """Puts MuJoCo's camera at a position (3,), looking at a target (3,)."""
    direction = target - position
    camera.lookat[:], camera.distance = target, float(np.linalg.norm(direction))
    camera.azimuth = float(np.degrees(np.arctan2(direction[1], direction[0])))
    camera.elevation = float(np.degrees(np.arcsin(direction[2] / camera.distance)))


def _rgba(colour: Colour) -> tuple[float, ...]:
    return (*(part / 255.0 for part in colour), 1.0)


def _add_geom(
    scene: Any, kind: int, rgba: Sequence[float], size: Array | None = None, pose: Pose | None = None
) -> Any | None:
    """A geom more in a scene of MuJoCo; None where there is no space."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom, pose = scene.geoms[scene.ngeom], pose or Pose()
    size, colour = np.zeros(3) if size is None else size, np.array(rgba, dtype=np.float32)
    rotation = pose.rotation.ravel()
    mujoco.mjv_initGeom(geom, kind, size, np.array(pose.position), rotation, colour)
    scene.ngeom += 1
    return geom


def _add_connector(scene: Any, kind: int, rgba: Sequence[float], width: float, a: Array, b: Array) -> None:
    """A line or an arrow from one point (3,) to another."""
    if (geom := _add_geom(scene, kind, rgba)) is not None:
        mujoco.mjv_connector(geom, kind, width, a, b)


class _ViewerWindow(Closing):
    """A window of MuJoCo's viewer."""

    _viewer: Any
    _threads: list[threading.Thread]

    def close(self) -> None:
        """Closes the window and waits for its drawing thread; may be called twice."""
        self._viewer.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(CLOSE_LIMIT)


class WindowSink(_ViewerWindow):
    """Mirrors joint angles into a window: a ``JointSink`` and a context manager.

    The window gets its own copy of the model, since its user may change it there.

    Args:
        robot: What to show.
        start: (nq,) first joint angles, rad or m; the robot's home if ``None``.
        solids: What stands round the robot.
        see: (n, 3) points that shall be in view beside the whole robot, metres.
        viewpoint: From where the camera looks; None: from the side that MuJoCo takes.
        ball: Radius of the ball that ``show_ball`` moves, metres; 0: there is none.
        instead: What to run where there can be no window, for the hint of the error.

    Attributes:
        data: The ``MjData`` that is shown; only its owner may write it.

    Raises:
        ViewerError: No display, no OpenGL on it, or macOS without ``mjpython``; the hint says what
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
        _light(self._model)
        self.data = mujoco.MjData(self._model)
        self._write(robot.home if start is None else start)
        self._viewer, self._threads = _launch(self._model, self.data, instead)
        with self._lock():
            self._aim_camera(see, viewpoint)
            for solid in solids:
                box, half = mujoco.mjtGeom.mjGEOM_BOX, np.array(solid.half)
                _add_geom(self._viewer.user_scn, box, solid.rgba, half, solid.pose)
            self._ball = None
            if ball > 0.0:
                sphere, size = mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, ball)
                colour = _rgba(GOAL_COLOUR)
                self._ball = _add_geom(self._viewer.user_scn, sphere, colour, size, Pose(_NOWHERE))
        self._viewer.sync()

    def _aim_camera(self, see: Array | None, viewpoint: Array | None) -> None:
        """Rotates the camera so that the robot as it stands and ``see`` (n, 3) fill the view."""
        model, data = self._model, self.data
        solid = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
        points = np.zeros((0, 3)) if see is None else np.reshape(see, (-1, 3))
        positions, sizes = data.geom_xpos[solid], model.geom_rbound[solid][:, None]
        corners = np.vstack([positions - sizes, positions + sizes, points])
        if not len(corners):
            return
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        camera = self._viewer.cam
        if viewpoint is not None:
            _point_camera(camera, viewpoint, middle)
        camera.lookat[:] = middle
        camera.distance = radius / np.sin(0.5 * np.deg2rad(model.vis.global_.fovy))

    def _write(self, q: Array) -> None:
        self.data.qpos[:] = self._robot.qpos(q)
        mujoco.mj_forward(self._model, self.data)

    def send(self, q: Array, now: float) -> None:
        """Shows ``q`` (nq,), rad or m, in joint order; does nothing once the window is closed."""
        if not self.is_running():
            return
        with self._lock():
            self._write(q)
        self._viewer.sync()

    def show_goal(self, pose: Pose) -> None:
        """Draws the axes of a goal at ``pose`` in the world: red x, green y, blue z."""
        arrow, scene = mujoco.mjtGeom.mjGEOM_ARROW, self._viewer.user_scn
        with self._lock():
            for axis, colour in enumerate(_AXIS_COLOURS):
                tip = pose.position + _AXIS_LENGTH * pose.rotation[:, axis]
                _add_connector(scene, arrow, colour, _AXIS_WIDTH, pose.position, tip)
        self._viewer.sync()

    def show_ball(self, position: Array) -> None:
        """Puts the ball at ``position`` (3,) in the world, seen from the next ``send`` on; NaN removes it."""
        if self._ball is not None:
            with self._lock():
                self._ball.pos[:] = position if np.isfinite(position).all() else _NOWHERE

    def show_text(self, left: str, right: str) -> None:
        """Writes two columns into the corner of the window, in place of what stood there."""
        if self.is_running():
            font, corner = mujoco.mjtFontScale.mjFONTSCALE_100, mujoco.mjtGridPos.mjGRID_TOPLEFT
            self._viewer.set_texts([(font, corner, left, right)])

    def is_running(self) -> bool:
        """Whether the window is still open."""
        return bool(self._viewer.is_running())

    def wait(self) -> None:
        """Returns when its user has closed the window, or pressed Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            while self.is_running():
                time.sleep(_POLL)

    def _lock(self) -> AbstractContextManager[Any]:
        lock: AbstractContextManager[Any] = self._viewer.lock()
        return lock


# ------------------------------------------------------------------------------ the testbed's session

_BALL = "testbed_ball"
_MOVED = 1e-7  # metres: less is rounding
_TEXT_ROWS = 12
_SPECIAL = {"Space": 32, "Right": 262, "Left": 263, "Down": 264, "Up": 265}  # GLFW's numbers


class SessionWindow(_ViewerWindow):
    """The front end ``window``: a testbed session in MuJoCo's passive viewer.

    The ball is selected from the start: Ctrl and the right mouse button move it.  Keys are those of the first
    thesis (``KEYMAP``).

    Args:
        session: What is shown and driven.

    Raises:
        ViewerError: As ``WindowSink``.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self._view = session.view()
        self._overlay = True
        self._robot: Robot | None = None
        self._open()

    @property
    def help(self) -> str:
        """The keys, in one line."""
        return "; ".join(f"{key.window} {key.about}" for key in KEYMAP if key.window)

    def _open(self) -> None:
        """A window for the session's robot; another robot needs another one."""
        robot = self.session.robot
        self._robot = robot
        self._grabbed = False
        self._placed = np.full(3, np.nan)  # the new window's ball was nowhere yet
        self._model, self._ball = _with_ball(robot, float(robot.model.stat.extent))
        _light(self._model)
        self._data = mujoco.MjData(self._model)
        self._option = mujoco.MjvOption()
        self._viewer, self._threads = _launch(
            self._model, self._data, _WITHOUT_VIEWER, key_callback=self._on_key
        )
        body = int(self._model.body(_BALL).id)
        with self._viewer.lock():
            self._viewer.perturb.select = body
            self._kept = [flags.copy() for flags in self._flags()]
        self._arrange()

    def _arrange(self) -> None:
        """Places for as many instances as there are, the first where its model is; the camera sees them all.

        The window stays open: while another one opens, keys are lost.
        """
        robot, self._count = self.session.robot, self._view.count
        arrangement = arranged(robot, self._count)
        self._offsets = arrangement.offsets - arrangement.offsets[0]
        self._others = [mujoco.MjData(robot.model) for _ in range(self._count - 1)]
        position, target = arrangement.camera(self.session.ball_path(), aspect=1.5) - arrangement.offsets[0]
        with self._viewer.lock():
            _point_camera(self._viewer.cam, position, target)

    def _on_key(self, code: int) -> None:
        """From the viewer's thread: only sends."""
        for key in KEYMAP:
            if key.window and code == _SPECIAL.get(key.window, ord(key.window[0])):
                if key.command is None:
                    self._overlay = not self._overlay
                else:
                    self.session.send(key.command(self._view))

    def draw(self, view: View) -> bool:
        """Shows a view; False once the window is closed."""
        if not self._viewer.is_running():
            return False
        self._view = view
        if self.session.robot.model is not getattr(self._robot, "model", None):
            self.close()
            self._open()
        elif view.count != self._count:
            self._arrange()
        robot = self.session.robot
        with self._viewer.lock():
            self._restore_flags()
            self._take_drag()
            self._data.mocap_pos[self._ball] = self._placed = np.array(view.ball.position)
            self._data.qpos[: robot.model.nq] = robot.qpos(view.instances[0].q)
            mujoco.mj_forward(self._model, self._data)
            self._draw_others(view)
        self._viewer.set_texts(self._texts(view) if self._overlay else [])
        self._viewer.sync()
        self._take_drag()
        return True

    def _take_drag(self) -> None:
        """``sync`` writes what the mouse did into the ball's mocap pose."""
        position, active = self._data.mocap_pos[self._ball].copy(), bool(self._viewer.perturb.active)
        grabbed, self._grabbed = self._grabbed or active, active  # the last move comes with the release
        if grabbed and np.isfinite(self._placed).all() and np.abs(position - self._placed).max() > _MOVED:
            self._placed = position
            x, y, z = (float(value) for value in position)
            self.session.send(MoveGoal((x, y, z)))

    def _flags(self) -> tuple[Any, ...]:
        return self._viewer.opt.flags, self._viewer.opt.geomgroup, self._viewer.user_scn.flags

    def _restore_flags(self) -> None:
        """What MuJoCo's own keys switched: every letter of the testbed is one of them, too."""
        for flags, kept in zip(self._flags(), self._kept, strict=True):
            flags[:] = kept

    def _draw_others(self, view: View) -> None:
        """Trails, and the other instances: their geoms shifted."""
        scene, robot = self._viewer.user_scn, self.session.robot
        scene.ngeom = 0
        for k, data in enumerate(self._others, 1):
            data.qpos[:] = robot.qpos(view.instances[k].q)
            mujoco.mj_forward(robot.model, data)
            first = scene.ngeom
            mujoco.mjv_addGeoms(
                robot.model, data, self._option, mujoco.MjvPerturb(),
                int(mujoco.mjtCatBit.mjCAT_DYNAMIC) | int(mujoco.mjtCatBit.mjCAT_STATIC), scene,
            )  # fmt: skip
            for g in range(first, scene.ngeom):
                scene.geoms[g].pos[:] += self._offsets[k]
        line = mujoco.mjtGeom.mjGEOM_LINE  # capsules take a third of the frame rate in software
        for k, one in enumerate(view.instances if self._overlay else ()):
            points, colour = one.trail + self._offsets[k], _rgba(INSTANCE_COLOURS[k])
            for a, b in zip(points[:-4:4], points[4::4], strict=False):
                _add_connector(scene, line, colour, 3.0, a, b)

    def _texts(self, view: View) -> list[Any]:
        """Mode, ball and statistics in the corners."""
        rows = [
            ("ball", " ".join(f"{value:+.3f}" for value in view.ball.position)),
            ("moves", view.motion),
            ("asks", view.kind),
            ("state", view.busy or view.state),
        ]
        for k, one in enumerate(view.instances):
            summary = one.summary.replace("°", " deg")  # MuJoCo's letters are ASCII
            rows.append((f"{k + 1} {one.method}", summary))
        if view.message:
            rows.append(("", view.message[:80]))
        left, right = ("\n".join(column) for column in zip(*rows[:_TEXT_ROWS], strict=True))
        corner = mujoco.mjtGridPos
        keys = "\n".join(key.window for key in KEYMAP if key.window)
        about = "\n".join(key.about for key in KEYMAP if key.window)
        font = mujoco.mjtFontScale.mjFONTSCALE_100
        return [(font, corner.mjGRID_TOPLEFT, left, right), (font, corner.mjGRID_BOTTOMLEFT, keys, about)]


def _with_ball(robot: Robot, extent: float) -> tuple[Any, int]:
    """The robot's model with a ball that the mouse can move, and its mocap index.

    Raises:
        ViewerError: The model was never a file.
    """
    if not robot.path.is_file():
        raise ViewerError(f"{robot.name} is no file, and the window needs one", hint="--viewer browser")
    spec, _ = read_spec(robot.path, robot.path)
    ball = spec.worldbody.add_body(name=_BALL, mocap=True)
    ball.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL_RADIUS * extent, 0.0, 0.0],
        rgba=list(_rgba(GOAL_COLOUR)), contype=0, conaffinity=0,
    )  # fmt: skip
    model = compiled(spec)
    return model, int(model.body(_BALL).mocapid[0])
