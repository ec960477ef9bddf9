"""The keys of the testbed: one table for the page and for MuJoCo's window.

The keys are those of the first thesis (Pađen 2011): up and down move the ball along y, left and
right along x, W and S in height. Space starts, R resets, I changes the mode, L shows the overlay.
On the page they replace viser's camera keys. While a method solves, the arrow keys of the page move
the ball relative to the view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

import robot_ik as rik
from robot_ik.testbed.commands import (
    COUNTS,
    GOAL_KINDS,
    MOTIONS,
    Act,
    Command,
    Nudge,
    PlayTimeline,
    RecordPose,
    Reset,
    SetCount,
    SetFigure,
    SetGoalKind,
    SetLimits,
    SetMethod,
    SetMotion,
    SetRunning,
    ShowBranches,
)
from robot_ik.testbed.view import View

STEP = 0.02
"""Metres of one nudge of the ball by a key of the window."""

Group = Literal["Ball", "Run", "Compare", "Show"]
Value = TypeVar("Value")


@dataclass(frozen=True)
class Key:
    """One key.

    Attributes:
        about: What it does.
        group: Heading in the list of keys.
        code: Its ``KeyboardEvent.code`` on the page. Empty: the page has no such key.
        window: Its name in MuJoCo's window. Empty: the window has no such key.
        command: Returns the command for a view. None: the front end executes the key.
        label: Text of the key on the page.
    """

    about: str
    group: Group
    code: str = ""
    window: str = ""
    command: Callable[[View], Command] | None = None
    label: str = ""


def next_of(values: tuple[Value, ...], value: object) -> Value:
    """Return the next value of a cycle, or the first one if ``value`` is not in it."""
    return values[(values.index(value) + 1) % len(values) if value in values else 0]


def _start(view: View) -> Command:
    if view.figure is not None and view.figure.mode == "passive":
        return Act()
    return SetRunning(not view.running)


def _change_mode(view: View) -> Command:
    if view.figure is not None:
        return SetFigure("passive" if view.figure.mode == "active" else "active")
    return SetMotion(next_of(MOTIONS, view.motion))


def _change_figure(view: View) -> Command:
    return SetFigure("active" if view.figure is None else "off")


def _change_method(view: View) -> Command:
    return SetMethod(0, next_of(tuple(rik.SOLVERS), view.instances[0].method))


def _play(view: View) -> Command:
    return PlayTimeline(not view.timeline.playing)


def _nudge(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[View], Command]:
    return lambda view: Nudge((x * STEP, y * STEP, z * STEP))  # noqa: ARG005 (a command of Key)


def _count(count: int) -> Callable[[View], Command]:
    return lambda view: SetCount(COUNTS[count])  # noqa: ARG005 (a command of Key)


KEYMAP: tuple[Key, ...] = (
    Key("ball +y; away, if a method solves", "Ball", "ArrowUp", "Up", _nudge(y=1.0), "↑"),
    Key("ball -y; near, if a method solves", "Ball", "ArrowDown", "Down", _nudge(y=-1.0), "↓"),
    Key("ball -x; left, if a method solves", "Ball", "ArrowLeft", "Left", _nudge(x=-1.0), "←"),
    Key("ball +x; right, if a method solves", "Ball", "ArrowRight", "Right", _nudge(x=1.0), "→"),
    Key("ball up, +z", "Ball", "KeyW", "W", _nudge(z=1.0), "W"),
    Key("ball down, -z", "Ball", "KeyS", "S", _nudge(z=-1.0), "S"),
    Key(
        "figure: active, passive; else curve, random, hand", "Ball", "KeyI", "I", _change_mode, "I"
    ),
    Key("arrows, W and S move the camera, or the ball", "Ball", "KeyC", "", None, "C"),
    Key("start, pause; a passive figure acts", "Run", "Space", "Space", _start, "Space"),
    Key("STOP; close a dialog", "Run", "Escape", "", None, "Esc"),
    Key("a figure decides, or a method solves", "Run", "KeyF", "F", _change_figure, "F"),
    Key("reset robot and ball", "Run", "KeyR", "R", lambda _: Reset(), "R"),
    Key("record the pose", "Run", "KeyP", "P", lambda _: RecordPose(), "P"),
    Key("play the timeline, stop it", "Run", "Enter", "", _play, "Enter"),
    Key("one robot", "Compare", "Digit1", "1", _count(0), "1"),
    Key("compare two", "Compare", "Digit2", "2", _count(1), "2"),
    Key("compare four", "Compare", "Digit4", "4", _count(2), "4"),
    Key("next method of robot 1", "Compare", "KeyM", "M", _change_method, "M"),
    Key(
        "next kind of goal",
        "Compare",
        "KeyK",
        "K",
        lambda view: SetGoalKind(next_of(GOAL_KINDS, view.kind)),
        "K",
    ),
    Key(
        "joint limits on, off", "Compare", "KeyO", "O", lambda view: SetLimits(not view.limits), "O"
    ),
    Key(
        "branches of robot 1",
        "Compare",
        "KeyB",
        "B",
        lambda view: ShowBranches(not view.show_branches),
        "B",
    ),
    Key("overlay on, off", "Show", "KeyL", "L", None, "L"),
    Key("robot in the camera's picture on, off", "Show", "KeyX", "X", None, "X"),
    Key("camera picture on, off", "Show", "KeyV", "", None, "V"),
    Key("gallery of robots", "Show", "KeyG", "", None, "G"),
    Key("side panel on, off", "Show", "Backslash", "", None, "\\"),
    Key("all keys", "Show", "Slash", "", None, "?"),
)
"""Every key, once."""
