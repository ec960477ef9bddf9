"""``robot-ik``: find the command in a table, import only its module, turn errors into exit codes.

Exit codes: 0 done; 1 tried and not achieved; 2 wrong input or environment; 130 interrupted
(Ctrl-C); 143 terminated (SIGTERM).
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

try:
    from cyclopts import App, CycloptsError, Group, Parameter

    from robot_ik.commands.options import OUTPUT, FolderOption
    from robot_ik.commands.streams import open_console, prepare_streams, silence_output
    from robot_ik.commands.tables import table
    from robot_ik.commands.terminal import Report, Terminal, say, show_error, show_logs
    from robot_ik.commands.usage import (
        command_app,
        explain,
        option_owners,
        prepare_command,
        refuse_empty,
    )
    from robot_ik.errors import NOT_ACHIEVED_ERRORS, OutputError
except KeyboardInterrupt:  # a command that prints help spends most of its time here
    sys.stderr.write("interrupted\n")
    raise SystemExit(130) from None

DONE = 0
NOT_ACHIEVED = 1
WRONG_INPUT = 2
INTERRUPTED = 130
TERMINATED = 143
"""Exit codes."""

HELP_WIDTH = 100
"""Columns of help texts on wide terminals. Longer lines are hard to read."""

EPILOGUE = """--debug shows tracebacks and the whole log (also: ROBOT_IK_DEBUG=1).

Exit codes: 0 done; 1 not achieved; 2 wrong input; 130 Ctrl-C"""

AMBIGUOUS_ALIASES = {
    "calibrate": "robot-ik servo calibrate runs; for a camera: robot-ik camera calibrate"
}
"""Alias that may mean two commands -> first line on stderr, which names both."""

HELP_FLAGS = frozenset(("--help", "-h"))
VERSION_FLAGS = ("--version", "-V")


@dataclass(frozen=True)
class Row:
    """One command of the table.

    Attributes:
        name: One or two words: ``reach``, ``servo scan``.
        help: One line for ``robot-ik --help``.
        target: Module and class. The module is imported when the command is used.
        aliases: Full names that users of LeRobot, ROS or MuJoCo expect. They work, and the help
            does not list them.
        mujoco: The command loads models. If MuJoCo cannot be imported, that is reported first.
    """

    name: str
    help: str
    target: str
    aliases: tuple[str, ...] = ()
    mujoco: bool = True


GROUPS: dict[str, tuple[Row, ...]] = {
    "Solve and move": (
        Row("solve", "Find joint angles for a goal.", "solve:Solve"),
        Row(
            "reach",
            "Detect a marker, reach it, and verify the result with a camera.",
            "reach:Reach",
        ),
        Row("plan", "Plan a motion around obstacles and prove it free.", "plan:Plan"),
        Row(
            "reachability",
            "Map where an arm can reach: slices and a point cloud.",
            "reachability:Reachability",
        ),
        Row("run", "Run a scripted test on simulated or real servos, faults included.", "run:Run"),
        Row(
            "view",
            "Open the interactive testbed, or film it without a screen.",
            "view:View",
        ),
    ),
    "Servos": (
        Row(
            "servo ports",
            "List serial ports, their adapters and the programs that use them.",
            "servo_ports:ServoPorts",
            aliases=("find-port",),
            mujoco=False,
        ),
        Row(
            "servo scan",
            "List the servos on a bus, at every baud rate.",
            "servo_scan:ServoScan",
            mujoco=False,
        ),
        Row(
            "servo setup",
            "Set the id and baud rate of the only connected servo.",
            "servo_setup:ServoSetup",
            aliases=("setup-motors",),
            mujoco=False,
        ),
        Row(
            "servo calibrate",
            "Measure ranges, zeros and directions by hand.",
            "servo_calibrate:ServoCalibrate",
            aliases=("calibrate",),
            mujoco=False,
        ),
        Row(
            "servo monitor",
            "Watch position, current, supply, heat and errors.",
            "servo_monitor:ServoMonitor",
            mujoco=False,
        ),
        Row(
            "servo move",
            "Move joints to angles, slowly and within limits.",
            "servo_move:ServoMove",
            mujoco=False,
        ),
        Row(
            "servo torque",
            "Switch torque on (hold the pose) or off (release).",
            "servo_torque:ServoTorque",
            mujoco=False,
        ),
        Row(
            "servo reset-fault",
            "Restart servos that have shut down.",
            "servo_reset_fault:ServoResetFault",
            mujoco=False,
        ),
        Row(
            "servo record",
            "Record the arm while a person guides it by hand.",
            "servo_record:ServoRecord",
            aliases=("record",),
            mujoco=False,
        ),
        Row(
            "servo replay",
            "Repeat a recording within the limits.",
            "servo_replay:ServoReplay",
            aliases=("replay",),
            mujoco=False,
        ),
        Row(
            "teleop",
            "Lead an arm by another arm, a gamepad or the keys of this terminal.",
            "teleop:Teleop",
            aliases=("teleoperate",),
            mujoco=False,
        ),
        Row(
            "stop",
            "Make an arm that another program drives stop and hold.",
            "stop:Stop",
            mujoco=False,
        ),
        Row(
            "sim-bus",
            "Serve simulated servos on a port that any client can open.",
            "sim_bus:SimBus",
            mujoco=False,
        ),
    ),
    "Camera": (
        Row(
            "camera list",
            "List the cameras of this machine and the programs that use them.",
            "camera_list:CameraList",
            mujoco=False,
        ),
        Row(
            "camera print",
            "Make a sheet of markers, a board, a cube or a pattern to print.",
            "camera_print:CameraPrint",
            mujoco=False,
        ),
        Row(
            "camera calibrate",
            "Measure lens and focal length from views of a pattern.",
            "camera_calibrate:CameraCalibrate",
            mujoco=False,
        ),
        Row(
            "camera detect",
            "Detect markers in pictures: ids, corners, poses.",
            "camera_detect:CameraDetect",
            mujoco=False,
        ),
        Row(
            "camera locate",
            "Measure the pose of the camera from a board of known pose.",
            "camera_locate:CameraLocate",
            mujoco=False,
        ),
        Row(
            "camera handeye",
            "Measure where the camera is mounted, by moving the arm.",
            "camera_handeye:CameraHandeye",
        ),
        Row(
            "camera verify",
            "Measure how far the arm is from where its joints say.",
            "camera_verify:CameraVerify",
        ),
        Row("ar", "Draw the robot into the pictures of a camera, on a printed board.", "ar:Ar"),
    ),
    "Figure": (
        Row("figure", "Let a humanoid see a ball and reach, bend, jump or walk.", "figure:Figure"),
    ),
    "Information": (
        Row("robots", "List the bundled robots, or describe one.", "robots:Robots", mujoco=False),
        Row("solvers", "List the solvers, or the options of one.", "solvers:Solvers"),
        Row(
            "bench",
            "Compare the solvers, or repeat the experiments of the theses.",
            "bench:Bench",
        ),
        Row(
            "doctor",
            "Check what this machine can do, and what to do about the rest.",
            "doctor:Doctor",
            mujoco=False,
        ),
        Row(
            "completion",
            "Print the completion script of a shell.",
            "completion:Completion",
            mujoco=False,
        ),
    ),
}
"""All commands, in the order of ``robot-ik --help``."""

GROUP_HELP = {
    "servo": "Find, set up, calibrate, watch and move servos.",
    "camera": "Find and calibrate cameras, print and detect markers.",
}
"""Help of the first word of commands with two words."""


def make_app() -> App:
    """Return the parser of all commands. No command module is imported."""
    app = App(
        name="robot-ik",
        help="Inverse kinematics for robot arms in Python, from camera to servo.",
        help_epilogue=EPILOGUE,
        help_format="plaintext",
        help_formatter=HelpFormatter(),
        version_flags=VERSION_FLAGS,
        group_commands=Group("Other", sort_key=99),
        group_parameters=Group("Options", sort_key=1),
        default_parameter=Parameter(negative=(), allow_repeating=False, show_default=_default_text),
        console=open_console(sys.stdout, max_width=HELP_WIDTH),
        print_error=False,
        exit_on_error=False,
    )
    groups: dict[str, App] = {}
    for order, (title, rows) in enumerate(GROUPS.items()):
        panel = Group(title, sort_key=order)
        for index, row in enumerate(rows):
            for name in (row.name, *row.aliases):
                first, _, second = name.partition(" ")
                if second and first not in groups:
                    groups[first] = App(
                        name=first,
                        help=GROUP_HELP[first],
                        group=panel,
                        group_commands=Group("Commands", sort_key=0),
                        sort_key=index,
                    )
                    app.command(groups[first])
                parent = groups[first] if second else app
                parent.command(
                    f"robot_ik.commands.{row.target}",
                    name=second or first,
                    help=row.help,
                    group=None if second else panel,
                    sort_key=index,
                    show=name == row.name,
                )
    return app


def command_names() -> list[str]:
    """Return the names and aliases of all commands."""
    return [name for rows in GROUPS.values() for row in rows for name in (row.name, *row.aliases)]


def completion_script(shell: Literal["bash", "zsh", "fish"]) -> str:
    """Return the script that completes commands and options in a shell. All are imported."""
    app = make_app()
    for rows in GROUPS.values():
        for row in rows:
            prepare_command(command_app(app, row.name))
    return app.generate_completion(shell=shell)


class HelpFormatter:
    """Prints a help as cyclopts does. Descriptions of several lines become one paragraph."""

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        for entry in panel.entries:
            text = getattr(entry.description, "primary_renderable", None)
            if text is not None:
                entry.description.primary_renderable = type(text)(" ".join(str(text).split()))
        self._default()(console, options, panel)

    def render_usage(self, console: Any, options: Any, usage: Any) -> None:
        """Print the line with the usage."""
        self._default().render_usage(console, options, usage)

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        """Print the text above the panels."""
        self._default().render_description(console, options, description)

    def _default(self) -> Any:
        from cyclopts.help import DefaultFormatter  # imports rich

        return DefaultFormatter()


def _default_text(value: object) -> str | None:
    """Return the default for the help; none for values that mean "not given"."""
    if value in ("", (), None, False):
        return None
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (``sys.argv`` by default) and return its exit code."""
    # NumPy reads this at its import. Small matrices lose time in OpenBLAS threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = os.environ.get("ROBOT_IK_DEBUG", "") not in ("", "0")
    if "--debug" in arguments:
        arguments.remove("--debug")
        debug = True
    try:
        if not prepare_streams():
            raise OutputError("standard output is closed, so results have nowhere to go")
        code = run_command(arguments, debug=debug)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader (head, less) has closed the pipe
        silence_output()
        return 128 + signal.SIGPIPE if hasattr(signal, "SIGPIPE") else NOT_ACHIEVED
    except KeyboardInterrupt:
        say("interrupted", "yellow")
        return INTERRUPTED
    except SystemExit as stop:
        if stop.code == TERMINATED:
            say("terminated", "yellow")
        return stop.code if isinstance(stop.code, int) else (0 if stop.code is None else 2)
    except Exception as error:
        if _was_interrupted(error):
            say("interrupted", "yellow")
            return INTERRUPTED
        show_error(error, debug=debug)
        return exit_code_of(error)


def exit_code_of(error: Exception) -> int:
    """Return the exit code of a run that an error has ended."""
    return NOT_ACHIEVED if isinstance(error, NOT_ACHIEVED_ERRORS) else WRONG_INPUT


def run_command(arguments: Sequence[str], *, debug: bool = False) -> int:
    """Parse the arguments, run the command, and print its report."""
    words = list(arguments)
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if words[:1] == ["version"] or words[:1] in ([flag] for flag in VERSION_FLAGS):
        print_versions()
        return DONE
    refuse_empty(words)
    name, command = parse_command(words)
    if command is None:  # help was printed
        return DONE if HELP_FLAGS.intersection(words) else WRONG_INPUT
    if name in AMBIGUOUS_ALIASES:
        say(AMBIGUOUS_ALIASES[name], "yellow")
    return _run(command, name, debug=debug)


def parse_command(words: Sequence[str]) -> tuple[str, Any]:
    """Return the name of a command and the command itself, None after help was printed.

    Raises:
        OptionError: The command line is wrong.
    """
    app = make_app()
    try:
        chain, apps, _ = app.parse_commands(words)
        for part in apps:
            if isinstance(part.default_command, type):
                prepare_command(part)
        target, bound, _ = app.parse_args(words or ["--help"])
    except CycloptsError as error:
        names = command_names()
        owners = [row.name for rows in GROUPS.values() for row in rows]
        raise explain(error, names, lambda: option_owners(app, owners)) from error
    result = target(*bound.args, **bound.kwargs)
    return " ".join(chain), result if hasattr(result, "run") else None


def print_versions() -> None:
    """Print the versions of robot_ik and of its dependencies."""
    from robot_ik.commands.environment import installed_versions  # reads the metadata of packages

    versions = {**installed_versions(), "python": sys.version.split()[0]}
    rows = [(name, version or "not installed") for name, version in versions.items()]
    open_console(sys.stdout).print(table("package", "version", rows=rows))


def _run(command: Any, name: str, *, debug: bool) -> int:
    from robot_ik.signals import raised_signals  # ctypes: not for --help

    terminal = Terminal(json=getattr(command, "json", False), debug=debug)
    with contextlib.ExitStack() as stack:
        stack.enter_context(show_logs(debug=debug))
        stack.enter_context(raised_signals(signal.SIGTERM))
        _import_mujoco_for(command)
        stack.enter_context(reserved_outputs(command, name, terminal))
        stack.enter_context(terminal.running(name))
        report: Report = command.run(terminal)
        terminal.show(report)
    return report.exit_code


def _import_mujoco_for(command: Any) -> None:
    """Import MuJoCo if the command loads models, so that its error says what is wrong."""
    target = f"{type(command).__module__.rpartition('.')[2]}:{type(command).__name__}"
    if any(row.mujoco for rows in GROUPS.values() for row in rows if row.target == target):
        from robot_ik.commands.environment import import_mujoco

        import_mujoco()


@contextlib.contextmanager
def reserved_outputs(command: Any, name: str, terminal: Terminal) -> Iterator[None]:
    """Reserve the files and the folder of a command before anything moves.

    Raises:
        OutputError: A file exists and ``--overwrite`` is not given, or it cannot be written.
    """
    from robot_ik.workcell.results import claimed, results_folder

    overwrite = getattr(command, "overwrite", False)
    with contextlib.ExitStack() as stack:
        if isinstance(command, FolderOption):
            job = name.replace(" ", "-")
            folder = results_folder(command.out or "", job, command.FILES, overwrite=overwrite)
            terminal.folder = stack.enter_context(folder)
        stack.enter_context(claimed(*output_files(command), overwrite=overwrite))
        yield


def output_files(command: Any) -> list[Path]:
    """Return the files that a command line names and that the command will write.

    A command whose files depend on several options returns them from ``written_files``.
    """
    if hasattr(command, "written_files"):
        return list(command.written_files())
    hints = get_type_hints(type(command), include_extras=True)
    marked = [
        item.name
        for item in fields(command)
        if OUTPUT in getattr(hints[item.name], "__metadata__", ())
    ]
    return [path for name in marked if (path := getattr(command, name)) is not None]


def _was_interrupted(error: BaseException | None) -> bool:
    """Return whether Ctrl-C interrupted an import: pybind11 turns it into an ``ImportError``."""
    while error is not None:
        if isinstance(error, ImportError) and isinstance(error.__cause__, KeyboardInterrupt):
            return True
        error = error.__cause__
    return False


if __name__ == "__main__":
    sys.exit(main())
