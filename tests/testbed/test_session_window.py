"""The testbed in MuJoCo's window, under a real X server: keys and the mouse reach the session."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable

from tests.testbed.test_window import PATIENCE, Screen, screen  # noqa: F401 (a fixture)

# The loop runs here; what the session got is said at the end.
CHILD = """
import subprocess, sys, threading, time
import numpy as np
from robot_ik.testbed.commands import Start
from robot_ik.testbed.session import Session, run
from robot_ik.testbed.frontends.window import SessionWindow

def act(*words):
    subprocess.run(["xdotool", *map(str, words)], check=True)
    time.sleep(0.6)

def until(holds, what):
    end = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < end, what
        time.sleep(0.05)

session = Session(Start("tabletop_puma"), beside=False)
stop, failed = threading.Event(), []

def person():
    try:
        until(lambda: window._view.tick > 20, "no tick")
        act("mousemove", 240, 180)
        time.sleep(1.0)
        act("key", "space")
        until(lambda: not window._view.running, "space did not pause")
        act("key", "space")
        act("key", "Up")
        until(lambda: window._view.motion == "hand", "an arrow did not move the ball")
        before = window._view.ball.position
        act("key", "w")
        until(lambda: window._view.ball.position[2] > before[2] + 0.01, "W did not lift the ball")
        flags = window._viewer.opt.flags.copy()
        assert (flags == window._kept[0]).all(), "W switched a flag of MuJoCo, too"
        before = window._view.ball.position
        act("keydown", "ctrl", "mousedown", 3)
        act("mousemove_relative", "--", 30, -20)
        act("mousemove_relative", "--", 10, -10)
        act("mouseup", 3, "keyup", "ctrl")
        until(lambda: np.linalg.norm(window._view.ball.position - before) > 0.005, "Ctrl-drag did nothing")
        until(lambda: window._view.instances[0].miss < 0.5, "the arm did not follow")
        act("key", "r")
        until(lambda: window._view.motion == "curve", "R did not reset")
        act("key", "4")
        until(lambda: window._view.count == 4 and window._viewer.user_scn.ngeom > 20, "no four arms")
        act("key", "Up")
        until(lambda: window._view.motion == "hand", "four arms: an arrow did not move the ball")
        act("key", "r")
        until(lambda: window._view.motion == "curve", "four arms: R did not reset")
    except BaseException as error:
        failed.append(error)
    finally:
        stop.set()

with SessionWindow(session) as window:
    thread = threading.Thread(target=person)
    thread.start()
    run(session, window.draw, stop)
    thread.join()
if failed:
    raise failed[0]
print("done", flush=True)
"""


def test_keys_and_mouse_reach_the_session(
    screen: Screen,  # noqa: F811
    require: Callable[..., str],
) -> None:
    require("xvfb", "xdotool is not installed", present=shutil.which("xdotool") is not None)
    environment = {**os.environ, "DISPLAY": screen.display, "LIBGL_ALWAYS_SOFTWARE": "1"}
    environment.pop("MUJOCO_GL", None)
    done = subprocess.run(
        [sys.executable, "-c", CHILD],
        env=environment, text=True, capture_output=True, timeout=2 * PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout == "done\n", done.stderr[-3000:]
