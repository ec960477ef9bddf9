"""Which part of the picture and which tilts the views of a calibration have shown, and which are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.overlay import write
from robot_ik.camera.patterns import FoundPattern
from robot_ik.ports import Array, Image

#: Names of the nine parts of a picture, by row and column.
PARTS = (
    ("upper left", "upper middle", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower middle", "lower right"),
)
# A part counts as shown by a view that has this many corners in it, and is covered by so many views.
_CORNERS, _VIEWS = 2, 2
#: Sides of the board that can tilt away from the camera, with the direction of each in the picture.
TILTS = {"right": (1.0, 0.0), "left": (-1.0, 0.0), "top": (0.0, -1.0), "bottom": (0.0, 1.0)}
#: A side is tilted away from this angle on, degrees.
TILT_DEG = 12.0
# Nearest and farthest board differ less than this: all at one distance.
_DEPTH_RATIO = 1.25


@dataclass(frozen=True, eq=False)
class Coverage:
    """What the views have shown.

    Attributes:
        size: (width, height) of the pictures, px.
        pixels: (n, 2) all corners of all views.
        parts: (3, 3) number of views that showed each part of the picture.
        tilts: (views, 2) in degrees, towards the side of the picture on which the board is farther away.
        missing: As text; empty when nothing is.
    """

    size: tuple[int, int]
    pixels: Array
    parts: NDArray[np.int64]
    tilts: Array
    missing: tuple[str, ...]


def cover(
    found: Sequence[FoundPattern], rotations: Sequence[Array], size: tuple[int, int]
) -> Coverage:
    """Accounts for views of pictures of ``size`` px, each with its ``rotation_camera_board`` (3, 3)."""
    parts = np.zeros((3, 3), dtype=np.int64)
    for view in found:
        cell = np.clip((view.pixels / size * 3).astype(int), 0, 2)
        counts = np.zeros((3, 3), dtype=np.int64)
        np.add.at(counts, (cell[:, 1], cell[:, 0]), 1)
        parts += counts >= _CORNERS
    tilts = np.array([_tilt(r) for r in rotations]).reshape(-1, 2)
    spacings = np.array([_spacing(f) for f in found])
    pixels = np.concatenate([f.pixels for f in found]) if found else np.zeros((0, 2))
    return Coverage(size, pixels, parts, tilts, tuple(_missing(parts, tilts, spacings)))


def _tilt(rotation: Array) -> Array:
    """Tilt vector in degrees: where in the picture the board is farther away."""
    normal = rotation[:, 2] * (1.0 if rotation[2, 2] >= 0 else -1.0)
    across = float(np.hypot(normal[0], normal[1]))
    angle = np.degrees(np.arctan2(across, normal[2]))
    return -normal[:2] / max(across, 1e-12) * angle


def _spacing(view: FoundPattern) -> float:
    """Pixels per metre of the board: the root of the ratio of the areas that the corners span."""
    spans = [
        np.sqrt(max(float(np.linalg.det(np.cov(p.T))), 0.0))
        for p in (view.pixels, view.points_board[:, :2])
    ]
    return float(np.sqrt(spans[0] / spans[1])) if spans[1] > 0 else 0.0


def _missing(parts: NDArray[np.int64], tilts: Array, spacings: Array) -> list[str]:
    missing = [
        f"the board in the {PARTS[r][c]}"
        for r in range(3)
        for c in range(3)
        if parts[r, c] < _VIEWS
    ]
    for side, direction in TILTS.items():
        if not len(tilts) or (tilts @ np.array(direction)).max() < TILT_DEG:
            missing.append(f"its {side} side tilted away")
    if len(spacings) > 1 and spacings.max() < _DEPTH_RATIO * spacings.min():
        missing.append("it nearer and farther")
    return missing


# ------------------------------------------------------------------------------- as a picture

_INK, _DOT, _GOOD, _LACK = (60, 60, 60), (170, 90, 20), (226, 240, 226), (196, 200, 250)
_RIM = 28


def coverage_picture(coverage: Coverage, width: int = 900) -> Image:
    """The corners in the picture, and the tilts beside it; what is missing is red.  BGR."""
    disc = round(width * 0.32)
    shown = width - disc - 3 * _RIM
    height = round(shown * coverage.size[1] / coverage.size[0])
    tall = max(height, disc) + 3 * _RIM
    canvas = np.full((tall, width, 3), 255, dtype=np.uint8)
    _draw_parts(canvas[2 * _RIM : 2 * _RIM + height, _RIM : _RIM + shown], coverage)
    _draw_tilts(canvas[2 * _RIM : 2 * _RIM + disc, width - disc - _RIM : width - _RIM], coverage)
    _write(
        canvas, f"corners of {len(coverage.tilts)} views (views to a part)", (_RIM, 2 * _RIM - 10)
    )
    _write(canvas, "tilts: rings 20, 40, 60 deg", (width - disc - _RIM, 2 * _RIM - 10))
    return canvas


def _draw_parts(area: Image, coverage: Coverage) -> None:
    height, width = area.shape[:2]
    labels = []
    for row in range(3):
        for column in range(3):
            box = (
                slice(row * height // 3, (row + 1) * height // 3),
                slice(column * width // 3, (column + 1) * width // 3),
            )
            count = int(coverage.parts[row, column])
            area[box] = _GOOD if count >= _VIEWS else _LACK
            labels.append((str(count), column * width // 3 + 8, row * height // 3 + 20))
    for x, y in (coverage.pixels + 0.5) * (width / coverage.size[0]):
        cv2.circle(area, (round(16 * x), round(16 * y)), 24, _DOT, -1, cv2.LINE_AA, 4)
    for text, x, y in labels:  # last, on white: dots would hide them
        cv2.rectangle(area, (x - 4, y - 15), (x + 8 * len(text) + 4, y + 5), (255, 255, 255), -1)
        _write(area, text, (x, y))
    cv2.rectangle(area, (0, 0), (width - 1, height - 1), _INK, 1)


def _draw_tilts(area: Image, coverage: Coverage) -> None:
    side = area.shape[0]
    centre, scale = side / 2, side / 2 / 65.0
    start = {"right": -45, "bottom": 45, "left": 135, "top": 225}
    for name, direction in TILTS.items():
        enough = (
            len(coverage.tilts) > 0 and (coverage.tilts @ np.array(direction)).max() >= TILT_DEG
        )
        colour = _GOOD if enough else _LACK
        radius = round(60 * scale)
        middle = (round(centre), round(centre))
        cv2.ellipse(
            area,
            middle,
            (radius, radius),
            0,
            start[name],
            start[name] + 90,
            colour,
            -1,
            cv2.LINE_AA,
        )
    for ring in (20, 40, 60):
        cv2.circle(area, (round(centre), round(centre)), round(ring * scale), _INK, 1, cv2.LINE_AA)
    for x, y in centre + scale * np.clip(coverage.tilts, -60, 60):
        cv2.circle(area, (round(16 * x), round(16 * y)), 64, _DOT, -1, cv2.LINE_AA, 4)


def _write(area: Image, text: str, position: tuple[int, int]) -> None:
    write(area, text, position, 13, _INK)
