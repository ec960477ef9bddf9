"""The viewer window under a real X server: it opens, and the arm is seen to move."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from robot_ik.errors import ViewerError
from robot_ik.robot import load_robot
from robot_ik.testbed.commands import Start
from robot_ik.testbed.frontends.session_window import SessionWindow
from robot_ik.testbed.frontends.window import WindowSink
from robot_ik.testbed.loop import replayed
from robot_ik.testbed.session import Session
from tests.testbed.conftest import Screen, Windows, changed
from tests.testbed.test_frontends import SCRIPT

# Prints one word a step and waits for a line, so that the test gets a picture at rest.
MOVED = """
import sys
import numpy as np
from robot_ik.geometry import Pose
from robot_ik.ports import JointSink
from robot_ik.robot import load_robot
from robot_ik.testbed.frontends.window import WindowSink

def step(word):
    print(word, flush=True)
    sys.stdin.readline()

robot = load_robot("puma560")
rest = np.array(robot.home)
with WindowSink(robot, start=rest, ball=0.1) as window:
    assert isinstance(window, JointSink)
    step("open")
    window.send(rest, 0.01)
    step("rested")
    moved = rest + np.array([0.8, 0.4, -0.4, 0.0, 0.3, 0.0])
    kept = moved.copy()
    window.send(moved, 0.02)
    assert (moved == kept).all()
    step("moved")
    window.send(rest, 0.03)
    step("back")
    window.show_goal(robot.forward(rest))
    step("goal")
    window.show_ball(robot.forward(rest).position)
    window.send(rest, 0.05)
    step("ball")
    window.show_ball(np.full(3, np.nan))
    window.send(rest, 0.06)
    step("no ball")
    window.show_text("reach", "the right hand reaches the ball standing")
    step("text")
    assert window.data.time == 0.0
    assert np.array_equal(window.data.qpos, robot.qpos(rest))
assert not window.is_running()
window.close()
window.send(rest, 0.04)
"""


def test_the_arm_is_seen_to_move(screen: Screen, windows: Windows) -> None:
    windows.start(MOVED)
    assert windows.line() == "open"
    first = screen.settled()
    windows.say()
    assert windows.line() == "rested"
    time.sleep(0.5)
    assert changed(screen.shot(), first) == 0  # nothing moves by itself: what follows is the arm
    windows.say()
    assert windows.line() == "moved"
    moved = screen.settled(differs_from=first)
    assert changed(moved, first) > 300
    windows.say()
    assert windows.line() == "back"
    assert changed(screen.settled(differs_from=moved), first) == 0
    windows.say()
    assert windows.line() == "goal"
    with_goal = screen.settled(differs_from=first)
    assert 10 < changed(with_goal, first) < changed(moved, first)
    windows.say()
    assert windows.line() == "ball"
    with_ball = screen.settled(differs_from=with_goal)
    assert changed(with_ball, with_goal) > 100
    windows.say()
    assert windows.line() == "no ball"
    assert changed(screen.settled(differs_from=with_ball), with_goal) == 0
    windows.say()
    assert windows.line() == "text"
    assert changed(screen.settled(differs_from=with_goal), with_goal) > 100
    windows.say()
    assert windows.line() == "=== done"


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("only X11 and Wayland announce themselves in the environment")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def test_without_a_display_it_says_what_to_run(no_display: None) -> None:
    with pytest.raises(ViewerError) as caught:
        WindowSink(load_robot("puma560"))
    assert "DISPLAY" in str(caught.value) and "--view" in caught.value.hint
    with pytest.raises(ViewerError) as caught:
        WindowSink(load_robot("puma560"), instead="run something else")
    assert caught.value.hint.startswith("run something else\n")
    # The testbed names its own options.
    with Session(Start(), beside=False) as session, pytest.raises(ViewerError) as caught:
        SessionWindow(session)
    assert "--viewer browser" in caught.value.hint and "--view:" not in caught.value.hint


def test_a_display_that_does_not_answer(no_display: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":987654")
    with pytest.raises(ViewerError, match="no window can be opened"):
        WindowSink(load_robot("puma560"))


# Shows a scene as `reach --view` does, and ends when its window is closed.
SCENE = """
import threading
import numpy as np
from robot_ik.testbed.frontends.scene_window import scene_solids
from robot_ik.workcell.scene import scene_for
from robot_ik.robot import load_robot
from robot_ik.testbed.frontends.window import WindowSink

robot = load_robot("NAME")
scene = scene_for(robot)
marker = scene.pose_world_marker
see = np.vstack([marker.position, marker.compose(scene.pose_marker_tool).position])
viewpoint = scene.pose_world_camera.position
with WindowSink(robot, solids=scene_solids(scene), see=see, viewpoint=viewpoint) as window:
    user = window._viewer.user_scn
    assert user.ngeom > 8, "floor, table, paper, square, cells"
    before = user.ngeom
    window.show_goal(marker.compose(scene.pose_marker_tool))
    assert user.ngeom == before + 3
    # everything within the cone of view, seen from where the camera stands
    camera, model = window._viewer.cam, window._model
    azimuth, elevation = np.deg2rad([camera.azimuth, camera.elevation])
    level = np.cos(elevation)
    ahead = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    place = camera.lookat - camera.distance * np.array(ahead)
    for point in [*window.data.geom_xpos, *see]:
        way = point - place
        angle = np.arccos(way @ ahead / np.linalg.norm(way))
        assert angle < 0.5 * np.deg2rad(model.vis.global_.fovy), (point, angle)
    threading.Timer(0.5, window._viewer.close).start()
    window.wait()
print("closed", flush=True)
"""


@pytest.mark.parametrize("name", ["puma560", pytest.param("panda", marks=pytest.mark.soak)])
def test_the_scene_is_there_and_the_window_stays_until_it_is_closed(
    name: str, windows: Windows
) -> None:
    assert windows.run(SCENE.replace("NAME", name)) == ["closed"]


SHOWN = """
from pathlib import Path
from robot_ik.testbed.commands import CommandLog
from robot_ik.testbed.frontends.session_window import SessionWindow
from robot_ik.testbed.loop import replayed

window = None
for session in replayed(CommandLog.load(Path("LOG"))):
    window = window or SessionWindow(session)
    window.draw(session.view())
print(session.view().digest(), flush=True)
window.close()
"""


def test_the_same_script_gives_the_same_view_in_the_window(
    windows: Windows, tmp_path: Path
) -> None:
    SCRIPT.save(tmp_path / "script.jsonl")
    *_, session = replayed(SCRIPT)
    assert windows.run(SHOWN.replace("LOG", str(tmp_path / "script.jsonl"))) == [
        session.view().digest()
    ]


# The loop runs here. The program prints the commands of the session at its end.
PERSON = """
import subprocess, sys, threading, time
import numpy as np
from robot_ik.testbed.commands import Start
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.frontends.session_window import SessionWindow

def act(*words, rest=0.0):
    subprocess.run(["xdotool", *map(str, words)], check=True)
    time.sleep(rest)

def until(holds, what):
    end = time.monotonic() + 300.0
    while not holds():
        assert time.monotonic() < end, what
        time.sleep(0.05)

def dragged(before):
    # The viewer looks at the mouse once a frame, and a frame may take long: until one has seen it.
    act("mousemove", 240, 180, "keydown", "ctrl", "mousedown", 3, rest=0.4)
    act("mousemove_relative", "--", 30, -20, rest=0.4)
    act("mousemove_relative", "--", 10, -10, rest=0.4)
    act("mouseup", 3, "keyup", "ctrl", rest=0.1)
    return np.linalg.norm(window._view.ball.position - before) > 0.005

session = Session(Start("tabletop_puma"), beside=False)
stop, failed = threading.Event(), []

def person():
    try:
        until(lambda: window._view.tick > 20, "no tick")
        act("mousemove", 240, 180, rest=0.5)  # keys go to the window under the mouse
        act("key", "space")
        until(lambda: not window._view.running, "space did not pause")
        act("key", "space")
        until(lambda: window._view.running, "space did not go on")
        act("key", "Up")
        until(lambda: window._view.motion == "hand", "an arrow did not move the ball")
        before = window._view.ball.position
        act("key", "w")
        until(lambda: window._view.ball.position[2] > before[2] + 0.01, "W did not lift the ball")
        flags = window._viewer.opt.flags.copy()
        assert (flags == window._kept[0]).all(), "W switched a flag of MuJoCo, too"
        before = window._view.ball.position
        until(lambda: dragged(before), "Ctrl-drag did nothing")
        until(lambda: window._view.instances[0].error < 0.5, "the arm did not follow")
        act("key", "r")
        until(lambda: window._view.motion == "curve", "R did not reset")
        act("key", "4")
        scene = window._viewer.user_scn
        until(lambda: window._view.count == 4 and scene.ngeom > 20, "no four arms")
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
"""


def test_keys_and_mouse_reach_the_session(windows: Windows, require: Callable[..., str]) -> None:
    require("xvfb", "xdotool is not installed", present=shutil.which("xdotool") is not None)
    assert windows.run(PERSON) == []
