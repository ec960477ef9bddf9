"""Messages for wrong command lines: what was given, what is allowed, what to try.

The parser raises errors with the option, the value and the expected type as attributes. This
module turns each kind of error into one sentence. It never reads the parser's text.
"""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, get_args

from cyclopts import UNSET, App, CycloptsError, exceptions
from cyclopts.validators import Number

from robot_ik.errors import OptionError, RobotIkError, close_matches

PROGRAM = "robot-ik"
"""Name of the program."""

OTHER_OPTIONS = {
    "--method": "--solver",
    "--model": "--robot",
    "--view": "--viewer",
    "--gui": "--viewer",
    "--film": "--video",
    "--csv": "--record",
    "--port": "--bus",
    "--device": "--bus",
    "--fps": "--rate",
    "--output": "--out",
    "--output-dir": "--out",
    "--force": "--overwrite",
    "--camera-extrinsics": "--extrinsics",
    "--camera-pose": "--extrinsics",
    "--rehearse": "--fault",
    "--by": "--relative",
}
"""Option of other programs or of former versions -> option here."""

OTHER_COMMANDS = {
    "ik": "solve",
    "info": "doctor",
    "find-cameras": "camera list",
    "viz": "view",
    "experiments": "bench",
    "video": "view",
}
"""Command of other programs -> command here. Exact synonyms are aliases of a row instead."""

_KINDS = {float: "a number", int: "a whole number", str: "a word"}
"""Description of each type of value."""


def prepare_command(app: App) -> None:
    """Complete the parser of a command after its class is imported.

    The row of the table has one line of help for the list. The docstring is the help of the
    command. A field that is not ``kw_only`` becomes an argument without an option name.
    """
    command: Any = app.default_command
    app.help = inspect.cleandoc(command.__doc__ or "")
    app.help_epilogue = ""
    signature = inspect.signature(command)
    parameters = [
        parameter.replace(kind=inspect.Parameter.POSITIONAL_ONLY)
        if parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
        else parameter
        for parameter in signature.parameters.values()
    ]
    command.__signature__ = signature.replace(parameters=parameters)


def command_app(app: App, name: str) -> App:
    """Return the parser of a command by its name. Its module is imported."""
    for word in name.split():
        app = app[word]
    return app


def explain(
    error: CycloptsError, names: Sequence[str], owners: Callable[[], Mapping[str, list[str]]]
) -> RobotIkError:
    """Return the error to show for a wrong command line.

    Args:
        error: What the parser found.
        names: All commands: ``reach``, ``servo scan``.
        owners: Returns option -> commands that have it, as ``option_owners``.
    """
    command = " ".join((PROGRAM, *(error.command_chain or ())))
    hint = f"all options: {command} --help"
    match error:
        case exceptions.UnknownCommandError():
            return _unknown_command(error, names)
        case exceptions.UnknownOptionError():
            return _unknown_option(error, owners, hint)
        case exceptions.UnusedCliTokensError():
            words = shlex.join(error.unused_tokens or ())
            return OptionError("", f"unexpected argument {words}", hint=hint)
        case exceptions.RepeatArgumentError():
            return OptionError(error.token.keyword or "", "given twice", "once", hint=hint)
        case exceptions.ValidationError():
            return _out_of_range(error, hint)
        case exceptions.CoercionError():
            return _wrong_type(error, hint)
        case exceptions.MissingArgumentError():
            given = "a value is missing" if error.keyword else "this argument is required"
            return OptionError(_name(error.argument), given, _form(error.argument), hint=hint)
        case _:
            return OptionError("", " ".join(str(error).split()), hint=hint)


def refuse_empty(arguments: Sequence[str]) -> None:
    """Refuse an empty argument, which a shell makes of a variable that is not set.

    ``--bus "$PORT"`` would otherwise mean the default: real servos at the only port.

    Raises:
        OptionError: An argument or the value behind ``=`` is empty.
    """
    previous = ""
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if not argument.strip():
            raise OptionError(previous if previous.startswith("-") else "", "the value is empty")
        if name.startswith("--") and equals and not value.strip():
            raise OptionError(name, "the value is empty")
        previous = argument


def _unknown_command(error: Any, names: Sequence[str]) -> OptionError:
    """Look for the name in the group, then among the commands of all groups."""
    group = " ".join(error.command_chain or ())
    prefix = f"{group} " if group else ""
    name = (error.unused_tokens or [""])[0]
    hint = f"all commands: {PROGRAM} {prefix}--help"
    inside = [command for command in names if command.startswith(prefix)]
    siblings = list(dict.fromkeys(item.removeprefix(prefix).split()[0] for item in inside))
    if name.startswith("-"):
        if group:
            given = [word for word in error.unused_tokens or () if word in siblings]
            example = f"{PROGRAM} {prefix}{(given or siblings)[0]} {name} …"
            return OptionError(name, f"options follow the command: {example}", hint=hint)
        close = close_matches(name, ("--help", "--version", "--debug"), 1)
        return OptionError("", f"unknown option {name}{_meant(close)}", hint=hint)
    close = [prefix + item for item in close_matches(name, siblings)]
    plain_name = name.lower().replace("_", "-")
    if plain_name in siblings:
        close = [prefix + plain_name]
    elif name in OTHER_COMMANDS:
        close = [OTHER_COMMANDS[name]]
    elif exact := _ending_with(name, names):
        close = exact
    elif not close:
        leaves = {command.split()[-1] for command in names}
        close = [path for leaf in close_matches(name, leaves) for path in _ending_with(leaf, names)]
    meant = _meant(f"`{PROGRAM} {path}`" for path in close[:3])
    return OptionError("", f"unknown command {name!r}{meant}", hint=hint)


def _ending_with(leaf: str, names: Sequence[str]) -> list[str]:
    """Return the commands with this last word: for ``scan`` ``servo scan``."""
    return [name for name in names if name.split()[-1] == leaf]


def _unknown_option(
    error: Any, owners_of: Callable[[], Mapping[str, list[str]]], hint: str
) -> OptionError:
    """Suggest another name of the same option, or an option that differs by a typing error.

    An option of another command is no typing error: ``solve --speed`` does not mean ``--seed``.
    """
    command = " ".join((PROGRAM, *error.command_chain))
    option = (error.token.keyword or error.token.value).partition("=")[0]
    options = [name for argument in error.argument_collection for name in argument.names]
    options = [name for name in options if name.startswith("--")]
    if OTHER_OPTIONS.get(option) in options:
        return OptionError(
            "", f"unknown option {option}; here it is {OTHER_OPTIONS[option]}", hint=hint
        )
    owners = owners_of().get(option, [])
    if owners:
        where = ", ".join(owners[:4]) + (", …" if len(owners) > 4 else "")
        problem = f"{command} has no option {option} (an option of: {where})"
        return OptionError("", problem, hint=hint)
    beginning = [name for name in options if len(option) > 3 and name.startswith(option)]
    close = beginning if len(beginning) == 1 else close_matches(option, options, 1)
    if close:
        return OptionError("", f"unknown option {option}{_meant(close)}", hint=hint)
    return OptionError("", f"{command} has no option {option}", hint=hint)


def option_owners(app: App, names: Sequence[str]) -> dict[str, list[str]]:
    """Return option -> commands that have it. All commands are imported: 0.1 s, for an error."""
    owners: dict[str, list[str]] = {}
    for name in names:
        command = command_app(app, name)
        prepare_command(command)
        for argument in command.assemble_argument_collection():
            for option in argument.names:
                owners.setdefault(option, []).append(name)
    return owners


def _out_of_range(error: Any, hint: str) -> OptionError:
    value = error.value if error.value is not UNSET else error.argument.value
    problem = f"{value} is out of range"
    return OptionError(_name(error.argument), problem, _range(error.argument), hint=hint)


def _wrong_type(error: Any, hint: str) -> OptionError:
    name = _name(error.argument)
    value = error.token.value if error.token is not None else ""
    choices = _choices(error.target_type)
    if choices:
        meant = _meant(map(repr, close_matches(value, choices, 1)))
        allowed = ", ".join(choices)
        return OptionError(name, f"unknown value {value!r}{meant}", allowed, hint=hint)
    kind = _KINDS.get(error.target_type, "a value of this option")
    allowed = _range(error.argument) or _form(error.argument)
    return OptionError(name, f"{value!r} is not {kind}", allowed, hint=hint)


def range_text(limits: Number) -> str:
    """Return the range of a number: ``above 0, at most 1``."""
    parts = [
        (limits.gt, "above"),
        (limits.gte, "at least"),
        (limits.lt, "below"),
        (limits.lte, "at most"),
    ]
    return ", ".join(
        f"{text} {value:g}" for value, text in parts if value not in (None, float("inf"))
    )


def _range(argument: Any) -> str:
    """Return the range of an option, empty if it has none."""
    checks = argument.parameter.validator if argument is not None else ()
    return next((range_text(check) for check in checks if isinstance(check, Number)), "")


def _form(argument: Any) -> str:
    """Return the form of a value, empty if it is a single word."""
    metavar = (argument.parameter.metavar or "") if argument is not None else ""
    return metavar if re.search(r"[ |=]", metavar) else ""


def _choices(kind: Any) -> list[str]:
    """Return the strings of a ``Literal`` type."""
    return [choice for choice in get_args(kind) if isinstance(choice, str)]


def _name(argument: Any) -> str:
    return argument.names[0] if argument is not None and argument.names else ""


def _meant(names: Iterable[str]) -> str:
    """Return the question for suggestions, empty without any."""
    text = " or ".join(names)
    return f"; did you mean {text}?" if text else ""
