"""The texts in the corners of MuJoCo's window: what the session does, and the keys."""

from __future__ import annotations

import textwrap
from typing import Any

import mujoco

from robot_ik.testbed.captions import ball_text, decision_text, mode_text
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.view import View

_LETTER_WIDTH = 9
"""Pixels of a letter at most."""

_ROW_HEIGHT = 23
"""Pixels from row to row."""

_FRAME = 24
"""Pixels around a table."""

_FIRST_COLUMN = 14
"""Letters of the first column of a table at most."""

_SMALLEST_COLUMN = 20
"""Letters of the second column, however narrow the window is."""

Rows = list[tuple[str, str]]


def window_texts(view: View, width: int, height: int, covered: int = 0) -> list[Any]:
    """Return the tables for ``Handle.set_texts``. They do not overlap.

    Args:
        view: What is shown.
        width: Of the window, pixels.
        height: Of the window, pixels.
        covered: Pixels of the lower right that a picture covers.
    """
    status = _broken(_status_rows(view), _letters(width))
    keys = _broken(_key_rows(), _letters(width - covered))
    font = mujoco.mjtFontScale.mjFONTSCALE_100
    corner = mujoco.mjtGridPos
    room = (height - 2 * _FRAME) // _ROW_HEIGHT
    status = status[: max(room, 1)]
    texts = [(font, corner.mjGRID_TOPLEFT, *_columns(status))]
    if len(status) + len(keys) <= room:
        texts.append((font, corner.mjGRID_BOTTOMLEFT, *_columns(keys)))
    return texts


def _letters(width: int) -> int:
    """Return the number of letters in the second column of a table of that width in pixels."""
    return max(width // _LETTER_WIDTH - _FIRST_COLUMN, _SMALLEST_COLUMN)


def _status_rows(view: View) -> Rows:
    rows = [("ball", ball_text(view)), ("mode", mode_text(view))]
    if view.figure is not None:
        rows.append(("decision", decision_text(view.figure)))
        rows.append(("action", view.figure.action))
        others = view.instances[1:]
    else:
        rows[1] = ("ball moves", view.motion)
        rows.append(("asks", view.kind))
        others = view.instances
    rows.append(("state", view.busy or view.state))
    first = len(view.instances) - len(others) + 1
    for k, one in enumerate(others, first):
        rows.append((f"{k} {one.method}", one.summary))
    if view.message:
        rows.append(("", view.message))
    return rows


def _key_rows() -> Rows:
    """Return the keys of each group in one row: the list of ``KEYMAP`` is too long for a window."""
    rows: Rows = []
    for group in dict.fromkeys(key.group for key in KEYMAP):
        keys = [key for key in KEYMAP if key.group == group and key.window]
        parts = [f"{key.window} {key.about.partition(';')[0]}" for key in keys]
        rows.append((group, ", ".join(parts)))
    return rows


def _broken(rows: Rows, letters: int) -> Rows:
    """Return the rows with the second column wrapped after a number of letters."""
    broken: Rows = []
    for left, right in rows:
        # MuJoCo's letters are ASCII.
        text = right.replace("°", " deg").encode("ascii", "replace").decode()
        lines = textwrap.wrap(text, letters) or [""]
        broken += [(left if k == 0 else "", line) for k, line in enumerate(lines)]
    return broken


def _columns(rows: Rows) -> tuple[str, str]:
    """Return the columns of a table as texts of lines."""
    return "\n".join(left for left, _ in rows), "\n".join(right for _, right in rows)
