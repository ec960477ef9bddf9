"""``robot-ik``: finds the command in one table, imports only its module, turns errors into exit codes."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Any

from robot_ik.cli.commands import COMMANDS, Command, find_command
from robot_ik.cli.streams import prepare_streams
from robot_ik.errors import OutputError, close_matches, unknown_name_text

_VERSION_FLAGS = ("--version", "-V", "version")
_HELP_FLAGS = ("--help", "-h")


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
        if not prepare_streams():
            raise OutputError("standard output is closed, so results have nowhere to go")
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
    if arguments and arguments[0] == "help":  # robot-ik help servo scan
        arguments = [*arguments[1:], "--help"]
    if not arguments or arguments[0] in _HELP_FLAGS:
        _print_help()
        return 0 if arguments else 2
    if arguments[0] in _VERSION_FLAGS:
        _print_versions()
        return 0
    if arguments[0] not in COMMANDS:
        return _unknown(arguments[0])
    name, command, rest = find_command(arguments)
    if command.options and not _meant_as_subcommand(command, rest):
        return _run(name, command, rest, debug=debug)
    return _group(name, command, rest)


def _meant_as_subcommand(command: Command, rest: list[str]) -> bool:
    return bool(command.subcommands and rest and not rest[0].startswith("-"))


def _group(name: str, command: Command, rest: list[str]) -> int:
    """A command that is only the name of its subcommands: its help, or which of them was meant."""
    if any(word in _HELP_FLAGS for word in rest):
        _print_group(name, command)
        return 0
    told = f"subcommand of {name}"
    word = next((word for word in rest if not word.startswith("-")), "") if rest else ""
    inner = next((word for word in rest if word in command.subcommands), None)
    if not rest:
        text = f"which {told}? There are: {', '.join(command.subcommands)}."
    elif inner:
        text = f"options stand behind the subcommand: robot-ik {name} {inner} {rest[0]} …"
    else:
        text = unknown_name_text(told, word or rest[0], list(command.subcommands))
    return _tell_wrong(text, f"robot-ik {name} --help")


def _run(name: str, command: Command, arguments: list[str], *, debug: bool) -> int:
    from robot_ik.cli import console
    from robot_ik.cli.arguments import parse

    asks_help = any(flag in arguments for flag in _HELP_FLAGS)
    if command.mujoco and not asks_help and os.environ.get("MUJOCO_GL"):
        from robot_ik.environment import import_mujoco

        import_mujoco()  # with this variable the import itself can fail: say so before anything else does
    module = importlib.import_module(command.module)
    options: Any = parse(getattr(module, command.options), f"robot-ik {name}", arguments)
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
    if not name.startswith("-"):
        text = unknown_name_text("command", name, list(COMMANDS))
    else:
        close = close_matches(name, ["--help", "--version", "--debug"])
        text = f"unknown option {name!r} before the command" + (
            f"; did you mean {close[0]!r}?" if close else ""
        )
    return _tell_wrong(text, "robot-ik --help")


def _tell_wrong(text: str, see: str) -> int:
    from robot_ik.cli import console

    console.say(f"error: {text}", "bold red")
    console.say(f"see all commands with: {see}", "cyan")
    return console.WRONG_INPUT


def _print_group(name: str, command: Command) -> None:
    from robot_ik.cli import console

    screen = console.out()
    screen.print(f"usage: robot-ik {name} SUBCOMMAND [OPTIONS]", markup=False)
    screen.print(f"\n{command.about[0].upper()}{command.about[1:]}.\n", markup=False)
    rows = console.table("subcommand", "what it does")
    for word, row in command.subcommands.items():
        rows.add_row(word, row.about)
    screen.print(rows)
    first = next(iter(command.subcommands))
    screen.print(f"\nEach explains itself:  robot-ik {name} {first} --help", markup=False)


def _print_help() -> None:
    from robot_ik.cli import console

    screen = console.out()
    screen.print("usage: robot-ik COMMAND [OPTIONS]        robot-ik COMMAND --help", markup=False)
    screen.print("\nFrom a robot model and a goal to joint angles, on simulated or real servos.\n")
    rows = console.table("command", "what it does")
    for name, command in COMMANDS.items():
        rows.add_row(name, command.about)
    screen.print(rows)
    others = console.table("", "")
    others.show_header = False
    others.add_row("--version", "versions of robot_ik and of what it stands on")
    others.add_row("--debug", "show tracebacks and the whole log (also: ROBOT_IK_DEBUG=1)")
    screen.print(others)
    screen.print("Start with:  robot-ik reach, or robot-ik view", markup=False)
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
