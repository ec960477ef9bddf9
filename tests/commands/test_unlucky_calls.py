"""Closed streams, other encodings, narrow terminals, and values that cannot be used."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.commands import streams, terminal
from robot_ik.commands.streams import open_console
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import Terminal, describe_error
from robot_ik.errors import ConfigError
from robot_ik.hardware import open_arm, open_bus
from robot_ik.hardware.config import ArmConfig
from tests.waiting import wait_for

ROBOT_IK = [sys.executable, "-m", "robot_ik"]


def with_closed(stream: int, *words: str) -> subprocess.CompletedProcess[str]:
    """A run whose standard stream of that number is closed."""
    command = ["sh", "-c", f'exec "$@" {stream}>&-', "sh", *ROBOT_IK, *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_without_standard_output_nothing_begins() -> None:
    run = with_closed(1, "robots")
    assert run.returncode == 2
    assert run.stderr == "error: standard output is closed, so results have nowhere to go\n"


def test_without_standard_error_the_exit_code_speaks() -> None:
    assert with_closed(2, "robots", "nosuch").returncode == 2
    run = with_closed(2, "robots")
    assert run.returncode == 0 and "puma560" in run.stdout


@pytest.mark.parametrize(
    ("words", "variables"),
    [
        (["robots", "puma560"], {"PYTHONIOENCODING": "ascii"}),
        (["reach", "--help"], {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    ],
    ids=["ascii", "C"],
)
def test_signs_that_a_stream_lacks_are_spelled(
    variables: dict[str, str], words: list[str], robot_ik_child: Any
) -> None:
    run = robot_ik_child(*words, **variables)
    assert run.code == 0 and run.out.isascii() and run.err.isascii()


def test_json_is_json_in_any_encoding(robot_ik: Any, robot_ik_child: Any) -> None:
    poor = robot_ik_child("solvers", "dls", "--json", PYTHONIOENCODING="ascii")
    rich = robot_ik("solvers", "dls", "--json")
    assert poor.out.isascii() and not rich.out.isascii()
    assert json.loads(poor.out) == json.loads(rich.out)


@pytest.mark.parametrize("columns", ["0", "1", "60"])
def test_tables_can_be_read_however_narrow_the_terminal_claims_to_be(
    columns: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    run = robot_ik("robots")
    assert run.code == 0
    for name in rik.catalogue():
        assert any(line.startswith(name) for line in run.out.splitlines()), run.out
    widest = max(map(len, run.out.splitlines()))
    assert widest <= {"0": streams.PIPE_WIDTH, "1": streams.MIN_WIDTH, "60": 60}[columns]
    assert robot_ik("robots", "--help").code == 0


def test_a_narrow_table_breaks_no_word(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("joint", "position", "velocity", "current", "supply", "torque")
    values = ("finger_left", "120.00°", "12.0 °/s", "1200 mA", "12.0 V", "off")
    for columns, lines in (("80", 2), ("45", 6)):  # side by side; one below the other
        monkeypatch.setenv("COLUMNS", columns)
        open_console(sys.stdout).print(table(*names, rows=[values]))
        out = capsys.readouterr().out
        assert len(out.splitlines()) == lines
        assert all(value in out for value in values), out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["solve", "--goal", "0", "0", "0", "--frame", ""], "--frame: the value is empty"),
        (["solve", "--goal", "0", "0", "0", "--robot="], "--robot: the value is empty"),
        (["robots", ""], "the value is empty"),
        (["servo", "monitor", "--bus", "sim", "--count", "0"], "--count: 0 is out of range"),
        (["ar", "--size", "100000", "100000"], "at least 16, at most 16384"),
        (["ar", "--size", "-640", "480"], "at least 16, at most 16384"),
        (["reach", "--marker-size", "-0.05"], "marker size of -0.05 m"),
        (["robots", "/no/such/arm.xml"], "there is no file /no/such/arm.xml"),
    ],
)
def test_a_value_without_sense_is_answered_by_one_sentence(
    words: list[str], says: str, robot_ik: Any
) -> None:
    run = robot_ik(*words)
    run.assert_one_screen_error()
    assert says in run.err and "fault of robot_ik" not in run.err


def test_a_model_with_a_number_that_is_none(robot_ik: Any, tmp_path: Path) -> None:
    path = tmp_path / "nan.xml"
    body = '<body name="arm" pos="nan 0 0"><joint/><geom size=".1"/></body>'
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    run = robot_ik("robots", path)
    assert run.code == 2 and "not finite" in run.err and "fault of robot_ik" not in run.err


@pytest.mark.parametrize(("seconds", "most"), [("1e9", "86400"), ("1e300", "1e+15")])
def test_a_wait_of_ages_is_refused(robot_ik: Any, tmp_path: Path, seconds: str, most: str) -> None:
    script = tmp_path / "wait.toml"
    script.write_text(f'schema = 1\nname = "w"\n[[steps]]\ndo = "wait"\nseconds = {seconds}\n')
    run = robot_ik("run", script)
    assert run.code == 2 and "seconds" in run.err and most in run.err, run


def test_without_its_compiler_the_package_says_so(robot_ik_child: Any) -> None:
    run = robot_ik_child("solve", "--goal", "0", "0", "0", NUMBA_DISABLE_JIT="1")
    run.assert_one_screen_error()
    assert "NUMBA_DISABLE_JIT" in run.err and "fault of robot_ik" not in run.err


def test_no_memory_is_no_fault_of_the_package() -> None:
    text, hint = describe_error(MemoryError("Unable to allocate 112. GiB"))
    assert text == "not enough memory: Unable to allocate 112. GiB" and not hint


@pytest.mark.parametrize(
    "call",
    [
        lambda: rik.Pose((np.nan, 0, 0)),
        lambda: rik.Pose((0, 0)),
        lambda: rik.Pose("abc"),
        lambda: rik.Pose((0, 0, 0), (0, 0, 0, 0)),
        lambda: rik.Pose.from_matrix(np.eye(3)),
        lambda: rik.make_chain(5000),
        lambda: rik.make_chain(2.5),  # type: ignore[arg-type]
        lambda: rik.make_chain(3, "long"),  # type: ignore[arg-type]
        lambda: rik.make_chain(3, np.nan),
        lambda: open_arm("puma560"),  # type: ignore[arg-type]
        lambda: open_bus("sim", 5),  # type: ignore[arg-type]
    ],
)
def test_a_wrong_value_is_an_error_of_this_package_and_a_value_error(call: Any) -> None:
    with pytest.raises(rik.RobotIkError) as caught:
        call()
    assert isinstance(caught.value, ValueError)


def test_what_is_for_virtual_servos_is_refused_at_a_port() -> None:
    config = ArmConfig.load(rik.catalogue()["puma560"] / "arm.toml")
    with pytest.raises(ConfigError, match="real port"):
        open_arm(config, "/dev/ttyUSB9", start=np.zeros(6))


def test_a_silent_run_is_named_after_a_while(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "SILENCE_SECONDS", 0.05)
    with Terminal().running("moving"):
        said = wait_for(lambda: capsys.readouterr().err)
    assert said == "moving …\n"
    monkeypatch.setattr(terminal, "SILENCE_SECONDS", 30.0)
    with Terminal().running("moving"):
        pass
    assert capsys.readouterr().err == ""
