"""The viewer window under a real X server: it opens, and the arm is seen to move."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.errors import ViewerError
from robot_ik.robot import load_robot
from robot_ik.testbed.frontends.window import WindowSink

#: A safety limit for everything that draws in software on a busy machine, seconds.
PATIENCE = 60.0

# Speaks one word a step and waits for a line before the next, so that the test looks at a still picture.
CHILD = """
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
with WindowSink(robot, start=rest) as window:
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
    window.show_goal(robot.forward(rest), length=0.5)
    step("goal")
    window.clear_goals()
    step("cleared")
    assert window.data.time == 0.0
    assert np.array_equal(window.data.qpos, robot.qpos(rest))
assert not window.is_running()
window.close()
window.send(rest, 0.04)
print("done", flush=True)
"""


@dataclass(frozen=True)
class Screen:
    """An X server whose frame buffer is a file."""

    display: str
    file: Path

    def shot(self) -> Any:
        """The whole screen, (h, w, 3) uint8; the file is in XWD format, version 7."""
        raw = self.file.read_bytes()
        header = np.frombuffer(raw[:100], ">u4")
        size, width, height, stride, colours = (int(header[k]) for k in (0, 4, 5, 12, 19))
        pixels = np.frombuffer(raw, np.uint8, stride * height, size + 12 * colours)
        return pixels.reshape(height, stride // 4, 4)[:, :width, :3].copy()

    def settled(self, differs_from: Any = None) -> Any:
        """A picture that has stopped changing and is not ``differs_from`` (or not black)."""
        deadline = time.monotonic() + PATIENCE
        last = self.shot()
        while time.monotonic() < deadline:
            time.sleep(0.7)
            now = self.shot()
            fresh = now.max() > 0 if differs_from is None else changed(now, differs_from) > 0
            if fresh and changed(now, last) == 0:
                return now
            last = now
        pytest.fail("the picture did not change, or never came to rest")


def changed(a: Any, b: Any) -> int:
    """Number of pixels that differ."""
    return int((a != b).any(axis=-1).sum())


@pytest.fixture
def screen(require: Callable[..., str], tmp_path: Path) -> Iterator[Screen]:
    """A display of its own, on a number that the server finds free by itself."""
    xvfb = require("xvfb", "opens the viewer window")
    reading, writing = os.pipe()
    command = [xvfb, "-displayfd", str(writing), "-screen", "0", "480x360x24", "-nolisten", "tcp"]
    server = subprocess.Popen(
        [*command, "-fbdir", str(tmp_path)], pass_fds=[writing], stderr=subprocess.DEVNULL
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as pipe:
            number = pipe.readline().strip()
        assert number, "Xvfb did not start"
        yield Screen(f":{number}", tmp_path / "Xvfb_screen0")
    finally:
        server.terminate()
        server.wait(20)


@pytest.fixture
def viewer_process(screen: Screen) -> Iterator[subprocess.Popen[str]]:
    environment = {
        **os.environ,
        "DISPLAY": screen.display,
        "LIBGL_ALWAYS_SOFTWARE": "1",
        "LP_NUM_THREADS": "1",
    }
    environment.pop("MUJOCO_GL", None)
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD],
        env=environment,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def test_the_arm_is_seen_to_move(screen: Screen, viewer_process: subprocess.Popen[str]) -> None:
    child = viewer_process
    assert child.stdin is not None and child.stdout is not None and child.stderr is not None

    def reach(word: str) -> None:
        said = child.stdout.readline().strip()  # type: ignore[union-attr]
        assert said == word, said or child.stderr.read()  # type: ignore[union-attr]

    def go_on() -> None:
        child.stdin.write("\n")  # type: ignore[union-attr]
        child.stdin.flush()  # type: ignore[union-attr]

    reach("open")
    first = screen.settled()
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 50  # a shaded picture, not a flat window
    go_on()
    reach("rested")
    time.sleep(1.0)
    assert changed(screen.shot(), first) == 0  # nothing moves by itself: what follows is the arm
    go_on()
    reach("moved")
    moved = screen.settled(differs_from=first)
    assert changed(moved, first) > 300
    go_on()
    reach("back")
    assert changed(screen.settled(differs_from=moved), first) == 0
    go_on()
    reach("goal")
    with_goal = screen.settled(differs_from=first)
    assert 10 < changed(with_goal, first) < changed(moved, first)
    go_on()
    reach("cleared")
    assert changed(screen.settled(differs_from=with_goal), first) == 0
    go_on()
    reach("done")
    assert child.wait(PATIENCE) == 0


def test_without_a_display_it_says_what_to_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if not sys.platform.startswith("linux"):
        pytest.skip("only X11 and Wayland announce themselves in the environment")
    with pytest.raises(ViewerError) as caught:
        WindowSink(load_robot("puma560"))
    assert "DISPLAY" in str(caught.value) and "--view" in caught.value.hint


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X11")
def test_a_display_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":987654")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match="no window can be opened"):
        WindowSink(load_robot("puma560"))


# Shows a scene as `reach --view` does, and ends when its window is closed.
SCENE = """
import sys, threading
import numpy as np
from robot_ik.jobs.reach import scene_solids
from robot_ik.jobs.scene import scene_for
from robot_ik.robot import load_robot
from robot_ik.testbed.frontends.window import WindowSink

robot = load_robot(sys.argv[1])
scene = scene_for(robot)
marker = scene.pose_world_marker
see = np.vstack([marker.position, marker.compose(scene.pose_marker_tool).position])
with WindowSink(robot, solids=scene_solids(scene), see=see, eye=scene.pose_world_camera.position) as window:
    scene = window._viewer.user_scn
    assert user.ngeom > 8, "floor, table, paper, square, cells"
    window.show_goal(marker.compose(scene.pose_marker_tool))
    assert user.ngeom == window._fixed + 3
    window.clear_goals()
    assert user.ngeom == window._fixed
    # everything within the cone of view, seen from where the camera stands
    camera, model = window._viewer.cam, window._model
    azimuth, elevation = np.deg2rad([camera.azimuth, camera.elevation])
    ahead = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    place = camera.lookat - camera.distance * np.array(ahead)
    for point in [*window.data.geom_xpos, *see]:
        way = point - place
        angle = np.arccos(way @ ahead / np.linalg.norm(way))
        assert angle < 0.5 * np.deg2rad(model.vis.global_.fovy), (point, angle)
    threading.Timer(1.0, window._viewer.close).start()
    window.wait()
print("closed", flush=True)
"""


@pytest.mark.parametrize("name", ["puma560", "panda"])
def test_the_scene_is_there_and_the_window_stays_until_it_is_closed(name: str, screen: Screen) -> None:
    environment = {
        **os.environ,
        "DISPLAY": screen.display,
        "LIBGL_ALWAYS_SOFTWARE": "1",
        "LP_NUM_THREADS": "1",
    }
    environment.pop("MUJOCO_GL", None)
    done = subprocess.run(
        [sys.executable, "-c", SCENE, name],
        env=environment, text=True, capture_output=True, timeout=3 * PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout == "closed\n", done.stderr
