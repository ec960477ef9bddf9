"""``robot-ik view``: the testbed in a browser or in MuJoCo's window, replayed, or as a video."""

from __future__ import annotations

import contextlib
import threading
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.arms import default_robot
from robot_ik.commands.options import (
    BUS_HELP,
    BUS_METAVAR,
    NO_BUS,
    OUTPUT,
    OUTPUT_GROUP,
    ArmName,
    BaseName,
    ExitPolicy,
    FrameName,
    JointNames,
    OverwriteOption,
    Seconds,
    Seed,
)
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import MissingExtraError, OptionError, install_command

if TYPE_CHECKING:
    from robot_ik.testbed.commands import CommandLog, Start
    from robot_ik.testbed.filming import SceneCamera
    from robot_ik.testbed.frontends.page_server import PageServer
    from robot_ik.testbed.presets import Preset
    from robot_ik.testbed.session import Session
    from robot_ik.testbed.view import View as SessionView

# NumPy, MuJoCo, pydantic and viser take more than 1 s to import: the methods import them.

DEFAULT_ADDRESS = "127.0.0.1"
DEFAULT_PORT = 8080
"""Address of the page without ``--host``. The next free port is taken if it is busy."""

DEFAULT_SIZE = (1280, 720)
"""px. Width and height of a video without ``--size``."""

DEFAULT_RATE = 30.0
"""Pictures a second of a video without ``--rate``."""

MIN_SIDE = 64
"""px. The statistics in smaller pictures cannot be read."""

MAX_SIDE = 8192
"""px. The largest side that video codecs accept."""

MAX_RATE = 240.0
"""Hz. Faster than any display."""

DISPLAY_SECONDS = 10.0
"""Time limit of the check for a display."""

FALLBACK_VIDEO = Path("testbed.mp4")
FALLBACK_SECONDS = 10.0
"""Video of a machine with neither the page nor a display."""

Viewer = Literal["browser", "window"]


@dataclass(frozen=True, kw_only=True)
class View(OverwriteOption):
    """Open the interactive testbed: drag the ball or any part of a robot, compare solvers.

    By default the page opens in the browser. With --bus the joint angles of the first robot go
    through the limiter to servos. Ctrl-C ends the testbed, and the arm is left by its exit policy.
    With --video the testbed is filmed without browser, display or OpenGL.

        robot-ik view --robot humanoid
        robot-ik view --solver dls lm pseudoinverse ccd
        robot-ik view --bus sim --log bug.jsonl
        robot-ik view --replay bug.jsonl --video bug.gif

    Exit code 1: a replay ends differently from its log.
    """

    robot: Annotated[
        str,
        Parameter(
            metavar="NAME|FILE",
            help="Robot name (see `robot-ik robots`), MJCF or URDF file. Default: that of the arm "
            "file; without servos puma560.",
        ),
    ] = ""
    preset: Annotated[str, Parameter(metavar="NAME")] = ""
    """Program of a thesis. arkineman: the figure of thesis P11, with a virtual ball in the picture
    of a camera."""
    frame: FrameName = None
    base: BaseName = None
    joints: JointNames = ()
    solver: Annotated[
        tuple[str, ...],
        Parameter(
            metavar="NAME …",
            consume_multiple=True,
            allow_repeating=True,
            help="Solver (see `robot-ik solvers`). One robot for each: 1, 2 or 4. Default: one "
            "robot with a usual solver.",
        ),
    ] = ()
    seed: Seed = 1
    bus: Annotated[
        str,
        Parameter(
            alias="--port",
            metavar=f"{BUS_METAVAR}|{NO_BUS}",
            help=f"Servo bus. {BUS_HELP}; none: no servos.",
        ),
    ] = NO_BUS
    arm: ArmName = ""
    on_exit: ExitPolicy = None
    viewer: Annotated[
        Viewer | None,
        Parameter(
            metavar="browser|window",
            help="Show the motion live. In the browser, or in MuJoCo's window. Default: the "
            "browser; without the extra `web` the window; without a display a video, testbed.mp4.",
        ),
    ] = None
    host: Annotated[str, Parameter(metavar="ADDR[:PORT]")] = ""
    """Address to listen at. Browsers of other machines need the token of the printed address. The
    page is not opened in a browser here, unless --viewer browser is given, too. Default:
    127.0.0.1:8080. The next free port is taken if it is busy."""
    seconds: Annotated[
        Seconds | None,
        Parameter(help="Duration, in s. Default: until Ctrl-C; with --replay as long as the log."),
    ] = None
    replay: Annotated[Path | None, Parameter(metavar="FILE.jsonl")] = None
    """Repeat a command log. Its end is compared with that of the log, bit by bit."""
    log: Annotated[Path | None, Parameter(metavar="FILE.jsonl", group=OUTPUT_GROUP), OUTPUT] = None
    """Write the command log at the end. It has everything that --replay needs."""
    video: Annotated[
        Path | None,
        Parameter(
            metavar="FILE.mp4|FILE.gif|FILE.png|FOLDER",
            group=OUTPUT_GROUP,
            help="Write a video of the motion (extra `video`). Or the last picture, or a folder "
            "of pictures. --seconds or --replay sets its duration.",
        ),
    ] = None
    record: Annotated[
        Path | None,
        Parameter(
            metavar="FILE.csv|.mcap",
            group=OUTPUT_GROUP,
            help="Record every command and measurement. With --video: joint angles and ball of "
            "every picture. A .mcap file needs the extra `record`.",
        ),
        OUTPUT,
    ] = None
    size: Annotated[
        tuple[int, int] | None,
        Parameter(metavar="W H", group=OUTPUT_GROUP, validator=Number(gte=MIN_SIDE, lte=MAX_SIDE)),
    ] = None
    """Picture size in pixels. With --video. Default: 1280 720."""
    rate: Annotated[
        float | None,
        Parameter(metavar="HZ", group=OUTPUT_GROUP, validator=Number(gte=1, lte=MAX_RATE)),
    ] = None
    """Samples a second. Pictures of --video. Default: 30."""

    def run(self, terminal: Terminal = QUIET) -> ViewReport | ReplayReport:
        """Open the testbed until it ends, replay a log, or film.

        Raises:
            OptionError: Options exclude each other.
            RobotIkError: The robot, the arm, the log or a front end cannot be used.
        """
        self._require_possible()
        if self.replay is not None:
            return self._replay(self.replay, terminal)
        if self.video is not None:
            return self._film(self.video, terminal)
        viewer = choose_viewer("browser" if self.host else self.viewer, terminal)
        if viewer is not None:
            return self._open(viewer, terminal)
        self._refuse(("bus",), "a video moves no servos", "with --viewer browser or window")
        return self._film(FALLBACK_VIDEO, terminal)

    def _require_possible(self) -> None:
        """Check the options that exclude each other.

        Raises:
            OptionError: An option would be ignored, or a value is not allowed.
        """
        from robot_ik.testbed.commands import COUNTS

        start = ("robot", "frame", "base", "joints", "solver", "bus", "arm")
        if self.replay is not None:
            names = (*start, "preset", "seed", "viewer", "host", "log")
            self._refuse(names, "given with --replay", "one of both: the log says what happens")
        if self.preset:
            self._refuse(start, "given with --preset", "one of both: the preset sets it")
        if self.solver and len(self.solver) not in COUNTS:
            raise OptionError("--solver", f"{len(self.solver)} solvers", "1, 2 or 4")
        if self.bus == NO_BUS:
            needed = "with --bus sim, pty or PORT"
            self._refuse(("arm", "on_exit"), "for servos, and no bus is named", needed)
        if self.viewer == "window":
            self._refuse(("host",), "MuJoCo's window has no address", "with --viewer browser")
        if self.video is None:
            self._refuse(("record", "size", "rate"), "there is no video", "with --video FILE")
            if self.replay is not None:
                self._refuse(("seconds",), "there is no video", "with --video FILE")
        else:
            self._refuse(("bus",), "a video moves no servos", "without --video")
            self._refuse(("viewer", "host"), "a video needs no viewer", "without --video")
            if self.replay is None and self.seconds is None:
                raise OptionError("--seconds", "the video has no duration", "--seconds S")
        if self.host:
            parse_host(self.host)

    def _refuse(self, names: Iterable[str], problem: str, allowed: str) -> None:
        """Raise ``OptionError`` for the first of these options that has another value."""
        defaults = type(self)()
        for name in names:
            if getattr(self, name) != getattr(defaults, name):
                raise OptionError("--" + name.replace("_", "-"), problem, allowed)

    def _chosen_preset(self) -> Preset | None:
        """Return the preset, None without one.

        Raises:
            ConfigError: There is no preset of that name.
        """
        if not self.preset:
            return None
        from robot_ik.testbed.presets import preset

        return preset(self.preset)

    def _start(self, preset: Preset | None) -> Start:
        """Return what the session begins with.

        Raises:
            RobotIkError: There is no such robot, or a value is not allowed.
        """
        from robot_ik.robot_file import SERVO_ROBOT, SHOWN_ROBOT, find_robot
        from robot_ik.testbed.commands import Start

        robot = self.robot
        if preset is not None:
            robot = preset.robot
        elif not robot and self.arm:
            robot = default_robot(self.arm, self.bus)
        elif not robot:
            robot = SHOWN_ROBOT if self.bus == NO_BUS else SERVO_ROBOT
        find_robot(robot)
        return Start(
            robot,
            len(self.solver) or 1,  # type: ignore[arg-type]
            self.solver,
            self.seed,
            tool=self.frame or "",
            base=self.base or "",
            joints=self.joints,
        )

    def _replay(self, file: Path, terminal: Terminal) -> ReplayReport:
        """Repeat a command log, and film it if a video is wanted."""
        from robot_ik.testbed.commands import CommandLog
        from robot_ik.testbed.loop import last_view

        log = CommandLog.load(file)
        if self.video is None:
            terminal.progress("replaying")
            return ReplayReport(last_view(log), log)
        view = self._draw(log, self.video, self.seconds, terminal)
        return ReplayReport(view, log if self.seconds is None else None, self._files(self.video))

    def _film(self, video: Path, terminal: Terminal) -> ReplayReport:
        """Film a session in which nobody does anything, and write its command log."""
        from robot_ik.testbed.commands import CommandLog

        preset = self._chosen_preset()
        commands = preset.commands if preset is not None else ()
        log = CommandLog(self._start(preset), tuple((0, command) for command in commands))
        view = self._draw(log, video, self.seconds or FALLBACK_SECONDS, terminal)
        self._save(replace(log, ticks=view.tick, digest=view.digest()), terminal)
        return ReplayReport(view, files=self._files(video))

    def _files(self, video: Path) -> tuple[Path, ...]:
        return (video,) if self.record is None else (video, self.record)

    def _draw(
        self, log: CommandLog, video: Path, seconds: float | None, terminal: Terminal
    ) -> SessionView:
        """Film a command log, and return its last view."""
        from robot_ik.testbed.filming import film

        width, height = self.size or DEFAULT_SIZE
        with saying_what_is_kept(video, terminal):
            return film(
                log,
                video,
                record=self.record,
                seconds=seconds,
                rate_hz=self.rate or DEFAULT_RATE,
                size=(width - width % 2, height - height % 2),  # codecs take even numbers
                overwrite=self.overwrite,
                progress=lambda _, share: terminal.progress("filming", share),
            )

    def _save(self, log: CommandLog, terminal: Terminal) -> None:
        """Write the command log if it is wanted."""
        if self.log is not None:
            log.save(self.log)
            terminal.say(f"command log: {self.log}")

    def _open(self, viewer: Viewer, terminal: Terminal) -> ViewReport:
        """Open a front end and run the session until it ends."""
        from robot_ik.robot_file import catalogue

        preset = self._chosen_preset()
        start = self._start(preset)
        terminal.end_progress()
        # The browser loads the page while this program loads the solvers. Only if no option can
        # be wrong: otherwise an error would follow an open page.
        is_certain = self.bus == NO_BUS and not self.solver and start.robot in catalogue()
        is_early = viewer == "browser" and is_certain
        with self._open_server(terminal) if is_early else contextlib.nullcontext() as server:
            self._run_session(start, viewer, server, preset, terminal)
        return ViewReport()

    def _open_server(self, terminal: Terminal) -> PageServer:
        """Open the server, print its address, and open a browser if one is wanted."""
        from robot_ik.hardware import bus_row
        from robot_ik.testbed.frontends.page_server import PageServer

        is_real = self.bus != NO_BUS and not bus_row(self.bus).virtual
        address, port = parse_host(self.host)
        server = PageServer(address, port, token=is_real)
        terminal.print(f"the testbed is at {server.url}")
        if server.url_outside:
            terminal.print(f"from other machines: {server.url_outside}")
        if self.viewer == "browser" or not self.host:
            webbrowser.open(server.url)
        return server

    def _run_session(
        self,
        start: Start,
        viewer: Viewer,
        server: PageServer | None,
        preset: Preset | None,
        terminal: Terminal,
    ) -> None:
        """Run the session, its arm and its front end, and write the command log."""
        from robot_ik.testbed.session import Session

        with contextlib.ExitStack() as stack:
            link = None
            if self.bus != NO_BUS:
                from robot_ik.testbed.filming import arm_link

                arm = Path(self.arm) if self.arm else None
                link = arm_link(start.robot, arm, self.bus, self.on_exit or "")
                # Printed also if a signal is raised while the arm is left.
                stack.callback(lambda link: terminal.say(link.left, "dim"), link)
                stack.callback(link.close)
            session = stack.enter_context(Session(start, arm=link))
            for command in preset.commands if preset is not None else ():
                session.send(command)
            has_ar = preset is not None and preset.ar
            draw = stack.enter_context(self._front_end(viewer, session, server, has_ar, terminal))
            try:
                run_until_end(session, draw, self.seconds)
            finally:  # an error or a signal is a reason to read the log
                self._save(session.log(), terminal)

    @contextlib.contextmanager
    def _front_end(
        self,
        viewer: Viewer,
        session: Session,
        server: PageServer | None,
        has_ar: bool,
        terminal: Terminal,
    ) -> Iterator[Callable[[SessionView], object]]:
        """Open a front end and yield the function that draws a view."""
        if viewer == "window":
            from robot_ik.testbed.frontends.session_window import SessionWindow

            with SessionWindow(session, ar=has_ar) as window:
                terminal.say("keys: " + window.help, "dim")
                yield window.draw
            return
        from robot_ik.testbed.filming import SceneCamera, film_in_process
        from robot_ik.testbed.frontends.browser import Page

        def open_camera() -> SceneCamera:
            return SceneCamera(session)

        page_server = server or self._open_server(terminal)
        with Page(session, page_server, camera=open_camera, film=film_in_process) as page:
            page.switch_ar(has_ar)
            yield page.draw


class ViewReport(Report):
    """The testbed was opened, and has ended."""

    streamed: ClassVar[bool] = True

    def tables(self) -> Iterable[Any]:
        """Return nothing: the front end has shown everything."""
        return ()

    def facts(self) -> dict[str, Any]:
        """Return no facts."""
        return {}


@dataclass(frozen=True, eq=False)
class ReplayReport(Report):
    """The end of a session without a viewer.

    Attributes:
        view: Its last view.
        log: Command log with which the end is compared, None to compare nothing.
        files: Files that were written.
    """

    view: SessionView
    log: CommandLog | None = None
    files: Sequence[Path] = ()

    @property
    def ok(self) -> bool:
        """Whether the end is not known to differ from that of the log."""
        return self.log is None or self.log.digest in ("", self.view.digest())

    @property
    def notes(self) -> Sequence[str]:
        """Return why a replay can differ."""
        if self.ok:
            return ()
        return ("the versions of robot_ik or numba, the processor or the log have changed",)

    def tables(self) -> Iterable[Any]:
        """Return the files, the robots at the end, and the comparison with the log."""
        view = self.view
        for file in self.files:
            yield f"{file}: {view.now:.1f} s of {view.robot}"
        if self.log is None:
            return
        rows = [
            (
                f"{view.robot} {number}",
                instance.method,
                instance.status,
                f"{1e3 * instance.error:.3f}",
                f"{100.0 * instance.statistics.solved:.0f} %",
            )
            for number, instance in enumerate(view.instances, start=1)
        ]
        yield table("robot", "solver", "status", "error mm", "solved", rows=rows)
        verdict = "the same bits" if self.ok else "other bits"
        if not self.log.digest:
            verdict = "the log has no digest to compare with"
        yield f"{len(self.log.commands)} commands, {view.tick} ticks: {verdict}"

    def facts(self) -> dict[str, Any]:
        """Return the robots at the end, and whether it is that of the log."""
        return {
            "robot": self.view.robot,
            "seconds": self.view.now,
            "digest": self.view.digest(),
            "same": self.ok if self.log is not None and self.log.digest else None,
            "instances": [
                {
                    "solver": instance.method,
                    "status": instance.status,
                    "error_m": instance.error,
                    "solved": instance.statistics.solved,
                }
                for instance in self.view.instances
            ],
        }


def choose_viewer(wanted: Viewer | None, terminal: Terminal) -> Viewer | None:
    """Return the front end to open, None if this machine has none.

    Args:
        wanted: Value of ``--viewer``.
        terminal: Shows why the browser is not opened.

    Raises:
        MissingExtraError: The browser is wanted and its extra is not installed.
    """
    has_page = all(map(find_spec, ("viser", "mjviser")))
    if wanted == "browser" and not has_page:
        raise MissingExtraError("viser", "web", "the page in the browser")
    if wanted is not None:
        return wanted
    if has_page:
        return "browser"
    from robot_ik.camera.drawing.probe import probe_display

    page = f"for the page in the browser: {install_command('web')}"
    if probe_display(timeout=DISPLAY_SECONDS).ok:
        terminal.say(f"MuJoCo's window opens; {page}", "yellow")
        return "window"
    terminal.say(f"there is no display, so {FALLBACK_VIDEO} is written; {page}", "yellow")
    return None


def parse_host(text: str) -> tuple[str, int]:
    """Return address and port of ``--host``.

    Args:
        text: ``ADDR``, ``ADDR:PORT``, ``[IPV6]:PORT``, or empty for the default.

    Raises:
        OptionError: The text has another form.
    """
    if not text:
        return DEFAULT_ADDRESS, DEFAULT_PORT
    address, colon, port = text.rpartition(":")
    if not colon or text.endswith("]") or (":" in address and not address.endswith("]")):
        address = text  # without a port: a name, or an IPv6 address
        port = str(DEFAULT_PORT)
    address = address.removeprefix("[").removesuffix("]")
    if not address or not port.isdecimal():
        raise OptionError("--host", f"cannot read {text!r}", "ADDR or ADDR:PORT")
    return address, int(port)


def run_until_end(
    session: Session, draw: Callable[[SessionView], object], seconds: float | None
) -> None:
    """Run a session until Ctrl-C, until its window is closed, or for a time in s."""
    from robot_ik.testbed.loop import run

    stop = threading.Event()
    timer = threading.Timer(seconds or threading.TIMEOUT_MAX, stop.set)
    timer.daemon = True
    timer.start()
    with contextlib.suppress(KeyboardInterrupt):
        run(session, draw, stop)
    timer.cancel()


@contextlib.contextmanager
def saying_what_is_kept(file: Path, terminal: Terminal) -> Iterator[None]:
    """Name the video that an interrupted block has written in part."""
    before = file.stat().st_mtime_ns if file.exists() else 0
    try:
        yield
    except BaseException:
        if file.exists() and file.stat().st_mtime_ns != before:
            terminal.say(f"kept until here: {file}", "yellow")
        raise
