"""``robot-ik ar``: draw a robot into the pictures of a camera."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.options import (
    BoardName,
    CameraSource,
    Dictionary,
    DrawnScale,
    DrawnVideo,
    ExtrinsicsFile,
    IntrinsicsFile,
    JsonOption,
    MarkerSize,
    OverwriteOption,
    RobotName,
    RobotPose,
    Seconds,
    Seed,
    TargetMarker,
    parse_robot_pose,
)
from robot_ik.commands.tables import pairs_table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError, install_command

if TYPE_CHECKING:
    from robot_ik.testbed.ar.overlay import ArReport as Drawing
    from robot_ik.testbed.ar.overlay import ArRequest

MIN_SIDE = 16
"""px. Smaller pictures show no marker."""

MAX_SIDE = 16_384
"""px. Larger pictures than those of any camera take all memory."""


@dataclass(frozen=True, kw_only=True)
class Ar(OverwriteOption, JsonOption):
    """Draw a robot into the pictures of a camera. It stands on a printed board that may move.

    By default the pictures are synthetic: a table, a board, a hand. Neither camera, OpenGL nor
    display is needed.

        robot-ik ar --robot lion --seconds 5 --video lion.mp4
        robot-ik ar --camera 0 --intrinsics camera.yaml --scale 0.3

    Exit code 1: the board was in no picture.
    """

    robot: RobotName = ""
    motion: Annotated[
        str,
        Parameter(
            metavar="home|wave|follow|FILE.csv|SCRIPT|ARM.toml@PORT",
            help="Motion of the robot. follow: reaches for --marker. FILE.csv: replays a "
            "trajectory or a recording of --record. SCRIPT: as for robot-ik run, on simulated "
            "servos. ARM.toml@PORT: mirrors a live arm.",
        ),
    ] = "wave"
    camera: CameraSource = "synthetic"
    intrinsics: IntrinsicsFile = None
    board: BoardName = "grid:2x2:50:12.5"
    dictionary: Dictionary = ""
    extrinsics: ExtrinsicsFile = None
    robot_pose: RobotPose = ()
    scale: DrawnScale = None
    marker: TargetMarker = 9
    marker_size: MarkerSize = 0.05
    occluders: Annotated[
        tuple[str, ...],
        Parameter(metavar="FILE|GEOM …", consume_multiple=True, allow_repeating=True),
    ] = ()
    """Real objects that hide the robot: boxes in TOML, MJCF, or geoms of the robot's model."""
    alpha: Annotated[float, Parameter(metavar="SHARE", validator=Number(gte=0, lte=1))] = 1.0
    """Opacity of the robot, from 0 to 1."""
    size: Annotated[
        tuple[int, int] | None,
        Parameter(metavar="W H", validator=Number(gte=MIN_SIDE, lte=MAX_SIDE)),
    ] = None
    """Picture size in pixels. Default: the camera's."""
    seconds: Annotated[
        Seconds | None,
        Parameter(
            help="Duration, in s. Default: the whole recording; synthetic: the motion's, or 4."
        ),
    ] = None
    seed: Seed = 0
    video: DrawnVideo = None

    def run(self, terminal: Terminal = QUIET) -> ArReport:
        """Draw into each picture, and write the pictures.

        Raises:
            KeyboardInterrupt: The run was interrupted. The pictures so far are written.
        """
        request = self.request(terminal)
        from robot_ik.testbed.ar.overlay import run_ar

        terminal.progress("drawing")
        report = ArReport(run_ar(request, terminal.counting("picture")))
        if report.drawing.interrupted:
            terminal.show(report)
            raise KeyboardInterrupt
        return report

    def request(self, terminal: Terminal) -> ArRequest:
        """Check the options, and return the request.

        Raises:
            OptionError: An option is wrong.
        """
        pose = parse_robot_pose(self.robot_pose)
        file, geoms = parse_occluders(self.occluders)
        # MuJoCo, Numba and OpenCV take 1.1 s to import, --help takes 0.1 s.
        from robot_ik.robot_file import SHOWN_ROBOT
        from robot_ik.testbed.ar.motion import robot_of
        from robot_ik.testbed.ar.overlay import ArRequest

        return ArRequest(
            robot=self.robot or robot_of(self.motion) or SHOWN_ROBOT,
            camera=self.camera,
            intrinsics=self.intrinsics,
            board=self.board,
            dictionary=self.dictionary,
            extrinsics=self.extrinsics,
            base=pose,
            scale=self.scale or 0.0,
            motion=self.motion,
            marker=(self.marker, self.marker_size or 0.05),
            occluders=file,
            occluder_geoms=geoms,
            alpha=self.alpha,
            out=self.video or default_video(terminal),
            overwrite=self.overwrite,
            seconds=self.seconds or 0.0,
            size=self.size,
            seed=self.seed,
        )


@dataclass(frozen=True, eq=False)
class ArReport(Report):
    """What was drawn."""

    drawing: Drawing

    @property
    def notes(self) -> Sequence[str]:
        """Return what differs from the request."""
        notes = [self.drawing.notice] if self.drawing.notice else []
        if self.drawing.file is None:
            notes.append("there was no picture: nothing is written")
        return notes

    def facts(self) -> dict[str, Any]:
        """Return the JSON object."""
        drawing = self.drawing
        return {
            "file": None if drawing.file is None else str(drawing.file),
            "pictures": drawing.pictures,
            "drawn": drawing.drawn,
            "scale": drawing.scale,
            "reprojection_px": drawing.reprojection_px,
            "interrupted": drawing.interrupted,
            "track_and_draw_hz": drawing.rate_hz,
        }

    def tables(self) -> Iterable[Any]:
        """Return counts, scale and speed, and the file."""
        drawing = self.drawing
        if drawing.file is None:
            return
        rows = [
            ("pictures", f"{drawing.pictures}, the robot in {drawing.drawn}"),
            ("scale", f"drawn at {drawing.scale:.3g} of its size"),
        ]
        if math.isfinite(drawing.reprojection_px):
            rows.append(("board", f"corners fit to {drawing.reprojection_px:.2f} px"))
        rate = drawing.rate_hz
        digits = f"{rate:.0f}" if rate >= 10.0 else f"{rate:.2g}"
        rows.append(("speed", f"{digits} pictures/s tracked and drawn"))
        yield pairs_table(rows)
        yield f"written: {drawing.file}"


def parse_occluders(items: Iterable[str]) -> tuple[Path | None, tuple[str, ...]]:
    """Return the file and the geoms of ``--occluders``. A name with a suffix is a file.

    Raises:
        OptionError: More than one file is given.
    """
    files = [item for item in items if Path(item).suffix]
    if len(files) > 1:
        raise OptionError("--occluders", f"{len(files)} files", "one file, and geoms")
    geoms = tuple(item for item in items if item not in files)
    return Path(files[0]) if files else None, geoms


def default_video(terminal: Terminal) -> Path:
    """Return ``ar.mp4``, or the folder ``ar`` if no video can be written."""
    from robot_ik.workcell.films import films_can_be_written

    if films_can_be_written():
        return Path("ar.mp4")
    text = f"pictures go to the folder ar; for a film: {install_command('video')}"
    terminal.say(text, "yellow")
    return Path("ar")
