"""A test on real time is tried again after a halt of the machine, and only then."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

# A call through PyDLL keeps the GIL, so no other thread runs, as on a machine that halts.
TESTS = """
import ctypes
from itertools import count

halt = ctypes.PyDLL(None).usleep
tries = {name: count() for name in ("late", "always", "wrong", "plain")}

def test_late_once(real_time):
    if next(tries["late"]) == 0:
        halt(200_000)
        assert False

def test_late_always(real_time):
    print("try", next(tries["always"]))
    halt(200_000)
    assert False

def test_wrong(real_time):
    assert next(tries["wrong"]) > 0

def test_plain():
    halt(200_000)
    assert next(tries["plain"]) > 0
"""


@pytest.mark.skipif(sys.platform == "win32", reason="its C library has no usleep")
def test_a_test_that_fails_after_a_halt_is_repeated(tmp_path: Path) -> None:
    plugin = Path(__file__).with_name("real_time.py")
    (tmp_path / "conftest.py").write_text(plugin.read_text().replace("HALT = 0.02", "HALT = 0.15"))
    (tmp_path / "test_halts.py").write_text(TESTS)
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            "-rA",
            f"--rootdir={tmp_path}",
            tmp_path,
        ],
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST")},
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    lines = [line.split(" - ")[0] for line in run.stdout.splitlines()]
    assert "PASSED test_halts.py::test_late_once" in lines, run.stdout
    for name in ("late_always", "wrong", "plain"):
        assert f"FAILED test_halts.py::test_{name}" in lines
    assert "3 failed, 1 passed, 6 warnings" in run.stdout  # one warning for each further try
    assert "try 5" in lines and "try 6" not in lines
    assert "tried again: the machine halted for 0." in run.stdout
