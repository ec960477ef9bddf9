"""The comparison bench and the posing of thesis A00 in the session: no window, no thread."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik.testbed.commands import (
    AddObstacle,
    Command,
    MoveGoal,
    RemovePin,
    Reset,
    SetBase,
    SetBudget,
    SetCount,
    SetCourse,
    SetExtraGoal,
    SetFigure,
    SetGoalKind,
    SetLimits,
    SetMethod,
    SetMotion,
    SetOption,
    SetPin,
    SetRobot,
    SetSpeed,
    SetStiffness,
    SetTool,
    Start,
)
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View
from tests.testbed.session_runs import require_equal_replay, run_script, view_after


def opened(robot: str = "puma560", **start: object) -> Session:
    return Session(Start(robot, **start), beside=False)  # type: ignore[arg-type]


def extras_of(view: View) -> dict[str, bool]:
    return {extra.name: extra.on for extra in view.extras}


def test_limits_of_each_instance_are_its_own() -> None:
    session = opened("seven_segment", count=2)
    view = view_after(session)
    assert [one.limited for one in view.instances] == [False, False], "off, as in the thesis"
    view = view_after(session, SetLimits(True, 1), SetMotion("random"), ticks=200)
    assert [one.limited for one in view.instances] == [False, True] and not view.limits
    bends = [k for k, name in enumerate(session.robot.joints) if not name.endswith("twist")]
    free, limited = (one.q[bends] for one in view.instances)
    assert np.abs(limited).max() <= np.radians(45.0) + 1e-9
    assert np.abs(free).max() > np.radians(45.0)
    view = view_after(session, SetLimits(True), ticks=1)
    assert view.limits and np.abs(view.instances[0].q[bends]).max() <= np.radians(45.0) + 1e-9


def test_a_method_is_given_with_its_options_in_one_command() -> None:
    session = opened()
    options = (("damping", 10.0), ("max_step", 0.2))
    view = view_after(session, SetMethod(0, "dls", options))
    shown = dict(view.instances[0].options)
    assert shown["damping"] == 10.0 and shown["max_step"] == 0.2
    view = view_after(session, SetOption(0, "damping", 0.5), SetMethod(0, "dls"))
    assert dict(view.instances[0].options)["damping"] == 0.05, "the defaults come back"


def test_frames_without_a_request_are_not_counted() -> None:
    session = opened()
    view_after(session, SetMotion("hand"), ticks=240)
    before = view_after(session, ticks=60).instances[0].statistics
    after = view_after(session, ticks=180).instances[0].statistics
    assert after.count == before.count < 60, "a ball at rest that is met asks for nothing"
    view = view_after(session, MoveGoal((0.4, 0.3, 0.6)), ticks=120)
    assert view.instances[0].statistics.count > before.count
    view = view_after(session, SetMotion("curve"), ticks=120)
    assert view.instances[0].statistics.count >= before.count + 60


def test_the_largest_joint_change_shows_which_method_jumps() -> None:
    session = opened("seven_segment", count=2, methods=("ccd", "dls"))
    view = view_after(session, SetMotion("random"), ticks=130)
    for one in view.instances:
        assert 0.0 < one.statistics.joint_change < 2.0 * np.pi + 1e-6


@pytest.mark.parametrize("tool", ["front_right_paw", "nose", "tail_tip"])
def test_any_frame_of_the_lion_follows_the_ball(tool: str) -> None:
    session = opened("lion")
    view = view_after(session, SetTool(tool), SetMotion("hand"), ticks=5)
    assert view.tool == session.robot.tool == tool
    extras = extras_of(view)
    assert extras["keep front_left_paw"]
    assert extras["keep front_right_paw"] is (tool != "front_right_paw")
    if tool == "nose":
        assert not extras["gaze"], "eyes cannot look at the ball that the nose touches"
    start = session.instances[0].tool_pose().position
    view = view_after(session, MoveGoal(tuple(start + np.array((0.02, 0.0, 0.03)))), ticks=90)
    one = view.instances[0]
    assert one.met
    robot = session.robot
    assert np.linalg.norm(robot.measure(one.q, tool).position - view.ball.position) < 1e-3
    home = robot.measure(robot.home, "front_left_paw")
    metres, _ = robot.measure(one.q, "front_left_paw").distance(home)
    assert metres < 1e-3


def test_only_joints_between_base_and_tool_move() -> None:
    session = opened("humanoid")
    view = view_after(session, SetBase("torso"), ticks=5)
    assert view.base == "torso" and len(session.robot.joints) == len(view.instances[0].q) < 12
    view = view_after(session, SetMotion("curve"), ticks=120)
    fixed = session.robot.model.body("left_hand").id
    assert np.allclose(
        view.instances[0].xpos[fixed], session.robot.data_at(session.robot.home).xpos[fixed]
    )
    view = view_after(session, SetBase("head"), ticks=2)
    assert "right_hand" in view.message and view.base == "torso"
    view = view_after(session, SetBase(""), ticks=2)
    assert view.base == "" and len(session.robot.joints) > 30
    view = view_after(session, SetBase("torso"), SetFigure("active"), ticks=2)
    assert view.base == "" and view.figure is not None, "a figure that decides has all joints"
    view = view_after(session, SetBase("torso"), ticks=2)
    assert view.figure is None and view.base == "torso"


def test_a_session_begins_with_base_tool_and_joints() -> None:
    session = opened("humanoid", tool="left_hand", base="torso")
    assert session.robot.tool == "left_hand" and "left_elbow_pitch" in session.robot.joints
    assert "right_elbow_pitch" not in session.robot.joints
    session = opened("puma560", joints=("joint1", "joint2", "joint3"))
    view = view_after(session, ticks=5)
    assert len(view.instances[0].q) == 3 and view.kind == "position"


def test_pins_have_weights_and_priorities() -> None:
    session = opened("humanoid", methods=("lm",))
    robot = session.robot
    at = robot.measure(robot.home, "left_hand").position + np.array((0.15, 0.05, 0.3))
    position = tuple(at.tolist())
    view = view_after(session, SetMotion("hand"), SetPin("left_hand", position), ticks=60)
    q = view.instances[0].q
    assert np.linalg.norm(robot.measure(q, "left_hand").position - at) < 1e-3
    view = view_after(session, SetPin("left_hand", position, weight=0.0), ticks=60)
    q = view.instances[0].q
    assert np.linalg.norm(robot.measure(q, "left_hand").position - at) > 0.05, "0 ignores it"
    (pin,) = view.pins
    assert (pin.frame, pin.weight, pin.priority) == ("left_hand", 0.0, 0)
    view = view_after(session, SetPin("left_hand", position, (1.0, 0.0, 0.0, 0.0), priority=3))
    assert view.pins[0].wxyz is not None and view.pins[0].priority == 3
    view = view_after(session, RemovePin("left_hand"), RemovePin("left_hand"), ticks=2)
    assert view.pins == () and "not pinned" in view.message
    view = view_after(session, SetPin("left_wing", position), ticks=2)
    assert "left_wing" in view.message and view.pins == ()


def test_goals_that_contradict_each_other_share_by_weight() -> None:
    session = opened("srs_arm", methods=("dls",))
    tool = session.robot.tool
    ball = session.robot.measure(session.robot.home).position
    pin = ball + np.array((0.0, 0.1, 0.0))
    distances = []
    for weight in (1.0, 10.0):
        goal = SetExtraGoal("ball", True, 0, 1.0)
        commands = (Reset(), SetGoalKind("position"), goal, MoveGoal(tuple(ball)))
        view = view_after(session, *commands, SetPin(tool, tuple(pin), weight=weight), ticks=120)
        place = session.robot.measure(view.instances[0].q).position
        distances.append(np.linalg.norm(place - pin))
    assert distances[0] == pytest.approx(0.05, abs=0.01) and distances[1] < 0.02


def test_a_stiff_joint_moves_less() -> None:
    turned = []
    for value in (1.0, 100.0):
        session = opened(methods=("dls",))
        view = view_after(session, SetMotion("hand"), SetGoalKind("position"), ticks=30)
        before = view.instances[0].q[0]
        ball = view.ball.position + np.array((0.1, 0.1, 0.0))
        view = view_after(session, SetStiffness("joint1", value), MoveGoal(tuple(ball)), ticks=60)
        turned.append(abs(view.instances[0].q[0] - before))
        assert view.stiffness == (("joint1", value),)
    assert turned[1] < 0.5 * turned[0]


@pytest.mark.parametrize("kind", ["orientation", "half_space"])
def test_orientation_and_half_space_goals(kind: str) -> None:
    session = opened(methods=("dls",))
    view = view_after(session, SetMotion("hand"), ticks=30)
    turned = (np.cos(0.3), np.sin(0.3), 0.0, 0.0)
    place = tuple(view.ball.position.tolist())
    view = view_after(session, SetGoalKind(kind), MoveGoal(place, turned), ticks=90)  # type: ignore[arg-type]
    one = view.instances[0]
    pose = session.robot.measure(one.q)
    assert one.met
    if kind == "orientation":
        assert pose.distance(view.ball)[1] < 2e-3 and one.error == 0.0
        return
    normal = view.ball.rotation[:, 2]
    assert (pose.position - view.ball.position) @ normal > -1e-4
    farther = view.ball.position + 0.1 * normal
    view = view_after(session, MoveGoal(tuple(farther)), ticks=90)
    pose = session.robot.measure(view.instances[0].q)
    assert (pose.position - view.ball.position) @ normal > -1e-4


def test_a_chain_is_a_robot_of_the_page() -> None:
    session = opened()
    view = view_after(session, SetRobot("chain:4"), ticks=300)
    assert view.robot == "chain:4" and view.kind == "position"
    assert all(one.met for one in view.instances)


def test_a_course_makes_one_step_in_each_frame() -> None:
    session = opened("puma560", methods=("lm",))
    view = view_after(session, SetCourse(4), ticks=1)
    assert view.robot == "chain:5" and view.motion == "course" and view.course is not None
    assert view.course.frames == 361 and view.course.moves == "circle in XZ"
    view = view_after(session, SetSpeed(3.0), ticks=30)
    assert view.course is not None and view.course.frame == 31, "no frame is skipped"
    assert view.course.place == "30°"
    radius = np.linalg.norm(view.ball.position)
    assert radius == pytest.approx(2.5) and abs(view.ball.position[1]) < 1e-12
    view = view_after(session, ticks=400)
    assert view.course is not None and view.course.frame == 361
    assert view.course.lost == ("",) and view.course.met[0] == 1.0
    view = view_after(session, Reset(), ticks=11)
    assert view.course is not None and view.course.frame == 11
    view = view_after(session, SetCourse(3), SetBudget(0, 1, 1e-4), ticks=20)
    assert view.kind == "pose" and view.course is not None and view.course.lost[0] == "0°"
    view = view_after(session, SetRobot("puma560"), ticks=2)
    assert view.course is None and view.motion == "curve"


def test_the_bench_replays_to_the_same_bits() -> None:
    session = opened("seven_segment", count=2)
    script: list[tuple[int, Command]] = [
        (1, SetLimits(True, 0)),
        (3, SetMethod(1, "ccd", (("axis", "free"),))),
        (5, SetMotion("random")),
        (40, SetTool("palm")),
        (50, SetStiffness("joint1_x", 5.0)),
        (60, SetPin("segment3", (0.2, 0.1, 2.9), weight=0.5)),
        (70, AddObstacle("box")),
        (80, SetBase("segment2")),
        (100, SetCount(1)),
        (110, SetCourse(6)),
        (120, SetExtraGoal("posture", True, 1, 0.1)),
    ]
    log = run_script(session, script, ticks=160)
    assert len(log.commands) == len(script)
    require_equal_replay(log)


def test_the_success_distance_ends_a_solve() -> None:
    session = opened("seven_segment", methods=("dls",))
    view_after(session, SetGoalKind("position"), SetMotion("hand"), ticks=5)
    ball = session.instances[0].tool_pose().position + np.array((0.2, 0.2, -0.2))
    view = view_after(session, SetBudget(0, 100, 0.05), MoveGoal(tuple(ball)), ticks=30)
    one = view.instances[0]
    assert one.met and 1e-3 < one.error <= 0.05, "it goes on after it is near enough"
    view = view_after(session, SetBudget(0, 100, 1e-4), ticks=30)
    assert view.instances[0].error <= 1e-4
