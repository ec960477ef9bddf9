"""``robot-ik view`` and ``video``: the testbed in a browser, in MuJoCo's window, replayed, or filmed."""

from __future__ import annotations

import contextlib
import threading
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from robot_ik.camera.drawing.probe import probe_display
from robot_ik.cli import console
from robot_ik.cli.arguments import (
    ArmFile,
    OnExit,
    Overwrite,
    Range,
    positive,
    require,
    robot_argument,
    several,
    single,
    wrong,
)
from robot_ik.cli.connection import NONE, bus_argument, resolved_robot
from robot_ik.errors import MissingExtraError, install_command
from robot_ik.jobs.results import claimed
from robot_ik.robot_file import SERVO_ROBOT, SHOWN_ROBOT, catalogue, find_robot

if TYPE_CHECKING:
    from robot_ik.jobs.testbed import SceneCamera
    from robot_ik.testbed.commands import CommandLog, Start
    from robot_ik.testbed.frontends.page_server import PageServer
    from robot_ik.testbed.presets import Preset
    from robot_ik.testbed.session import Session
    from robot_ik.testbed.view import View


@dataclass(frozen=True)
class ViewOptions:
    """The interactive testbed: drag the ball or any part of the robot, choose methods, compare up to four.

    It opens in the browser; `--viewer window` is MuJoCo's own window. With `--bus` the first robot's joint
    angles go through the limiter to servos, simulated or real. Ctrl-C ends it, and the arm is left by its
    exit policy.

    Exit code 0: done. 1: a replay differs from what its log says. 2: wrong input or environment.
    """

    robot: Annotated[str, robot_argument(f"{SHOWN_ROBOT}")] = ""
    preset: Annotated[str, single("NAME", "none")] = ""
    """arkineman: the figure of thesis P11, with a virtual ball in the picture of a camera."""
    viewer: Literal["auto", "browser", "window", "recorder"] = "auto"
    """auto: the browser; without the extra `web` the window; without a display the recorder."""
    frame: Annotated[str, single("NAME", "the robot's tool")] = ""
    """Frame that follows the ball: a tool, site or body."""
    base: Annotated[str, single("NAME", "all joints move")] = ""
    """Frame that stays: only joints between it and the moved frame are active."""
    joints: Annotated[tuple[str, ...], several("NAME", "all joints")] = ()
    """Active joints."""
    count: int = 1
    """Robots side by side: 1, 2 or 4, each with its own method."""
    method: Annotated[tuple[str, ...], several("NAME", "usual ones")] = ()
    """Methods to begin with."""
    bus: Annotated[str, bus_argument(none=True)] = NONE
    arm: ArmFile = None
    on_exit: OnExit = ""
    replay: Annotated[Path | None, single("FILE", "none")] = None
    """Repeat a command log, and compare how it ends bit by bit."""
    log: Annotated[Path | None, single("FILE", "none")] = None
    """Write the command log at the end."""
    host: str = "127.0.0.1"
    """Address to listen at. One that others can reach asks every browser for a token."""
    host_name: Annotated[tuple[str, ...], several("NAME")] = ()
    """Further names under which browsers may call this machine."""
    port: int = 8080
    """The next free one is taken where it is busy."""
    dark: bool = False
    """Begin with dark colours."""
    camera: bool = True
    """The synthetic camera's tab, where the robot has a scene."""
    shadows: bool = True
    """Draw shadows; without a GPU the browser is faster with --no-shadows."""
    open: bool = True
    """Open the page in the system's browser."""
    seconds: Annotated[float | None, single("S", "until Ctrl-C"), positive(1e6, " s")] = None
    """End by itself after so many seconds."""
    seed: int = 1
    """Of the ball's random places."""
    overwrite: Overwrite = False


def run(options: ViewOptions) -> int:
    """Opens the testbed; 0 done, 1 a replay that differs."""
    if options.replay is not None:
        told = ("robot", "preset", "frame", "base", "joints", "count", "method", "bus", "arm", "log", "seed")
        for name in told:
            same = getattr(options, name) == getattr(ViewOptions, name, ())
            require(same, f"--{name}", "given with --replay", "one of both: the log says what happens")
        return _replay(options.replay)
    if options.preset:
        for name in ("robot", "frame", "base", "joints", "count", "method", "bus", "arm"):
            usual = getattr(options, name) == getattr(ViewOptions, name, ())
            require(usual, f"--{name}", "given with --preset", "one of both: the preset names it")
    _check_methods(options.method, options.count)
    for option, given in (("--arm", options.arm), ("--on-exit", options.on_exit)):
        alone = f"{given} is for servos, and no bus is named"
        require(options.bus != NONE or not given, option, alone, "with --bus sim, pty or PORT")
    viewer = choose_viewer(options.viewer)
    moved = viewer != "recorder" or options.bus == NONE
    require(moved, "--bus", "the recorder moves no servos", "with --viewer browser or window")
    with claimed(options.log, overwrite=options.overwrite):
        return _view(options, viewer)


def choose_viewer(asked: str) -> str:
    """Which front end opens here, asked for as ``--viewer``; says so where it was not named.

    Raises:
        MissingExtraError: The browser is asked for without its extra.
    """
    browser = all(map(find_spec, ("viser", "mjviser")))
    if asked == "browser" and not browser:
        raise MissingExtraError("viser", "web", "the page in the browser")
    if asked != "auto":
        return asked
    if browser:
        return "browser"
    if probe_display(timeout=10.0).ok:
        text = f"the window is opened; for the page in a browser: {install_command('web')}"
        console.say(text, "yellow")
        return "window"
    console.say("neither browser page nor display: the recorder films 10 s instead", "yellow")
    return "recorder"


def _check_methods(methods: tuple[str, ...], count: int) -> None:
    """Raises ``ConfigError`` for a count that there is not, or a method that no robot would have."""
    from robot_ik.testbed.commands import COUNTS

    require(count in COUNTS, "--count", f"{count} robots", "1, 2 or 4")
    many = f"{len(methods)} methods for {console.count_of(count, 'robot')}"
    require(len(methods) <= count, "--method", many, "--count 2 or 4, or fewer methods")


def _view(options: ViewOptions, viewer: str) -> int:
    from robot_ik.testbed.commands import CommandLog, Start

    of_arm = resolved_robot(options.arm, options.bus) if options.arm else ""
    robot = options.robot or of_arm or (SHOWN_ROBOT if options.bus == NONE else SERVO_ROBOT)
    chosen = None
    if options.preset:
        from robot_ik.testbed.presets import preset

        chosen = preset(options.preset)
        robot = chosen.robot
    find_robot(robot)
    start = Start(
        robot, options.count, options.method, options.seed,  # type: ignore[arg-type]
        tool=options.frame, base=options.base, joints=options.joints,
    )  # fmt: skip
    if viewer == "recorder":
        from robot_ik.jobs.testbed import film

        first = chosen.commands if chosen else ()
        out, log = Path("testbed.mp4"), CommandLog(start, tuple((0, command) for command in first))
        with console.kept(out):
            view = film(log, out, seconds=options.seconds or 10.0, overwrite=options.overwrite)
        console.say(f"filmed: {out}")
        _save(replace(log, ticks=view.tick, digest=view.digest()), options.log)
        return console.DONE
    # Before all is loaded, where nothing that is asked for can be wrong.
    early = viewer == "browser" and options.bus == NONE and not options.method and robot in catalogue()
    with _open_server(options) if early else contextlib.nullcontext() as server:
        return _run(start, options, viewer, server, chosen)


def _open_server(options: ViewOptions) -> PageServer:
    """The server; says where it is, and opens the browser, which then loads beside this program."""
    from robot_ik.hardware import bus_row
    from robot_ik.testbed.frontends.page_server import PageServer

    real = options.bus != NONE and not bus_row(options.bus).virtual
    server = PageServer(
        options.host, options.port, token=real, names=options.host_name, dark=options.dark,
        shadows=options.shadows,
    )  # fmt: skip
    console.result(f"the testbed is at {server.url}")
    if server.url_outside:
        console.result(f"from other machines: {server.url_outside}")
    if options.open:
        webbrowser.open(server.url)
    return server


def _run(
    start: Start,
    options: ViewOptions,
    viewer: str,
    server: PageServer | None,
    chosen: Preset | None,
) -> int:
    """The session, the arm and the front end, until they end."""
    from robot_ik.testbed.session import Session

    with contextlib.ExitStack() as stack:
        link = None
        if options.bus != NONE:
            from robot_ik.jobs.testbed import arm_link

            link = arm_link(start.robot, options.arm, options.bus, options.on_exit)
            # Said even where a signal that has waited comes out of ``close``.
            stack.callback(lambda arm: console.say(arm.left, "dim"), link)
            stack.callback(link.close)
        session = stack.enter_context(Session(start, arm=link))
        for command in chosen.commands if chosen else ():
            session.send(command)
        ar = chosen is not None and chosen.ar
        draw = stack.enter_context(_opened(viewer, session, options, server, ar))
        try:
            _loop(session, draw, options)
        finally:  # what went wrong, or was ended from outside, is what a log is read for
            _save(session.log(), options.log)
    return console.DONE


def _save(log: CommandLog, file: Path | None) -> None:
    if file is not None:
        log.save(file)
        console.say(f"command log: {file}")


@contextlib.contextmanager
def _opened(
    viewer: str, session: Session, options: ViewOptions, server: PageServer | None, ar: bool
) -> Iterator[Callable[[View], object]]:
    """A front end's ``draw``."""
    if viewer == "window":
        from robot_ik.testbed.frontends.session_window import SessionWindow

        with SessionWindow(session, ar=ar) as window:
            console.say("keys: " + window.help, "dim")
            yield window.draw
        return
    from robot_ik.testbed.frontends.browser import Page

    def open_camera() -> SceneCamera:
        from robot_ik.jobs.testbed import SceneCamera

        return SceneCamera(session)

    def film(log: CommandLog) -> bytes:
        from robot_ik.jobs.testbed import film_in_process

        return film_in_process(log)

    camera = open_camera if options.camera else None
    with Page(session, server or _open_server(options), camera=camera, film=film) as page:
        page.switch_ar(ar)
        yield page.draw


def _loop(session: Session, draw: Callable[[View], object], options: ViewOptions) -> None:
    from robot_ik.testbed.loop import run as run_session

    stop = threading.Event()
    timer = threading.Timer(options.seconds or threading.TIMEOUT_MAX, stop.set)
    timer.daemon = True
    timer.start()
    with contextlib.suppress(KeyboardInterrupt):
        run_session(session, draw, stop)
    timer.cancel()


def _replay(path: Path) -> int:
    """Repeats a log; says whether it ends as it did."""
    from robot_ik.testbed.commands import CommandLog
    from robot_ik.testbed.loop import last_view

    log = CommandLog.load(path)
    view = last_view(log)
    same = not log.digest or view.digest() == log.digest
    rows = []
    for k, one in enumerate(view.instances, 1):
        solved = f"{100.0 * one.statistics.solved:.0f} %"
        rows.append((f"{view.robot} {k}", one.method, one.status, f"{1e3 * one.error:.3f}", solved))
    console.show(console.table("robot", "method", "status", "off mm", "solved", rows=rows))
    found = "the same bits" if same else "other bits"
    verdict = found if log.digest else "the log has no digest to compare with"
    console.say(f"{len(log.commands)} commands, {view.tick} ticks: {verdict}", "" if same else "bold red")
    if not same:
        console.say("another version of robot_ik or numba, another processor, or an edited log", "yellow")
    return console.DONE if same else console.NOT_ACHIEVED


# ------------------------------------------------------------------------------------------
# ``robot-ik video``: a film of the testbed without a screen, from a command log or by the clock.


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
    robot: Annotated[str, single("NAME|PATH", SHOWN_ROBOT)] = ""
    """Without a log: a name of `robot-ik robots`, or any MJCF or URDF file."""
    count: int = 1
    """Without a log: robots side by side, 1, 2 or 4."""
    method: Annotated[tuple[str, ...], several("NAME", "usual ones")] = ()
    """Without a log: methods."""
    seconds: Annotated[float | None, single("S", "as long as the log"), positive(1e6, " s")] = None
    """How long the film is, seconds; needed without a log."""
    csv: Annotated[Path | None, single("FILE", "none")] = None
    """Numbers of every picture: angles, errors, times."""
    record: Annotated[Path | None, single("FILE.csv|FILE.mcap", "none")] = None
    """Angles and ball at every picture, for other tools (.mcap: extra `record`)."""
    size: Annotated[tuple[int, int], arg(metavar="W H"), Range(64, 8192, " pixels")] = (1280, 720)
    """Width and height, pixels."""
    rate: Annotated[float, arg(metavar="HZ"), Range(1.0, 240.0, " pictures a second")] = 30.0
    """Pictures a second."""
    overwrite: Overwrite = False


def run_video(options: VideoOptions) -> int:
    """Films; 0 done."""
    count, (width, height) = len(options.files), options.size
    given = f"{count} names are given" if count else "no film is named"
    require(1 <= count <= 2, "FILES", given, "OUT, or LOG.jsonl OUT")
    log, out = _log(options), options.files[-1]
    from robot_ik.jobs.testbed import film

    with (
        claimed(options.csv, options.record, overwrite=options.overwrite),
        console.kept(out),
        console.progress() as bar,
    ):
        view = film(
            log, out, numbers=options.csv, record=options.record, seconds=options.seconds,
            rate_hz=options.rate, size=(width - width % 2, height - height % 2),
            overwrite=options.overwrite,
            progress=console.shares_on(bar, "filming"),
        )  # fmt: skip
    numbers = f"; numbers: {options.csv}" if options.csv else ""
    console.say(f"{out}: {view.now:.1f} s of {view.robot}{numbers}")
    return console.DONE


def _log(options: VideoOptions) -> CommandLog:
    from robot_ik.testbed.commands import CommandLog, Start

    if len(options.files) == 2:
        if options.robot or options.count != 1 or options.method:
            raise wrong("--robot, --count, --method", "given with a command log", "the log says what happens")
        return CommandLog.load(options.files[0])
    if options.files[0].suffix == ".jsonl":
        raise wrong("OUT", f"{options.files[0]} is a command log and there is no film", "LOG.jsonl OUT.mp4")
    require(options.seconds is not None, "--seconds", "no log and no length", "--seconds N, above 0")
    _check_methods(options.method, options.count)
    start = Start(options.robot or SHOWN_ROBOT, options.count, options.method)  # type: ignore[arg-type]
    return CommandLog(start, ())
