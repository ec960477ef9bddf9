"""Errors of drawings in pictures, in pixels: against ``cv2.projectPoints`` and exact truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.quantity import Quantity
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.registration import (
    BoardObservation,
    BoardTracker,
    LatencyOptions,
    Registrar,
)
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import (
    STANDARD_CAMERA,
    STANDARD_SIZE,
    random_pose,
    render_markers,
)
from robot_ik.camera.synthetic.sensor import WEBCAM
from robot_ik.camera.targets import marker_grid
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array

#: A lens with strong distortion, and the same lens without any.
DISTORTED = CameraIntrinsics(
    640, 480, 612.0, 605.0, 331.3, 228.9, (-0.28, 0.09, 0.001, -0.0007, 0.0)
)
PINHOLE = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9)
#: Azuma's remedies for delay: the remaining part of the delay, and the options.
REMEDIES: dict[str, tuple[float, LatencyOptions]] = {
    "nothing": (1.0, LatencyOptions("latest")),
    "less delay (half)": (0.5, LatencyOptions("latest")),
    "image shifting": (1.0, LatencyOptions("latest", shift=True)),
    "prediction": (1.0, LatencyOptions("latest", predict=True)),
    "prediction and shifting": (1.0, LatencyOptions("latest", predict=True, shift=True)),
    "delayed video": (0.0, LatencyOptions("tracked")),
}

# The largest RMS and single error of drawn spheres that pass, px.
_SPHERE_LIMITS = {"pinhole": (0.05, 0.15), "with distortion": (0.08, 0.20)}
# The same of a robot on a board, px, and the distances of the board, metres.
_OVERLAY_LIMITS = (0.3, 1.0)
_OVERLAY_DISTANCES = (0.7, 1.0)
# Radius of a drawn sphere and distance between two, px.
_SPHERE_RADIUS = 8.0
_SPHERE_SPACING = 44
# Range of depths of the spheres, metres.
_SPHERE_DEPTHS = (0.4, 2.0)
# Where points of a robot on a board may be, metres beside the board and above it; how many.
_BESIDE = 0.15
_ABOVE = 0.30
_POINT_COUNT = 120
# The board: 2 x 2 markers of 50 mm, this far apart, metres; its side; white paper round each
# marker, in marker sizes.
_GAP = 0.012
_BOARD = marker_grid(2, 2, STANDARD_SIZE, _GAP, dictionary="DICT_4X4_50")
_BOARD_SIDE = 2 * STANDARD_SIZE + _GAP
_PAPER = 0.12
# Pictures per second of the registration that lags.
_RATE_HZ = 30.0
# The filter needs this time to find the speed of the board, s.
_SETTLING = 0.5


@dataclass(frozen=True)
class DrawingErrors:
    """Distances between drawn and true positions, px.

    Attributes:
        rms: Root mean square.
        worst: The largest.
        bias: The larger component of the mean offset.
        count: Number of offsets.
    """

    rms: float
    worst: float
    bias: float
    count: int

    @classmethod
    def of(cls, offsets: Sequence[Array]) -> DrawingErrors:
        """Return the statistics of offsets, each (2,) or (n, 2). NaN without any."""
        errors = np.vstack([np.zeros((0, 2)), *offsets])
        if not len(errors):
            return cls(float("nan"), float("nan"), float("nan"), 0)
        length = np.linalg.norm(errors, axis=1)
        return cls(
            float(np.sqrt(np.mean(length**2))),
            float(length.max()),
            float(np.abs(errors.mean(axis=0)).max()),
            len(errors),
        )


def projection(seed: int = 1) -> Iterator[Quantity]:
    """Measure the middles of drawn spheres against OpenCV's projection."""
    for kind, lens in (("pinhole", PINHOLE), ("with distortion", DISTORTED)):
        errors = projection_errors(lens, seed=seed)
        yield from _figures(f"painter against projectPoints, {kind}", errors, _SPHERE_LIMITS[kind])


def overlay(seed: int = 1, count: int = 60) -> Iterator[Quantity]:
    """Measure points of a robot on a 2×2 board, drawn with the pose found in ``count`` pictures."""
    for distance in _OVERLAY_DISTANCES:
        errors = overlay_errors(distance, count, seed=seed)
        yield from _figures(f"overlay on a 2×2 board at {distance} m", errors, _OVERLAY_LIMITS)


def latency(seconds: float = 4.0) -> Iterator[Quantity]:
    """Measure what is left of a delay with each remedy. These figures have no limits."""
    for name, errors in latency_errors(seconds=seconds).items():
        yield from _figures(name, errors, (None, None))


def projection_errors(
    intrinsics: CameraIntrinsics = DISTORTED,
    *,
    seed: int = 3,
    drawn_through: CameraIntrinsics | None = None,
) -> DrawingErrors:
    """Compare the centroids of drawn spheres with those that OpenCV projects.

    Spheres of 8 px radius at random depths fill the picture. The outline of a sphere is the circle
    at which the rays of sight touch it.

    Args:
        intrinsics: Lens of the picture.
        seed: Of the places of the spheres.
        drawn_through: Lens of the drawing. Default: ``intrinsics``.
    """
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spheres = []
    first = _SPHERE_SPACING / 2
    for x in np.arange(first, intrinsics.width - first + 1, _SPHERE_SPACING):
        for y in np.arange(first, intrinsics.height - first + 1, _SPHERE_SPACING):
            depth = rng.uniform(*_SPHERE_DEPTHS)
            pixel = np.array([[x, y]]) + rng.uniform(-4.0, 4.0, (1, 2))
            centre = intrinsics.unproject(pixel)[0] * depth
            radius = _SPHERE_RADIUS * depth / intrinsics.fx
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre.tolist()
            )
            spheres.append((pixel[0], centre, radius))
    robot = DrawnRobot(spec.compile(), shadow=False)
    layer = robot.draw([], drawn_through or intrinsics, Pose()).robot
    coverage = layer.mask(*intrinsics.size).astype(np.float32)
    half = _SPHERE_SPACING // 2
    offsets = []
    for pixel, centre, radius in spheres:
        x, y = np.rint(pixel).astype(int)
        x0 = max(x - half, 0)
        y0 = max(y - half, 0)
        middle = np.array([x0, y0]) + _centroid(coverage[y0 : y + half, x0 : x + half])
        offsets.append(middle - _outline_centroid(centre, radius, intrinsics))
    return DrawingErrors.of(offsets)


def robot_points(seed: int = 0) -> Array:
    """Return points (n, 3) where a robot on the board may be, board frame, metres."""
    rng = np.random.default_rng([seed, 46])
    lower = (-_BESIDE, -_BESIDE, 0.0)
    upper = (_BESIDE, _BESIDE, _ABOVE)
    return rng.uniform(lower, upper, (_POINT_COUNT, 3))


def overlay_errors(distance: float, count: int = 20, *, seed: int = 0) -> DrawingErrors:
    """Compare points of a robot on a 2 x 2 board (112 mm), from picture to overlay, with truth.

    The pictures have blur, noise, uneven light, and tilts up to 60 degrees.

    Args:
        distance: Of the board, metres.
        count: Number of pictures.
        seed: Of the pictures.
    """
    rng = np.random.default_rng([seed, round(1e3 * distance)])
    points = robot_points(seed)
    offsets = []
    for number in range(count):
        pose = random_pose(STANDARD_CAMERA, rng, distance, size=_BOARD_SIDE)
        observation = _BOARD.find(_board_frame(pose, rng, number), STANDARD_CAMERA)
        if observation is None:
            continue
        true = STANDARD_CAMERA.project(pose.apply(points))
        drawn = STANDARD_CAMERA.project(observation.pose.apply(points))
        offsets.append((drawn - true)[_in_view(true)])
    return DrawingErrors.of(offsets)


def latency_errors(delay: float = 0.066, seconds: float = 4.0) -> dict[str, DrawingErrors]:
    """Return the registration errors of a robot on a moving board with each remedy for delay.

    All remedies are measured on the same pictures, with points of a robot on the board.

    Args:
        delay: Time that tracking and drawing take, s.
        seconds: Length of the film, s.
    """
    rng = np.random.default_rng([0, 5])
    steps = max(1, round(delay * _RATE_HZ))
    times = (np.arange(round(seconds * _RATE_HZ)) / _RATE_HZ).tolist()
    frames = [_board_frame(hand_motion(t), rng, k, t) for k, t in enumerate(times)]
    # All remedies use the same observations.
    tracker = _RecordedTracker(frames)
    return {
        name: _latency_errors(options, round(share * steps), frames, tracker)
        for name, (share, options) in REMEDIES.items()
    }


def hand_motion(t: float) -> Pose:
    """Return ``pose_camera_board`` of a board moved by hand at time t: some 200 mm/s, 40 deg/s."""
    position = (
        0.060 * np.sin(2.6 * t) + 0.015 * np.sin(6.1 * t + 1.0),
        0.035 * np.sin(3.4 * t + 0.7),
        0.80 + 0.04 * np.sin(1.9 * t),
    )
    facing = Pose(wxyz=rotation_exp([np.pi, 0.0, 0.0]))
    lean = [-0.6 + 0.20 * np.sin(2.2 * t), 0.15 * np.sin(2.9 * t), 0.35 * np.sin(1.7 * t)]
    return Pose(position, facing.compose(Pose(wxyz=rotation_exp(lean))).wxyz)


class _RecordedTracker(BoardTracker):
    """Tracks the board in some frames once, and returns the observations again and again."""

    def __init__(self, frames: list[Frame]) -> None:
        super().__init__(_BOARD, STANDARD_CAMERA)
        self._observations = [super(_RecordedTracker, self).observe(frame) for frame in frames]

    def observe(self, frame: Frame) -> BoardObservation | None:
        """Return the observation of a frame."""
        return self._observations[frame.sequence]


def _latency_errors(
    options: LatencyOptions, steps: int, frames: list[Frame], tracker: BoardTracker
) -> DrawingErrors:
    """Return the errors of one remedy. The tracker is ``steps`` pictures late."""
    points = robot_points(0)
    nothing = DrawnRobot(mujoco.MjSpec().compile())
    registrar = Registrar(tracker, nothing, STANDARD_CAMERA, options)
    offsets = []
    for k in range(steps, len(frames)):
        observation = registrar.track(frames[k - steps])
        pose, motion = registrar.place(observation, frames[k])
        if pose is None or frames[k].time < _SETTLING:
            continue
        true = STANDARD_CAMERA.project(hand_motion(frames[k].time).apply(points))
        drawn = STANDARD_CAMERA.project(pose.apply(points))
        if motion is not None:
            drawn = drawn @ motion[:, :2].T + motion[:, 2]
        offsets.append((drawn - true)[_in_view(true)])
    return DrawingErrors.of(offsets)


def _board_frame(pose: Pose, rng: np.random.Generator, number: int, time: float = 0.0) -> Frame:
    """Return a webcam's picture of the board at ``pose_camera_board``."""
    placed = {
        marker_id: (side, pose.compose(pose_board_marker))
        for marker_id, (side, pose_board_marker) in _BOARD.markers.items()
    }
    image = render_markers(
        STANDARD_CAMERA, placed, rng, dictionary=_BOARD.dictionary, margin=_PAPER, sensor=WEBCAM
    )
    return Frame(np.ascontiguousarray(np.repeat(image[:, :, None], 3, axis=2)), time, number)


def _in_view(pixels: Array) -> NDArray[np.bool_]:
    """Return which pixels (n, 2) are in the picture of the standard camera."""
    return np.asarray(((pixels > 0) & (pixels < np.array(STANDARD_CAMERA.size) - 1)).all(axis=1))


def _centroid(shape: NDArray[np.float32]) -> Array:
    """Return the centroid (2,) of a mask (h, w), or of the inside of an outline (n, 1, 2)."""
    moments = cv2.moments(shape)
    if not moments["m00"]:
        return np.full(2, np.nan)
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]


def _outline_centroid(centre: Array, radius: float, intrinsics: CameraIntrinsics) -> Array:
    """Return the centroid (2,) of a sphere in the picture, by ``cv2.projectPoints``."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)[:, None]
    shrink = (radius / distance) ** 2
    circle = np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)
    ring = centre * (1 - shrink) + radius * np.sqrt(1 - shrink) * circle
    coefficients = intrinsics.coefficients if len(intrinsics.distortion) else None
    projected, _ = cv2.projectPoints(
        ring, np.zeros(3), np.zeros(3), intrinsics.matrix, coefficients
    )
    pixels = np.asarray(projected).reshape(-1, 2)
    return pixels[0] + _centroid((pixels - pixels[0]).astype(np.float32).reshape(-1, 1, 2))


def _figures(
    name: str, errors: DrawingErrors, limits: tuple[float | None, float | None]
) -> Iterator[Quantity]:
    """Return RMS and largest error with their limits."""
    yield Quantity(f"{name}, RMS", errors.rms, "px", limits[0])
    yield Quantity(f"{name}, worst", errors.worst, "px", limits[1])
