"""Goals from the pictures of a camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA as CAMERA
from robot_ik.camera.synthetic.pictures import render_markers
from robot_ik.camera.targets import marker, marker_points
from robot_ik.errors import FrameTimeoutError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import PoseGoal

FACING = np.array([0.0, 1.0, 0.0, 0.0])
# Camera 0.6 m above the table, looking down. The picture's up is the world's y.
CAMERA_IN_WORLD = Pose((0.3, 0.1, 0.6), FACING)
#: The tool is above the marker, its z axis towards it.
HOVER = Pose((0.0, 0.0, 0.12), FACING)
LEAN = rotation_exp([np.deg2rad(35), 0, 0])


class Poison:
    """A truth that raises an error on every access."""

    def __getattribute__(self, name: str) -> object:
        raise AssertionError("truth was read")


@dataclass
class ListSource(FrameSource):
    """Returns frames from a list and counts the calls."""

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
    """A camera that has a new frame only when the test provides one."""

    ready: list[Frame] = field(default_factory=list)

    def newest(self) -> Frame | None:
        return self.ready.pop(0) if self.ready else None


def frame(
    poses: dict[int, Pose],
    number: int = 0,
    *,
    time: float | None = None,
    size: float = 0.05,
    seed: int = 0,
) -> Frame:
    """Return a picture of several markers: the darker pixel of the pictures of each."""
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
    target = marker(marker_id, 0.05)
    source = ListSource(list(frames))
    return MarkerGoalSource(source, CAMERA, target, CAMERA_IN_WORLD, HOVER, **options)  # type: ignore[arg-type]


def test_a_marker_becomes_a_pose_goal_in_the_world() -> None:
    pose = marker_at(0.03, -0.02, 0.45)
    goals = source_for(frame({7: pose}), frame="gripper")
    goal = goals.poll(0.0)
    assert isinstance(goal, PoseGoal)
    assert goal.frame == "gripper"
    wanted = CAMERA_IN_WORLD.compose(pose).compose(HOVER)
    position, angle = Pose(goal.position, goal.wxyz).distance(wanted)
    assert position < 1e-3
    assert angle < np.deg2rad(0.5)
    assert goals.last is not None
    assert goals.last.ids == (7,)


def test_truth_is_never_read_nor_kept() -> None:
    goals = source_for(frame({7: marker_at(0.0, 0.0, 0.4)}))
    assert goals.poll(0.0) is not None
    assert goals.last_frame is not None
    assert goals.last_frame.truth is None


def test_each_picture_alone_gives_the_same_goal_at_rest() -> None:
    pose = marker_at(0.03, -0.02, 0.45)
    goals = source_for(frame({7: pose}), motion=None)
    goal = goals.poll(0.0)
    assert isinstance(goal, PoseGoal)
    assert goal.target.distance(CAMERA_IN_WORLD.compose(pose).compose(HOVER))[0] < 1e-3


def test_an_unlisted_marker_never_becomes_a_goal() -> None:
    for other in (0, 3, 8, 49):
        goals = source_for(frame({other: marker_at(0.0, 0.0, 0.35)}))
        assert goals.poll(0.0) is None
        assert goals.last is None


def test_a_lost_marker_gives_no_goal_until_it_is_found_again() -> None:
    pose = marker_at(0.0, 0.0, 0.4)
    goals = source_for(frame({7: pose}, 0), frame({}, 1), frame({7: pose}, 2))
    assert goals.poll(0.00) is not None
    assert goals.poll(0.03) is None
    assert goals.last is None
    assert goals.poll(0.06) is not None


def test_the_goal_moves_with_the_marker() -> None:
    goals = source_for(
        frame({7: marker_at(0.0, 0.0, 0.4)}, 0), frame({7: marker_at(0.05, 0.0, 0.4)}, 1)
    )
    first = goals.poll(0.0)
    second = goals.poll(0.03)
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


def test_a_photograph_gives_one_constant_goal() -> None:
    goals = source_for(*[frame({7: marker_at(0.0, 0.0, 0.4)})] * 3)
    goals.source.live = False  # type: ignore[misc]
    first = goals.poll(0.0)
    assert first is not None
    assert goals.poll(100.0) is first


def test_between_pictures_the_goal_stays_until_it_is_old() -> None:
    camera = PatientSource([])
    goals = MarkerGoalSource(camera, CAMERA, marker(7, 0.05), CAMERA_IN_WORLD, HOVER)
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
