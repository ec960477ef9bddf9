"""Two poses in mind from picture to picture, the search window, and what compiled code computes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.camera.bodies import grid_body
from robot_ik.camera.corner_refinement import refine_markers, unrefined
from robot_ik.camera.detection import Detection, MarkerDetector, SearchWindow
from robot_ik.camera.observations import marker_branches, marker_points
from robot_ik.camera.pose_fit import Branches, flat_normal, mirrored
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA as CAMERA
from robot_ik.camera.synthetic.pictures import random_pose, render_markers
from robot_ik.camera.tracker import BranchMemory, MarkerTracker
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.jobs.ar.scene import synthetic_scene

FACING = np.array([0.0, 1.0, 0.0, 0.0])
SIZE, RATE = 0.05, 30.0


def seen(pose: Pose, sigma: float, rng: np.random.Generator) -> Branches:
    corners = CAMERA.project(pose.apply(marker_points(SIZE))) + rng.normal(0, sigma, (4, 2))
    found = marker_branches(unrefined(corners, CAMERA, sigma), SIZE, CAMERA)
    assert found is not None
    return found


def swing(distance: float, sigma: float, seed: int, count: int = 150) -> Iterator[tuple[Pose, Branches]]:
    """A marker that swings +-25 degrees through the frontal view, twice in five seconds."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        lean = np.deg2rad([25 * np.sin(2 * np.pi * k / 75), 4 * np.sin(2 * np.pi * k / 47), 15])
        pose = Pose((0.03, 0.02, distance), quat_multiply(FACING, rotation_exp(lean)))
        yield pose, seen(pose, sigma, rng)


def angles(pairs: list[tuple[Pose, Pose]]) -> np.ndarray:
    return np.rad2deg([a.distance(b)[1] for a, b in pairs])


# ------------------------------------------------------------------------------------- flips


@pytest.mark.parametrize(("distance", "sigma"), [(1.0, 0.05), (1.0, 0.15), (1.5, 0.1)])
def test_two_hypotheses_are_never_worse_than_the_smaller_error(distance: float, sigma: float) -> None:
    for seed in range(3):
        memory, alone, kept = BranchMemory(), [], []
        for k, (true, branches) in enumerate(swing(distance, sigma, seed)):
            choice = memory.choose(branches, k / RATE)
            alone.append((true, branches.poses[0]))
            kept.append((true, branches.poses[choice.index]))
        one, two = angles(alone), angles(kept)
        assert np.sqrt(np.mean(two**2)) <= np.sqrt(np.mean(one**2)) + 1e-9, seed
        assert (two > 5).sum() <= (one > 5).sum(), seed
    if sigma == 0.15:
        assert (two > 5).sum() < 0.7 * (one > 5).sum()


def test_a_wrong_branch_does_not_stay_alive() -> None:
    """Ten pictures that lie, then the truth: it is believed again after a few."""
    memory = BranchMemory()
    pose = Pose((0.0, 0.0, 0.7), quat_multiply(FACING, rotation_exp([0.5, 0.1, 0.0])))
    rng = np.random.default_rng(1)
    wrong = []
    for k in range(20):
        branches = seen(pose, 0.05, rng)
        if k < 10:
            branches = dataclasses.replace(branches, poses=branches.poses[::-1])
        index = memory.choose(branches, k / RATE).index
        wrong.append(branches.poses[index].distance(pose)[1] > 0.3)
    assert all(wrong[:10]) and not any(wrong[13:])


def test_one_wrong_picture_among_right_ones_changes_nothing() -> None:
    memory, rng = BranchMemory(), np.random.default_rng(2)
    pose = Pose((0.0, 0.0, 1.2), quat_multiply(FACING, rotation_exp([0.3, 0.1, 0.0])))
    for k in range(12):
        branches = seen(pose, 0.05, rng)
        if k == 8:  # noise prefers the mirror image by a little
            costs = zip(branches.fits[::-1], (2.0, 4.0), strict=True)
            fits = tuple(dataclasses.replace(fit, costs=np.array([cost])) for fit, cost in costs)
            branches = Branches(branches.poses[::-1], fits)
        index = memory.choose(branches, k / RATE).index
        assert branches.poses[index].distance(pose)[1] < 0.2, k


def test_the_first_picture_speaks_for_itself_and_so_does_one_after_a_pause() -> None:
    memory, rng = BranchMemory(), np.random.default_rng(3)
    for k, time in enumerate((0.0, 10.0, 3.0, float("nan"))):
        branches = seen(random_pose(CAMERA, np.random.default_rng(k), 1.0), 0.1, rng)
        choice = (BranchMemory() if np.isnan(time) else memory).choose(branches, time)
        assert choice.index == 0
        assert choice.ambiguity == pytest.approx(branches.ambiguity)


def test_pictures_of_a_resting_marker_make_it_less_ambiguous() -> None:
    memory, rng = BranchMemory(), np.random.default_rng(4)
    pose = Pose((0.0, 0.0, 1.2), quat_multiply(FACING, rotation_exp([0.35, 0.1, 0.0])))
    alone, together = [], []
    for k in range(40):
        branches = seen(pose, 0.12, rng)
        together.append(memory.choose(branches, k / RATE).ambiguity)
        alone.append(branches.ambiguity)
    assert np.mean(together[10:]) < np.mean(alone[10:]) - 0.04
    assert all(0.0 <= a <= 1.0 for a in together)


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_the_mirror_image_turns_depths_round(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = random_pose(CAMERA, rng, 0.8, tilt_deg=(5, 60))
    turn = Pose(
        rng.normal(0, 0.1, 3), rotation_exp(rng.normal(0, 1, 3))
    )  # the plane lies anywhere in the body
    points = turn.apply(rng.uniform(-0.1, 0.1, (6, 3)) * (1, 1, 0))
    camera = pose.compose(turn.inverse())
    normal = flat_normal(points)
    assert normal is not None
    there, here = mirrored(camera, points, normal).apply(points), camera.apply(points)
    centre = here.mean(axis=0)
    way = centre / np.linalg.norm(centre)
    assert (there - centre) @ way == pytest.approx(-(here - centre) @ way, abs=1e-9)
    aside = np.eye(3) - np.outer(way, way)
    assert (there - centre) @ aside == pytest.approx((here - centre) @ aside, abs=1e-9)
    assert flat_normal(points + rng.normal(0, 0.02, points.shape)) is None


# ------------------------------------------------------------------------------------- window


def test_a_part_of_the_picture_gives_the_corners_of_the_whole() -> None:
    pose = Pose((0.05, -0.04, 0.5), quat_multiply(FACING, rotation_exp([0.4, 0.2, 0.7])))
    image = render_markers(CAMERA, {7: (SIZE, pose)}, np.random.default_rng(5))
    detector = MarkerDetector("DICT_4X4_50")
    (found,) = detector.detect(image)
    (whole,) = refine_markers(image, [found.corners], [7], "DICT_4X4_50", CAMERA)
    window = SearchWindow()
    window.remember([found])
    box = window.around(640, 480)
    assert box is not None
    x0, y0, x1, y1 = box
    part = image[y0:y1, x0:x1]
    (again,) = detector.detect_part(part, window.side, origin=(x0, y0))
    assert again.corners == pytest.approx(found.corners, abs=1.5)
    (refined,) = refine_markers(part, [found.corners], [7], "DICT_4X4_50", CAMERA, origin=(x0, y0))
    # The fit samples pixels on a lattice, which begins where the part does.
    assert refined.corners == pytest.approx(whole.corners, abs=0.02)
    assert refined.normalized == pytest.approx(CAMERA.undistort(refined.corners), abs=1e-9)


@settings(max_examples=30)
@given(st.floats(0, 639), st.floats(0, 479), st.floats(10, 100), st.floats(0, 3), st.floats(-40, 40))
def test_the_window_keeps_the_white_margin_and_looks_ahead(
    x: float, y: float, size: float, turn: float, step: float
) -> None:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    window = SearchWindow()
    assert window.around(640, 480) is None
    for k in range(2):
        window.remember([Detection(1, square @ rotation.T + (x + k * step, y))])
    box = window.around(640, 480)
    if box is None:
        return
    x0, y0, x1, y1 = box
    assert 0 <= x0 <= max(x1, 640) and 0 <= y0 <= max(y1, 480) and x1 <= 640 and y1 <= 480
    # Where it is, and where it will be: with half a marker of white all round, as far as the picture goes.
    for ahead in (1, 2):
        wanted = 2 * square @ rotation.T + (x + ahead * step, y)
        inside = np.clip(wanted, 0, (639, 479))
        assert (inside >= (x0 - 1e-6, y0 - 1e-6)).all() and (inside <= (x1, y1)).all()


def test_tracking_sees_what_single_pictures_see() -> None:
    single = MarkerTracker(CAMERA, "DICT_4X4_50", {3: SIZE, 7: SIZE})
    film = MarkerTracker(CAMERA, "DICT_4X4_50", {3: SIZE, 7: SIZE}, window=True)
    whole = 0
    for k in range(12):
        poses = {
            3: Pose((-0.06 + 0.004 * k, 0.0, 0.5), quat_multiply(FACING, rotation_exp([0.5, 0, 0]))),
            7: Pose((0.06, 0.002 * k, 0.55), quat_multiply(FACING, rotation_exp([0, 0.5, 0.1 * k]))),
        }
        markers = {i: (SIZE, pose) for i, pose in poses.items()}
        gray = render_markers(CAMERA, markers, np.random.default_rng(k))
        frame = Frame(np.repeat(gray[:, :, None], 3, axis=2), k / RATE, k)
        a, b = single.observe(frame), film.observe(frame)
        assert [o.id for o in a] == [o.id for o in b] == [3, 7]
        for one, two in zip(a, b, strict=True):
            # A film fits a part of the pixels; this is the largest of 192 differences.
            assert np.abs(one.corners - two.corners).max() < 2.5 * two.sigma
            assert two.pose.distance(poses[two.id])[1] < np.deg2rad(1.0)
            assert two.time == frame.time
        whole += film._window._since_whole == 0
    assert whole == 2  # the first one and the tenth after it


def test_rough_corners_that_lead_nowhere_are_sought_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    pose = Pose((0.0, 0.0, 0.5), quat_multiply(FACING, rotation_exp([0.5, 0, 0])))
    image = render_markers(CAMERA, {3: (SIZE, pose)}, np.random.default_rng(5))
    searches: list[str] = []

    def seen_by(tracker: MarkerTracker, lead_nowhere: set[str]) -> bool:
        """Whether corners are refined where the named searches give some that are 12 px off."""

        def search(name: str, real: Callable[[Any], list[Detection]], gray: Any) -> list[Detection]:
            searches.append(name)
            off = 12.0 if name in lead_nowhere else 0.0
            return [Detection(d.id, d.corners + off) for d in real(gray)]

        for name in ("detect", "detect_quickly"):
            found_by = partial(search, name, getattr(tracker.detector, name))
            monkeypatch.setattr(tracker.detector, name, found_by)
        searches.clear()
        return 3 in tracker.corners(Frame(image, 0.0, 0))

    assert seen_by(MarkerTracker(CAMERA, "DICT_4X4_50", {3: SIZE}), {"detect_quickly"})
    assert searches == ["detect_quickly", "detect"]
    assert not seen_by(MarkerTracker(CAMERA, "DICT_4X4_50", SIZE), {"detect"})
    assert searches == ["detect"]  # it would find the same


def test_small_markers_under_a_steep_view_stay_in_the_window() -> None:
    """Cells of 2 px: read at the picture's own size, one in three of these boards lacks a marker.

    So does the first picture, which has no window yet: it is looked at round the others.
    """
    source, clock = synthetic_scene(640, 480)
    layout = grid_body(2, 2, 0.05, 0.0125).markers
    sizes = {i: side for i, (side, _) in layout.items()}
    tracker = MarkerTracker(source.scene.intrinsics, "DICT_5X5_50", sizes, window=True)
    whole: list[tuple[int, ...]] = []
    inner = tracker.detector.detect

    def spy(image: Any) -> Any:
        whole.append(image.shape)
        return inner(image)

    tracker.detector.detect = spy  # type: ignore[method-assign]
    for k in range(9):
        seen = tracker.observe_body(source.read(), layout)
        assert seen is not None and len(seen.ids) == 4, k
        clock.sleep_until((k + 1) / 30.0)
    assert len(whole) <= 1
