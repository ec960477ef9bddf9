"""``robot-ik ar``: the virtual robot in the pictures of a camera, on the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    Dictionary,
    Json,
    Lens,
    Overwrite,
    Range,
    positive,
    request_of,
    require,
    robot_argument,
    several,
    single,
)
from robot_ik.errors import install_command
from robot_ik.robot_file import SHOWN_ROBOT

if TYPE_CHECKING:
    from robot_ik.jobs.ar.job import ArReport, ArRequest


# Sides of a picture, px; larger ones than any camera's would take all memory before they fail.
_SIDES = Range(16, 16_384, " pixels")
_MOTIONS = "home|wave|follow|FILE.csv|SCRIPT|ARM.toml@PORT"
_MOTION = (
    "What the robot does. follow: reaches for --marker; FILE.csv: replays a trajectory (time_s, and radians "
    "for each joint) or a recording of --record; SCRIPT: as for robot-ik run, on simulated servos; "
    "ARM.toml@PORT: mirrors a live arm."
)


@dataclass(frozen=True)
class ArOptions:
    """Draws a robot into the pictures of a camera, standing on a printed board that is moved about.

    With no options everything is made up: a table, a board, a hand.  Neither camera, OpenGL nor display is
    needed.  Exit code 0: done.  1: the board was in no picture.  2: wrong input.
    """

    robot: Annotated[str, robot_argument(f"the motion's, else {SHOWN_ROBOT}")] = ""
    camera: Annotated[str, arg(metavar="synthetic|INDEX|FILE|FOLDER|URL")] = "synthetic"
    """Where the pictures come from."""
    intrinsics: Lens = None
    board: Annotated[str, arg(metavar="BOARD")] = "grid:2x2:50:12.5"
    """It stands on this: marker:ID:MM, grid:2x2:50:12, charuco:8x6:30:22, chessboard:9x6:25 or FILE.toml."""
    dictionary: Dictionary = ""
    extrinsics: Annotated[Path | None, single("FILE.toml")] = None
    """Where the camera stands (of camera locate), instead of a board; the robot stands in its world."""
    base: Annotated[tuple[float, ...], single("X Y Z [YAW_DEG]")] = ()
    """Where the robot stands: metres from the middle of the board, x right, y up, z out of it."""
    scale: Annotated[float, single(None, "1; synthetic: what fits the table"), Range(0.0)] = 0.0
    """Drawn size over true size."""
    motion: Annotated[str, arg(metavar=_MOTIONS, help=_MOTION)] = "wave"
    marker: Annotated[int, arg(metavar="ID")] = 9
    """The marker to follow."""
    marker_size: Annotated[float, arg(metavar="M")] = 0.05
    """Side of its black square, metres."""
    occluders: Annotated[Path | None, single("FILE")] = None
    """Real objects that hide the robot: boxes in TOML, or MJCF."""
    occluder_geoms: Annotated[tuple[str, ...], several("GEOM")] = ()
    """The same, as geoms of the robot's own model."""
    sync: Literal["tracked", "latest"] = "tracked"
    """Show the picture that was tracked (no delay by construction), or the newest."""
    predict: bool = False
    """Draw where the board will be (for --sync latest)."""
    shift: bool = False
    """Move the finished drawing by the board's motion in the picture (for --sync latest)."""
    alpha: Annotated[float, Range(0.0, 1.0)] = 1.0
    """Opacity of the robot, from 0 to 1."""
    shadow: bool = True
    """Draw the shadow on the board's plane."""
    out: Annotated[str, single("FILE.mp4|FILE.png|DIR", "ar.mp4, else the folder ar")] = ""
    """A film (extra `video`), the last picture, or a folder of pictures."""
    overwrite: Overwrite = False
    seconds: Annotated[float | None, single("S", "all; synthetic: the motion's, or 4"), positive()] = None
    """How long the film is, seconds."""
    size: Annotated[tuple[int, int] | None, single("W H", "the camera's"), _SIDES] = None
    """Size of synthetic and live pictures."""
    seed: int = 0
    """Of the synthetic camera's noise."""
    json: Json = False


def run(options: ArOptions) -> int:
    """Runs the job; 0 done, 1 not."""
    request = make_request(options)
    from robot_ik.jobs.ar.job import run_ar

    with console.progress() as bar:
        report = run_ar(request, console.counted_on(bar, "drawing"))
    if report.notice:
        console.say(report.notice, style="yellow")
    if options.json:
        names = ("pictures", "drawn", "scale", "reprojection_px", "interrupted")
        facts = {name: getattr(report, name) for name in names}
        file = None if report.file is None else str(report.file)
        console.print_json({"file": file, **facts, "track_and_draw_hz": report.rate_hz})
    else:
        _print(report)
    return console.INTERRUPTED if report.interrupted else console.DONE


def _print(report: ArReport) -> None:
    if report.file is None:
        console.say("there was no picture: nothing is written", "yellow")
        return
    board = [("board", f"corners fit to {report.reprojection_px:.2f} px")]
    speed = f"{report.rate_hz:.0f}" if report.rate_hz >= 10.0 else f"{report.rate_hz:.2g}"
    facts = console.facts(
        ("pictures", f"{report.pictures}, the robot in {report.drawn}"),
        ("scale", f"drawn at {report.scale:.3g} of its size"),
        *(board if np.isfinite(report.reprojection_px) else ()),
        ("speed", f"{speed} pictures/s tracked and drawn"),
    )
    console.show(facts)
    console.result(f"written: {report.file}")


def _default_out() -> str:
    from robot_ik.jobs.films import films_can_be_written

    if films_can_be_written():
        return "ar.mp4"
    console.say(f"pictures go to the folder ar; for a film: {install_command('video')}", "yellow")
    return "ar"


def make_request(options: ArOptions) -> ArRequest:
    """The job's request; raises ``ConfigError`` for all that can be wrong without looking."""
    from robot_ik.camera.registration import LatencyOptions
    from robot_ik.jobs.ar.job import ArRequest
    from robot_ik.jobs.ar.motion import robot_of

    _check(options)
    x, y, z, yaw = (*options.base, *(0.0,) * (4 - len(options.base)))
    return request_of(
        ArRequest,
        options,
        robot=options.robot or robot_of(options.motion) or SHOWN_ROBOT,
        base=(x, y, z, yaw),
        marker=(options.marker, options.marker_size),
        latency_options=LatencyOptions(options.sync, options.predict, options.shift),
        out=Path(options.out or _default_out()),
        seconds=options.seconds or 0.0,
    )


def _check(options: ArOptions) -> None:
    base = options.base
    numbers = "3 or 4 finite numbers: x y z in metres, yaw in degrees"
    require(len(base) in (0, 3, 4) and bool(np.isfinite(base).all()), "--base", f"{base}", numbers)
    require(
        options.sync == "latest" or not (options.predict or options.shift), "--sync",
        "the picture that was tracked has no delay to make up for", "--sync latest with --predict or --shift",
    )  # fmt: skip
