"""The parts of the testbed's commands: servo arm, camera, film."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import marker
from robot_ik.camera.tracker import Tracker
from robot_ik.errors import CameraError, ConfigError, ModelError
from robot_ik.geometry import Pose
from robot_ik.motion.joint_table import Moment
from robot_ik.motion.keyframes import column_names
from robot_ik.motion.recording import Recording, open_recording, require_recording
from robot_ik.ports import Array, Image
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_arm import open_robot
from robot_ik.testbed.arm import ArmLink
from robot_ik.testbed.arrangement import GOAL_COLOUR
from robot_ik.testbed.camera_picture import CameraPicture
from robot_ik.testbed.commands import RATE, CommandLog
from robot_ik.testbed.frontends.recorder import Recorder
from robot_ik.testbed.loop import replayed
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View
from robot_ik.workcell.films import open_sink
from robot_ik.workcell.pictures import draw_observations
from robot_ik.workcell.progress import Progress
from robot_ik.workcell.scene import scene_for

INSTANCE_COLUMNS = (
    "method",
    "status",
    "iterations",
    "error_m",
    "error_rad",
    "mean_solve_time_s",
    "solved_share",
)
"""Further columns of a recording: the result of the last solve, and the statistics so far."""

_SUBPIXEL_BITS = 4
"""Fractional bits of the coordinates that are drawn."""

_SUBPIXELS = 1 << _SUBPIXEL_BITS

_BALL_RADIUS = 18
"""Pixels of the circle around the ball."""

_LARGEST_COORDINATE = 1 << 20
"""Largest coordinate that is drawn, subpixels. Far larger ones overflow in OpenCV."""


def arm_link(name: str, arm_file: Path | None, bus: str, on_exit: str = "") -> ArmLink:
    """Return the servo arm of a robot on a bus, connected. Torque stays unchanged.

    Args:
        name: Name or path of the robot.
        arm_file: Arm file. None for the file of the robot.
        bus: A simulated bus or a port.
        on_exit: Exit policy. Empty for that of the arm file.

    Raises:
        ConfigError: There is no arm file, or it is another robot's.
        CalibrationMismatchError: The arm was calibrated for another model.
        HardwareError: As ``Arm.connect``.
    """
    opened = open_robot(name, arm_file, bus, on_exit=on_exit or None)
    robot = load_robot(name)
    link = ArmLink(opened, robot, bus)
    link.open()
    return link


class SceneCamera:
    """The synthetic camera of a robot's scene: pictures of robot 1 with the detected markers.

    Markers are detected in the picture alone.

    Args:
        session: The session whose first instance is in the picture.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._robot: Robot | None = None
        self._source: SyntheticSource | None = None
        self._tracker: Tracker | None = None

    def __call__(self) -> CameraPicture | None:
        """Return the next picture at half size, or None if the robot has no scene."""
        if self._session.robot is not self._robot:
            self._robot = self._session.robot
            self._open(self._robot)
        if self._source is None or self._tracker is None:
            return None
        frame = self._source.read()
        begin = time.monotonic()
        observations = self._tracker.observe(frame)
        search_ms = 1e3 * (time.monotonic() - begin)
        scene = self._source.scene
        image = draw_observations(frame.image, observations, scene.intrinsics)
        ball = np.array(self._session.ball.position)
        _draw_ball(image, scene.pose_world_camera, scene.intrinsics, ball)
        age_ms = 1e3 * (time.monotonic() - frame.time)
        markers = tuple(
            (seen.ids[0], float(np.linalg.norm(seen.pose.position)), seen.reprojection_error)
            for seen in observations
        )
        note = (
            f"Synthetic camera; {age_ms:.0f} ms old, {search_ms:.0f} ms of them for finding "
            "markers. Orange: the ball."
        )
        return CameraPicture(np.ascontiguousarray(image[::2, ::2]), markers, note)

    def _open(self, robot: Robot) -> None:
        self._source = None
        self._tracker = None
        with contextlib.suppress(CameraError, ModelError):
            synthetic = scene_for(robot).synthetic(robot)
            markers = [marker(m.id, m.size, m.dictionary) for m in synthetic.markers]
            self._tracker = Tracker(synthetic.intrinsics, markers)
            self._source = SyntheticSource(synthetic, lambda: self._session.instances[0].q)


def _draw_ball(image: Image, camera: Pose, lens: CameraIntrinsics, position: Array) -> None:
    """Draw a circle around the place of the ball in the picture."""
    inside = camera.inverse().apply(position)
    if inside[2] > 0.0:
        x, y = np.round(_SUBPIXELS * lens.project(inside[None])[0]).astype(int).tolist()
        if max(abs(x), abs(y)) < _LARGEST_COORDINATE:
            radius = _SUBPIXELS * _BALL_RADIUS
            colour = GOAL_COLOUR[::-1]
            cv2.circle(image, (x, y), radius, colour, 3, cv2.LINE_AA, _SUBPIXEL_BITS)


def film_in_process(log: CommandLog) -> bytes:
    """Return the film of a command log, the bytes of an MP4 file.

    Another process draws it, so the session continues without a delay.

    Raises:
        ConfigError: The film cannot be made; the message is that of ``robot-ik view``.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "testbed.jsonl"
        out = Path(folder) / "testbed.mp4"
        replace(log, digest="").save(source)  # a film is made also if the bits differ
        options = ["--replay", str(source), "--video", str(out)]
        command = [sys.executable, "-m", "robot_ik", "view", *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not out.is_file():
            lines = done.stderr.strip().splitlines() or ["robot-ik view failed"]
            raise ConfigError(lines[-1], file="film")
        return out.read_bytes()


def film(
    log: CommandLog,
    out: Path | None,
    *,
    record: Path | None = None,
    seconds: float | None = None,
    rate_hz: float = 30.0,
    size: tuple[int, int] = (1280, 720),
    overwrite: bool = False,
    progress: Progress | None = None,
) -> View:
    """Run a command log without a screen, film it, and return the last view.

    Args:
        log: The command log.
        out: A film (.mp4, .mkv, .mov, .gif), the last picture (.png, .jpg), a folder, or None.
        record: File (.csv, .mcap) with a row for each instance of each picture.
        seconds: Length of the film. None for that of the log.
        rate_hz: Pictures a second.
        size: Width and height, pixels.
        overwrite: Whether existing files may be replaced.
        progress: Called with a phase and a share.

    Raises:
        ConfigError: Nothing happens in the log and no length is given.
        OutputError: Something cannot be written.
    """
    tick_count = log.ticks if seconds is None else round(seconds * RATE)
    if not tick_count:
        problem = "the length of the film is unknown"
        raise ConfigError(problem, file="command log", key="end", allowed="--seconds N")
    log = replace(
        log, ticks=tick_count, commands=tuple(c for c in log.commands if c[0] < tick_count)
    )
    if record is not None:
        require_recording(record)
    ticks_per_picture = max(1, round(RATE / rate_hz))
    view: View | None = None
    with contextlib.ExitStack() as stack:
        write = None
        if out is not None:
            sink = stack.enter_context(
                open_sink(out, RATE / ticks_per_picture, overwrite=overwrite)
            )
            write = sink.write
        recorder: Recorder | None = None
        rows: Recording | None = None
        names: tuple[str, ...] = ()
        for session in replayed(log):
            recorder = recorder or Recorder(session, size, write)
            view = session.view()
            if (view.tick - 1) % ticks_per_picture == 0:
                recorder.draw(view)
                if record is not None and rows is None:
                    names = column_names(session.robot)
                    rows = stack.enter_context(open_recording(record, names, INSTANCE_COLUMNS))
                if rows is not None and column_names(session.robot) == names:  # of one robot
                    _write_moments(rows, view)
            if progress is not None:
                progress("", view.tick / tick_count)
    if view is None:
        raise RuntimeError("the command log has no tick")
    return view


def _write_moments(rows: Recording, view: View) -> None:
    """Write a row for each instance of a view."""
    for k, instance in enumerate(view.instances):
        values = (
            instance.method,
            instance.status,
            instance.iterations,
            instance.error,
            instance.angle,
            instance.statistics.mean,
            instance.statistics.solved,
        )
        moment = Moment(
            view.now,
            commanded=instance.q,
            goal=view.ball,
            text=view.message if k == 0 else "",
            robot=k + 1 if view.count > 1 else 0,
            extra=dict(zip(INSTANCE_COLUMNS, values, strict=True)),
        )
        rows.write(moment)
