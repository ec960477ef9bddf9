"""Command-line arguments to a dataclass of options by tyro; help is folded, a mistake is one sentence."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, is_dataclass
from inspect import cleandoc, signature
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO, TypeVar, get_type_hints

from tyro.conf import arg

from robot_ik.cli.console import HELP_FLAGS, NARROWEST
from robot_ik.config import is_number
from robot_ik.errors import ConfigError, InvalidGoalError, close_matches

if TYPE_CHECKING:
    from robot_ik.geometry import Pose
    from robot_ik.goals import PoseGoal, PositionGoal

Request = TypeVar("Request")
#: What tyro writes for programs to read: no line of it is folded.
_ENDLESS = 10_000
#: Longer lines of prose are hard to read, however wide the terminal.
_PROSE = 100
_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_KINDS = {"FLOAT": "a number", "INT": "a whole number", "STR": "a word"}


# ------------------------------------------------------------------------------------------
# Options that several commands have.


def single(metavar: str | None, default: str = "", help: str | None = None) -> Any:
    """Annotation of one value; ``default``: what is taken where none is given."""
    return arg(metavar=metavar, help=help, help_behavior_hint=f"(default: {default})" if default else "")


def several(metavar: str, default: str = "", help: str | None = None) -> Any:
    """Annotation of any number of values; ``default``: what is taken where none is given."""
    return single(f"{metavar} …", default, help)


def robot_argument(default: str) -> Any:
    """Annotation of a robot's name or path; ``default``: what is taken where none is given."""
    return single("NAME|PATH", default, "A name of `robot-ik robots`, or any MJCF or URDF file.")


@dataclass(frozen=True)
class Range:
    """Annotation of a number, or of several: what each may be.  ``parse`` refuses others.

    Attributes:
        what: Behind the number in the error: its unit, or what is wrong with it.
        above: ``low`` itself is too low.
    """

    low: float
    high: float = math.inf
    what: str = ""
    above: bool = False

    def holds(self, value: float) -> bool:
        high_enough = self.low < value if self.above else self.low <= value
        return high_enough and value <= self.high and value < math.inf

    def __str__(self) -> str:
        low, high, bounded = f"{self.low:.10g}", f"{self.high:.10g}", self.high < math.inf
        if self.above:
            return f"above {low}" + (f", at most {high}" if bounded else "")
        return f"{low} to {high}" if bounded else f"{low} or more"


def positive(high: float = math.inf, what: str = "") -> Range:
    """The range above 0."""
    return Range(0.0, high, what, above=True)


#: Behind the help of an option.
NEEDED = "(needed for a real camera)"
XYZ_WXYZ = "X Y Z [W X Y Z]"
_BOARD = (
    "marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM, "
    "chessboard:COLUMNSxROWS:SQUARE_MM or FILE.toml[:NAME]."
)
ArmFile = Annotated[
    Path | None,
    single("FILE|NAME", "beside the model", "Servo ids, signs, zeros and limits: a file, or a robot's."),
]
ArmName = Annotated[
    str, arg(metavar="FILE|NAME", help="Arm file (TOML), or a robot of the catalogue that has one.")
]
OnExit = Annotated[
    Literal["", "torque_off", "hold", "park"],
    single(
        "torque_off|hold|park", "the arm file's", "How to leave the arm; park: back to where it was first."
    ),
]
RecordFile = Annotated[
    Path | None,
    single(
        "FILE.csv|FILE.mcap",
        "none",
        "Write every command and measurement while it happens (.mcap: extra `record`).",
    ),
]
Lens = Annotated[
    Path | None,
    arg(metavar="FILE", help="Calibration of a real camera: OpenCV or ROS YAML.", help_behavior_hint=NEEDED),
]
Dictionary = Annotated[str, single("NAME", "DICT_5X5_50", "Of the board's markers.")]
BoardName = Annotated[str, arg(metavar="BOARD", help=_BOARD)]
NeededBoard = Annotated[str, arg(metavar="BOARD", help=_BOARD, help_behavior_hint=NEEDED)]
Speed = Annotated[
    float,
    positive(1.0, " is no share of the speed limits"),
    arg(help="Share of the joints' speed limits, above 0 and up to 1."),
]
Overwrite = Annotated[bool, arg(help="Files of an earlier run may be replaced.")]
Json = Annotated[bool, arg(help="Print one JSON object instead of tables.")]


def request_of(kind: type[Request], options: object, /, **others: Any) -> Request:
    """The request of a job: options that it has under the same name, and ``others``."""
    same = {name: getattr(options, name) for name in signature(kind).parameters if hasattr(options, name)}
    return kind(**same | others)


def require(right: bool, key: str, problem: str, allowed: str = "", hint: str = "") -> None:
    """Raises ``ConfigError`` unless an option is right: as ``wrong``."""
    if not right:
        raise wrong(key, problem, allowed, hint)


# ------------------------------------------------------------------------------------------
# Values that are parsed here.


def wrong(key: str, problem: str, allowed: str = "", hint: str = "") -> ConfigError:
    """A wrong option: its name, what is the matter, what would be right, what to try."""
    return ConfigError(problem, file="command line", key=key, allowed=allowed, hint=hint)


def joint_degrees(option: str, items: Sequence[str], largest: float = math.inf) -> dict[str, float]:
    """Joint -> degrees of ``JOINT=DEGREES`` arguments, up to ``largest`` to either side.

    Raises:
        ConfigError: Another form, or no such number.
    """
    found = {}
    for item in items:
        joint, _, degrees = item.partition("=")
        found[joint] = float(degrees) if is_number(degrees) else math.nan
        right = math.isfinite(found[joint]) and abs(found[joint]) <= largest
        require(right, option, repr(item), "JOINT=DEGREES, e.g. joint2=2")
    return found


def make_goal(numbers: Sequence[float], frame: str | None = None) -> PositionGoal | PoseGoal:
    """The goal of three numbers (position, metres) or seven (position, then quaternion wxyz).

    No ``frame`` means the robot's tool.

    Raises:
        ConfigError, InvalidGoalError: Another count, a number that is not finite, or a zero quaternion.
    """
    from robot_ik.goals import PoseGoal, PositionGoal

    given = f"{len(numbers)} numbers" if numbers else "no goal is given"
    allowed, example = "3: x y z in metres, or 7: then w x y z", "for example: --goal -0.4 -0.1 0.7"
    require(len(numbers) in (3, 7), "--goal", given, allowed, example)
    return PositionGoal(frame, numbers) if len(numbers) == 3 else PoseGoal(frame, numbers[:3], numbers[3:])


def parse(kind: Any, prog: str, tokens: Sequence[str]) -> Any:
    """Options (``kind``, a dataclass) from what came after ``prog``, such as ``robot-ik servo scan``.

    Raises:
        ConfigError: An argument that does not belong there.
        SystemExit: With 0, after help was asked for and given.
    """
    if any(token in HELP_FLAGS for token in tokens):
        width = max(shutil.get_terminal_size().columns, NARROWEST)
        _, shown = _tyro(kind, prog, tokens, width)
        if shown:
            sys.stdout.write(fold(kind, shown, width) + "\n")
            raise SystemExit(0)
    _refuse_empty(prog, tokens)
    gathered = gather(kind, tokens)
    options, said = _tyro(kind, prog, gathered, _ENDLESS)
    if options is None:
        raise _mistake(kind, prog, gathered, said)
    _refuse_repeated(gathered)
    _refuse_outside(options)
    return options


def _refuse_empty(prog: str, tokens: Sequence[str]) -> None:
    """Raises ``ConfigError`` for an empty argument: what a shell makes of a variable that is not set."""
    for before, token in itertools.pairwise(["", *tokens]):
        flag, given, value = token.partition("=")
        if not token.strip() or (flag.startswith("--") and given and not value.strip()):
            name = flag if given else before
            key = name if name.startswith("-") else ""
            raise wrong(key, "nothing is given", hint=f"all options: {prog} --help")


def _refuse_repeated(tokens: Sequence[str]) -> None:
    """Raises ``ConfigError`` for an option that is given twice: tyro would take the last one in silence."""
    given = [token.partition("=")[0].replace("_", "-") for token in tokens if token.startswith("--")]
    if repeated := next((flag for flag in given if given.count(flag) > 1), None):
        raise wrong(repeated, "given twice", "once")


def _annotated(kind: Any, prefix: str = "--") -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Each flag, with what the type of its field is annotated with."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        flag = prefix + name.replace("_", "-")
        if is_dataclass(hint):
            yield from _annotated(hint, f"{flag}.")
        else:
            yield flag, getattr(hint, "__metadata__", ())


def _refuse_outside(options: Any) -> None:
    """Raises ``ConfigError`` for a number outside the ``Range`` of its option."""
    for flag, notes in _annotated(type(options)):
        value = attrgetter(flag.removeprefix("--").replace("-", "_"))(options)
        numbers = value if isinstance(value, tuple) else (value,)
        for span in (note for note in notes if isinstance(note, Range) and value is not None):
            said = " x ".join(f"{number:.10g}" for number in numbers)
            each = " each" if len(numbers) > 1 else ""
            default = next(filter(None, (getattr(note, "help_behavior_hint", None) for note in notes)), "")
            right = all(map(span.holds, numbers))
            require(right, flag, said + span.what, f"{span}{each} {default}".rstrip())


def gather(kind: Any, tokens: Sequence[str]) -> list[str]:
    """The arguments, options of any number of values (``RATE …``) last, each once with all of its values.

    ``--baud 57600 --baud 1000000`` is ``--baud 57600 1000000``; tyro would take the last one alone.
    """
    metavars = ((flag, getattr(note, "metavar", "")) for flag, notes in _annotated(kind) for note in notes)
    endless = {flag for flag, metavar in metavars if metavar and metavar.endswith("…")}
    into = kept = list[str]()
    values: dict[str, list[str]] = {}
    for token in tokens:
        flag, given, value = token.partition("=")
        if (flag := flag.replace("_", "-")) in endless:  # as tyro understands it
            into = values.setdefault(flag, [])
            into += [value] if given else []
            continue
        if token.startswith("-") and not is_number(token):
            into = kept
        into.append(token)
    return kept + [token for flag, row in values.items() for token in (flag, *row)]


class _Stream(io.StringIO):
    """What is written, kept; drawn and coloured as for the stream it stands for."""

    def __init__(self, like: TextIO) -> None:
        super().__init__()
        self._like = like

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._like, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        return self._like.isatty()


def _tyro(kind: Any, prog: str, tokens: Sequence[str], columns: int) -> tuple[Any, str]:
    """Options or None, and what was shown (help) or complained of, on a terminal so wide."""
    import tyro

    out, err = _Stream(sys.stdout), _Stream(sys.stderr)
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(columns)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            return tyro.cli(kind, prog=prog, description="", args=list(tokens)), ""
    except SystemExit as stop:
        return None, out.getvalue() if stop.code in (0, None) else _ANSI.sub("", err.getvalue())
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before


# -------------------------------------------------------------------------------------- help


def fold(kind: Any, shown: str, width: int) -> str:
    """Usage and boxes of options as tyro has ``shown`` them, and between them the docstring of ``kind``.

    All is folded to ``width`` columns.
    """
    usage, _, boxes = shown.rstrip().partition("\n\n")
    indent = " " * len("usage: robot-ik ")
    head = [_folded(_ANSI.sub("", usage), width, subsequent_indent=indent, break_long_words=False)]
    head += [_fold_prose(paragraph, min(width, _PROSE)) for paragraph in cleandoc(kind.__doc__).split("\n\n")]
    return "\n\n".join([*head, boxes])


def _folded(text: str, width: int, **how: Any) -> str:
    return textwrap.fill(" ".join(text.split()), width, break_on_hyphens=False, **how)


def _fold_prose(paragraph: str, width: int) -> str:
    """Example commands stay as they are, a line each; the other lines are one text."""
    folded: list[str] = []
    text: list[str] = []
    for line in [*paragraph.splitlines(), ""]:
        example = line.strip().startswith("robot-ik ")
        if line and not example:
            text.append(line)
            continue
        folded += [_folded(" ".join(text), width)] if text else []
        folded += ["    " + line.strip()] if example else []
        text = []
    return "\n".join(folded)


# ------------------------------------------------------------------------------------- mistakes


def _mistake(kind: Any, prog: str, tokens: Sequence[str], said: str) -> ConfigError:
    """What tyro says about wrong arguments, as one sentence.

    Its text is for people and differs between versions: what is not recognized is passed on as it is.
    """
    hint = f"all options: {prog} --help"
    usage = _ANSI.sub("", _tyro(kind, prog, ["--help"], _ENDLESS)[1])
    rows = [row for line in said.splitlines() if (row := line.strip("│ ")) and row[0] not in "╭╰"]
    text = " ".join(" ".join(rows).split())

    def takes(flag: str) -> str:
        """What stands behind an option in the help, as text."""
        found = re.search(rf"(?:^|, |│ |  ){re.escape(flag)} (\S.*?)(?:  |\s*│|$)", usage, re.MULTILINE)
        return " ".join(_KINDS.get(token, token) for token in found[1].split()) if found else ""

    if found := re.search(r"Unrecognized (?:or misplaced )?options: (.*?)(?:[─-]{8}|$)", text):
        listed = re.split(r"[,\s]+", found[1])
        return _unknown([token for token in tokens if token in listed] or listed, usage, hint)
    if "Missing from " in text:
        begun = itertools.dropwhile(lambda row: not row.startswith("Missing from "), rows)
        shown = list(itertools.takewhile(lambda row: not row.startswith(("─", "--------")), begun))[1:]
        pairs = zip(shown[::2], shown[1::2], strict=False)
        missing = [f"{name} ({what.replace(' (required)', '')})" for name, what in pairs]
        return wrong("", f"missing: {', '.join(missing)}", hint=hint)
    if found := re.search(r"Missing value for argument '([^']*)'", text):
        return wrong(found[1], "a value is missing", takes(found[1]), hint)
    choice = r"invalid choice '(.*?)' for argument '([^']*)'\. Expected one of \((.*?)\)"
    if found := re.search(choice, text):
        value, name, row = found.groups()
        choices = [token for token in re.findall(r"'([^']*)'", row) if token]  # the empty one: not asked
        close = close_matches(value, choices, 1)
        meant = f" (did you mean {close[0]!r}?)" if close else ""
        key = name if name.startswith("-") else ""
        return wrong(key, f"{value!r} is not a valid choice{meant}", ", ".join(choices), hint)
    if found := re.search(r"Error parsing ([^\s:/]+)[^:]*: ", text):
        flag, allowed = found[1], takes(found[1])
        behind = list(itertools.dropwhile(lambda token: token != flag, tokens))[1:]
        given = list(itertools.takewhile(lambda token: not token.startswith("--"), behind))
        bad = re.findall(r"(?:to float|base 10): '([^']*)'", text)[-1:]
        bad = bad or [token for token in given if not is_number(token)]
        whole = " whole" if "base 10" in text else ""
        problem = f"{bad[0]!r} is no{whole} number" if bad else f"{' '.join(given)!r} cannot be read"
        return wrong(flag, problem, "" if bad and allowed in _KINDS.values() else allowed, hint)
    return wrong("", re.split(r" [─-]{8,} ", text)[0], hint=hint)


def _unknown(tokens: Sequence[str], usage: str, hint: str) -> ConfigError:
    """Arguments that belong to no option; a close name of one is in ``usage``."""
    flag = next((token for token in tokens if token.startswith("-")), None)
    if flag is None:
        return wrong("", f"{' '.join(tokens)!r}: nothing more is taken here", hint=hint)
    rows = re.findall(r"^[│ ]*(-.*?)(?:  |$)", usage, re.MULTILINE)  # not what prose speaks of
    flags = re.findall(r"--[a-z][\w.-]*", " ".join(rows))
    close = close_matches(flag, flags, 1)
    meant = f"; did you mean {close[0]!r}?" if close else ""
    return wrong("", f"unknown option {flag!r}{meant}", hint=hint)


# ------------------------------------------------------------------------------------------
# A pose on the command line: seven numbers.


def pose_option(numbers: tuple[float, ...], key: str) -> Pose | None:
    """Position in metres and quaternion w x y z, or position alone; None when nothing was given.

    Raises:
        ConfigError, InvalidGoalError: Another count of numbers, or no pose.
    """
    from robot_ik.geometry import Pose

    if not numbers:
        return None
    if len(numbers) not in (3, 7):
        raise wrong(key, f"{len(numbers)} numbers", "3: x y z in metres, or 7: then w x y z")
    try:
        return Pose(numbers[:3], numbers[3:] or (1.0, 0.0, 0.0, 0.0))
    except ValueError as error:
        raise InvalidGoalError(f"{key}: {error}") from error


def pose_text(pose: Pose) -> str:
    """Millimetres and quaternion, for tables."""
    millimetres = " ".join(f"{1e3 * v:z.2f}" for v in pose.position)
    quaternion = " ".join(f"{v:z.5f}" for v in pose.wxyz)
    return f"{millimetres} mm, wxyz {quaternion}"
