"""Sheets to print at true scale, with bars to check the scale.

A sheet shows the command that made it and a command that uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
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
from robot_ik.camera.sheets.cube_net import FACES, cube_paper, dashed
from robot_ik.camera.sheets.page import LETTER_WIDTH, PrintedPage, TextLine
from robot_ik.camera.targets import MarkerTarget, marker_cube, marker_grid
from robot_ik.errors import CameraError
from robot_ik.files import toml_value
from robot_ik.ports import Array

Area = tuple[float, float]
SheetKind = Literal["marker", "board", "cube", "charuco", "chessboard"]

#: White round a marker that its detection needs, in markers: one cell.
QUIET = 1.0 / 6.0
#: Paper, mm, upright.
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0)}

#: Edge of a cube, in markers. It leaves white round the markers.
CUBE_EDGE = 1.25
# Smallest side of a marker or square, mm.
_SMALLEST_MM = 3.0
# The command that finds a board or cube as one body, with the file that --body writes.
_BODY_USE = "robot-ik camera detect 0 --intrinsics camera.yaml --bodies body.toml"
# Height of the letters under a marker, and the space below them, mm.
_LABEL_HEIGHT = 2.1
_LABEL_SPACE = 1.0
# Margin of a page, mm. Printers leave about 5 mm white.
_MARGIN = 7.0
# Height of the bar and the lines of text below the print, and width of the bar at the right, mm.
_FOOT = 14.0
_SIDE = 6.0
# Length of the bars, and thickness of their lines and ticks, mm.
_BAR = 100.0
_TICK = 0.3
# Lengths of a tick and of every fifth tick, mm.
_TICK_LENGTH = 1.4
_LONG_TICK_LENGTH = 2.4
# Height of the letters and distance of the lines of text, mm.
_TEXT_HEIGHT = 2.1
_LINE_HEIGHT = 2.8
# Sizes that are tried for a hint, mm: the smallest, and the step.
_SMALLEST_HINT = 5.0
_HINT_STEP = 0.5
# Rounding error that a print may exceed a page by, mm.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class SheetRequest:
    """Request for a sheet. None stands for the default.

    Attributes:
        kind: Of the sheet.
        size_mm: Side of a marker's black square (50; cube 40), or of a square of a pattern
            (charuco 30, chessboard 25).
        columns: Board: markers (2). Patterns: as in ``PatternRequest``.
        rows: The same downwards.
        id: Ids of the markers. The ids of a board are consecutive from the first one.
        dictionary: Of the markers.
        gap_mm: White between markers.
        marker_mm: Side of the markers of a charuco board.
        page: Paper: a4, letter or a3.
    """

    kind: SheetKind
    size_mm: float | None = None
    columns: int | None = None
    rows: int | None = None
    id: tuple[int, ...] = ()
    dictionary: str = "DICT_5X5_50"
    gap_mm: float | None = None
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
        return CUBE_EDGE * self.size

    @property
    def counts(self) -> tuple[int, int]:
        """Columns and rows of a board."""
        columns = 2 if self.columns is None else self.columns
        rows = 2 if self.rows is None else self.rows
        return columns, rows

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Ids of the markers on a sheet of markers, a board or a cube."""
        if self.kind == "board":
            first = self.id[0] if self.id else 0
            return tuple(range(first, first + self.counts[0] * self.counts[1]))
        return self.id or tuple(range(6 if self.kind == "cube" else 1))


@dataclass(frozen=True, eq=False)
class Block(PrintedPage):
    """A print with its white margin, before it is placed on a page.

    Attributes:
        use: The command that uses it.
        board: Its name for ``--board``; empty if it has no such name.
    """

    use: str = ""
    board: str = ""


def make_sheet_page(request: SheetRequest) -> PrintedPage:
    """Lay a sheet out.

    Raises:
        CameraError: It does not fit (the hint says what fits), or the marker or the dictionary does
            not exist.
        CalibrationError: No marker or square has this size.
    """
    if request.page not in PAPERS:
        raise CameraError(f"unknown paper {request.page!r}", hint=f"known: {', '.join(PAPERS)}")
    what = "a square" if MAKERS[request.kind] is _pattern else "a marker"
    check_millimetres(what, request.size, _SMALLEST_MM)
    if request.kind == "board" and min(request.counts) < 1:
        columns, rows = request.counts
        problem = f"a board of {columns} x {rows} markers is not possible"
        raise CameraError(problem, hint="at least 1 x 1")
    quiet = request.size * QUIET
    if request.gap < quiet and request.kind in ("marker", "board"):
        raise CameraError(
            f"a gap of {request.gap:g} mm is too small for markers of {request.size:g} mm",
            hint=f"the white around a marker must be a cell wide: at least {quiet:.1f} mm",
        )
    laid_out = _laid_out(request)
    if laid_out is None:
        raise _does_not_fit(request)
    block, paper = laid_out
    return _on_page(block, paper, request)


def moved(boxes: Array, x: float, y: float) -> Array:
    """Return boxes (n, 5) shifted by (x, y) mm."""
    return np.asarray(boxes + np.array([x, y, 0.0, 0.0, 0.0]))


def body_of(request: SheetRequest) -> MarkerTarget:
    """Return the body on a sheet.

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
    problem = f"a sheet of kind {request.kind!r} is not a body"
    raise CameraError(problem, hint="print a board or cube")


def body_file(request: SheetRequest, name: str) -> str:
    """Return a file for ``target_files.load_bodies`` with the body called ``name``."""
    lines = [
        "# Metres; position and wxyz are the marker's pose in the body.",
        "[[body]]",
        f"name = {toml_value(name)}",
        f'dictionary = "{request.dictionary}"',
        "markers = [",
    ]
    for marker, (size, pose) in body_of(request).markers.items():
        position = ", ".join(_number(v) for v in pose.position)
        wxyz = ", ".join(_number(v) for v in pose.wxyz)
        place = f"position = [{position}], wxyz = [{wxyz}]"
        lines.append(f"  {{id = {marker}, size = {size:.9g}, {place}}},")
    return "\n".join([*lines, "]", ""])


def _number(value: float) -> str:
    """Return a number to a billionth. Sines of quarter turns are then exactly 0."""
    return f"{round(float(value), 12) + 0.0:.12g}"


def _black(boxes: Array, x: float, y: float) -> Array:
    """Return black rectangles (n, 4) as boxes (n, 5), shifted by (x, y) mm."""
    return moved(np.hstack([boxes, np.ones((len(boxes), 1))]), x, y)


def _prints(request: SheetRequest, places: Sequence[Area] | Array) -> Array:
    """Return the boxes (n, 5) of markers with their upper left corners at ``places``, mm."""
    return np.concatenate(
        [
            _black(marker_boxes(request.dictionary, marker, request.size), x, y)
            for marker, (x, y) in zip(request.marker_ids, places, strict=False)
        ]
    )


def _names(ids: Sequence[int]) -> str:
    """Return ids as text."""
    if len(ids) > 2 and list(ids) == list(range(ids[0], ids[0] + len(ids))):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))


def _markers(request: SheetRequest, area: Area) -> Block:
    """Lay markers out in rows, with their ids below them."""
    ids = request.marker_ids
    quiet = request.size * QUIET
    pitch = request.size + request.gap
    columns = int(np.clip((area[0] - 2 * quiet + request.gap) // pitch, 1, len(ids)))
    rows = -(-len(ids) // columns)
    step = pitch + _LABEL_HEIGHT + _LABEL_SPACE
    places = [(quiet + k % columns * pitch, quiet + k // columns * step) for k in range(len(ids))]
    below = request.size + quiet + _LABEL_HEIGHT
    labels = tuple(
        TextLine(x, y + below, _LABEL_HEIGHT, f"{marker}  {request.size:g} mm")
        for marker, (x, y) in zip(ids, places, strict=True)
    )
    width = columns * pitch - request.gap + 2 * quiet
    height = rows * step - request.gap + 2 * quiet
    what = "marker" if len(ids) == 1 else "markers"
    about = f"{what} {_names(ids)} of {request.dictionary}, {request.size:g} mm"
    options = f"--dictionary {request.dictionary} --marker-size {request.size / 1e3:g}"
    options += f" --id {' '.join(map(str, ids))}"
    use = f"robot-ik camera detect 0 --intrinsics camera.yaml {options}"
    return Block(width, height, _prints(request, places), labels, about, use=use)


def _board(request: SheetRequest, _area: Area) -> Block:
    """Lay a board of markers out."""
    columns, rows = request.counts
    ids = request.marker_ids
    quiet = request.size * QUIET
    pitch = request.size + request.gap
    places = [(quiet + k % columns * pitch, quiet + k // columns * pitch) for k in range(len(ids))]
    about = (
        f"board of {columns}x{rows} markers {_names(ids)} of {request.dictionary}, "
        f"{request.size:g} mm, gap {request.gap:g} mm"
    )
    # The name of a board does not contain ids. They begin at 0.
    board = "" if ids[0] else f"grid:{columns}x{rows}:{request.size:g}:{request.gap:g}"
    width = columns * pitch - request.gap + 2 * quiet
    height = rows * pitch - request.gap + 2 * quiet
    boxes = _prints(request, places)
    return Block(width, height, boxes, (), about, use=_BODY_USE, board=board)


def _cube(request: SheetRequest, _area: Area) -> Block:
    """Lay the net of a cube out."""
    # Raise the error of an impossible cube.
    body_of(request)
    cuts, folds, _ = cube_paper(request.edge)
    corners = np.vstack([cuts, folds]).reshape(-1, 2)
    lower = corners.min(axis=0)
    upper = corners.max(axis=0)
    boxes = _prints(request, request.edge * np.array(FACES) - lower - request.size / 2)
    lines = np.vstack([cuts, dashed(folds)]) - np.tile(lower, 2)
    about = (
        f"cube of {request.edge:g} mm with markers {_names(request.marker_ids)} of "
        f"{request.dictionary}, {request.size:g} mm "
        "(cut along the lines, fold the dashed ones back, glue the tabs inside)"
    )
    width, height = (float(v) for v in upper - lower)
    return Block(width, height, boxes, (), about, lines, _BODY_USE)


def _pattern(request: SheetRequest, _area: Area) -> Block:
    """Lay a calibration pattern out."""
    kind: Literal["charuco", "chessboard"] = (
        "charuco" if request.kind == "charuco" else "chessboard"
    )
    pattern: Pattern = PatternRequest(
        kind, request.columns, request.rows, request.size, request.marker_mm, request.dictionary
    ).pattern()
    boxes = _black(pattern.black() * 1e3, *(-1e3 * np.array(pattern.origin)))
    options = f"--pattern {kind} --columns {pattern.columns} --rows {pattern.rows}"
    options += f" --square-mm {request.size:g}"
    board = f"{kind}:{pattern.columns}x{pattern.rows}:{request.size:g}"
    if isinstance(pattern, CharucoPattern):
        board += f":{1e3 * pattern.marker:g}"
        options += f" --marker-mm {1e3 * pattern.marker:g} --dictionary {pattern.dictionary}"
    width, height = (1e3 * length for length in pattern.size)
    use = f"robot-ik camera calibrate 0 {options}"
    return Block(width, height, boxes, (), describe(pattern), use=use, board=board)


Maker = Callable[[SheetRequest, Area], Block]
#: Lays a kind of sheet out for the printable area (width, height) of a page, mm.
MAKERS: dict[str, Maker] = {
    "marker": _markers,
    "board": _board,
    "cube": _cube,
    "charuco": _pattern,
    "chessboard": _pattern,
}


def _laid_out(request: SheetRequest) -> tuple[Block, Area] | None:
    """Return the block and the paper, upright or turned, on which it fits. None: on neither."""
    upright = PAPERS[request.page]
    for paper in (upright, upright[::-1]):
        width, height = _printable_area(paper)
        block = MAKERS[request.kind](request, (width, height))
        if block.width <= width + _ROUNDING and block.height <= height + _ROUNDING:
            return block, paper
    return None


def _printable_area(paper: Area) -> Area:
    """Return the size of the area for a print, mm."""
    return paper[0] - 2 * _MARGIN - _SIDE, paper[1] - 2 * _MARGIN - _FOOT


def _does_not_fit(request: SheetRequest) -> CameraError:
    """Return the error for a print that is too large, with a hint about what fits."""
    upright = PAPERS[request.page]
    block = MAKERS[request.kind](request, _printable_area(upright))
    areas = " or ".join(
        "{:.0f}x{:.0f}".format(*_printable_area(paper)) for paper in (upright, upright[::-1])
    )
    hints = []
    size = _fitting_size(request)
    if size is not None:
        hints.append(f"--size-mm {size:g} fits")
    larger = [page for page in PAPERS if _laid_out(replace(request, page=page)) is not None]
    hints += [f"it fits --page {name}" for name in larger[:1]]
    return CameraError(
        f"{block.about} needs {block.width:.0f}x{block.height:.0f} mm; "
        f"{request.page} has room for {areas} mm",
        hint=", or ".join(hints) or "print fewer or smaller markers or squares",
    )


def _fitting_size(request: SheetRequest) -> float | None:
    """Return the largest size below the requested one, mm, that fits the page, or None."""
    start = np.floor(request.size / _HINT_STEP - 1e-6) * _HINT_STEP
    for size in np.arange(start, _SMALLEST_HINT, -_HINT_STEP).tolist():
        share = size / request.size
        smaller = replace(
            request,
            size_mm=size,
            gap_mm=None if request.gap_mm is None else request.gap_mm * share,
            marker_mm=None if request.marker_mm is None else request.marker_mm * share,
        )
        if _laid_out(smaller) is not None:
            return float(size)
    return None


def _on_page(block: Block, paper: Area, request: SheetRequest) -> PrintedPage:
    """Put a block in the middle of the printable area, with bars and text at the edges."""
    width, height = _printable_area(paper)
    x = _MARGIN + (width - block.width) / 2
    y = _MARGIN + (height - block.height) / 2
    foot = paper[1] - _MARGIN - _FOOT + 4.0
    boxes = [
        moved(block.boxes, x, y),
        _bar(_MARGIN, foot),
        _bar(paper[0] - _MARGIN, _MARGIN, upright=True),
    ]
    labels = [replace(label, x=label.x + x, y=label.y + y) for label in block.labels]
    scale = "both bars: 100.0 mm. Print at 100 % (actual size)."
    if block.board:
        scale += f"  --board {block.board}"
    beside = _MARGIN + _BAR + 3.0
    labels.append(_line(beside, foot + 0.8, paper[0] - _MARGIN - beside, scale))
    for k, text in enumerate((block.about, _command(request), block.use)):
        labels.append(_line(_MARGIN, foot + 4.2 + k * _LINE_HEIGHT, paper[0] - 2 * _MARGIN, text))
    lines = block.lines + np.array([x, y, x, y])
    about = f"{block.about} on {request.page}"
    return PrintedPage(paper[0], paper[1], np.concatenate(boxes), tuple(labels), about, lines)


def _line(x: float, y: float, width: float, text: str) -> TextLine:
    """Return a line of text whose letters shrink to fit a width, mm."""
    return TextLine(x, y, min(_TEXT_HEIGHT, width / (LETTER_WIDTH * len(text))), text)


def _bar(x: float, y: float, *, upright: bool = False) -> Array:
    """Return a bar of exactly 100 mm with a tick every 10 mm.

    It runs from (x, y) to the right. An upright bar runs down, left of x.
    """
    rows = [(0.0, 0.0, _BAR, _TICK)]
    for k in range(11):
        length = _LONG_TICK_LENGTH if k % 5 == 0 else _TICK_LENGTH
        # The outer edges of the first and the last tick are 100 mm apart.
        at = {0: 0.0, 10: _BAR - _TICK}.get(k, 10.0 * k - _TICK / 2)
        rows.append((at, -length, _TICK, length))
    bar = np.array([(*row, 1.0) for row in rows])
    if upright:
        bar = bar[:, [1, 0, 3, 2, 4]]
        return moved(bar, x - _TICK, y)
    return moved(bar, x, y)


def _command(request: SheetRequest) -> str:
    """Return the command that makes the sheet, without options that have their default."""
    text = f"robot-ik camera print {request.kind}"
    for option in fields(request)[1:]:
        value = getattr(request, option.name)
        if value != option.default:
            values = value if isinstance(value, tuple) else (value,)
            shown = " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)
            text += f" --{option.name.replace('_', '-')} {shown}"
    return text
