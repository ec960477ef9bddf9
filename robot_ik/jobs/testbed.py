"""What the testbed's commands put together: session, servo arm, camera, film."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.gl import GlArtist, make_artist
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.errors import CameraError, ConfigError, ModelError
from robot_ik.jobs.ar.output import open_sink
from robot_ik.jobs.scene import stage_for
from robot_ik.robot import Robot, load_robot
from robot_ik.testbed.arm import ArmLink
from robot_ik.testbed.commands import CommandLog
from robot_ik.testbed.frontends.recorder import Recorder
from robot_ik.testbed.session import Session, View, replayed

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig

Image = NDArray[np.uint8]


def arm_link(name: str, arm_file: Path | None, bus: str, on_exit: str = "") -> ArmLink:
    """The servo arm of a robot on a bus, connected; torque stays as it is.

    Args:
        name: The robot: a name of the catalogue or a path.
        arm_file: The arm file; None: the one beside the model.
        bus: As ``--bus`` takes it.
        on_exit: How the arm is left; empty: as its file says.

    Raises:
        ConfigError: There is no arm file, or it is another robot's.
        HardwareError: As ``Arm.connect``.
    """
    from robot_ik.hardware import bus_row, open_arm
    from robot_ik.hardware.virtual.bus import VirtualBus

    robot = load_robot(name)
    config = _arm_config(robot, arm_file)
    row = bus_row(bus)
    servos = None
    if row.virtual:
        start = robot.home[[robot.joints.index(joint) for joint in config.names]]
        servos = VirtualBus.from_config(config, row.clock(), start)
    arm = open_arm(config, bus, virtual_bus=servos, on_exit=on_exit or None)
    link = ArmLink(arm, robot, bus)
    link.open()
    return link


def _arm_config(robot: Robot, arm_file: Path | None) -> ArmConfig:
    """The arm file's, with the joints that the robot has."""
    from robot_ik.hardware.config import ArmConfig

    path = arm_file or robot.arm_file
    if path is None:
        raise ConfigError(
            f"{robot.name} comes without an arm file",
            file=robot.folder, key="arm.toml",
            allowed="--arm FILE, or a robot that has one: tabletop_puma, koch_v11, omx_f, wx250s, vx300s",
        )  # fmt: skip
    config = ArmConfig.load(path)
    missing = [joint for joint in config.names if joint not in robot.joints]
    if missing:
        raise ConfigError(
            f"{robot.name} has no joint {', '.join(map(repr, missing))}",
            file=path, key="joints", allowed=", ".join(robot.joints),
        )  # fmt: skip
    return config


class StageCamera:
    """The synthetic camera of a robot's scene, for the page: a picture of robot 1 and a line about it.

    Args:
        session: Whose first instance is seen.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._robot: Robot | None = None
        self._source: SyntheticSource | None = None

    def __call__(self) -> tuple[Image, str] | None:
        """The next picture, RGB at half size; None while the robot has no scene."""
        robot = self._session.robot
        if robot is not self._robot:
            self._robot, self._source = robot, None
            with contextlib.suppress(CameraError, ModelError):
                scene = stage_for(robot).scene(robot)
                self._source = SyntheticSource(scene, lambda: self._session.instances[0].q, quality="fast")
        if self._source is None:
            return None
        begin = time.monotonic()
        frame = self._source.read()
        truth: Any = frame.truth or {}
        seen = sorted(truth.get("corners", {}))
        age = 1e3 * (time.monotonic() - begin)
        ids = ", ".join(map(str, seen)) or "none"
        text = f"<small>synthetic camera; markers in view: {ids}; {age:.0f} ms old</small>"
        return np.ascontiguousarray(frame.image[::2, ::2, ::-1]), text


def film(
    log: CommandLog,
    out: Path | None,
    *,
    numbers: Path | None = None,
    seconds: float = 0.0,
    rate_hz: float = 30.0,
    size: tuple[int, int] = (1280, 720),
    backend: str = "gl",
    overwrite: bool = False,
    on_tick: Callable[[View, int], None] = lambda view, count: None,
) -> View:
    """Runs a command log without a screen, and films it.

    Args:
        log: What happens.
        out: A film (.mp4, .mkv, .mov, .gif), the last picture (.png, .jpg) or a folder; None: no pictures.
        numbers: CSV file with a row for each instance of each picture.
        seconds: How long; 0: as long as the log.
        rate_hz: Pictures a second.
        size: Of the pictures, pixels.
        backend: Who draws: ``gl``, where it works, or ``painter``.
        overwrite: Whether files may be replaced.
        on_tick: Called after each tick with the view and the number of ticks in all.

    Returns:
        The last view.

    Raises:
        ConfigError: Nothing happens in the log and no length is given.
        OutputError: Something cannot be written.
        RobotIkError: As ``Session``.
    """
    wanted = round(seconds * log.start.rate) if seconds else log.ticks
    if not wanted:
        raise ConfigError(
            "it says nothing of its length", file="command log", key="end", allowed="--seconds N"
        )
    log = replace(log, ticks=wanted, commands=tuple(c for c in log.commands if c[0] < wanted))
    every = max(1, round(log.start.rate / rate_hz))
    artist, _ = make_artist(backend)
    view: View | None = None
    with contextlib.ExitStack() as stack:
        if isinstance(artist, GlArtist):
            stack.callback(artist.close)
        sink = None
        if out is not None:
            sink = stack.enter_context(open_sink(out, log.start.rate / every, overwrite=overwrite))
        recorder: Recorder | None = None
        for session in replayed(log):
            recorder = recorder or Recorder(session, artist, size, sink)
            view = session.view()
            if (view.tick - 1) % every == 0:
                recorder.draw(view)
            on_tick(view, wanted)
        if recorder is not None and numbers is not None:
            recorder.save_numbers(numbers)
    assert view is not None
    return view
