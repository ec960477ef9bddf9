"""The command line: help, versions, exit codes, signals, pipes, reserved files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import pytest
from cyclopts import Parameter

from robot_ik import errors
from robot_ik.commands import main as main_module
from robot_ik.commands import terminal
from robot_ik.commands.main import GROUPS, Row
from robot_ik.commands.options import OUTPUT, FolderOption, JsonOption
from robot_ik.commands.terminal import Report, Terminal

COMMANDS = [row for rows in GROUPS.values() for row in rows]

_ENDING: dict[str, Any] = {}
"""Function that the command of the tests calls."""


@dataclass(frozen=True)
class TrialReport(Report):
    """Report of the command of the tests."""

    value: Any

    @property
    def ok(self) -> bool:
        return self.value in (0, None)

    @property
    def exit_code(self) -> int:
        return self.value or 0

    def tables(self) -> Iterable[Any]:
        return [] if self.value is None else [f"value {self.value}"]

    def facts(self) -> Mapping[str, Any]:
        return {"value": self.value}


@dataclass(frozen=True, kw_only=True)
class Trial(JsonOption, FolderOption):
    """Call the function of the test."""

    FILES = ("*.txt",)

    plot: Annotated[Path | None, Parameter(help="A picture."), OUTPUT] = None

    def run(self, terminal: Terminal) -> TrialReport:
        return TrialReport(_ENDING["call"](self, terminal))


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch, robot_ik: Any, tmp_path: Path) -> Any:
    """``trial(function, options …) -> Run`` of a command that calls ``function``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "robot_ik.commands.trial", sys.modules[__name__])
    row = Row("trial", "For tests.", "trial:Trial", mujoco=False)
    monkeypatch.setitem(main_module.GROUPS, "Tests", (row,))

    def run(call: Any, *arguments: object) -> Any:
        _ENDING["call"] = lambda command, terminal: call()
        return robot_ik("trial", *arguments)

    return run


def raising(error: BaseException) -> Any:
    def call() -> int:
        raise error

    return call


def unfolded(text: str) -> str:
    """Return the text of a help without its boxes, on one line."""
    return " ".join(text.replace("│", " ").split())


def test_help_names_every_command_on_two_screens(
    robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for arguments in (["--help"], ["-h"], ["help"]):
        run = robot_ik(*arguments)
        assert run.code == 0 and run.err == ""
        assert len(run.out.splitlines()) < 50
        assert "130 Ctrl-C" in run.out, "the line is folded"
        for row in COMMANDS:
            assert f" {row.name.split()[0]} " in run.out
            assert " " in row.name or row.help in unfolded(run.out)


@pytest.mark.parametrize("group", sorted({r.name.split()[0] for r in COMMANDS if " " in r.name}))
def test_help_of_a_group_names_its_commands(
    group: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    run = robot_ik(group, "--help")
    assert run.code == 0 and max(map(len, run.out.splitlines())) <= 80
    for row in COMMANDS:
        if row.name.startswith(f"{group} "):
            assert f" {row.name.split()[1]} {row.help}" in unfolded(run.out)


def test_no_command_shows_the_help_and_fails(robot_ik: Any) -> None:
    run = robot_ik()
    assert run.code == 2 and "Usage: robot-ik" in run.out


@pytest.mark.parametrize("word", ["--version", "-V", "version"])
def test_version_shows_the_dependencies(word: str, robot_ik: Any) -> None:
    run = robot_ik(word)
    assert run.code == 0 and len(run.out.splitlines()) < 15
    for package in ("robot-ik-testbed", "mujoco", "numba"):
        line = next(line for line in run.out.splitlines() if line.startswith(package + " "))
        assert metadata.version(package) in line
    assert "opencv" in run.out


def test_a_failed_import_of_mujoco_is_explained(robot_ik_child: Any) -> None:
    run = robot_ik_child("solve", "--goal", 0, 0, 0, MUJOCO_GL="nosuch")
    run.assert_one_screen_error()
    assert "MUJOCO_GL=nosuch is set" in run.err


def test_calibrate_names_both_commands_that_it_may_mean(robot_ik: Any, tmp_path: Path) -> None:
    run = robot_ik("calibrate", tmp_path / "mine.txt", "--bus", "sim")
    assert run.code == 2
    first, second = run.err.splitlines()
    assert "robot-ik servo calibrate" in first
    assert "robot-ik camera calibrate" in first
    assert second.startswith("error: OUT.toml")
    run = robot_ik("servo", "calibrate", tmp_path / "mine.txt", "--bus", "sim")
    assert "camera calibrate" not in run.err


def test_json_has_the_version_of_its_schema(trial: Any) -> None:
    run = trial(lambda: 1, "--json")
    assert run.code == 1 and json.loads(run.out) == {"schema": 1, "value": 1}


def test_files_are_reserved_before_the_run(trial: Any, tmp_path: Path) -> None:
    old = tmp_path / "plot.png"
    old.write_text("old")
    run = trial(lambda: 0, "--plot", old)
    run.assert_one_screen_error()
    assert "plot.png was not changed: it exists" in run.err and "--overwrite" in run.err
    assert trial(lambda: 0, "--plot", old, "--overwrite").code == 0
    assert trial(lambda: 0, "--plot", tmp_path / "new" / "plot.png").code == 0
    assert not (tmp_path / "new").exists(), "the run wrote nothing"
    assert not list(tmp_path.rglob("*.lock"))


def test_a_result_folder_is_reserved_and_named(trial: Any, robot_ik: Any, tmp_path: Path) -> None:
    def write(command: Trial, terminal: Terminal) -> int:
        assert terminal.folder is not None
        (terminal.folder / "a.txt").write_text("a")
        return 0

    trial(lambda: 0)
    _ENDING["call"] = write
    assert robot_ik("trial").code == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.endswith("-trial")
    assert robot_ik("trial", "--out", folder).code == 2
    assert robot_ik("trial", "--out", folder, "--overwrite").code == 0


def test_a_running_command_prints_its_name_after_some_time(
    trial: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    printed = threading.Event()
    say = terminal.say
    monkeypatch.setattr(terminal, "SILENCE_SECONDS", 0.0)
    monkeypatch.setattr(terminal, "say", lambda *text: (say(*text), printed.set()))
    run = trial(lambda: 0 if printed.wait(60.0) else 1)
    assert (run.code, run.err) == (0, "trial …\n")


@pytest.mark.parametrize("code", [0, 1, 2])
def test_exit_code_of_a_command_is_kept(code: int, trial: Any) -> None:
    assert trial(lambda: code).code == code


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.NotConvergedError("1 mm away", None), 1),  # type: ignore[arg-type]
        (errors.MarkerNotFoundError("marker 7 is not in the picture"), 1),
        (errors.TrajectoryError("no straight line"), 1),
        (errors.MotorFaultError("joint3", ["overload"]), 1),
        (errors.UnknownRobotError("pumaa", ["puma560"]), 2),
        (errors.UnknownSolverError("lmm", ["lm"]), 2),
        (errors.ConfigError("unknown key", file="arm.toml", key="bus.buad"), 2),
        (errors.ServoMismatchError({1: "joint1: XM430"}, {}, port="pty"), 2),
        (errors.BusTimeoutError(id=3, register="ping", port="/dev/x", joint="joint3"), 2),
        (errors.OutputError("runs/ cannot be written", hint="choose another --out"), 2),
        (errors.MissingExtraError("av", "video", "recording"), 2),
    ],
)
def test_errors_of_the_package_become_exit_codes(error: Exception, code: int, trial: Any) -> None:
    run = trial(raising(error))
    run.assert_one_screen_error(code)
    flat = " ".join(run.err.split())
    assert flat.startswith("error: ")
    for line in str(error).splitlines():  # message and hint, each once and whole
        assert flat.count(" ".join(line.split())) == 1, (line, run.err)


def test_markup_in_a_message_is_shown_as_it_is(trial: Any) -> None:
    run = trial(raising(errors.ModelError("joint [bold]1[/bold] of [/nothing] [red]")))
    assert "joint [bold]1[/bold] of [/nothing] [red]" in run.err


def test_an_endless_message_stays_on_one_screen(trial: Any) -> None:
    text = "\n".join(f"line {k}" for k in range(500))
    run = trial(raising(errors.ModelError(text, hint="\n".join("abcdefghij"))))
    run.assert_one_screen_error()
    assert "more lines" in run.err
    run = trial(raising(errors.ModelError("x" * 100_000)))
    assert len(run.err) < 2000


def test_an_unexpected_error_has_a_hint_to_report_it(trial: Any) -> None:
    run = trial(raising(ZeroDivisionError("division by zero")))
    run.assert_one_screen_error()
    assert "ZeroDivisionError" in run.err and "--debug" in run.err and "report" in run.err
    assert "test_main.py" in run.err  # the place of the error


def test_missing_file_is_not_called_a_fault_of_the_program(trial: Any) -> None:
    run = trial(lambda: len(Path("/nowhere/at-all.toml").read_text()))
    run.assert_one_screen_error()
    assert "/nowhere/at-all.toml" in run.err and "bug in robot_ik" not in run.err


@pytest.mark.parametrize("how", ["flag before", "flag after", "variable"])
def test_debug_shows_the_traceback(
    how: str, trial: Any, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = raising(errors.ModelError("broken"))
    if how == "variable":
        monkeypatch.setenv("ROBOT_IK_DEBUG", "1")
        run = trial(call)
    elif how == "flag after":
        run = trial(call, "--debug")
    else:
        _ENDING["call"] = lambda *_: call()
        run = robot_ik("--debug", "trial")
    assert run.code == 2 and "Traceback" in run.err and run.err.rstrip().endswith("error: broken")


def test_interrupt_is_one_line(trial: Any) -> None:
    run = trial(raising(KeyboardInterrupt()))
    assert (run.code, run.out, run.err) == (130, "", "interrupted\n")


def test_an_interrupt_while_a_package_loads_is_no_missing_package(trial: Any) -> None:
    def load() -> int:
        try:
            raise ImportError("initialization failed") from KeyboardInterrupt()
        except ImportError as reason:
            raise errors.RobotIkError("MuJoCo cannot be imported") from reason

    result = trial(load)
    assert (result.code, result.err.strip()) == (130, "interrupted")


def test_an_interrupt_while_the_program_itself_loads_is_one_line() -> None:
    code = """
import sys

class Interrupting:
    def find_spec(self, name, *rest):
        if name == "rich.table":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupting())
from robot_ik.commands.main import main
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_sigterm_unwinds_the_stack(trial: Any) -> None:
    closed = []
    before = signal.getsignal(signal.SIGTERM)

    def call() -> int:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            for _ in range(10_000_000):
                pass
            return 0
        finally:
            closed.append(True)

    run = trial(call)
    assert (run.code, run.err) == (143, "terminated\n") and closed
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_closed_pipe_is_quiet() -> None:
    child = subprocess.Popen(
        [sys.executable, "-m", "robot_ik", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert child.stdout is not None and child.stderr is not None
    child.stdout.close()  # before the child has written anything
    output = child.stderr.read()
    assert child.wait() == 128 + signal.SIGPIPE
    assert output == b""
