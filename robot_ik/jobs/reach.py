"""The main job: a marker is seen, the arm reaches it, a camera says how far it really is from the goal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import (
    ConfigError,
    MarkerNotFoundError,
    MotorFaultError,
    NotConvergedError,
    RobotIkError,
    TrajectoryError,
)
from robot_ik.execution import execute
from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.jobs.eyes import Eyes, Seen, open_eyes
from robot_ik.jobs.limbs import Limbs, prepare_limbs
from robot_ik.jobs.verdict import (
    SIGMAS,
    Bound,
    Judgement,
    judge_by_camera,
    judge_read_back,
    quantisation,
)
from robot_ik.motion.line import line_move
from robot_ik.motion.reports import Execution, FollowReport
from robot_ik.motion.trajectory import Trajectory, joint_move
from robot_ik.problem import Problem, Tolerance
from robot_ik.solvers import make_solver

if TYPE_CHECKING:
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution

Array = NDArray[np.float64]

# The solve is asked for far more than the servos can do, so that its miss does not count.
_TOLERANCE = Tolerance(position=1e-5, angle=1e-4)
# Errors that mean "tried, not achieved": they end up in the report.
_NOT_ACHIEVED = (MarkerNotFoundError, NotConvergedError, TrajectoryError, MotorFaultError)
# How long the servos may take to arrive after the last command.
_SETTLE_SECONDS = 0.4


@dataclass(frozen=True)
class Rehearsal:
    """What shall go wrong, to see that it is noticed; for simulated servos and the synthetic camera.

    Attributes:
        zero_offset_deg: Joint -> degrees by which its servo's shaft is ahead of what its registers say.
        stuck: Joints whose shaft does not move.
        cover_gripper: Hide the gripper's markers in the second picture.
        blank_marker: Leave the target's paper white.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker instead of the stage's own.
    """

    zero_offset_deg: Mapping[str, float] = field(default_factory=dict)
    stuck: tuple[str, ...] = ()
    cover_gripper: bool = False
    blank_marker: bool = False
    marker_at: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class ReachRequest:
    """What ``run_reach`` shall do; every default is the embedded demonstration.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        solver: Name of a method; empty: the robot's own, else ``auto``.
        goal: Instead of a marker.
        frame: What shall get there; None: the robot's tool.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file of a real camera.
        pose_world_camera: Where a real camera stands; None: where the stage's stands.
        marker_id, marker_size, dictionary: The target; None: the stage's.
        bus: ``pty``, ``sim``, ``none`` or a serial port.
        arm_file: None: the one beside the model, else a generic one.
        speed: Share of the joints' speed limits.
        line: Move the tool on a straight line.
        follow: Seconds to go on following the marker; 0: not at all.
        view: Mirror the motion in a window.
        seed: Of restarts and of the synthetic camera's noise.
        rehearsal: What shall go wrong.
    """

    robot: str = "puma560"
    solver: str = ""
    goal: Goal | None = None
    frame: str | None = None
    camera: str = "synthetic"
    intrinsics: Path | None = None
    pose_world_camera: Pose | None = None
    marker_id: int | None = None
    marker_size: float | None = None
    dictionary: str | None = None
    bus: str = "pty"
    arm_file: Path | None = None
    speed: float = 1.0
    line: bool = False
    follow: float = 0.0
    view: bool = False
    seed: int = 0
    rehearsal: Rehearsal = Rehearsal()


@dataclass(eq=False)
class ReachReport:
    """What happened, as far as it got; fields stay None where it did not get.

    Attributes:
        robot: With the limits that were used.
        frame: What was to reach the goal.
        seen: The target marker in the first picture.
        goal, target: What was wanted; its pose in the world.
        tolerance: What the solution's miss may be; part of ``bound``.
        behind: While following: how far the tool was from the goal of the moment, median and largest, metres.
        problem: Why it ended early: an error that means "not achieved".
        read_back, by_camera: The two judgements.
        verdict: One sentence on the camera's judgement.
    """

    request: ReachRequest
    robot: Robot
    frame: str
    limbs: Limbs
    eyes: Eyes | None
    seen: Seen | None = None
    goal: Goal | None = None
    target: Pose | None = None
    solution: Solution | None = None
    microseconds: float | None = None
    trajectory: Trajectory | None = None
    execution: Execution | None = None
    following: FollowReport | None = None
    q_start: Array | None = None
    q_end: Array | None = None
    tolerance: Tolerance = _TOLERANCE
    behind: tuple[float, float] | None = None
    bound: Bound | None = None
    read_back: Judgement | None = None
    by_camera: Judgement | None = None
    verdict: str = ""
    camera_counts: bool = False
    before: Any = None
    after: Any = None
    problem: RobotIkError | None = None
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def reached(self) -> bool:
        """Both judgements passed, or the only one that could be made."""
        if self.problem is not None or self.read_back is None or not self.read_back.passed:
            return False
        if not self.camera_counts:
            return True
        return self.by_camera is not None and self.by_camera.passed


Progress = Callable[[str, float], None]


def run_reach(request: ReachRequest, progress: Progress = lambda stage, share: None) -> ReachReport:
    """Looks, solves, moves, looks again.

    Args:
        request: What to do.
        progress: Told the stage ("looking", "solving", "moving", …) and the share of it that is done.

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
    limbs = prepare_limbs(request)
    frame = limbs.frame
    with contextlib.ExitStack() as stack:
        eyes = open_eyes(request, limbs, frame, stack)
        window = _window(request, limbs, stack)
        stack.enter_context(limbs.connected())
        report = ReachReport(request, limbs.robot, frame, limbs, eyes)
        try:
            _aim(report, progress)
            limbs.energise()
            _reach(report, window, progress)
        except _NOT_ACHIEVED as problem:
            report.problem = problem
        report.counters = limbs.counters()
    return report


def _window(request: ReachRequest, limbs: Limbs, stack: contextlib.ExitStack) -> Any:
    if not request.view:
        return None
    from robot_ik.testbed.frontends.window import WindowSink

    return stack.enter_context(WindowSink(limbs.robot, start=limbs.q))


def _aim(report: ReachReport, progress: Progress) -> None:
    """Finds the goal, by eye or as given, and the joint angles for it.  Nothing moves."""
    request, robot, eyes = report.request, report.robot, report.eyes
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
    report.q_start = report.limbs.q.copy()
    progress("solving", 0.0)
    name = request.solver or robot.file.solver or "auto"
    solver = make_solver(name)
    problem = Problem(robot, report.goal, tolerance=_TOLERANCE, seed=request.seed)
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
        known = seen.uncertainty(report.eyes.stage.pose_marker_tool.position)  # type: ignore[union-attr]
        miss = solution.miss
        if miss.position <= SIGMAS * known.position and miss.angle <= SIGMAS * known.angle:
            report.tolerance = Tolerance(
                position=max(_TOLERANCE.position, miss.position), angle=max(_TOLERANCE.angle, miss.angle)
            )
            return
    solution.require()


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
        robot, report.q_end, report.goal, report.target, report.frame, report.bound
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
    return line_move(report.robot, report.q_start, target, frame=report.frame, **caps)


def _follow(report: ReachReport, window: Any, progress: Progress) -> None:
    from robot_ik.execution import follow

    request, limbs, eyes = report.request, report.limbs, report.eyes
    assert eyes is not None  # without a goal there are eyes

    behind: list[float] = []

    def show(tick: Any) -> None:
        q = tick.q if tick.measured is None else tick.measured
        limbs.scene.send(q, tick.time)
        if tick.goal is not None:
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
            tolerance=_TOLERANCE,
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


def _judge(report: ReachReport) -> None:
    """The camera's look at the gripper."""
    eyes, limbs = report.eyes, report.limbs
    if eyes is None or not eyes.sees_arm:
        report.verdict = "no camera watched the arm" if eyes is None else eyes.why_blind
        return
    body = eyes.find_gripper()
    report.after = eyes.last_image
    report.camera_counts = report.request.goal is None or body is not None
    if body is None:
        report.verdict = "no marker of the gripper is in view, so where the tool is remains unproven"
        return
    assert report.goal is not None and report.target is not None and report.bound is not None
    pose_body_tool = eyes.pose_body_tool(limbs.scene.q)
    report.by_camera = judge_by_camera(
        body, eyes.pose_world_camera, pose_body_tool, report.goal, report.target, report.bound
    )
    report.verdict = (
        "within what the servos' ticks and the camera explain"
        if report.by_camera.passed
        else "farther off than the servos' ticks and the camera can explain: check zeros, horns and limits"
    )
