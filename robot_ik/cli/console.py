"""How the commands talk: results on stdout, everything else on stderr, errors on one screen.

Exit codes: 0 done; 1 tried, not achieved; 2 wrong input or environment; 130 interrupted.
Away from a terminal there is no colour and no progress bar, and tables are not folded at 80 columns.
"""

from __future__ import annotations

import codecs
import contextlib
import json
import logging
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from robot_ik.errors import NOT_ACHIEVED_ERRORS, RobotIkError, install_command
from robot_ik.files import json_text, plain

# ------------------------------------------------------------------------------------------
# Standard streams as they may be: closed, or of an encoding without the signs that tables use.


# What a stream without these signs shows instead.
_SPELLED = {
    "°": " deg", "µ": "u", "σ": "s", "…": "...", "±": "+-", "×": "x", "·": "*", "²": "2", "³": "3", "–": "-",
    "—": "-", "≤": "<=", "≥": ">=", "∞": "inf", "→": "->", "│": "|", "─": "-", "━": "-", "√": "sqrt",
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼", "+"),
}  # fmt: skip
_HANDLER = "robot_ik.spelled"


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_SPELLED.get(sign, "?") for sign in error.object[error.start : error.end]), error.end


def is_unicode(stream: object) -> bool:
    """Whether a stream can show every sign."""
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "").startswith("utf")


def prepare_streams() -> bool:
    """Makes standard streams that can be written to without an error; False: there is no standard output.

    A closed descriptor is opened on the null device: the next file, a serial port perhaps, would get its
    number, and with it what C libraries write to their standard error.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    there = sys.stdout is not None
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - for good
        elif not is_unicode(stream):
            codecs.register_error(_HANDLER, _replace_unencodable)
            with contextlib.suppress(AttributeError, OSError):  # a stream that somebody made himself
                stream.reconfigure(errors=_HANDLER)
    return there


HELP_FLAGS = ("--help", "-h")

DONE, NOT_ACHIEVED, WRONG_INPUT, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143

#: Columns when the output is not a terminal: no table of ours is wider, so nothing is folded.
PIPE_WIDTH = 240
#: Columns below which tables are not folded further.
NARROWEST = 40
# Blank columns between two of a table.
_GAP = 2
#: Seconds of silence after which a command says what it is at.
SILENCE = 3.0
#: An error must fit one screen together with the prompt.
ERROR_LINES = 20
_REPORT = (
    "this is a fault of robot_ik, not yours. See the whole of it with: robot-ik --debug …",
    "and report it with that text, the command and the output of: robot-ik --version",
)


def width_of(stream: Any) -> int:
    """Columns to write to a stream: the variable's, else the terminal's, else ``PIPE_WIDTH``.

    0 means unknown, as everywhere; narrower than ``NARROWEST`` nothing can be read.
    """
    asked = os.environ.get("COLUMNS", "")
    columns = int(asked) if asked.isdecimal() else 0
    if not columns and stream.isatty():
        with contextlib.suppress(OSError, ValueError):
            columns = os.get_terminal_size(stream.fileno()).columns or 80
    return max(columns or PIPE_WIDTH, NARROWEST)


class _Console(Console):
    """Shows text as it is, never as markup; a closed pipe is left to ``main``, which knows the exit code."""

    def __init__(self, stream: Any, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, width=width_of(stream), highlight=False, markup=False, emoji=False)

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def out() -> Console:
    """Console for results, on stdout."""
    return _Console(sys.stdout)


def stderr_console() -> Console:
    """Console for everything that is not a result, on stderr."""
    return _Console(sys.stderr, stderr=True)


def say(text: str, style: str = "") -> None:
    """One line on stderr; never folded."""
    stderr_console().print(Text(text, style=style), soft_wrap=True)


def result(text: str, style: str = "") -> None:
    """One line of result on stdout; never folded."""
    out().print(Text(text, style=style), soft_wrap=True)


def show(*results: RenderableType) -> None:
    """Tables and text on stdout, one below the other; an empty text is a blank line."""
    screen = out()
    for one in results:
        screen.print(one)


def refused(problem: str, hint: str = "") -> int:
    """Says what was not achieved, and what to try.

    Returns:
        ``NOT_ACHIEVED``, the exit code of the command.
    """
    say(f"error: {problem}", "bold red")
    if hint:
        say(hint, "cyan")
    return NOT_ACHIEVED


def confirm(question: str) -> bool:
    """Asks on stderr for a yes; the end of the input is a no."""
    stderr_console().print(Text(f"{question} [y/N] "), end="")
    try:
        return input().strip().lower() in ("y", "yes")
    except EOFError:
        say("")
        return False


class _FoldedTable(Table):
    """A table that breaks no word: where that needs more columns than there are, each row is a list."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        texts = [[_plain(cell) for cell in (column.header, *column.cells)] for column in self.columns]
        longest_words = [
            max(len(word) for text in column for word in text.split() or [""]) for column in texts
        ]
        lines = [max(len(line) for text in column for line in text.splitlines() or [""]) for column in texts]
        longest_words[0] = lines[0]  # the first column is never broken
        space = options.max_width - _GAP * (len(texts) - 1)
        if sum(lines) > space >= sum(longest_words):
            spare = space - sum(longest_words)
            widths = sorted(
                (line - word, k) for k, (word, line) in enumerate(zip(longest_words, lines, strict=True))
            )
            for done, (width, k) in enumerate(widths):  # the smallest first: long lines fold, not headers
                more = min(width, spare // (len(widths) - done))
                self.columns[k].width = longest_words[k] + more
                spare -= more
        elif sum(lines) > space and len(texts) > 2:
            yield from self._rows_as_lists()
            return
        yield from super().__rich_console__(console, options)

    def _rows_as_lists(self) -> Iterator[Table]:
        names = [_plain(column.header) for column in self.columns]
        for row in zip(*(list(column.cells) for column in self.columns), strict=True):
            rest = ((f"  {name}", cell) for name, cell in zip(names[1:], row[1:], strict=True))
            yield facts((Text(_plain(row[0]), style="bold"), ""), *(pair for pair in rest if _plain(pair[1])))


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def table(*columns: str, rows: Iterable[Sequence[object]] = (), title: str | None = None) -> Table:
    """A table in the one style of all commands: cells are ``Text``, or shown by ``str``.

    The first column is never broken.
    """
    made = _FoldedTable(
        title=title, title_justify="left", title_style="bold", header_style="bold", box=None, pad_edge=False
    )
    for index, name in enumerate(columns):
        made.add_column(name, no_wrap=index == 0, overflow="fold")
    for row in rows:
        made.add_row(*(cell if isinstance(cell, Text) else str(cell) for cell in row))
    return made


def facts(*rows: tuple[object, object]) -> Table:
    """Rows of a name and its value, without a header."""
    made = table("", "", rows=rows)
    made.show_header = False
    return made


def count_of(count: int, one: str) -> str:
    """A number of things: ``1 pose``, ``2 poses``."""
    return f"{count} {one}{'' if count == 1 else 's'}"


class _ClockColumn(BarColumn):
    """A bar that fills with the time."""

    def render(self, task: Task) -> ProgressBar:
        if task.total is not None:
            task.completed = min(task.elapsed or 0.0, task.total)
        return super().render(task)


def progress(column: type[BarColumn] = BarColumn) -> Progress:
    """A progress bar on stderr that shows nothing unless stderr is a terminal."""
    console = stderr_console()
    return Progress(
        TextColumn("{task.description}"),
        column(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def shares_on(bar: Progress, what: str) -> Callable[[str, float], None]:
    """The ``progress`` of a job: the share of it that is done is the bar, its phase stands behind it."""
    task = bar.add_task(what, total=1.0, note="")
    return lambda phase, share: bar.update(task, completed=share, note=phase)


def counted_on(bar: Progress, what: str, things: str = "pictures") -> Callable[[int, int], None]:
    """A job's count of things on a bar: how many are done, and of how many (0: unknown)."""
    task = bar.add_task(what, total=None, note="")
    return lambda done, whole: bar.update(task, completed=done, total=whole or None, note=f"{done} {things}")


@contextlib.contextmanager
def kept(out: Path) -> Iterator[None]:
    """Says what is in a film, a picture or a folder of pictures where the block ends early."""
    before = out.stat().st_mtime_ns if out.exists() else 0
    try:
        yield
    except BaseException:
        if out.exists() and out.stat().st_mtime_ns != before:
            say(f"kept until here: {out}", "yellow")
        raise


@contextlib.contextmanager
def busy(what: str, seconds: float | None = None) -> Iterator[None]:
    """Shows that something goes on inside, for ``seconds`` if that is known.

    On a terminal by a bar, elsewhere by a line after ``SILENCE``.
    """
    takes = "" if seconds is None else f", about {seconds:.0f} s"
    timer = threading.Timer(SILENCE, lambda: say(f"{what}{takes} …", "dim"))
    timer.daemon = True
    if not stderr_console().is_terminal:
        timer.start()
    try:
        with progress(_ClockColumn) as bar:
            bar.add_task(what, total=seconds, note="")
            yield
    finally:
        timer.cancel()


def print_json(value: Mapping[str, Any]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json_text(plain(value), ascii=not is_unicode(sys.stdout)) + "\n")


def print_json_line(value: Mapping[str, Any]) -> None:
    """One JSON object on one line of stdout, at once."""
    sys.stdout.write(json.dumps(plain(value), allow_nan=False) + "\n")
    sys.stdout.flush()


# ----------------------------------------------------------------------------------- errors


def _first_lines(text: str, count: int) -> str:
    lines = text.rstrip().splitlines() or [""]
    if len(lines) > count:
        left = len(lines) - count + 1
        lines = [*lines[: count - 1], f"… ({left} more lines; --debug shows all)"]
    # A single endless line (a path list, a compiler's answer) would fill the screen as well.
    return "\n".join(line if len(line) <= 800 else line[:799] + "…" for line in lines)


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return ""
    last = frames[-1]
    name = os.path.join(os.path.basename(os.path.dirname(last.filename)), os.path.basename(last.filename))
    return f" (in {last.name}, {name}:{last.lineno})"


def describe_error(error: BaseException) -> tuple[str, str]:
    """What to show of an error: the message, and what to try."""
    if isinstance(error, RobotIkError):
        message = str(error.args[0]) if error.args else type(error).__name__
        if isinstance(error, OSError):  # OSError keeps its arguments in its own way
            message = str(error)
            message = message.removesuffix("\n" + error.hint) if error.hint else message
        return message, error.hint
    if isinstance(error, ModuleNotFoundError) and not (error.name or "").startswith("robot_ik"):
        hint = f"install what robot_ik needs: {install_command()}"
        return f"the Python package {error.name!r} is missing", hint
    if isinstance(error, ImportError) and not isinstance(error, ModuleNotFoundError):
        return f"a part of the installation cannot be loaded: {error}", "look closer with: robot-ik doctor"
    if isinstance(error, MemoryError):
        return f"not enough memory: {str(error) or 'a smaller job may fit'}", ""
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}", ""
    return (
        f"robot-ik stopped on an error it did not expect: {type(error).__name__}: {error}{_where(error)}",
        "\n".join(_REPORT),
    )


def show_error(error: BaseException, *, debug: bool = False) -> int:
    """Prints an error on at most one screen; with ``debug`` the traceback comes first.

    Returns:
        The exit code that belongs to it.
    """
    if debug:
        sys.stderr.write("".join(traceback.format_exception(error)))
    message, hint = describe_error(error)
    hint = _first_lines(hint, 6)
    message = _first_lines(message, ERROR_LINES - hint.count("\n") - 1)
    text = Text.assemble(("error: ", "bold red"), message, ("\n" + hint if hint else "", "cyan"))
    stderr_console().print(text, soft_wrap=True)
    return NOT_ACHIEVED if isinstance(error, NOT_ACHIEVED_ERRORS) else WRONG_INPUT


class _ConsoleLogHandler(logging.Handler):
    """Shows log records as single lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            style = "yellow" if record.levelno >= logging.WARNING else "dim"
            say(record.getMessage(), style)
        except Exception:  # a log line must never end the run
            self.handleError(record)


@contextlib.contextmanager
def log_levels(levels: Mapping[str, int]) -> Iterator[None]:
    """Loggers, by name, at these levels while inside."""
    before = {name: logging.getLogger(name).level for name in levels}
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


@contextlib.contextmanager
def logs_shown(*, debug: bool = False) -> Iterator[None]:
    """Shows the library's log while inside: warnings and what the kernels say; everything with ``debug``.

    The library itself installs no handler; this is the only place that does, and it is taken back.
    """
    handler, root = _ConsoleLogHandler(), logging.getLogger("robot_ik")
    usual = {"robot_ik": logging.WARNING, "robot_ik.kernels": logging.INFO}
    root.addHandler(handler)
    try:
        with log_levels(dict.fromkeys(usual, logging.DEBUG) if debug else usual):
            yield
    finally:
        root.removeHandler(handler)
