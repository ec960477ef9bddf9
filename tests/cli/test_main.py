"""The table of commands: help, versions, typing mistakes, exit codes."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import os
import re
import signal
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from robot_ik import errors
from robot_ik.cli import main as main_module
from robot_ik.cli.main import COMMANDS, CommandRow, find_command

#: All that has options of its own: "reach", "servo scan" …
LEAVES = [name for name, command in COMMANDS.items() if command.options] + [
    f"{name} {word}" for name, command in COMMANDS.items() for word in command.subcommands
]

# A command made of one function, so that any ending of a command can be tried.
_ENDING: dict[str, Any] = {}


@dataclasses.dataclass(frozen=True)
class TrialOptions:
    """Ends as the test wants."""


def run_trial(options: TrialOptions) -> int:
    return _ENDING["call"]()


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch, robot_ik: Any) -> Any:
    """``trial(function) -> Run`` of a command that calls ``function``."""
    monkeypatch.setitem(sys.modules, "trial_command", sys.modules[__name__])
    row = CommandRow("trial_command", "TrialOptions", "for tests", "run_trial", mujoco=False)
    monkeypatch.setitem(main_module.COMMANDS, "trial", row)

    def run(call: Any, *arguments: str) -> Any:
        _ENDING["call"] = call
        return robot_ik("trial", *arguments)

    return run


def raising(error: BaseException) -> Any:
    def call() -> int:
        raise error

    return call


def test_help_names_every_command_on_one_screen(robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for arguments in (["--help"], ["-h"], ["help"]):
        run = robot_ik(*arguments)
        assert run.code == 0 and run.err == ""
        assert len(run.out.splitlines()) < 30
        assert "130 Ctrl-C" in run.out, "the line is folded"
        for name, command in COMMANDS.items():
            assert f"{name} " in run.out and command.about in run.out


def test_nothing_asked_shows_the_help_and_fails(robot_ik: Any) -> None:
    run = robot_ik()
    assert run.code == 2 and "usage: robot-ik" in run.out


@pytest.mark.parametrize("name", LEAVES)
def test_help_of_each_command(name: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, command, rest = find_command(name.split())
    assert rest == []
    options = getattr(importlib.import_module(command.module), command.options)
    run = robot_ik(*name.split(), "--help")
    assert run.code == 0 and run.err == ""
    assert max(map(len, run.out.splitlines())) <= 80
    text = " ".join(run.out.replace("│", " ").split())
    assert text.startswith(f"usage: robot-ik {name} [-h]")
    first_line = (options.__doc__ or "").strip().splitlines()[0]
    assert first_line[:60] in text
    # The second line of an option's text would begin a line of the help in mid sentence.
    paragraph = r'^    """[^"\n]*\n    \w[^"]*"""$'
    for kind in options.__mro__[:-1]:
        own = inspect.getsource(kind).partition(f'"""{kind.__doc__}"""')[2]
        assert not re.search(paragraph, own, re.MULTILINE)
    for field in dataclasses.fields(options):
        if "Positional" not in str(field.type):  # those go by another name
            assert "--" + field.name.replace("_", "-") in text, field.name
    assert not re.search(r"command\.\w|<class|\w OPTIONS\]", text)
    # Where nothing is given: Annotated[str | None, single("NAME", "what is taken then")]  (cli/arguments.py)
    assert not re.search(r"\(default: (None)?\)", text), "an option says no default that a user understands"
    if " " not in name:
        assert robot_ik("help", name).out == run.out


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.subcommands])
def test_help_names_every_subcommand(name: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    run = robot_ik(name, "--help")
    assert run.code == 0 and max(map(len, run.out.splitlines())) <= 80
    assert all(re.search(rf"\b{word}\b", run.out) for word in COMMANDS[name].subcommands)


@pytest.mark.parametrize("name", LEAVES)
def test_options_are_frozen_and_explained(name: str) -> None:
    _, command, _ = find_command(name.split())
    module = importlib.import_module(command.module)
    options = getattr(module, command.options)
    assert dataclasses.is_dataclass(options)
    assert options.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert callable(getattr(module, command.run))


HELPS = """
import contextlib, io, sys
from robot_ik.cli.main import main
for line in {lines}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main(line.split())
print([name for name in {heavy} if name in sys.modules])
"""
HEAVY = ["mujoco", "numba", "cv2", "serial", "dynamixel_sdk", "matplotlib", "viser"]


@pytest.mark.parametrize(
    ("lines", "heavy"),
    [
        (["--help", "--version"], [*HEAVY, "numpy", "tyro"]),
        ([f"{name} --help" for name in ("reach", "solve", "run", "view", "servo move")], [*HEAVY, "numpy"]),
        ([f"{name} --help" for name in LEAVES], HEAVY),
    ],
)
def test_help_imports_nothing_heavy(lines: list[str], heavy: list[str]) -> None:
    code = HELPS.format(lines=lines, heavy=heavy)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_version_shows_what_it_stands_on(robot_ik: Any) -> None:
    run = robot_ik("--version")
    assert run.code == 0 and len(run.out.splitlines()) < 15
    for package in ("robot-ik-testbed", "mujoco", "numba"):
        line = next(line for line in run.out.splitlines() if line.startswith(package + " "))
        assert metadata.version(package) in line
    assert "opencv" in run.out


@pytest.mark.parametrize(
    ("typed", "meant"), [("slove", "solve"), ("robot", "robots"), ("SOLVE", "solve"), ("simbus", "sim-bus")]
)
def test_unknown_command_names_the_close_one(typed: str, meant: str, robot_ik: Any) -> None:
    run = robot_ik(typed)
    run.assert_one_screen_error()
    assert f"did you mean '{meant}'" in run.err or f"'{meant}'" in run.err


def test_unknown_option_before_the_command(robot_ik: Any) -> None:
    run = robot_ik("--verison")
    run.assert_one_screen_error()
    assert "--version" in run.err


@pytest.mark.parametrize(
    ("line", "reported"),
    [
        ("help slove", "did you mean 'solve'"),
        ("doctor --jsn", "unknown option '--jsn'; did you mean '--json'?"),
        ("doctor extra", "'extra': nothing more is taken here"),
        ("solve --gaol 1 2 3", "did you mean '--goal'?"),
        ("solve --seed many", "--seed: 'many' is no whole number"),
        ("solve --robot", "--robot: a value is missing; allowed: NAME|PATH"),
        ("solve --goal 1 b 3", "--goal: 'b' is no number; allowed: X Y Z [W X Y Z]"),
        ("solve --speed=-fast --goal 1 2 3", "unknown option '--speed"),
        ("reach --speed fast", "--speed: 'fast' is no number"),
        ("reach --marker x", "--marker: 'x' is no whole number; allowed: ID"),
        ("reach --when-lost fall", "'fall' is not a valid choice; allowed: hold, park, stop"),
        ("figure --path triangle", "'triangle' is not a valid choice; allowed: circle, random, marker"),
        ("experiments", "missing: {a00,s12} (Which thesis.)"),
        ("experiments b00", "'b00' is not a valid choice (did you mean 'a00'?); allowed: a00, s12"),
        ("bench --sets foo", "--sets: 'foo' is not a valid choice; allowed: cold, warm,"),
        ("robots a b c", "'b c': nothing more is taken here"),
        ("servo", "which subcommand of servo? There are: ports, scan,"),
        ("servo skan", "did you mean 'scan'?"),
        ("servo --bus pty scan", "options stand behind the subcommand: robot-ik servo scan --bus"),
        ("solve --goal 1 2 3 --robot ur5e --goal 4 5 6", "--goal: given twice; allowed: once"),
        ("servo move joint1=1 --on_exit hold --on-exit torque_off", "--on-exit: given twice"),
        ("servo torque onn", "'onn' is not a valid choice (did you mean 'on'?); allowed: on, off"),
        ("servo torque", "missing: on|off (What to do.)"),
        ("servo scan --baud x", "--baud: 'x' is no"),
        ("servo calibrate", "missing: OUT.toml"),
        ("servo move joint1=1 --speed", "--speed: a value is missing"),
        ("ar --record a.csv", "unknown option '--record'\n"),
        ("bench --seconds 0", "--seconds: 0 s; allowed: above 0"),
        ("sim-bus --wire-baud 99999999", "--wire-baud: 99999999; allowed: 0 to 10500000"),
        ("servo monitor --rate nan", "--rate: nan Hz; allowed: above 0, at most 200"),
        ("servo monitor --rate 200.1", "--rate: 200.1 Hz; allowed: above 0, at most 200"),
        ("figure --scale inf", "--scale: inf; allowed: 0 or more (default: 1; synthetic"),
        ("ar --size 640 3", "--size: 640 x 3 pixels; allowed: 16 to 16384 each (default: the camera's)"),
        ("reach --lead 0.3", "--lead: 0.3 s cannot be predicted; allowed: 0 to 0.2"),
        ("experiments s12 --seed -1", "--seed: -1; allowed: 0 or more"),
    ],
)
def test_wrong_words_are_reported_in_one_sentence(line: str, reported: str, robot_ik: Any) -> None:
    run = robot_ik(*line.split())
    run.assert_one_screen_error()
    assert reported in run.err and run.err.startswith("error: ")
    assert "--help" in run.err.splitlines()[-1] or len(run.err.splitlines()) == 1  # or all words were read
    assert not re.search(r"command\.|\{None\}|<class|invalid literal|Traceback", run.err)


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


def test_unexpected_error_says_how_to_report_it(trial: Any) -> None:
    run = trial(raising(ZeroDivisionError("division by zero")))
    run.assert_one_screen_error()
    assert "ZeroDivisionError" in run.err and "--debug" in run.err and "report" in run.err
    assert "test_main.py" in run.err  # where it happened


def test_missing_file_is_not_called_a_fault_of_the_program(trial: Any) -> None:
    run = trial(lambda: len(Path("/nowhere/at-all.toml").read_text()))
    run.assert_one_screen_error()
    assert "/nowhere/at-all.toml" in run.err and "fault of robot_ik" not in run.err


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
        _ENDING["call"] = call
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
from robot_ik.cli.main import main
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
    said = child.stderr.read()
    assert child.wait() == 128 + signal.SIGPIPE
    assert said == b""
