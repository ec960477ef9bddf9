"""A testbed session in a window of MuJoCo's passive viewer."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import INSTANCE_COLOURS, arranged, rgba_of
from robot_ik.testbed.commands import MoveGoal
from robot_ik.testbed.frontends.window import (
    ViewerWindow,
    add_connector,
    add_light,
    launch,
    point_camera,
)
from robot_ik.testbed.frontends.window_ar import WindowAr
from robot_ik.testbed.frontends.window_scene import WindowScene
from robot_ik.testbed.frontends.window_texts import window_texts
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

_WITHOUT_VIEWER = "run it with --viewer browser or --video FILE, which need no display"

_MOVED = 1e-7
"""Metres. A smaller motion of the ball is rounding."""

_ASPECT = 1.5
"""Width over height of the window that the camera is fitted to."""

_TRAIL_STEP = 4
"""Positions between two points of a trail."""

_TRAIL_WIDTH = 3.0
"""Pixels."""

_SPECIAL = {"Space": 32, "Right": 262, "Left": 263, "Down": 264, "Up": 265}
"""GLFW's numbers of keys without a letter."""


class SessionWindow(ViewerWindow):
    """The front end ``window``: a testbed session in MuJoCo's passive viewer.

    The robot stands in its scene. The ball is selected from the start: Ctrl and the right mouse
    button move it. Keys are those of the first thesis (``KEYMAP``).

    Args:
        session: The session that is shown and driven.
        ar: Begin with the robot in the picture of the synthetic camera.

    Raises:
        ViewerError: As ``WindowSink``.
    """

    def __init__(self, session: Session, *, ar: bool = False) -> None:
        self.session = session
        self._view = session.view()
        self._overlay = True
        self._ar: WindowAr | None = None
        self._is_ar_wanted = ar
        self._robot: Robot | None = None
        self._open()

    @property
    def help(self) -> str:
        """All keys in one line."""
        return "; ".join(f"{key.window} {key.about}" for key in KEYMAP if key.window)

    def _open(self) -> None:
        """Open a window for the session's robot. Another robot needs another window."""
        robot = self.session.robot
        self._robot = robot
        self._grabbed = False
        self._placed = np.full(3, np.nan)  # a new window has no position of the ball
        self._scene = WindowScene(robot)
        self._model = self._scene.model
        add_light(self._model)
        self._data = mujoco.MjData(self._model)
        self._option = mujoco.MjvOption()
        self._viewer, self._threads = launch(
            self._model, self._data, _WITHOUT_VIEWER, key_callback=self._on_key
        )
        with self._viewer.lock():
            self._viewer.perturb.select = self._scene.ball_body
            self._kept = [flags.copy() for flags in self._flags()]
        self._arrange()

    def _arrange(self) -> None:
        """Place the instances and the camera. The first instance is where its model is.

        The window stays open: while another window opens, keys are lost.
        """
        robot = self.session.robot
        self._count = self._view.count
        arrangement = arranged(robot, self._count)
        self._offsets = arrangement.offsets - arrangement.offsets[0]
        self._others = [mujoco.MjData(robot.model) for _ in range(self._count - 1)]
        camera = arrangement.camera(self.session.ball_path(), _ASPECT)
        position, target = camera - arrangement.offsets[0]
        with self._viewer.lock():
            self._scene.seat(self._count)
            point_camera(self._viewer.cam, position, target)

    def _on_key(self, code: int) -> None:
        """Send the command of a key. The viewer's thread calls it."""
        for key in KEYMAP:
            if key.window and code == _SPECIAL.get(key.window, ord(key.window[0])):
                if key.command is not None:
                    self.session.send(key.command(self._view))
                elif key.window == "X":
                    self._is_ar_wanted = not self._is_ar_wanted
                else:
                    self._overlay = not self._overlay

    def draw(self, view: View) -> bool:
        """Show a view. Return False once the window is closed."""
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
            self._placed = np.array(view.ball.position)
            self._data.mocap_pos[self._scene.ball] = self._placed
            self._data.qpos[: robot.model.nq] = robot.qpos(view.instances[0].q)
            mujoco.mj_forward(self._model, self._data)
            self._draw_others(view)
        covered = self._draw_ar(view)
        self._viewer.set_texts(self._texts(view, covered))
        self._viewer.sync()
        self._take_drag()
        return True

    def _texts(self, view: View, covered: int) -> list[Any]:
        window = self._viewer.viewport
        if not self._overlay or window is None:
            return []
        return window_texts(view, window.width, window.height, covered)

    def _draw_ar(self, view: View) -> int:
        """Show the camera's picture if it is wanted, and return its width in pixels."""
        if self._is_ar_wanted and self._ar is None:
            self._ar = WindowAr(self.session)
        if self._ar is None:
            return 0
        if self._ar.is_on != self._is_ar_wanted:
            self._ar.switch(self._is_ar_wanted)
        if self._ar.problem:
            self._is_ar_wanted = False
            self.session.report(f"no picture: {self._ar.problem}")
        return self._ar.draw(self._viewer, view)

    def close(self) -> None:
        """Close the window, end the camera, and wait for their threads."""
        if self._ar is not None:
            self._ar.close()
            self._ar = None
        super().close()

    def _take_drag(self) -> None:
        """Send where the mouse has put the ball. ``sync`` writes it into the ball's mocap pose."""
        position = self._data.mocap_pos[self._scene.ball].copy()
        is_active = bool(self._viewer.perturb.active)
        was_grabbed = self._grabbed or is_active  # the last move comes with the release
        self._grabbed = is_active
        is_placed = np.isfinite(self._placed).all()
        if was_grabbed and is_placed and np.abs(position - self._placed).max() > _MOVED:
            self._placed = position
            x, y, z = (float(value) for value in position)
            self.session.send(MoveGoal((x, y, z)))

    def _flags(self) -> tuple[Any, ...]:
        return self._viewer.opt.flags, self._viewer.opt.geomgroup, self._viewer.user_scn.flags

    def _restore_flags(self) -> None:
        """Undo the switches of MuJoCo's own keys, which are the same letters."""
        for flags, kept in zip(self._flags(), self._kept, strict=True):
            flags[:] = kept

    def _draw_others(self, view: View) -> None:
        """Draw trails, and the geoms of the other instances, shifted."""
        scene = self._viewer.user_scn
        robot = self.session.robot
        scene.ngeom = 0
        for k, data in enumerate(self._others, 1):
            data.qpos[:] = robot.qpos(view.instances[k].q)
            mujoco.mj_forward(robot.model, data)
            first = scene.ngeom
            categories = mujoco.mjtCatBit.mjCAT_DYNAMIC, mujoco.mjtCatBit.mjCAT_STATIC
            mask = int(categories[0]) | int(categories[1])
            perturb = mujoco.MjvPerturb()
            mujoco.mjv_addGeoms(robot.model, data, self._option, perturb, mask, scene)
            for g in range(first, scene.ngeom):
                scene.geoms[g].pos[:] += self._offsets[k]
        line = mujoco.mjtGeom.mjGEOM_LINE  # capsules take a third of the frame rate in software
        for k, one in enumerate(view.instances if self._overlay else ()):
            points = (one.trail + self._offsets[k])[::_TRAIL_STEP]
            colour = rgba_of(INSTANCE_COLOURS[k])
            for a, b in pairwise(points):
                add_connector(scene, line, colour, _TRAIL_WIDTH, a, b)
