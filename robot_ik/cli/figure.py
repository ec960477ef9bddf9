"""``robot-ik figure``: a humanoid that sees a ball, decides, and reaches, bends, jumps or walks."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.environment import import_mujoco
from robot_ik.files import claimed, write_atomically

if TYPE_CHECKING:
    from robot_ik.figure.abilities import Abilities
    from robot_ik.figure.session import FigureFrame
    from robot_ik.jobs.figure import FigureReport, FigureRequest

_SHOWN = (0.45, -0.25, 1.45), (0.5, -0.2, 0.2), (2.2, 0.8, 1.2), (2.6, 0.9, 2.35)


@dataclass(frozen=True)
class FigureOptions:
    """A figure sees a ball, decides what to do, and does it: reach, bend, jump, walk, or nothing.

    Without a ball it is shown four, one after the other. Frames are 60 a second; a run ends when nothing
    goes on.

        robot-ik figure --ball 0.5 -0.2 0.2 --record bend.mp4
        robot-ik figure --balls balls.csv > decisions.jsonl

    Exit code 0: every hand came to its ball within 5 mm. 1: one did not. 2: wrong input or environment.
    """

    ball: Annotated[tuple[float, float, float] | None, arg(metavar="X Y Z", help_behavior_hint="")] = None
    """Where the ball is, metres."""
    balls: Annotated[Path | None, arg(metavar="FILE.csv", help_behavior_hint="")] = None
    """Balls, x, y, z in each row: prints one decision a line as JSON, without moving."""
    path: Annotated[Literal["", "circle", "random"], arg(metavar="circle|random", help_behavior_hint="")] = ""
    """A ball that moves."""
    seconds: float = 12.0
    """How long it moves."""
    place: Annotated[tuple[float, float, float], arg(metavar="X Y HEADING")] = (0.0, 0.0, 0.0)
    """Where the figure stands at first: metres, metres, degrees."""
    mode: Annotated[Literal["active", "passive"], arg(metavar="active|passive")] = "active"
    """Active follows the ball; passive acts on the ball as it was at the start."""
    model: Annotated[str, arg(metavar="NAME|PATH")] = "humanoid"
    """A model whose robot.toml has a table [figure]."""
    record: Annotated[Path | None, arg(metavar="OUT", help_behavior_hint="(default: none)")] = None
    """A film (.mp4, .gif), a picture, or a folder of pictures."""
    frames: Annotated[Path | None, arg(metavar="OUT.csv", help_behavior_hint="(default: none)")] = None
    """A table of all frames, for programs that check them."""
    viewer: bool = False
    """Show it in MuJoCo's window."""
    tour: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: none)")] = None
    """Draw a picture of each decision, and film strips."""
    seed: int = 0
    """Of random balls."""
    json: bool = False
    """Print what was done as JSON."""
    overwrite: bool = False
    """Files of an earlier run may be replaced."""


def run(options: FigureOptions) -> int:
    """Runs the figure."""
    import_mujoco()
    asked = [name for name in ("ball", "balls", "path", "tour") if getattr(options, name)]
    if len(asked) > 1:
        raise wrong(f"--{asked[1]}", f"--{asked[0]} is given, too", "one of --ball, --balls, --path, --tour")
    abilities = _abilities(options.model)
    if options.balls is not None:
        return _decisions(abilities, options)
    if options.tour is not None:
        return _tour(abilities, options.tour)
    with claimed(options.frames, overwrite=options.overwrite):
        report = _watch(abilities, options)
        if options.frames is not None:
            from robot_ik.jobs.figure import frames_table

            write_atomically(options.frames, frames_table(abilities.figure, report.frames, options.seed))
    if options.record is not None:
        from robot_ik.jobs.figure import record

        with console.busy(f"painting {options.record}"):
            record(abilities.figure, report.frames, options.record, (), overwrite=options.overwrite)
    _print(report, options)
    return console.DONE if report.worst <= 0.005 else console.NOT_ACHIEVED


def _abilities(model: str) -> Abilities:
    from robot_ik.figure.abilities import load_abilities
    from robot_ik.figure.figure import load_figure

    with console.progress() as bar:
        task = bar.add_task("what it can reach", total=None, note="once for each model", visible=False)

        def progress(done: int, whole: int) -> None:
            bar.update(task, completed=done, total=whole, visible=True)

        return load_abilities(load_figure(model), progress=progress)


def _place(options: FigureOptions) -> tuple[float, float, float]:
    from math import radians

    return options.place[0], options.place[1], radians(options.place[2])


def _request(options: FigureOptions) -> FigureRequest:
    from robot_ik.jobs.figure import FigureRequest

    balls = (options.ball,) if options.ball is not None else () if options.path else _SHOWN
    return FigureRequest(
        balls, options.path, options.seconds, _place(options), options.mode, seed=options.seed
    )


def _decisions(abilities: Abilities, options: FigureOptions) -> int:
    import json

    from robot_ik.jobs.figure import decide_balls, read_balls

    assert options.balls is not None
    for row in decide_balls(abilities, read_balls(options.balls), _place(options)):
        console.out().file.write(json.dumps(row) + "\n")
    return console.DONE


def _tour(abilities: Abilities, folder: Path) -> int:
    from robot_ik.files import make_folder
    from robot_ik.jobs.figure import tour

    make_folder(folder)
    for file in tour(abilities, folder, console.say):
        console.out().print(str(file), markup=False)
    return console.DONE


def _watch(abilities: Abilities, options: FigureOptions) -> FigureReport:
    from robot_ik.jobs.figure import run_figure, watch

    frames: Iterator[FigureFrame] = run_figure(abilities, _request(options))
    if not options.viewer:
        return watch(abilities, frames, lambda frame: None)
    from robot_ik.testbed.frontends.window import WindowSink

    with WindowSink(abilities.figure.robot) as window:
        began = time.monotonic()

        def show(frame: FigureFrame) -> None:
            time.sleep(max(0.0, began + frame.t - time.monotonic()))
            window.send(frame.q, frame.t)

        report = watch(abilities, frames, show)
        window.wait()
    return report


def _print(report: FigureReport, options: FigureOptions) -> None:
    if options.json:
        from dataclasses import asdict

        console.print_json(
            {
                "schema": 1,
                "decisions": [{"t": t, **asdict(decision)} for t, decision in report.decisions],
                "misses": [{"action": action, "miss_m": miss} for action, miss in report.misses],
                "frames": len(report.frames),
            }
        )
        return
    shown = console.table("s", "decision", "hand", "why")
    for t, decision in report.decisions:
        shown.add_row(f"{t:.2f}", decision.action, decision.arm or "", decision.reason)
    console.out().print(shown)
    misses = ", ".join(f"{action} {1000 * miss:.2f} mm" for action, miss in report.misses)
    seconds = len(report.frames) / 60.0
    console.out().print(
        f"{len(report.frames)} frames, {seconds:.1f} s; hand from the ball: {misses or 'no touch'}"
    )
