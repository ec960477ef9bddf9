"""Synthetic pictures of calibration patterns with exact truth, to measure a calibration with.

As in ``standard_set``, each pixel is the mean of many rays traced back through the lens to the paper; the
paper is a fine drawing of the pattern's own black rectangles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.patterns import Pattern
from robot_ik.camera.drawing.raster import paint_boxes
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.standard_set import Look, undistorted_grid
from robot_ik.geometry import Pose, rotation_exp

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Rays per pixel, on a lattice with as many different columns and rows.
_RAYS = 16
_LATTICE = np.stack([np.arange(_RAYS), np.arange(_RAYS) * 7 % _RAYS], axis=1) / _RAYS + 0.5 / _RAYS - 0.5
# remap takes both coordinates in one array; its type says nothing of that.
_NO_MAP: Any = None
# Of the paper's drawing, pixels along its longer side: several to each pixel of the picture.
_PAPER_PIXELS = 3000
# White round the print, in squares.
_MARGIN = 0.5


@dataclass(frozen=True, eq=False)
class PatternView:
    """A picture and its truth.

    Attributes:
        image: (height, width) uint8.
        pose: True ``pose_camera_board``.
    """

    image: Image
    pose: Pose


@lru_cache(maxsize=4)
def _paper(pattern: Pattern) -> tuple[Image, Array]:
    """The print (h, w) and the (3, 3) map from board metres to its pixels."""
    margin = _MARGIN * pattern.square
    width, height = (length + 2 * margin for length in pattern.size)
    scale = _PAPER_PIXELS / max(width, height)
    corner = np.array(pattern.origin) - margin
    boxes = pattern.black().copy()
    boxes[:, :2] -= corner
    drawn = paint_boxes(boxes * scale, round(width * scale), round(height * scale))
    to_pixels = np.array(
        [[scale, 0, -corner[0] * scale - 0.5], [0, scale, -corner[1] * scale - 0.5], [0, 0, 1]]
    )
    return drawn, to_pixels


@lru_cache(maxsize=1)
def _rays(camera: CameraIntrinsics) -> tuple[NDArray[np.float32], ...]:
    """For each ray of the lattice the undistorted coordinates (h, w, 2) of all pixels."""
    centres, slopes = undistorted_grid(camera)
    return tuple(
        np.asarray(centres + slopes[..., 0] * x + slopes[..., 1] * y, dtype=np.float32) for x, y in _LATTICE
    )


def render_pattern(
    pattern: Pattern, camera: CameraIntrinsics, pose: Pose, rng: np.random.Generator, look: Look | None = None
) -> Image:
    """One picture (height, width) uint8 of the pattern at ``pose`` (``pose_camera_board``)."""
    look = look or Look()
    paper, to_pixels = _paper(pattern)
    plane = np.column_stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.position])
    to_paper = to_pixels @ np.linalg.inv(plane)
    total = np.zeros((camera.height, camera.width), dtype=np.float32)
    for rays in _rays(camera):
        at = cv2.perspectiveTransform(rays, to_paper)
        # 128 beyond the paper: a grey wall.
        total += cv2.remap(
            paper, at, _NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128
        )
    canvas = look.black + (look.white - look.black) * (total.astype(float) / (255.0 * _RAYS))
    if look.blur > 0:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), look.blur), dtype=float)
    way = rng.uniform(0, 2 * np.pi)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, camera.width), np.linspace(-0.5, 0.5, camera.height))
    along = (x * np.cos(way) + y * np.sin(way)) / (abs(np.cos(way)) + abs(np.sin(way))) + 0.5
    canvas = canvas * (1.0 - look.gradient * along) + rng.normal(0.0, look.noise, canvas.shape)
    return np.clip(np.rint(canvas), 0, 255).astype(np.uint8)


def pattern_pose(
    pattern: Pattern,
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    *,
    tilt_deg: tuple[float, float] = (10.0, 45.0),
    fill: tuple[float, float] = (0.4, 1.0),
) -> Pose:
    """A ``pose_camera_board`` as a person holds a board: tilted any way, here and there in the picture.

    Args:
        pattern: The board.
        camera: The optics.
        rng: Source of chance.
        tilt_deg: Range of the angle between board and picture plane.
        fill: Range of the print's width in the picture, in picture widths, were it not tilted.
    """
    centre = np.array([*(np.array(pattern.origin) + np.array(pattern.size) / 2), 0.0])
    while True:
        depth = camera.fx * pattern.size[0] / (camera.width * rng.uniform(*fill))
        place = rng.uniform((0, 0), camera.size)
        tilt, azimuth = np.deg2rad(rng.uniform(*tilt_deg)), rng.uniform(0, 2 * np.pi)
        lean = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        turn = lean.compose(Pose(wxyz=rotation_exp([0.0, 0.0, rng.normal(0.0, 0.15)])))
        position = camera.unproject(place) * depth - turn.rotation @ centre
        pose = Pose(position, turn.wxyz)
        if _in_view(pattern, camera, pose):
            return pose


def _in_view(pattern: Pattern, camera: CameraIntrinsics, pose: Pose) -> bool:
    """Whether all inner corners are in the picture, with room for their patches."""
    columns, rows = pattern.corners
    start = np.array(pattern.origin) + pattern.square
    ends = [(start[0] + c * pattern.square, start[1] + r * pattern.square, 0.0)
            for c in (0, columns - 1) for r in (0, rows - 1)]  # fmt: skip
    pixels = camera.project(pose.apply(np.array(ends)))
    return bool((pixels > 12).all() and (pixels < np.array(camera.size) - 13).all())


def pattern_set(
    pattern: Pattern, camera: CameraIntrinsics, count: int, *, seed: int = 0, look: Look | None = None
) -> Iterator[PatternView]:
    """Pictures as a calibration wants them; the same seed gives the same ones."""
    rng = np.random.default_rng([seed, count])
    for _ in range(count):
        pose = pattern_pose(pattern, camera, rng)
        yield PatternView(render_pattern(pattern, camera, pose, rng, look), pose)
