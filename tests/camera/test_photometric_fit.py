"""Corners from the whole print: nearer than from the sides, not believed where it is not there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.camera.accuracy import frame_of
from robot_ik.camera.bodies import grid_body
from robot_ik.camera.corner_refinement import RefinedCorners, is_print, refine_markers
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, random_pose, render_markers
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.geometry import Pose, rotation_exp

DICTIONARY = "DICT_4X4_50"
BOARD = grid_body(2, 2, 0.05, 0.012).markers
FACING = Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))


def picture(pose: Pose, seed: int, margin: float = 0.24) -> NDArray[np.uint8]:
    placed = {i: (side, pose.compose(on)) for i, (side, on) in BOARD.items()}
    rng = np.random.default_rng(seed)
    return render_markers(STANDARD_CAMERA, placed, rng, dictionary=DICTIONARY, margin=margin)


def found_in(gray: NDArray[np.uint8]) -> dict[int, NDArray[np.float64]]:
    """Corners as the detector gives them."""
    return {d.id: d.corners for d in MarkerDetector(DICTIONARY).detect(gray)}


@pytest.mark.parametrize(
    ("distance", "tilt", "margin", "most"),
    [(0.7, (0.5, 6.0), 0.24, 1.2e-3), (1.0, (45.0, 60.0), 0.12, 1e-3)],
)
def test_a_board_is_known_as_well_as_it_says(
    distance: float, tilt: tuple[float, float], margin: float, most: float
) -> None:
    """Facing the camera, where corners are weakest; aslant on paper that ends near the print."""
    tracker = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {i: side for i, (side, _) in BOARD.items()})
    rng, off, inside = np.random.default_rng(4), [], []
    for seed in range(8):
        pose = random_pose(STANDARD_CAMERA, rng, distance, size=0.112, tilt_deg=tilt)
        seen = tracker.observe_body(frame_of(picture(pose, seed, margin)), BOARD)
        assert seen is not None
        off.append(seen.pose_camera_body.distance(pose)[1])
        inside.append(off[-1] ** 2 / np.trace(seen.covariance[3:, 3:]))
    assert np.sqrt(np.mean(np.square(off))) < most
    assert 0.3 < np.sqrt(np.mean(inside)) < 1.5  # it knows how near


def test_the_print_tells_a_marker_from_its_mirror_image() -> None:
    """A 50 mm marker at 1 m that leans by some degrees: the corners alone cannot tell which way."""
    tracker = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {7: 0.05})
    rng, worst = np.random.default_rng(9), 0.0
    for _ in range(10):
        lean = Pose(wxyz=rotation_exp([*np.deg2rad(rng.uniform(-4.0, 4.0, 2)), rng.uniform(-3.0, 3.0)]))
        pose = Pose((0.02, -0.03, 1.0), FACING.compose(lean).wxyz)
        image = render_markers(STANDARD_CAMERA, {7: (0.05, pose)}, rng)
        (seen,) = tracker.observe(frame_of(image))
        worst = max(worst, seen.pose.distance(pose)[1])
        assert seen.alternative is None or seen.alternative.distance(pose)[1] > seen.pose.distance(pose)[1]
    assert worst < np.deg2rad(2.5)


def test_a_print_that_is_not_there_is_not_believed() -> None:
    pose = random_pose(STANDARD_CAMERA, np.random.default_rng(1), 0.7, size=0.112)
    image = picture(pose, 1)
    found = found_in(image)

    def fit(gray: NDArray[np.uint8], marker_id: int, start: NDArray[np.float64]) -> RefinedCorners:
        (refined,) = refine_markers(gray, [start], [marker_id], DICTIONARY, STANDARD_CAMERA)
        return refined

    assert all(fit(image, i, start).refined for i, start in found.items())
    # from rougher corners, too
    rough = found[0] + 1.0
    again = fit(image, 0, rough)
    assert again.refined and again.corners == pytest.approx(fit(image, 0, found[0]).corners, abs=0.02)
    noise = np.random.default_rng(2).integers(0, 255, image.shape).astype(np.uint8)
    for spoilt in (noise, np.full_like(image, 128), image[::-1].copy()):
        other = fit(spoilt, 0, rough)
        assert not other.refined
        assert (other.corners == rough).all()
    assert not is_print(fit(noise, 0, rough))
    last = {0: fit(image, 0, found[0])}
    for start in (found[0] + 2000.0, found[0] * (1, 0)):
        assert not fit(image, 0, start).refined
        (seen,) = refine_markers(image, [start], [0], DICTIONARY, STANDARD_CAMERA, film=True, before=last)
        assert not seen.refined
    assert refine_markers(image, [], [], DICTIONARY, STANDARD_CAMERA) == []


def test_in_a_film_a_fit_starts_from_the_last_picture_and_ends_where_it_would_alone() -> None:
    before: dict[int, RefinedCorners] = {}
    off: list[float] = []
    for k in range(6):
        pose = Pose((0.01 * k - 0.02, 0.004 * k, 0.7 + 0.005 * k), FACING.wxyz)
        image = picture(pose, k)
        found = found_in(image)
        ids, starts = list(found), list(found.values())

        def fit(
            known: dict[int, RefinedCorners],
            image: NDArray[np.uint8] = image,
            starts: list[NDArray[np.float64]] = starts,
            ids: list[int] = ids,
        ) -> list[RefinedCorners]:
            return refine_markers(image, starts, ids, DICTIONARY, STANDARD_CAMERA, film=True, before=known)

        alone, again, tracked = fit({}), fit({}), fit(before)
        assert all((a.corners == b.corners).all() for a, b in zip(alone, again, strict=True))
        assert all(one.refined for one in tracked)
        off += [
            float(np.abs(a.corners - b.corners).max() / a.sigma) for a, b in zip(alone, tracked, strict=True)
        ]
        before = dict(zip(ids, tracked, strict=True))
    # Not the same pixels, so not the same corners: but within what either states.
    assert np.median(off) < 1.0 and max(off) < 2.0


@pytest.mark.parametrize(("seed", "distance"), [(75, 1.8), (106, 1.4), (162, 1.4)])
def test_the_mirror_image_is_not_taken_for_sure(seed: int, distance: float) -> None:
    """Both poses are judged by the same pixels: by those of each its own, these were 10 degrees off."""
    rng = np.random.default_rng(seed)
    pose = random_pose(STANDARD_CAMERA, rng, distance, tilt_deg=(1, 30))
    image = render_markers(STANDARD_CAMERA, {7: (0.05, pose)}, rng)
    (seen,) = MarkerTracker(STANDARD_CAMERA, DICTIONARY, {7: 0.05}).observe(frame_of(image))
    mirrored = seen.alternative is not None and (
        seen.alternative.distance(pose)[1] < seen.pose.distance(pose)[1]
    )
    assert not mirrored or seen.ambiguity > 0.6
