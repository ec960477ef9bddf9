"""Rigid bodies that carry markers: boards, cubes, any layout; and the file that describes them.

The frame of a marker: x right, y up, z out of the print, origin in its centre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from robot_ik.camera.image import dictionary_size
from robot_ik.camera.observations import marker_points
from robot_ik.config import KeyProblem, Position, Several, Table, Wxyz, read_table
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

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
            f"a board of {columns} x {rows} markers with gaps of {1e3 * gap:g} mm is not possible",
            hint="at least 1 x 1, and white between the markers: a quarter of their size is good",
        )
    pitch = size + gap
    markers = {}
    for k in range(columns * rows):
        row, column = divmod(k, columns)
        position = ((column - 0.5 * (columns - 1)) * pitch, (0.5 * (rows - 1) - row) * pitch, 0.0)
        markers[first_id + k] = (size, Pose(position))
    return MarkerBody(name, markers)


def cube_body(ids: Sequence[int], size: float, edge: float) -> MarkerBody:
    """A cube with a marker in the middle of up to six sides.

    Frame: centre of the cube.  The sides in their order: front (+z), right (+x), back (-z), left (-x), top
    (+y), bottom (-y); the first four markers stand upright (their y is the cube's), those of top and bottom
    join the front one (their x is the cube's).

    Args:
        ids: One to six, in the order of the sides.
        size: Side of the black squares, metres.
        edge: Of the cube, metres.

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
    rotations = [(0.0, k * quarter, 0.0) for k in range(4)] + [(-quarter, 0.0, 0.0), (quarter, 0.0, 0.0)]
    sides = [Pose().plus((0.0, 0.0, 0.0, *rotation)) for rotation in rotations]
    out = Pose((0.0, 0.0, 0.5 * edge))
    return MarkerBody("cube", {i: (size, side.compose(out)) for i, side in zip(ids, sides, strict=False)})


# ------------------------------------------------------------------------------------- files


class _MarkerTable(Table):
    id: int
    size: float
    position: Position = (0.0, 0.0, 0.0)
    wxyz: Wxyz = (1.0, 0.0, 0.0, 0.0)


class _BodyTable(Table):
    name: Annotated[str, Field(min_length=1, pattern=r"\S")]
    dictionary: str | None = None
    markers: Annotated[Several[_MarkerTable], Field(min_length=1)]

    @cached_property
    def body(self) -> MarkerBody:
        """The body that is described.

        Raises:
            KeyProblem: It cannot be.
        """
        numbers = [marker.id for marker in self.markers]
        for k, number in enumerate(numbers):
            if number in numbers[:k]:
                raise KeyProblem(f"marker {number} comes twice", f"markers[{k}]", "each id once")
        sides = {m.id: (m.size, Pose(m.position, m.wxyz)) for m in self.markers}
        try:
            return MarkerBody(self.name, sides, self.dictionary)
        except CameraError as error:
            raise KeyProblem(str(error.args[0]), hint=error.hint) from None

    @model_validator(mode="after")
    def _can_be(self) -> _BodyTable:
        _ = self.body  # which raises where it cannot be
        return self


class _BodiesFile(Table):
    body: Annotated[Several[_BodyTable], Field(min_length=1, description="one table [[body]] for each")]

    @model_validator(mode="after")
    def _once(self) -> _BodiesFile:
        owner: dict[tuple[str | None, int], str] = {}
        for k, row in enumerate(self.body):
            if row.name in [other.name for other in self.body[:k]]:
                raise KeyProblem(f"two bodies are named {row.name!r}", f"body[{k}].name", "every name once")
            for marker in row.markers:
                other = owner.setdefault((row.dictionary, marker.id), row.name)
                if other != row.name:
                    problem = f"marker {marker.id} is on {other!r} and on {row.name!r}"
                    raise KeyProblem(problem, f"body[{k}].markers", "each id once")
        return self


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
    return {row.name: row.body for row in read_table(_BodiesFile, Path(path), "the file of bodies").body}
