"""``robot-ik``: finds the command in one table, imports only its module, turns errors into exit codes."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any

from robot_ik.errors import close_matches


@dataclass(frozen=True)
class Command:
    """One row of ``COMMANDS``.

    Attributes:
        module: Where it lives; imported when the command is used and not before.
        options: Name of its frozen dataclass of options.
        about: One line for ``robot-ik --help``.
        run: Name of its function ``run(options) -> exit code``.
        mujoco: It loads models, so a broken MuJoCo is told before anything else.
    """

    module: str
    options: str
    about: str
    run: str = "run"
    mujoco: bool = True


COMMANDS: dict[str, Command] = {
    "reach": Command(
        "robot_ik.cli.reach",
        "ReachOptions",
        "see a marker, reach it, and let a camera judge: the whole product",
    ),
    "solve": Command(
        "robot_ik.cli.solve_command", "SolveOptions", "a goal in, joint angles out (JSON on stdout)"
    ),
    "robots": Command(
        "robot_ik.cli.listing", "RobotsOptions", "the robots that come along, or one in detail", "run_robots"
    ),
    "solvers": Command(
        "robot_ik.cli.listing", "SolversOptions", "the methods and their options", "run_solvers"
    ),
    "experiments": Command(
        "robot_ik.cli.experiments",
        "ExperimentsOptions",
        "repeat the experiments of the theses: a00 or s12",
    ),
    "bench": Command(
        "robot_ik.cli.bench", "BenchOptions", "methods on seeded problems: success, time, plots"
    ),
    "run": Command(
        "robot_ik.cli.run", "RunOptions", "a scripted test run on simulated or real servos, faults included"
    ),
    "sim-bus": Command(
        "robot_ik.cli.sim_bus",
        "SimBusOptions",
        "serve simulated servos on a port that any client can open",
        mujoco=False,
    ),
    "servo": Command(
        "robot_ik.cli.servo",
        "ServoOptions",
        "servos by hand: find, set up, calibrate, watch, move, record, save",
        mujoco=False,
    ),
    "ar": Command(
        "robot_ik.cli.ar",
        "ArOptions",
        "the virtual robot in a camera's pictures, standing on a printed board",
    ),
    "camera": Command(
        "robot_ik.cli.camera",
        "CameraOptions",
        "the camera by hand: find, print markers, calibrate, detect, locate",
        mujoco=False,
    ),
    "doctor": Command(
        "robot_ik.cli.doctor",
        "DoctorOptions",
        "what this machine can do, and what to do about the rest",
        mujoco=False,
    ),
}

_VERSION_FLAGS = ("--version", "-V", "version")
_HELP_FLAGS = ("--help", "-h", "help")


class Terminated(BaseException):
    """SIGTERM arrived; raised in the main thread so that every ``with`` block closes its arm or port."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command line.

    Args:
        argv: Arguments without the program's name; ``None`` takes those of the process.

    Returns:
        The exit code: 0 done; 1 tried, not achieved; 2 wrong input or environment; 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = os.environ.get("ROBOT_IK_DEBUG", "") not in ("", "0")
    if "--debug" in arguments:
        arguments.remove("--debug")
        debug = True
    try:
        code = _dispatch(arguments, debug=debug)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader (head, less) went away: nothing to say, and nothing to say it to at exit either.
        _silence_stdout()
        return 128 + signal.SIGPIPE if hasattr(signal, "SIGPIPE") else 1
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else (0 if stop.code is None else 2)
    except (KeyboardInterrupt, Terminated) as stop:
        from robot_ik.cli import console

        interrupted = isinstance(stop, KeyboardInterrupt)
        console.say("interrupted" if interrupted else "terminated", "yellow")
        return console.INTERRUPTED if interrupted else console.TERMINATED
    except Exception as error:  # the last place where an error can become an exit code
        from robot_ik.cli import console

        console.show_error(error, debug=debug)
        return console.exit_code(error)


def _dispatch(arguments: list[str], *, debug: bool) -> int:
    if not arguments or arguments[0] in _HELP_FLAGS:
        if len(arguments) > 1 and arguments[1] in COMMANDS:  # robot-ik help solve
            return _run(arguments[1], ["--help"], debug=debug)
        _print_help()
        return 0 if arguments else 2
    name, rest = arguments[0], arguments[1:]
    if name in _VERSION_FLAGS:
        _print_versions()
        return 0
    if name in COMMANDS:
        return _run(name, rest, debug=debug)
    return _unknown(name)


def _run(name: str, arguments: list[str], *, debug: bool) -> int:
    import tyro

    from robot_ik.cli import console

    command = COMMANDS[name]
    asks_help = any(flag in arguments for flag in ("--help", "-h"))
    if command.mujoco and not asks_help and os.environ.get("MUJOCO_GL"):
        from robot_ik.environment import import_mujoco

        import_mujoco()  # with this variable the import itself can fail: say so before anything else does
    module = importlib.import_module(command.module)
    options: Any = tyro.cli(getattr(module, command.options), prog=f"robot-ik {name}", args=arguments)
    with console.logs_shown(debug=debug), _terminable():
        code: int = getattr(module, command.run)(options)
    return code


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Makes SIGTERM unwind the stack as Ctrl-C does, while inside."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _silence_stdout() -> None:
    with contextlib.suppress(OSError, ValueError):
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)


def _unknown(name: str) -> int:
    from robot_ik.cli import console
    from robot_ik.errors import unknown_name_text

    kind = "option" if name.startswith("-") else "command"
    if kind == "command":
        text = unknown_name_text(kind, name, list(COMMANDS))
    else:
        close = close_matches(name, ["--help", "--version", "--debug"])
        text = f"unknown option {name!r} before the command" + (
            f"; did you mean {close[0]!r}?" if close else ""
        )
    console.say(f"error: {text}", "bold red")
    console.say("see all commands with: robot-ik --help", "cyan")
    return console.WRONG_INPUT


def _print_help() -> None:
    from robot_ik.cli import console

    screen = console.out()
    screen.print("usage: robot-ik COMMAND [OPTIONS]        robot-ik COMMAND --help", markup=False)
    screen.print("\nFrom a robot model and a goal to joint angles, on simulated or real servos.\n")
    rows = console.table("command", "what it does")
    for name, command in COMMANDS.items():
        rows.add_row(name, command.about)
    screen.print(rows)
    others = console.table("option", "")
    others.add_row("--version", "versions of robot_ik and of what it stands on")
    others.add_row("--debug", "show tracebacks and the whole log (also: ROBOT_IK_DEBUG=1)")
    screen.print()
    screen.print(others)
    screen.print("\nStart with:  robot-ik reach", markup=False)
    screen.print("Exit codes:  0 done; 1 tried, not achieved; 2 wrong input or environment", markup=False)


def _print_versions() -> None:
    from robot_ik.cli import console
    from robot_ik.cli.checks import installed_versions

    rows = console.table("package", "version")
    for name, version in installed_versions().items():
        rows.add_row(name, version or "not installed")
    rows.add_row("python", sys.version.split()[0])
    console.out().print(rows)


if __name__ == "__main__":
    sys.exit(main())
