"""Parts of the picture and tilts that the views of a calibration show, and those missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.patterns import FoundPattern
from robot_ik.ports import Array

#: Names of the nine parts of a picture, by row and column.
PARTS = (
    ("upper left", "upper middle", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower middle", "lower right"),
)
# Smallest number of corners in a part of the picture with which a view shows that part.
_MIN_CORNERS = 2
# Smallest number of views that cover a part.
_MIN_VIEWS = 2
#: Sides of the board that can tilt away from the camera, and their directions in the picture.
TILTS = {"right": (1.0, 0.0), "left": (-1.0, 0.0), "top": (0.0, -1.0), "bottom": (0.0, 1.0)}
#: Smallest angle at which a side counts as tilted away, degrees.
TILT_DEG = 12.0
# Smallest ratio of the farthest to the nearest distance of the board. With a smaller ratio all
# views count as taken at one distance.
_MIN_DEPTH_RATIO = 1.25


@dataclass(frozen=True, eq=False)
class Coverage:
    """Coverage by the views of a calibration.

    Attributes:
        size: (width, height) of the pictures, px.
        pixels: (n, 2) all corners of all views.
        parts: (3, 3) number of views that show each part of the picture.
        tilts: (views, 2) in degrees, towards the side of the picture on which the board is farther
            away.
        missing: Missing views as text.
    """

    size: tuple[int, int]
    pixels: Array
    parts: NDArray[np.int64]
    tilts: Array
    missing: tuple[str, ...]


def cover(
    found: Sequence[FoundPattern], rotations: Sequence[Array], size: tuple[int, int]
) -> Coverage:
    """Return the coverage by the views of a calibration.

    Args:
        found: The pattern in each view.
        rotations: ``rotation_camera_board`` (3, 3) of each view.
        size: (width, height) of the pictures, px.
    """
    parts = np.zeros((3, 3), dtype=np.int64)
    for view in found:
        cell = np.clip((view.pixels / size * 3).astype(int), 0, 2)
        counts = np.zeros((3, 3), dtype=np.int64)
        np.add.at(counts, (cell[:, 1], cell[:, 0]), 1)
        parts += counts >= _MIN_CORNERS
    tilts = np.array([_tilt(r) for r in rotations]).reshape(-1, 2)
    spacings = np.array([_spacing(f) for f in found])
    pixels = np.concatenate([f.pixels for f in found]) if found else np.zeros((0, 2))
    return Coverage(size, pixels, parts, tilts, tuple(_missing(parts, tilts, spacings)))


def _tilt(rotation: Array) -> Array:
    """Return the tilt in degrees, towards the side on which the board is farther away."""
    normal = rotation[:, 2] * (1.0 if rotation[2, 2] >= 0 else -1.0)
    across = float(np.hypot(normal[0], normal[1]))
    angle = np.degrees(np.arctan2(across, normal[2]))
    return -normal[:2] / max(across, 1e-12) * angle


def _spacing(view: FoundPattern) -> float:
    """Return pixels per metre: the root of the ratio of the areas that the corners span."""
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
        if parts[r, c] < _MIN_VIEWS
    ]
    for side, direction in TILTS.items():
        if not len(tilts) or (tilts @ np.array(direction)).max() < TILT_DEG:
            missing.append(f"the {side} side of the board tilted away")
    if len(spacings) > 1 and spacings.max() < _MIN_DEPTH_RATIO * spacings.min():
        missing.append("the board nearer and farther")
    return missing
