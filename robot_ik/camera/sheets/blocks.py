"""What sheets show: markers, boards, cubes and calibration patterns, laid out in millimetres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.pattern_guess import describe
from robot_ik.camera.boards.pattern_kinds import PatternWish
from robot_ik.camera.boards.patterns import CharucoPattern, Pattern
from robot_ik.camera.opencv import marker_bits
from robot_ik.camera.sheets.cube import cube_net, cube_paper, dashed
from robot_ik.camera.sheets.page import Words
from robot_ik.errors import CameraError

Array = NDArray[np.float64]
Room = tuple[float, float]

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
class SheetWish:
    """What is to be printed; None where the usual will do.

    Attributes:
        kind: What it is.
        size_mm: Side of a marker's black square (50; cube 40), or of a square of a pattern (30; 25).
        columns, rows: Board: markers (2 x 2).  Patterns: as ``PatternWish``.
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
        return self.columns or 2, self.rows or 2

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Ids of the markers on a sheet of them, a board or a cube."""
        if self.kind == "board":
            first = self.ids[0] if self.ids else 0
            return tuple(range(first, first + self.counts[0] * self.counts[1]))
        return self.ids or tuple(range(6 if self.kind == "cube" else 1))


@dataclass(frozen=True, eq=False)
class Block:
    """What is laid out, before it is put on a page; lengths in mm from its upper left corner.

    Attributes:
        width, height: Of all of it, with the white that it needs.
        boxes: (n, 5) as in ``Page``.
        words: Labels.
        about: What it is.
        use: The command that uses it.
        board: What other commands call it behind ``--board``; empty where it has no such name.
        lines: (m, 4) to cut or fold along, as in ``Page``.
    """

    width: float
    height: float
    boxes: Array
    words: tuple[Words, ...]
    about: str
    use: str
    board: str = ""
    lines: Array = field(default_factory=lambda: np.zeros((0, 4)))


def marker_boxes(dictionary: str, marker: int, size: float, turns: int = 0) -> Array:
    """A marker's black cells (n, 5), upper left corner at the origin; turned left ``turns`` quarter turns."""
    bits = np.rot90(marker_bits(dictionary, marker), turns)
    cell = size / len(bits)
    row, column = np.nonzero(bits == 0)
    place = np.stack([column * cell, row * cell], axis=1)
    return np.hstack([place, np.full((len(place), 2), cell), np.ones((len(place), 1))])


def moved(boxes: Array, x: float, y: float) -> Array:
    """Boxes (n, 5) shifted by (x, y) mm."""
    return np.asarray(boxes + np.array([x, y, 0.0, 0.0, 0.0]))


def _names(ids: Sequence[int]) -> str:
    if len(ids) > 2 and list(ids) == list(range(ids[0], ids[0] + len(ids))):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))


def _markers(wish: SheetWish, room: Room) -> Block:
    ids = wish.marker_ids
    quiet, pitch = wish.size * QUIET, wish.size + wish.gap
    columns = int(np.clip((room[0] - 2 * quiet + wish.gap) // pitch, 1, len(ids)))
    rows = -(-len(ids) // columns)
    step = pitch + _LABEL + 1.0
    boxes, words = [], []
    for k, marker in enumerate(ids):
        x, y = quiet + k % columns * pitch, quiet + k // columns * step
        boxes.append(moved(marker_boxes(wish.dictionary, marker, wish.size), x, y))
        words.append(Words(x, y + wish.size + quiet + _LABEL, _LABEL, f"{marker}  {wish.size:g} mm"))
    width = columns * pitch - wish.gap + 2 * quiet
    height = rows * step - wish.gap - _LABEL - 1.0 + 2 * quiet + _LABEL + 1.0
    what = "marker" if len(ids) == 1 else "markers"
    about = f"{what} {_names(ids)} of {wish.dictionary}, {wish.size:g} mm"
    options = f"--dictionary {wish.dictionary} --size {wish.size / 1e3:g} --ids {' '.join(map(str, ids))}"
    use = f"robot-ik camera detect 0 --intrinsics camera.yaml {options}"
    return Block(width, height, np.concatenate(boxes), tuple(words), about, use)


def _board(wish: SheetWish, room: Room) -> Block:
    (columns, rows), ids = wish.counts, wish.marker_ids
    quiet, pitch = wish.size * QUIET, wish.size + wish.gap
    boxes = [
        moved(
            marker_boxes(wish.dictionary, marker, wish.size),
            quiet + k % columns * pitch,
            quiet + k // columns * pitch,
        )
        for k, marker in enumerate(ids)
    ]
    about = (
        f"board of {columns}x{rows} markers {_names(ids)} of {wish.dictionary}, {wish.size:g} mm, "
        f"gap {wish.gap:g} mm"
    )
    # That name says nothing of the ids: they count from 0.
    board = "" if ids[0] else f"grid:{columns}x{rows}:{wish.size:g}:{wish.gap:g}"
    size = [n * pitch - wish.gap + 2 * quiet for n in (columns, rows)]
    return Block(size[0], size[1], np.concatenate(boxes), (), about, _BODY_USE, board)


def _cube(wish: SheetWish, room: Room) -> Block:
    ids = wish.marker_ids
    white = (wish.edge - wish.size) / 2
    if white < _LEAST_WHITE * wish.size - 1e-9:
        raise CameraError(
            f"a cube of {wish.edge:g} mm leaves {white:g} mm of white round markers of {wish.size:g} mm",
            hint=f"--edge-mm {(1.0 + 2.0 * _LEAST_WHITE) * wish.size:g} at least",
        )
    faces, net = cube_net(ids, wish.size, wish.edge), cube_paper(wish.edge)
    corners = np.vstack([net.cuts.reshape(-1, 2), net.folds.reshape(-1, 2)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    boxes = [
        moved(
            marker_boxes(wish.dictionary, face.marker, wish.size, face.turns),
            *(face.centre - low - wish.size / 2),
        )
        for face in faces
    ]
    lines = np.vstack([net.cuts, dashed(net.folds)]) - np.tile(low, 2)
    about = (
        f"cube of {wish.edge:g} mm with markers {_names(ids)} of {wish.dictionary}, {wish.size:g} mm "
        "(cut along the lines, fold the dashed ones back, glue the tabs inside)"
    )
    width, height = (float(v) for v in high - low)
    return Block(width, height, np.concatenate(boxes), (), about, _BODY_USE, lines=lines)


def _pattern(wish: SheetWish, room: Room) -> Block:
    kind: Literal["charuco", "chessboard"] = "charuco" if wish.kind == "charuco" else "chessboard"
    pattern: Pattern = PatternWish(
        kind, wish.columns, wish.rows, wish.size, wish.marker_mm, wish.dictionary
    ).pattern()
    boxes = pattern.black() * 1e3
    boxes[:, :2] -= 1e3 * np.array(pattern.origin)
    options = f"--pattern {kind} --columns {pattern.columns} --rows {pattern.rows} --square-mm {wish.size:g}"
    board = f"{kind}:{pattern.columns}x{pattern.rows}:{wish.size:g}"
    if isinstance(pattern, CharucoPattern):
        board += f":{1e3 * pattern.marker:g}"
        options += f" --marker-mm {1e3 * pattern.marker:g} --dictionary {pattern.dictionary}"
    width, height = (1e3 * length for length in pattern.size)
    boxes = np.hstack([boxes, np.ones((len(boxes), 1))])
    return Block(width, height, boxes, (), describe(pattern), f"robot-ik camera calibrate 0 {options}", board)


Maker = Callable[[SheetWish, Room], Block]
#: One row a kind of sheet: lays it out for the room (width, height) that a page has, mm.
MAKERS: dict[str, Maker] = {
    "marker": _markers, "board": _board, "cube": _cube, "charuco": _pattern, "chessboard": _pattern,
}  # fmt: skip
