"""From pictures to goals: the tracker and the marker goal source."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from robot_ik.camera.corner_refinement import unrefined
from robot_ik.camera.marker_goals import AMBIGUITY_LIMIT, MarkerGoalSource
from robot_ik.camera.observations import marker_branches, marker_observation, marker_points
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA as CAMERA
from robot_ik.camera.synthetic.pictures import render_markers
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.errors import CalibrationError, CameraError, FrameTimeoutError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal

FACING = np.array([0.0, 1.0, 0.0, 0.0])
# Camera 0.6 m above the table, looking down; its picture's up is the world's y.
CAMERA_IN_WORLD = Pose((0.3, 0.1, 0.6), FACING)
HOVER = Pose((0.0, 0.0, 0.12), FACING)  # tool z down onto the marker
LEAN = rotation_exp([np.deg2rad(35), 0, 0])


class Poison:
    """Truth that must not be looked at."""

    def __getattribute__(self, name: str) -> object:
        raise AssertionError("truth was read")


@dataclass
class ListSource(FrameSource):
    """Frames from a list; counts how often it was asked."""

    frames: list[Frame]
    live: bool = True
    reads: int = 0

    def read(self) -> Frame:
        if self.reads >= len(self.frames):
            raise FrameTimeoutError("end")
        self.reads += 1
        return self.frames[self.reads - 1]


@dataclass
class PatientSource(ListSource):
    """A camera with a thread: has a new frame only when told."""

    ready: list[Frame] = field(default_factory=list)

    def newest(self) -> Frame | None:
        return self.ready.pop(0) if self.ready else None


def frame(
    poses: dict[int, Pose], number: int = 0, *, time: float | None = None, size: float = 0.05, seed: int = 0
) -> Frame:
    """Markers on one wall: rendered one by one and joined by the darker pixel where both show paper."""
    image = None
    for marker_id, pose in poses.items():
        rng = np.random.default_rng(seed)
        one = render_markers(CAMERA, {marker_id: (size, pose)}, rng, dictionary="DICT_5X5_50")
        box = CAMERA.project(pose.apply(marker_points(size * 1.5)))
        x0, y0 = np.floor(box.min(axis=0)).astype(int)
        x1, y1 = np.ceil(box.max(axis=0)).astype(int)
        if image is None:
            image = one
        else:
            image[y0:y1, x0:x1] = one[y0:y1, x0:x1]
    if image is None:
        image = np.full((480, 640), 128, np.uint8)
    stamp = 0.03 * number if time is None else time
    return Frame(np.repeat(image[:, :, None], 3, axis=2), stamp, number, truth=Poison())


def marker_at(x: float, y: float, z: float, turn: np.ndarray = LEAN) -> Pose:
    return Pose((x, y, z), quat_multiply(FACING, turn))


def source_for(*frames: Frame, marker_id: int = 7, **options: object) -> MarkerGoalSource:
    tracker = MarkerTracker(CAMERA, "DICT_5X5_50", 0.05, ids=None)
    return MarkerGoalSource(ListSource(list(frames)), tracker, CAMERA_IN_WORLD, marker_id, HOVER, **options)  # type: ignore[arg-type]


# --------------------------------------------------------------------------------------- tracker


def test_the_tracker_sees_all_wanted_markers_and_their_time() -> None:
    poses = {7: marker_at(-0.08, 0.0, 0.4), 3: marker_at(0.08, 0.02, 0.45)}
    seen = MarkerTracker(CAMERA, "DICT_5X5_50", 0.05).observe(frame(poses, time=12.5))
    assert [o.id for o in seen] == [3, 7]
    for o in seen:
        assert o.refined
        assert o.time == 12.5
        position, angle = o.pose.distance(poses[o.id])
        assert position < 0.5e-3
        assert angle < np.deg2rad(0.5)


def test_sizes_by_id() -> None:
    poses = {7: marker_at(-0.08, 0.0, 0.4), 3: marker_at(0.08, 0.02, 0.45)}
    (seen,) = MarkerTracker(CAMERA, "DICT_5X5_50", {7: 0.1}).observe(frame(poses))
    assert seen.id == 7
    # Twice the size at twice the distance looks the same.
    assert seen.pose.position == pytest.approx(2 * poses[7].position, abs=2e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("DICT_5X5_5",), "unknown marker dictionary"),
        (("DICT_5X5_50", 50.0), "marker size of 50.0 m"),
        (("DICT_5X5_50", {3: 0.05}, [3, 4]), "no size is given for marker ids 4"),
        (("DICT_5X5_50", 0.05, [77]), "ids 77 are not in"),
    ],
)
def test_a_tracker_that_cannot_work_is_not_made(arguments: tuple, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        MarkerTracker(CAMERA, *arguments)


def test_a_frame_of_another_size_is_refused() -> None:
    tracker = MarkerTracker(CAMERA)
    with pytest.raises(CalibrationError, match="640x480 px, the picture has 320x240"):
        tracker.observe(Frame(np.zeros((240, 320, 3), np.uint8), 0.0, 0))


def test_the_window_finds_what_the_whole_frame_finds() -> None:
    whole = MarkerTracker(CAMERA, "DICT_5X5_50", 0.05)
    window = MarkerTracker(CAMERA, "DICT_5X5_50", 0.05, window=True)
    sizes, off = [], []
    inner = window.detector.detect_part

    def spy(image: np.ndarray, *rest: Any, **more: Any) -> list:
        sizes.append(image.shape)
        return inner(image, *rest, **more)

    window.detector.detect_part = spy  # type: ignore[method-assign]
    for k in range(20):
        # Wanders slowly, jumps once (5), hides once (8); a second marker comes in (10) and is seen
        # at the latest in the tenth frame after a full search.
        x = 0.005 * k - 0.05 + (0.1 if k == 5 else 0.0)
        poses = {} if k == 8 else {7: marker_at(x, 0.01, 0.4)}
        if k >= 10:
            poses[3] = marker_at(-0.1, -0.08, 0.45)
        picture = frame(poses, k, seed=k)
        first, second = whole.observe(picture), window.observe(picture)
        if k < 10 or k == 19:
            assert [o.id for o in first] == [o.id for o in second], k
        for a in second:
            b = next(o for o in first if o.id == a.id)
            # Fewer pixels, from another start: a difference, within what is stated.
            off.append(float(np.abs(a.corners - b.corners).max()) / a.sigma)
    assert max(off) < 3.0 and np.median(off) < 1.5
    assert min(s[0] * s[1] for s in sizes) < 0.3 * 640 * 480


# ----------------------------------------------------------------------------------------- goals


def test_a_marker_becomes_a_pose_goal_in_the_world() -> None:
    marker = marker_at(0.03, -0.02, 0.45)
    goals = source_for(frame({7: marker}), frame="gripper")
    goal = goals.poll(0.0)
    assert isinstance(goal, PoseGoal)
    assert goal.frame == "gripper"
    wanted = CAMERA_IN_WORLD.compose(marker).compose(HOVER)
    position, angle = Pose(goal.position, goal.wxyz).distance(wanted)
    assert position < 1e-3
    assert angle < np.deg2rad(0.5)
    assert goals.last is not None
    assert goals.last.id == 7


def test_truth_is_never_read_nor_kept() -> None:
    goals = source_for(frame({7: marker_at(0.0, 0.0, 0.4)}))
    assert goals.poll(0.0) is not None
    assert goals.last_frame is not None
    assert goals.last_frame.truth is None


def test_an_unlisted_marker_never_becomes_a_goal() -> None:
    for other in (0, 3, 8, 49):
        goals = source_for(frame({other: marker_at(0.0, 0.0, 0.35)}))
        assert goals.poll(0.0) is None
        assert goals.last is None


def test_a_lost_marker_means_hold_and_a_found_one_means_go() -> None:
    here = marker_at(0.0, 0.0, 0.4)
    goals = source_for(frame({7: here}, 0), frame({}, 1), frame({7: here}, 2))
    assert goals.poll(0.00) is not None
    assert goals.poll(0.03) is None
    assert goals.last is None
    assert goals.poll(0.06) is not None


def test_the_goal_moves_with_the_marker() -> None:
    goals = source_for(frame({7: marker_at(0.0, 0.0, 0.4)}, 0), frame({7: marker_at(0.05, 0.0, 0.4)}, 1))
    first, second = goals.poll(0.0), goals.poll(0.03)
    assert isinstance(first, PoseGoal)
    assert isinstance(second, PoseGoal)
    assert np.subtract(second.position, first.position) == pytest.approx([0.05, 0.0, 0.0], abs=1e-3)


def test_two_copies_of_the_marker_mean_hold(caplog: pytest.LogCaptureFixture) -> None:
    left = frame({7: marker_at(-0.08, 0.0, 0.4)}).image
    right = frame({7: marker_at(0.08, 0.0, 0.4)}).image
    both = np.hstack([left[:, :320], right[:, 320:]])
    goals = source_for(Frame(both, 0.0, 0))
    assert goals.poll(0.0) is None
    assert "2 times" in caplog.text


def test_a_photograph_gives_one_goal_for_ever() -> None:
    goals = source_for(*[frame({7: marker_at(0.0, 0.0, 0.4)})] * 3)
    goals.source.live = False  # type: ignore[misc]
    first = goals.poll(0.0)
    assert first is not None
    assert goals.poll(100.0) is first


def test_between_pictures_the_goal_stays_until_it_is_old() -> None:
    tracker = MarkerTracker(CAMERA, "DICT_5X5_50", 0.05)
    camera = PatientSource([])
    goals = MarkerGoalSource(camera, tracker, CAMERA_IN_WORLD, 7, HOVER)
    assert goals.poll(0.0) is None
    camera.ready = [frame({7: marker_at(0.0, 0.0, 0.4)})]
    first = goals.poll(1.0)
    assert first is not None
    assert goals.poll(1.4) is first
    assert goals.poll(1.6) is None
    assert goals.last is None


def test_the_end_of_a_film_is_reported() -> None:
    goals = source_for()
    with pytest.raises(FrameTimeoutError):
        goals.poll(0.0)


@dataclass
class StubTracker:
    """Gives one prepared observation: ambiguous views are rare in good pictures."""

    observation: object

    def observe(self, _: Frame, __: list[int]) -> list:
        return [self.observation]


def ambiguous_source(pose_marker_tool: Pose, **options: object) -> tuple[MarkerGoalSource, Pose]:
    """A small marker far away: both branches fit."""
    truth = marker_at(0.0, 0.0, 4.0, rotation_exp([np.deg2rad(25), 0, 0]))
    rng = np.random.default_rng(1)
    corners = CAMERA.project(truth.apply(marker_points(0.05))) + rng.normal(0, 0.1, (4, 2))
    refined = unrefined(corners, CAMERA, 0.1)
    branches = marker_branches(refined, 0.05, CAMERA)
    assert branches is not None
    seen = marker_observation(7, refined, branches, branches.alone, float("nan"))
    assert seen.ambiguity > AMBIGUITY_LIMIT
    blank = ListSource([frame({})])
    world_camera = Pose((0, 0, 4.0), FACING)
    return (
        MarkerGoalSource(blank, StubTracker(seen), world_camera, 7, pose_marker_tool, **options),  # type: ignore[arg-type]
        world_camera.compose(truth),
    )


def test_an_uncertain_orientation_is_not_passed_on() -> None:
    # The tool stands off the marker: where it should be depends on the uncertain orientation.
    goals, _ = ambiguous_source(HOVER)
    assert goals.poll(0.0) is None
    assert goals.last is not None, "the marker is seen all the same"


def test_where_both_orientations_agree_the_position_is_a_goal() -> None:
    goals, truth = ambiguous_source(Pose((0, 0, 0), FACING))
    goal = goals.poll(0.0)
    assert isinstance(goal, PositionGoal)
    assert goal.position == pytest.approx(truth.position, abs=0.1)
