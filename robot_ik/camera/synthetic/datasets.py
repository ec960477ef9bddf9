"""Synthetic pictures with exact truth, to measure with: sets of markers, patterns, hand-eye; moving sources.

The standard set is a flat printed marker before a blotchy wall: 640x480 px, f = 800 px, distortion, blur,
noise and a light gradient.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import Any
from urllib.parse import parse_qsl

import cv2
import numpy as np

from robot_ik.camera.calibration.handeye import HandEyeSample, Mount, Mounting
from robot_ik.camera.drawing.prints import PRINT_MARKER, Print, blank_paper, marker_print, see_print
from robot_ik.camera.drawing.raycast import ray_field
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import Pattern, PatternRequest
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.sensor import LINEAR, SensorModel
from robot_ik.camera.targets import Observation, marker_points
from robot_ik.errors import CameraNotFoundError, FrameTimeoutError, unknown_name_text
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array, Image

STANDARD_CAMERA = CameraIntrinsics(
    640, 480, 800.0, 800.0, 322.3, 236.8, (-0.18, 0.05, 0.0005, -0.0003, 0.0), name="standard set"
)
STANDARD_SIZE = 0.05
STANDARD_DISTANCES = (0.3, 0.6, 1.0)

# White paper reaches this far beyond the black square, in marker sizes.
_PAPER_MARGIN = 0.25


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A picture and its truth.

    Attributes:
        image: (height, width) uint8.
        corners: (4, 2) true corners in distorted pixels, in the order of the detector.
        pose: True ``pose_camera_marker``.
    """

    image: Image
    corners: Array
    pose: Pose


def render_markers(
    camera: CameraIntrinsics,
    markers: Mapping[int, tuple[float, Pose]],
    rng: np.random.Generator,
    *,
    sensor: SensorModel = LINEAR,
    **options: Any,
) -> Image:
    """One picture (height, width) uint8 of printed markers; ``options`` as of ``marker_light``."""
    light, centre = marker_light(camera, markers, rng, sensor=sensor, **options)
    return photograph(light, centre, rng, sensor)


def marker_light(
    camera: CameraIntrinsics,
    markers: Mapping[int, tuple[float, Pose]],
    rng: np.random.Generator,
    *,
    dictionary: str = "DICT_4X4_50",
    sensor: SensorModel = LINEAR,
    margin: float = _PAPER_MARGIN,
    cover: Array | None = None,
) -> tuple[Array, Array]:
    """Light (h, w) before the lens, 0 to 255, of printed markers: a board, or the faces of a cube that show.

    And the pixel (2,) in their middle; that of the picture where there are none.

    Args:
        camera: The optics.
        markers: Id -> (side in metres, ``pose_camera_marker``); they must not overlap.
        rng: Of wall, light and noise.
        dictionary: Of all markers.
        sensor: Blur, noise, light.
        margin: White paper round each marker, in its size; at most the gap to the next marker's ink.
        cover: (k, 2) pixels: the outline of something grey that hides what is behind it.
    """
    canvas = _wall(camera, rng, sensor)
    # All of the paper before any ink: one marker's paper must not bleach the edge of the next.
    papers = [(blank_paper(size * (1.0 + 2.0 * margin)), pose) for size, pose in markers.values()]
    prints = [
        (marker_print(dictionary, i, size, 0.0, sensor.bleed), pose) for i, (size, pose) in markers.items()
    ]
    for sheet, pose in [*papers, *prints]:
        _lay(canvas, sheet, pose.compose(PRINT_MARKER), camera, sensor)
    if cover is not None:
        cv2.fillPoly(canvas, [np.rint(cover).astype(np.int32)], 0.5 * (sensor.black + sensor.white))
    middles = [camera.project(pose.position) for _, pose in markers.values()]
    return canvas, np.mean(middles or [0.5 * np.array(camera.size)], axis=0)


def photograph(canvas: Array, centre: Array, rng: np.random.Generator, sensor: SensorModel) -> Image:
    """The light of a scene, unevenly lit and developed; a shadow's edge goes by ``centre``."""
    height, width = canvas.shape
    direction = rng.uniform(0, 2 * np.pi)
    across = np.array([np.cos(direction), np.sin(direction)])
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height))
    along = (x * across[0] + y * across[1]) / np.abs(across).sum() + 0.5
    light = sensor.scattered(canvas) * (1.0 - sensor.gradient * along)
    if sensor.shadow > 0.0:
        away = (np.arange(width) - centre[0]) * across[0] + ((np.arange(height) - centre[1]) * across[1])[
            :, None
        ]
        light = light * (1.0 - 0.5 * sensor.shadow * (1.0 + np.tanh(0.5 * away / sensor.shadow_edge)))
    return sensor.developed(light, rng.normal(0.0, 1.0, light.shape))


def _lay(canvas: Array, sheet: Print, pose: Pose, camera: CameraIntrinsics, sensor: SensorModel) -> None:
    """Puts a print at ``pose`` (``pose_camera_print``) over the light (h, w) of what is behind it."""
    seen = see_print(sheet, pose, ray_field(camera))
    if seen is not None:
        x0, y0, x1, y1 = seen.box
        view = canvas[y0:y1, x0:x1]
        view += seen.coverage * (sensor.white + (sensor.black - sensor.white) * seen.ink - view)


def _wall(camera: CameraIntrinsics, rng: np.random.Generator, sensor: SensorModel) -> Array:
    """Background of soft blotches, so that the paper has an edge of its own and the threshold some work."""
    coarse = rng.uniform(0.25, 0.75, (camera.height // 24 + 2, camera.width // 24 + 2))
    blotches = cv2.resize(coarse, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(sensor.black + (sensor.white - sensor.black) * blotches, dtype=float)


def random_pose(
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    distance: float,
    *,
    size: float = STANDARD_SIZE,
    tilt_deg: tuple[float, float] = (0.0, 60.0),
) -> Pose:
    """Random ``pose_camera_marker`` at depth ``distance``, all of its paper in view.

    ``tilt_deg`` is the range of angles between the marker's z axis and the way to the camera.
    """
    margin = 4.0
    while True:
        tilt = np.deg2rad(rng.uniform(*tilt_deg))
        pixel = rng.uniform((0, 0), (camera.width, camera.height))
        position = camera.unproject(pixel) * distance
        # Facing the camera: the marker's z axis points back along the line of sight, its y axis up.
        back = -position / np.linalg.norm(position)
        right = np.cross((0.0, -1.0, 0.0), back)
        right /= np.linalg.norm(right)
        facing = Pose.from_rotation(np.column_stack([right, np.cross(back, right), back]))
        azimuth, roll = rng.uniform(0, 2 * np.pi, 2)
        tilt_rotation = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        rotation = facing.compose(tilt_rotation).compose(Pose(wxyz=rotation_exp([0.0, 0.0, roll])))
        pose = Pose(position, rotation.wxyz)
        outline = camera.project(pose.apply(marker_points(size * (1 + 2 * _PAPER_MARGIN))))
        if (outline > margin).all() and (outline < np.array(camera.size) - 1 - margin).all():
            return pose


def standard_set(
    distance: float,
    count: int = 100,
    *,
    seed: int = 0,
    dictionary: str = "DICT_4X4_50",
    marker_id: int = 7,
    camera: CameraIntrinsics = STANDARD_CAMERA,
    sensor: SensorModel = LINEAR,
    tilt_deg: tuple[float, float] = (0.0, 60.0),
) -> Iterator[MarkerView]:
    """The pictures of the standard set at one distance; the same seed gives the same pictures.

    ``distance`` is the depth of the marker's centre in metres (the set has 0.3, 0.6 and 1.0), ``tilt_deg``
    the range of tilts in degrees; the rest as in ``render_markers``.
    """
    rng = np.random.default_rng([seed, round(distance * 1000)])
    for _ in range(count):
        pose = random_pose(camera, rng, distance, tilt_deg=tilt_deg)
        image = render_markers(
            camera, {marker_id: (STANDARD_SIZE, pose)}, rng, dictionary=dictionary, sensor=sensor
        )
        yield MarkerView(image, camera.project(pose.apply(marker_points(STANDARD_SIZE))), pose)


# ------------------------------------------------------------------------------------------
# Synthetic pictures of calibration patterns with exact truth, to measure a calibration with.
#
# White round the print, in squares.
_MARGIN = 0.5


@lru_cache(maxsize=4)
def pattern_print(pattern: Pattern) -> Print:
    """The pattern on white paper; metres in the board's frame."""
    margin = _MARGIN * pattern.square
    left, top = np.array(pattern.origin) - margin
    width, height = np.array(pattern.size) + 2.0 * margin
    return Print.of_boxes(pattern.black(), (left, top, width, height))


def render_pattern(
    pattern: Pattern,
    camera: CameraIntrinsics,
    pose: Pose,
    rng: np.random.Generator,
    sensor: SensorModel = LINEAR,
) -> Image:
    """One picture (height, width) uint8 of the pattern at ``pose`` (``pose_camera_board``)."""
    # A grey wall.
    canvas = np.full((camera.height, camera.width), 0.5 * (sensor.black + sensor.white))
    _lay(canvas, pattern_print(pattern), pose, camera, sensor)
    return photograph(canvas, camera.project(pose.position), rng, sensor)


def pattern_pose(
    pattern: Pattern,
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    *,
    tilt_deg: tuple[float, float] = (10.0, 45.0),
    fill: tuple[float, float] = (0.4, 1.0),
) -> Pose:
    """A ``pose_camera_board`` as a person holds a board: tilted any way, here and there in the picture.

    ``tilt_deg`` is the range of the angle between board and picture plane, ``fill`` that of the print's width
    in the picture, in picture widths, were it not tilted.
    """
    centre = np.array([*(np.array(pattern.origin) + np.array(pattern.size) / 2), 0.0])
    while True:
        depth = camera.fx * pattern.size[0] / (camera.width * rng.uniform(*fill))
        pixel = rng.uniform((0, 0), camera.size)
        tilt, azimuth = np.deg2rad(rng.uniform(*tilt_deg)), rng.uniform(0, 2 * np.pi)
        tilt_rotation = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        rotation = tilt_rotation.compose(Pose(wxyz=rotation_exp([0.0, 0.0, rng.normal(0.0, 0.15)])))
        position = camera.unproject(pixel) * depth - rotation.rotation @ centre
        pose = Pose(position, rotation.wxyz)
        if _in_view(pattern, camera, pose):
            return pose


def _in_view(pattern: Pattern, camera: CameraIntrinsics, pose: Pose) -> bool:
    """Whether all inner corners are in the picture, with a margin for their patches."""
    columns, rows = pattern.corners
    start = np.array(pattern.origin) + pattern.square
    ends = [(start[0] + c * pattern.square, start[1] + r * pattern.square, 0.0)
            for c in (0, columns - 1) for r in (0, rows - 1)]  # fmt: skip
    pixels = camera.project(pose.apply(np.array(ends)))
    return bool((pixels > 12).all() and (pixels < np.array(camera.size) - 13).all())


def pattern_set(
    pattern: Pattern,
    camera: CameraIntrinsics,
    count: int,
    *,
    seed: int = 0,
    sensor: SensorModel = LINEAR,
) -> Iterator[tuple[Image, Pose]]:
    """Pictures as a calibration wants them, each with its true ``pose_camera_board``; by the seed alone."""
    rng = np.random.default_rng([seed, count])
    for _ in range(count):
        pose = pattern_pose(pattern, camera, rng)
        yield render_pattern(pattern, camera, pose, rng, sensor), pose


# ------------------------------------------------------------------------------------------
# The standard set of hand-eye calibration: views of one small marker with exact truth, to measure with.
#
# The hardest usual case: a marker of 50 mm, 0.5 to 0.9 m away, whose pose is known to about 0.5 mm across,
# 1 mm along the view and 0.3 degrees.


#: Standard deviation of corners (px) and of the arm's poses, each axis: metres, rad.
PIXEL, ARM = 0.1, (3e-4, float(np.deg2rad(0.05)))
# A pose estimated from four corners with 1 px of noise is off by about this: metres, rad.
_ROUGH = np.repeat((2.5e-3, 0.02), 3)


def handeye_set(
    count: int = 15,
    *,
    mounting: Mounting = "eye_in_hand",
    seed: int = 0,
    pixel: float = PIXEL,
    arm: tuple[float, float] = ARM,
    spread_deg: float = 25.0,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Mount, list[HandEyeSample]]:
    """The truth, and what an arm and a camera would say; the same seed gives the same.

    Args:
        count: Number of views.
        mounting: Who is carried.
        seed: Of everything.
        pixel: Standard deviation of the corners, px.
        arm: Standard deviation of the hand's pose, each axis: metres, rad.
        spread_deg: Standard deviation of the rotations about each axis of the camera.
        axes: Shares of it, by axis.
    """
    rng = np.random.default_rng(seed)
    points = marker_points(STANDARD_SIZE)
    truth = Mount(
        Pose(rng.normal(0, 0.05, 3), rotation_exp(rng.normal(0, 1, 3))),
        Pose(rng.normal(0, 0.3, 3), rotation_exp(rng.normal(0, 1, 3))),
        mounting,
    )
    samples = []
    for _ in range(count):
        rotation = rotation_exp(np.deg2rad(spread_deg) * rng.normal(0, 1, 3) * axes)
        position = (*rng.normal(0, 0.04, 2), rng.uniform(0.5, 0.9))
        seen = Pose(position, (0, 1, 0, 0)).compose(Pose(wxyz=rotation))  # facing the camera, then turned
        pixels = STANDARD_CAMERA.project(seen.apply(points)) + rng.normal(0, 1, (4, 2)) * pixel
        said = Pose().moved(rng.normal(0, 1, 6) * np.repeat(arm, 3))
        rough = Pose().moved(rng.normal(0, pixel, 6) * _ROUGH)
        view = Observation(points, pixels, seen.compose(rough), max(pixel, 0.01))
        samples.append(HandEyeSample(truth.pose_world_hand(seen).compose(said), view))
    return truth, samples


# ------------------------------------------------------------------------------------------
# Sources that move something before a synthetic camera: ``synthetic:orbit``, ``synthetic:charuco``, ….
#
# They need no robot, camera or display.  Each frame's ``truth`` holds what tracks must not read.


_RATE_HZ = 30.0
# The marker of ``synthetic:orbit``.
_ORBIT_ID, _ORBIT_DICTIONARY = 7, "DICT_5X5_50"
# It swings through all tilts once in so many seconds.
_ORBIT_S = 4.0
# Pictures for which a board is held in one place: what is still can be told from what moves.
_HELD = 3

Pictures = Iterator[tuple[Image, dict[str, object]]]
"""Pictures (height, width) uint8 without an end, each with its truth."""


@dataclass(frozen=True)
class MovingOptions:
    """What may follow the name, as in ``synthetic:orbit?frames=60&noise=8``.

    Attributes:
        frames: Pictures before the source ends.
        seed: Of noise, light and poses.
        noise: Standard deviation of the sensor's noise, grey levels.
        blur: Standard deviation of the optical blur, px.
    """

    frames: int = 90
    seed: int = 0
    noise: float = 4.0
    blur: float = 0.7


class MovingSource(FrameSource):
    """Something that moves before ``STANDARD_CAMERA``; 640 x 480 px, 30 pictures a second.

    Args:
        options: Length, seed and noise.
        show: Gives the pictures.
    """

    #: It shows no arm and goes on only when it is read, as a film does.
    live = False

    def __init__(
        self, options: MovingOptions, show: Callable[[np.random.Generator, SensorModel], Pictures]
    ) -> None:
        self.options, self.size = options, STANDARD_CAMERA.size
        sensor = SensorModel(noise=options.noise, blur=options.blur, gradient=0.2)
        self._pictures = show(np.random.default_rng(options.seed), sensor)
        self._start, self._count = time.monotonic(), 0

    @property
    def exhausted(self) -> bool:
        return self._count >= self.options.frames

    def read(self) -> Frame:
        if self.exhausted:
            raise FrameTimeoutError(f"the synthetic camera's {self.options.frames} pictures have been read")
        index = self._count
        gray, truth = next(self._pictures)
        self._count += 1
        image = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        return Frame(image, self._start + index / _RATE_HZ, index, truth)


def _orbit(rng: np.random.Generator, sensor: SensorModel) -> Pictures:
    """Marker 7 of DICT_5X5_50, 50 mm, seen from all round: truth ``pose_camera_marker``."""
    for index in itertools.count():
        phase = 2 * np.pi * index / _RATE_HZ / _ORBIT_S
        tilt = np.deg2rad(30.0 + 15.0 * np.sin(0.37 * phase))
        tilt_rotation = Pose(wxyz=rotation_exp([tilt * np.cos(phase), tilt * np.sin(phase), 0.0]))
        position = (0.04 * np.sin(phase), 0.03 * np.cos(phase), 0.45 + 0.12 * np.sin(0.61 * phase))
        pose = Pose(position, PRINT_MARKER.compose(tilt_rotation).wxyz)
        image = render_markers(
            STANDARD_CAMERA,
            {_ORBIT_ID: (STANDARD_SIZE, pose)},
            rng,
            dictionary=_ORBIT_DICTIONARY,
            sensor=sensor,
        )
        yield image, {"pose_camera_marker": {_ORBIT_ID: pose}}


def _held_board(pattern: Pattern, rng: np.random.Generator, sensor: SensorModel) -> Pictures:
    """A calibration pattern held here and there for a few pictures each: truth ``pose_camera_board``."""
    while True:
        pose = pattern_pose(pattern, STANDARD_CAMERA, rng)
        clean = render_pattern(pattern, STANDARD_CAMERA, pose, rng, replace(sensor, noise=0.0))
        for _ in range(_HELD):
            noisy = clean + rng.normal(0.0, sensor.noise, clean.shape)
            yield np.clip(np.rint(noisy), 0, 255).astype(np.uint8), {"pose_camera_board": pose}


_SCENES: dict[str, Callable[[np.random.Generator, SensorModel], Pictures]] = {
    "orbit": _orbit,
    "charuco": partial(_held_board, PatternRequest("charuco").pattern()),
    "chessboard": partial(_held_board, PatternRequest("chessboard").pattern()),
}


def open_moving(text: str) -> MovingSource:
    """Opens ``synthetic:NAME?option=value&…``.

    Raises:
        CameraNotFoundError: Unknown name or option, or a value that is no number.
    """
    name, _, query = text.removeprefix("synthetic:").partition("?")
    if name not in _SCENES:
        raise CameraNotFoundError(unknown_name_text("synthetic scene", name, list(_SCENES)))
    known = {name: type(value) for name, value in asdict(MovingOptions()).items()}
    given: dict[str, Any] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise CameraNotFoundError(unknown_name_text("option of a synthetic source", key, list(known)))
        try:
            given[key] = known[key](value)
        except ValueError:
            raise CameraNotFoundError(f"{key}={value!r} of a synthetic source must be a number") from None
        if not 0 <= given[key] < 1e9:
            raise CameraNotFoundError(f"{key}={value} of a synthetic source cannot be negative or endless")
    return MovingSource(MovingOptions(**given), _SCENES[name])
