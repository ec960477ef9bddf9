"""Sheets to print at true scale, with bars to check it, the command that made them and one to use them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.sheets.blocks import MAKERS, QUIET, Block, Maker, Room, SheetWish, moved
from robot_ik.camera.sheets.page import LETTER_WIDTH, Page, Words
from robot_ik.errors import CameraError

Array = NDArray[np.float64]

#: Paper, mm, upright.
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0)}
# Printers leave about 5 mm white.
_MARGIN = 7.0
# The bar, the lines of text under it, and the upright bar at the right, mm.
_FOOT, _SIDE = 14.0, 6.0
_BAR, _TICK = 100.0, 0.3
_TEXT, _LINE = 2.1, 2.8
# Options that the command on the sheet names when they are not the usual ones.
_NAMED = ("size_mm", "columns", "rows", "ids", "dictionary", "gap_mm", "edge_mm", "marker_mm", "page")


def make_sheet_page(wish: SheetWish) -> Page:
    """Lays the sheet out.

    Raises:
        CameraError: It does not fit (the hint says what would), or there is no such marker or dictionary.
    """
    if wish.page not in PAPERS:
        raise CameraError(f"unknown paper {wish.page!r}", hint=f"known: {', '.join(PAPERS)}")
    if not 3.0 <= wish.size <= 1000.0:
        raise CameraError(f"a size of {wish.size:g} mm cannot be meant", hint="50 mm is usual for a marker")
    if wish.gap < wish.size * QUIET and wish.kind in ("marker", "board"):
        raise CameraError(
            f"a gap of {wish.gap:g} mm is too small for markers of {wish.size:g} mm",
            hint=f"the white round a marker must be a cell wide: at least {wish.size * QUIET:.1f} mm",
        )
    make = MAKERS[wish.kind]
    for paper in _both_ways(wish.page):
        block = make(wish, _room(paper))
        if _fits(block, paper):
            return _on_page(block, paper, wish)
    raise _does_not_fit(wish, make)


def _both_ways(page: str) -> list[Room]:
    width, height = PAPERS[page]
    return [(width, height), (height, width)]


def _room(paper: Room) -> Room:
    return paper[0] - 2 * _MARGIN - _SIDE, paper[1] - 2 * _MARGIN - _FOOT


def _fits(block: Block, paper: Room) -> bool:
    room = _room(paper)
    return block.width <= room[0] + 1e-9 and block.height <= room[1] + 1e-9


def _does_not_fit(wish: SheetWish, make: Maker) -> CameraError:
    block = make(wish, _room(PAPERS[wish.page]))
    rooms = " or ".join("{:.0f}x{:.0f}".format(*_room(paper)) for paper in _both_ways(wish.page))
    hints = []
    for size in np.arange(np.floor(wish.size * 2 - 1e-6) / 2, 5.0, -0.5):
        share = float(size) / wish.size
        less = replace(
            wish,
            size_mm=float(size),
            gap_mm=None if wish.gap_mm is None else wish.gap_mm * share,
            edge_mm=None if wish.edge_mm is None else wish.edge_mm * share,
            marker_mm=None if wish.marker_mm is None else wish.marker_mm * share,
        )
        if any(_fits(make(less, _room(paper)), paper) for paper in _both_ways(wish.page)):
            hints.append(f"--size-mm {size:g} fits")
            break
    larger = [p for p in PAPERS if any(_fits(make(wish, _room(paper)), paper) for paper in _both_ways(p))]
    hints += [f"it fits --page {name}" for name in larger[:1]]
    return CameraError(
        f"{block.about} needs {block.width:.0f}x{block.height:.0f} mm; {wish.page} has room for {rooms} mm",
        hint=", or ".join(hints) or "take fewer or smaller ones",
    )


def _on_page(block: Block, paper: Room, wish: SheetWish) -> Page:
    """The block in the middle of the room, the bars and the words at the rim."""
    room = _room(paper)
    x, y = _MARGIN + (room[0] - block.width) / 2, _MARGIN + (room[1] - block.height) / 2
    foot = paper[1] - _MARGIN - _FOOT + 4.0
    boxes = [moved(block.boxes, x, y), _bar(_MARGIN, foot), _bar(paper[0] - _MARGIN, _MARGIN, upright=True)]
    words = [replace(w, x=w.x + x, y=w.y + y) for w in block.words]
    scale = "both bars: 100.0 mm. Print at 100 % (actual size)."
    scale += f"  --board {block.board}" if block.board else ""
    beside = _MARGIN + _BAR + 3.0
    words.append(_line(beside, foot + 0.8, paper[0] - _MARGIN - beside, scale))
    for k, text in enumerate([block.about, _command(wish), *([block.use] if block.use else [])]):
        words.append(_line(_MARGIN, foot + 4.2 + k * _LINE, paper[0] - 2 * _MARGIN, text))
    lines = block.lines + np.array([x, y, x, y])
    about = f"{block.about} on {wish.page}"
    return Page(paper[0], paper[1], np.concatenate(boxes), tuple(words), about, lines)


def _line(x: float, y: float, room: float, text: str) -> Words:
    """Words that shrink to fit: they are for looking things up, not for reading across a room."""
    return Words(x, y, min(_TEXT, room / (LETTER_WIDTH * len(text))), text)


def _bar(x: float, y: float, *, upright: bool = False) -> Array:
    """A bar of exactly 100 mm with a tick every 10 mm, from (x, y) to the right, or down and left of x."""
    rows = [(0.0, 0.0, _BAR, _TICK)]
    for k in range(11):
        long = 2.4 if k % 5 == 0 else 1.4
        # The outer edges of the first and last tick are 100 mm apart.
        at = {0: 0.0, 10: _BAR - _TICK}.get(k, 10.0 * k - _TICK / 2)
        rows.append((at, -long, _TICK, long))
    bar = np.array([(*row, 1.0) for row in rows])
    if upright:
        bar = bar[:, [1, 0, 3, 2, 4]]
        return moved(bar, x - _TICK, y)
    return moved(bar, x, y)


def _command(wish: SheetWish) -> str:
    text = f"robot-ik camera print {wish.kind}"
    for name in _NAMED:
        value = getattr(wish, name)
        if value != SheetWish.__dataclass_fields__[name].default:
            values = value if isinstance(value, tuple) else (value,)
            shown = " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)
            text += f" --{name.replace('_', '-')} {shown}"
    return text
