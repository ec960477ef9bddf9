"""Reach on virtual time: the goal is reached, the error is measured, and faults are noticed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.commands.reach import Reach
from robot_ik.commands.reach_picture import VIDEO_RATE_HZ
from robot_ik.commands.reach_report import ReachReport
from robot_ik.commands.terminal import Terminal
from robot_ik.errors import (
    MarkerNotFoundError,
    MotorFaultError,
    NotConvergedError,
    OptionError,
    UnknownFrameError,
    UnknownJointError,
    UnknownSolverError,
    UnsupportedJointError,
)
from robot_ik.geometry import Pose
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.workcell.verdict import LARGEST_ERROR, SIGMAS

pytestmark = pytest.mark.usefixtures("light_pictures")

JOINTS = [f"joint{k}" for k in range(1, 7)]


def shafts(report: ReachReport) -> Pose:
    """Return the true pose of the tool."""
    return report.robot.forward(report.setup.true_q(), report.frame)


def test_a_healthy_arm_reaches_its_marker(healthy: ReachReport) -> None:
    report = healthy
    assert report.ok and report.error is None
    assert (
        report.seen is not None and report.seen.true_pose is not None and report.vision is not None
    )
    assert (
        report.goal.target is not None
        and report.execution is not None
        and report.judged.bound is not None
    )
    assert report.seen.pose_world_marker.distance(report.seen.true_pose)[0] < 1e-3
    wanted = report.seen.pose_world_marker.compose(report.vision.scene.pose_marker_tool)
    assert report.goal.target.distance(wanted)[0] < 1e-9
    # The true shafts hold the tool at the goal, and the camera measures that pose.
    assert shafts(report).distance(report.goal.target)[0] <= report.judged.bound.position
    assert report.judged.by_camera is not None and report.judged.read_back is not None
    assert (
        report.judged.by_camera.pose.distance(shafts(report))[0]
        < SIGMAS * report.judged.by_camera.sigma.position + 2e-4
    )
    # The ticks, not the camera, limit the verdict.
    assert report.judged.by_camera.sigma.position < 5e-4


def test_exit_is_literally_what_the_two_judgements_say(healthy: ReachReport) -> None:
    read_back = healthy.judged.read_back
    camera = healthy.judged.by_camera
    bound = healthy.judged.bound
    assert read_back is not None and camera is not None and bound is not None
    assert read_back.allowed == bound and read_back.position <= bound.position
    explained = SIGMAS * camera.sigma.position + bound.position
    assert camera.allowed.position == min(LARGEST_ERROR, explained) and camera.position <= explained


def test_the_motion_is_timed_and_capped(healthy: ReachReport) -> None:
    run = healthy.execution
    setup = healthy.setup
    assert run is not None and run.measured is not None
    assert run.rate == pytest.approx(100.0, rel=0.01) and run.overruns == 0
    speed = np.abs(np.diff(run.commanded, axis=0)) * run.rate
    assert (speed <= setup.caps(1.0)["velocity_limits"] * 1.01).all()
    np.testing.assert_allclose(run.measured[-1], run.commanded[-1], atol=setup.resolution.max())
    assert healthy.counters["cycles"] >= len(run.times) and healthy.counters["timeouts"] == 0
    np.testing.assert_allclose(setup.shown, healthy.judged.q, atol=setup.resolution.max())
    assert setup.arm is not None and setup.arm.bus.virtual_bus is not None
    # The exit policy has switched torque off.
    assert not any(servo.torque for servo in setup.arm.bus.virtual_bus.servos)


@pytest.mark.parametrize(("joint", "degrees"), list(zip(JOINTS, [2.0, -2.0] * 3, strict=True)))
def test_a_hidden_zero_offset_is_noticed_by_the_camera_alone(
    joint: str, degrees: float, reach: Any
) -> None:
    report = reach(f"zero-offset:{joint}={degrees}")
    assert not report.ok and report.error is None
    assert report.judged.read_back.passed and not report.judged.by_camera.passed
    # The camera measures the true motion of the shafts.
    metres, radians = shafts(report).distance(report.goal.target)
    assert np.rad2deg(report.judged.by_camera.angle) == pytest.approx(np.rad2deg(radians), abs=0.15)
    assert report.judged.by_camera.position == pytest.approx(metres, abs=1.5e-3)
    assert "zeros" in report.verdict


def test_a_stuck_servo_is_noticed_by_both_where_it_has_a_short_way(reach: Any) -> None:
    report = reach("stuck:joint2")
    assert not report.ok and report.error is None
    assert not report.judged.read_back.passed and not report.judged.by_camera.passed


@pytest.mark.parametrize("joint", ["joint3", "joint6"])
def test_a_stuck_servo_that_falls_far_behind_stops_the_arm(joint: str, reach: Any) -> None:
    report = reach(f"stuck:{joint}")
    assert not report.ok and isinstance(report.error, MotorFaultError)
    assert (report.error.joint, report.error.status) == (joint, ("not_following",))


def test_a_covered_gripper_proves_nothing(reach: Any) -> None:
    report = reach("cover-gripper")
    assert not report.ok and report.judged.read_back.passed and report.judged.by_camera is None
    assert "unproven" in report.verdict


def test_a_blank_marker_moves_nothing(reach: Any) -> None:
    report = reach("blank-marker")
    assert not report.ok and isinstance(report.error, MarkerNotFoundError)
    assert "marker 7" in str(report.error)
    assert report.execution is None and report.solution is None and report.before is not None
    np.testing.assert_allclose(report.setup.true_q(), report.robot.home, atol=1e-2)


@pytest.mark.usefixtures("full_pictures")
def test_goal_arm_and_verdict_move_with_the_rendered_marker(
    healthy: ReachReport, reach: Any
) -> None:
    home = healthy.vision.scene.pose_world_marker  # type: ignore[union-attr]
    shift = np.array([0.03, 0.04, 0.0])
    yaw = -80.0
    report = reach(marker_at=(*(home.position + shift), yaw))
    assert report.ok
    for name, one, other in [
        ("goal", report.goal.target, healthy.goal.target),
        ("shafts", shafts(report), shafts(healthy)),
        ("camera", report.judged.by_camera.pose, healthy.judged.by_camera.pose),  # type: ignore[union-attr]
        ("read back", report.judged.read_back.pose, healthy.judged.read_back.pose),  # type: ignore[union-attr]
    ]:
        np.testing.assert_allclose(one.position - other.position, shift, atol=2e-3, err_msg=name)
        assert np.rad2deg(one.distance(other)[1]) == pytest.approx(10.0, abs=0.5), name


def test_an_unreachable_marker_is_a_result(reach: Any) -> None:
    report = reach(marker_at=(-0.6, -0.3, 0.66, 100.0))
    assert isinstance(report.error, NotConvergedError) and not report.ok
    assert (
        report.solution is not None
        and report.execution is None
        and report.solution.error.position > 1e-3
    )
    assert report.robot.outside(report.solution.q) == []


def test_a_given_place(reach: Any) -> None:
    place = np.array([-0.42, -0.08, 0.80])
    report = reach(goal=PositionGoal(None, place))
    assert report.ok and report.seen is None
    assert report.judged.read_back.angle == 0.0
    assert np.linalg.norm(shafts(report).position - place) <= report.judged.bound.position


def test_a_given_pose_of_another_frame(reach: Any) -> None:
    target = Pose((-0.40, -0.10, 0.90), (0.0, 1.0, 0.0, 0.0))
    goal = PoseGoal("flange", position=target.position, wxyz=target.wxyz)
    report = reach(goal=goal, frame="flange")
    assert report.ok and report.frame == "flange"
    metres, radians = report.robot.forward(report.setup.true_q(), "flange").distance(target)
    assert metres <= report.judged.bound.position and radians <= report.judged.bound.angle


def test_a_straight_line_is_straight(reach: Any) -> None:
    report = reach(line=True)
    assert report.ok
    start, end = (
        report.robot.forward(q, report.frame).position for q in (report.q_start, report.judged.q)
    )
    way = (end - start) / np.linalg.norm(end - start)
    places = [
        report.robot.forward(q, report.frame).position - start for q in report.execution.commanded
    ]
    off = [np.linalg.norm(place - (place @ way) * way) for place in places]
    assert max(off) < 2.5e-3


def test_speed_is_a_share(healthy: ReachReport, reach: Any) -> None:
    slow = reach(speed=0.5, goal=PositionGoal(None, healthy.goal.target.position))  # type: ignore[union-attr]
    fast = reach(speed=1.0, goal=PositionGoal(None, healthy.goal.target.position))  # type: ignore[union-attr]
    assert slow.trajectory.times[-1] > 1.3 * fast.trajectory.times[-1]


def test_following_the_marker(reach: Any) -> None:
    report = reach(follow=2.0)
    assert report.ok and report.followed.ticks.ticks == 200 and report.followed.ticks.held < 40
    assert report.followed.ticks.statuses["CONVERGED"] > 150
    # The marker moved, the arm followed, and the verdict is about the last position.
    home = report.vision.scene.pose_world_marker.position
    away = np.linalg.norm(report.seen.pose_world_marker.position - home)
    assert away > 0.02
    assert np.linalg.norm(shafts(report).position - report.goal.target.position) < 2e-3
    median = report.followed.median
    largest = report.followed.largest
    assert median < 0.01 and largest < 0.2


def test_there_is_nothing_to_follow_at_a_fixed_goal(reach: Any) -> None:
    with pytest.raises(OptionError, match="follow"):
        reach(goal=PositionGoal(None, (-0.4, -0.1, 0.8)), follow=1.0)


@pytest.mark.parametrize("name", ["ur", "planar", "desk"])
def test_arms_without_a_description(name: str, arms: dict[str, Path], reach: Any) -> None:
    report = reach(robot=str(arms[name]))
    assert report.ok, (report.error, report.verdict)
    assert report.judged.by_camera is not None
    assert (report.goal.weights[1] > 0.0) is (name == "ur")
    assert report.judged.by_camera.allowed.position <= LARGEST_ERROR


@pytest.mark.usefixtures("full_pictures")
def test_without_servos_the_scene_gives_the_verdict(arms: dict[str, Path], reach: Any) -> None:
    report = reach(bus="none", robot=str(arms["planar"]))
    assert report.ok and report.execution.measured is None and report.counters == {}
    # The marker is measured outside the plane that the arm can reach, within its standard
    # deviation: 0.4 mm along the ray, for 63 mm at 0.9 m.
    assert report.judged.read_back.position < report.judged.read_back.allowed.position < 2e-3


@pytest.mark.usefixtures("full_pictures")
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
def test_following_without_servos_arrives(seed: int, reach: Any) -> None:
    report = reach(bus="none", follow=1.2, seed=seed)
    assert report.ok, report.verdict
    assert report.judged.read_back.position > 1e-6  # two measurements of the marker differ
    assert (
        report.judged.read_back.position
        <= report.judged.read_back.allowed.position
        <= LARGEST_ERROR
    )


@pytest.mark.parametrize("name", ["two_arms", "two_arms_of_three_joints"])
def test_a_generated_scene_keeps_the_arms_markers_off_the_target(
    name: str, arms: dict[str, Path], reach: Any
) -> None:
    report = reach(bus="none", robot=str(arms[name]))
    assert report.ok, report.error or report.verdict
    assert report.judged.read_back.position < 1e-3 and report.judged.by_camera is not None


@pytest.mark.parametrize("bus", ["none", "sim"])
def test_a_floating_base_stands_still_while_the_hand_reaches(bus: str, reach: Any) -> None:
    report = reach(bus=bus, robot="humanoid")
    assert report.ok, report.error or report.verdict
    assert "root" not in report.robot.joints and len(report.robot.joints) >= 3


def test_nothing_but_ball_joints_is_reported(reach: Any) -> None:
    with pytest.raises(UnsupportedJointError, match="no hinge or slide moves 'nose' of lion"):
        reach(bus="none", robot="lion")


def test_without_servos_a_covered_gripper_leaves_nothing_unproven(
    arms: dict[str, Path], reach: Any
) -> None:
    report = reach("cover-gripper", bus="none", robot=str(arms["planar"]))
    assert report.ok and report.judged.by_camera is None and "joint angles" in report.verdict


@pytest.mark.parametrize("solver", ["dls", "ccd", "auto"])
def test_every_solver_reaches_the_marker(solver: str, reach: Any) -> None:
    report = reach(solver=solver, goal=PositionGoal(None, (-0.42, -0.08, 0.80)))
    assert report.ok, report.error


@pytest.mark.usefixtures("full_pictures")
def test_the_same_seed_gives_the_same_run(healthy: ReachReport, reach: Any) -> None:
    again = reach()
    np.testing.assert_array_equal(again.execution.commanded, healthy.execution.commanded)  # type: ignore[union-attr]
    assert again.judged.by_camera.position == healthy.judged.by_camera.position  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"solver": "lmm"}, UnknownSolverError),
        ({"frame": "griper"}, UnknownFrameError),
        ({"fault": ("stuck:joint9",)}, UnknownJointError),
        ({"marker_at": (0.0, float("nan"), 0.0, 0.0)}, OptionError),
    ],
)
def test_wrong_input(options: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        Reach(bus="sim", **options).run()


class Progress(Terminal):
    """A terminal that keeps the progress."""

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.reported: list[tuple[str, float]] = []

    def progress(self, phase: str, share: float = 0.0) -> None:
        self.reported.append((phase, share))


def test_progress_only_grows_within_a_phase() -> None:
    terminal = Progress()
    Reach(bus="sim", goal=(-0.42, -0.08, 0.80)).run(terminal)
    phases = [*dict.fromkeys(phase for phase, _ in terminal.reported)]
    assert phases == ["solving", "moving", "looking again", "writing files"]
    moving = [share for phase, share in terminal.reported if phase == "moving"]
    assert moving == sorted(moving) and moving[0] == 0.0 and moving[-1] == 1.0


def test_the_video_shows_the_whole_motion(
    arms: dict[str, Path], reach: Any, tmp_path: Path
) -> None:
    av = pytest.importorskip("av", reason="needs the extra `video`")
    path = tmp_path / "reach.mp4"
    report = reach(bus="none", robot=str(arms["planar"]), video=path)
    frames = [
        frame.to_ndarray(format="gray").astype(float)
        for frame in av.open(str(path)).decode(video=0)
    ]
    assert len(frames) == pytest.approx(report.execution.times[-1] * VIDEO_RATE_HZ, abs=2)
    assert np.abs(frames[-1] - frames[0]).max() > 50.0  # the arm moved
