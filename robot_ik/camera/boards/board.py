"""What a board is called on the command line, and how it is seen: markers on a rigid body, or a pattern."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.boards.patterns import Pattern, PatternRequest
from robot_ik.camera.bodies import grid_body, load_bodies
from robot_ik.camera.image import quiet
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.observations import estimate_body, marker_points
from robot_ik.camera.photometric_fit import LEAST_SIGMA
from robot_ik.camera.sources import Frame, require_frame
from robot_ik.camera.tracker import Layout, MarkerTracker
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array


@dataclass(frozen=True, eq=False)
class BoardView:
    """Points of a rigid board (or cube, or single marker) in one picture.

    Attributes:
        points: (n, 3) in the board's frame, metres.
        pixels: (n, 2) where they were seen, distorted pixels.
        pose_camera_board: A first estimate of the pose.
        sigma: Standard deviation of the pixels, px.
        bias: Of the corners of markers, four after four: standard deviation of how far outwards all of them
            lie in every picture alike, px; 0 for other points.

    Raises:
        CameraError: The arrays do not belong together, a number is not finite, or points are fewer than 4.
    """

    points: Array
    pixels: Array
    pose_camera_board: Pose
    sigma: float = 0.1
    bias: float = 0.0

    def __post_init__(self) -> None:
        p, x = np.array(self.points, dtype=float), np.array(self.pixels, dtype=float)
        if p.ndim != 2 or p.shape[1] != 3 or x.shape != (len(p), 2):
            raise CameraError(f"points (n, 3) and pixels (n, 2) are asked for, not {p.shape} and {x.shape}")
        if len(p) < 4:
            raise CameraError(f"{len(p)} points do not fix a pose", hint="at least 4 are needed")
        if not (np.isfinite(p).all() and np.isfinite(x).all() and 0.0 < self.sigma < np.inf):
            raise CameraError("a point, a pixel or the standard deviation of the pixels is not finite")
        if not 0.0 <= self.bias < np.inf or (self.bias > 0.0 and len(p) % 4):
            raise CameraError(f"a bias of {self.bias} px of {len(p)} points: markers have 4 corners each")
        object.__setattr__(self, "points", p)
        object.__setattr__(self, "pixels", x)


def point_jacobian(intrinsics: CameraIntrinsics, points: Array) -> Array:
    """Derivative (n, 2, 3) of distorted pixels by points (n, 3) in front of the camera, camera frame."""
    z = points[:, 2]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
    by_point[:, :, 2] = -points[:, :2] / z[:, None] ** 2
    return np.asarray(intrinsics.pixel_jacobian(points[:, :2] / z[:, None]) @ by_point)


# Corners of patterns are found to about this, px (measured by the calibration).
_PATTERN_SIGMA = 0.1
_DICTIONARY = "DICT_5X5_50"
# No square of a board is smaller, mm: such a number is metres.
_LEAST_MM = 0.5
_KINDS = (
    "marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM, "
    "chessboard:COLUMNSxROWS:SQUARE_MM, or a file of bodies (FILE.toml or FILE.toml:NAME)"
)


@dataclass(frozen=True, eq=False)
class MarkerBoard:
    """Markers on a rigid body.

    The frame is the body's; a grid has its origin in the middle, x right, y up, z out of the print.

    Attributes:
        layout: Marker id -> (side in metres, ``pose_board_marker``).
        dictionary: Of the markers.
    """

    layout: Layout
    dictionary: str = _DICTIONARY

    def corners(self, ids: Iterable[int]) -> Array:
        """Corners (4 n, 3) of some of its markers, metres, in the board's frame."""
        return np.concatenate([self.layout[i][1].apply(marker_points(self.layout[i][0])) for i in ids])

    def see(self, frame: Frame, intrinsics: CameraIntrinsics) -> BoardView | None:
        """The markers of the body that are seen; None when none of them gives a pose.

        Ids that come twice are left out, markers that contradict the others, and those whose print could not
        be fitted where others' could.
        """
        sizes = {id: side for id, (side, _) in self.layout.items()}
        seen = MarkerTracker(intrinsics, self.dictionary, sizes).corners(frame)
        seen = {i: one for i, one in seen.items() if one.refined} or seen
        body = estimate_body(seen, self.layout, intrinsics)
        if body is None:
            return None
        pixels = np.concatenate([seen[i].corners for i in body.ids])
        sigma = float(np.sqrt(np.mean([seen[i].sigma ** 2 for i in body.ids])))
        return BoardView(self.corners(body.ids), pixels, body.pose_camera_body, sigma, bias=LEAST_SIGMA)


@dataclass(frozen=True, eq=False)
class PatternBoard:
    """A chessboard or ChArUco board.  The frame is the pattern's: x right, y down, z into the board."""

    pattern: Pattern

    @property
    def layout(self) -> Layout:
        """One square that should be in the picture when views are planned, z out of the print."""
        width, height = self.pattern.size
        middle = np.array(self.pattern.origin) + 0.5 * np.array([width, height])
        return {0: (0.8 * min(width, height), Pose((*middle, 0.0), (0.0, 1.0, 0.0, 0.0)))}

    def see(self, frame: Frame, intrinsics: CameraIntrinsics) -> BoardView | None:
        """The corners that are found."""
        require_frame(frame)
        intrinsics.require_size(*frame.size)
        found = self.pattern.find(frame.image)
        if found is None:
            return None
        normalized = intrinsics.undistort(found.pixels)
        if not np.isfinite(normalized).all():
            return None
        with quiet():
            count, rotations, translations, _ = cv2.solvePnPGeneric(
                found.points_board, normalized.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
        if not count:
            return None
        rotation, _ = cv2.Rodrigues(rotations[0])
        pose = Pose.from_rotation(rotation, np.asarray(translations[0], dtype=float).reshape(3))
        return BoardView(found.points_board, found.pixels, pose, _PATTERN_SIGMA)


Board = MarkerBoard | PatternBoard


def parse_board(text: str, dictionary: str = "") -> Board:
    """A board from its text, lengths in millimetres.

    Args:
        text: ``marker:7:100``, ``grid:4x3:40:10``, ``charuco:8x6:30:22``, ``chessboard:9x6:25``,
            ``bodies.toml`` or ``bodies.toml:hand``.
        dictionary: Of the markers; ``DICT_5X5_50`` when empty.

    Raises:
        CameraError: It means nothing; says what is possible.
    """
    chosen = dictionary or _DICTIONARY
    kind, *numbers = text.split(":")
    if kind.endswith(".toml"):
        return _body(Path(kind), numbers[0] if numbers else "", chosen)
    with contextlib.suppress(ValueError):
        match kind, *numbers:
            case ["marker", id, side]:
                return MarkerBoard({int(id): (_metres(side), Pose())}, chosen)
            case ["grid", counts, side, gap]:
                return MarkerBoard(grid_body(*_count(counts), _metres(side), _metres(gap)).markers, chosen)
            case ["charuco", counts, square, marker]:
                sides = float(square), float(marker)
                return PatternBoard(PatternRequest("charuco", *_count(counts), *sides, chosen).pattern())
            case ["chessboard", counts, square]:
                return PatternBoard(PatternRequest("chessboard", *_count(counts), float(square)).pattern())
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
            f"a length of {length:g} mm is too small for a board",
            hint=f"a board's lengths are in millimetres: {length:g} m are {1e3 * length:g}",
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
