"""Settings for all tests: optional programs of the machine, hypothesis, time limits."""

import gc
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Protocol

import dynamixel_sdk.port_handler
import pytest
from hypothesis import settings

# The tests must not depend on the width of the terminal, which pytest-xdist hands on.
os.environ.pop("COLUMNS", None)

# In the background of a shell or under nohup a process and its children ignore signals. Tests of
# signals need them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Virtual servos answer in real time, on threads of the tests' processes, which must not wait long.
sys.setswitchinterval(5e-4)
gc.set_threshold(50_000, 20, 50)
# The official SDK gives an answer 34 ms, too little for a busy machine.
dynamixel_sdk.port_handler.LATENCY_TIMER = 120

# No deadline: the first example of a law compiles its kernel, and the machine may be busy. The
# suite has the same examples every time, so a failure is caused by a change. `make explore` draws
# new ones.
settings.register_profile(
    "robot_ik", max_examples=30, deadline=None, print_blob=True, derandomize=True
)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile(os.environ.get("ROBOT_IK_EXAMPLES", "robot_ik"))


@pytest.fixture(scope="module", autouse=True)
def _freeze_old_objects() -> Iterator[None]:
    """Exclude the objects that a test file leaves behind from garbage collection.

    They are millions of a compiler's objects. Each search stopped the process, and virtual servos
    with it, for up to 1.5 s: a third of a minute in all.
    """
    yield
    gc.collect()
    gc.freeze()


DEMANDED = "ROBOT_IK_REQUIRE"

RENDER = """
import mujoco
renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
renderer.render()
"""


class Require(Protocol):
    """Skips the test, or fails it if ROBOT_IK_REQUIRE names the missing program."""

    def __call__(self, name: str, reason: str = "", *, present: bool | None = None) -> str: ...


def _find_browser() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


def _find_gl() -> str | None:
    """Return the first MUJOCO_GL that renders off-screen.

    Each is tried in a child process, because a failing one may abort its process.
    """
    asked = os.environ.get("MUJOCO_GL")
    for backend in [asked] if asked else ["egl", "osmesa"]:
        child = subprocess.run(
            [sys.executable, "-c", RENDER],
            env=os.environ | {"MUJOCO_GL": backend},
            capture_output=True,
        )
        if child.returncode == 0:
            return backend
    return None


def _find_opencv4() -> str | None:
    import cv2

    return cv2.__version__ if cv2.__version__.startswith("4.") else None


def _find_xvfb() -> str | None:
    return shutil.which("Xvfb")


PROBES: dict[str, tuple[Callable[[], str | None], str]] = {
    "browser": (_find_browser, "no Chromium or Chrome"),
    "gl": (_find_gl, "MuJoCo cannot render off-screen: neither EGL nor OSMesa works"),
    "opencv4": (_find_opencv4, "this is not OpenCV 4 (make test-opencv4)"),
    "xvfb": (_find_xvfb, "no Xvfb"),
}


@cache
def _find(name: str) -> str | None:
    return PROBES[name][0]()


def _beside(name: str) -> ModuleType:
    """Return a module of this folder, which is neither a package nor on the path."""
    spec = spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _demanded() -> set[str]:
    return {name.strip() for name in os.environ.get(DEMANDED, "").split(",") if name.strip()}


def pytest_configure(config: pytest.Config) -> None:
    """Refuse an unknown name in the demands; register the plugins beside this file."""
    for name in ("goal_recorder", "real_time"):
        config.pluginmanager.register(_beside(name), name)
    if unknown := _demanded() - PROBES.keys():
        raise pytest.UsageError(f"{DEMANDED} names {sorted(unknown)}; known are {sorted(PROBES)}")


@pytest.fixture(scope="session")
def require() -> Require:
    """``require("xvfb")`` skips a test without Xvfb, or fails it if Xvfb is demanded.

    It returns the path of Xvfb or of the browser, the MUJOCO_GL that works off-screen, or the
    version of OpenCV. A test that has searched itself gives ``present`` and the ``reason``.
    """

    def require(name: str, reason: str = "", *, present: bool | None = None) -> str:
        if name not in PROBES:
            raise LookupError(f"require({name!r}): known are {sorted(PROBES)}")
        found = _find(name) if present is None else "yes" if present else None
        if found is not None:
            return found
        message = f"needs {name}: {reason or PROBES[name][1]}"
        if name in _demanded():
            pytest.fail(f"{message}; {DEMANDED} demands it", pytrace=False)
        pytest.skip(message)

    return require
