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
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from robot_ik.environment import import_mujoco, probe_display
from robot_ik.errors import ViewerError
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.geometry import Pose
    from robot_ik.robot import Robot

#: Seconds the window may take to appear; it takes about one, several in software on a busy machine.
OPEN_LIMIT = 20.0
#: Seconds to wait for the drawing thread to end; a thread left behind can crash Python's own exit.
CLOSE_LIMIT = 5.0
#: Axis thickness as a fraction of its length.
_AXIS_WIDTH = 0.04
#: Seconds between two looks whether the window is closed.
_LOOK_AGAIN = 0.05
# Of the light at the eye, where the model has none.
_AMBIENT, _DIFFUSE = 0.35, 0.55
_AXIS_COLOURS = ((0.9, 0.1, 0.1, 1.0), (0.1, 0.75, 0.1, 1.0), (0.15, 0.3, 1.0, 1.0))


@dataclass(frozen=True)
class Solid:
    """A box that stands round the robot: ``pose`` in the world, half its sides in metres, colour rgba."""

    pose: Pose
    half: tuple[float, float, float]
    rgba: tuple[float, ...]


def _require_display(limit: float) -> None:
    """Raises before MuJoCo waits for ever for a window that cannot come."""
    probe = probe_display(timeout=limit)
    if probe.ok:
        return
    raise ViewerError(
        f"no window can be opened: {probe.text}",
        hint="run it without --view: the pictures are written to the output folder without a display\n"
        "or on a machine with a desktop (ssh -X), or with: xvfb-run -a …",
    )


def _call_with_limit(call: Callable[[], Any], limit: float) -> Any:
    """Result of ``call``, run on a thread of its own; ``ViewerError`` after ``limit`` seconds."""
    box: list[Any] = []
    failure: list[BaseException] = []

    def body() -> None:
        try:
            box.append(call())
        except BaseException as error:  # handed to the caller below
            failure.append(error)

    thread = threading.Thread(target=body, daemon=True, name="viewer-opening")
    thread.start()
    thread.join(limit)
    if failure:
        raise ViewerError(f"the viewer window failed to open: {failure[0]}") from failure[0]
    if not box:
        raise ViewerError(
            f"the viewer window did not open within {limit:.0f} s",
            hint="run it without --view, and look closer with: robot-ik doctor",
        )
    return box[0]


class WindowSink:
    """Mirrors joint angles into a window: a ``JointSink`` and a context manager.

    The window gets its own copy of the model, since its user may change it there.

    Args:
        robot: What to show.
        start: (nq,) first joint angles, rad or m; the robot's home if ``None``.
        panels: Show MuJoCo's side panels.
        limit: Seconds the window may take to appear.
        solids: What stands round the robot.
        see: (n, 3) points that shall be in view beside the whole robot, metres.
        eye: From where to look; None: from the side that MuJoCo takes.

    Attributes:
        data: The ``MjData`` that is shown; nobody else may write it.

    Raises:
        ViewerError: No display, no OpenGL on it, or macOS without ``mjpython``; the hint says what
            to run instead.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        start: Array | None = None,
        panels: bool = False,
        limit: float = OPEN_LIMIT,
        solids: Sequence[Solid] = (),
        see: Array | None = None,
        eye: Array | None = None,
    ) -> None:
        self._mujoco = import_mujoco()
        self._robot = robot
        self._model = copy.deepcopy(robot.model)
        self._light()
        self.data = self._mujoco.MjData(self._model)
        self._write(robot.home if start is None else start)
        before = set(threading.enumerate())
        self._viewer = self._open(panels, limit)
        self._threads = [t for t in threading.enumerate() if t not in before]
        with self._lock():
            self._look(see, eye)
            for solid in solids:
                self._add_box(solid)
        self._fixed = int(self._viewer.user_scn.ngeom)
        self._viewer.sync()

    def _light(self) -> None:
        """A model without a light of its own is lit from the eye alone, and then more brightly."""
        if not self._model.nlight:
            self._model.vis.headlight.ambient[:] = _AMBIENT
            self._model.vis.headlight.diffuse[:] = _DIFFUSE

    def _look(self, see: Array | None, eye: Array | None) -> None:
        """Turns the camera so that the robot as it stands and ``see`` (n, 3) fill the view."""
        model, data = self._model, self.data
        solid = [g for g in range(model.ngeom) if model.geom_type[g] != self._mujoco.mjtGeom.mjGEOM_PLANE]
        points = np.zeros((0, 3)) if see is None else np.reshape(see, (-1, 3))
        places, sizes = data.geom_xpos[solid], model.geom_rbound[solid][:, None]
        corners = np.vstack([places - sizes, places + sizes, points])
        if not len(corners):
            return
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
        camera = self._viewer.cam
        camera.lookat[:] = middle
        camera.distance = radius / np.sin(0.5 * np.deg2rad(model.vis.global_.fovy))
        if eye is not None:
            way = middle - eye
            camera.azimuth = float(np.rad2deg(np.arctan2(way[1], way[0])))
            camera.elevation = float(np.rad2deg(np.arcsin(way[2] / np.linalg.norm(way))))

    def _add_box(self, solid: Solid) -> None:
        mujoco, scene = self._mujoco, self._viewer.user_scn
        if scene.ngeom < scene.maxgeom:
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                mujoco.mjtGeom.mjGEOM_BOX,
                np.array(solid.half),
                np.array(solid.pose.position),
                solid.pose.rotation.ravel(),
                np.array(solid.rgba, dtype=np.float32),
            )
            scene.ngeom += 1

    def _open(self, panels: bool, limit: float) -> Any:
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
                    hint="run: mjpython -m robot_ik … --view, or leave out --view",
                )
        else:
            _require_display(limit)
        return _call_with_limit(
            lambda: viewer.launch_passive(self._model, self.data, show_left_ui=panels, show_right_ui=panels),
            limit,
        )

    def _write(self, q: Array) -> None:
        self.data.qpos[:] = self._robot.qpos(q)
        self._mujoco.mj_forward(self._model, self.data)

    def send(self, q: Array, now: float) -> None:
        """Shows ``q`` (nq,), rad or m, in joint order; does nothing once the window is closed."""
        if not self.is_running():
            return
        with self._lock():
            self._write(q)
        self._viewer.sync()

    def show_goal(self, pose: Pose, *, length: float = 0.12) -> None:
        """Draws the axes of a goal at ``pose`` in the world: red x, green y, blue z, ``length`` metres."""
        mujoco = self._mujoco
        with self._lock():
            scene = self._viewer.user_scn
            for axis, colour in enumerate(_AXIS_COLOURS):
                if scene.ngeom >= scene.maxgeom:
                    return
                geom = scene.geoms[scene.ngeom]
                tip = pose.position + length * pose.rotation[:, axis]
                mujoco.mjv_initGeom(
                    geom,
                    mujoco.mjtGeom.mjGEOM_ARROW,
                    np.zeros(3),
                    np.zeros(3),
                    np.eye(3).ravel(),
                    np.array(colour, dtype=np.float32),
                )
                mujoco.mjv_connector(
                    geom, mujoco.mjtGeom.mjGEOM_ARROW, _AXIS_WIDTH * length, pose.position, tip
                )
                scene.ngeom += 1
        self._viewer.sync()

    def clear_goals(self) -> None:
        """Takes all drawn goals away."""
        with self._lock():
            self._viewer.user_scn.ngeom = self._fixed
        self._viewer.sync()

    def is_running(self) -> bool:
        """Whether the window is still open."""
        return bool(self._viewer.is_running())

    def wait(self) -> None:
        """Returns when its user has closed the window, or pressed Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            while self.is_running():
                time.sleep(_LOOK_AGAIN)

    def close(self) -> None:
        """Closes the window and waits for its drawing thread; may be called twice."""
        self._viewer.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(CLOSE_LIMIT)

    def _lock(self) -> AbstractContextManager[Any]:
        lock: AbstractContextManager[Any] = self._viewer.lock()
        return lock

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
