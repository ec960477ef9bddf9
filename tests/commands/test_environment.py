"""What the machine can do is found out in child processes, and a broken MUJOCO_GL is named."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from robot_ik.camera.drawing.probe import Probe, probe_display, probe_gl, run_probe
from robot_ik.commands.environment import import_mujoco
from robot_ik.errors import RobotIkError
from tests.waiting import LONG

# What PyOpenGL does without the OSMesa or EGL library (camera.md, 3.1).
_NO_LIBRARY = "raise AttributeError(\"'NoneType' object has no attribute 'glGetError'\")\n"


def test_probe_returns_what_the_child_prints() -> None:
    assert run_probe("print('yes')", timeout=LONG) == Probe(True, "yes")


def test_probe_returns_the_last_line_of_a_failure() -> None:
    probe = run_probe("raise AttributeError('no glGetError')", timeout=LONG)
    assert not probe.ok and probe.text == "AttributeError: no glGetError"
    probe = run_probe("raise SystemExit('no display')", timeout=LONG)
    assert not probe.ok and probe.text == "no display"


def test_probe_survives_an_abort() -> None:
    probe = run_probe("import os; os.abort()", timeout=LONG)
    assert not probe.ok and "signal 6" in probe.text


def test_probe_does_not_wait_for_ever_and_keeps_what_was_said(real_time: None) -> None:
    started = time.monotonic()
    code = "import time; print('first', flush=True); time.sleep(600)"
    probe = run_probe(code, timeout=2.0)
    assert not probe.ok and probe.text.startswith("first") and "no answer" in probe.text
    assert time.monotonic() - started < 300


def test_probe_takes_no_package_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mujoco.py").write_text("raise SystemExit('shadowed')")
    monkeypatch.chdir(tmp_path)
    assert run_probe("import mujoco; mujoco.MjModel", timeout=LONG).ok


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="DISPLAY is how X11 says it")
def test_no_display_is_seen_without_trying(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    probe = probe_display()
    assert not probe.ok and "DISPLAY" in probe.text


def test_mujoco_imports_here() -> None:
    assert import_mujoco().MjModel is not None


@pytest.mark.parametrize("command", [["solve", "--goal", "0", "0", "1"], ["robots", "puma560"]])
def test_impossible_mujoco_gl(command: list[str], robot_ik_child: Any) -> None:
    run = robot_ik_child(*command, MUJOCO_GL="bogus")
    run.assert_one_screen_error()
    assert "MUJOCO_GL=bogus" in run.err and "unset MUJOCO_GL" in run.err and "egl" in run.err


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="egl and osmesa are for Linux")
@pytest.mark.parametrize(("value", "package"), [("egl", "libegl1"), ("osmesa", "libosmesa6")])
def test_mujoco_gl_without_its_library(
    value: str, package: str, tmp_path: Path, robot_ik_child: Any
) -> None:
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text(_NO_LIBRARY)
    # PyOpenGL's own choice, which a test that drew leaves behind, would keep MuJoCo from trying.
    variables = {"MUJOCO_GL": value, "PYOPENGL_PLATFORM": "", "PYTHONPATH": str(tmp_path)}
    run = robot_ik_child("solve", "--goal", "0", "0", "1", **variables)
    run.assert_one_screen_error()
    for text in (
        f"MUJOCO_GL={value}",
        f"apt-get install --no-install-recommends {package}",
        "unset MUJOCO_GL",
    ):
        assert text in run.err, run.err


def test_help_works_with_a_broken_mujoco_gl(robot_ik_child: Any) -> None:
    run = robot_ik_child("--help", MUJOCO_GL="bogus")
    assert run.code == 0
    run = robot_ik_child("sim-bus", "--help", MUJOCO_GL="bogus")
    assert run.code == 0


def test_an_empty_mujoco_shell_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shell = type(sys)("mujoco")
    monkeypatch.setitem(sys.modules, "mujoco", shell)
    with pytest.raises(RobotIkError, match="two versions were mixed"):
        import_mujoco()


def test_probing_leaves_this_process_alone() -> None:
    before = dict(os.environ)
    probe_gl("bogus", timeout=LONG)
    assert dict(os.environ) == before
