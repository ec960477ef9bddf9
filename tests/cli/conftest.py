"""Runs of the command line: in this process for speed, in a child where the process itself matters."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from robot_ik.cli.main import main

#: What fits a terminal of 25 lines together with the prompt.
SCREEN = 25
ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


@dataclass(frozen=True)
class Run:
    """What one command line did."""

    code: int
    out: str
    err: str

    def assert_one_screen_error(self, code: int = 2) -> None:
        """Nothing on stdout, a short text without traceback on stderr, the wanted exit code."""
        assert self.code == code, self
        assert self.out == "", self
        assert self.err.strip(), self
        assert "Traceback" not in self.err, self.err
        assert len(self.err.splitlines()) < SCREEN, self.err


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("COLUMNS", "ROBOT_IK_DEBUG", "FORCE_COLOR", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def robot_ik(capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """``robot_ik("solve", "--goal", …) -> Run``, in this process."""

    def run(*arguments: object) -> Run:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return Run(code, said.out, said.err)

    return run


@pytest.fixture
def robot_ik_child() -> Callable[..., Run]:
    """The same in a child process, with extra environment variables."""

    def run(*arguments: object, **variables: str) -> Run:
        done = subprocess.run(
            [sys.executable, "-m", "robot_ik", *map(str, arguments)],
            capture_output=True,
            text=True,
            env={**os.environ, **variables},
            stdin=subprocess.DEVNULL,
            timeout=120,
            check=False,
        )
        return Run(done.returncode, done.stdout, done.stderr)

    return run
