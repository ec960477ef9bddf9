"""Markers in pictures of cameras with a tone curve.

The pictures are rendered independently of the fit and of ``synthetic.pictures``: 64 rays in each
pixel, blur at that resolution, the area of the pixel, a colour filter with demosaicing, a tone
curve, an unsharp mask and JPEG.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.camera.accuracy import frame_of
from robot_ik.camera.corners import Corners, refine_markers
from robot_ik.camera.detection import Detection, MarkerDetector
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import Observation, find_corners, marker, marker_grid, marker_points
from robot_ik.geometry import Pose, quat_multiply, rotation_exp

Array = NDArray[np.float64]

CAMERA = CameraIntrinsics(640, 480, 800.0, 800.0, 319.5, 239.5)
DICTIONARY = "DICT_4X4_50"
SIZE = 0.05
ID = 7
BOARD = marker_grid(2, 2, SIZE, 0.012, dictionary=DICTIONARY)
FACING = Pose(wxyz=(0.0, 1.0, 0.0, 0.0))
FINE = 8


@dataclass(frozen=True)
class Camera:
    """Optics, sensor and processing of a camera."""

    tone: str = "srgb"
    blur: float = 0.7
    exposure: float = 1.0
    sharpen: float = 0.6
    radius: float = 1.1
    jpeg: int = 90
    bayer: bool = True
    noise: float = 2.0


LINEAR = Camera("linear", sharpen=0.0, jpeg=100, bayer=False)
WEBCAM = Camera()


def paper_box(side: float, at: Pose) -> NDArray[np.int64]:
    """Return the bounding box of a marker's paper: left, top, right, bottom, half open, px."""
    paper = CAMERA.project(at.apply(1.26 * marker_points(side)))
    low = np.floor(paper.min(axis=0))
    high = np.ceil(paper.max(axis=0)) + 1
    return np.concatenate([low, high]).astype(np.int64)


def light_of(layout: dict[int, tuple[float, Pose]], pose: Pose, blur: float) -> Array:
    """Return the light (480, 640) of markers before a grey wall. Paper 0.85, ink 0.08."""
    placed = {i: (side, pose.compose(on)) for i, (side, on) in layout.items()}
    boxes = {i: paper_box(side, at) for i, (side, at) in placed.items()}
    x0, y0 = np.min([box[:2] for box in boxes.values()], axis=0) - 8
    x1, y1 = np.max([box[2:] for box in boxes.values()], axis=0) + 8
    fine = np.full(((y1 - y0) * FINE, (x1 - x0) * FINE), 0.4, dtype=np.float32)
    for i, (side, at) in placed.items():
        left, top, right, bottom = boxes[i]
        x = ((np.arange(left * FINE, right * FINE) + 0.5) / FINE - 0.5 - 319.5) / 800.0
        y = ((np.arange(top * FINE, bottom * FINE) + 0.5) / FINE - 0.5 - 239.5) / 800.0
        rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1)
        normal = at.rotation[:, 2]
        points = rays * ((normal @ at.position) / (rays @ normal))[..., None] - at.position
        u = points @ at.rotation[:, 0] / side
        v = -(points @ at.rotation[:, 1]) / side
        bits = marker_bits(DICTIONARY, i)
        n = len(bits)
        column = np.floor((u + 0.5) * n).astype(int)
        row = np.floor((v + 0.5) * n).astype(int)
        crop = fine[
            (top - y0) * FINE : (bottom - y0) * FINE, (left - x0) * FINE : (right - x0) * FINE
        ]
        crop[np.maximum(np.abs(u), np.abs(v)) < 0.62] = 0.85
        ink = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < n)
        crop[ink] = np.where(bits[row[ink], column[ink]] > 0, 0.85, 0.08)
    # Blur at this resolution, then take the mean over the area of each pixel.
    soft = cv2.GaussianBlur(fine, (0, 0), blur * FINE)
    whole = np.full((480, 640), 0.4)
    whole[y0:y1, x0:x1] = soft.reshape(y1 - y0, FINE, x1 - x0, FINE).mean(axis=(1, 3))
    return whole


def picture_of(light: Array, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the picture (480, 640) uint8 of a light."""
    raw = np.clip(light * camera.exposure, 0.0, 1.0)
    raw = np.clip(
        raw + camera.noise / 255.0 * np.sqrt(raw + 0.01) * rng.normal(size=raw.shape), 0.0, 1.0
    )
    if camera.bayer:
        kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4.0
        colours = []
        for places in (((0, 0),), ((0, 1), (1, 0)), ((1, 1),)):
            mask = np.zeros_like(raw)
            for j, i in places:
                mask[j::2, i::2] = 1.0
            colours.append(cv2.filter2D(raw * mask, -1, kernel) / cv2.filter2D(mask, -1, kernel))
        raw = 0.299 * colours[0] + 0.587 * colours[1] + 0.114 * colours[2]
    srgb = np.where(
        raw <= 0.0031308, 12.92 * raw, 1.055 * np.maximum(raw, 1e-9) ** (1 / 2.4) - 0.055
    )
    tones = {
        "linear": raw,
        "gamma 1.5": raw ** (1 / 1.5),
        "srgb": srgb,
        "s-curve": 0.5 * srgb + 0.5 * srgb**2 * (3 - 2 * srgb),
    }
    grey = 255.0 * tones[camera.tone]
    grey = grey + camera.sharpen * (grey - cv2.GaussianBlur(grey, (0, 0), camera.radius))
    picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, camera.jpeg])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def some_pose(
    rng: np.random.Generator, distance: float, tilts: tuple[float, float] = (5.0, 55.0)
) -> Pose:
    tilt = np.deg2rad(rng.uniform(*tilts))
    way = rng.uniform(0.0, 2.0 * np.pi)
    lean = quat_multiply(
        rotation_exp([tilt * np.cos(way), tilt * np.sin(way), 0.0]),
        rotation_exp([0.0, 0.0, rng.uniform(0, 6.3)]),
    )
    place = np.array([*rng.uniform(-0.12, 0.12, 2), 1.0]) * distance
    return Pose(place, FACING.compose(Pose(wxyz=lean)).wxyz)


@pytest.fixture(scope="module")
def scenes() -> list[tuple[Pose, Array]]:
    """Return single markers at 0.6 m."""
    rng = np.random.default_rng(12)
    poses = [some_pose(rng, 0.6) for _ in range(8)]
    return [(pose, light_of({ID: (SIZE, Pose())}, pose, 0.7)) for pose in poses]


def observed(light: Array, camera: Camera, seed: int) -> Observation:
    image = picture_of(light, camera, np.random.default_rng(seed))
    observation = marker(ID, SIZE, DICTIONARY).find(frame_of(image), CAMERA)
    assert observation is not None
    return observation


@pytest.mark.parametrize(
    ("camera", "max_error"),
    [
        (LINEAR, 0.2e-3),
        (replace(WEBCAM, tone="gamma 1.5"), 0.25e-3),
        (WEBCAM, 0.25e-3),
        (replace(WEBCAM, tone="s-curve"), 0.35e-3),
        (replace(WEBCAM, exposure=1.5), 0.5e-3),
        (replace(WEBCAM, sharpen=1.5), 0.4e-3),
        (replace(WEBCAM, sharpen=1.5, radius=2.0), 0.4e-3),
    ],
    ids=[
        "linear",
        "gamma 1.5",
        "webcam",
        "s-curve",
        "overexposed",
        "sharpened",
        "sharpened widely",
    ],
)
def test_the_pose_of_a_marker_is_accurate_for_every_tone_curve(
    scenes: list[tuple[Pose, Array]], camera: Camera, max_error: float
) -> None:
    distances = []
    nees = []
    outward = []
    for k, (pose, light) in enumerate(scenes):
        observation = observed(light, camera, k)
        error = observation.pose.position - pose.position
        distances.append(float(np.linalg.norm(error)))
        nees.append(float(error @ np.linalg.solve(observation.covariance[:3, :3], error)) / 3.0)
        true = CAMERA.project(pose.apply(marker_points(SIZE)))
        way = true - true.mean(axis=0)
        outward.append(
            np.mean(np.sum((observation.pixels - true) * way, axis=1) / np.linalg.norm(way, axis=1))
        )
    assert np.sqrt(np.mean(np.square(distances))) < max_error
    assert abs(np.mean(outward)) < 0.04
    # The covariance agrees with the errors.
    assert np.mean(nees) < 3.0


def test_the_covariance_covers_a_hard_shadow_over_a_marker(
    scenes: list[tuple[Pose, Array]],
) -> None:
    """The estimate of the shadow is too smooth for its border. The covariance contains the rest."""
    nees = []
    sigmas = []
    rng = np.random.default_rng(3)
    for k, (pose, light) in enumerate(scenes):
        middle = CAMERA.project(pose.position[None])[0]
        angle = rng.uniform(0.0, 2.0 * np.pi)
        column = (np.arange(640) - middle[0]) * np.cos(angle)
        row = (np.arange(480)[:, None] - middle[1]) * np.sin(angle)
        observation = observed(light * np.where(column + row > 0.0, 0.5, 1.0), WEBCAM, k)
        error = observation.pose.position - pose.position
        nees.append(float(error @ np.linalg.solve(observation.covariance[:3, :3], error)) / 3.0)
        sigmas.append(observation.sigma)
    plain = observed(scenes[0][1], WEBCAM, 0)
    assert np.mean(nees) < 2.0
    assert min(sigmas) > 1.5 * plain.sigma


def test_a_strongly_tilted_marker_is_fitted_though_its_sharp_corners_are_found_far_off() -> None:
    """At 70 degrees one corner of the detector has an error of 4 px."""
    pose = some_pose(np.random.default_rng(175), 0.6, (70.0, 70.0))
    image = picture_of(light_of({ID: (SIZE, Pose())}, pose, 0.7), WEBCAM, np.random.default_rng(1))
    found, fitted = found_and_fitted(image)
    true = CAMERA.project(pose.apply(marker_points(SIZE)))
    assert np.abs(found - true).max() > 3.5
    assert fitted.refined and np.abs(fitted.pixels - true).max() < 0.1


def test_the_pose_of_a_board_in_a_webcam_picture_is_accurate() -> None:
    """The board has 2 x 2 markers. The edge shift of each is estimated."""
    rng = np.random.default_rng(13)
    distances = []
    nees = []
    for _ in range(5):
        pose = some_pose(rng, 0.6)
        image = picture_of(light_of(dict(BOARD.markers), pose, 0.7), WEBCAM, rng)
        observation = BOARD.find(frame_of(image), CAMERA)
        assert observation is not None
        error = observation.pose.position - pose.position
        distances.append(float(np.linalg.norm(error)))
        nees.append(float(error @ np.linalg.solve(observation.covariance[:3, :3], error)) / 3.0)
    assert np.sqrt(np.mean(np.square(distances))) < 0.08e-3
    assert np.mean(nees) < 3.0


def found_and_fitted(image: NDArray[np.uint8]) -> tuple[Array, Corners]:
    (found,) = MarkerDetector(DICTIONARY).detect(image)
    (fitted,) = refine_markers(image, [found.corners], [found.id], DICTIONARY, CAMERA)
    return found.corners, fitted


def test_a_marker_with_a_misread_id_is_rejected() -> None:
    rng = np.random.default_rng(14)
    pose = Pose((0.0, 0.0, 0.5), FACING.wxyz)
    image = picture_of(light_of(dict(BOARD.markers), pose, 0.7), WEBCAM, rng)
    found = MarkerDetector(DICTIONARY).detect(image)
    ids = [found[0].id, found[1].id, found[2].id, 17]
    fitted = refine_markers(image, [d.corners for d in found], ids, DICTIONARY, CAMERA)
    assert [fit.refined for fit in fitted] == [True, True, True, False]
    assert [fit.verified for fit in fitted] == [True, True, True, False]
    assert (fitted[3].pixels == found[3].corners).all()


def test_the_code_of_a_marker_alone_is_not_a_marker(
    scenes: list[tuple[Pose, Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The detector corrects bits. The fit then compares the cells with the print."""
    image = picture_of(scenes[0][1], WEBCAM, np.random.default_rng(2))
    assert [i for i, _ in find_corners(frame_of(image), CAMERA, DICTIONARY)] == [ID]
    real = MarkerDetector.detect

    def misread(detector: MarkerDetector, gray: NDArray[np.uint8]) -> list[Detection]:
        return [replace(detection, id=31) for detection in real(detector, gray)]

    monkeypatch.setattr(MarkerDetector, "detect", misread)
    assert find_corners(frame_of(image), CAMERA, DICTIONARY) == []
