"""A process that compiles kernels: it calls a function, reports, and is ended."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from robot_ik.kernels.precompile import Precompilation

MODULE = """
import pathlib, time
from robot_ik.kernels.jit import kernel


@kernel
def added_by_a_test(a, b):
    return a + b


def note(file, text):
    pathlib.Path(file).write_text(text)


def compile_one():
    added_by_a_test(1.0, 2.0)


def fail():
    raise SystemExit(3)


def hang(file):
    pathlib.Path(file).write_text("begun")
    time.sleep(600)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module that other processes can import."""
    (tmp_path / "functions_of_a_test.py").write_text(MODULE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "functions_of_a_test"


def test_the_function_gets_its_arguments(module: str, tmp_path: Path) -> None:
    file = tmp_path / "note"
    with Precompilation(f"{module}:note", str(file), "puma560 lm") as compilation:
        compilation.wait()
    assert file.read_text() == "puma560 lm"


def test_compiled_functions_are_reported(module: str) -> None:
    with Precompilation(f"{module}:compile_one") as compilation:
        assert "added_by_a_test" in list(compilation.compiled_functions())


def test_a_process_that_runs_is_ended(module: str, tmp_path: Path) -> None:
    file = tmp_path / "note"
    with Precompilation(f"{module}:hang", str(file)) as compilation:
        process = compilation.process
        assert process is not None
    assert process.poll() is not None


@pytest.mark.parametrize("function", ["fail", "no_such_function"])
def test_a_failed_process_raises_no_error(module: str, function: str) -> None:
    with Precompilation(f"{module}:{function}") as compilation:
        compilation.wait()
        assert compilation.process is not None
        assert compilation.process.returncode != 0


def test_without_an_interpreter_no_process_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with Precompilation("robot_ik.robot:load_robot", "puma560") as compilation:
        compilation.wait()
    assert compilation.process is None


def test_no_function_starts_no_process() -> None:
    with Precompilation(None) as compilation:
        assert list(compilation.compiled_functions()) == []
        compilation.wait()
    assert compilation.process is None
