"""Tracking: two poses from frame to frame, and several targets in a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.camera.accuracy import frame_of
from robot_ik.camera.corners import Corners, unrefined
from robot_ik.camera.detection import Detection, MarkerDetector
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA as CAMERA
from robot_ik.camera.synthetic.pictures import random_pose, render_markers
from robot_ik.camera.targets import MarkerFits, MarkerTarget, marker, marker_grid, marker_points
from robot_ik.camera.tracker import MAX_FITS, PoseMemory, Tracker
from robot_ik.errors import CalibrationError, CameraError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from tests.camera.rendering import board_picture

FACING = np.array([0.0, 1.0, 0.0, 0.0])
SIZE = 0.05
RATE = 30.0
MARKER = marker(7, SIZE)


def seen(pose: Pose, sigma: float, rng: np.random.Generator, time: float = 0.0) -> MarkerFits:
    """Both poses of a marker whose corners are off by ``sigma`` px."""
    pixels = CAMERA.project(pose.apply(marker_points(SIZE))) + rng.normal(0, sigma, (4, 2))
    fits = MARKER.fit({7: unrefined(pixels, CAMERA, sigma)}, CAMERA, time)
    assert fits is not None
    return fits


def swing(distance: float, sigma: float, seed: int) -> Iterator[tuple[Pose, MarkerFits]]:
    """A marker that swings +-25 degrees through the frontal view, twice in five seconds."""
    rng = np.random.default_rng(seed)
    for k in range(150):
        lean = np.deg2rad([25 * np.sin(2 * np.pi * k / 75), 4 * np.sin(2 * np.pi * k / 47), 15])
        pose = Pose((0.03, 0.02, distance), quat_multiply(FACING, rotation_exp(lean)))
        yield pose, seen(pose, sigma, rng, k / RATE)


def angles(pairs: list[tuple[Pose, Pose]]) -> np.ndarray:
    return np.rad2deg([a.distance(b)[1] for a, b in pairs])


@pytest.mark.parametrize(("distance", "sigma"), [(1.0, 0.05), (1.0, 0.15), (1.5, 0.1)])
def test_memory_does_not_increase_the_rms_error(distance: float, sigma: float) -> None:
    for seed in range(3):
        memory = PoseMemory()
        single = []
        kept = []
        for true, fits in swing(distance, sigma, seed):
            single.append((true, fits.observation().pose))
            kept.append((true, memory.choose(fits).pose))
        single_angles = angles(single)
        kept_angles = angles(kept)
        assert np.sqrt(np.mean(kept_angles**2)) <= np.sqrt(np.mean(single_angles**2)) + 1e-9, seed
        assert (kept_angles > 5).sum() <= (single_angles > 5).sum(), seed
    if sigma == 0.15:
        assert (kept_angles > 5).sum() < 0.7 * (single_angles > 5).sum()


def test_a_wrong_pose_does_not_persist() -> None:
    """Ten pictures prefer the wrong pose, then the right one is chosen again after a few."""
    memory = PoseMemory()
    pose = Pose((0.0, 0.0, 0.7), quat_multiply(FACING, rotation_exp([0.5, 0.1, 0.0])))
    rng = np.random.default_rng(1)
    wrong = []
    for k in range(20):
        fits = seen(pose, 0.05, rng, k / RATE)
        if k < 10:
            one, other = fits.fits
            poses = [replace(one, pose=other.pose), replace(other, pose=one.pose)]
            fits = replace(fits, fits=poses)
        wrong.append(memory.choose(fits).pose.distance(pose)[1] > 0.3)
    assert all(wrong[:10])
    assert not any(wrong[13:])


def test_one_wrong_picture_does_not_change_the_result() -> None:
    memory = PoseMemory()
    rng = np.random.default_rng(2)
    pose = Pose((0.0, 0.0, 1.2), quat_multiply(FACING, rotation_exp([0.3, 0.1, 0.0])))
    for k in range(12):
        fits = seen(pose, 0.05, rng, k / RATE)
        if k == 8:
            # Noise prefers the mirror image by a little.
            one, other = fits.fits
            fits = replace(fits, fits=[replace(other, cost=2.0), replace(one, cost=4.0)])
        assert memory.choose(fits).pose.distance(pose)[1] < 0.2, k


def test_the_first_picture_and_one_after_a_pause_count_alone() -> None:
    memory = PoseMemory()
    rng = np.random.default_rng(3)
    for k, time in enumerate((0.0, 10.0, 3.0, float("nan"))):
        fits = seen(random_pose(CAMERA, np.random.default_rng(k), 1.0), 0.1, rng, time)
        choice = (PoseMemory() if np.isnan(time) else memory).choose(fits)
        single = fits.observation()
        assert choice.pose is single.pose
        assert choice.ambiguity == pytest.approx(single.ambiguity)


def test_pictures_of_a_resting_marker_make_it_less_ambiguous() -> None:
    memory = PoseMemory()
    rng = np.random.default_rng(4)
    pose = Pose((0.0, 0.0, 1.2), quat_multiply(FACING, rotation_exp([0.35, 0.1, 0.0])))
    single = []
    together = []
    for k in range(40):
        fits = seen(pose, 0.12, rng, k / RATE)
        together.append(memory.choose(fits).ambiguity)
        single.append(fits.observation().ambiguity)
    assert np.mean(together[10:]) < np.mean(single[10:]) - 0.04
    assert all(0.0 <= a <= 1.0 for a in together)


def test_targets_are_told_apart_and_carry_the_time() -> None:
    targets = [marker(7, SIZE), marker(3, SIZE), marker(9, SIZE)]
    poses = {
        3: Pose((-0.06, 0.0, 0.5), quat_multiply(FACING, rotation_exp([0.5, 0, 0]))),
        7: Pose((0.06, 0.0, 0.55), quat_multiply(FACING, rotation_exp([0, 0.5, 0.1]))),
    }
    placed = {i: (SIZE, pose) for i, pose in poses.items()}
    image = render_markers(CAMERA, placed, np.random.default_rng(0), dictionary="DICT_5X5_50")
    observations = Tracker(CAMERA, targets).observe(frame_of(image, time=12.5))
    assert [o.target for o in observations] == targets[:2]
    for o in observations:
        assert o.time == 12.5
        assert o.pose.distance(poses[o.ids[0]])[0] < 5e-4


def test_targets_of_two_dictionaries_are_tracked() -> None:
    """Both ids are 7."""
    targets = [marker(7, SIZE, "DICT_5X5_50"), marker(7, SIZE, "DICT_4X4_50")]
    images = []
    for target, x in zip(targets, (-0.08, 0.08), strict=True):
        pose = Pose((x, 0.0, 0.5), quat_multiply(FACING, rotation_exp([0.4, 0, 0])))
        placed = {7: (SIZE, pose)}
        rng = np.random.default_rng(0)
        images.append(render_markers(CAMERA, placed, rng, dictionary=target.dictionary))
    image = np.hstack([images[0][:, :320], images[1][:, 320:]])
    observations = Tracker(CAMERA, targets).observe(frame_of(image))
    assert [o.target for o in observations] == targets
    assert observations[0].pose.position[0] < 0.0 < observations[1].pose.position[0]


def test_a_large_board_is_fitted_in_part_and_every_target_is_found() -> None:
    """48 markers on a board, and one of them as a separate target, too."""
    board = marker_grid(8, 6, 0.02, 0.005, dictionary="DICT_5X5_50")
    single = MarkerTarget({0: board.markers[0]}, board.dictionary, "first marker")
    pose = Pose((0.0, 0.0, 0.4), quat_multiply(FACING, rotation_exp([0.2, 0.0, 0.0])))
    frame = board_picture(board, pose)
    whole = board.find(frame, CAMERA)
    tracked, first = Tracker(CAMERA, [board, single]).observe(frame)
    assert whole is not None and len(whole.ids) == 48
    assert 10 <= len(tracked.ids) <= MAX_FITS
    assert first.ids == (0,)
    assert tracked.pose.distance(pose)[0] < 1e-4
    # The fitted markers are spread over the board.
    assert np.ptp(tracked.points[:, 0]) > 0.15 and np.ptp(tracked.points[:, 1]) > 0.1


def test_the_same_frame_is_processed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = frame_of(np.full((480, 640), 128, np.uint8))
    tracker = Tracker(CAMERA, [MARKER])
    first = tracker.observe(frame)
    monkeypatch.setattr("robot_ik.camera.tracker.find_corners", None)
    assert tracker.observe(frame) is first


def test_a_frame_of_another_size_and_a_bare_picture_are_refused() -> None:
    tracker = Tracker(CAMERA, [MARKER])
    with pytest.raises(CalibrationError, match="640x480 px, the picture has 320x240"):
        tracker.observe(Frame(np.zeros((240, 320, 3), np.uint8), 0.0, 0))
    with pytest.raises(CameraError):
        tracker.observe(np.zeros((480, 640, 3), np.uint8))  # type: ignore[arg-type]


def test_a_hidden_part_of_a_board_does_not_stop_the_tracking() -> None:
    board = marker_grid(2, 2, SIZE, 0.012)
    tracker = Tracker(CAMERA, [board])
    pose = Pose((0.0, 0.0, 0.6), quat_multiply(FACING, rotation_exp([0.3, 0.1, 0.0])))
    for k in range(4):
        frame = board_picture(board, pose, seed=k)
        if k % 2:
            x, y = CAMERA.project(pose.apply(board.markers[3][1].position[None]))[0].astype(int)
            frame.image[y - 20 : y + 20, x - 20 : x + 20] = 128
        (seen_board,) = tracker.observe(replace(frame, time=k / RATE, sequence=k))
        assert seen_board.ids == ((0, 1, 2) if k % 2 else (0, 1, 2, 3))
        assert seen_board.pose.distance(pose)[0] < 2e-4


def test_unverified_corners_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quick detection whose fits fail is repeated thoroughly."""
    pose = Pose((0.0, 0.0, 0.5), quat_multiply(FACING, rotation_exp([0.5, 0, 0])))
    frame = board_picture(MARKER, pose)
    calls: list[str] = []

    def displaced(name: str, offset: float) -> None:
        real = getattr(MarkerDetector, name)

        def detect(detector: MarkerDetector, image: np.ndarray) -> list[Detection]:
            calls.append(name)
            return [Detection(d.id, d.corners + offset) for d in real(detector, image)]

        monkeypatch.setattr(MarkerDetector, name, detect)

    displaced("detect_quickly", 12.0)
    displaced("detect", 0.0)
    observation = MARKER.find(frame, CAMERA)
    assert observation is not None and observation.pose.distance(pose)[0] < 5e-4
    assert calls == ["detect_quickly", "detect"]


def test_corners_state_how_accurate_they_are() -> None:
    corners = Corners(np.zeros((4, 2)), np.zeros((4, 2)), 0.04 * np.eye(8), refined=True)
    assert corners.sigma == pytest.approx(0.2)


def test_a_limit_of_pixels_costs_little_accuracy() -> None:
    board = marker_grid(5, 4, 0.03, 0.0075)
    pose = Pose((0.0, 0.0, 0.5), quat_multiply(FACING, rotation_exp([0.3, 0.1, 0.0])))
    frame = board_picture(board, pose)
    (tracked,) = Tracker(CAMERA, [board]).observe(frame)
    whole = board.find(frame, CAMERA)
    assert whole is not None and len(tracked.ids) == len(whole.ids) == 20
    assert whole.sigma < tracked.sigma < 2.0 * whole.sigma
    assert tracked.pose.distance(pose)[0] < 5e-5
