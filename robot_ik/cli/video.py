"""``robot-ik video``: a film of the testbed without a screen, from a command log or by the clock."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import several, wrong
from robot_ik.environment import import_mujoco
from robot_ik.files import claimed
from robot_ik.robot_file import SHOWN_ROBOT

if TYPE_CHECKING:
    from robot_ik.testbed.commands import CommandLog

_SIDES = (64, 8192)


@dataclass(frozen=True)
class VideoOptions:
    """Films the testbed: no display, no browser, and by the painter no OpenGL either.

        robot-ik video --seconds 8 --count 4 four.mp4
        robot-ik video bug.jsonl bug.gif

    Names are told apart by their ending: a command log is .jsonl; OUT is .mp4, .mkv, .mov, .gif, .png (the
    last picture), or a folder. Exit code 0: done. 2: wrong input or environment.
    """

    files: Positional[
        Annotated[tuple[Path, ...], arg(metavar="[LOG.jsonl] OUT", help_behavior_hint="(required)")]
    ]
    """What happens, and where the film goes."""
    robot: Annotated[str, arg(metavar="NAME|PATH", help_behavior_hint=f"(default: {SHOWN_ROBOT})")] = ""
    """Without a log: a name of `robot-ik robots`, or any MJCF or URDF file."""
    count: int = 1
    """Without a log: robots side by side, 1, 2 or 4."""
    method: Annotated[tuple[str, ...], several("NAME", "usual ones")] = ()
    """Without a log: methods."""
    seconds: Annotated[float, arg(help_behavior_hint="(default: as long as the log)")] = 0.0
    """How long."""
    csv: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Numbers of every picture: angles, misses, times."""
    record: Annotated[
        Path | None, arg(metavar="FILE.csv|FILE.mcap", help_behavior_hint="(default: none)")
    ] = None
    """Angles and ball at every picture, for other tools (.mcap: extra `record`)."""
    size: tuple[int, int] = (1280, 720)
    """Width and height, pixels."""
    rate: float = 30.0
    """Pictures a second."""
    backend: Literal["gl", "painter"] = "gl"
    """Who draws; without OpenGL the painter does."""
    overwrite: bool = False
    """These files may be there from an earlier run: they are replaced."""


def run(options: VideoOptions) -> int:
    """Films; 0 done."""
    import_mujoco()
    if not 1 <= len(options.files) <= 2:
        raise wrong("FILES", f"{len(options.files)} names", "OUT, or LOG.jsonl OUT")
    if not all(_SIDES[0] <= side <= _SIDES[1] for side in options.size):
        raise wrong("--size", f"{options.size[0]} x {options.size[1]}", "64 to 8192 pixels each")
    if not 1.0 <= options.rate <= 240.0:
        raise wrong("--rate", f"{options.rate:g} pictures a second", "1 to 240")
    log, out = _log(options), options.files[-1]
    width, height = (side - side % 2 for side in options.size)
    from robot_ik.jobs.testbed import film

    with claimed(options.csv, options.record, overwrite=options.overwrite), console.progress() as bar:
        task = bar.add_task("filming", total=None, note="")
        view = film(
            log, out, numbers=options.csv, record=options.record, seconds=options.seconds,
            rate_hz=options.rate,
            size=(width, height), backend=options.backend, overwrite=options.overwrite,
            on_tick=lambda view, count: bar.update(task, total=count, completed=view.tick),
        )  # fmt: skip
    console.say(
        f"{out}: {view.now:.1f} s of {view.robot}" + (f"; numbers: {options.csv}" if options.csv else "")
    )
    return console.DONE


def _log(options: VideoOptions) -> CommandLog:
    from robot_ik.testbed.commands import COUNTS, CommandLog, Start

    if len(options.files) == 2:
        if options.robot or options.count != 1 or options.method:
            raise wrong("--robot, --count, --method", "given with a command log", "the log says what happens")
        return CommandLog.load(options.files[0])
    if options.files[0].suffix == ".jsonl":
        raise wrong("OUT", f"{options.files[0]} is a command log and there is no film", "LOG.jsonl OUT.mp4")
    if options.seconds <= 0.0:
        raise wrong("--seconds", "no log and no length", "--seconds N, above 0")
    if options.count not in COUNTS:
        raise wrong("--count", f"{options.count} robots", "1, 2 or 4")
    start = Start(options.robot or SHOWN_ROBOT, methods=options.method)
    return CommandLog(replace(start, count=options.count), ())
