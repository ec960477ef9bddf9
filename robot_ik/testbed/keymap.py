"""Keys of every front end in one table; their help is made from it.

The window has the keys of the first thesis.  The browser's page cannot: its 3D view moves the camera with
W A S D Q E and the arrows, and has no switch for that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from robot_ik.testbed.commands import (
    COUNTS,
    GOAL_KINDS,
    MOTIONS,
    Command,
    Nudge,
    Reset,
    SetCount,
    SetGoalKind,
    SetLimits,
    SetMethod,
    SetMotion,
    SetRunning,
    ShowBranches,
)
from robot_ik.testbed.session import View

STEP = 0.02
"""Metres of one nudge of the ball."""
# In the order in which a key goes through them where there is no menu.
_CYCLE = ("dls", "lm", "analytic", "sdls", "pseudoinverse", "transpose", "bfgs", "ccd", "fabrik")


@dataclass(frozen=True)
class Key:
    """One row of ``KEYMAP``.

    Attributes:
        about: What it does, as text.
        browser: The key on the page; empty: none, because a control is there.
        window: The key in MuJoCo's window; empty: none.
        command: What it asks for, in this state; None: the front end shows or hides its overlay.
    """

    about: str
    browser: str
    window: str
    command: Callable[[View], Command] | None


def _next(value: object, values: tuple[object, ...]) -> int:
    return (values.index(value) + 1) % len(values) if value in values else 0


def _next_method(view: View) -> Command:
    return SetMethod(0, _CYCLE[_next(view.instances[0].method, _CYCLE)])


def _next_kind(view: View) -> Command:
    return SetGoalKind(GOAL_KINDS[_next(view.kind, GOAL_KINDS)])


def _next_motion(view: View) -> Command:
    return SetMotion(MOTIONS[_next(view.motion, MOTIONS)])


KEYMAP: tuple[Key, ...] = (
    Key("start / pause", "space", "Space", lambda view: SetRunning(not view.running)),
    Key("reset", "R", "R", lambda view: Reset()),
    Key("ball: curve, random, by hand", "I", "I", _next_motion),
    Key("one robot", "1", "1", lambda view: SetCount(COUNTS[0])),
    Key("compare two", "2", "2", lambda view: SetCount(COUNTS[1])),
    Key("compare four", "4", "4", lambda view: SetCount(COUNTS[2])),
    Key("next method of robot 1", "M", "M", _next_method),
    Key("next kind of goal", "K", "K", _next_kind),
    Key("joint limits on / off", "O", "O", lambda view: SetLimits(not view.limits)),
    Key("branches of robot 1", "B", "B", lambda view: ShowBranches(not view.show_branches)),
    Key("ball along +x", "T", "Up", lambda view: Nudge((STEP, 0.0, 0.0))),
    Key("ball along -x", "G", "Down", lambda view: Nudge((-STEP, 0.0, 0.0))),
    Key("ball along +y", "F", "Left", lambda view: Nudge((0.0, STEP, 0.0))),
    Key("ball along -y", "H", "Right", lambda view: Nudge((0.0, -STEP, 0.0))),
    Key("ball up", "Y", "W", lambda view: Nudge((0.0, 0.0, STEP))),
    Key("ball down", "N", "S", lambda view: Nudge((0.0, 0.0, -STEP))),
    Key("trails and labels / overlay on, off", "L", "L", None),
)
"""Every key, once."""
