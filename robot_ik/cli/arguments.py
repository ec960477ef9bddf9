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
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar, get_type_hints

from tyro.conf import arg

from robot_ik.cli.console import HELP_FLAGS, NARROWEST
from robot_ik.errors import ConfigError, InvalidGoalError, close_matches
from robot_ik.reading import FORMER

if TYPE_CHECKING:
    from robot_ik.geometry import Pose

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
OnExit = Annotated[
    str,
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
Json = Annotated[bool, arg(help="Print one JSON object instead of tables.")]


def request_of(kind: type[Request], options: object, **others: Any) -> Request:
    """The request of a job: options that it has under the same name, and ``others``."""
    same = {f.name: getattr(options, f.name) for f in fields(kind) if hasattr(options, f.name)}  # type: ignore[arg-type]
    return kind(**same | others)


def require(right: bool, key: str, problem: str, allowed: str = "", hint: str = "") -> None:
    """Raises ``ConfigError`` unless an option is right: as ``wrong``."""
    if not right:
        raise wrong(key, problem, allowed, hint)


def require_share(option: str, value: float, of: str = "speed limits") -> None:
    """Raises ``ConfigError`` unless a share is above 0 and up to 1."""
    require(0.0 < value <= 1.0, option, f"{value:g} is no share of the {of}", "above 0, at most 1")


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
        try:
            found[joint] = float(degrees)
        except ValueError:
            found[joint] = math.nan
        if not (math.isfinite(found[joint]) and abs(found[joint]) <= largest):
            raise wrong(option, repr(item), "JOINT=DEGREES, e.g. joint2=2")
    return found


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
            sys.stdout.write(fold(shown, width) + "\n")
            raise SystemExit(0)
    _refuse_empty(prog, tokens)
    gathered = gather(kind, tokens)
    options, said = _tyro(kind, prog, gathered, _ENDLESS)
    if options is None:
        raise _Mistake(kind, prog, gathered, said).error()
    return options


def _refuse_empty(prog: str, tokens: Sequence[str]) -> None:
    """Raises ``ConfigError`` for an empty argument: what a shell makes of a variable that is not set."""
    for before, token in itertools.pairwise(["", *tokens]):
        flag, given, value = token.partition("=")
        if not token.strip() or (flag.startswith("--") and given and not value.strip()):
            name = flag if given else before
            key = name if name.startswith("-") else ""
            raise wrong(key, "nothing is given", hint=f"all options: {prog} --help")


def gather(kind: Any, tokens: Sequence[str]) -> list[str]:
    """The arguments; an option of any number of values (``RATE …``) stands once in them, with all its values.

    ``--baud 57600 --baud 1000000`` is ``--baud 57600 1000000``; tyro would take the last one alone.
    """
    flags = [_flag(token) for token in tokens]
    repeated = {flag for flag in flags if flag and flags.count(flag) > 1} & set(_endless_options(kind))
    kept: list[str] = []
    values: dict[str, list[str]] = {flag: [] for flag in flags if flag in repeated}
    into = kept
    for flag, token in zip(flags, tokens, strict=True):
        if flag in repeated:
            into = values[flag]
            into += [token.partition("=")[2]] if "=" in token else []
            continue
        if token.startswith("-") and not _is_number(token):
            into = kept
        into.append(token)
    return kept + [token for flag, row in values.items() for token in (flag, *row)]


def _flag(token: str) -> str:
    """The option that an argument names, as tyro understands it; empty: it is none."""
    return token.partition("=")[0].replace("_", "-") if token.startswith("--") else ""


def _endless_options(kind: Any, prefix: str = "--") -> Iterator[str]:
    for name, hint in get_type_hints(kind, include_extras=True).items():
        flag = prefix + name.replace("_", "-")
        if is_dataclass(hint):
            yield from _endless_options(hint, f"{flag}.")
        elif any(
            (getattr(note, "metavar", "") or "").endswith("…") for note in getattr(hint, "__metadata__", ())
        ):
            yield flag


def _is_number(token: str) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    return True


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
            return tyro.cli(kind, prog=prog, args=list(tokens)), ""
    except SystemExit as stop:
        return None, out.getvalue() if stop.code in (0, None) else _ANSI.sub("", err.getvalue())
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before


# -------------------------------------------------------------------------------------- help


def fold(text: str, width: int) -> str:
    """Help of tyro with usage and description folded to ``width`` columns, as its boxes are."""
    lines = text.rstrip().splitlines()
    boxes = next((at for at in range(len(lines)) if _opens_a_box(lines, at)), len(lines))
    usage, *paragraphs = re.split(r"\n\s*\n", _ANSI.sub("", "\n".join(lines[:boxes])).strip())
    head = [_fold_usage(usage, width)]
    head += [_fold_prose(paragraph.strip("\n"), min(width, _PROSE)) for paragraph in paragraphs]
    return "\n\n".join([*(part for part in head if part), "\n".join(lines[boxes:])])


def _opens_a_box(lines: Sequence[str], at: int) -> bool:
    below = lines[at + 1].strip() if at + 1 < len(lines) else ""
    return _ANSI.sub("", lines[at]).startswith("╭") or (len(below) > 8 and not below.strip("-"))


def _fold_usage(usage: str, width: int) -> str:
    """Broken between arguments, never within the brackets of one."""
    depth, glued = 0, ""
    for character in " ".join(usage.split()):
        depth += (character in "[{") - (character in "]}")
        glued += "\0" if character == " " and depth else character
    indent = " " * (len("usage: robot-ik") + 1)
    kept = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.fill(glued, width, subsequent_indent=indent, **kept).replace("\0", " ")  # type: ignore[arg-type]


def _fold_prose(paragraph: str, width: int) -> str:
    """Example commands stay as they are, a line each; the other lines are one text."""
    folded: list[str] = []
    text: list[str] = []
    for line in [*paragraph.splitlines(), ""]:
        example = line.strip().startswith("robot-ik ")
        if line and not example:
            text.append(line)
            continue
        folded += textwrap.wrap(" ".join(" ".join(text).split()), width, break_on_hyphens=False)
        folded += ["    " + line.strip()] if example else []
        text = []
    return "\n".join(folded)


# ------------------------------------------------------------------------------------- mistakes


class _Mistake:
    """What tyro says about wrong arguments, as one sentence.

    Its text is for people and differs between versions: what is not recognized is passed on as it is.
    """

    def __init__(self, kind: Any, prog: str, tokens: Sequence[str], said: str) -> None:
        self._tokens = list(tokens)
        self._hint = f"all options: {prog} --help"
        self._help = _ANSI.sub("", _tyro(kind, prog, ["--help"], _ENDLESS)[1])
        # The box without its frame: a title, then parts between rules.
        rows = [line.strip("│ ").rstrip() for line in said.splitlines()]
        self._rows = [row for row in rows if row]
        parts = re.split(r"\n[─-]{8,}\n", "\n".join(row for row in rows if not row.startswith(("╭", "╰"))))
        self._said = " ".join((parts[1] if len(parts) > 1 and "Options" in parts[0] else parts[0]).split())
        self._all = " ".join(" ".join(rows).split())

    def error(self) -> ConfigError:
        """The first of the sentences that fits."""
        for report in (self._unknown, self._missing, self._no_value, self._no_choice, self._unreadable):
            if (found := report()) is not None:
                return found
        return wrong("", self._said, hint=self._hint)

    def _metavar_text(self, flag: str) -> str:
        """What stands behind an option in the help, as text."""
        found = re.search(rf"(?:^|, |│ |  ){re.escape(flag)} (\S.*?)(?:  |\s*│|$)", self._help, re.MULTILINE)
        return " ".join(_KINDS.get(token, token) for token in found[1].split()) if found else ""

    def _unknown(self) -> ConfigError | None:
        found = re.search(r"Unrecognized (?:or misplaced )?options: (.*?)(?:[─-]{8}|$)", self._all)
        if found is None:
            return None
        tokens = [token for token in self._tokens if token in re.split(r"[,\s]+", found[1])]
        flag = next((token for token in tokens if token.startswith("-")), None)
        if flag is None:
            return wrong("", f"{' '.join(tokens) or found[1]!r}: nothing more is taken here", hint=self._hint)
        flags = re.findall(r"--[a-z][\w.-]*", self._help)
        if (now := FORMER.get(flag)) in flags:
            return wrong(flag, f"this option is called {now} now", hint=self._hint)
        close = close_matches(flag, flags, 1)
        meant = f"; did you mean {close[0]!r}?" if close else ""
        return wrong("", f"unknown option {flag!r}{meant}", hint=self._hint)

    def _missing(self) -> ConfigError | None:
        rows = itertools.dropwhile(lambda row: not row.startswith("Missing from "), self._rows)
        if next(rows, None) is None:
            return None
        shown = list(itertools.takewhile(lambda row: not row.startswith(("─", "--------")), rows))
        pairs = zip(shown[::2], shown[1::2], strict=False)
        missing = [f"{name} ({what.replace(' (required)', '')})" for name, what in pairs]
        return wrong("", f"missing: {', '.join(missing)}", hint=self._hint)

    def _no_value(self) -> ConfigError | None:
        if not (found := re.search(r"Missing value for argument '([^']*)'", self._all)):
            return None
        return wrong(found[1], "a value is missing", self._metavar_text(found[1]), self._hint)

    def _no_choice(self) -> ConfigError | None:
        found = re.search(
            r"invalid choice '(.*?)' for argument '([^']*)'\. Expected one of \((.*?)\)", self._all
        )
        if found is None:
            return None
        value, name, listed = found.groups()
        choices = [token for token in re.findall(r"'([^']*)'", listed) if token]  # the empty one: not asked
        close = close_matches(value, choices, 1)
        meant = f" (did you mean {close[0]!r}?)" if close else ""
        key = name if name.startswith("-") else ""
        return wrong(key, f"{value!r} is not a valid choice{meant}", ", ".join(choices), self._hint)

    def _unreadable(self) -> ConfigError | None:
        if not (found := re.search(r"Error parsing ([^\s:/]+)[^:]*: ", self._all)):
            return None
        flag = found[1]
        behind = itertools.dropwhile(lambda token: token != flag, self._tokens)
        given = list(itertools.takewhile(lambda token: not token.startswith("--"), list(behind)[1:]))
        bad = re.findall(r"(?:to float|base 10): '([^']*)'", self._all)[-1:] or [
            token for token in given if not re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?|nan|[-+]?inf", token)
        ]
        whole = " whole" if "base 10" in self._all else ""
        problem = f"{bad[0]!r} is no{whole} number" if bad else f"{' '.join(given)!r} cannot be read"
        takes = self._metavar_text(flag)
        return wrong(flag, problem, "" if bad and takes in _KINDS.values() else takes, self._hint)


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
        raise wrong(key, f"{len(numbers)} numbers", "x y z in metres, and an orientation as w x y z")
    try:
        return Pose(numbers[:3], numbers[3:] or (1.0, 0.0, 0.0, 0.0))
    except ValueError as error:
        raise InvalidGoalError(f"{key}: {error}") from error


def pose_text(pose: Pose) -> str:
    """Millimetres and quaternion, for tables."""
    x, y, z = (1e3 * pose.position).tolist()
    w = " ".join(f"{v:.5f}" for v in pose.wxyz)
    return f"{x:.2f} {y:.2f} {z:.2f} mm, wxyz {w}"
