"""Corners from the whole print: more accurate than from the sides, and only from a real print."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.camera.accuracy import frame_of
from robot_ik.camera.corners import Corners, refine_markers
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, random_pose, render_markers
from robot_ik.camera.targets import marker, marker_grid
from robot_ik.geometry import Pose, rotation_exp

DICTIONARY = "DICT_4X4_50"
BOARD = marker_grid(2, 2, 0.05, 0.012, dictionary=DICTIONARY)
FACING = Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))


def picture(pose: Pose, seed: int, margin: float = 0.24) -> NDArray[np.uint8]:
    placed = {i: (side, pose.compose(on)) for i, (side, on) in BOARD.markers.items()}
    rng = np.random.default_rng(seed)
    return render_markers(STANDARD_CAMERA, placed, rng, dictionary=DICTIONARY, margin=margin)


def found_in(gray: NDArray[np.uint8]) -> dict[int, NDArray[np.float64]]:
    """Corners as the detector gives them."""
    return {d.id: d.corners for d in MarkerDetector(DICTIONARY).detect(gray)}


@pytest.mark.parametrize(
    ("distance", "tilt", "margin", "most"),
    [(0.7, (0.5, 6.0), 0.24, 1.2e-3), (1.0, (45.0, 60.0), 0.12, 1e-3)],
)
def test_the_stated_uncertainty_of_a_board_agrees_with_its_errors(
    distance: float, tilt: tuple[float, float], margin: float, most: float
) -> None:
    """Facing the camera, where corners are weakest; aslant on paper that ends near the print."""
    rng = np.random.default_rng(4)
    errors = []
    inside = []
    for seed in range(8):
        pose = random_pose(STANDARD_CAMERA, rng, distance, size=0.112, tilt_deg=tilt)
        seen = BOARD.find(frame_of(picture(pose, seed, margin)), STANDARD_CAMERA)
        assert seen is not None
        errors.append(seen.pose.distance(pose)[1])
        inside.append(errors[-1] ** 2 / np.trace(seen.covariance[3:, 3:]))
    assert np.sqrt(np.mean(np.square(errors))) < most
    assert 0.3 < np.sqrt(np.mean(inside)) < 1.5  # the stated sigma is consistent


def test_the_print_distinguishes_a_marker_from_its_mirror_image() -> None:
    """A 50 mm marker at 1 m, tilted by some degrees in a direction unknown from the corners."""
    target = marker(7, 0.05, DICTIONARY)
    rng = np.random.default_rng(9)
    worst = 0.0
    for _ in range(10):
        lean = Pose(
            wxyz=rotation_exp([*np.deg2rad(rng.uniform(-4.0, 4.0, 2)), rng.uniform(-3.0, 3.0)])
        )
        pose = Pose((0.02, -0.03, 1.0), FACING.compose(lean).wxyz)
        image = render_markers(STANDARD_CAMERA, {7: (0.05, pose)}, rng)
        seen = target.find(frame_of(image), STANDARD_CAMERA)
        assert seen is not None
        worst = max(worst, seen.pose.distance(pose)[1])
        assert (
            seen.alternative is None
            or seen.alternative.distance(pose)[1] > seen.pose.distance(pose)[1]
        )
    assert worst < np.deg2rad(2.5)


def test_a_missing_print_gives_no_refined_corners() -> None:
    pose = random_pose(STANDARD_CAMERA, np.random.default_rng(1), 0.7, size=0.112)
    image = picture(pose, 1)
    found = found_in(image)

    def fit(gray: NDArray[np.uint8], marker_id: int, start: NDArray[np.float64]) -> Corners:
        (refined,) = refine_markers(gray, [start], [marker_id], DICTIONARY, STANDARD_CAMERA)
        return refined

    assert all(fit(image, i, start).refined for i, start in found.items())
    # from rougher corners, too
    rough = found[0] + 1.0
    again = fit(image, 0, rough)
    assert again.refined and again.pixels == pytest.approx(fit(image, 0, found[0]).pixels, abs=0.02)
    noise = np.random.default_rng(2).integers(0, 255, image.shape).astype(np.uint8)
    for spoilt in (noise, np.full_like(image, 128), image[::-1].copy()):
        other = fit(spoilt, 0, rough)
        assert not other.refined
        assert (other.pixels == rough).all()
    assert not fit(noise, 0, rough).verified
    for start in (found[0] + 2000.0, found[0] * (1, 0)):
        assert not fit(image, 0, start).refined
    assert refine_markers(image, [], [], DICTIONARY, STANDARD_CAMERA) == []


@pytest.mark.parametrize(("seed", "distance"), [(75, 1.8), (106, 1.4), (162, 1.4)])
def test_the_mirrored_orientation_stays_ambiguous(seed: int, distance: float) -> None:
    """Both poses are compared on the same pixels. Different pixels gave errors of 10 degrees."""
    rng = np.random.default_rng(seed)
    pose = random_pose(STANDARD_CAMERA, rng, distance, tilt_deg=(1, 30))
    image = render_markers(STANDARD_CAMERA, {7: (0.05, pose)}, rng)
    seen = marker(7, 0.05, DICTIONARY).find(frame_of(image), STANDARD_CAMERA)
    assert seen is not None
    mirrored = seen.alternative is not None and (
        seen.alternative.distance(pose)[1] < seen.pose.distance(pose)[1]
    )
    assert not mirrored or seen.ambiguity > 0.6
