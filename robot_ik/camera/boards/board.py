"""What a board is called on the command line, and how it is seen: markers on a rigid body, or a pattern."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.boards.view import BoardView, Layout, see_board
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.opencv import quiet
from robot_ik.camera.pose.bodies import grid_body, load_bodies
from robot_ik.camera.sources import Frame
from robot_ik.camera.track import MarkerTracker
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

# Corners of patterns are found to about this, px (measured by the calibration).
_PATTERN_SIGMA = 0.1
_DICTIONARY = "DICT_5X5_50"
# No square of a board is smaller, mm: such a number is metres.
_LEAST_MM = 0.5
_KINDS = (
    "marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM, "
    "chessboard:COLUMNSxROWS:SQUARE_MM, or a file of bodies (FILE.toml or FILE.toml:NAME)"
)


class Board(Protocol):
    """A rigid thing with known points.

    Attributes:
        layout: Squares that should be in the picture when views are planned: number -> (side in metres,
            ``pose_board_square``), z out of the print.
    """

    @property
    def layout(self) -> Layout: ...

    def see(self, frame: Frame, intrinsics: CameraIntrinsics) -> BoardView | None:
        """The board in a frame; None when it is not found."""
        ...


@dataclass(frozen=True, eq=False)
class MarkerBoard:
    """Markers on a rigid body.

    The frame is the body's; a grid has its origin in the middle, x right, y up, z out of the print.
    """

    layout: Layout
    dictionary: str = _DICTIONARY

    def see(self, frame: Frame, intrinsics: CameraIntrinsics) -> BoardView | None:
        """The markers of the body that are seen."""
        sizes = {id: side for id, (side, _) in self.layout.items()}
        return see_board(MarkerTracker(intrinsics, self.dictionary, sizes), frame, self.layout)


@dataclass(frozen=True, eq=False)
class PatternBoard:
    """A chessboard or ChArUco board.  The frame is the pattern's: x right, y down, z into the board."""

    pattern: Pattern

    @property
    def layout(self) -> Layout:
        width, height = self.pattern.size
        middle = np.array(self.pattern.origin) + 0.5 * np.array([width, height])
        return {0: (0.8 * min(width, height), Pose((*middle, 0.0), (0.0, 1.0, 0.0, 0.0)))}

    def see(self, frame: Frame, intrinsics: CameraIntrinsics) -> BoardView | None:
        """The corners that are found."""
        intrinsics.require_size(*frame.size)
        found = self.pattern.find(frame.image)
        if found is None:
            return None
        ideal = intrinsics.undistort(found.pixels)
        if not np.isfinite(ideal).all():
            return None
        with quiet():
            count, turns, places, _ = cv2.solvePnPGeneric(
                found.points_board, ideal.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
        if not count:
            return None
        rotation, _ = cv2.Rodrigues(turns[0])
        pose = Pose.from_rotation(rotation, np.asarray(places[0], dtype=float).reshape(3))
        return BoardView(found.points_board, found.pixels, pose, _PATTERN_SIGMA)


def parse_board(text: str, dictionary: str = "") -> MarkerBoard | PatternBoard:
    """A board from its words, lengths in millimetres.

    Args:
        text: ``marker:7:100``, ``grid:4x3:40:10``, ``charuco:8x6:30:22``, ``chessboard:9x6:25``,
            ``bodies.toml`` or ``bodies.toml:hand``.
        dictionary: Of the markers; ``DICT_5X5_50`` when empty.

    Raises:
        CameraError: It means nothing; says what is possible.
    """
    words = text.split(":")
    kind, numbers = words[0], words[1:]
    chosen = dictionary or _DICTIONARY
    if kind.endswith(".toml"):
        return _body(Path(kind), numbers[0] if numbers else "", chosen)
    try:
        if kind == "marker" and len(numbers) == 2:
            return MarkerBoard({int(numbers[0]): (_metres(numbers[1]), Pose())}, chosen)
        if kind == "grid" and len(numbers) == 3:
            columns, rows = _count(numbers[0])
            return MarkerBoard(
                grid_body(columns, rows, _metres(numbers[1]), _metres(numbers[2])).markers, chosen
            )
        if kind == "charuco" and len(numbers) == 3:
            columns, rows = _count(numbers[0])
            return PatternBoard(
                CharucoPattern(columns, rows, _metres(numbers[1]), _metres(numbers[2]), chosen)
            )
        if kind == "chessboard" and len(numbers) == 2:
            columns, rows = _count(numbers[0])
            return PatternBoard(ChessboardPattern(columns, rows, _metres(numbers[1])))
    except ValueError:
        pass
    raise CameraError(f"{text!r} is no board", hint=f"possible: {_KINDS}")


def _count(text: str) -> tuple[int, int]:
    columns, rows = text.split("x")
    if not (1 <= int(columns) <= 100 and 1 <= int(rows) <= 100):
        raise ValueError
    return int(columns), int(rows)


def _metres(text: str) -> float:
    length = float(text)
    if not 0.0 <= length < np.inf:
        raise ValueError
    if 0.0 < length < _LEAST_MM:
        raise CameraError(
            f"a length of {length:g} mm cannot be right on a board",
            hint=f"boards are said in millimetres: {length:g} m are {1e3 * length:g}",
        )
    return 1e-3 * length


def _body(path: Path, name: str, dictionary: str) -> MarkerBoard:
    bodies = load_bodies(path)
    if not name and len(bodies) == 1:
        name = next(iter(bodies))
    if name not in bodies:
        raise CameraError(
            f"{path} has no body {name!r}" if name else f"{path} has several bodies",
            hint=f"name one: {', '.join(f'{path}:{one}' for one in bodies)}",
        )
    body = bodies[name]
    return MarkerBoard(body.markers, body.dictionary or dictionary)
