"""Large pictures with soft edges: phone photographs, enlarged pictures, pictures out of focus."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.camera.pictures import pattern_set, standard_set
from robot_ik.camera.corners import refine_markers
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.image import from_reduced, marker_bits, reduced, to_reduced
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, STANDARD_SIZE
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.camera.targets import find_corners, marker

#: Enlargement: 640 px become 5120, and a blur of 0.7 px becomes 5.6 px.
TIMES = 8


def enlarged(image: np.ndarray, times: int = TIMES) -> np.ndarray:
    return np.asarray(cv2.resize(image, (0, 0), fx=times, fy=times, interpolation=cv2.INTER_CUBIC))


@pytest.mark.parametrize("times", [2, 3, 7])
def test_reduced_pixels_are_where_they_were(times: int) -> None:
    # The grey level encodes the position of a pixel. The sizes are no multiples.
    across = np.tile(np.arange(200, dtype=np.uint8), (103, 1))
    reduced_points = reduced(across, times)
    assert reduced_points.shape == (103 // times, 200 // times)
    columns = np.arange(reduced_points.shape[1], dtype=float)
    assert from_reduced(columns, times) == pytest.approx(reduced_points[0].astype(float), abs=0.5)
    assert to_reduced(from_reduced(columns, times), times) == pytest.approx(columns)


@pytest.mark.parametrize("ids", [None, [7]])
def test_a_marker_in_an_enlarged_picture_is_measured_as_in_the_small_one(
    ids: list[int] | None,
) -> None:
    camera = STANDARD_CAMERA.scaled(TIMES * STANDARD_CAMERA.width, TIMES * STANDARD_CAMERA.height)
    wanted = None if ids is None else frozenset(ids)
    target = marker(7, STANDARD_SIZE, "DICT_4X4_50")
    for view in standard_set(0.4, 3, seed=8):
        ((_, small),) = find_corners(
            Frame(view.image, 0.0, 0), STANDARD_CAMERA, "DICT_4X4_50", wanted
        )
        ((_, large),) = find_corners(
            Frame(enlarged(view.image), 0.0, 0), camera, "DICT_4X4_50", wanted
        )
        assert large.refined
        assert to_reduced(large.pixels, TIMES) == pytest.approx(small.pixels, abs=0.15)
        fits = target.fit({7: large}, camera)
        assert fits is not None
        assert fits.observation().pose.distance(view.pose)[0] < 5e-4


def test_a_small_marker_in_a_large_picture_is_found_at_full_size() -> None:
    # 6 cells of 4 px are too small in the reduced picture.
    picture = np.full((2600, 4000), 200, np.uint8)
    picture[1500:1524, 3100:3124] = np.kron(
        marker_bits("DICT_4X4_50", 3), np.ones((4, 4), np.uint8)
    )
    (found,) = MarkerDetector("DICT_4X4_50").detect(picture)
    assert found.id == 3
    assert found.corners[0] == pytest.approx([3099.5, 1499.5], abs=1.0)


def test_a_marker_found_at_both_sizes_is_one_marker() -> None:
    (view,) = standard_set(0.4, 1, seed=2)
    assert [d.id for d in MarkerDetector("DICT_4X4_50").detect(enlarged(view.image, 5))] == [7]


@pytest.mark.parametrize(
    "pattern", [CharucoPattern(8, 6, 0.03, 0.022), ChessboardPattern(9, 6, 0.025)]
)
def test_a_board_in_an_enlarged_picture_keeps_its_corners(pattern: Pattern) -> None:
    ((image, pose),) = pattern_set(pattern, STANDARD_CAMERA, 1, seed=6)
    small = pattern.find(image)
    large = pattern.find(enlarged(image))
    assert small is not None and large is not None
    assert len(large.ids) >= len(small.ids)
    true = STANDARD_CAMERA.project(pose.apply(large.points_board))
    errors = to_reduced(large.pixels, TIMES) - true
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.06
    assert large.blur == pytest.approx(TIMES * small.blur, rel=0.4)


@pytest.mark.parametrize("at", [(1000, 1000), (-500, -500), (-300, 100), (100, 2000)])
def test_corners_outside_the_picture_are_returned(at: tuple[int, int]) -> None:
    rough = np.array([[0, 0], [100, 0], [100, 100], [0, 100]]) + np.array(at, dtype=float)
    (corners,) = refine_markers(
        np.full((480, 640), 128, np.uint8), [rough], [7], "DICT_4X4_50", STANDARD_CAMERA
    )
    assert not corners.refined and (corners.pixels == rough).all()


def test_a_picture_that_was_sharpened_is_measured_too() -> None:
    # Cameras and programs sharpen edges: one pixel wide, with a light and a dark seam.
    refined = 0
    for view in standard_set(0.5, 20, seed=4, sensor=SensorModel(blur=0.4, noise=1.0)):
        image = view.image.astype(float)
        sharp = np.clip(
            image + 3.0 * (image - cv2.GaussianBlur(image, (0, 0), 1.0)), 0, 255
        ).astype(np.uint8)
        (rough,) = MarkerDetector("DICT_4X4_50").detect(sharp)
        (corners,) = refine_markers(sharp, [rough.corners], [7], "DICT_4X4_50", STANDARD_CAMERA)
        refined += corners.refined
        assert np.abs(corners.pixels - view.corners).max() < 0.5
    assert refined == 20
