"""Compiling in a process of its own: only when it is due, never in the way, never left behind."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from robot_ik.jobs import precompile
from robot_ik.jobs.precompile import Precompilation
from robot_ik.kernels import jit
from robot_ik.solvers import levenberg_marquardt


@pytest.fixture
def due(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine where nothing has been compiled yet."""
    monkeypatch.setattr(jit, "compiled", lambda function: False)


def test_it_runs_for_the_robot_and_method_that_were_asked_for(
    due: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    note = tmp_path / "note"
    program = f"import sys, pathlib; pathlib.Path({str(note)!r}).write_text(' '.join(sys.argv[1:]))"
    monkeypatch.setattr(precompile, "_SOLVE", program)
    with Precompilation.solver("puma560", "lm") as compiling:
        compiling.wait()
    assert note.read_text() == "puma560 lm"


@pytest.mark.parametrize("solver", ["lm", "auto"])
def test_the_program_is_one_that_solves(due: None, solver: str) -> None:
    with Precompilation.solver("puma560", solver) as compiling:
        process = compiling._process
        compiling.wait()
    assert process is not None and process.returncode == 0


def test_one_that_is_slow_is_not_left_behind(due: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile, "_SOLVE", "import time; time.sleep(600)")
    began = time.monotonic()
    with Precompilation.solver("puma560", "lm") as compiling:
        process = compiling._process
    assert process is not None and process.poll() is not None
    assert time.monotonic() - began < 300.0


def test_one_that_fails_costs_nothing(due: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile, "_SOLVE", "raise SystemExit(3)")
    with Precompilation.solver("puma560", "lm") as compiling:
        compiling.wait()
    monkeypatch.setattr(precompile.sys, "executable", "/no/such/python")
    with Precompilation.solver("puma560", "lm") as compiling:
        compiling.wait()


def test_what_is_compiled_starts_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "compiled", lambda function: True)
    assert Precompilation.solver("puma560", "lm")._process is None
    # One of those that it may come to will do: which it is, is known only when the robot has been read.
    monkeypatch.setattr(jit, "compiled", lambda function: function is levenberg_marquardt.solve)
    assert Precompilation.solver("puma560", "auto")._process is None


def test_the_overlay_is_compiled_by_a_program_that_runs(due: None) -> None:
    with Precompilation.overlay() as compiling:
        process = compiling._process
        compiling.wait()
    assert process is not None and process.returncode == 0
