"""Seeded sets of pictures and views with exact truth, for the camera's benchmark.

The standard set is a flat printed marker of 50 mm before a blotchy wall, as the standard camera
sees it at three distances.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.calibration.handeye import HandEyeSample, Mount, Mounting
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import Pattern
from robot_ik.camera.synthetic.pictures import (
    STANDARD_CAMERA,
    STANDARD_SIZE,
    pattern_pose,
    random_pose,
    render_markers,
    render_pattern,
)
from robot_ik.camera.synthetic.sensor import LINEAR, SensorModel
from robot_ik.camera.targets import Observation, marker_points
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array, Image

#: Depths of the marker's centre in the standard set, metres.
STANDARD_DISTANCES = (0.3, 0.6, 1.0)
#: Standard deviation of corners in the hand-eye set, px.
CORNER_SIGMA = 0.1
#: Standard deviation of the arm's poses in the hand-eye set, each axis: metres, rad.
ARM_SIGMA = (3e-4, float(np.deg2rad(0.05)))

# A pose estimated from four corners with 1 px of noise has about this error: metres, rad.
_ROUGH_SIGMA = np.repeat((2.5e-3, 0.02), 3)
# Range of distances in the hand-eye set, metres.
_HANDEYE_DISTANCES = (0.5, 0.9)
# Standard deviations of the marker's place across the view, of the camera's place on the hand, and
# of the marker's place in the world, metres.
_ACROSS_SIGMA = 0.04
_ON_HAND_SIGMA = 0.05
_IN_WORLD_SIGMA = 0.3
# Smallest stated standard deviation of the corners of a view, px.
_MIN_SIGMA = 0.01


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
    """Return the pictures of the standard set at one distance. One seed gives one set.

    Args:
        distance: Depth of the marker's centre, metres.
        count: Number of pictures.
        seed: Of poses, walls, light and noise.
        dictionary: Of the marker.
        marker_id: In the dictionary.
        camera: The optics.
        sensor: Model of the sensor.
        tilt_deg: Range of tilts, degrees.
    """
    rng = np.random.default_rng([seed, round(distance * 1000)])
    for _ in range(count):
        pose = random_pose(camera, rng, distance, tilt_deg=tilt_deg)
        markers = {marker_id: (STANDARD_SIZE, pose)}
        image = render_markers(camera, markers, rng, dictionary=dictionary, sensor=sensor)
        corners = camera.project(pose.apply(marker_points(STANDARD_SIZE)))
        yield MarkerView(image, corners, pose)


def pattern_set(
    pattern: Pattern,
    camera: CameraIntrinsics,
    count: int,
    *,
    seed: int = 0,
    sensor: SensorModel = LINEAR,
) -> Iterator[tuple[Image, Pose]]:
    """Return pictures for a calibration, each with its true ``pose_camera_board``."""
    rng = np.random.default_rng([seed, count])
    for _ in range(count):
        pose = pattern_pose(pattern, camera, rng)
        yield render_pattern(pattern, camera, pose, rng, sensor), pose


def handeye_set(
    count: int = 15,
    *,
    mounting: Mounting = "eye_in_hand",
    seed: int = 0,
    corner_sigma: float = CORNER_SIGMA,
    arm_sigma: tuple[float, float] = ARM_SIGMA,
    spread_deg: float = 25.0,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Mount, list[HandEyeSample]]:
    """Return the truth of a hand-eye calibration, and the views of one small marker.

    It is the hardest usual case: a marker of 50 mm, 0.5 to 0.9 m away. Its pose is known to about
    0.5 mm across the view, 1 mm along it and 0.3 degrees. One seed gives one set.

    Args:
        count: Number of views.
        mounting: Whether the hand carries the camera or the marker.
        seed: Of everything.
        corner_sigma: Standard deviation of the corners, px.
        arm_sigma: Standard deviation of the hand's pose, each axis: metres, rad.
        spread_deg: Standard deviation of the rotations about each axis of the camera, degrees.
        axes: Part of this spread that each axis has.
    """
    rng = np.random.default_rng(seed)
    points = marker_points(STANDARD_SIZE)
    truth = Mount(
        Pose(rng.normal(0, _ON_HAND_SIGMA, 3), rotation_exp(rng.normal(0, 1, 3))),
        Pose(rng.normal(0, _IN_WORLD_SIGMA, 3), rotation_exp(rng.normal(0, 1, 3))),
        mounting,
    )
    samples = []
    for _ in range(count):
        rotation = rotation_exp(np.deg2rad(spread_deg) * rng.normal(0, 1, 3) * axes)
        position = (*rng.normal(0, _ACROSS_SIGMA, 2), rng.uniform(*_HANDEYE_DISTANCES))
        # The marker faces the camera, then it is turned.
        pose = Pose(position, (0, 1, 0, 0)).compose(Pose(wxyz=rotation))
        noise = rng.normal(0, 1, (4, 2)) * corner_sigma
        pixels = STANDARD_CAMERA.project(pose.apply(points)) + noise
        arm_error = Pose().plus(rng.normal(0, 1, 6) * np.repeat(arm_sigma, 3))
        rough = Pose().plus(rng.normal(0, corner_sigma, 6) * _ROUGH_SIGMA)
        view = Observation(points, pixels, pose.compose(rough), max(corner_sigma, _MIN_SIGMA))
        samples.append(HandEyeSample(truth.pose_world_hand(pose).compose(arm_error), view))
    return truth, samples
