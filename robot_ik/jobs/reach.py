"""The main job: a marker is seen, the arm reaches it, a camera says how far it really is from the goal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.catalogue import find_robot
from robot_ik.errors import (
    ConfigError,
    MarkerNotFoundError,
    MotorFaultError,
    NotConvergedError,
    TrajectoryError,
)
from robot_ik.execution import execute
from robot_ik.geometry import Pose
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.jobs.ahead import CompiledAhead
from robot_ik.jobs.cameras import open_eyes
from robot_ik.jobs.eyes import Eyes
from robot_ik.jobs.limbs import Limbs, prepare_limbs
from robot_ik.jobs.reach_report import SOLVE_TOLERANCE, ReachReport
from robot_ik.jobs.reach_request import ReachRequest, Rehearsal
from robot_ik.jobs.verdict import (
    SIGMAS,
    Bound,
    judge_by_camera,
    judge_read_back,
    quantisation,
)
from robot_ik.motion.line import line_move
from robot_ik.motion.trajectory import Trajectory, joint_move
from robot_ik.problem import Problem, Tolerance
from robot_ik.solvers import make_solver

Array = NDArray[np.float64]

# Errors that mean "tried, not achieved": they end up in the report.
_NOT_ACHIEVED = (MarkerNotFoundError, NotConvergedError, TrajectoryError, MotorFaultError)
# How long the servos may take to arrive after the last command.
_SETTLE_SECONDS = 0.4


__all__ = ["ReachReport", "ReachRequest", "Rehearsal", "run_reach"]

Progress = Callable[[str, float], None]


def run_reach(
    request: ReachRequest,
    progress: Progress = lambda stage, share: None,
    done: Callable[[ReachReport], None] = lambda report: None,
) -> ReachReport:
    """Looks, solves, moves, looks again.

    Args:
        request: What to do.
        progress: Told the stage ("looking", "solving", "moving", …) and the share of it that is done.
        done: Given the report when the arm has been left; with a window, before its user closes that.

    Returns:
        A report; not reaching the goal is a result (``report.reached``, ``report.problem``).

    Raises:
        RobotIkError: Wrong input or environment; nothing was sent to a servo, or the arm was left as its
            exit policy says.
    """
    if request.solver:
        make_solver(request.solver)  # a misspelt name shall cost nothing
    if request.follow > 0.0 and request.goal is not None:
        raise ConfigError(
            "a goal that is given does not move, so there is nothing to follow",
            file="command line", key="--follow", allowed="without --goal, so that a marker is the goal",
        )  # fmt: skip
    method = request.solver or find_robot(request.robot)[1].solver or "auto"
    with contextlib.ExitStack() as stack:
        ahead = stack.enter_context(CompiledAhead.solver(request.robot, method))
        limbs = prepare_limbs(request)
        frame = limbs.frame
        eyes = open_eyes(request, limbs, frame, stack)
        window = _window(request, limbs, eyes, stack)
        report = ReachReport(request, limbs.robot, frame, limbs, eyes)
        with limbs.connected():
            try:
                _look(report, progress)
                ahead.wait()
                if window is not None and report.target is not None:
                    window.show_goal(report.target)
                _solve(report, method, progress)
                limbs.energise()
                _reach(report, window, progress)
            except _NOT_ACHIEVED as problem:
                report.problem = problem
            report.counters = limbs.counters()
        done(report)
        if window is not None:
            window.wait()
    return report


def _window(request: ReachRequest, limbs: Limbs, eyes: Eyes | None, stack: contextlib.ExitStack) -> Any:
    if not request.view:
        return None
    from robot_ik.jobs.reach_window import stage_solids, window_stage
    from robot_ik.testbed.frontends.window import WindowSink

    stage = window_stage(limbs.robot, limbs.frame, None if eyes is None else eyes.stage)
    view: dict[str, Any] = {"solids": stage_solids(stage)}
    if stage is not None:
        marker = stage.pose_world_marker
        view["see"] = np.vstack([marker.position, marker.compose(stage.pose_marker_tool).position])
        view["eye"] = stage.pose_world_camera.position
    return stack.enter_context(WindowSink(limbs.robot, start=limbs.q, **view))


def _look(report: ReachReport, progress: Progress) -> None:
    """Finds the goal, by eye or as given."""
    request, eyes = report.request, report.eyes
    if request.goal is not None:
        report.goal = request.goal
        if eyes is not None:
            report.before = eyes.picture()
    else:
        assert eyes is not None  # open_eyes made some, because there is no other goal
        progress("looking", 0.0)
        try:
            report.seen = eyes.find_target()
        finally:
            report.before = eyes.last_image
        report.goal = report.seen.goal
        if request.follow > 0.0:
            eyes.get_ready_to_follow()
    report.target = report.goal.target


def _solve(report: ReachReport, method: str, progress: Progress) -> None:
    """Finds joint angles for the goal.  Nothing moves."""
    assert report.goal is not None
    report.q_start = report.limbs.q.copy()
    progress("solving", 0.0)
    solver = make_solver(method)
    problem = Problem(report.robot, report.goal, tolerance=SOLVE_TOLERANCE, seed=report.request.seed)
    report.solution = solver.solve(problem, report.q_start)
    # The first solve of a process loads or compiles the kernel; the same again shows what a solve costs.
    report.microseconds = 1e6 * solver.solve(problem, report.q_start).seconds
    _accept(report)


def _accept(report: ReachReport) -> None:
    """Goes on with a solution that met the tolerance, or missed a seen goal by less than is known of it.

    An arm that moves in a plane cannot go to a marker that is seen some micrometres beside that plane.

    Raises:
        NotConvergedError: Neither.
    """
    solution, seen = report.solution, report.seen
    assert solution is not None
    if seen is not None and not solution.converged:
        known, miss = _known(report), solution.miss
        if miss.position <= SIGMAS * known.position and miss.angle <= SIGMAS * known.angle:
            report.tolerance = Tolerance(
                position=max(SOLVE_TOLERANCE.position, SIGMAS * known.position),
                angle=max(SOLVE_TOLERANCE.angle, SIGMAS * known.angle),
            )
            return
    solution.require()


def _known(report: ReachReport) -> Bound:
    """Standard deviation of the goal as the last look at the marker tells it."""
    assert report.seen is not None and report.eyes is not None  # eyes have seen it
    return report.seen.uncertainty(report.eyes.stage.pose_marker_tool.position)


def _reach(report: ReachReport, window: Any, progress: Progress) -> None:
    """Moves there, follows if asked to, and judges."""
    request, robot, limbs = report.request, report.robot, report.limbs
    assert report.solution is not None and report.goal is not None and report.target is not None
    report.q_start = limbs.q.copy()
    report.trajectory = _plan(report)
    count = len(report.trajectory)

    def show(tick: Any) -> None:
        limbs.scene.send(tick.commanded if tick.measured is None else tick.measured, tick.time)
        if window is not None:
            window.send(limbs.scene.q, tick.time)
        progress("moving", min(1.0, tick.index / max(1, count)))

    report.execution = execute(
        report.trajectory,
        limbs.sinks,
        source=limbs.source,
        clock=limbs.clock,
        on_tick=show,
        settle=_SETTLE_SECONDS if limbs.source is not None else 0.0,
    )
    if request.follow > 0.0:
        _follow(report, window, progress)
    report.q_end = limbs.q.copy()
    report.bound = quantisation(robot, report.q_end, limbs.resolution, report.frame, report.tolerance)
    report.read_back = judge_read_back(
        robot, report.q_end, report.goal, report.target, report.frame, report.bound, report.goal_sigma
    )
    progress("looking again", 0.0)
    _judge(report)


def _plan(report: ReachReport) -> Trajectory:
    request, limbs = report.request, report.limbs
    assert report.solution is not None and report.target is not None and report.q_start is not None
    caps: dict[str, Any] = {
        "velocity": limbs.velocity,
        "acceleration": limbs.acceleration,
        "rate": limbs.rate,
        "speed": request.speed,
    }
    if not request.line:
        return joint_move(report.robot, report.q_start, report.solution.q, **caps)
    target = report.target
    if not report.goal.has_angle:  # type: ignore[union-attr]
        # A position says nothing of the turn on the way: keep the one the tool has.
        target = Pose(target.position, report.robot.forward(report.q_start, report.frame).wxyz)
    elif getattr(report.goal, "free_axis", None) is not None:  # the turn that the solution has chosen
        target = Pose(target.position, report.robot.forward(report.solution.q, report.frame).wxyz)
    return line_move(report.robot, report.q_start, target, frame=report.frame, **caps)


def _follow(report: ReachReport, window: Any, progress: Progress) -> None:
    from robot_ik.execution import follow

    request, limbs, eyes = report.request, report.limbs, report.eyes
    assert eyes is not None  # without a goal there are eyes

    behind: list[float] = []

    def show(tick: Any) -> None:
        q = tick.q if tick.measured is None else tick.measured
        limbs.scene.send(q, tick.time)
        if isinstance(tick.goal, PoseGoal | PositionGoal):  # not while parking
            place = report.robot.forward(q, report.frame).position
            behind.append(float(np.linalg.norm(place - tick.goal.target.position)))
        if window is not None:
            window.send(limbs.scene.q, tick.time)
        progress("following", min(1.0, tick.time / request.follow))

    with eyes.following(limbs.clock, request.follow) as goals:
        report.following = follow(
            goals,
            report.robot,
            request.solver or report.robot.file.solver or "auto",
            limbs.sinks,
            rate=limbs.rate,
            clock=limbs.clock,
            duration=request.follow,
            start=limbs.commanded,
            tolerance=SOLVE_TOLERANCE,
            speed=request.speed,
            source=limbs.source,
            on_tick=show,
        )
    if behind:
        report.behind = float(np.median(behind)), float(np.max(behind))
    limbs.settle(_SETTLE_SECONDS)
    # What counts in the end is where the marker is now.
    report.seen = eyes.find_target_again()
    report.goal, report.target = report.seen.goal, report.seen.goal.target
    # Two measurements of the marker: the one that was followed last, no better than this, and this one.
    report.goal_sigma = _known(report).combined(_known(report))


def _judge(report: ReachReport) -> None:
    """The camera's look at the gripper."""
    eyes, limbs = report.eyes, report.limbs
    if eyes is None or not eyes.sees_arm:
        report.blind = "no camera watched the arm" if eyes is None else eyes.why_blind
        return
    body = eyes.find_gripper()
    report.after = eyes.last_image
    if body is None:
        return
    assert report.goal is not None and report.target is not None and report.bound is not None
    report.by_camera = judge_by_camera(
        body, eyes.pose_world_camera, eyes.pose_body_tool(limbs.scene.q), report.goal, report.target,
        report.bound, report.goal_sigma,
    )  # fmt: skip
