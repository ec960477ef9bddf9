"""Synthetic pictures of printed markers and calibration patterns, at exact places.

The standard camera has 640x480 pixels, a focal length of 800 px and distortion. Markers hang in
front of a blotchy wall. The light is uneven, the lens blurs and the sensor adds noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from robot_ik.camera.drawing.prints import (
    PRINT_MARKER,
    Print,
    blank_paper,
    marker_print,
    project_print,
)
from robot_ik.camera.drawing.rays import ray_field
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import Pattern
from robot_ik.camera.synthetic.sensor import LINEAR, SensorModel
from robot_ik.camera.targets import marker_points
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array, Image

STANDARD_CAMERA = CameraIntrinsics(
    width=640,
    height=480,
    fx=800.0,
    fy=800.0,
    cx=322.3,
    cy=236.8,
    distortion=(-0.18, 0.05, 0.0005, -0.0003, 0.0),
    name="standard set",
)
#: Side of the black square of the standard marker, metres.
STANDARD_SIZE = 0.05
#: White paper beyond the black square, in marker sizes.
PAPER_MARGIN = 0.25

# Distance of the paper of a marker from the edge of the picture, px.
_EDGE_MARGIN = 4.0
# White round the print of a pattern, in squares.
_PATTERN_MARGIN = 0.5
# Standard deviation of the rotation of a held board in the picture plane, rad.
_ROLL = 0.15
# Distance of the inner corners of a pattern from the edge of the picture, px. The patch that is
# used to measure a corner must be inside.
_CORNER_MARGIN = 12
# Side of the blotches of the wall, px, and their tones, 0 for ink to 1 for paper.
_BLOTCH = 24
_BLOTCH_TONES = (0.25, 0.75)


def render_markers(
    camera: CameraIntrinsics,
    markers: Mapping[int, tuple[float, Pose]],
    rng: np.random.Generator,
    *,
    sensor: SensorModel = LINEAR,
    **options: Any,
) -> Image:
    """Return one picture (height, width) uint8 of printed markers.

    The arguments, ``options`` too, are those of ``marker_light``.
    """
    light, centre = marker_light(camera, markers, rng, sensor=sensor, **options)
    return photograph(light, centre, rng, sensor)


def marker_light(
    camera: CameraIntrinsics,
    markers: Mapping[int, tuple[float, Pose]],
    rng: np.random.Generator,
    *,
    dictionary: str = "DICT_4X4_50",
    sensor: SensorModel = LINEAR,
    margin: float = PAPER_MARGIN,
    cover: Array | None = None,
) -> tuple[Array, Array]:
    """Return the light before the lens of printed markers: a board, or visible faces of a cube.

    Args:
        camera: The optics.
        markers: Id -> (side in metres, ``pose_camera_marker``). They must not overlap.
        rng: For the wall.
        dictionary: Of all markers.
        sensor: Its tones of ink and paper, and its bleed of ink.
        margin: White paper round each marker, in its size. It must not cover the ink of the next
            marker.
        cover: (k, 2) pixels, the outline of a grey object that hides what is behind it.

    Returns:
        The light (h, w), 0 to 255, and the pixel (2,) in the middle of the markers.
    """
    canvas = _wall(camera, rng, sensor)
    # All paper comes before any ink: the paper of a marker must not bleach the edge of the next.
    sheets = [
        (blank_paper(size * (1.0 + 2.0 * margin)), pose) for size, pose in markers.values()
    ] + [
        (marker_print(dictionary, id, size, 0.0, sensor.bleed), pose)
        for id, (size, pose) in markers.items()
    ]
    for sheet, pose in sheets:
        _lay(canvas, sheet, pose.compose(PRINT_MARKER), camera, sensor)
    if cover is not None:
        grey = 0.5 * (sensor.black + sensor.white)
        cv2.fillPoly(canvas, [np.rint(cover).astype(np.int32)], grey)
    middles = [camera.project(pose.position) for _, pose in markers.values()]
    return canvas, np.mean(middles or [0.5 * np.array(camera.size)], axis=0)


def photograph(
    canvas: Array, centre: Array, rng: np.random.Generator, sensor: SensorModel
) -> Image:
    """Return the picture (h, w) uint8 of the light of a scene, with uneven illumination.

    Args:
        canvas: (h, w) light, 0 to 255.
        centre: (2,) pixel through which the edge of a shadow goes, if the sensor model has one.
        rng: For the direction of the light, and for noise.
        sensor: Model of the sensor.
    """
    height, width = canvas.shape
    direction = rng.uniform(0, 2 * np.pi)
    across = np.array([np.cos(direction), np.sin(direction)])
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height))
    along = (x * across[0] + y * across[1]) / np.abs(across).sum() + 0.5
    light = sensor.scattered(canvas) * (1.0 - sensor.gradient * along)
    if sensor.shadow > 0.0:
        columns = (np.arange(width) - centre[0]) * across[0]
        rows = (np.arange(height) - centre[1]) * across[1]
        away = columns + rows[:, None]
        edge = 1.0 + np.tanh(0.5 * away / sensor.shadow_edge)
        light = light * (1.0 - 0.5 * sensor.shadow * edge)
    return sensor.developed(light, rng.normal(0.0, 1.0, light.shape))


def random_pose(
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    distance: float,
    *,
    size: float = STANDARD_SIZE,
    tilt_deg: tuple[float, float] = (0.0, 60.0),
) -> Pose:
    """Return a random ``pose_camera_marker`` with all paper of the marker in the picture.

    Args:
        camera: The optics.
        rng: Source of the pose.
        distance: Depth of the marker's centre, metres.
        size: Side of the black square, metres.
        tilt_deg: Range of the angle between the marker's z axis and the way to the camera, degrees.
    """
    while True:
        tilt = np.deg2rad(rng.uniform(*tilt_deg))
        pixel = rng.uniform((0, 0), (camera.width, camera.height))
        position = camera.unproject(pixel) * distance
        # The z axis of a marker that faces the camera points back along the line of sight.
        back = -position / np.linalg.norm(position)
        right = np.cross((0.0, -1.0, 0.0), back)
        right /= np.linalg.norm(right)
        facing = Pose.from_rotation(np.column_stack([right, np.cross(back, right), back]))
        azimuth, roll = rng.uniform(0, 2 * np.pi, 2)
        tilted = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        turned = Pose(wxyz=rotation_exp([0.0, 0.0, roll]))
        pose = Pose(position, facing.compose(tilted).compose(turned).wxyz)
        outline = camera.project(pose.apply(marker_points(size * (1 + 2 * PAPER_MARGIN))))
        limit = np.array(camera.size) - 1 - _EDGE_MARGIN
        if (outline > _EDGE_MARGIN).all() and (outline < limit).all():
            return pose


@lru_cache(maxsize=4)
def pattern_print(pattern: Pattern) -> Print:
    """Return the pattern on white paper, in metres of the frame of the board."""
    margin = _PATTERN_MARGIN * pattern.square
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
    """Return one picture (height, width) uint8 of the pattern before a grey wall.

    Args:
        pattern: The pattern.
        camera: The optics.
        pose: ``pose_camera_board``.
        rng: For light and noise.
        sensor: Model of the sensor.
    """
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
    """Return a random ``pose_camera_board`` like that of a hand-held board, all in the picture.

    Args:
        pattern: The pattern on the board.
        camera: The optics.
        rng: Source of the pose.
        tilt_deg: Range of the angle between board and picture plane, degrees.
        fill: Range of the width of a board without tilt in the picture, in picture widths.
    """
    centre = np.array([*(np.array(pattern.origin) + np.array(pattern.size) / 2), 0.0])
    while True:
        depth = camera.fx * pattern.size[0] / (camera.width * rng.uniform(*fill))
        pixel = rng.uniform((0, 0), camera.size)
        tilt = np.deg2rad(rng.uniform(*tilt_deg))
        azimuth = rng.uniform(0, 2 * np.pi)
        tilted = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        rotation = tilted.compose(Pose(wxyz=rotation_exp([0.0, 0.0, rng.normal(0.0, _ROLL)])))
        position = camera.unproject(pixel) * depth - rotation.rotation @ centre
        pose = Pose(position, rotation.wxyz)
        if _in_view(pattern, camera, pose):
            return pose


def _in_view(pattern: Pattern, camera: CameraIntrinsics, pose: Pose) -> bool:
    """Return whether all inner corners of the pattern are well inside the picture."""
    columns, rows = pattern.corners
    x, y = np.array(pattern.origin) + pattern.square
    right = x + (columns - 1) * pattern.square
    bottom = y + (rows - 1) * pattern.square
    corners = [(x, y, 0.0), (x, bottom, 0.0), (right, y, 0.0), (right, bottom, 0.0)]
    pixels = camera.project(pose.apply(np.array(corners)))
    limit = np.array(camera.size) - 1 - _CORNER_MARGIN
    return bool((pixels > _CORNER_MARGIN).all() and (pixels < limit).all())


def _lay(
    canvas: Array, sheet: Print, pose: Pose, camera: CameraIntrinsics, sensor: SensorModel
) -> None:
    """Lay a print at ``pose`` (``pose_camera_print``) over the light (h, w), in place."""
    projected = project_print(sheet, pose, ray_field(camera))
    if projected is not None:
        x0, y0, x1, y1 = projected.box
        view = canvas[y0:y1, x0:x1]
        tone = sensor.white + (sensor.black - sensor.white) * projected.ink
        view += projected.coverage * (tone - view)


def _wall(camera: CameraIntrinsics, rng: np.random.Generator, sensor: SensorModel) -> Array:
    """Return a background (h, w) of soft blotches, on which the paper has an edge."""
    shape = (camera.height // _BLOTCH + 2, camera.width // _BLOTCH + 2)
    coarse = rng.uniform(*_BLOTCH_TONES, shape)
    blotches = cv2.resize(coarse, camera.size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(sensor.black + (sensor.white - sensor.black) * blotches, dtype=float)
