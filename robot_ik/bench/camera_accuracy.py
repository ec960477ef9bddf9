"""How accurate corners, poses and overlays are: standard sets of pictures with exact truth."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera_rows import Effort, Figure
from robot_ik.camera.goals import MarkerGoalSource
from robot_ik.camera.made_up.standard_set import (
    STANDARD_CAMERA,
    STANDARD_DISTANCES,
    STANDARD_SIZE,
    MarkerView,
    random_pose,
    render_markers,
    standard_set,
)
from robot_ik.camera.pose import BodyObservation, MarkerObservation
from robot_ik.camera.pose.bodies import grid_body
from robot_ik.camera.sources import ClosingSource, Frame
from robot_ik.camera.track import MarkerTracker
from robot_ik.geometry import Pose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

DICTIONARY = "DICT_4X4_50"
_MARKER = 7
# The board of 2×2: 112 mm; of 3×3: 174 mm.
_GAP = 0.012
# A pose farther off than this took the wrong one of the two that a square allows, rad.
_FLIPPED = np.deg2rad(5.0)
# Position and orientation of one 50 mm marker, by distance: mm, degrees.
_MARKER_WANTED = {0.3: (0.15, 0.3), 0.6: (0.5, 0.4), 1.0: (1.5, 0.8)}
_COVERED_DISTANCE, _BOARD_DISTANCE = 0.6, 1.0
# Clutter: pictures, squares in each, and their cells.
_CLUTTERED, _SQUARES = 150, 25


def frame_of(image: Image, number: int = 0, time: float = 0.0) -> Frame:
    """A grey picture as a frame without truth."""
    return Frame(np.ascontiguousarray(np.repeat(image[:, :, None], 3, axis=2)), time, number)


def rms(values: Array | list[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _seen(
    effort: Effort, distance: float, count: int
) -> Iterator[tuple[MarkerView, MarkerObservation | None]]:
    # Its number is named, as goals ask for it: a wall's squares now and then have the code of another one.
    tracker = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {_MARKER: STANDARD_SIZE})
    for number, view in enumerate(
        standard_set(distance, effort.count(count), seed=effort.seed, marker_id=_MARKER)
    ):
        seen = tracker.observe(frame_of(view.image, number))
        yield view, seen[0] if len(seen) == 1 else None


def corners(effort: Effort) -> Iterator[Figure]:
    """RMS error and bias of the corners, all distances together; the bias outwards is what becomes depth."""
    errors, outward = [], []
    for distance in STANDARD_DISTANCES:
        for view, seen in _seen(effort, distance, 60):
            if seen is None:
                continue
            error = seen.corners - view.corners
            way = view.corners - view.corners.mean(axis=0)
            errors.append(error)
            outward.append((error * way).sum(axis=1) / np.linalg.norm(way, axis=1))
    every = np.array(errors)
    bias = max(float(np.abs(every.mean(axis=(0, 1))).max()), abs(float(np.mean(outward))))
    yield Figure("corner error, RMS", float(np.sqrt((every**2).sum(axis=2).mean())), "px", 0.10)
    yield Figure("corner bias (x, y or outwards)", bias, "px", 0.03)


def marker(effort: Effort) -> Iterator[Figure]:
    """Position, orientation and flips of one 50 mm marker at three distances."""
    flips = missed = 0
    for distance in STANDARD_DISTANCES:
        off = []
        for view, seen in _seen(effort, distance, 100):
            missed += seen is None
            if seen is not None:
                off.append(seen.pose.distance(view.pose))
        flips += sum(angle > _FLIPPED for _, angle in off)
        metres, radians = np.array(off).T
        wanted = _MARKER_WANTED[distance]
        yield Figure(f"position at {distance} m, RMS", 1e3 * rms(metres), "mm", wanted[0])
        yield Figure(f"orientation at {distance} m, RMS", float(np.degrees(rms(radians))), "°", wanted[1])
    yield Figure("wrong branch (more than 5° off), up to 1 m", flips, "", 0)
    yield Figure("not found, up to 1 m", missed, "", 0)


def _boards(
    effort: Effort, side: int, distance: float, count: int, *, hidden: bool = False, tilt: float = 60.0
) -> Iterator[tuple[Pose, BodyObservation | None]]:
    """True pose and observation of a board of side × side markers, tilted by up to ``tilt`` degrees."""
    layout = grid_body(side, side, STANDARD_SIZE, _GAP).markers
    size = side * STANDARD_SIZE + (side - 1) * _GAP
    tracker = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {i: s for i, (s, _) in layout.items()})
    rng = np.random.default_rng([effort.seed, side, round(1000 * distance), hidden])
    for number in range(effort.count(count)):
        pose, _ = random_pose(STANDARD_CAMERA, rng, distance, size=size, tilt_deg=(0.0, tilt))
        placed = {i: (s, pose.compose(on)) for i, (s, on) in layout.items()}
        cover = _half(pose, size, rng) if hidden else None
        image = render_markers(
            STANDARD_CAMERA, placed, rng, dictionary=DICTIONARY, margin=_GAP / STANDARD_SIZE, cover=cover
        )
        yield pose, tracker.observe_body(frame_of(image, number), layout)


def _half(pose: Pose, size: float, rng: np.random.Generator) -> Array:
    """Outline (4, 2) in pixels of what hides half of a board, from a random side."""
    turn, far = rng.uniform(0.0, 2.0 * np.pi), 1.5 * size
    along, across = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
    outline = [far * across, far * across + far * along, far * along - far * across, -far * across]
    points = pose.apply(np.array(outline))
    points[:, 2] = np.maximum(points[:, 2], 0.05)
    return STANDARD_CAMERA.project(points)


def _board_figures(
    pairs: list[tuple[Pose, BodyObservation | None]], wanted: tuple[float, float, float | None], where: str
) -> Iterator[Figure]:
    off = np.array([seen.pose_camera_body.distance(pose) for pose, seen in pairs if seen is not None])
    yield Figure(f"position {where}, RMS", 1e3 * rms(off[:, 0]), "mm", wanted[0])
    yield Figure(f"orientation {where}, RMS", float(np.degrees(rms(off[:, 1]))), "°", wanted[1])
    yield Figure(f"orientation {where}, worst", float(np.degrees(off[:, 1].max())), "°", wanted[2])
    yield Figure(f"not found {where}", sum(seen is None for _, seen in pairs), "", 0)


def board(effort: Effort) -> Iterator[Figure]:
    """A board of 2×2 markers, 112 mm, at 1 m."""
    yield from _board_figures(list(_boards(effort, 2, _BOARD_DISTANCE, 100)), (0.3, 0.2, 1.0), "at 1 m")


def occlusion(effort: Effort) -> Iterator[Figure]:
    """A board of 3×3 markers at 0.6 m, half of its area hidden."""
    pairs = list(_boards(effort, 3, _COVERED_DISTANCE, 60, hidden=True))
    yield from _board_figures(pairs, (1.0, 0.3, None), "at 0.6 m, half hidden")


class _Clutter(ClosingSource):
    """Pictures full of squares of random bits: everything a marker has but the code."""

    live = False

    def __init__(self, seed: int) -> None:
        self._rng, self._number = np.random.default_rng([seed, 7]), 0

    def read(self) -> Frame:
        rng = self._rng
        image = rng.integers(90, 200, (480, 640)).astype(np.uint8)
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 3), dtype=np.uint8)
        for _ in range(_SQUARES):
            cells, cell = int(rng.integers(4, 9)), int(rng.integers(3, 9))
            bits = np.zeros((cells + 2, cells + 2), np.uint8)
            bits[1:-1, 1:-1] = 255 * rng.integers(0, 2, (cells, cells))
            tile = np.pad(np.kron(bits, np.ones((cell, cell), np.uint8)), cell, constant_values=255)
            height, width = tile.shape
            y, x = rng.integers(0, 480 - height), rng.integers(0, 640 - width)
            image[y : y + height, x : x + width] = tile
        self._number += 1
        return frame_of(image, self._number, 0.05 * self._number)


def clutter(effort: Effort) -> Iterator[Figure]:
    """Goals, and finds of any id, in 150 cluttered pictures without a marker."""
    tracker, source = MarkerTracker(STANDARD_CAMERA, "DICT_5X5_50", STANDARD_SIZE), _Clutter(effort.seed)
    finds, false, count = 0, 0, effort.count(_CLUTTERED)
    for number in range(count):
        frame = source.read()
        seen = tracker.observe(frame)
        finds += len(seen)
        for marker_id in {observation.id for observation in seen}:
            one = MarkerGoalSource(_One(frame), tracker, Pose(), marker_id, Pose())
            false += one.poll(0.05 * number) is not None
    yield Figure(f"false goals in {count} cluttered pictures, any of 50 ids", false, "", 0)
    yield Figure("false finds in them (DICT_5X5_50)", finds, "", 0)


class _One(ClosingSource):
    """One frame for ever."""

    live = False

    def __init__(self, frame: Frame) -> None:
        self._frame = frame

    def read(self) -> Frame:
        return self._frame
