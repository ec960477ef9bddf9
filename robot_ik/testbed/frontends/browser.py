"""The testbed in a browser: viser draws the 3D view, and the files in ``web`` the page around it.

The page shows views and sends commands. Several browsers may be connected: one drives, the others
watch. STOP works from all of them.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import viser

from robot_ik.errors import RobotIkError
from robot_ik.figure.motion.bvh import export_bvh
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Closing
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import FIELD_OF_VIEW
from robot_ik.testbed.camera_picture import ReadPicture
from robot_ik.testbed.cases import CaseRunner, CasesView
from robot_ik.testbed.commands import (
    RATE,
    Command,
    CommandLog,
    DragLink,
    MoveGoal,
    MoveObstacle,
    PlayPlan,
    PlayTimeline,
    Release,
    SetArm,
    SetBase,
    SetPin,
    SetRobot,
    SetRunning,
    SetTool,
    command_from,
)
from robot_ik.testbed.frontends import actions
from robot_ik.testbed.frontends.ar_pictures import ArPictures
from robot_ik.testbed.frontends.camera_pictures import CameraPictures
from robot_ik.testbed.frontends.channel import ChannelPage
from robot_ik.testbed.frontends.contact_scene import ContactScene
from robot_ik.testbed.frontends.cube_scene import CubeScene
from robot_ik.testbed.frontends.mesh_upload import uploaded_mesh
from robot_ik.testbed.frontends.obstacle_scene import ObstacleScene
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.frontends.plan_scene import PlanScene
from robot_ik.testbed.frontends.reach_scene import ReachScene
from robot_ik.testbed.frontends.region_scene import RegionScene
from robot_ik.testbed.frontends.scene import BrowserScene
from robot_ik.testbed.frontends.share import shared_page
from robot_ik.testbed.frontends.view_rows import (
    frame_of_body,
    joint_addresses,
    program_row,
    reach_row,
    robot_row,
    view_row,
)
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.presets import Preset, preset
from robot_ik.testbed.problem_text import problem_text
from robot_ik.testbed.reach_maps import ReachMaps, ReachState
from robot_ik.testbed.regions import figure_regions, reach_shell
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View
from robot_ik.workcell.guided_recording import measured_table

LOG = logging.getLogger(__name__)

VIEW_PERIOD = 1.0 / 15.0
"""Seconds between two views on the channel."""

WATCHING = (
    "Another browser drives. STOP works here, too. To drive from here, press Hand over there "
    "(in the tab Scene), or close that page."
)

_PHONE_ASPECT = 0.7
"""Width over height of the 3D view. A narrower view is that of a phone."""

_ASPECT_CHANGE = 0.02
"""A smaller change of the aspect does not move the camera."""

_GIZMO_SIZE = 0.15
"""Of the arrows at the ball, in extents of the model."""

_COMMAND_OF_CODE = {key.code: key.command for key in KEYMAP if key.code and key.command}


class Page(Closing):
    """The front end ``browser``.

    Args:
        session: The session that is shown and driven.
        page_server: The server of the page, which closes it.
        camera: Opens a camera when pictures are asked for. None: there is none.
        film: Returns the film of a command log, a file in MP4. None: the page cannot film.

    Attributes:
        url: Where a browser finds the page, with its token if it needs one.
    """

    def __init__(
        self,
        session: Session,
        page_server: PageServer,
        *,
        camera: Callable[[], ReadPicture] | None = None,
        film: Callable[[CommandLog], bytes] | None = None,
    ) -> None:
        self.session = session
        self.page_server = page_server
        self.server = page_server.server
        self.gate = page_server.gate
        self.channel = page_server.channel
        self.url = page_server.url
        self._view = session.view()
        self._grab: tuple[str, tuple[float, float, float]] | None = None
        self._shows_overlay = True
        self._shows_handles = True
        self._shows_turn_handles = False
        self._shows_tool_frames = False
        self._shows_wire = False
        self._reach_picture: actions.ReachPicture = "none"
        self._reach = ReachState()
        self._reach_changed = False
        self._reach_maps = ReachMaps(self._show_reach)
        self._shows_regions = False
        self._shows_cube = False
        self._picks: Literal["tool", "base", "pin", "off"] = "off"
        self._cases: CaseRunner | None = None
        self._wanted_cases: CaseRunner | None = None
        self._film = film
        self._view_due = 0.0
        self._addresses: list[int] = []
        self._published_robot: Robot | None = None
        self._published_cases: CasesView | None = None
        self.camera = None if camera is None else CameraPictures(camera, self.channel)
        self.ar = ArPictures(session, self.channel)
        with self.server.atomic():
            self._add_gizmo()
            self._obstacles = ObstacleScene(self.server, self._move_obstacle)
            self._contacts = ContactScene(self.server)
            self._plan = PlanScene(self.server)
            self._reach_scene = ReachScene(self.server)
            self._space = RegionScene(self.server, "reach", reach_shell, self._notice)
            self._regions = RegionScene(self.server, "figure", figure_regions, self._notice)
            self._cube = CubeScene(self.server)
            self._scene = self._new_scene(self._view)
            self.draw(self._view)
        program = program_row(
            has_camera=camera is not None,
            has_film=film is not None,
            has_arm=session.arm is not None,
        )
        self.channel.publish("program", program)
        self._publish_settings()
        self.channel.receive = self._receive
        self.server.on_client_connect(self._welcome)
        self.gate.on_watcher = self._notify_watcher
        self.gate.on_close = self._viser_closed
        self.channel.on_close = self._channel_closed
        self.gate.driver.on_leave = self._driver_left

    def close(self) -> None:
        """Stop cameras, maps and server."""
        self._reach_maps.cancel()
        if self.camera is not None:
            self.camera.close()
        self.ar.close()
        self.page_server.close()

    # Messages of pages, on the server's thread

    def _receive(self, page: ChannelPage, message: dict[str, Any]) -> None:
        try:
            if "command" in message:
                self._execute(page.key, command_from(message, "page"))
            else:
                self._act(page.key, actions.action_from(message, "page"))
        except RobotIkError as error:
            self.channel.send(page.key, {"notice": problem_text(error)})

    def _execute(self, page: str, command: Command) -> None:
        """Send a command to the session. STOP works from every page."""
        if command == SetRunning(False) or self._admits(page):
            self.session.send(command)

    def _admits(self, page: str) -> bool:
        """Return whether a page drives. If not, send it a notice."""
        if self.gate.driver.admits(page):
            return True
        self._notify_watcher(page)
        return False

    def _notify_watcher(self, page: str) -> None:
        self.channel.send(page, {"notice": WATCHING})

    def _act(self, page: str, action: actions.Action) -> None:
        """Execute an action of a page."""
        if isinstance(action, actions.PressKey):
            command = _COMMAND_OF_CODE.get(action.code)
            if command is not None:
                self._execute(page, command(self._view))
            return
        if not action.for_all and not self._admits(page):
            return
        match action:
            case actions.SetTheme(dark):
                self.page_server.theme(dark)
            case actions.ShowOverlay(on):
                self._shows_overlay = on
                self.ar.write_captions(on)
                self._scene.show_trails(on)
            case actions.ShowHandles(on):
                self._shows_handles = on
                self._gizmo.visible = on
            case actions.ShowTurnHandles(on):
                self._shows_turn_handles = on
                self._gizmo.disable_rotations = not on
            case actions.ShowToolFrames(on):
                self._shows_tool_frames = on
                self._scene.show_axes(on)
            case actions.ShowReach(picture):
                self._choose_reach(picture)
            case actions.ShowWire(on):
                self._shows_wire = on
                self._scene.show_wire(on)
            case actions.ShowRegions(on):
                self._shows_regions = on
            case actions.ShowCube(on):
                self._shows_cube = on
            case actions.PickPart(role):
                self._picks = role
            case actions.PinFrame(frame, turns):
                self._pin(frame, turns=turns)
            case actions.RunCases(frames):
                self._wanted_cases = CaseRunner(self.session.send, frames)
            case actions.ShowCamera(on):
                self._switch_camera(on)
            case actions.ShowAr(on):
                self.switch_ar(on)
            case actions.BeginPreset(name):
                self._begin(preset(name))
            case actions.LoadMesh(file, base64):
                self.session.send(uploaded_mesh(file, base64))
            case actions.HandOver():
                self.gate.driver.hand_over()
            case actions.ReportGraphics(software):
                self.page_server.cast_shadows(page, on=not software)
            case actions.FitCamera():
                client = self.page_server.client_of(page)
                if client is not None:
                    self._fit_camera(self._scene, client)
            case actions.DragArBall():
                moved = self.ar.dragged(action)
                if moved is not None:
                    self.session.send(moved)
                return
            case _:
                self.ar.act(action)
                self._give_file(page, action)
        self._publish_settings()

    def _switch_camera(self, on: bool) -> None:
        """Show the camera of the robot's scene, or not. One camera is shown at a time."""
        if self.camera is not None:
            self.camera.switch(on)
            if on:
                self.ar.switch(False)

    def _begin(self, chosen: Preset) -> None:
        """Show the robot of a preset, and send its first commands."""
        if self._view.robot != chosen.robot:
            self.session.send(SetRobot(chosen.robot))
        for command in chosen.commands:
            self.session.send(command)
        self.switch_ar(chosen.ar)

    def switch_ar(self, on: bool) -> None:
        """Show augmented reality, or not. One camera is shown at a time."""
        self.ar.switch(on)
        if on and self.camera is not None:
            self.camera.switch(False)
        self._publish_settings()

    def _notice(self, text: str) -> None:
        """Show a sentence on all pages."""
        self.channel.broadcast({"notice": text})

    def _choose_reach(self, picture: actions.ReachPicture) -> None:
        """Show another picture of where the tool can be."""
        is_map = picture in ("cloud", "shell")
        has_map = is_map and self._reach_picture in ("cloud", "shell")
        self._reach_picture = picture
        self._reach_changed = True
        if not is_map:
            self._reach_maps.cancel()
            self._reach = ReachState()
            self.channel.publish("reach", reach_row(self._reach))
        elif not has_map:
            obstacles = tuple(one.placed.obstacle() for one in self._view.obstacles)
            self._reach_maps.ask(self.session.robot, obstacles)

    def _show_reach(self, state: ReachState) -> None:
        """Take a state of the map. The loop draws it."""
        self._reach = state
        self._reach_changed = True
        self.channel.publish("reach", reach_row(state))

    def _publish_settings(self) -> None:
        """Send all pages what is shown."""
        settings = {
            "dark": self.page_server.dark,
            "overlay": self._shows_overlay,
            "handles": self._shows_handles,
            "turn_handles": self._shows_turn_handles,
            "tool_frames": self._shows_tool_frames,
            "reach": self._reach_picture,
            "wire": self._shows_wire,
            "ar": self.ar.settings(),
            "regions": self._shows_regions,
            "cube": self._shows_cube,
            "pick": self._picks,
            "camera": self.camera is not None and self.camera.is_on,
        }
        self.channel.publish("settings", settings)

    # Files for a browser

    def _give_file(self, page: str, action: actions.Action) -> None:
        """Make a file and let a page save it. Slow files are made on a thread."""
        match action:
            case actions.SaveLog():
                self._give(page, "testbed.jsonl", self.session.log().text())
            case actions.SavePoses():
                self._give(page, "poses.toml", self.session.timeline.book().text())
            case actions.SaveMotion(format):
                self._give(page, f"motion.{format}", self._motion_text(format))
            case actions.SaveRecording():
                arm = self.session.arm
                if arm is None or arm.recording is None:
                    notice = "Nothing is recorded yet: press Teach, guide the arm, press Hold."
                    self.channel.send(page, {"notice": notice})
                else:
                    self._give(page, "recording.csv", measured_table(arm.recording))
            case actions.ShareMotion():
                self._give_later(page, "motion.html", self._shared)
            case actions.FilmSession():
                film = self._film
                if film is not None:
                    log = self.session.log()
                    self._give_later(page, "testbed.mp4", lambda: film(log))

    def _give(self, page: str, name: str, text: str) -> None:
        self.channel.send_file(page, name, text.encode())

    def _give_later(self, page: str, name: str, make: Callable[[], bytes]) -> None:
        """Make a file on a thread."""

        def work() -> None:
            try:
                self.channel.send_file(page, name, make())
            except Exception as error:
                LOG.debug("no file %s", name, exc_info=True)
                problem = problem_text(error)
                self.channel.send(page, {"notice": f"{name} was not made: {problem}"})

        self.channel.send(page, {"notice": f"Making {name} …"})
        threading.Thread(target=work, name="testbed-file", daemon=True).start()

    def _shared(self) -> bytes:
        dark = self.page_server.dark
        return shared_page(self.server, self._scene, self.session, dark).encode()

    def _motion_text(self, format: str) -> str:
        timeline = self.session.timeline
        if format == "csv":
            return timeline.motion().sampled(RATE).csv_text()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "motion.bvh"
            export_bvh(timeline.motion()).save(file)
            return file.read_text(encoding="utf-8")

    # The 3D view

    def _add_gizmo(self) -> None:
        self._gizmo = self.server.scene.add_transform_controls(
            "/goal",
            scale=0.2,
            line_width=3.0,
            disable_sliders=True,
            disable_rotations=True,
            depth_test=False,
        )

        @self._gizmo.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                position = np.array(self._gizmo.position) - self._scene.offsets[0]
                w, *xyz = (float(value) for value in self._gizmo.wxyz)
                self.session.send(MoveGoal(_floats(position), (w, *_floats(xyz))))

    def _new_scene(self, view: View) -> BrowserScene:
        """Draw the session's robot and its number of instances."""
        if self._grab is not None:
            self._end_drag()
        robot = self.session.robot
        scene = BrowserScene(self.server, robot, view.count)
        scene.on_drag(self._drag_ball, self._drag_link)
        scene.on_click(self._click_part)
        scene.show_trails(self._shows_overlay)
        scene.show_axes(self._shows_tool_frames)
        scene.show_wire(self._shows_wire)
        self._gizmo.scale = _GIZMO_SIZE * scene.arrangement.extent
        for client in self.server.get_clients().values():
            # On the server's thread, as in ``_welcome``.
            self.server._event_loop.call_soon_threadsafe(self._fit_camera, scene, client)
        return scene

    def _publish_robot(self, view: View) -> None:
        """Send all pages the joints and frames of the robot, if they have changed."""
        robot = self.session.robot
        before = self._published_robot
        same_model = before is not None and before.model is robot.model
        if before and same_model and (before.joints, before.tool) == (robot.joints, robot.tool):
            return
        self._published_robot = robot
        self._addresses = joint_addresses(robot)
        self.channel.publish("robot", robot_row(robot, view.robot))

    async def _click_part(self, event: Any) -> None:
        """Choose a clicked part as tool or base, or pin it, if a page has asked for that."""
        role = self._picks
        body = self._scene.name_of(event.target)
        if role == "off" or body is None:
            return
        self._picks = "off"
        self._publish_settings()
        frame = frame_of_body(self.session.robot, body)
        match role:
            case "tool":
                self.session.send(SetTool(frame))
            case "base":
                self.session.send(SetBase(frame))
            case "pin":
                self._pin(frame, turns=True)

    def _pin(self, frame: str, *, turns: bool) -> None:
        """Pin a frame of the first instance where it is."""
        robot = self.session.robot
        named = robot.frame(frame)
        one = self._view.instances[0]
        body = Pose(one.xpos[named.body], one.xquat[named.body])
        pose = body @ named.local
        w, x, y, z = (float(value) for value in pose.wxyz)
        wxyz = None if turns else (w, x, y, z)
        self.session.send(SetPin(frame, _floats(pose.position), wxyz))

    async def _drag_ball(self, event: Any) -> None:
        position = np.array(event.end_position) - self._scene.offsets[self._index(event)]
        self.session.send(MoveGoal(_floats(position)))

    async def _drag_link(self, event: Any) -> None:
        """Drag a body. viser keeps the order of a drag's phases for ``async`` functions only."""
        scene = self._scene
        k = self._index(event)
        name = scene.name_of(event.target)
        if name is None:
            return  # another robot is shown: the drag has ended
        if self._grab is None:
            one = self._view.instances[k]
            body = scene.robot.model.body(name).id
            rotation = viser.transforms.SO3(one.xquat[body]).as_matrix()
            start = np.array(event.start_position) - scene.offsets[k]
            self._grab = name, _floats(rotation.T @ (start - one.xpos[body]))
        position = np.array(event.end_position) - scene.offsets[k]
        self.session.send(DragLink(k, *self._grab, _floats(position)))
        if event.phase == "end":
            self._end_drag()

    def _end_drag(self) -> None:
        self._grab = None
        self.session.send(Release())

    def _move_obstacle(self, index: int, position: Array) -> None:
        self.session.send(MoveObstacle(index, _floats(position - self._scene.offsets[0])))

    def _index(self, event: Any) -> int:
        return min(event.instance_index or 0, self._view.count - 1)

    # Browsers

    async def _welcome(self, client: viser.ClientHandle) -> None:
        """Fit the camera whenever the 3D view changes its shape.

        It is ``async`` to run on the server's thread: a browser's own messages have no lock.
        """
        aspect = client.camera.aspect
        self._fit_camera(self._scene, client)

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            nonlocal aspect
            if abs(camera.aspect - aspect) > _ASPECT_CHANGE:
                aspect = camera.aspect
                self._fit_camera(self._scene, client)

    def _fit_camera(self, scene: BrowserScene, client: viser.ClientHandle) -> None:
        aspect = client.camera.aspect
        if not (math.isfinite(aspect) and aspect > 0.05):
            return
        # A figure may have walked away with the ball. A page that is loaded again shows both.
        shown = [self._view.ball.position, *(one.xpos[1:] for one in self._view.instances)]
        path = np.vstack([self.session.ball_path(), *shown])
        position, target = scene.arrangement.camera(path, aspect)
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = target
            client.camera.fov = FIELD_OF_VIEW

    def _viser_closed(self, page: str) -> None:
        """End a drag of a page that left viser. Without a channel the page is disconnected."""
        if self.gate.driver.page == page and self._grab is not None:
            self._end_drag()
        if not self.channel.has(page):
            self.gate.driver.leave(page)

    def _channel_closed(self, page: str) -> None:
        """Let the driver leave: a page without a channel cannot send STOP."""
        self.gate.driver.leave(page)

    def _driver_left(self) -> None:
        """End a drag, and let a servo arm hold."""
        if self._grab is not None:
            self._end_drag()
        if self._view.timeline.playing:
            self.session.send(PlayTimeline(False))
        if self._view.plan.playing:
            self.session.send(PlayPlan(False))
        if self._view.arm is not None and self._view.arm.mode in ("follow", "replay"):
            self.session.send(SetArm("hold"))

    # Drawing, on the loop's thread

    def draw(self, view: View) -> None:
        """Show a view. The loop calls it 30 times a second.

        The messages of a view are sent together: viser's thread begins to send after the last one.
        """
        self._view = view
        self.ar.show_view(view)
        self._run_cases(view)
        with self.server.atomic():
            try:
                self._draw_scene(view)
            finally:  # the view has the message about an error of the scene
                self._send_view(view)

    def _run_cases(self, view: View) -> None:
        """Run the cases of thesis S12, if a page has started them."""
        if self._wanted_cases is not None:
            self._cases = self._wanted_cases
            self._wanted_cases = None
            self._cases.start(view)
        if self._cases is not None:
            self._cases.step(view)
            cases = self._cases.view()
            if cases != self._published_cases:
                self._published_cases = cases
                self.channel.publish("cases", dataclasses.asdict(cases))

    def _draw_scene(self, view: View) -> None:
        scene = self._scene
        robot = self.session.robot
        # Another tool, base or stiffness of the same model has another map, too.
        has_other_map = scene.robot is not robot
        if scene.robot.model is not robot.model or scene.count != view.count:
            scene.remove()
            scene = self._new_scene(view)
            self._scene = scene
            self._reach_changed = True
        elif scene.robot is not robot:
            scene.take(robot)
        if has_other_map and self._reach_picture in ("cloud", "shell"):
            self._choose_reach("none")
            self._publish_settings()
        self._publish_robot(view)
        scene.draw(view)
        offset = scene.arrangement.offsets[0]
        self._obstacles.draw(view, offset)
        self._contacts.draw(view, scene)
        self._plan.draw(view, scene)
        self._draw_reach(scene)
        self._space.draw(robot, offset, on=self._reach_picture == "space")
        self._regions.draw(robot, offset, on=self._shows_regions and view.can_act)
        self._cube.draw(view, robot, on=self._shows_cube)
        self._gizmo.position = view.ball.position + offset
        if view.motion != "hand":
            self._gizmo.wxyz = view.ball.wxyz

    def _draw_reach(self, scene: BrowserScene) -> None:
        if self._reach_changed:
            self._reach_changed = False
            self._reach_scene.draw(self._reach_picture, scene, self._reach.reach_map)

    def _send_view(self, view: View) -> None:
        now = time.monotonic()
        if now >= self._view_due:
            self._view_due = now + VIEW_PERIOD
            robot: Robot = self.session.robot
            self.channel.publish_view(view_row(view, robot, self._addresses))


def _floats(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
