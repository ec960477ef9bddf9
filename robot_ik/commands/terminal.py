"""Output of the commands: results on stdout, everything else on stderr.

Away from a terminal there is no colour and no progress bar, and lines are not folded.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import threading
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from robot_ik.commands.streams import is_unicode, open_console
from robot_ik.commands.tables import plural
from robot_ik.errors import RobotIkError, install_command

if TYPE_CHECKING:
    from robot_ik.commands.progress import CommandProgress

SILENCE_SECONDS = 3.0
"""Away from a terminal, a running command prints its name after this time."""

MAX_ERROR_LINES = 20
"""Lines of an error, so that it fits one screen together with the prompt."""

MAX_HINT_LINES = 6
"""Lines of a hint."""

MAX_LINE_LENGTH = 800
"""Characters of a line of an error. A compiler can print endless lines."""

_UNEXPECTED_HINT = (
    "This is a bug in robot_ik. Run the command again with --debug,\n"
    "and report the output together with that of: robot-ik --version"
)


class Report(ABC):
    """Result of a command.

    Attributes:
        SCHEMA: Version of the JSON object. It is raised when a field changes its meaning.
        streamed: The command printed its results during the run, so ``main`` prints none.
    """

    SCHEMA: ClassVar[int] = 1
    streamed: ClassVar[bool] = False

    @property
    def ok(self) -> bool:
        """Whether the command achieved its aim."""
        return True

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 0 done, 1 not achieved, 2 wrong input or environment."""
        return 0 if self.ok else 1

    @property
    def failure(self) -> RobotIkError | None:
        """Error that ended the run early. It is printed after the tables."""
        return None

    @property
    def notes(self) -> Sequence[str]:
        """Warnings to print on stderr, after the tables."""
        return ()

    @property
    def hints(self) -> Sequence[str]:
        """Lines on what to do next, for people. They are printed on stderr."""
        return ()

    @abstractmethod
    def tables(self) -> Iterable[RenderableType]:
        """Return the tables and lines for people."""

    @abstractmethod
    def facts(self) -> Mapping[str, Any]:
        """Return the values for programs (``--json``): SI units, quaternions w x y z."""

    def json_object(self) -> dict[str, Any]:
        """Return the object that ``--json`` prints: the version of its schema and the facts."""
        return {"schema": self.SCHEMA, **self.facts()}


_BARS: list[CommandProgress] = []
"""The progress bar that is shown, if any. Lines on stderr are printed above it."""


def stderr_console() -> Console:
    """Return the console on stderr: that of the progress bar while one is shown."""
    return _BARS[-1].console if _BARS else open_console(sys.stderr, stderr=True)


def say(text: str, style: str = "") -> None:
    """Print one line on stderr. It is never folded."""
    stderr_console().print(Text(text, style=style), soft_wrap=True)


def show_error(error: BaseException, *, debug: bool = False) -> None:
    """Print an error on at most one screen, after its traceback with ``debug``."""
    if debug:
        sys.stderr.write("".join(traceback.format_exception(error)))
    message, hint = describe_error(error)
    hint = _first_lines(hint, MAX_HINT_LINES)
    message = _first_lines(message, MAX_ERROR_LINES - hint.count("\n") - 1)
    text = Text.assemble(("error: ", "bold red"), message)
    if hint:
        text.append("\n" + hint, "cyan")
    stderr_console().print(text, soft_wrap=True)


def describe_error(error: BaseException) -> tuple[str, str]:
    """Return the message of an error and what to try."""
    match error:
        case RobotIkError():
            message = str(error).removesuffix("\n" + error.hint) if error.hint else str(error)
            return message or type(error).__name__, error.hint
        case ModuleNotFoundError() if not (error.name or "").startswith("robot_ik"):
            hint = f"install what robot_ik needs: {install_command()}"
            return f"the Python package {error.name!r} is missing", hint
        case ImportError():
            return f"a package cannot be loaded: {error}", "look closer with: robot-ik doctor"
        case MemoryError():
            return f"not enough memory: {str(error) or 'a smaller job may fit'}", ""
        case OSError():
            where = f"{error.filename}: " if error.filename else ""
            return f"{where}{error.strerror or error}", ""
    place = traceback.extract_tb(error.__traceback__)[-1:]
    where = "".join(
        f" (in {last.name}, {Path(last.filename).parent.name}/{Path(last.filename).name}:"
        f"{last.lineno})"
        for last in place
    )
    return f"unexpected {type(error).__name__}: {error}{where}", _UNEXPECTED_HINT


def _first_lines(text: str, count: int) -> str:
    lines = text.rstrip().splitlines() or [""]
    if len(lines) > count:
        hidden = len(lines) - count + 1
        lines[count - 1 :] = [f"… ({hidden} more lines; --debug shows all)"]
    return "\n".join(
        line if len(line) <= MAX_LINE_LENGTH else line[: MAX_LINE_LENGTH - 1] + "…"
        for line in lines
    )


@dataclass
class Terminal:
    """The output of one command.

    Attributes:
        json: Print facts instead of tables.
        quiet: Print nothing: the command was called from Python.
        debug: Print tracebacks.
        folder: Reserved result folder, for commands with ``--out FOLDER``.
    """

    json: bool = False
    quiet: bool = False
    debug: bool = False
    folder: Path | None = None
    shown: Report | None = field(default=None, init=False)
    _bar: CommandProgress | None = field(default=None, init=False)

    @property
    def console(self) -> Console:
        """Console on stdout, for commands that print during the run."""
        return open_console(sys.stdout)

    def progress(self, phase: str, share: float = 0.0) -> None:
        """Show the current phase, and the share of the phase that is done.

        Jobs with a parameter ``progress`` take this method.
        """
        self._advance(description=phase, total=1.0, completed=share, seconds=None)

    def counting(self, noun: str) -> Callable[[int, int], None]:
        """Return ``show(done, total)``, which shows a count of things. Total 0: it is unknown."""

        def show(done: int, total: int) -> None:
            self._advance(description=plural(done, noun), total=total or None, completed=done)

        return show

    @contextlib.contextmanager
    def busy(self, phase: str, seconds: float | None = None) -> Iterator[None]:
        """Show a phase, with a bar that fills with the time if its duration is known."""
        if self._bar is not None:
            self._bar.begin(phase, seconds)
        try:
            yield
        finally:
            self._advance(seconds=None)

    def _advance(self, **values: Any) -> None:
        if self._bar is not None:
            self._bar.update(**values)

    def end_progress(self) -> None:
        """Remove the progress bar, before a command prints or draws during its run."""
        if self._bar is not None:
            self._bar.stop()
            _BARS.remove(self._bar)
            self._bar = None

    def say(self, text: str, style: str = "") -> None:
        """Print one line on stderr."""
        if not self.quiet:
            say(text, style)

    def confirm(self, question: str) -> bool:
        """Ask a question on stderr. The end of the input means no."""
        self.end_progress()
        open_console(sys.stderr, stderr=True).print(Text(f"{question} [y/N] "), end="")
        try:
            return input().strip().lower() in ("y", "yes")
        except EOFError:
            self.say("")
            return False

    def print(self, *results: RenderableType) -> None:
        """Print results on stdout during the run. Strings are never folded."""
        if self.quiet:
            return
        self.end_progress()
        for part in results:
            self.console.print(part, soft_wrap=isinstance(part, str))

    def print_json_line(self, value: Mapping[str, Any]) -> None:
        """Print one JSON object on one line of stdout, at once."""
        if self.quiet:
            return
        from robot_ik.files import plain  # not for --help

        self.end_progress()
        sys.stdout.write(json.dumps(plain(value), allow_nan=False) + "\n")
        sys.stdout.flush()

    def show(self, report: Report) -> None:
        """Print a report, once.

        ``main`` calls this after the run. A command with a window calls it before it waits for the
        user to close the window.
        """
        if self.quiet or self.shown is report:
            return
        self.shown = report
        self.end_progress()
        if report.streamed:
            pass
        elif self.json:
            from robot_ik.files import json_text, plain  # not for --help

            values = plain(report.json_object())
            sys.stdout.write(json_text(values, ascii=not is_unicode(sys.stdout)) + "\n")
            sys.stdout.flush()
        else:
            self._print_tables(report)
            for hint in report.hints:
                say(hint, "dim")
        for note in report.notes:
            say(note, "yellow")
        if report.failure is not None:
            show_error(report.failure, debug=self.debug)

    def _print_tables(self, report: Report) -> None:
        console = self.console
        for index, part in enumerate(report.tables()):
            if index and isinstance(part, Table):
                console.print()
            console.print(part, soft_wrap=isinstance(part, str | Text))

    @contextlib.contextmanager
    def running(self, name: str) -> Iterator[None]:
        """Show a progress bar during a run, or one line after some seconds without a terminal."""
        console = open_console(sys.stderr, stderr=True)
        if not console.is_terminal:
            timer = threading.Timer(SILENCE_SECONDS, say, (f"{name} …", "dim"))
            timer.daemon = True
            timer.start()
            try:
                yield
            finally:
                timer.cancel()
            return
        from robot_ik.commands.progress import CommandProgress  # 15 ms: not for --help

        self._bar = CommandProgress(name, console)
        self._bar.start()
        _BARS.append(self._bar)
        try:
            yield
        finally:
            self.end_progress()


QUIET = Terminal(quiet=True)
"""Terminal of a command that is called from Python."""


class _LogHandler(logging.Handler):
    """Prints log records as lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            say(record.getMessage(), "yellow" if record.levelno >= logging.WARNING else "dim")
        except Exception:  # a log line must never end a run
            self.handleError(record)


@contextlib.contextmanager
def show_logs(*, debug: bool = False) -> Iterator[None]:
    """Print the library's log during a run: warnings and compilations, or everything.

    The library installs no handler. This is the only one, and it is removed at the end.
    """
    handler = _LogHandler()
    root = logging.getLogger("robot_ik")
    levels = {
        root: logging.DEBUG if debug else logging.WARNING,
        logging.getLogger("robot_ik.kernels"): logging.DEBUG if debug else logging.INFO,
    }
    before = {logger: logger.level for logger in levels}
    root.addHandler(handler)
    for logger, level in levels.items():
        logger.setLevel(level)
    try:
        yield
    finally:
        root.removeHandler(handler)
        for logger, level in before.items():
            logger.setLevel(level)
