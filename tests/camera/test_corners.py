"""Refined corners in pictures whose corners are known exactly."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.camera.pictures import standard_set
from robot_ik.camera.corners import DETECTOR_SIGMA, Corners, refine_markers
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.synthetic.sensor import WEBCAM, SensorModel

STRAIGHT = CameraIntrinsics(640, 480, 800.0, 800.0, 319.5, 239.5)


def outward(error: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the component (n, 4) of the errors away from the centre of the marker."""
    way = corners - corners.mean(axis=1, keepdims=True)
    return (error * way).sum(axis=2) / np.linalg.norm(way, axis=2)


def test_corners_of_the_standard_set_meet_the_target(standard: dict) -> None:
    errors = np.array([m.corner_error for rows in standard.values() for m in rows])
    truth = np.array([m.view.corners for rows in standard.values() for m in rows])
    assert all(m.seen.sigma < 0.3 for rows in standard.values() for m in rows)
    assert np.sqrt((errors**2).sum(axis=2).mean()) <= 0.10
    assert np.abs(errors.mean(axis=(0, 1))).max() <= 0.03
    # A bias of the size of the marker becomes an error of its depth.
    assert abs(outward(errors, truth).mean()) <= 0.03


def test_the_stated_sigma_is_consistent(standard: dict) -> None:
    for rows in standard.values():
        actual = np.sqrt(np.mean([m.corner_error**2 for m in rows]))
        stated = np.sqrt(np.mean([m.seen.sigma**2 for m in rows]))
        assert 0.5 < actual / stated < 2.0


def test_corners_are_more_accurate_than_opencvs(standard: dict) -> None:
    """SUBPIX moves corners inwards. The fit of the print does not."""
    mine = []
    theirs = []
    for m in standard[0.6]:
        rough = MarkerDetector("DICT_4X4_50").detect(m.view.image)[0].corners.astype(np.float32)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
        subpix = cv2.cornerSubPix(
            m.view.image, rough.reshape(-1, 1, 2).copy(), (4, 4), (-1, -1), criteria
        )
        theirs.append(subpix.reshape(4, 2) - m.view.corners)
        mine.append(m.corner_error)
    assert np.sqrt(np.mean(np.square(mine))) < 0.25 * np.sqrt(np.mean(np.square(theirs)))


@pytest.mark.parametrize(
    ("sensor", "limit"),
    [
        (SensorModel(blur=1.5), 0.10),
        (SensorModel(noise=12, gradient=0.8), 0.25),
        (SensorModel(black=60, white=140), 0.15),
    ],
    ids=["soft", "noisy", "pale"],
)
def test_poor_pictures_have_little_effect(sensor: SensorModel, limit: float) -> None:
    errors = []
    for view in standard_set(0.5, 8, seed=2, sensor=sensor):
        (found,) = MarkerDetector("DICT_4X4_50").detect(view.image)
        result = refine_markers(
            view.image, [found.corners], [found.id], "DICT_4X4_50", STANDARD_CAMERA
        )[0]
        assert result.sigma < 0.3
        errors.append(result.pixels - view.corners)
    assert np.sqrt(np.mean(np.square(errors))) <= limit


@pytest.mark.parametrize(
    ("sensor", "limit"),
    [
        # With a round blur 0.057 px, with an elongated one 0.023 px.
        (replace(WEBCAM, motion=4.0), 0.035),
        # Without a halo 0.035 px, with a negative one 0.017 px.
        (replace(WEBCAM, bloom=0.3), 0.025),
    ],
    ids=["motion", "bloom"],
)
def test_motion_and_bloom_are_in_the_model(sensor: SensorModel, limit: float) -> None:
    errors = []
    for view in standard_set(0.6, 12, seed=2, sensor=sensor):
        (found,) = MarkerDetector("DICT_4X4_50").detect(view.image)
        (result,) = refine_markers(
            view.image, [found.corners], [found.id], "DICT_4X4_50", STANDARD_CAMERA
        )
        assert result.refined
        errors.append(result.pixels - view.corners)
    assert np.sqrt(np.mean(np.square(errors))) <= limit


@pytest.mark.parametrize("dictionary", ["DICT_5X5_50", "DICT_APRILTAG_36H11"])
def test_other_dictionaries_are_equally_accurate(dictionary: str) -> None:
    errors = []
    detector = MarkerDetector(dictionary)
    for view in standard_set(1.0, 8, seed=3, dictionary=dictionary):
        (found,) = detector.detect(view.image)
        result = refine_markers(
            view.image, [found.corners], [found.id], dictionary, STANDARD_CAMERA
        )[0]
        assert result.refined
        errors.append(result.pixels - view.corners)
    assert np.sqrt((np.square(errors)).sum(axis=2).mean()) <= 0.10
    assert np.abs(np.mean(errors, axis=(0, 1))).max() <= 0.03


def crisp(x0: int, y0: int, cell: int = 16) -> np.ndarray:
    """Return a marker along the pixel grid. Its edges lie exactly between pixels."""
    image = np.full((480, 640), 200, np.uint8)
    bits = np.kron(marker_bits("DICT_4X4_50", 7) // 255 * 170 + 30, np.ones((cell, cell))).astype(
        np.uint8
    )
    image[y0 : y0 + len(bits), x0 : x0 + len(bits)] = bits
    return image


def refined(image: np.ndarray, rough: object) -> Corners:
    """Return the corners of ``crisp``."""
    (found,) = refine_markers(image, [rough], [7], "DICT_4X4_50", STRAIGHT)  # type: ignore[list-item]
    return found


def test_the_half_pixel_is_right() -> None:
    image = cv2.GaussianBlur(crisp(200, 120), (0, 0), 0.8)
    # The first dark pixel is column 200. Its left edge is at 199.5, since centres are integers.
    low = np.array([199.5, 119.5])
    high = np.array([295.5, 215.5])
    truth = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    rough = truth + np.array([[0.8, -1.0], [1.0, 0.6], [-0.7, 0.9], [0.5, 0.5]])
    found = refined(image, rough)
    assert found.pixels == pytest.approx(truth, abs=0.01)


def test_far_starts_are_found() -> None:
    image = cv2.GaussianBlur(crisp(200, 120), (0, 0), 0.8)
    truth = np.array([[199.5, 119.5], [295.5, 119.5], [295.5, 215.5], [199.5, 215.5]])
    rng = np.random.default_rng(4)
    for _ in range(10):
        rough = truth + rng.uniform(-2.0, 2.0, (4, 2))
        found = refined(image, rough)
        assert found.pixels == pytest.approx(truth, abs=0.02)
        assert found.sigma < 0.1


def test_dirt_on_an_edge_has_little_effect() -> None:
    image = crisp(200, 120)
    truth = np.array([[199.5, 119.5], [295.5, 119.5], [295.5, 215.5], [199.5, 215.5]])
    image[117:123, 240:250] = 255
    found = refined(cv2.GaussianBlur(image, (0, 0), 0.8), truth)
    assert found.pixels == pytest.approx(truth, abs=0.1)


@pytest.mark.parametrize(
    ("name", "image", "corners"),
    [
        (
            "blank",
            np.full((480, 640), 128, np.uint8),
            [[100, 100], [150, 100], [150, 150], [100, 150]],
        ),
        (
            "outside",
            np.full((480, 640), 128, np.uint8),
            [[-20, 100], [30, 100], [30, 150], [-20, 150]],
        ),
        ("tiny", crisp(200, 120), [[200, 120], [206, 120], [206, 126], [200, 126]]),
        ("folded", crisp(200, 120), [[200, 120], [290, 210], [290, 120], [200, 210]]),
        ("elsewhere", crisp(200, 120), [[400, 300], [450, 300], [450, 350], [400, 350]]),
    ],
)
def test_a_failed_fit_gives_the_detectors_corners_and_reports_it(
    name: str, image: np.ndarray, corners: list[list[float]]
) -> None:
    result = refined(image, corners)
    assert not result.refined
    assert result.pixels.tolist() == corners
    assert result.sigma == DETECTOR_SIGMA


def test_noise_has_no_edges() -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        image = rng.integers(0, 256, (480, 640)).astype(np.uint8)
        square = np.array([[0, 0], [60, 0], [60, 60], [0, 60]]) + rng.uniform(50, 300, 2)
        assert not refined(image, square).refined


def test_many_markers_at_once_are_as_each_alone() -> None:
    rng = np.random.default_rng(6)
    image = np.minimum(crisp(100, 120), crisp(330, 200, 10))
    noisy = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0, 3, image.shape)
    image = np.clip(noisy, 0, 255).astype(np.uint8)
    found = [d.corners for d in MarkerDetector("DICT_4X4_50").detect(image)]
    assert len(found) == 2
    together = refine_markers(image, found, [7, 7], "DICT_4X4_50", STRAIGHT)
    for corners, result in zip(found, together, strict=True):
        single = refined(image, corners)
        assert result.pixels == pytest.approx(single.pixels, abs=0.01)
    assert refine_markers(image, [], [], "DICT_4X4_50", STRAIGHT) == []


def test_arguments_are_not_changed() -> None:
    image = crisp(200, 120)
    corners = np.array([[199.0, 119.0], [295.0, 119.0], [295.0, 215.0], [199.0, 215.0]])
    before = image.copy(), corners.copy()
    refined(image, corners)
    assert (image == before[0]).all()
    assert (corners == before[1]).all()


def test_a_strong_distortion_is_inverted() -> None:
    """The edges are curved by several pixels. A straight line would be wrong by more than one."""
    camera = CameraIntrinsics(640, 480, 420.0, 420.0, 319.5, 239.5, (-0.3, 0.09, 0.0, 0.0, 0.0))
    errors = []
    for view in standard_set(0.09, 4, seed=4, camera=camera, tilt_deg=(0, 25)):
        (found,) = MarkerDetector("DICT_4X4_50").detect(view.image)
        result = refine_markers(view.image, [found.corners], [found.id], "DICT_4X4_50", camera)[0]
        assert result.refined
        errors.append(result.pixels - view.corners)
    assert np.sqrt(np.mean(np.square(errors))) < 0.1
