"""How accurate corners, poses and overlays are: standard sets of pictures with exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera import Effort
from robot_ik.bench.quantity import Quantity
from robot_ik.camera.calibration.handeye import solve_handeye
from robot_ik.camera.calibration.intrinsic import calibrate
from robot_ik.camera.drawing.gl import make_artist
from robot_ik.camera.drawing.renderers import ARTISTS, Artist, DrawnRobot, PainterArtist
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.registration import BoardObservation, BoardTracker, LatencyOptions, Registrar
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.datasets import (
    STANDARD_CAMERA,
    STANDARD_DISTANCES,
    STANDARD_SIZE,
    handeye_set,
    pattern_set,
    random_pose,
    render_markers,
    standard_set,
)
from robot_ik.camera.synthetic.sensor import WEBCAM
from robot_ik.camera.targets import MarkerTarget, Observation, find_corners, marker_grid
from robot_ik.camera.targets import marker as marker_target
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp
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
# How well drawings lie on pictures, in pixels: measured against ``cv2.projectPoints`` and exact truth.


#: A lens with strong distortion, and the same without any.
BENT = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9, (-0.28, 0.09, 0.001, -0.0007, 0.0))
STRAIGHT = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9)
# Spheres in the picture: radius and margin round each, pixels.
_RADIUS_PX, _SPACING_PX = 8.0, 44
# Where a robot on the board may be: metres beside it and above it.
_BESIDE, _ABOVE, _POINTS = 0.15, 0.30, 120


@dataclass(frozen=True)
class Misses:
    """Distances between where things are and where they belong, pixels; ``bias``: larger part of the mean."""

    rms: float
    worst: float
    bias: float
    count: int

    @classmethod
    def of(cls, offsets: Sequence[Array]) -> Misses:
        """From offsets, each (2,) or (n, 2)."""
        off = np.vstack([np.zeros((0, 2)), *offsets])
        if not len(off):
            return cls(float("nan"), float("nan"), float("nan"), 0)
        length = np.linalg.norm(off, axis=1)
        return cls(
            float(np.sqrt(np.mean(length**2))),
            float(length.max()),
            float(np.abs(off.mean(axis=0)).max()),
            len(off),
        )


def projection_identity(artist: Artist, intrinsics: CameraIntrinsics = BENT, *, seed: int = 3) -> Misses:
    """Centres of drawn spheres against those that OpenCV projects.

    Spheres of 8 px radius at random depths all over the picture; the middle of what is drawn of each is
    compared with that of its outline, the circle at which rays of sight touch it, projected by
    ``cv2.projectPoints``.
    """
    rng = np.random.default_rng(seed)
    spec, spheres = mujoco.MjSpec(), []
    for x in np.arange(_SPACING_PX / 2, intrinsics.width - _SPACING_PX / 2 + 1, _SPACING_PX):
        for y in np.arange(_SPACING_PX / 2, intrinsics.height - _SPACING_PX / 2 + 1, _SPACING_PX):
            depth = rng.uniform(0.4, 2.0)
            pixel = np.array([[x, y]]) + rng.uniform(-4.0, 4.0, (1, 2))
            centre = intrinsics.unproject(pixel)[0] * depth
            radius = _RADIUS_PX * depth / intrinsics.fx
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre.tolist()
            )
            spheres.append((pixel[0], centre, radius))
    robot = DrawnRobot(spec.compile(), shadow=False)
    drawn = artist.draw(robot, [], intrinsics, Pose()).robot.mask(*intrinsics.size).astype(np.float32)
    half = _SPACING_PX // 2
    offsets = []
    for pixel, centre, radius in spheres:
        x, y = np.rint(pixel).astype(int)
        x0, y0 = max(x - half, 0), max(y - half, 0)
        alone = np.array([x0, y0]) + _middle(drawn[y0 : y + half, x0 : x + half])
        offsets.append(alone - outline_middle(centre, radius, intrinsics))
    return Misses.of(offsets)


def _middle(shape: NDArray[np.float32]) -> Array:
    """Centroid (2,) of what a mask holds, or of what an outline (n, 1, 2) encloses."""
    moments = cv2.moments(shape)
    if not moments["m00"]:
        return np.full(2, np.nan)
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]


def outline_middle(centre: Array, radius: float, intrinsics: CameraIntrinsics) -> Array:
    """Centroid (2,) of a sphere's outline in the picture, by ``cv2.projectPoints``."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)[:, None]
    shrink = (radius / distance) ** 2
    ring = radius * np.sqrt(1 - shrink) * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    coefficients = intrinsics.coefficients if len(intrinsics.distortion) else None
    pixels = np.asarray(
        cv2.projectPoints(
            centre * (1 - shrink) + ring, np.zeros(3), np.zeros(3), intrinsics.matrix, coefficients
        )[0]
    ).reshape(-1, 2)
    return pixels[0] + _middle((pixels - pixels[0]).astype(np.float32).reshape(-1, 1, 2))


def robot_points(seed: int = 0) -> Array:
    """Points (n, 3) where a robot standing on the board may be, board frame, metres."""
    rng = np.random.default_rng([seed, 46])
    return rng.uniform((-_BESIDE, -_BESIDE, 0.0), (_BESIDE, _BESIDE, _ABOVE), (_POINTS, 3))


def overlay_error(distance: float, count: int = 20, *, seed: int = 0) -> Misses:
    """From picture to overlay: points of a robot on a 2 x 2 board (112 mm), against exact truth.

    The pictures are those of the standard set (blur, noise, uneven light, tilts up to 60 degrees).
    """
    rng = np.random.default_rng([seed, round(1e3 * distance)])
    points, offsets = robot_points(seed), []
    for number in range(count):
        pose = random_pose(STANDARD_CAMERA, rng, distance, size=0.112)
        seen = BOARD.find(board_frame(pose, BOARD, rng, number=number), STANDARD_CAMERA)
        if seen is None:
            continue
        true, drawn = (STANDARD_CAMERA.project(p.apply(points)) for p in (pose, seen.pose))
        offsets.append((drawn - true)[_in_view(true)])
    return Misses.of(offsets)


def _in_view(pixels: Array) -> NDArray[np.bool_]:
    return np.asarray(((pixels > 0) & (pixels < np.array(STANDARD_CAMERA.size) - 1)).all(axis=1))


def hand_motion(t: float) -> Pose:
    """``pose_camera_board`` of a board that a hand moves about 0.8 m away: some 200 mm/s, 40 deg/s."""
    position = (
        0.060 * np.sin(2.6 * t) + 0.015 * np.sin(6.1 * t + 1.0),
        0.035 * np.sin(3.4 * t + 0.7),
        0.80 + 0.04 * np.sin(1.9 * t),
    )
    facing = Pose(wxyz=rotation_exp([np.pi, 0.0, 0.0]))
    lean = rotation_exp([-0.6 + 0.20 * np.sin(2.2 * t), 0.15 * np.sin(2.9 * t), 0.35 * np.sin(1.7 * t)])
    return Pose(position, facing.compose(Pose(wxyz=lean)).wxyz)


LATENCY_CASES: dict[str, tuple[float, LatencyOptions]] = {
    "nothing": (1.0, LatencyOptions("latest")),
    "less delay (half)": (0.5, LatencyOptions("latest")),
    "image shifting": (1.0, LatencyOptions("latest", shift=True)),
    "prediction": (1.0, LatencyOptions("latest", predict=True)),
    "prediction and shifting": (1.0, LatencyOptions("latest", predict=True, shift=True)),
    "delayed video": (0.0, LatencyOptions("tracked")),
}
"""Azuma's latency options: what part of the delay is left, and what is done about it."""


# Pictures a second of the registration that lags.
_RATE_HZ = 30.0


def latency_errors(delay: float = 0.066, seconds: float = 4.0) -> dict[str, Misses]:
    """Registration errors of a robot on a moving board when tracking and drawing take ``delay`` seconds.

    Each option is measured on the same pictures, with points of a robot on the board.
    """
    rng = np.random.default_rng([0, 5])
    steps = max(1, round(delay * _RATE_HZ))
    times = np.arange(round(seconds * _RATE_HZ)) / _RATE_HZ
    frames = [board_frame(hand_motion(t), BOARD, rng, number=k, time=float(t)) for k, t in enumerate(times)]
    # All options use the same observations.
    tracker = _RecordedTracker(frames)
    return {
        name: _latency_error(latency_options, round(share * steps), frames, tracker, robot_points(0))
        for name, (share, latency_options) in LATENCY_CASES.items()
    }


class _RecordedTracker(BoardTracker):
    """Tracks the board in some frames once, and returns the observations again and again."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__(BOARD, STANDARD_CAMERA)
        self._observations = [super(_RecordedTracker, self).observe(frame) for frame in frames]

    def observe(self, frame: Frame) -> BoardObservation | None:
        return self._observations[frame.sequence]


def _latency_error(
    latency_options: LatencyOptions,
    steps: int,
    frames: list[Frame],
    tracker: BoardTracker,
    points: Array,
) -> Misses:
    nobody = DrawnRobot(mujoco.MjSpec().compile())
    registrar = Registrar(tracker, PainterArtist(), nobody, STANDARD_CAMERA, latency_options)
    offsets = []
    for k in range(steps, len(frames)):
        seen = registrar.track(frames[k - steps])
        # the first half second is for the filter to find the speed
        pose, motion = registrar.place(seen, frames[k])
        if pose is None or frames[k].time < 0.5:
            continue
        true = STANDARD_CAMERA.project(hand_motion(frames[k].time).apply(points))
        drawn = STANDARD_CAMERA.project(pose.apply(points))
        if motion is not None:
            drawn = drawn @ motion[:, :2].T + motion[:, 2]
        offsets.append((drawn - true)[_in_view(true)])
    return Misses.of(offsets)


# ------------------------------------------------------------------------------------------
# Optics: a drawing where OpenCV projects it, a calibration and a hand-eye calibration near the truth.


# What is wanted of drawn spheres (RMS, worst, px) without and with a lens.
_WANTED = {"pinhole": (STRAIGHT, 0.05, 0.15), "with distortion": (BENT, 0.08, 0.20)}
# Of a robot on a board, by its distance, m.
_OVERLAY_WANTED, _OVERLAY_DISTANCES = (0.3, 1.0), (0.7, 1.0)
# The boards: squares of 30 mm with markers of 22 mm; 9 × 6 inner corners of squares of 25 mm.
_PATTERNS: dict[str, Pattern] = {
    "ChArUco 8×6": CharucoPattern(8, 6, 0.030, 0.022),
    "chessboard 9×6": ChessboardPattern(9, 6, 0.025),
}
_VIEWS, _SETS = 20, 3
# Hand-eye: how many poses, and the spread of their rotations in degrees.
_POSES, _SPREAD = 15, 25.0


def _figures(what: str, misses: Misses, most: tuple[float | None, float | None]) -> Iterator[Quantity]:
    """RMS and worst, and the most that is wanted of them."""
    yield Quantity(f"{what}, RMS", misses.rms, "px", most[0])
    yield Quantity(f"{what}, worst", misses.worst, "px", most[1])


def _spheres(artist: Artist, seed: int) -> Iterator[Quantity]:
    for kind, (lens, *most) in _WANTED.items():
        misses = projection_identity(artist, lens, seed=seed)
        yield from _figures(f"{artist.name} against projectPoints, {kind}", misses, (most[0], most[1]))


def projection(effort: Effort) -> Iterator[Quantity]:
    """Middles of spheres that are drawn without OpenGL, against OpenCV's projection."""
    for make in ARTISTS.values():
        yield from _spheres(make(), effort.seed)


def gl_projection(effort: Effort) -> Iterator[Quantity]:
    """The same by MuJoCo's renderer.

    Raises:
        CameraError: OpenGL does not work here.
    """
    artist, notice = make_artist("gl")
    if notice:
        raise CameraError(notice)
    try:
        yield from _spheres(artist, effort.seed)
    finally:
        artist.close()


def overlay(effort: Effort) -> Iterator[Quantity]:
    """Points of a robot, up to 300 mm above and 150 mm beside a 2×2 board, drawn with the pose seen."""
    for distance in _OVERLAY_DISTANCES:
        misses = overlay_error(distance, effort.count(60), seed=effort.seed)
        yield from _figures(f"overlay on a 2×2 board at {distance} m", misses, _OVERLAY_WANTED)


def latency(effort: Effort) -> Iterator[Quantity]:
    """What is left of a delay by each of Azuma's remedies; nothing is wanted of them."""
    for name, misses in latency_errors(seconds=1.1 if effort.quick else 4.0).items():
        yield from _figures(name, misses, (None, None))


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
