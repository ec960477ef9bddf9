"""Rigid bodies that carry markers: boards, cubes, any layout; and the file that describes them.

The frame of a marker: x right, y up, z out of the print, origin in its centre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from robot_ik.camera.image import dictionary_size
from robot_ik.camera.observations import marker_points
from robot_ik.errors import CameraError, ConfigError, unknown_name_text
from robot_ik.files import read_toml, shown
from robot_ik.geometry import Pose

_BODY_KEYS = ("name", "dictionary", "markers")
_MARKER_KEYS = ("id", "size", "position", "wxyz")
_CUBE_SIDES = 6


@dataclass(frozen=True, eq=False)
class MarkerBody:
    """A rigid body with markers on it.

    Attributes:
        name: For people, and to tell bodies apart.
        markers: Id -> (side of the black square in metres, ``pose_body_marker``).
        dictionary: Of its markers; None when whoever looks for them says it.

    Raises:
        CameraError: No marker at all, a size that cannot be, an unknown dictionary or an id beyond it.
    """

    name: str
    markers: Mapping[int, tuple[float, Pose]]
    dictionary: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "markers", MappingProxyType(dict(self.markers)))
        if not self.markers:
            raise CameraError(f"the body {self.name!r} has no markers", hint="list them under markers")
        for size, _ in self.markers.values():
            marker_points(size)
        least, most = min(self.markers), max(self.markers)
        count = dictionary_size(self.dictionary) if self.dictionary is not None else most + 1
        if least < 0 or most >= count:
            raise CameraError(
                f"the body {self.name!r} has marker {least if least < 0 else most}, "
                f"which is not in {self.dictionary or 'any dictionary'}",
                hint=f"ids are 0 to {count - 1}" if self.dictionary else "ids count from 0",
            )

    @property
    def sizes(self) -> dict[int, float]:
        """Id -> side of the black square, metres."""
        return {i: size for i, (size, _) in self.markers.items()}

    def require_dictionary(self, dictionary: str) -> None:
        """Checks that the markers are of this dictionary.

        Raises:
            CameraError: They are of another one.
        """
        if self.dictionary is None or _plain(dictionary) == _plain(self.dictionary):
            return
        raise CameraError(
            f"the markers of the body {self.name!r} are of {self.dictionary}, but {dictionary} is looked for",
            hint=f"look for theirs: --dictionary {self.dictionary}",
        )


def _plain(dictionary: str) -> str:
    return dictionary.strip().upper().removeprefix("DICT_")


def grid_body(
    columns: int, rows: int, size: float, gap: float, first_id: int = 0, *, name: str = "board"
) -> MarkerBody:
    """A flat board of markers in rows, ids counted from the upper left like words on a page.

    Frame: centre of the board, x right, y up, z out of the print.

    Args:
        columns: Markers in a row.
        rows: Rows.
        size: Side of the black squares, metres.
        gap: White between them, metres.
        first_id: Of the upper left one.
        name: Of the body.

    Raises:
        CameraError: No markers, a size that cannot be, or a gap that is not positive.
    """
    if columns < 1 or rows < 1 or not gap > 0:
        raise CameraError(
            f"a board of {columns} x {rows} markers with gaps of {gap} m cannot be",
            hint="at least 1 x 1, and white between the markers: a quarter of their size is good",
        )
    pitch = size + gap
    markers = {}
    for k in range(columns * rows):
        row, column = divmod(k, columns)
        place = ((column - 0.5 * (columns - 1)) * pitch, (0.5 * (rows - 1) - row) * pitch, 0.0)
        markers[first_id + k] = (size, Pose(place))
    return MarkerBody(name, markers)


def cube_body(ids: Sequence[int], size: float, edge: float, *, name: str = "cube") -> MarkerBody:
    """A cube with a marker in the middle of up to six sides.

    Frame: centre of the cube.  The sides in their order: front (+z), right (+x), back (-z), left (-x), top
    (+y), bottom (-y); the first four markers stand upright (their y is the cube's), those of top and bottom
    join the front one (their x is the cube's).

    Args:
        ids: One to six, in the order of the sides.
        size: Side of the black squares, metres.
        edge: Of the cube, metres.
        name: Of the body.

    Raises:
        CameraError: Too many or repeated ids, or markers larger than the cube.
    """
    if not 1 <= len(ids) <= _CUBE_SIDES or len(set(ids)) != len(ids):
        raise CameraError(f"a cube has one to six different markers, not {list(ids)}")
    if not size < edge:
        raise CameraError(
            f"markers of {size} m do not fit on a cube of {edge} m",
            hint="leave white round them: a fifth at least",
        )
    quarter = np.pi / 2
    turns = [(0.0, k * quarter, 0.0) for k in range(4)] + [(-quarter, 0.0, 0.0), (quarter, 0.0, 0.0)]
    sides = [Pose.exp((0.0, 0.0, 0.0, *turn)) for turn in turns]
    out = Pose((0.0, 0.0, 0.5 * edge))
    return MarkerBody(name, {i: (size, side.compose(out)) for i, side in zip(ids, sides, strict=False)})


# ------------------------------------------------------------------------------------- files


def load_bodies(path: Path | str) -> dict[str, MarkerBody]:
    """Bodies of a TOML file by name.

        [[body]]
        name = "cube"
        dictionary = "DICT_5X5_50"
        markers = [
          {id = 20, size = 0.07, position = [0, 0, 0.04], wxyz = [1, 0, 0, 0]},
        ]

    Lengths in metres; ``position`` and ``wxyz`` are ``pose_body_marker`` and may be left out when zero.

    Raises:
        ConfigError: The file is missing or no TOML, a key is unknown or missing, a value is of the wrong
            kind or cannot be (size, id, dictionary), or a marker is on two bodies.
    """
    file = Path(path)
    content = read_toml(file, "the file of bodies")
    _known_keys(content, ("body",), file, "")
    rows = content.get("body")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise ConfigError("describes no body", file=file, allowed="one table [[body]] for each")
    bodies: dict[str, MarkerBody] = {}
    owner: dict[tuple[str | None, int], str] = {}
    for k, row in enumerate(rows):
        body = _read_body(row, file, f"body[{k}]")
        if body.name in bodies:
            raise ConfigError(f"two bodies are named {body.name!r}", file=file, key=f"body[{k}].name")
        bodies[body.name] = body
        for i in body.markers:
            other = owner.setdefault((body.dictionary, i), body.name)
            if other != body.name:
                problem = f"marker {i} is on {other!r} and on {body.name!r}"
                raise ConfigError(problem, file=file, key=f"body[{k}].markers", allowed="each id once")
    return bodies


def _read_body(row: dict[str, Any], file: Path, key: str) -> MarkerBody:
    _known_keys(row, _BODY_KEYS, file, key)
    name, dictionary = row.get("name"), row.get("dictionary")
    if not isinstance(name, str) or not name.strip():
        raise ConfigError("a body needs a name", file=file, key=f"{key}.name", allowed="a text")
    if dictionary is not None and not isinstance(dictionary, str):
        allowed = 'a name as "DICT_5X5_50"'
        raise ConfigError("is no dictionary", file=file, key=f"{key}.dictionary", allowed=allowed)
    entries = row.get("markers")
    if not isinstance(entries, list) or not entries:
        allowed = "a list of {id = 0, size = 0.05, position = [x, y, z], wxyz = [w, x, y, z]}"
        raise ConfigError("a body needs markers", file=file, key=f"{key}.markers", allowed=allowed)
    markers: dict[int, tuple[float, Pose]] = {}
    for k, entry in enumerate(entries):
        where = f"{key}.markers[{k}]"
        if not isinstance(entry, dict):
            raise ConfigError("is no table", file=file, key=where, allowed="{id = …, size = …}")
        _known_keys(entry, _MARKER_KEYS, file, where)
        number, size, pose = _read_marker(entry, file, where)
        if number in markers:
            raise ConfigError(f"marker {number} comes twice", file=file, key=where, allowed="each id once")
        markers[number] = (size, pose)
    try:
        return MarkerBody(name, markers, dictionary)
    except CameraError as error:
        raise ConfigError(str(error.args[0]), file=file, key=key, hint=error.hint) from None


def _read_marker(entry: dict[str, Any], file: Path, key: str) -> tuple[int, float, Pose]:
    number, size = entry.get("id"), entry.get("size")
    if not isinstance(number, int) or isinstance(number, bool):
        raise ConfigError("a marker needs its number", file=file, key=f"{key}.id", allowed="an integer")
    if not isinstance(size, (int, float)) or isinstance(size, bool):
        allowed = "the side of the black square in metres"
        raise ConfigError("a marker needs its size", file=file, key=f"{key}.size", allowed=allowed)
    position = _numbers(entry, "position", (0.0, 0.0, 0.0), file, key)
    wxyz = _numbers(entry, "wxyz", (1.0, 0.0, 0.0, 0.0), file, key)
    try:
        return number, float(size), Pose(position, wxyz)
    except ValueError as error:
        raise ConfigError(str(error), file=file, key=key) from None


def _numbers(
    entry: dict[str, Any], name: str, default: tuple[float, ...], file: Path, key: str
) -> tuple[float, ...]:
    value = entry.get(name, list(default))
    right = isinstance(value, list) and len(value) == len(default)
    if not right or not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value):
        allowed = f"{len(default)} numbers"
        raise ConfigError(f"is {shown(value)}", file=file, key=f"{key}.{name}", allowed=allowed)
    return tuple(float(v) for v in value)


def _known_keys(table: dict[str, Any], known: tuple[str, ...], file: Path, key: str) -> None:
    for name in table:
        if name not in known:
            where = f"{key}.{name}" if key else name
            raise ConfigError(unknown_name_text("key", name, known), file=file, key=where)
