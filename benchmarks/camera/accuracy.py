"""Accuracy of corners, poses, calibrations and overlays, from pictures with exact truth."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.camera import drawing_errors
from benchmarks.camera.pictures import STANDARD_DISTANCES, handeye_set, pattern_set, standard_set
from benchmarks.camera.rows import Effort
from benchmarks.quantity import Quantity
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
from robot_ik.ports import Array, Image

#: Of the standard marker.
DICTIONARY = "DICT_4X4_50"
MARKER = 7
#: White between the markers of a board, metres. A board of 2×2 has 112 mm, one of 3×3 174 mm.
GAP = 0.012
BOARD = marker_grid(2, 2, STANDARD_SIZE, GAP, dictionary=DICTIONARY)

# A pose with a larger error is the wrong one of the two that a square allows, rad.
_FLIPPED = np.deg2rad(5.0)
# Limits of one 50 mm marker by its distance in metres: position, mm, and orientation, degrees.
_MARKER_LIMITS = {0.3: (0.15, 0.3), 0.6: (0.5, 0.4), 1.0: (1.5, 0.8)}
# Numbers of pictures.
_MARKER_PICTURES = 100
_BOARD_PICTURES = 100
_OCCLUDED_PICTURES = 60
_OVERLAY_PICTURES = 60
_CLUTTERED_PICTURES = 150
# Distances of the board and of the half hidden board, metres.
_BOARD_DISTANCE = 1.0
_OCCLUDED_DISTANCE = 0.6
# Limits of the boards: position, mm, orientation, degrees, and its largest error, degrees.
_BOARD_LIMITS = (0.3, 0.2, 1.0)
_OCCLUDED_LIMITS = (1.0, 0.3, None)
# An object in front of a board is at least this far from the lens, metres.
_NEAREST = 0.05
# Squares in a cluttered picture.
_SQUARES = 25
# Length of the film with a delay, and of the quick one, s.
_LATENCY_SECONDS = 4.0
_QUICK_LATENCY_SECONDS = 1.1
# The boards of the calibration: squares of 30 mm with markers of 22 mm; squares of 25 mm.
_PATTERNS: dict[str, Pattern] = {
    "ChArUco 8×6": CharucoPattern(8, 6, 0.030, 0.022),
    "chessboard 9×6": ChessboardPattern(9, 6, 0.025),
}
# Calibration: views in a set, and number of sets.
_VIEWS = 20
_SETS = 3
# Hand-eye calibration: poses in a set, number of sets, and spread of the rotations, degrees.
_POSES = 15
_HANDEYE_SETS = 40
_SPREAD_DEG = 25.0


def frame_of(image: Image, number: int = 0, time: float = 0.0) -> Frame:
    """Return a grey picture (h, w) as a frame without truth."""
    return Frame(np.ascontiguousarray(np.repeat(image[:, :, None], 3, axis=2)), time, number)


def rms(values: Array | list[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def factor(ratio: float) -> float:
    """Return the ratio or its inverse, whichever is larger."""
    return max(ratio, 1.0 / ratio)


def outward(error: Array, corners: Array) -> Array:
    """Return the outward part (4,), along the diagonals, of the errors (4, 2) of corners (4, 2)."""
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
    """Return a webcam's picture of a board.

    Args:
        pose: ``pose_camera_board``.
        board: The markers.
        rng: For wall, light and noise.
        margin: White paper round each marker, in marker sizes.
        cover: (k, 2) pixels, the outline of an object in front.
        number: Of the frame.
        time: Of the frame, s.
    """
    placed = {id: (side, pose.compose(on)) for id, (side, on) in board.markers.items()}
    image = render_markers(
        STANDARD_CAMERA,
        placed,
        rng,
        dictionary=board.dictionary,
        margin=margin,
        cover=cover,
        sensor=WEBCAM,
    )
    return frame_of(image, number, time)


def marker(effort: Effort) -> Iterator[Quantity]:
    """Measure corners, pose and wrong pose solutions of one 50 mm marker at three distances."""
    target = marker_target(MARKER, STANDARD_SIZE, DICTIONARY)
    flips = 0
    missed = 0
    errors = []
    outwards = []
    for distance in STANDARD_DISTANCES:
        count = effort.count(_MARKER_PICTURES)
        views = standard_set(distance, count, seed=effort.seed, marker_id=MARKER, sensor=WEBCAM)
        pose_errors = []
        for number, view in enumerate(views):
            observation = target.find(frame_of(view.image, number), STANDARD_CAMERA)
            if observation is None:
                missed += 1
                continue
            pose_errors.append(observation.pose.distance(view.pose))
            errors.append(observation.pixels - view.corners)
            outwards.append(outward(errors[-1], view.corners))
        flips += sum(angle > _FLIPPED for _, angle in pose_errors)
        metres, radians = np.array(pose_errors).T
        degrees = float(np.degrees(rms(radians)))
        limits = _MARKER_LIMITS[distance]
        yield Quantity(f"position at {distance} m, RMS", 1e3 * rms(metres), "mm", limits[0])
        yield Quantity(f"orientation at {distance} m, RMS", degrees, "°", limits[1])
    offsets = np.array(errors)
    # The outward bias becomes an error of depth.
    sideways = float(np.abs(offsets.mean(axis=(0, 1))).max())
    bias = max(sideways, abs(float(np.mean(outwards))))
    corner_rms = float(np.sqrt((offsets**2).sum(axis=2).mean()))
    yield Quantity("corner error, RMS", corner_rms, "px", 0.10)
    yield Quantity("corner bias (x, y or outwards)", bias, "px", 0.03)
    yield Quantity("wrong branch (more than 5° off), up to 1 m", flips, "", 0)
    yield Quantity("not found, up to 1 m", missed, "", 0)


def _boards(
    effort: Effort, side: int, distance: float, count: int, *, hidden: bool = False
) -> Iterator[tuple[Pose, Observation | None]]:
    """Return true pose and observation of boards of side × side markers, tilted by up to 60°."""
    target = marker_grid(side, side, STANDARD_SIZE, GAP, dictionary=DICTIONARY)
    size = side * STANDARD_SIZE + (side - 1) * GAP
    rng = np.random.default_rng([effort.seed, side, round(1000 * distance), hidden])
    for number in range(effort.count(count)):
        pose = random_pose(STANDARD_CAMERA, rng, distance, size=size, tilt_deg=(0.0, 60.0))
        cover = _half_outline(pose, size, rng) if hidden else None
        margin = GAP / STANDARD_SIZE
        frame = board_frame(pose, target, rng, margin=margin, cover=cover, number=number)
        yield pose, target.find(frame, STANDARD_CAMERA)


def _half_outline(pose: Pose, size: float, rng: np.random.Generator) -> Array:
    """Return the outline (4, 2), px, of an object that hides half of a board, on a random side."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    far = 1.5 * size
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    outline = [far * across, far * across + far * along, far * along - far * across, -far * across]
    points = pose.apply(np.array(outline))
    points[:, 2] = np.maximum(points[:, 2], _NEAREST)
    return STANDARD_CAMERA.project(points)


def _board_figures(
    pairs: list[tuple[Pose, Observation | None]],
    limits: tuple[float, float, float | None],
    where: str,
) -> Iterator[Quantity]:
    """Return the figures of a board."""
    observed = [(pose, observation) for pose, observation in pairs if observation is not None]
    errors = np.array([observation.pose.distance(pose) for pose, observation in observed])
    degrees = np.degrees(errors[:, 1])
    yield Quantity(f"position {where}, RMS", 1e3 * rms(errors[:, 0]), "mm", limits[0])
    yield Quantity(f"orientation {where}, RMS", rms(degrees), "°", limits[1])
    yield Quantity(f"orientation {where}, worst", float(degrees.max()), "°", limits[2])
    yield Quantity(f"not found {where}", len(pairs) - len(observed), "", 0)


def board(effort: Effort) -> Iterator[Quantity]:
    """Measure a board of 2×2 markers, 112 mm, at 1 m."""
    pairs = list(_boards(effort, 2, _BOARD_DISTANCE, _BOARD_PICTURES))
    yield from _board_figures(pairs, _BOARD_LIMITS, "at 1 m")


def occlusion(effort: Effort) -> Iterator[Quantity]:
    """Measure a board of 3×3 markers at 0.6 m with half of its area hidden."""
    pairs = list(_boards(effort, 3, _OCCLUDED_DISTANCE, _OCCLUDED_PICTURES, hidden=True))
    yield from _board_figures(pairs, _OCCLUDED_LIMITS, "at 0.6 m, half hidden")


def _cluttered(seed: int, count: int) -> Iterator[Frame]:
    """Return pictures full of squares of random bits. Only the code of a marker is missing."""
    rng = np.random.default_rng([seed, 7])
    for number in range(count):
        image = rng.integers(90, 200, (480, 640)).astype(np.uint8)
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 3), dtype=np.uint8)
        for _ in range(_SQUARES):
            cells = int(rng.integers(4, 9))
            cell = int(rng.integers(3, 9))
            bits = np.zeros((cells + 2, cells + 2), np.uint8)
            bits[1:-1, 1:-1] = 255 * rng.integers(0, 2, (cells, cells))
            tile = np.pad(np.kron(bits, np.ones((cell, cell), np.uint8)), cell, constant_values=255)
            height, width = tile.shape
            y = rng.integers(0, 480 - height)
            x = rng.integers(0, 640 - width)
            image[y : y + height, x : x + width] = tile
        yield frame_of(image, number)


def clutter(effort: Effort) -> Iterator[Quantity]:
    """Count finds of any id in cluttered pictures without a marker. Each could become a goal."""
    count = effort.count(_CLUTTERED_PICTURES)
    finds = 0
    for frame in _cluttered(effort.seed, count):
        finds += len(find_corners(frame, STANDARD_CAMERA, "DICT_5X5_50"))
    yield Quantity(f"false finds in {count} cluttered pictures (DICT_5X5_50)", finds, "", 0)


def projection(effort: Effort) -> Iterator[Quantity]:
    """Compare the centres of drawn spheres with OpenCV's projection."""
    yield from drawing_errors.projection(effort.seed)


def overlay(effort: Effort) -> Iterator[Quantity]:
    """Measure points of a robot, up to 300 mm above a 2×2 board, drawn with the found pose."""
    yield from drawing_errors.overlay(effort.seed, effort.count(_OVERLAY_PICTURES))


def latency(effort: Effort) -> Iterator[Quantity]:
    """Measure the remaining delay with each of Azuma's remedies, without limits."""
    yield from drawing_errors.latency(_QUICK_LATENCY_SECONDS if effort.quick else _LATENCY_SECONDS)


def calibration(effort: Effort) -> Iterator[Quantity]:
    """Measure intrinsics from 20 pictures of a board. The figures are those of the worst set."""
    true = STANDARD_CAMERA
    for name, pattern in _PATTERNS.items():
        focal = []
        centre = []
        error = []
        counted = []
        for trial in range(1 if effort.quick else _SETS):
            # Each seed has its own sets.
            seed = _SETS * (effort.seed - 1) + trial + 1
            pictures = pattern_set(pattern, true, _VIEWS, seed=seed, sensor=WEBCAM)
            views = [view for image, _ in pictures if (view := pattern.find(image)) is not None]
            lens = calibrate(views, true.size).intrinsics
            focal.append(max(abs(lens.fx / true.fx - 1.0), abs(lens.fy / true.fy - 1.0)))
            centre.append(float(np.hypot(lens.cx - true.cx, lens.cy - true.cy)))
            error.append(lens.rms or np.nan)
            counted.append(len(views))
        count = min(counted)
        yield Quantity(f"{name}: focal length, off by", 100.0 * max(focal), "%", 0.15)
        yield Quantity(f"{name}: optical centre, off by", max(centre), "px", 2.0)
        yield Quantity(f"{name}: reprojection error, RMS", max(error), "px", 0.2)
        yield Quantity(f"{name}: views in which the board was found", count, "", least=_VIEWS)


def handeye(effort: Effort) -> Iterator[Quantity]:
    """Measure a camera on the hand, from 15 poses of a marker: error and stated uncertainty."""
    errors = []
    stated = []
    for trial in range(effort.count(_HANDEYE_SETS)):
        seed = 1000 * effort.seed + trial
        truth, samples = handeye_set(_POSES, spread_deg=_SPREAD_DEG, seed=seed)
        result = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_in_hand")
        errors.append(result.pose_parent_camera.distance(truth.pose_parent_camera))
        stated.append((result.sigma_position, result.sigma_angle))
    error = np.array(errors)
    sigma = np.array(stated)
    degrees = float(np.degrees(rms(error[:, 1])))
    yield Quantity("camera on the hand, position, RMS", 1e3 * rms(error[:, 0]), "mm", 1.5)
    yield Quantity("camera on the hand, orientation, RMS", degrees, "°", 0.25)
    for k, what in enumerate(("position", "orientation")):
        ratio = factor(rms(error[:, k]) / rms(sigma[:, k]))
        yield Quantity(f"stated {what} off by a factor of", ratio, "", 2.0)
