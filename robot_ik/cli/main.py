"""Former commands of ``robot-ik``: finds the command in one table and imports only its module.

``robot_ik/commands/main.py`` calls ``dispatch`` for the commands that its own table does not have yet.
"""

from __future__ import annotations

import importlib
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from robot_ik.cli import console
from robot_ik.signals import raised_signals

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
    "poses": ("", "key poses and motions: record, list, play, export, import"),
    "poses list": ("key_poses", "the poses and motions of a file"),
    "poses record": ("key_poses", "a pose into a file: from joints, from a recorded frame, by reaching"),
    "poses play": ("key_poses", "a motion in MuJoCo's window"),
    "poses export": ("key_poses", "a motion as frames: CSV or BVH"),
    "poses import": ("key_poses", "motion capture (BVH) onto a figure"),
    "servo": ("", "servos by hand: find, set up, calibrate, watch, move, record, save"),
    "video": ("view", "a film of the testbed without a screen, from its command log"),
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
        {
            inner.split()[1]: _row(inner, *row)
            for inner, row in ROWS.items()
            if inner.startswith(f"{name} ")
        },
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


def dispatch(arguments: list[str], *, debug: bool) -> int:
    """Runs one command line that begins with a name of ``COMMANDS``, and returns its exit code."""
    name, command, rest = find_command(arguments)
    return _run(name, command, rest, debug=debug)


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
