"""The testbed in a browser: viser's server behind a gate, panels left and right, the scene between.

The page shows views and sends commands; it decides nothing.  Several browsers may look: one drives, the
others watch; STOP works from every one of them.
"""

from __future__ import annotations

import functools
import html
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from viser import _messages as vm

from robot_ik.ports import Closing, Image
from robot_ik.testbed.arrangement import FIELD_OF_VIEW
from robot_ik.testbed.commands import KEYMAP, DragLink, Key, MoveGoal, Release, SetArm
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.frontends.panels import (
    ArmPanel,
    ConnectionPanel,
    Control,
    FigurePanel,
    GoalsPanel,
    MeasuredPanel,
    MethodPanel,
    RunPanel,
    key_table,
    page,
    pressed,
)
from robot_ik.testbed.frontends.scene import BrowserScene
from robot_ik.testbed.session import Session, View

LOG = logging.getLogger(__name__)
ReadPicture = Callable[[], tuple[Image, str] | None]

_LEFT, _RIGHT = 300, 375  # px
_PANEL_PERIOD, _TABLE_PERIOD, _CAMERA_PERIOD = 0.2, 1.0, 0.25  # seconds
_BEAT_PERIOD = 1.0  # seconds; see connection.js
_NOTICE_SECONDS = 4.0
_PHONE_ASPECT = 0.7
_GIZMO = 0.15  # of the extent


class Page(Closing):
    """The front end ``browser``; a context manager.

    Args:
        session: What is shown and driven.
        page_server: What listens for browsers; the page closes it.
        camera: Opens a camera once pictures are asked for: what is called for each, (h, w, 3) RGB and a
            line about it; None: there is none.

    Attributes:
        url: Where a browser finds the page, with its token if it needs one.
    """

    def __init__(
        self,
        session: Session,
        page_server: PageServer,
        *,
        camera: Callable[[], ReadPicture] | None = None,
    ) -> None:
        self.session, self._view = session, session.view()
        self._page_server = page_server
        self.server, self.gate, self.url = page_server.server, page_server.gate, page_server.url
        self._grab: tuple[str, tuple[float, float, float]] | None = None
        self._overlay = True
        self._noticed: dict[int, float] = {}  # client -> when it was last told that it only watches
        self._camera = None if camera is None else _CameraThread(camera)
        gui = self.server.gui
        with self.server.atomic():
            self._controls(gui)
            self._readings(gui)
            self._keys(gui)
            self._add_gizmo()
            self._periods = self._panel_periods()
            self._due = dict.fromkeys(self._periods, 0.0)  # when each is shown again
            self._scene = self._new_scene(self._view)
            self.draw(self._view)
        self.server.on_client_connect(self._welcome)
        self.gate.on_refused, self.gate.on_driver_left = self._correct, self._driver_left

    def close(self) -> None:
        """Stops the server."""
        if self._camera is not None:
            self._camera.close()
        self._page_server.close()

    # --------------------------------------------------------------------------------------- panels

    def _controls(self, gui: viser.GuiApi) -> None:
        """The panel on the left: what people do."""
        send = self.session.send
        gui.main_panel.dock_left()
        gui.main_panel.set_width(_LEFT)
        self._run = RunPanel(gui, send, self._view)
        self._connection = ConnectionPanel(gui, with_arm=self.session.arm is not None)
        self.gate.always.add(self._run.stop_uuid)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Method"):
            self._methods = MethodPanel(gui, send)
        with tabs.add_tab("Goals"):
            self._goals = GoalsPanel(gui, send)
        with tabs.add_tab("Arm"):
            self._arm = ArmPanel(gui, send, self.session.arm)
        with tabs.add_tab("Figure"):
            self._figure = FigurePanel(gui, send, self._view)
        with tabs.add_tab("Record"):
            self._record(gui)
        with gui.add_folder("Show", expand_by_default=False):
            self._show(gui)
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_html(key_table())

    def _record(self, gui: viser.GuiApi) -> None:
        gui.add_html(
            page(
                "<small>The log holds every command. Attach it to a bug report: "
                "<kbd>robot-ik view --replay FILE</kbd> repeats it to the same bits, and "
                "<kbd>robot-ik video FILE OUT.mp4</kbd> films it.</small>"
            )
        )
        hint = "As a file of this browser"
        button = gui.add_button("Save the command log", icon=viser.Icon.DOWNLOAD, hint=hint)

        def save(event: Any) -> None:
            if event.client is not None:
                event.client.send_file_download("testbed.jsonl", self.session.log().text().encode())

        pressed(button, save)

    def _show(self, gui: viser.GuiApi) -> None:
        trails = gui.add_checkbox("Trails and labels", True, hint="Over the scene (L)")
        self._trails = Control(trails, self._show_overlay)
        handles = gui.add_checkbox("Goal handles", True, hint="Arrows that move the ball along one axis")
        Control(handles, lambda value: setattr(self._gizmo, "visible", value))
        arcs = gui.add_checkbox("Turn handles", False, hint="Arcs that turn the ball's pose")
        Control(arcs, lambda value: setattr(self._gizmo, "disable_rotations", not value))
        self._axes = gui.add_checkbox("Tool frames", False, hint="x red, y green, z blue")
        Control(self._axes, lambda shown: self._scene.show_axes(shown))
        self._reach = gui.add_checkbox("Reach", False, hint="Places of the tool at random joint angles")
        Control(self._reach, lambda shown: self._scene.show_reach(shown))
        dark = gui.add_checkbox("Dark", self._page_server.dark, hint="For all browsers that look")
        Control(dark, self._page_server.theme)
        if self._camera is not None:
            pictures = gui.add_checkbox("Camera pictures", False, hint="Four a second: a quarter of a core")
            Control(pictures, self._camera.switch)
        hint = "The next browser that acts drives"
        wheel = gui.add_button("Hand over", icon=viser.Icon.STEERING_WHEEL, hint=hint)
        pressed(wheel, lambda _: self.gate.hand_over())

    def _readings(self, gui: viser.GuiApi) -> None:
        """The panel on the right: readings; nothing to press, so nothing moves under the mouse."""
        panel = gui.add_panel()
        with panel.add_tab("Measured", viser.Icon.CHART_LINE):
            self._measured = MeasuredPanel(gui)
        if self._camera is not None:
            with panel.add_tab("Camera", viser.Icon.CAMERA):
                self._camera.add_to(gui)
        panel.dock_right()
        panel.set_width(_RIGHT)

    def _keys(self, gui: viser.GuiApi) -> None:
        for key in KEYMAP:
            if key.browser:
                command = gui.add_command(key.about, hotkey=key.browser)  # type: ignore[arg-type]
                command.on_trigger(functools.partial(self._pressed_key, key))

    async def _pressed_key(self, key: Key, event: Any) -> None:
        if key.command is not None:
            self.session.send(key.command(self._view))
        else:
            self._show_overlay(not self._overlay)

    # ---------------------------------------------------------------------------------------- scene

    def _show_overlay(self, shown: bool) -> None:
        self._overlay = shown
        self._trails.handle.value = shown
        self._scene.show_overlay(shown)

    def _add_gizmo(self) -> None:
        self._gizmo = self.server.scene.add_transform_controls(
            "/goal", scale=0.2, line_width=3.0, disable_sliders=True, disable_rotations=True, depth_test=False
        )

        @self._gizmo.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                position = np.array(self._gizmo.position) - self._scene.offsets[0]
                w, *xyz = (float(value) for value in self._gizmo.wxyz)
                self.session.send(MoveGoal(_floats(position), (w, *_floats(xyz))))

    def _new_scene(self, view: View) -> BrowserScene:
        """The scene of the session's robot and its number of instances."""
        if self._grab is not None:
            self._end_drag()
        scene = BrowserScene(self.server, self.session.robot, view.count)
        scene.on_drag(self._drag_ball, self._drag_link)
        scene.show_overlay(self._overlay)
        scene.show_axes(self._axes.value)
        scene.show_reach(self._reach.value)
        self._gizmo.scale = _GIZMO * scene.arrangement.extent
        for client in self.server.get_clients().values():
            # On the server's thread, as in ``_welcome``.
            self.server._event_loop.call_soon_threadsafe(self._fit_camera, scene, client)
        for show in self._periods:
            show(view, scene)
        return scene

    async def _drag_ball(self, event: Any) -> None:
        position = np.array(event.end_position) - self._scene.offsets[self._index(event)]
        self.session.send(MoveGoal(_floats(position)))

    async def _drag_link(self, event: Any) -> None:
        """``async``: viser keeps the order of a drag's phases only then."""
        scene, k = self._scene, self._index(event)
        name = scene.name_of(event.target)
        if name is None:
            return  # the robot changed under the mouse: that drag is over
        if self._grab is None:
            one = self._view.instances[k]
            body = scene.robot.model.body(name).id
            rotation = viser.transforms.SO3(one.xquat[body]).as_matrix()
            grip = rotation.T @ (np.array(event.start_position) - scene.offsets[k] - one.xpos[body])
            self._grab = name, _floats(grip)
        position = np.array(event.end_position) - scene.offsets[k]
        self.session.send(DragLink(k, *self._grab, _floats(position)))
        if event.phase == "end":
            self._end_drag()

    def _end_drag(self) -> None:
        self._grab = None
        self.session.send(Release())

    def _index(self, event: Any) -> int:
        return min(event.instance_index or 0, self._view.count - 1)

    # ------------------------------------------------------------------------------------- browsers

    async def _welcome(self, client: viser.ClientHandle) -> None:
        """Fits the camera until the canvas keeps its shape: it gets that only when the panels have docked.

        ``async``: on the server's thread, because a browser's own messages have no lock.
        """
        shape = [client.camera.aspect]
        self._fit_camera(self._scene, client)

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            if abs(camera.aspect - shape[0]) > 0.02:
                shape[0] = camera.aspect
                self._fit_camera(self._scene, client)

    def _fit_camera(self, scene: BrowserScene, client: viser.ClientHandle) -> None:
        aspect = client.camera.aspect
        if not (math.isfinite(aspect) and aspect > 0.05):
            return
        # A figure walks away, and a ball is taken along: a page that is loaded anew shall see both.
        now = [self._view.ball.position, *(one.xpos[1:] for one in self._view.instances)]
        path = np.vstack([self.session.ball_path(), *now])
        position, target = scene.arrangement.camera(path, aspect, phone=aspect < _PHONE_ASPECT)
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = target
            client.camera.fov = FIELD_OF_VIEW

    def _correct(self, connection: object, message: Mapping[str, Any]) -> None:
        """A browser that only watches moved a slider: its own copy goes back to what is true."""
        live = self.server._websock_server._live_connections
        handle = self.server.gui._gui_input_handle_from_uuid.get(message.get("uuid", ""))
        for client in self.server.get_clients().values():
            if live.get(client.client_id) is not connection:
                continue
            if handle is not None and message["type"] == "GuiUpdateMessage":
                true = vm.GuiUpdateMessage(message["uuid"], {"value": handle.value})
                client._websock_connection.queue_message(true)
            if time.monotonic() - self._noticed.get(client.client_id, -math.inf) > _NOTICE_SECONDS:
                self._noticed[client.client_id] = time.monotonic()
                client.add_notification(
                    "Watching",
                    "Another browser drives; STOP works here, too. To drive from here, press Hand over there "
                    "(under Show), or close it.",
                    auto_close_seconds=_NOTICE_SECONDS,
                )

    def _driver_left(self) -> None:
        """No drag goes on, and a servo arm holds."""
        if self._grab is not None:
            self._end_drag()
        if self._view.arm is not None and self._view.arm.mode in ("follow", "replay"):
            self.session.send(SetArm("hold"))

    # -------------------------------------------------------------------------------------- drawing

    def draw(self, view: View) -> None:
        """Shows a view; called by the loop, 30 times a second.

        All of it is one piece for the browsers: viser's thread begins to send when the last message is there,
        and does not take turns with this one.
        """
        self._view = view
        with self.server.atomic():
            try:
                self._draw_scene(view)
            finally:  # the panels say what is wrong with the scene
                self._show_next_panel(view)

    def _draw_scene(self, view: View) -> None:
        scene = self._scene
        if (scene.robot.model, scene.count) != (self.session.robot.model, view.count):
            scene.remove()
            self._scene = scene = self._new_scene(view)
        scene.draw(view)
        self._gizmo.position = view.ball.position + scene.arrangement.offsets[0]
        if view.motion != "hand":
            self._gizmo.wxyz = view.ball.wxyz

    def _show_next_panel(self, view: View) -> None:
        """One panel at most, so that no frame pays for all of them."""
        now, show = time.monotonic(), min(self._due, key=self._due.__getitem__)
        if now >= self._due[show]:
            self._due[show] = now + self._periods[show]
            show(view, self._scene)

    def _panel_periods(self) -> dict[Callable[[View, BrowserScene], None], float]:
        """What is shown on the panels, and how often, seconds."""

        def run(view: View, scene: BrowserScene) -> None:
            self._run.show(view)
            self._figure.show(view)

        def tables(view: View, scene: BrowserScene) -> None:
            self._measured.show(view)
            self._arm.show(view)
            scene.name_instances(view)

        return {
            lambda view, scene: self._connection.show(): _BEAT_PERIOD,
            run: _PANEL_PERIOD,
            lambda view, scene: self._methods.show(view): _PANEL_PERIOD,
            lambda view, scene: self._goals.show(view): _PANEL_PERIOD,
            lambda view, scene: self._measured.draw(view, scene.robot): _PANEL_PERIOD,
            tables: _TABLE_PERIOD,
        }


class _CameraThread:
    """Pictures of a camera, at most four a second, beside the loop; off until they are switched on."""

    _NOTHING = "<small>this robot has no scene with a camera: choose tabletop_puma under Robot</small>"
    _OFF = page("<small>no pictures: switch them on under Show, on the left</small>")

    def __init__(self, open_camera: Callable[[], ReadPicture]) -> None:
        self._open, self._shown = functools.cache(open_camera), threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="testbed-camera", daemon=True)

    def add_to(self, gui: viser.GuiApi) -> None:
        """Picture and text, where the caller is adding things."""
        self._image = gui.add_image(np.full((180, 320, 3), 128, np.uint8), format="jpeg", jpeg_quality=80)
        self._text = gui.add_html(self._OFF)
        self._thread.start()

    def switch(self, on: bool) -> None:
        """Pictures, or none."""
        if on:
            self._text.content = page("<small>the first picture takes some seconds …</small>")
            self._shown.set()
        else:
            self._shown.clear()
            self._text.content = self._OFF

    def _work(self) -> None:
        while not self._over.wait(_CAMERA_PERIOD):
            if not self._shown.is_set():
                continue
            image, text = self._next_picture()
            if self._shown.is_set() and not self._over.is_set():
                self._text.content = page(text)
                if image is not None:
                    self._image.image = image

    def _next_picture(self) -> tuple[Image | None, str]:
        """The next picture, and what is said of it."""
        try:
            return self._open()() or (None, self._NOTHING)
        except Exception as error:  # on a thread it is seen nowhere else, and the picture stands still
            LOG.debug("no picture", exc_info=True)
            return None, f'<span class="no">no picture: {html.escape(str(error).splitlines()[0])}</span>'

    def close(self) -> None:
        """Ends the thread."""
        self._over.set()
        self._thread.join(5.0)


def _floats(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
