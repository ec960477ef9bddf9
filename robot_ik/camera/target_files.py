"""Targets from text and files: the boards of the command line and TOML files of bodies."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from robot_ik.camera.detection import check_ids
from robot_ik.camera.patterns import PatternRequest
from robot_ik.camera.targets import (
    DEFAULT_DICTIONARY,
    MarkerTarget,
    PatternTarget,
    Target,
    marker,
    marker_grid,
    marker_points,
)
from robot_ik.config import KeyProblem, Position, Several, Table, Wxyz, read_table
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

# Smallest length of a board, mm. A smaller number was probably given in metres.
_MIN_MM = 0.5
# Largest number of columns and of rows.
_MAX_COUNT = 100
_FORMS = (
    "marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM, "
    "chessboard:COLUMNSxROWS:SQUARE_MM, or a file of bodies (FILE.toml or FILE.toml:NAME)"
)


def parse_target(text: str, dictionary: str = "") -> Target:
    """Return the target that a text names. Lengths in the text are in millimetres.

    Args:
        text: ``marker:7:100``, ``grid:4x3:40:10``, ``charuco:8x6:30:22``, ``chessboard:9x6:25``,
            ``bodies.toml`` or ``bodies.toml:hand``.
        dictionary: OpenCV's name of the dictionary; ``DICT_5X5_50`` if empty.

    Raises:
        CameraError: The text has none of these forms, or a number is impossible.
    """
    chosen = dictionary or DEFAULT_DICTIONARY
    kind, *numbers = text.split(":")
    if kind.endswith(".toml"):
        return _body(Path(kind), numbers[0] if numbers else "", chosen)
    with contextlib.suppress(ValueError):
        match kind, *numbers:
            case ["marker", marker_id, size]:
                return marker(int(marker_id), _metres(size), chosen)
            case ["grid", counts, size, gap]:
                return marker_grid(
                    *_counts(counts), _metres(size), _metres(gap), dictionary=chosen, name=text
                )
            case ["charuco", counts, square, size]:
                sides = float(square), float(size)
                return PatternTarget(
                    PatternRequest("charuco", *_counts(counts), *sides, chosen).pattern()
                )
            case ["chessboard", counts, square]:
                return PatternTarget(
                    PatternRequest("chessboard", *_counts(counts), float(square)).pattern()
                )
    raise CameraError(f"{text!r} is not a board", hint=f"possible: {_FORMS}")


def _counts(text: str) -> tuple[int, int]:
    columns, rows = map(int, text.split("x"))
    if not (1 <= columns <= _MAX_COUNT and 1 <= rows <= _MAX_COUNT):
        raise ValueError
    return columns, rows


def _metres(text: str) -> float:
    length = float(text)
    if not 0.0 <= length < math.inf:
        raise ValueError
    if 0.0 < length < _MIN_MM:
        raise CameraError(
            f"a length of {length:g} mm is too small for a board",
            hint=f"lengths of a board are in millimetres: {length:g} m are {1e3 * length:g}",
        )
    return 1e-3 * length


def _body(path: Path, name: str, dictionary: str) -> MarkerTarget:
    bodies = load_bodies(path, dictionary)
    if not name and len(bodies) == 1:
        name = next(iter(bodies))
    if name not in bodies:
        raise CameraError(
            f"{path} has no body {name!r}" if name else f"{path} has several bodies",
            hint=f"choose one: {', '.join(f'{path}:{known}' for known in bodies)}",
        )
    return bodies[name]


def load_bodies(path: Path | str, dictionary: str = DEFAULT_DICTIONARY) -> dict[str, MarkerTarget]:
    """Load the bodies of a TOML file, by name.

        [[body]]
        name = "cube"
        dictionary = "DICT_5X5_50"
        markers = [
          {id = 20, size = 0.07, position = [0, 0, 0.04], wxyz = [1, 0, 0, 0]},
        ]

    Lengths are in metres. ``position`` and ``wxyz`` are ``pose_body_marker``. By default the frame
    of the marker is that of the body.

    Args:
        path: The file.
        dictionary: Dictionary of the bodies for which the file gives none.

    Raises:
        ConfigError: The file is missing or not TOML, a key is unknown or missing, a value is
            impossible (size, id, dictionary), or a marker is on two bodies.
        CameraError: ``dictionary`` is unknown, or does not have an id.
    """
    tables = read_table(_BodiesFile, Path(path), "the file of bodies").body
    return {table.name: table.target(table.dictionary or dictionary) for table in tables}


class _MarkerTable(Table):
    id: int
    size: float
    position: Position = (0.0, 0.0, 0.0)
    wxyz: Wxyz = (1.0, 0.0, 0.0, 0.0)


class _BodyTable(Table):
    name: Annotated[str, Field(min_length=1, pattern=r"\S")]
    dictionary: str | None = None
    markers: Annotated[Several[_MarkerTable], Field(min_length=1)]

    def target(self, dictionary: str) -> MarkerTarget:
        """Return the body with the markers of a dictionary."""
        squares = {m.id: (m.size, Pose(m.position, m.wxyz)) for m in self.markers}
        return MarkerTarget(squares, dictionary, self.name)

    @model_validator(mode="after")
    def _is_possible(self) -> _BodyTable:
        ids = [m.id for m in self.markers]
        for k, marker_id in enumerate(ids):
            if marker_id in ids[:k]:
                raise KeyProblem(
                    f"marker {marker_id} appears twice", f"markers[{k}]", "each id once"
                )
        try:
            for m in self.markers:
                marker_points(m.size)
            if min(ids) < 0:
                raise CameraError(
                    f"a marker cannot have the id {min(ids)}", hint="ids count from 0"
                )
            if self.dictionary is not None:
                check_ids(ids, self.dictionary)
        except CameraError as error:
            raise KeyProblem(str(error.args[0]), hint=error.hint) from None
        return self


class _BodiesFile(Table):
    body: Annotated[
        Several[_BodyTable], Field(min_length=1, description="one table [[body]] for each")
    ]

    @model_validator(mode="after")
    def _is_unique(self) -> _BodiesFile:
        owner: dict[tuple[str | None, int], str] = {}
        for k, row in enumerate(self.body):
            if row.name in [other.name for other in self.body[:k]]:
                raise KeyProblem(
                    f"two bodies are named {row.name!r}", f"body[{k}].name", "every name once"
                )
            for m in row.markers:
                other = owner.setdefault((row.dictionary, m.id), row.name)
                if other != row.name:
                    problem = f"marker {m.id} is on {other!r} and on {row.name!r}"
                    raise KeyProblem(problem, f"body[{k}].markers", "each id once")
        return self
