"""``robot-ik figure``: a humanoid that sees a ball, decides, and reaches, bends, jumps or walks."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import Json, Lens, Overwrite, Range, positive, request_of, require, single, wrong
from robot_ik.files import claimed, write_atomically
from robot_ik.geometry import Pose

if TYPE_CHECKING:
    from robot_ik.figure.abilities import Abilities
    from robot_ik.figure.session import FigureFrame
    from robot_ik.jobs.figure import FigureReport
    from robot_ik.robot import Robot

_LION_BALLS = (0.9, -0.2, 0.6), (0.7, 0.4, 0.5)
# Pictures of the synthetic camera that are not shown: the ball's place to 4 mm at a quarter of the time.
_UNSEEN_SIZE = (640, 360)
_SHOWN = (0.45, -0.25, 1.45), (0.5, -0.2, 0.2), (2.2, 0.8, 1.2), (2.6, 0.9, 2.35)


@dataclass(frozen=True)
class FigureOptions:
    """A figure sees a ball, decides what to do, and does it: reach, bend, jump, walk, or nothing.

    Without a ball it is shown four, one after the other. Frames are 60 a second; a run ends when nothing
    goes on.

        robot-ik figure --ball 0.5 -0.2 0.2 --record bend.mp4
        robot-ik figure --balls balls.csv > decisions.jsonl
        robot-ik figure --ar --camera 0 --intrinsics camera.yaml

    Exit code 0: every hand came to its ball within 5 mm; none need come to a ball that moves. 1: one did not.
    2: wrong input or environment.
    """

    ball: Annotated[tuple[float, float, float] | None, single("X Y Z")] = None
    """Where the ball is, metres."""
    balls: Annotated[Path | None, single("FILE.csv")] = None
    """Balls, x, y, z in each row: prints one decision a line as JSON, without moving."""
    path: Annotated[Literal["", "circle", "random", "marker"], single("circle|random|marker")] = ""
    """A ball that moves; or a printed marker in the pictures of --camera."""
    seconds: Annotated[float, arg(metavar="S"), positive(what=" s")] = 12.0
    """How long it moves, seconds."""
    camera: Annotated[str, single("synthetic|INDEX|FILE|FOLDER|URL")] = ""
    """Where the marker is seen, above a printed board on which the figure stands."""
    intrinsics: Lens = None
    board: Annotated[str, arg(metavar="BOARD")] = "grid:2x2:50:12.5"
    """The board, as for robot-ik ar."""
    marker: Annotated[int, arg(metavar="ID")] = 9
    """The marker that is the ball."""
    marker_size: Annotated[float, arg(metavar="M")] = 0.05
    """Side of its black square, metres."""
    scale: Annotated[float, single(None, "1; synthetic: what fits the table"), Range(0.0)] = 0.0
    """Size of the figure over life size."""
    ar: bool = False
    """Draw the figure into the camera's pictures, written to --record (else to ar.mp4, or the folder ar)."""
    place: Annotated[tuple[float, float, float], arg(metavar="X Y HEADING")] = (0.0, 0.0, 0.0)
    """Where the figure stands at first: metres, metres, degrees."""
    mode: Annotated[Literal["active", "passive"], arg(metavar="active|passive")] = "active"
    """Active follows the ball; passive acts on the ball as it was at the start."""
    model: Annotated[str, arg(metavar="NAME|PATH")] = "humanoid"
    """A model whose robot.toml has a table [figure], or a lion: four paws and a gaze."""
    record: Annotated[Path | None, single("OUT", "none")] = None
    """A film (.mp4, .gif), a picture, or a folder of pictures."""
    frames: Annotated[Path | None, single("OUT.csv", "none")] = None
    """A table of all frames, for programs that check them."""
    viewer: bool = False
    """Show it in MuJoCo's window."""
    seed: int = 0
    """Of random balls."""
    json: Json = False
    overwrite: Overwrite = False


def run(options: FigureOptions) -> int:
    """Runs the figure; 1 where a hand did not come to its ball."""
    options = _checked(options)
    from robot_ik.figure.decide import Decider
    from robot_ik.figure.lion import Lion, is_lion
    from robot_ik.jobs.figure import frames_table, read_balls, record, run_lion
    from robot_ik.motion.keyframes import Keyframes
    from robot_ik.robot import load_robot

    robot = load_robot(options.model)
    lion = robot.file.figure is None and is_lion(robot)
    if lion and (options.path or options.mode != "active"):
        raise wrong("--model", f"{robot.name} stands where it is", "a lion takes --ball or --balls")
    who = Lion(robot) if lion else _abilities(robot)
    if options.balls is not None:
        stance = _stance(options)
        for ball in read_balls(options.balls):
            decision = who.decide(ball) if isinstance(who, Lion) else Decider(who).decide(ball, stance)
            console.print_json_line({"ball": ball, **asdict(decision)})
        return console.DONE
    with claimed(options.frames, overwrite=options.overwrite):
        if isinstance(who, Lion):
            balls = _LION_BALLS if options.ball is None else (options.ball,)
            report = _watch(robot, {paw: paw for paw in who.paws}, run_lion(who, balls), options)
        else:
            report = _watch(robot, who.figure.hands, _frames(who, options), options)
        if options.frames is not None:
            if isinstance(who, Lion):
                q = [frame.q for frame in report.frames]
                Keyframes(robot, np.arange(len(q)) / 60.0, q).save_csv(options.frames)
            else:
                write_atomically(options.frames, frames_table(who.figure, report.frames, options.seed))
    if options.record is not None and not options.ar:
        with console.kept(options.record), console.progress() as bar:
            progress = console.counted_on(bar, f"painting {options.record}")
            record(robot, report.frames, options.record, progress, overwrite=options.overwrite)
    _print(report, options)
    went = bool(report.misses) or options.ball is None
    return console.DONE if went and report.arrived else console.NOT_ACHIEVED


def _checked(options: FigureOptions) -> FigureOptions:
    """The options, with what they imply; raises ``ConfigError`` where some contradict each other."""
    for name in (name for name in ("ar", "camera") if getattr(options, name)):
        other = next((other for other in ("ball", "balls") if getattr(options, other)), "")
        require(not other, f"--{name}", f"--{other} is given, too", "one of both; the ball is a marker there")
        seen = "--path marker: the ball is a marker that it sees"
        require(options.path in ("", "marker"), f"--{name}", f"--path is {options.path}", seen)
        options = replace(options, path="marker")
    if options.path == "marker" and not options.camera:
        options = replace(options, camera="synthetic")
    asked = [name for name in ("ball", "balls", "path") if getattr(options, name)]
    if len(asked) > 1:
        raise wrong(f"--{asked[1]}", f"--{asked[0]} is given, too", "one of --ball, --balls, --path")
    finite = options.ball is None or bool(np.isfinite(options.ball).all())
    require(finite, "--ball", f"{options.ball}", "three finite numbers, metres")
    numbers = "three finite numbers: metres, metres, degrees"
    require(bool(np.isfinite(options.place).all()), "--place", f"{options.place}", numbers)
    for name in ("record", "frames", "viewer") if options.balls is not None else ():
        require(not getattr(options, name), f"--{name}", "with --balls nothing moves", "without --balls")
    drawn = "--ar draws into the camera's pictures"
    require(not (options.ar and options.viewer), "--viewer", drawn, "one of both")
    return options


def _abilities(robot: Robot) -> Abilities:
    from robot_ik.figure.abilities import load_abilities
    from robot_ik.figure.figure import load_figure

    with console.progress() as bar:
        progress = console.counted_on(bar, "what it can reach, once for each model", "points")
        return load_abilities(load_figure(robot), progress=progress)


def _stance(options: FigureOptions) -> tuple[float, float, float]:
    return options.place[0], options.place[1], math.radians(options.place[2])


def _balls(options: FigureOptions) -> tuple[tuple[float, float, float], ...]:
    """Those that stand still."""
    return (options.ball,) if options.ball is not None else () if options.path else _SHOWN


def _frames(abilities: Abilities, options: FigureOptions) -> Iterator[FigureFrame]:
    """Of what it does, with ``--ar`` drawn into the camera's pictures already."""
    from robot_ik.jobs.ar.job import ArRequest, marker_positions
    from robot_ik.jobs.figure import FigureRequest, draw_on_camera, run_figure, run_marker
    from robot_ik.jobs.films import films_can_be_written

    path = "" if options.path == "marker" else options.path
    request = FigureRequest(
        _balls(options), path, options.seconds, _stance(options), options.mode, seed=options.seed
    )
    if options.path != "marker":
        return run_figure(abilities, request)
    camera = request_of(
        ArRequest,
        options,
        robot=options.model,
        motion="follow",
        marker=(options.marker, options.marker_size),
        out=options.record or Path("ar.mp4" if films_can_be_written() else "ar"),
        size=_UNSEEN_SIZE if options.camera == "synthetic" and not options.ar else None,
    )
    if not options.ar:
        return run_marker(abilities, request, marker_positions(camera, abilities.figure.robot))
    with console.progress() as bar:
        report, frames = draw_on_camera(abilities, request, camera, console.counted_on(bar, "drawing"))
    if report.notice:
        console.say(report.notice, style="yellow")
    console.say(f"{report.pictures} pictures, the figure in {report.drawn}: {report.file}")
    if report.interrupted:
        raise KeyboardInterrupt
    return iter(frames)


def _watch(
    robot: Robot, hands: Mapping[str, str], frames: Iterator[FigureFrame], options: FigureOptions
) -> FigureReport:
    from robot_ik.jobs.figure import BALL_RADIUS, TILES, watch

    if not options.viewer:
        with console.progress() as bar:
            task = bar.add_task("moving", total=options.seconds if options.path else None, note="")
            return watch(
                robot, hands, frames,
                lambda frame: bar.update(task, completed=frame.t, note=f"{frame.t:.1f} s {frame.action}"),
            )  # fmt: skip
    from robot_ik.testbed.frontends.window import Solid, WindowSink

    instead = "run it without --viewer, or film it with --record"
    floor = [Solid(Pose(position), half, rgba) for position, half, rgba in TILES]
    balls = (ball for ball in _balls(options) if np.isfinite(ball).all())
    see = np.array([(*options.place[:2], 0.0), *balls])
    with WindowSink(robot, ball=BALL_RADIUS, see=see, solids=floor, instead=instead) as window:
        began = time.monotonic()

        def show(frame: FigureFrame) -> None:
            time.sleep(max(0.0, began + frame.t - time.monotonic()))
            window.show_ball(frame.ball)
            window.show_text(frame.action, frame.decision.reason)
            window.send(frame.q, frame.t)

        report = watch(robot, hands, frames, show)
        window.wait()
    return report


def _print(report: FigureReport, options: FigureOptions) -> None:
    count = len(report.frames)
    if options.json:
        decisions = [{"t": t, **asdict(decision)} for t, decision in report.decisions]
        misses = [{"action": action, "miss_m": miss} for action, miss in report.misses]
        console.print_json({"schema": 1, "decisions": decisions, "misses": misses, "frames": count})
        return
    rows: list[tuple[str, ...]] = []
    for t, one in report.decisions:
        said = (one.action, one.arm or "", one.reason)
        if not rows or rows[-1][1:] != said:  # a ball that moves is decided upon again and again
            rows.append((f"{t:.2f}", *said))
    touches = ", ".join(f"{action} {1000 * miss:.2f} mm" for action, miss in report.misses)
    console.show(
        console.table("s", "decision", "hand", "why", rows=rows),
        f"{count} frames, {count / 60.0:.1f} s; hand from the ball: {touches or 'no touch'}",
    )
