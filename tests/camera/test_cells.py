"""Poses from the whole print of marker or board: nearer than from corners, not believed where spoilt."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.bench.camera.accuracy import frame_of
from robot_ik.camera.bodies import grid_body
from robot_ik.camera.observations import estimate_body
from robot_ik.camera.photometric_pose import fit_photometric_pose
from robot_ik.camera.synthetic.datasets import STANDARD_CAMERA, random_pose, render_marker, render_markers
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.geometry import Pose, rotation_exp

DICTIONARY = "DICT_4X4_50"
BOARD = grid_body(2, 2, 0.05, 0.012).markers
FACING = Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))


def picture(pose: Pose, seed: int, margin: float = 0.24) -> NDArray[np.uint8]:
    placed = {i: (side, pose.compose(on)) for i, (side, on) in BOARD.items()}
    rng = np.random.default_rng(seed)
    return render_markers(STANDARD_CAMERA, placed, rng, dictionary=DICTIONARY, margin=margin)


@pytest.mark.parametrize(
    ("distance", "tilt", "margin", "share"), [(0.7, (0.5, 6.0), 0.24, 0.8), (1.0, (45.0, 60.0), 0.12, 0.3)]
)
def test_the_whole_print_is_nearer_than_the_corners(
    distance: float, tilt: tuple[float, float], margin: float, share: float
) -> None:
    """Facing the camera, where corners are weakest; aslant on paper that ends near the print."""
    tracker = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {i: side for i, (side, _) in BOARD.items()})
    rng, off, inside = np.random.default_rng(4), [], []
    for seed in range(8):
        pose, _ = random_pose(STANDARD_CAMERA, rng, distance, size=0.112, tilt_deg=tilt)
        frame = frame_of(picture(pose, seed, margin))
        corners = estimate_body(tracker.corners(frame), BOARD, STANDARD_CAMERA)
        print_too = tracker.observe_body(frame, BOARD)
        assert corners is not None and print_too is not None
        off.append([one.pose_camera_body.distance(pose)[1] for one in (corners, print_too)])
        inside.append(off[-1][1] ** 2 / np.trace(print_too.covariance[3:, 3:]))
    by_corners, by_print = np.sqrt(np.mean(np.square(off), axis=0))
    assert by_print < share * by_corners
    assert 0.3 < np.sqrt(np.mean(inside)) < 1.5  # it knows how near


def test_the_print_tells_a_marker_from_its_mirror_image() -> None:
    """A 50 mm marker at 1 m that leans by some degrees: the corners alone cannot tell which way."""
    tracker = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {7: 0.05})
    rng, worst = np.random.default_rng(9), 0.0
    for _ in range(10):
        lean = Pose(wxyz=rotation_exp([*np.deg2rad(rng.uniform(-4.0, 4.0, 2)), rng.uniform(-3.0, 3.0)]))
        pose = Pose((0.02, -0.03, 1.0), FACING.compose(lean).wxyz)
        image = render_marker(STANDARD_CAMERA, pose, rng, marker_id=7)
        (seen,) = tracker.observe(frame_of(image))
        worst = max(worst, seen.pose.distance(pose)[1])
        assert seen.alternative is None or seen.alternative.distance(pose)[1] > seen.pose.distance(pose)[1]
    assert worst < np.deg2rad(2.5)


def test_a_print_that_is_not_there_is_not_believed() -> None:
    pose, _ = random_pose(STANDARD_CAMERA, np.random.default_rng(1), 0.7, size=0.112)
    image = picture(pose, 1)
    near = 1e-6 * np.eye(6)

    def fit(gray: NDArray[np.uint8], ids: list[int], start: Pose = pose) -> object:
        return fit_photometric_pose(gray, BOARD, ids, DICTIONARY, STANDARD_CAMERA, start, near)

    assert fit(image, [0, 1, 2, 3]) is not None
    noise = np.random.default_rng(2).integers(0, 255, image.shape).astype(np.uint8)
    assert fit(noise, [0, 1, 2, 3]) is None
    assert fit(np.full_like(image, 128), [0, 1]) is None
    behind = Pose((0.0, 0.0, -0.5), pose.wxyz)
    assert fit(image, [0], behind) is None and fit(image, []) is None
    # what was said to be known to a micrometre is not left for something farther off
    beside = Pose(pose.position + np.array([2e-4, 0.0, 0.0]), pose.wxyz)
    assert (
        fit_photometric_pose(image, BOARD, [0], DICTIONARY, STANDARD_CAMERA, beside, 1e-12 * np.eye(6))
        is None
    )


@pytest.mark.parametrize(("seed", "distance"), [(75, 1.8), (106, 1.4), (162, 1.4)])
def test_the_mirror_image_is_not_taken_for_sure(seed: int, distance: float) -> None:
    """Both poses are judged by the same pixels: by those of each its own, these were 10 degrees off."""
    rng = np.random.default_rng(seed)
    pose, _ = random_pose(STANDARD_CAMERA, rng, distance, tilt_deg=(1, 30))
    image = render_marker(STANDARD_CAMERA, pose, rng, marker_id=7)
    (seen,) = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {7: 0.05}).observe(frame_of(image))
    mirrored = seen.alternative is not None and (
        seen.alternative.distance(pose)[1] < seen.pose.distance(pose)[1]
    )
    assert not mirrored or seen.ambiguity > 0.6
