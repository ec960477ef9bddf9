"""Joint bars, timeline, obstacles and statistics of the session: no window, no thread."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from robot_ik.errors import TrajectoryError
from robot_ik.motion.key_poses import KeyPoses
from robot_ik.robot import load_robot
from robot_ik.testbed.commands import (
    Act,
    AddMesh,
    AddObstacle,
    Command,
    LoadPoses,
    MoveGoal,
    MoveObstacle,
    MovePose,
    Nudge,
    PlayTimeline,
    RecordPose,
    RemoveObstacle,
    RemovePose,
    Reset,
    ResizeObstacle,
    Scrub,
    SetBudget,
    SetCount,
    SetFigure,
    SetJoint,
    SetMethod,
    SetMotion,
    SetPace,
    SetRestarts,
    SetRobot,
    SetRunning,
    Start,
)
from robot_ik.testbed.obstacles import MAX_OBSTACLES
from robot_ik.testbed.robot_goals import first_ball
from robot_ik.testbed.session import Session
from robot_ik.testbed.timeline import MIN_INTERVAL, Timeline
from tests.testbed.session_runs import require_equal_replay, run_script, view_after


def test_a_joint_is_set_and_the_ball_goes_to_the_tool(session: Session) -> None:
    view_after(session, SetMotion("hand"), ticks=30)
    before = session.instances[0].q.copy()
    view = view_after(session, SetJoint("joint3", -0.7), ticks=30)
    wanted = before.copy()
    wanted[2] = -0.7
    assert view.motion == "joints" and np.array_equal(view.instances[0].q, wanted)
    tool = session.robot.measure(view.instances[0].q)
    assert np.allclose(view.ball.position, tool.position, atol=1e-12)
    upper = session.robot.upper[2]
    view = view_after(session, SetJoint("joint3", 100.0))
    assert view.instances[0].q[2] == upper, "beyond the limit"
    assert "joint3" in view_after(session, SetJoint("joint33", 0.0), ticks=1).message
    view = view_after(session, Nudge((0.0, 0.0, -0.02)), ticks=30)
    assert view.motion == "hand" and view.instances[0].met, "the method does not go on"


def test_other_robots_follow_the_ball_of_a_joint_that_is_set(session: Session) -> None:
    view = view_after(session, SetCount(2), SetJoint("joint1", 0.4), ticks=60)
    first, second = view.instances
    assert second.met and not np.array_equal(first.q, second.q)
    assert first.statistics.count == 0 or first.status == "set by hand"


def test_joints_of_a_figure_are_set_when_no_figure_decides(session: Session) -> None:
    view = view_after(session, SetRobot("humanoid"), SetJoint("head_yaw", 0.5), ticks=20)
    number = session.robot.joints.index("head_yaw")
    assert view.instances[0].q[session.robot.tree.qadr[number]] == 0.5, "the solver moved it"
    view = view_after(session, SetJoint("root", 0.5), ticks=1)
    assert "neither a hinge nor a slide" in view.message
    view = view_after(session, SetFigure("active"), SetJoint("head_yaw", 0.1), ticks=2)
    assert "Methods" in view.message


def test_key_poses_are_recorded_scrubbed_and_played(session: Session) -> None:
    view = view_after(session, PlayTimeline(True), ticks=1)
    assert "empty" in view.message and view.motion == "curve"
    for value in (0.0, 0.8, -0.4):
        view_after(session, SetJoint("joint1", value), RecordPose(), ticks=1)
    view = view_after(session, Scrub(1.0), ticks=1)
    assert view.timeline.times == (0.0, 1.0, 2.0) and view.motion == "timeline"
    assert view.instances[0].q[0] == pytest.approx(0.8)
    view = view_after(session, Scrub(0.5), ticks=5)
    assert 0.1 < view.instances[0].q[0] < 0.7 and view.timeline.now == 0.5
    assert np.allclose(view.ball.position, session.robot.measure(view.instances[0].q).position)
    view = view_after(session, PlayTimeline(True), ticks=30)
    assert view.timeline.now == pytest.approx(1.0) and view.timeline.playing
    view = view_after(session, ticks=120)
    assert view.timeline.now == 2.0 and not view.timeline.playing
    assert view.instances[0].q[0] == pytest.approx(-0.4)
    view = view_after(session, PlayTimeline(True), ticks=6)
    assert view.timeline.now == pytest.approx(0.1), "the timeline does not restart"
    view = view_after(session, SetRunning(False), ticks=20)
    assert not view.timeline.playing and view.timeline.now == pytest.approx(0.1)
    view = view_after(session, MoveGoal(tuple(first_ball(session.robot).position)), ticks=1)
    assert view.motion == "hand"


def test_key_poses_are_moved_and_removed(session: Session) -> None:
    for value in (0.1, 0.2, 0.3):
        view_after(session, SetJoint("joint1", value), RecordPose(), ticks=1)
    view = view_after(session, MovePose(0, 5.0), ticks=1)
    assert view.timeline.names == ("pose 2", "pose 3", "pose 1")
    assert view.timeline.times == (0.0, 1.0, 4.0)
    view = view_after(session, MovePose(1, 0.0), Scrub(0.0), ticks=1)
    assert view.timeline.times[1] - view.timeline.times[0] == pytest.approx(MIN_INTERVAL)
    view = view_after(session, RemovePose(0), RemovePose(7), ticks=1)
    assert len(view.timeline.times) == 2 and view.timeline.times[0] == 0.0
    view = view_after(session, RemovePose(0), RemovePose(0), ticks=2)
    assert view.timeline.times == () and view.motion == "hand"


def test_a_file_of_poses_comes_back_as_it_was(session: Session) -> None:
    for value in (0.1, 0.9):
        view_after(session, SetJoint("joint1", value), RecordPose(), ticks=1)
    view_after(session, MovePose(1, 2.5), ticks=1)
    text = session.timeline.book().text()
    book = KeyPoses.parse(text, session.robot, "poses.toml")
    assert book.motion("timeline").duration == pytest.approx(2.5)
    other = Session(Start(), beside=False)
    view = view_after(other, LoadPoses(text), Scrub(2.5), ticks=2)
    assert view.timeline.times == (0.0, 2.5) and view.instances[0].q[0] == pytest.approx(0.9)
    view = view_after(other, LoadPoses("schema = 1\n[poses.a]\njoint9 = 1"), ticks=1)
    assert "joint9" in view.message and view.timeline.times == (0.0, 2.5)


def test_a_timeline_without_a_motion_says_what_is_missing() -> None:
    timeline = Timeline(load_robot("puma560"))
    for call in (timeline.motion, lambda: timeline.at(0.0)):
        with pytest.raises(TrajectoryError):
            call()


def test_distances_to_obstacles_are_mujocos(session: Session) -> None:
    view = view_after(session, SetMotion("hand"), AddObstacle("sphere"), ticks=12)
    position = (0.9, 0.5, 0.6)
    view = view_after(session, MoveObstacle(0, position), ticks=12)
    obstacle = view.obstacles[0]
    radius = 0.5 * obstacle.placed.size[0]
    model = session.robot.model
    data = session.robot.data_at(view.instances[0].q)
    nearest = min(
        np.linalg.norm(data.geom_xpos[g] - position) - model.geom_rbound[g] - radius
        for g in range(model.ngeom)
        if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE
    )
    assert nearest <= obstacle.distance < np.linalg.norm(np.array(position)) and obstacle.part
    gap = np.linalg.norm(obstacle.points[0] - obstacle.points[1])
    assert gap == pytest.approx(obstacle.distance, abs=1e-9)
    on_sphere = np.linalg.norm(obstacle.points - position, axis=1).min()
    assert on_sphere == pytest.approx(radius, abs=1e-6)
    tool = tuple(session.instances[0].tool_pose().position.tolist())
    view = view_after(session, MoveObstacle(0, tool), ticks=12)
    assert view.obstacles[0].distance < 0.0
    view = view_after(session, RemoveObstacle(3), RemoveObstacle(0), ticks=12)
    assert view.obstacles == () and view.contacts == ()


def test_there_is_a_limit_of_obstacles(session: Session) -> None:
    commands = [AddObstacle("box")] * (MAX_OBSTACLES + 1)
    view = view_after(session, *commands, ticks=1)
    assert len(view.obstacles) == MAX_OBSTACLES and "remove one" in view.message


WEDGE = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.1), (0.01, 0.01, 0.01))
"""m. The last point is inside."""


def test_a_mesh_is_its_convex_hull_and_every_shape_takes_a_size(session: Session) -> None:
    commands = [AddMesh("wedge", WEDGE), AddObstacle("cylinder"), AddObstacle("sphere")]
    view = view_after(session, *commands, SetMotion("hand"), ticks=12)
    hull = view.obstacles[0].placed.hull
    assert hull is not None and len(hull.vertices) == 4 and len(hull.faces) == 4
    assert view.obstacles[0].placed.size == pytest.approx((0.3, 0.2, 0.1), abs=1e-6)
    size = (0.2, 0.4, 0.6)
    resized = [ResizeObstacle(k, size) for k in range(3)]
    moved = [MoveObstacle(k, (9.0, 3.0 * k, 9.0)) for k in range(3)]
    view = view_after(session, *resized, *moved, ticks=12)
    sizes = [one.placed.size for one in view.obstacles]
    assert sizes == [size, (0.2, 0.2, 0.6), (0.2, 0.2, 0.2)]
    # MuJoCo measures each shape from a part of the robot to its surface.
    for one in view.obstacles:
        from_centre = np.abs(one.points - one.placed.position)
        on_obstacle = from_centre[np.linalg.norm(from_centre, axis=1).argmin()]
        assert (on_obstacle < 0.5 * np.array(one.placed.size) + 1e-6).all()
    view = view_after(session, AddMesh("flat", ((0.0, 0.0, 0.0),) * 5), ticks=1)
    assert "cannot be an obstacle" in view.message and len(view.obstacles) == 3


def test_all_contacts_are_named_with_their_depths(session: Session) -> None:
    view = view_after(session, SetMotion("hand"), ticks=12)
    assert view.contacts == (), "parts that touch by construction are no contact"
    folded = {"joint1": 2.31, "joint2": -0.09, "joint3": 1.71, "joint4": 1.87, "joint5": -0.72}
    view = view_after(session, *(SetJoint(*row) for row in folded.items()), ticks=12)
    robot = session.robot
    q = view.instances[0].q
    data = robot.data_at(q)
    mujoco.mj_comPos(robot.model, data)
    mujoco.mj_collision(robot.model, data)
    body_of = robot.model.geom_bodyid
    judged = {
        frozenset(robot.model.body(body_of[geom]).name for geom in contact.geom)
        for contact in data.contact[: data.ncon]
        if contact.dist < 0.0
    }
    assert judged and {frozenset(contact.parts) for contact in view.contacts} == judged
    depths = [contact.depth for contact in view.contacts]
    assert depths == sorted(depths, reverse=True) and depths[-1] > 0.0
    names = {robot.model.body(body).name for one in view.contacts for body in one.bodies}
    assert names <= set().union(*judged) and names
    tool = tuple(session.instances[0].tool_pose().position.tolist())
    view = view_after(session, AddObstacle("box"), MoveObstacle(0, tool), ticks=12)
    touching = [contact for contact in view.contacts if "box 1" in contact.parts]
    assert touching
    for contact in touching:
        part = contact.parts[1 - contact.parts.index("box 1")]
        assert contact.bodies == (robot.model.body(part).id,)


def test_restarts_solve_random_positions_that_following_does_not() -> None:
    solved = []
    for on in (False, True):
        with Session(Start(methods=("dls",)), beside=False) as session:
            view = view_after(
                session, SetRestarts(on), SetPace(0.5), SetMotion("random"), ticks=60 * 12
            )
            solved.append(view.instances[0].statistics.solved)
    assert solved[1] > solved[0] + 0.1 and solved[1] > 0.9


def test_the_pace_of_the_random_ball(session: Session) -> None:
    def moves(ticks: int) -> int:
        count = 0
        for _ in range(ticks):
            before = session.view().ball.position
            session.tick()
            count += not np.array_equal(before, session.view().ball.position)
        return count

    view_after(session, SetMotion("random"), SetPace(0.5), ticks=1)
    assert moves(120) == 4
    view_after(session, SetPace(0.0), ticks=1)
    assert moves(30) == 30


def test_a_budget_limits_iterations_and_decides_what_counts_as_solved(session: Session) -> None:
    view_after(session, SetMethod(0, "ccd"), SetMotion("hand"), ticks=5)
    view = view_after(session, SetBudget(0, 3, 1e-4), MoveGoal((0.3, 0.3, 0.6)), ticks=2)
    assert view.instances[0].iterations <= 3 and not view.instances[0].met
    view = view_after(session, SetBudget(0, 3, 1.0), SetMethod(0, "lm"), ticks=70)
    one = view.instances[0]
    assert one.distance == 1.0 and one.statistics.count > 0


def test_words_agree_with_numbers() -> None:
    with Session(Start("humanoid"), beside=False) as session:
        view = view_after(session, ticks=130)
        one = view.instances[0]
        assert one.met and one.words.startswith("ball met")
    gaze = ("ball", 0.0, 0.0), ("gaze", 0.0, 0.2), ("posture", 0.0, 0.5)
    posture = ("ball", 0.0, 0.0), ("gaze", 0.0, 1e-5), ("posture", 0.0, 0.5)
    for goals, status, words in (
        (gaze, "blocked by limits", "ball met; gaze blocked by limits"),
        (posture, "blocked by limits", "ball met"),
        (gaze, "stalled", "ball met"),
        (posture, "converged", "ball met"),
    ):
        assert dataclasses.replace(one, goals=goals, status=status).words == words
    missed = dataclasses.replace(one, met=False, status="blocked by limits")
    assert missed.words == "blocked by limits"
    assert dataclasses.replace(missed, stuck=True).words.endswith("press Reset, or choose a branch")
    refused = dataclasses.replace(one, able=False, status="it supports pose goals only")
    assert refused.words == "it supports pose goals only"


def test_a_stuck_method_says_what_to_do(session: Session) -> None:
    view_after(session, SetMotion("hand"), ticks=5)
    stuck = session.instances[0]
    q = session.robot.home.copy()
    q[1] = session.robot.upper[1]
    q[2] = session.robot.lower[2]
    target = tuple(session.robot.measure(session.robot.home).position.tolist())
    stuck.move_to(q)
    view = view_after(session, MoveGoal(target, (0.0, 1.0, 0.0, 0.0)), ticks=90)
    one = view.instances[0]
    if not one.met:
        assert one.stuck and "press Reset" in one.words
    view = view_after(session, Reset(), ticks=90)
    assert view.instances[0].met and not view.instances[0].stuck


def test_the_ball_is_locked_while_a_passive_figure_acts_and_reset_frees_both(
    session: Session,
) -> None:
    view = view_after(session, SetRobot("humanoid"), SetFigure("passive"), ticks=2)
    ball = (0.5, -0.3, 1.3)
    view = view_after(session, MoveGoal(ball), Act(), ticks=20)
    assert view.figure is not None and view.figure.locked
    for command in (MoveGoal((1.0, 0.0, 1.0)), Nudge((0.1, 0.0, 0.0)), SetMotion("curve")):
        view = view_after(session, command, ticks=5)
        assert np.allclose(view.ball.position, ball) and "locked" in view.message
    view = view_after(session, Reset(), ticks=2)
    assert view.figure is not None and view.figure.waiting and not view.figure.locked
    assert np.allclose(view.ball.position, first_ball(session.robot).position)
    assert np.allclose(view.instances[0].q, session.robot.home, atol=1e-6)


def test_posing_replays_to_the_same_bits(session: Session) -> None:
    script: list[tuple[int, Command]] = [
        (2, SetJoint("joint1", 0.3)),
        (4, RecordPose()),
        (6, SetJoint("joint2", -0.9)),
        (7, RecordPose()),
        (8, MovePose(1, 1.7)),
        (9, PlayTimeline(True)),
        (60, AddObstacle("box")),
        (65, AddMesh("wedge", WEDGE)),
        (66, ResizeObstacle(1, (0.3, 0.3, 0.3))),
        (70, MoveObstacle(0, (0.4, 0.4, 0.4))),
        (80, SetBudget(0, 50, 0.01)),
        (90, SetMotion("random")),
        (91, SetPace(0.25)),
        (140, SetRestarts(False)),
        (150, RemoveObstacle(0)),
    ]
    require_equal_replay(run_script(session, script, ticks=180))
