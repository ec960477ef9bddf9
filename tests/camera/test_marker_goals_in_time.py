"""Goals in time: prediction, weights, wild poses, and a marker that stays lost."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_ik.camera.corners import unrefined
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lost_policy import WhenLost
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.pose import PoseFit
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import MarkerFits, MarkerTarget
from robot_ik.errors import CameraError, MarkerNotFoundError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal, PostureGoal

FACING = np.array([0.0, 1.0, 0.0, 0.0])
CAMERA_IN_WORLD = Pose((0.3, 0.1, 0.6), FACING)
HOVER = Pose((0.0, 0.0, 0.12), FACING)
SPEED = 0.3
BLANK = np.zeros((480, 640, 3), np.uint8)


class ListSource(FrameSource):
    """Frames from a list."""

    live = True

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = iter(frames)

    def read(self) -> Frame:
        return next(self._frames)


def marker_at(x: float, y: float, z: float) -> Pose:
    return Pose((x, y, z), quat_multiply(FACING, rotation_exp([np.deg2rad(35), 0, 0])))


class PreparedTarget(MarkerTarget):
    """A marker whose poses are given, frame by frame. The fit is replaced; the rest is real."""

    def __init__(self, poses: list[Pose | None], sigma: tuple[float, float]) -> None:
        super().__init__({7: (0.05, Pose())}, name="marker 7")
        object.__setattr__(self, "poses", poses)
        object.__setattr__(self, "known", np.diag(np.repeat(np.square(sigma), 3)))

    def fit(
        self, _corners: object, _intrinsics: CameraIntrinsics, time: float = math.nan
    ) -> MarkerFits | None:
        pose = self.poses[round(time * 30)]  # type: ignore[attr-defined]
        if pose is None:
            return None
        fit = PoseFit(pose, self.known, 2.0, 2.0, np.array([0.1]), np.array([2.0]))  # type: ignore[attr-defined]
        corners = {7: unrefined([[0, 0], [9, 0], [9, 9], [0, 9]], STANDARD_CAMERA, 0.1)}
        return MarkerFits(self, [7], [0], self.points([7]), corners, [fit], time)


def reported(poses: list[Pose | None], **options: object) -> MarkerGoalSource:
    target = PreparedTarget(poses, options.pop("sigma", (2e-4, 2e-3)))  # type: ignore[arg-type]
    source = ListSource([Frame(BLANK, k / 30, k) for k in range(len(poses))])
    return MarkerGoalSource(source, STANDARD_CAMERA, target, CAMERA_IN_WORLD, HOVER, **options)  # type: ignore[arg-type]


def sideways(count: int, speed: float = SPEED) -> list[Pose | None]:
    return [marker_at(speed * k / 30, 0.0, 0.4) for k in range(count)]


def wanted_x(time: float) -> float:
    return float(
        CAMERA_IN_WORLD.compose(marker_at(SPEED * time, 0.0, 0.4)).compose(HOVER).position[0]
    )


def test_a_goal_is_predicted_for_the_requested_time() -> None:
    """Pictures are 60 ms old when they are processed; the goal is where the marker is by then."""
    goals = reported(sideways(30))
    for k in range(30):
        goal = goals.poll(k / 30 + 0.06)
    assert isinstance(goal, PoseGoal)
    assert goal.target.position[0] == pytest.approx(wanted_x(29 / 30 + 0.06), abs=1e-4)
    later = goals.goal_at(29 / 30 + 0.10)  # no new picture: the prediction continues
    assert later is not None and later.target.position[0] == pytest.approx(
        wanted_x(29 / 30 + 0.10), abs=1e-4
    )
    measured = goals.measured
    assert measured is not None
    assert measured.target.position[0] == pytest.approx(wanted_x(29 / 30), abs=1e-4)
    ages = goals.picture_ages.summary()
    assert ages.count == 31 and ages.p50 == pytest.approx(0.06)


def test_lead_predicts_further_and_what_is_recorded_is_not_predicted() -> None:
    ahead = reported(sideways(20), lead=0.05)
    recorded = reported(sideways(20), predict=False)
    for k in range(20):
        one = ahead.poll(k / 30)
        other = recorded.poll(k / 30 + 0.1)
    assert one is not None and other is not None
    assert one.target.position[0] == pytest.approx(wanted_x(19 / 30 + 0.05), abs=1e-4)
    assert other.target.position[0] == pytest.approx(wanted_x(19 / 30), abs=1e-4)


def test_stamps_of_another_clock_are_not_compared_with_now() -> None:
    goals = reported(sideways(20))
    for k in range(20):
        goal = goals.poll(5000.0 + k / 30)
    assert goal is not None and goal.target.position[0] == pytest.approx(
        wanted_x(19 / 30), abs=1e-4
    )
    assert goals.picture_ages.summary().count == 0


def test_a_resting_marker_gives_one_goal() -> None:
    rng = np.random.default_rng(5)
    poses: list[Pose | None] = []
    for _ in range(60):
        step = rng.normal(0, [3e-4] * 3 + [2e-3] * 3)
        poses.append(marker_at(0.0, 0.0, 0.4).plus(step))
    goals = reported(poses, sigma=(3e-4, 2e-3))
    for k in range(60):
        goal = goals.poll(k / 30 + 0.03)
        # At rest nothing is predicted.
        assert goal is not None and goal is goals.goal_at(k / 30 + 0.06)


def test_goals_carry_the_weights_of_their_covariance_at_the_tool() -> None:
    # 0.05 rad at the tool, 0.12 m away, are 6 mm, and 1 mm is trusted.
    cases = (((1e-4, 1e-3), 1.0, 1.0), ((1e-6, 0.05), 1 / 6, 0.1745), ((0.5, 1e-4), 0.05, 1.0))
    for sigma, metres, radians in cases:
        goals = reported(sideways(1), sigma=sigma)
        goal = goals.poll(0.0)
        assert isinstance(goal, PoseGoal)
        assert goal.angle_weight == pytest.approx(radians, abs=1e-3)
        assert goal.position_weight == pytest.approx(metres, abs=1e-3)


def test_a_single_outlier_pose_is_no_goal() -> None:
    poses = sideways(20, speed=0.0)
    poses[12] = marker_at(0.0, 0.0, 0.4).plus(np.array([0.0, 0.0, 0.1, 0.0, 1.5, 0.0]))
    goals = reported(poses)
    seen = [goals.poll(k / 30) for k in range(20)]
    places = np.array([goal.target.position for goal in seen if goal is not None])
    assert len(places) == 20 and np.ptp(places, axis=0).max() < 1e-6


def test_policies_for_a_marker_that_stays_lost() -> None:
    park = PostureGoal(q=np.zeros(6))
    poses = [*sideways(5), *[None] * 100]
    for policy in (WhenLost(), WhenLost("park", 1.0, park), WhenLost("stop", 1.0)):
        goals = reported(list(poses), when_lost=policy)
        for k in range(5):
            assert isinstance(goals.poll(k / 30), PoseGoal)
        for k in range(5, 34):
            assert goals.poll(k / 30) is None  # hold at first
        if policy.then == "stop":
            with pytest.raises(MarkerNotFoundError, match="marker 7 has given no goal for 1 s"):
                goals.poll(35 / 30)
        else:
            assert goals.poll(35 / 30) is (park if policy.then == "park" else None)
    # It comes back: it is followed again.
    goals = reported([None] * 40 + sideways(1), when_lost=WhenLost("park", 0.5, park))
    assert [goals.poll(k / 30) for k in range(41)][20:40] == [park] * 20
    assert isinstance(goals.measured, PoseGoal)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run",), "'run'"),
        (("stop", -1.0), "-1.0 s"),
        (("park",), "needs a goal"),
        (("hold", 1.0, PositionGoal(position=(0, 0, 0))), "takes no goal"),
    ],
)
def test_an_invalid_policy_is_rejected(arguments: tuple, said: str) -> None:
    with pytest.raises(CameraError, match=said):
        WhenLost(*arguments)


def test_the_pose_of_a_camera_on_the_arm_is_that_at_the_time_of_the_picture() -> None:
    times = []

    def camera(time: float) -> Pose:
        times.append(time)
        return Pose((0.3 + time, 0.1, 0.6), FACING)

    goals = reported(sideways(3, speed=-1.0))
    goals.pose_world_camera = camera
    places = [goals.poll(k / 30) for k in range(3)]
    assert times == [0.0, 1 / 30, 2 / 30]
    # The camera moves, and the marker moves the opposite way in its picture: it is at rest.
    assert all(goal is not None for goal in places)
    np.testing.assert_allclose(places[2].target.position, places[0].target.position, atol=1e-5)  # type: ignore[union-attr]
