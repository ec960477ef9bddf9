"""Planned motions of the session: no window, no thread but the planner's."""

from __future__ import annotations

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.testbed.commands import (
    AddObstacle,
    MarkPlanStart,
    MoveGoal,
    MoveObstacle,
    PlanMotion,
    PlayPlan,
    RemovePlan,
    ResizeObstacle,
    ScrubPlan,
    SetFigure,
    SetGoalKind,
    SetMotion,
    SetRobot,
    Start,
)
from robot_ik.testbed.planning import MARGIN
from robot_ik.testbed.session import Session
from tests.testbed.session_runs import require_equal_replay, view_after
from tests.waiting import wait_for

BALL = (0.35, 0.45, 0.35)
POST = (0.4, 0.2, 0.35)
"""m. A post between the tool at home and the ball."""

POST_SIZE = (0.06, 0.06, 0.7)
"""m."""


def obstructed(*, beside: bool = False) -> Session:
    """Return a session of a Panda with a post in the way."""
    session = Session(Start("panda", methods=("dls",)), beside=beside)
    wait_for(lambda: session.tick() or session.ready)
    ball = MoveGoal(BALL, (0.0, 1.0, 0.0, 0.0))
    post = [AddObstacle("box"), ResizeObstacle(0, POST_SIZE), MoveObstacle(0, POST)]
    view_after(session, SetMotion("hand"), *post, ball)
    return session


def test_a_plan_goes_around_the_obstacle_and_is_played_to_the_ball() -> None:
    with obstructed() as session:
        view = view_after(session, PlanMotion(), ticks=1)
        assert view.plan.state == "found" and "proven to keep 3 mm" in view.plan.text
        assert len(view.plan.path) and len(view.plan.ghosts) == 6
        obstacle = view.obstacles[0].placed.obstacle()
        scene = rik.Scene(session.robot, [obstacle])
        view = view_after(session, PlayPlan(True), ticks=1)
        postures = [view.instances[0].q]
        while view.plan.playing:
            view = view_after(session, ticks=1)
            postures.append(view.instances[0].q)
        assert view.motion == "plan" and view.plan.now == view.plan.duration
        # MuJoCo judges every posture that was shown.
        assert min(scene.clearance(q).distance for q in postures) >= MARGIN - 1e-6
        assert np.allclose(postures[0], session.robot.home, atol=0.05)
        assert view.instances[0].error < 1e-3
        # Without the plan the tool would go through the obstacle.
        straight = np.linspace(session.robot.home, postures[-1], 100)
        assert min(scene.clearance(q).distance for q in straight) < 0.0
        middle = view_after(session, ScrubPlan(0.5 * view.plan.duration), ticks=1)
        assert middle.plan.now == pytest.approx(0.5 * view.plan.duration)
        assert not np.allclose(middle.instances[0].q, postures[-1], atol=0.1)


def test_a_plan_starts_where_a_person_marked_it() -> None:
    with obstructed() as session:
        wait = view_after(session, MoveGoal((0.45, -0.3, 0.4), (0.0, 1.0, 0.0, 0.0)), ticks=30)
        marked = wait.instances[0].q
        view = view_after(session, MarkPlanStart(), MoveGoal(BALL), ticks=10)
        assert len(view.plan.ghosts) == 1 and "marked" in view.plan.text
        view = view_after(session, PlanMotion(), ScrubPlan(0.0), ticks=1)
        assert np.allclose(view.instances[0].q, marked, atol=1e-9)


def test_a_change_of_the_obstacles_or_of_the_goal_removes_the_plan() -> None:
    with obstructed() as session:
        for change in (MoveObstacle(0, (0.5, 0.0, 0.8)), AddObstacle("sphere")):
            view = view_after(session, PlanMotion(), ScrubPlan(0.1), ticks=2)
            assert view.plan.state == "found" and view.motion == "plan"
            view = view_after(session, change, ticks=2)
            assert view.plan.state == "none" and "plan again" in view.plan.text
            assert view.motion == "hand" and not len(view.plan.path)
        view_after(session, MoveObstacle(1, (3.0, 3.0, 3.0)), PlanMotion(), ticks=2)
        view = view_after(session, SetGoalKind("position"), ticks=2)
        assert view.plan.state == "none"
        view = view_after(session, PlanMotion(), RemovePlan(), ticks=1)
        assert view.plan.state == "none" and view.plan.text == ""


def test_why_there_is_no_plan_is_said() -> None:
    with obstructed() as session:
        tool = session.robot.measure(session.robot.home).position
        x, y, z = tool.tolist()
        view = view_after(session, MoveObstacle(0, (x, y, z)), PlanMotion(), ticks=1)
        assert view.plan.state == "failed" and "start is in collision" in view.plan.text
        view = view_after(session, PlayPlan(True), ticks=1)
        assert "no planned motion" in view.message and view.motion == "hand"
        far = [MoveObstacle(0, POST), MoveGoal((1.5, 0.0, 0.5))]
        view = view_after(session, *far, PlanMotion(), ticks=1)
        assert view.plan.state == "failed" and view.plan.text
        view = view_after(session, SetRobot("humanoid"), PlanMotion(), ticks=1)
        assert view.plan.state == "failed" and "free joints" in view.plan.text
        view = view_after(session, SetFigure("active"), PlanMotion(), ticks=1)
        assert "figure" in view.message


def test_a_plan_that_was_made_beside_the_loop_replays_to_the_same_bits() -> None:
    with obstructed(beside=True) as session:
        session.send(SetMotion("curve"))
        session.send(PlanMotion())
        wait_for(lambda: session.tick() or session.view().plan.state == "found")
        view_after(session, PlayPlan(True), ticks=40)
        log = session.log()
    planned = [command for _, command in log.commands if isinstance(command, PlanMotion)]
    assert len(planned) == 1 and len(planned[0].start) == 7 and planned[0].position is not None
    last = require_equal_replay(log)
    assert last.plan.path.tolist() == session.view().plan.path.tolist()


def test_a_plan_that_comes_too_late_is_not_shown() -> None:
    with obstructed(beside=True) as session:
        session.send(PlanMotion())
        session.tick()
        view = view_after(session, MoveObstacle(0, (0.5, 0.0, 0.9)), ticks=1)
        assert view.plan.state == "none"
        session.send(PlanMotion())
        session.send(MoveGoal((0.3, -0.4, 0.4)))
        # The first plan is ready before the second: the planner makes one after the other.
        wait_for(lambda: session.tick() or session.view().plan.state == "found")
        planned = [one for _, one in session.log().commands if isinstance(one, PlanMotion)]
        assert len(planned) == 1
