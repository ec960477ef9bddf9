"""Sheets to print at true scale, with bars to check it, the command that made them and one to use them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from robot_ik.camera.image import marker_boxes
from robot_ik.camera.patterns import (
    CharucoPattern,
    Pattern,
    PatternRequest,
    check_millimetres,
    describe,
)
from robot_ik.camera.sheets.page import LETTER_WIDTH, PrintedPage, TextLine
from robot_ik.camera.targets import MarkerTarget, marker_cube, marker_grid
from robot_ik.errors import CameraError
from robot_ik.files import toml_value
from robot_ik.ports import Array

Area = tuple[float, float]

SheetKind = Literal["marker", "board", "cube", "charuco", "chessboard"]

#: White round a marker that its detection needs, in markers: a cell, of six to ten in a marker with border.
QUIET = 1.0 / 6.0
# White round the marker on a face of a cube, in markers, on each side.
_LEAST_WHITE = 0.1
# What finds a board or cube as one body, with the file that --body writes.
_BODY_USE = "robot-ik camera detect 0 --intrinsics camera.yaml --bodies body.toml"
# Height of the letters under a marker, mm.
_LABEL = 2.1


@dataclass(frozen=True)
class SheetRequest:
    """What is to be printed; None where the usual will do.

    Attributes:
        kind: What it is.
        size_mm: Side of a marker's black square (50; cube 40), or of a square of a pattern (30; 25).
        columns, rows: Board: markers (2 x 2).  Patterns: as ``PatternRequest``.
        ids: Of the markers; board: the first one counts on.
        dictionary: Of the markers.
        gap_mm: White between markers.
        edge_mm: Edge of the cube.
        marker_mm: Side of the markers of a charuco board.
        page: Paper: a4, letter or a3.
    """

    kind: SheetKind
    size_mm: float | None = None
    columns: int | None = None
    rows: int | None = None
    ids: tuple[int, ...] = ()
    dictionary: str = "DICT_5X5_50"
    gap_mm: float | None = None
    edge_mm: float | None = None
    marker_mm: float | None = None
    page: str = "a4"

    @property
    def size(self) -> float:
        """Side of a marker or square, mm."""
        usual = {"cube": 40.0, "charuco": 30.0, "chessboard": 25.0}.get(self.kind, 50.0)
        return usual if self.size_mm is None else self.size_mm

    @property
    def gap(self) -> float:
        """White between markers, mm."""
        return self.size / 4.0 if self.gap_mm is None else self.gap_mm

    @property
    def edge(self) -> float:
        """Edge of the cube, mm."""
        return 1.25 * self.size if self.edge_mm is None else self.edge_mm

    @property
    def counts(self) -> tuple[int, int]:
        """Columns and rows of a board."""
        return 2 if self.columns is None else self.columns, 2 if self.rows is None else self.rows

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Ids of the markers on a sheet of them, a board or a cube."""
        if self.kind == "board":
            first = self.ids[0] if self.ids else 0
            return tuple(range(first, first + self.counts[0] * self.counts[1]))
        return self.ids or tuple(range(6 if self.kind == "cube" else 1))


@dataclass(frozen=True, eq=False)
class Block(PrintedPage):
    """What is laid out, before it is put on a page: as large as it is with the white that it needs.

    Attributes:
        use: The command that uses it.
        board: What other commands call it behind ``--board``; empty where it has no such name.
    """

    use: str = ""
    board: str = ""


def _black(boxes: Array, x: float, y: float) -> Array:
    """Black rectangles (n, 4) as boxes (n, 5), shifted by (x, y) mm."""
    return moved(np.hstack([boxes, np.ones((len(boxes), 1))]), x, y)


def moved(boxes: Array, x: float, y: float) -> Array:
    """Boxes (n, 5) shifted by (x, y) mm."""
    return np.asarray(boxes + np.array([x, y, 0.0, 0.0, 0.0]))


def _prints(request: SheetRequest, places: Sequence[Area] | Array) -> Array:
    """Boxes (n, 5) of the markers, each with its upper left corner at x, y of ``places``, mm."""
    return np.concatenate([
        _black(marker_boxes(request.dictionary, marker, request.size), x, y)
        for marker, (x, y) in zip(request.marker_ids, places, strict=False)
    ])  # fmt: skip


def _names(ids: Sequence[int]) -> str:
    if len(ids) > 2 and list(ids) == list(range(ids[0], ids[0] + len(ids))):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))


def _markers(request: SheetRequest, area: Area) -> Block:
    ids = request.marker_ids
    quiet, pitch = request.size * QUIET, request.size + request.gap
    columns = int(np.clip((area[0] - 2 * quiet + request.gap) // pitch, 1, len(ids)))
    rows = -(-len(ids) // columns)
    step = pitch + _LABEL + 1.0
    places = [(quiet + k % columns * pitch, quiet + k // columns * step) for k in range(len(ids))]
    labels = tuple(
        TextLine(x, y + request.size + quiet + _LABEL, _LABEL, f"{marker}  {request.size:g} mm")
        for marker, (x, y) in zip(ids, places, strict=True)
    )
    width = columns * pitch - request.gap + 2 * quiet
    height = rows * step - request.gap - _LABEL - 1.0 + 2 * quiet + _LABEL + 1.0
    what = "marker" if len(ids) == 1 else "markers"
    about = f"{what} {_names(ids)} of {request.dictionary}, {request.size:g} mm"
    options = (
        f"--dictionary {request.dictionary} --size {request.size / 1e3:g} --ids {' '.join(map(str, ids))}"
    )
    use = f"robot-ik camera detect 0 --intrinsics camera.yaml {options}"
    return Block(width, height, _prints(request, places), labels, about, use=use)


def _board(request: SheetRequest, area: Area) -> Block:
    (columns, rows), ids = request.counts, request.marker_ids
    quiet, pitch = request.size * QUIET, request.size + request.gap
    places = [(quiet + k % columns * pitch, quiet + k // columns * pitch) for k in range(len(ids))]
    about = (
        f"board of {columns}x{rows} markers {_names(ids)} of {request.dictionary}, {request.size:g} mm, "
        f"gap {request.gap:g} mm"
    )
    # That name says nothing of the ids: they count from 0.
    board = "" if ids[0] else f"grid:{columns}x{rows}:{request.size:g}:{request.gap:g}"
    size = [n * pitch - request.gap + 2 * quiet for n in (columns, rows)]
    return Block(size[0], size[1], _prints(request, places), (), about, use=_BODY_USE, board=board)


def _cube(request: SheetRequest, area: Area) -> Block:
    white = (request.edge - request.size) / 2
    if white < _LEAST_WHITE * request.size - 1e-9:
        raise CameraError(
            f"a cube of {request.edge:g} mm leaves {white:g} mm of white round "
            f"markers of {request.size:g} mm",
            hint=f"--edge-mm {(1.0 + 2.0 * _LEAST_WHITE) * request.size:g} at least",
        )
    body_of(request)  # which raises where there is no such cube
    cuts, folds, _ = cube_paper(request.edge)
    corners = np.vstack([cuts, folds]).reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    boxes = _prints(request, request.edge * np.array(_FACES) - low - request.size / 2)
    lines = np.vstack([cuts, dashed(folds)]) - np.tile(low, 2)
    about = (
        f"cube of {request.edge:g} mm with markers {_names(request.marker_ids)} of "
        f"{request.dictionary}, {request.size:g} mm "
        "(cut along the lines, fold the dashed ones back, glue the tabs inside)"
    )
    width, height = (float(v) for v in high - low)
    return Block(width, height, boxes, (), about, lines, _BODY_USE)


def _pattern(request: SheetRequest, area: Area) -> Block:
    kind: Literal["charuco", "chessboard"] = "charuco" if request.kind == "charuco" else "chessboard"
    pattern: Pattern = PatternRequest(
        kind, request.columns, request.rows, request.size, request.marker_mm, request.dictionary
    ).pattern()
    boxes = _black(pattern.black() * 1e3, *(-1e3 * np.array(pattern.origin)))
    options = (
        f"--pattern {kind} --columns {pattern.columns} --rows {pattern.rows} --square-mm {request.size:g}"
    )
    board = f"{kind}:{pattern.columns}x{pattern.rows}:{request.size:g}"
    if isinstance(pattern, CharucoPattern):
        board += f":{1e3 * pattern.marker:g}"
        options += f" --marker-mm {1e3 * pattern.marker:g} --dictionary {pattern.dictionary}"
    width, height = (1e3 * length for length in pattern.size)
    use = f"robot-ik camera calibrate 0 {options}"
    return Block(width, height, boxes, (), describe(pattern), use=use, board=board)


Maker = Callable[[SheetRequest, Area], Block]
#: One row a kind of sheet: lays it out for the printable area (width, height) of a page, mm.
MAKERS: dict[str, Maker] = {
    "marker": _markers, "board": _board, "cube": _cube, "charuco": _pattern, "chessboard": _pattern,
}  # fmt: skip


#: Paper, mm, upright.
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0)}
# Printers leave about 5 mm white.
_MARGIN = 7.0
# The bar, the lines of text under it, and the upright bar at the right, mm.
_FOOT, _SIDE = 14.0, 6.0
_BAR, _TICK = 100.0, 0.3
_TEXT, _LINE = 2.1, 2.8


def make_sheet_page(request: SheetRequest) -> PrintedPage:
    """Lays the sheet out.

    Raises:
        CameraError: It does not fit (the hint says what would), or there is no such marker or dictionary.
        CalibrationError: No marker or square has this size.
    """
    if request.page not in PAPERS:
        raise CameraError(f"unknown paper {request.page!r}", hint=f"known: {', '.join(PAPERS)}")
    check_millimetres("a square" if MAKERS[request.kind] is _pattern else "a marker", request.size, 3.0)
    if request.kind == "board" and min(request.counts) < 1:
        columns, rows = request.counts
        raise CameraError(f"a board of {columns} x {rows} markers is not possible", hint="at least 1 x 1")
    if request.gap < request.size * QUIET and request.kind in ("marker", "board"):
        raise CameraError(
            f"a gap of {request.gap:g} mm is too small for markers of {request.size:g} mm",
            hint=f"the white round a marker must be a cell wide: at least {request.size * QUIET:.1f} mm",
        )
    if (found := _laid_out(request)) is None:
        raise _does_not_fit(request)
    return _on_page(*found, request)


def _laid_out(request: SheetRequest) -> tuple[Block, Area] | None:
    """The block, and the paper, upright or lying, on which it fits; None: on neither."""
    upright = PAPERS[request.page]
    for paper in (upright, upright[::-1]):
        area = _printable_area(paper)
        block = MAKERS[request.kind](request, area)
        if block.width <= area[0] + 1e-9 and block.height <= area[1] + 1e-9:
            return block, paper
    return None


def _printable_area(paper: Area) -> Area:
    return paper[0] - 2 * _MARGIN - _SIDE, paper[1] - 2 * _MARGIN - _FOOT


def _does_not_fit(request: SheetRequest) -> CameraError:
    upright = PAPERS[request.page]
    block = MAKERS[request.kind](request, _printable_area(upright))
    areas = " or ".join("{:.0f}x{:.0f}".format(*_printable_area(one)) for one in (upright, upright[::-1]))
    hints = []
    for size in np.arange(np.floor(request.size * 2 - 1e-6) / 2, 5.0, -0.5):
        share = float(size) / request.size
        less = replace(
            request,
            size_mm=float(size),
            gap_mm=None if request.gap_mm is None else request.gap_mm * share,
            edge_mm=None if request.edge_mm is None else request.edge_mm * share,
            marker_mm=None if request.marker_mm is None else request.marker_mm * share,
        )
        if _laid_out(less) is not None:
            hints.append(f"--size-mm {size:g} fits")
            break
    larger = [page for page in PAPERS if _laid_out(replace(request, page=page)) is not None]
    hints += [f"it fits --page {name}" for name in larger[:1]]
    return CameraError(
        f"{block.about} needs {block.width:.0f}x{block.height:.0f} mm; "
        f"{request.page} has room for {areas} mm",
        hint=", or ".join(hints) or "take fewer or smaller ones",
    )


def _on_page(block: Block, paper: Area, request: SheetRequest) -> PrintedPage:
    """The block in the middle of the printable area, bars and text at the rim."""
    area = _printable_area(paper)
    x, y = _MARGIN + (area[0] - block.width) / 2, _MARGIN + (area[1] - block.height) / 2
    foot = paper[1] - _MARGIN - _FOOT + 4.0
    boxes = [moved(block.boxes, x, y), _bar(_MARGIN, foot), _bar(paper[0] - _MARGIN, _MARGIN, upright=True)]
    labels = [replace(w, x=w.x + x, y=w.y + y) for w in block.labels]
    scale = "both bars: 100.0 mm. Print at 100 % (actual size)."
    scale += f"  --board {block.board}" if block.board else ""
    beside = _MARGIN + _BAR + 3.0
    labels.append(_line(beside, foot + 0.8, paper[0] - _MARGIN - beside, scale))
    for k, text in enumerate((block.about, _command(request), block.use)):
        labels.append(_line(_MARGIN, foot + 4.2 + k * _LINE, paper[0] - 2 * _MARGIN, text))
    lines = block.lines + np.array([x, y, x, y])
    about = f"{block.about} on {request.page}"
    return PrintedPage(paper[0], paper[1], np.concatenate(boxes), tuple(labels), about, lines)


def _line(x: float, y: float, width: float, text: str) -> TextLine:
    """A line of text that shrinks to fit: it is looked up from near by."""
    return TextLine(x, y, min(_TEXT, width / (LETTER_WIDTH * len(text))), text)


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


def _command(request: SheetRequest) -> str:
    text = f"robot-ik camera print {request.kind}"
    for option in fields(request)[1:]:  # all but the kind, where they are not the usual ones
        value = getattr(request, option.name)
        if value != option.default:
            values = value if isinstance(value, tuple) else (value,)
            shown = " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)
            text += f" --{option.name.replace('_', '-')} {shown}"
    return text


# ------------------------------------------------------------------------------------------
# The net of a cube: what is cut and folded.


# Depth of a tab in edges, and at most, mm.
_TAB, _TAB_MOST = 0.2, 10.0
# A dash and the gap after it, mm.
_DASH, _GAP = 2.0, 1.5
# Middles of the six faces of ``marker_cube``, in edges, y down: front, right, back, left, top, bottom.  All
# prints stand upright.
_FACES = ((0, 0), (1, 0), (2, 0), (-1, 0), (0, -1), (0, 1))
# Their sides that have a tab (face, way to the side); each is glued behind a side that has none.
_TABBED = (
    ((0, -1), (1, 0)), ((0, -1), (-1, 0)), ((0, -1), (0, -1)),
    ((0, 1), (1, 0)), ((0, 1), (-1, 0)), ((0, 1), (0, 1)),
    ((-1, 0), (-1, 0)),
)  # fmt: skip


def cube_paper(edge: float) -> tuple[Array, Array, Array]:
    """The net of a cube of this edge, and tabs that hold it together; x right, y down, from its first face.

    Returns:
        Lines (n, 4) from x, y to x, y to cut along; (12, 4) to fold along, between the faces, and between a
        face and its tab; corners (7, 4, 2) of the tabs, of which the first and the last are on the face.
    """
    depth = min(_TAB * edge, _TAB_MOST)
    cuts, folds, tabs = [], [], []
    for face in _FACES:
        for direction in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            start, end = _side(face, direction, edge)
            if (face, direction) in _TABBED:
                along = (end - start) / edge
                out = np.array(direction, dtype=float)
                # Its ends are cut back at 45 degrees: two tabs in one corner then do not meet.
                tab = [start, start + depth * (along + out), end + depth * (out - along), end]
                tabs.append(tab)
                folds.append([start, end])
                cuts += [[a, b] for a, b in pairwise(tab)]
            elif (face[0] + direction[0], face[1] + direction[1]) not in _FACES:
                cuts.append([start, end])
            elif direction in ((1, 0), (0, 1)):  # a fold has two sides
                folds.append([start, end])
    return np.array(cuts).reshape(-1, 4), np.array(folds).reshape(-1, 4), np.array(tabs)


def _side(face: tuple[int, int], direction: tuple[int, int], edge: float) -> tuple[Array, Array]:
    """The two ends of a face's side."""
    out = np.array(direction, dtype=float)
    middle, half = edge * (np.array(face) + 0.5 * out), 0.5 * edge * np.array([-out[1], out[0]])
    return middle - half, middle + half


def dashed(lines: Array) -> Array:
    """The dashes (m, 4) of lines (n, 4) in mm; each line begins and ends with half a dash."""
    dashes = []
    for line in np.asarray(lines, dtype=float):
        start, end = line[:2], line[2:]
        length = float(np.linalg.norm(end - start))
        count = max(1, round(length / (_DASH + _GAP)))
        share = _DASH / (_DASH + _GAP)
        at = (np.arange(count + 1)[:, None] + 0.5 * share * np.array([-1.0, 1.0])) / count
        for low, high in np.clip(at, 0.0, 1.0):
            dashes.append([*(start + low * (end - start)), *(start + high * (end - start))])
    return np.array(dashes)


# ------------------------------------------------------------------------------------------
# What a printed board or cube is to a tracker: a body, and the file that describes it.


def body_of(request: SheetRequest) -> MarkerTarget:
    """The body on a sheet.

    Raises:
        CameraError: The sheet shows neither a board nor a cube.
    """
    size = request.size / 1e3
    if request.kind == "board":
        columns, rows = request.counts
        gap = request.gap / 1e3
        return marker_grid(columns, rows, size, gap, request.marker_ids[0], request.dictionary)
    if request.kind == "cube":
        return marker_cube(request.marker_ids, size, request.edge / 1e3, request.dictionary)
    raise CameraError(
        f"a sheet of kind {request.kind!r} is no body", hint="bodies are printed as board or cube"
    )


def body_file(request: SheetRequest, name: str) -> str:
    """The text of a file for ``robot_ik.camera.target_files.load_bodies``, with the body called ``name``."""
    lines = ["# Metres; position and wxyz are the marker's pose in the body.", "[[body]]"]
    lines += [f"name = {toml_value(name)}", f'dictionary = "{request.dictionary}"', "markers = ["]
    for marker, (size, pose) in body_of(request).markers.items():
        position, wxyz = (", ".join(_number(v) for v in part) for part in (pose.position, pose.wxyz))
        lines.append(f"  {{id = {marker}, size = {size:.9g}, position = [{position}], wxyz = [{wxyz}]}},")
    return "\n".join([*lines, "]", ""])


def _number(value: float) -> str:
    """To a billionth; sines of quarter turns are then the 0 that they are meant to be."""
    return f"{round(float(value), 12) + 0.0:.12g}"
