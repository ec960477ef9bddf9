"""What MuJoCo's window shows: the robot in its scene, tables that do not overlap, the figure."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue
from robot_ik.testbed.commands import MoveGoal, SetFigure, Start
from robot_ik.testbed.frontends.window_scene import WindowScene
from robot_ik.testbed.frontends.window_texts import window_texts
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.session import Session
from tests.testbed.conftest import Windows

ROW = 23
"""Pixels of a row of MuJoCo's tables at 100 %, measured in its window."""

LETTER = 9
"""Pixels of a letter at most, likewise."""


@pytest.mark.parametrize("name", catalogue())
def test_the_window_stands_the_robot_on_a_floor_with_light(name: str) -> None:
    robot = load_robot(name)
    scene = WindowScene(robot)
    model = scene.model
    joints = [robot.model.joint(j).name for j in range(robot.model.njnt)]
    assert [model.joint(j).name for j in range(len(joints))] == joints
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    assert len(planes) >= 1
    if (robot.path.parent / "scene.xml").is_file():
        assert model.nlight >= 1, "the scene's light is missing"
    data = mujoco.MjData(model)
    data.qpos[: robot.model.nq] = robot.qpos(robot.home)
    mujoco.mj_kinematics(model, data)
    tool = robot.measure(robot.home)
    frame = robot.frame(robot.tool)
    body = model.body(robot.model.body(frame.body).name).id
    rotation = data.xmat[body].reshape(3, 3)
    assert np.allclose(data.xpos[body] + rotation @ frame.local.position, tool.position)


def test_tables_of_four_robots_do_not_overlap() -> None:
    scene = WindowScene(load_robot("tabletop_puma"))
    model = scene.model
    names = [model.geom(g).name for g in range(model.ngeom)]
    table = names.index("table_top")
    floor = names.index("floor")
    alone = model.geom_pos[floor, 2]
    scene.seat(4)
    assert model.geom_rgba[table, 3] == 0.0, "four tables would lie in each other"
    assert alone < model.geom_pos[floor, 2] <= 0.0, "the robots float"
    scene.seat(1)
    assert model.geom_rgba[table, 3] == 1.0 and model.geom_pos[floor, 2] == alone


@pytest.mark.parametrize(("width", "height"), [(853, 533), (1280, 800), (480, 360)])
@pytest.mark.parametrize("covered", [0, 355])
def test_status_and_keys_are_not_over_each_other(width: int, height: int, covered: int) -> None:
    with Session(Start("tabletop_puma", count=4), beside=False) as session:
        for _ in range(70):
            session.tick()
        session.report(
            "a message that is long enough to need more than one line of the window " * 2
        )
        texts = window_texts(session.view(), width, height, covered)
    rows = [max(len(column.split("\n")) for column in text[2:]) for text in texts]
    assert sum(rows) * ROW <= height
    for k, (_, corner, left, right) in enumerate(texts):
        assert (left + right).isascii()
        letters = max(map(len, left.split("\n"))) + max(map(len, right.split("\n")))
        room = width if k == 0 else width - covered
        assert letters * LETTER <= room + 14 * LETTER or letters <= 40
        assert corner in (mujoco.mjtGridPos.mjGRID_TOPLEFT, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT)
    if (width, covered) == (853, 0):
        keys = texts[1][3]
        assert all(key.window in keys for key in KEYMAP if key.window), "a key is not shown"


def test_the_table_names_mode_decision_and_reason() -> None:
    with Session(Start("humanoid"), beside=False) as session:
        for command in (SetFigure("active"), MoveGoal((0.45, -0.3, 1.25))):
            session.send(command)
        for _ in range(30):
            session.tick()
        view = session.view()
        assert view.figure is not None
        text = window_texts(view, 1280, 800)[0][3].replace("\n", " ")
    assert "active: the figure follows the ball" in text
    assert view.figure.decision.reason in text and "+0.45" in text


# The loop runs here. The program prints the commands of the session at its end.
PERSON = """
import subprocess, threading, time
import numpy as np
from robot_ik.testbed.commands import MoveGoal, Start
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.frontends.session_window import SessionWindow

BALL = (0.45, -0.3, 1.25)

def key(name):
    subprocess.run(["xdotool", "key", name], check=True)

def until(holds, what):
    end = time.monotonic() + 300.0
    while not holds():
        assert time.monotonic() < end, what
        time.sleep(0.05)

def moved(axis, sign):
    step = window._view.ball.position - BALL
    return sign * step[axis] > 0.01

def mode():
    figure = window._view.figure
    return figure.mode if figure is not None else "off"

session = Session(Start("humanoid"), beside=False)
stop, failed = threading.Event(), []

def person():
    try:
        until(lambda: window._view.tick > 3, "no tick")
        subprocess.run(["xdotool", "mousemove", "240", "180"], check=True)
        time.sleep(0.5)  # keys go to the window under the mouse
        key("f")
        until(lambda: mode() == "active", "F does not let the figure decide")
        for name, axis, sign in (("Up", 1, 1.0), ("Left", 0, -1.0), ("w", 2, 1.0)):
            session.send(MoveGoal(BALL))
            until(lambda: np.allclose(window._view.ball.position, BALL), "the ball does not come")
            key(name)
            until(lambda: moved(axis, sign), name + " does not move the ball along its axis")
        key("i")
        until(lambda: mode() == "passive", "I does not change the mode")
        until(lambda: window._view.figure.waiting, "it does not wait")
        key("space")
        until(lambda: window._view.figure.locked, "Space does not start")
        ball = window._view.ball.position
        key("w")
        until(lambda: "locked" in window._view.message, "the ball is not locked")
        assert np.array_equal(window._view.ball.position, ball)
        key("r")
        until(lambda: not window._view.figure.locked, "R does not reset")
        key("x")
        until(lambda: window._ar is not None and window._ar._picture is not None, "no picture")
        key("f")
        until(lambda: mode() == "off", "F does not end it")
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


def test_the_figure_decides_in_the_window_by_keys(
    windows: Windows, require: Callable[..., str]
) -> None:
    require("xvfb", "xdotool is not installed", present=shutil.which("xdotool") is not None)
    assert windows.run(PERSON) == []
