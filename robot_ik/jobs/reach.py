"""The main job: a marker is seen, the arm reaches it, a camera says how far it really is from the goal."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.image import marker_bits
from robot_ik.camera.marker_goals import LostPolicy
from robot_ik.errors import (
    CameraError,
    ConfigError,
    MarkerNotFoundError,
    MotorFaultError,
    NotConvergedError,
    RobotIkError,
    TrajectoryError,
)
from robot_ik.execution import Execution, FollowReport, execute
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.jobs import JobReport, Progress
from robot_ik.jobs.precompile import Precompilation
from robot_ik.jobs.recording import open_recording
from robot_ik.jobs.robot_setup import RobotSetup, prepare_robot
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.verdict import (
    EXACT,
    SIGMAS,
    Bound,
    Judgement,
    Verdict,
    decide,
    judge_by_camera,
    judge_read_back,
    quantisation,
)
from robot_ik.jobs.vision import SeenTarget, Vision, open_vision
from robot_ik.motion.line import line_move
from robot_ik.motion.trajectory import Trajectory, joint_move
from robot_ik.problem import Problem
from robot_ik.robot_file import find_robot
from robot_ik.solvers import make_solver
from robot_ik.testbed.frontends.window import Solid

if TYPE_CHECKING:
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution


# ------------------------------------------------------------------------------------------
# What a reach shall do, and what shall go wrong on purpose.


@dataclass(frozen=True)
class Rehearsal:
    """What shall go wrong, to see that it is noticed; for simulated servos and the synthetic camera.

    Attributes:
        zero_offset_deg: Joint -> degrees by which its servo's shaft is ahead of what its registers say.
        stuck: Joints whose shaft does not move.
        cover_gripper: Hide the gripper's markers in the second picture.
        blank_marker: Leave the target's paper white.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker instead of the scene's own.
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
        pose_world_camera: Where a real camera stands; None: where the scene's stands.
        marker_id, marker_size, dictionary: The target; None: the scene's.
        bus: ``pty``, ``sim``, ``none`` or a serial port.
        arm_file: None: the one beside the model, else a generic one.
        speed: Share of the joints' speed limits.
        line: Move the tool on a straight line.
        follow: Seconds to go on following the marker; 0: not at all.
        when_lost, lost_after: What to do (``hold``, ``park`` at home, ``stop``) after so many seconds without
            the marker while following.
        lead: Seconds to predict the marker beyond each tick.
        view: Mirror the motion in a window.
        record: File of all commands and measurements, .csv or .mcap.
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
    when_lost: LostPolicy = "hold"
    lost_after: float = 2.0
    lead: float = 0.0
    view: bool = False
    record: Path | None = None
    seed: int = 0
    rehearsal: Rehearsal = Rehearsal()


# ------------------------------------------------------------------------------------------
# What happened in a reach, as far as it got.


# The solve is asked for far more than the servos can do, so that its miss does not count.
SOLVE_TOLERANCE = Tolerance(position=1e-5, angle=1e-4)


@dataclass(eq=False)
class ReachReport(JobReport):
    """What happened, as far as it got; fields stay None where it did not get.

    Attributes:
        robot: With the limits that were used.
        frame: What was to reach the goal.
        seen: The target marker in the first picture.
        goal, target: What was wanted; its pose in the world.
        tolerance: What the solution's miss may be; part of ``bound``.
        behind: While following: how far the tool was from the goal of the moment, median and largest, metres.
        problem: Why it ended early: an error that means "not achieved".
        goal_sigma: How well ``target`` is known beside what the arm was sent to; zeros where both are one.
        read_back, by_camera: The two judgements.
        blind: Why no camera looked at the arm; empty: one looked.
    """

    request: ReachRequest
    robot: Robot
    frame: str
    setup: RobotSetup
    vision: Vision | None
    seen: SeenTarget | None = None
    goal: Goal | None = None
    target: Pose | None = None
    solution: Solution | None = None
    microseconds: float | None = None
    trajectory: Trajectory | None = None
    execution: Execution | None = None
    following: FollowReport | None = None
    q_start: Array | None = None
    q_end: Array | None = None
    tolerance: Tolerance = SOLVE_TOLERANCE
    behind: tuple[float, float] | None = None
    bound: Bound | None = None
    read_back: Judgement | None = None
    by_camera: Judgement | None = None
    goal_sigma: Bound = EXACT
    blind: str = ""
    before: Any = None
    after: Any = None
    problem: RobotIkError | None = None
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def decision(self) -> Verdict:
        """Did it arrive, and why so; text and exit code are its."""
        if self.problem is not None or self.read_back is None:
            return Verdict(False, "")
        return decide(
            self.read_back,
            self.by_camera,
            servos=self.setup.arm is not None,
            blind=self.blind,
            seen_goal=self.request.goal is None,
            stopped_short=self._stopped_short(),
            followed=self.following is not None,
        )

    @property
    def reached(self) -> bool:
        """Whether it arrived."""
        return self.decision.reached

    @property
    def verdict(self) -> str:
        """One sentence on that; empty where ``problem`` says it."""
        return self.decision.text

    def _stopped_short(self) -> str:
        """Which servo did not get to where it was sent, by its own account; empty: all did."""
        off = None if self.execution is None else self.execution.final_error
        if off is None or self.following is not None:
            return ""
        worst = int(abs(off).argmax())
        if abs(off[worst]) <= self.setup.resolution[worst]:
            return ""
        joint = self.execution.joints[worst]  # type: ignore[union-attr]
        return (
            f"{joint} is {math.degrees(abs(float(off[worst]))):.2f}° from its command by its own account: "
            "is it held, overloaded or too slow?"
        )


Array = NDArray[np.float64]

# Errors that mean "tried, not achieved": they end up in the report.
_NOT_ACHIEVED = (MarkerNotFoundError, NotConvergedError, TrajectoryError, MotorFaultError)
# How long the servos may take to arrive after the last command.
_SETTLE_SECONDS = 0.4


def run_reach(
    request: ReachRequest,
    progress: Progress = lambda phase, share: None,
    done: Callable[[ReachReport], None] = lambda report: None,
) -> ReachReport:
    """Looks, solves, moves, looks again.

    Args:
        request: What to do.
        progress: Called with the phase ("looking", "solving", "moving", …) and the share of it that is done.
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
        compiling = stack.enter_context(Precompilation.solver(request.robot, method))
        setup = prepare_robot(request)
        if request.record is not None:
            setup.record(stack.enter_context(open_recording(request.record, setup.robot.joints)))
        vision = open_vision(request, setup, setup.frame, stack)
        window = _window(request, setup, vision, stack)
        report = ReachReport(request, setup.robot, setup.frame, setup, vision)
        with setup.connected():
            try:
                _run_phases(report, _ReachPhases(request, setup, vision, window, method, progress), compiling)
            except _NOT_ACHIEVED as problem:
                report.problem = problem
            report.counters = setup.counters()
        done(report)
        if window is not None:
            window.wait()
    return report


def _run_phases(report: ReachReport, phases: _ReachPhases, compiling: Precompilation) -> None:
    """One phase after the other; the report keeps those that ended, whatever becomes of the next."""
    try:
        found = report.keep(phases.find_goal())
    finally:
        if phases.vision is not None:
            report.before = phases.vision.last_image
    compiling.wait()
    if phases.window is not None:
        phases.window.show_goal(found.target)
    solved = report.keep(phases.solve(found))
    report.tolerance = phases.accept(found, solved)
    phases.setup.enable_torque()
    report.keep(phases.move(report.keep(phases.plan(found, solved))))
    if phases.request.follow > 0.0:
        report.keep(phases.follow())
        found = report.keep(phases.find_goal_again())
        # Two measurements of the marker: the one that was followed last, no better than this, and this one.
        report.goal_sigma = phases.known(found).combined(phases.known(found))
    arrived = report.keep(phases.read_back(found, report.tolerance, report.goal_sigma))
    report.keep(phases.judge_by_camera(found, arrived, report.goal_sigma))


def _window(
    request: ReachRequest, setup: RobotSetup, vision: Vision | None, stack: contextlib.ExitStack
) -> Any:
    if not request.view:
        return None
    from robot_ik.testbed.frontends.window import WindowSink

    scene = window_scene(setup.robot, setup.frame, None if vision is None else vision.scene)
    view: dict[str, Any] = {"solids": scene_solids(scene)}
    if scene is not None:
        marker = scene.pose_world_marker
        view["see"] = np.vstack([marker.position, marker.compose(scene.pose_marker_tool).position])
        view["viewpoint"] = scene.pose_world_camera.position
    return stack.enter_context(WindowSink(setup.robot, start=setup.q, **view))


@dataclass(frozen=True, eq=False)
class ReachGoal:
    """What is wanted.

    Attributes:
        goal, target: The goal, and its pose in the world.
        seen: The marker that says so; None: the goal was given.
    """

    goal: Goal
    target: Pose
    seen: SeenTarget | None


@dataclass(frozen=True, eq=False)
class Solved:
    """Joint angles for it, from ``q_start`` (nq,); ``microseconds`` are of a solve that is loaded."""

    q_start: Array
    solution: Solution
    microseconds: float


@dataclass(frozen=True, eq=False)
class Planned:
    """The way there from ``q_start`` (nq,), where the arm with torque stands."""

    q_start: Array
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class Moved:
    """What became of the way."""

    execution: Execution


@dataclass(frozen=True, eq=False)
class Followed:
    """What became of following; ``behind`` as in ``ReachReport``."""

    following: FollowReport
    behind: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Arrived:
    """Where the servos say that the arm is, (nq,), and what follows from that."""

    q_end: Array
    bound: Bound
    read_back: Judgement


@dataclass(frozen=True, eq=False)
class SeenArrived:
    """What the camera says; ``blind``: why it says nothing."""

    by_camera: Judgement | None = None
    after: Any = None
    blind: str = ""


@dataclass(frozen=True, eq=False)
class _ReachPhases:
    """What a reach does, one thing after the other, and what all of it needs."""

    request: ReachRequest
    setup: RobotSetup
    vision: Vision | None
    window: Any
    method: str
    progress: Progress

    @property
    def camera(self) -> Vision:
        """The camera, which there is wherever no goal was given."""
        assert self.vision is not None
        return self.vision

    def find_goal(self) -> ReachGoal:
        """Finds the goal, by eye or as given."""
        goal = self.request.goal
        if goal is not None:
            if self.vision is not None:
                self.vision.picture()
            return ReachGoal(goal, goal.target, None)
        self.progress("looking", 0.0)
        seen = self.camera.find_target()
        if self.request.follow > 0.0:
            self.camera.get_ready_to_follow()
        return ReachGoal(seen.goal, seen.goal.target, seen)

    def find_goal_again(self) -> ReachGoal:
        """What counts after following is where the marker is now."""
        seen = self.camera.find_target_again()
        return ReachGoal(seen.goal, seen.goal.target, seen)

    def solve(self, found: ReachGoal) -> Solved:
        """Finds joint angles for the goal.  Nothing moves."""
        q = self.setup.q.copy()
        self.progress("solving", 0.0)
        solver = make_solver(self.method)
        robot, seed = self.setup.robot, self.request.seed
        problem = Problem(robot, found.goal, tolerance=SOLVE_TOLERANCE, seed=seed)
        solution = solver.solve(problem, q)
        # The first solve of a process loads or compiles the kernel; the same again shows what a solve costs.
        return Solved(q, solution, 1e6 * solver.solve(problem, q).seconds)

    def accept(self, found: ReachGoal, solved: Solved) -> Tolerance:
        """What the solution's miss may be: the tolerance, or as much as is not known of a seen goal.

        An arm that moves in a plane cannot go to a marker that is seen some micrometres beside that plane.

        Raises:
            NotConvergedError: It misses both.
        """
        if found.seen is not None and not solved.solution.converged:
            known, miss = self.known(found), solved.solution.miss
            if miss.position <= SIGMAS * known.position and miss.angle <= SIGMAS * known.angle:
                return Tolerance(
                    position=max(SOLVE_TOLERANCE.position, SIGMAS * known.position),
                    angle=max(SOLVE_TOLERANCE.angle, SIGMAS * known.angle),
                )
        solved.solution.require()
        return SOLVE_TOLERANCE

    def known(self, found: ReachGoal) -> Bound:
        """Standard deviation of a seen goal, as the last picture of the marker says it."""
        assert found.seen is not None
        return found.seen.uncertainty(self.camera.scene.pose_marker_tool.position)

    def plan(self, found: ReachGoal, solved: Solved) -> Planned:
        """The way from where the arm stands now."""
        setup, robot, frame, goal = self.setup, self.setup.robot, self.setup.frame, found.goal
        start, end = setup.q.copy(), solved.solution.q
        caps: dict[str, Any] = {
            "velocity": setup.velocity,
            "acceleration": setup.acceleration,
            "rate": setup.rate,
            "speed": self.request.speed,
        }
        if not self.request.line:
            return Planned(start, joint_move(robot, start, end, **caps))
        target = found.target
        if not goal.has_angle:  # a position says nothing of the rotation on the way: the tool keeps its own
            target = Pose(target.position, robot.forward(start, frame).wxyz)
        elif getattr(goal, "free_axis", None) is not None:  # the rotation that the solution has chosen
            target = Pose(target.position, robot.forward(end, frame).wxyz)
        return Planned(start, line_move(robot, start, target, frame=frame, **caps))

    def move(self, planned: Planned) -> Moved:
        """Sends it, and gives the servos time to arrive."""
        count = max(1, len(planned.trajectory))

        def show(tick: Any) -> None:
            self.show(tick.commanded if tick.measured is None else tick.measured, tick.time)
            self.progress("moving", min(1.0, tick.index / count))

        settle = _SETTLE_SECONDS if self.setup.source is not None else 0.0
        return Moved(
            execute(
                planned.trajectory, self.setup.sinks, source=self.setup.source, clock=self.setup.clock,
                on_tick=show, settle=settle,
            )
        )  # fmt: skip

    def show(self, q: Array, time: float) -> None:
        """The arm at ``q`` (nq,) in scene and window."""
        self.setup.scene.send(q, time)
        if self.window is not None:
            self.window.send(self.setup.scene.q, time)

    def follow(self) -> Followed:
        """Goes on after the marker for the time that was asked for."""
        from robot_ik.execution import follow

        request, setup, robot = self.request, self.setup, self.setup.robot
        behind: list[float] = []

        def show(tick: Any) -> None:
            q = tick.q if tick.measured is None else tick.measured
            self.show(q, tick.time)
            if isinstance(tick.goal, PoseGoal | PositionGoal):  # not while parking
                position = robot.forward(q, setup.frame).position
                behind.append(float(np.linalg.norm(position - tick.goal.target.position)))
            self.progress("following", min(1.0, tick.time / request.follow))

        with self.camera.following(setup.clock, request.follow) as goals:
            following = follow(
                goals, robot, self.method, setup.sinks, rate=setup.rate, clock=setup.clock,
                duration=request.follow, start=setup.commanded, tolerance=SOLVE_TOLERANCE,
                speed=request.speed, source=setup.source, on_tick=show,
            )  # fmt: skip
        setup.settle(_SETTLE_SECONDS)
        return Followed(following, (float(np.median(behind)), max(behind)) if behind else None)

    def read_back(self, found: ReachGoal, tolerance: Tolerance, goal_sigma: Bound) -> Arrived:
        """Judges by the servos' own account."""
        robot, frame, q = self.setup.robot, self.setup.frame, self.setup.q.copy()
        bound = quantisation(robot, q, self.setup.resolution, frame, tolerance)
        judged = judge_read_back(robot, q, found.goal, found.target, frame, bound, goal_sigma)
        return Arrived(q, bound, judged)

    def judge_by_camera(self, found: ReachGoal, arrived: Arrived, goal_sigma: Bound) -> SeenArrived:
        """The camera's view of the gripper."""
        self.progress("looking again", 0.0)
        vision = self.vision
        if vision is None or not vision.sees_arm:
            return SeenArrived(blind="no camera watched the arm" if vision is None else vision.why_blind)
        body = vision.find_gripper()
        if body is None:
            return SeenArrived(after=vision.last_image)
        judged = judge_by_camera(
            body, vision.pose_world_camera, vision.pose_body_tool(self.setup.scene.q), found.goal,
            found.target, arrived.bound, goal_sigma,
        )  # fmt: skip
        return SeenArrived(judged, vision.last_image)


# ------------------------------------------------------------------------------------------
# What is seen of a reach while it runs: the window with its scene.


_FLOOR, _TABLE = (0.82, 0.83, 0.85, 1.0), (0.62, 0.52, 0.42, 1.0)
_WHITE, _BLACK = (0.97, 0.97, 0.97, 1.0), (0.03, 0.03, 0.03, 1.0)
_FLOOR_HALF = 8.0  # metres
_TOP = 0.03  # of the table, metres
_PAPER = 2e-4  # metres, so that what lies on it is not lost in it


def scene_solids(scene: Scene | None) -> list[Solid]:
    """Floor, table and printed marker for the window."""
    table = None if scene is None else scene.table
    floor = 0.0 if table is None else table.floor_height
    found = [Solid(Pose((0.0, 0.0, floor - 0.01)), (_FLOOR_HALF, _FLOOR_HALF, 0.01), _FLOOR)]
    if table is not None:
        middle = (0.5 * sum(table.x), 0.5 * sum(table.y), table.height - 0.5 * _TOP)
        half = (0.5 * (table.x[1] - table.x[0]), 0.5 * (table.y[1] - table.y[0]), 0.5 * _TOP)
        found.append(Solid(Pose(middle), half, _TABLE))
    return found if scene is None else [*found, *_marker(scene)]


def _marker(scene: Scene) -> list[Solid]:
    """White paper, the black square on it, and its white cells on that."""
    bits = marker_bits(scene.dictionary, scene.marker_id)
    cell, h = scene.marker_size / len(bits), 0.5 * scene.marker_size
    at = scene.pose_world_marker

    def sheet(x: float, y: float, half: float, layer: int, colour: tuple[float, ...]) -> Solid:
        return Solid(at.compose(Pose((x, y, layer * _PAPER))), (half, half, 0.5 * _PAPER), colour)

    cells = [
        sheet(-h + (column + 0.5) * cell, h - (row + 0.5) * cell, 0.5 * cell, 3, _WHITE)
        for row, column in np.argwhere(bits > 0).tolist()
    ]
    return [sheet(0.0, 0.0, h + cell, 1, _WHITE), sheet(0.0, 0.0, h, 2, _BLACK), *cells]


def window_scene(robot: Robot, frame: str, scene: Scene | None) -> Scene | None:
    """The scene to show: the camera's, else the robot's own; None where there is none."""
    if scene is not None:
        return scene
    try:
        return scene_for(robot, frame)
    except CameraError:
        return None
