"""``robot-ik``: finds the command in one table, imports only its module, turns errors into exit codes."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

try:
    from robot_ik.cli import console
    from robot_ik.errors import OutputError, RobotIkError, close_matches, unknown_name_text
    from robot_ik.signals import raised_signals
except KeyboardInterrupt:  # most of the first half second is spent here
    sys.stderr.write("interrupted\n")
    raise SystemExit(130) from None

# ------------------------------------------------------------------------------------------
# The table of commands and of their subcommands: names, where each lives, one line about it.


@dataclass(frozen=True)
class CommandRow:
    """One row of ``COMMANDS``.

    Attributes:
        module: Where it lives; imported when the command is used and not before.
        options: Name of its frozen dataclass of options; empty: it has subcommands and nothing else.
        about: One line for ``robot-ik --help``.
        run: Name of its function ``run(options) -> exit code``.
        mujoco: It loads models, so a MuJoCo that cannot be loaded is reported before anything else.
        subcommands: Rows of the same kind, by the name that follows the command's name.
    """

    module: str
    options: str
    about: str
    run: str = "run"
    mujoco: bool = True
    subcommands: Mapping[str, CommandRow] = field(default_factory=dict)


# Name -> file of ``robot_ik/cli/`` and one line of help, in the order of ``robot-ik --help``.
ROWS: dict[str, tuple[str, str]] = {
    "view": ("view", "the interactive testbed, in the browser or in MuJoCo's window"),
    "reach": ("reach", "detect a marker, reach it, and verify the result with a camera"),
    "solve": ("solve", "a goal in, joint angles out (JSON on stdout)"),
    "reachability": ("reachability", "where an arm can reach: a map, slices and a point cloud"),
    "plan": ("plan", "a motion around obstacles, proven free"),
    "robots": ("listing", "the bundled robots, or one in detail"),
    "solvers": ("listing", "the methods and their options"),
    "experiments": ("experiments", "repeat the experiments of the theses: a00 or s12"),
    "bench": ("bench", "methods on seeded problems: success, time, plots"),
    "run": ("run", "a scripted test run on simulated or real servos, faults included"),
    "poses": ("", "key poses and motions: record, list, play, export, import"),
    "poses list": ("key_poses", "the poses and motions of a file"),
    "poses record": ("key_poses", "a pose into a file: from joints, from a recorded frame, by reaching"),
    "poses play": ("key_poses", "a motion in MuJoCo's window"),
    "poses export": ("key_poses", "a motion as frames: CSV or BVH"),
    "poses import": ("key_poses", "motion capture (BVH) onto a figure"),
    "sim-bus": ("sim_bus", "serve simulated servos on a port that any client can open"),
    "servo": ("", "servos by hand: find, set up, calibrate, watch, move, record, save"),
    "servo ports": ("servo_bus", "serial ports, the adapter behind each, who uses it"),
    "servo scan": ("servo_bus", "which servos answer, at every rate; doubled ids"),
    "servo setup": ("servo_bus", "id and baud rate of the one servo connected"),
    "servo calibrate": ("servo_hand", "ranges, zeros and directions by hand"),
    "servo monitor": ("servo_bus", "position, current, supply, heat, errors, live"),
    "servo move": ("servo_motion", "joints to angles, slowly, within limits"),
    "servo torque": ("servo_motion", "on: hold where it stands; off: let go"),
    "servo reset-fault": ("servo_motion", "restart servos that have shut down"),
    "servo teach": ("servo_hand", "record the arm while a hand guides it"),
    "servo play": ("servo_hand", "repeat a recording within the limits"),
    "servo backup": ("servo_bus", "save the control tables as JSON"),
    "servo restore": ("servo_bus", "put the EEPROM back as a backup has it"),
    "teleop": ("teleop", "lead an arm by another one, or by the keys of this terminal"),
    "stop": ("servo_motion", "make an arm that another program drives stop and hold"),
    "ar": ("ar", "the virtual robot in a camera's pictures, on a printed board"),
    "figure": ("figure", "a humanoid sees a ball and reaches, bends, jumps or walks"),
    "camera": ("", "the camera by hand: find, print markers, calibrate, detect, locate"),
    "camera list": ("camera", "cameras of this machine: index, name, who uses them"),
    "camera print": ("camera", "a sheet of markers, a board, a cube or a pattern to print"),
    "camera calibrate": ("camera", "lens and focal length from views of a printed pattern"),
    "camera detect": ("camera", "markers in pictures: ids, corners, poses"),
    "camera locate": ("camera", "where the camera stands, from a board whose pose is known"),
    "camera handeye": ("arm_camera", "where the camera is mounted, by moving the arm"),
    "camera verify": ("arm_camera", "how far the arm is from where its joints say"),
    "video": ("view", "a film of the testbed without a screen, from its command log"),
    "doctor": ("listing", "what this machine can do, and what to do about the rest"),
}  # fmt: skip
# They run, or say what is wrong, on a machine whose MuJoCo cannot be loaded; but these of them do not.
_WITHOUT_MUJOCO = ("robots", "sim-bus", "servo", "stop", "camera", "doctor")
_WITH_MUJOCO = ("camera handeye", "camera verify")


def _row(name: str, file: str, about: str) -> CommandRow:
    """``servo reset-fault`` of ``servo_motion.py`` is ``run_reset_fault(options: ServoResetFaultOptions)``.

    A file that has the command's name has one command, whose function is ``run``.
    """
    parts = name.replace("-", " ").split()
    own = file == "_".join(parts)
    return CommandRow(
        f"robot_ik.cli.{file}" if file else "",
        "".join(part.title() for part in parts) + "Options" if file else "",
        about,
        "run" if own else "run_" + name.split()[-1].replace("-", "_"),
        name in _WITH_MUJOCO or name.split()[0] not in _WITHOUT_MUJOCO,
        {inner.split()[1]: _row(inner, *row) for inner, row in ROWS.items() if inner.startswith(f"{name} ")},
    )


COMMANDS = {name: _row(name, *row) for name, row in ROWS.items() if " " not in name}


def find_command(arguments: Sequence[str]) -> tuple[str, CommandRow, list[str]]:
    """The row that a command line means, as deep as its arguments lead.

    Returns:
        Its name ("servo scan"), its row, and the arguments that are left for it.

    Raises:
        KeyError: The first argument is no name of ``COMMANDS``.
    """
    name, command, rest = arguments[0], COMMANDS[arguments[0]], list(arguments[1:])
    while rest and rest[0] in command.subcommands:
        name, command = f"{name} {rest[0]}", command.subcommands[rest[0]]
        del rest[0]
    return name, command, rest


_VERSION_FLAGS = ("--version", "-V", "version")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command line (of the process if ``None``) and returns its exit code, see ``console``."""
    # Before a command imports NumPy: its matrices are small, OpenBLAS's threads would wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = os.environ.get("ROBOT_IK_DEBUG", "") not in ("", "0")
    if "--debug" in arguments:
        arguments.remove("--debug")
        debug = True
    try:
        if not console.prepare_streams():
            raise OutputError("standard output is closed, so results have nowhere to go")
        code = _dispatch(arguments, debug=debug)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader (head, less) went away: nothing to say, and nothing to say it to at exit either.
        _silence_stdout()
        return 128 + signal.SIGPIPE if hasattr(signal, "SIGPIPE") else 1
    except SystemExit as stop:
        if stop.code == console.TERMINATED:
            console.say("terminated", "yellow")
        return stop.code if isinstance(stop.code, int) else (0 if stop.code is None else 2)
    except KeyboardInterrupt:
        console.say("interrupted", "yellow")
        return console.INTERRUPTED
    except Exception as error:  # the last place where an error can become an exit code
        if _was_interrupted(error):
            console.say("interrupted", "yellow")
            return console.INTERRUPTED
        return console.show_error(error, debug=debug)


def _was_interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C came while a package was loaded: pybind11 makes an ``ImportError`` of it."""
    while error is not None:
        if isinstance(error, ImportError) and isinstance(error.__cause__, KeyboardInterrupt):
            return True
        error = error.__cause__
    return False


def _dispatch(arguments: list[str], *, debug: bool) -> int:
    if arguments and arguments[0] == "help":  # robot-ik help servo scan
        arguments = [*arguments[1:], "--help"]
    if not arguments or arguments[0] in console.HELP_FLAGS:
        _print_help()
        return 0 if arguments else 2
    if arguments[0] in _VERSION_FLAGS:
        _print_versions()
        return 0
    if arguments[0] not in COMMANDS:
        raise _unknown(arguments[0])
    name, command, rest = find_command(arguments)
    misspelt = command.subcommands and rest and not rest[0].startswith("-")
    if command.options and not misspelt:
        return _run(name, command, rest, debug=debug)
    return _group(name, command, rest)


def _group(name: str, command: CommandRow, rest: list[str]) -> int:
    """A command that is only the name of its subcommands: its help, or which of them was meant."""
    if any(argument in console.HELP_FLAGS for argument in rest):
        _print_group(name, command)
        return 0
    what = f"subcommand of {name}"
    inner = next((argument for argument in rest if argument in command.subcommands), None)
    if not rest:
        text = f"which {what}? There are: {', '.join(command.subcommands)}."
    elif inner:
        text = f"options stand behind the subcommand: robot-ik {name} {inner} {rest[0]} …"
    else:
        asked = next((argument for argument in rest if not argument.startswith("-")), rest[0])
        text = unknown_name_text(what, asked, list(command.subcommands))
    raise RobotIkError(text, hint=f"see all commands with: robot-ik {name} --help")


def _run(name: str, command: CommandRow, arguments: list[str], *, debug: bool) -> int:
    from robot_ik.cli.arguments import parse
    from robot_ik.jobs.environment import import_mujoco

    module = importlib.import_module(command.module)
    options: Any = parse(getattr(module, command.options), f"robot-ik {name}", arguments)
    if command.mujoco:
        import_mujoco()
    with console.logs_shown(debug=debug), raised_signals(signal.SIGTERM):
        code: int = getattr(module, command.run)(options)
    return code


def _silence_stdout() -> None:
    with contextlib.suppress(OSError, ValueError):
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)


def _unknown(name: str) -> RobotIkError:
    if not name.startswith("-"):
        text = unknown_name_text("command", name, list(COMMANDS))
    else:
        close = close_matches(name, ["--help", "--version", "--debug"])
        meant = f"; did you mean {close[0]!r}?" if close else ""
        text = f"unknown option {name!r} before the command{meant}"
    return RobotIkError(text, hint="see all commands with: robot-ik --help")


def _print_group(name: str, command: CommandRow) -> None:
    rows = [(subcommand, row.about) for subcommand, row in command.subcommands.items()]
    console.show(
        f"usage: robot-ik {name} SUBCOMMAND [OPTIONS]",
        f"\n{command.about[0].upper()}{command.about[1:]}.\n",
        console.table("subcommand", "what it does", rows=rows),
        f"\nEach explains itself:  robot-ik {name} {rows[0][0]} --help",
    )


def _print_help() -> None:
    rows = [(name, command.about) for name, command in COMMANDS.items()]
    console.show(
        "usage: robot-ik COMMAND [OPTIONS]        robot-ik COMMAND --help",
        "Inverse kinematics for robot arms in Python, from camera to servo.\n",
        console.table("command", "what it does", rows=rows),
        console.facts(
            ("--version", "versions of robot_ik and of what it stands on"),
            ("--debug", "show tracebacks and the whole log (also: ROBOT_IK_DEBUG=1)"),
        ),
        "Start with:  robot-ik reach, or robot-ik view",
        "Exit codes:  0 done; 1 not achieved; 2 wrong input or environment; 130 Ctrl-C",
    )


def _print_versions() -> None:
    from robot_ik.jobs.environment import installed_versions

    rows = [(name, version or "not installed") for name, version in installed_versions().items()]
    console.show(console.table("package", "version", rows=[*rows, ("python", sys.version.split()[0])]))


if __name__ == "__main__":
    sys.exit(main())
