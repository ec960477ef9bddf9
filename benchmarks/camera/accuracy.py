"""How accurate corners, poses and overlays are: standard sets of pictures with exact truth."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.camera.pictures import STANDARD_DISTANCES, handeye_set, pattern_set, standard_set
from benchmarks.camera.rows import Effort
from robot_ik.camera.calibration.handeye import solve_handeye
from robot_ik.camera.calibration.intrinsic import calibrate
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import (
    STANDARD_CAMERA,
    STANDARD_SIZE,
    random_pose,
    render_markers,
)
from robot_ik.camera.synthetic.sensor import WEBCAM
from robot_ik.camera.targets import MarkerTarget, Observation, find_corners, marker_grid
from robot_ik.camera.targets import marker as marker_target
from robot_ik.geometry import Pose
from robot_ik.jobs.ar import self_test
from robot_ik.jobs.quantity import Quantity
from robot_ik.ports import Array, Image

DICTIONARY = "DICT_4X4_50"
MARKER = 7
# The board of 2×2: 112 mm; of 3×3: 174 mm.
GAP = 0.012
BOARD = marker_grid(2, 2, STANDARD_SIZE, GAP, dictionary=DICTIONARY)
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


def factor(ratio: float) -> float:
    """The same above 1, whichever is larger."""
    return max(ratio, 1.0 / ratio)


def outward(error: Array, corners: Array) -> Array:
    """How far corners (4, 2) that are off by ``error`` (4, 2) lie outwards, along the diagonals: (4,)."""
    direction = corners - corners.mean(axis=0)
    return np.asarray((error * direction).sum(axis=1) / np.linalg.norm(direction, axis=1))


def board_frame(
    pose: Pose,
    board: MarkerTarget,
    rng: np.random.Generator,
    *,
    margin: float = 0.12,
    cover: Array | None = None,
    number: int = 0,
    time: float = 0.0,
) -> Frame:
    """A board of markers at ``pose`` (camera frame) in a picture of a webcam."""
    placed = {id: (side, pose.compose(on)) for id, (side, on) in board.markers.items()}
    image = render_markers(
        STANDARD_CAMERA, placed, rng, dictionary=board.dictionary, margin=margin, cover=cover, sensor=WEBCAM
    )
    return frame_of(image, number, time)


def marker(effort: Effort) -> Iterator[Quantity]:
    """Corners, position, orientation and flips of one 50 mm marker at three distances."""
    target = marker_target(MARKER, STANDARD_SIZE, DICTIONARY)
    flips, missed, errors, outwards = 0, 0, [], []
    for distance in STANDARD_DISTANCES:
        views = standard_set(distance, effort.count(100), seed=effort.seed, marker_id=MARKER, sensor=WEBCAM)
        off = []
        for number, view in enumerate(views):
            seen = target.find(frame_of(view.image, number), STANDARD_CAMERA)
            if seen is None:
                missed += 1
                continue
            off.append(seen.pose.distance(view.pose))
            errors.append(seen.pixels - view.corners)
            outwards.append(outward(errors[-1], view.corners))
        flips += sum(angle > _FLIPPED for _, angle in off)
        metres, radians = np.array(off).T
        wanted = _MARKER_WANTED[distance]
        yield Quantity(f"position at {distance} m, RMS", 1e3 * rms(metres), "mm", wanted[0])
        yield Quantity(f"orientation at {distance} m, RMS", float(np.degrees(rms(radians))), "°", wanted[1])
    every = np.array(errors)
    # The bias outwards is what becomes depth.
    bias = max(float(np.abs(every.mean(axis=(0, 1))).max()), abs(float(np.mean(outwards))))
    yield Quantity("corner error, RMS", float(np.sqrt((every**2).sum(axis=2).mean())), "px", 0.10)
    yield Quantity("corner bias (x, y or outwards)", bias, "px", 0.03)
    yield Quantity("wrong branch (more than 5° off), up to 1 m", flips, "", 0)
    yield Quantity("not found, up to 1 m", missed, "", 0)


def _boards(
    effort: Effort, side: int, distance: float, count: int, *, hidden: bool = False
) -> Iterator[tuple[Pose, Observation | None]]:
    """True pose and observation of a board of side × side markers, tilted by up to 60 degrees."""
    target = marker_grid(side, side, STANDARD_SIZE, GAP, dictionary=DICTIONARY)
    size = side * STANDARD_SIZE + (side - 1) * GAP
    rng = np.random.default_rng([effort.seed, side, round(1000 * distance), hidden])
    for number in range(effort.count(count)):
        pose = random_pose(STANDARD_CAMERA, rng, distance, size=size, tilt_deg=(0.0, 60.0))
        cover = _half(pose, size, rng) if hidden else None
        frame = board_frame(pose, target, rng, margin=GAP / STANDARD_SIZE, cover=cover, number=number)
        yield pose, target.find(frame, STANDARD_CAMERA)


def _half(pose: Pose, size: float, rng: np.random.Generator) -> Array:
    """Outline (4, 2) in pixels of what hides half of a board, from a random side."""
    angle, far = rng.uniform(0.0, 2.0 * np.pi), 1.5 * size
    along, across = (
        np.array([np.cos(angle), np.sin(angle), 0.0]),
        np.array([-np.sin(angle), np.cos(angle), 0.0]),
    )
    outline = [far * across, far * across + far * along, far * along - far * across, -far * across]
    points = pose.apply(np.array(outline))
    points[:, 2] = np.maximum(points[:, 2], 0.05)
    return STANDARD_CAMERA.project(points)


def _board_figures(
    pairs: list[tuple[Pose, Observation | None]], wanted: tuple[float, float, float | None], where: str
) -> Iterator[Quantity]:
    off = np.array([seen.pose.distance(pose) for pose, seen in pairs if seen is not None])
    yield Quantity(f"position {where}, RMS", 1e3 * rms(off[:, 0]), "mm", wanted[0])
    yield Quantity(f"orientation {where}, RMS", float(np.degrees(rms(off[:, 1]))), "°", wanted[1])
    yield Quantity(f"orientation {where}, worst", float(np.degrees(off[:, 1].max())), "°", wanted[2])
    yield Quantity(f"not found {where}", sum(seen is None for _, seen in pairs), "", 0)


def board(effort: Effort) -> Iterator[Quantity]:
    """A board of 2×2 markers, 112 mm, at 1 m."""
    yield from _board_figures(list(_boards(effort, 2, _BOARD_DISTANCE, 100)), (0.3, 0.2, 1.0), "at 1 m")


def occlusion(effort: Effort) -> Iterator[Quantity]:
    """A board of 3×3 markers at 0.6 m, half of its area hidden."""
    pairs = list(_boards(effort, 3, _COVERED_DISTANCE, 60, hidden=True))
    yield from _board_figures(pairs, (1.0, 0.3, None), "at 0.6 m, half hidden")


def _cluttered(seed: int, count: int) -> Iterator[Frame]:
    """Pictures full of squares of random bits: everything a marker has but the code."""
    rng = np.random.default_rng([seed, 7])
    for number in range(count):
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
        yield frame_of(image, number)


def clutter(effort: Effort) -> Iterator[Quantity]:
    """Finds of any id in 150 cluttered pictures without a marker: each could become a goal."""
    count = effort.count(_CLUTTERED)
    finds = 0
    for frame in _cluttered(effort.seed, count):
        finds += len(find_corners(frame, STANDARD_CAMERA, "DICT_5X5_50"))
    yield Quantity(f"false finds in {count} cluttered pictures (DICT_5X5_50)", finds, "", 0)


# ------------------------------------------------------------------------------------------
# Optics: a drawing where OpenCV projects it, a calibration and a hand-eye calibration near the truth.


# The boards: squares of 30 mm with markers of 22 mm; 9 × 6 inner corners of squares of 25 mm.
_PATTERNS: dict[str, Pattern] = {
    "ChArUco 8×6": CharucoPattern(8, 6, 0.030, 0.022),
    "chessboard 9×6": ChessboardPattern(9, 6, 0.025),
}
_VIEWS, _SETS = 20, 3
# Hand-eye: how many poses, and the spread of their rotations in degrees.
_POSES, _SPREAD = 15, 25.0


def projection(effort: Effort) -> Iterator[Quantity]:
    """Middles of drawn spheres against OpenCV's projection."""
    yield from self_test.projection(effort.seed)


def overlay(effort: Effort) -> Iterator[Quantity]:
    """Points of a robot, up to 300 mm above and 150 mm beside a 2×2 board, drawn with the pose seen."""
    yield from self_test.overlay(effort.seed, effort.count(60))


def latency(effort: Effort) -> Iterator[Quantity]:
    """What is left of a delay by each of Azuma's remedies; nothing is wanted of them."""
    yield from self_test.latency(1.1 if effort.quick else 4.0)


def calibration(effort: Effort) -> Iterator[Quantity]:
    """Intrinsics from 20 pictures of a board; worst of the sets tried."""
    for name, pattern in _PATTERNS.items():
        focal, centre, error, counted = [], [], [], []
        for trial in range(1 if effort.quick else _SETS):
            # Other seeds, other sets: none is measured twice.
            seed = _SETS * (effort.seed - 1) + trial + 1
            views = pattern_set(pattern, STANDARD_CAMERA, _VIEWS, seed=seed, sensor=WEBCAM)
            found = [seen for image, _ in views if (seen := pattern.find(image)) is not None]
            lens, true = calibrate(found, STANDARD_CAMERA.size).intrinsics, STANDARD_CAMERA
            focal.append(max(abs(lens.fx / true.fx - 1.0), abs(lens.fy / true.fy - 1.0)))
            centre.append(float(np.hypot(lens.cx - true.cx, lens.cy - true.cy)))
            error.append(lens.rms or np.nan)
            counted.append(len(found))
        yield Quantity(f"{name}: focal length, off by", 100.0 * max(focal), "%", 0.15)
        yield Quantity(f"{name}: optical centre, off by", max(centre), "px", 2.0)
        yield Quantity(f"{name}: reprojection error, RMS", max(error), "px", 0.2)
        yield Quantity(f"{name}: views in which the board was found", min(counted), "", least=_VIEWS)


def handeye(effort: Effort) -> Iterator[Quantity]:
    """Camera on the hand: true error and stated uncertainty, from 15 poses and a single 50 mm marker."""
    off, stated = [], []
    for trial in range(effort.count(40)):
        truth, samples = handeye_set(_POSES, spread_deg=_SPREAD, seed=1000 * effort.seed + trial)
        found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_in_hand")
        off.append(found.pose_parent_camera.distance(truth.pose_parent_camera))
        stated.append((found.sigma_position, found.sigma_angle))
    error, sigma = np.array(off), np.array(stated)
    yield Quantity("camera on the hand, position, RMS", 1e3 * rms(error[:, 0]), "mm", 1.5)
    yield Quantity("camera on the hand, orientation, RMS", float(np.degrees(rms(error[:, 1]))), "°", 0.25)
    for k, what in enumerate(("position", "orientation")):
        ratio = factor(rms(error[:, k]) / rms(sigma[:, k]))
        yield Quantity(f"stated {what} off by a factor of", ratio, "", 2.0)
