"""The main job: a marker is seen, the arm reaches it, a camera says how far it really is from the goal."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.camera.image import marker_bits
from robot_ik.camera.lost_policy import LostPolicy
from robot_ik.errors import NOT_ACHIEVED_ERRORS, CameraError, ConfigError, RobotIkError
from robot_ik.execution import Execution, FollowReport, execute, follow
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.jobs import Progress
from robot_ik.jobs.precompile import Precompilation
from robot_ik.jobs.recording import open_recording
from robot_ik.jobs.robot_setup import ArmRequest, RobotSetup, prepare_robot
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.verdict import (
    EXACT,
    SIGMAS,
    SOLVE_TOLERANCE,
    Bound,
    Judgement,
    decide,
    judge_by_camera,
    judge_read_back,
    quantisation,
)
from robot_ik.jobs.vision import SeenTarget, Vision, open_vision
from robot_ik.motion.keyframes import column_names
from robot_ik.motion.line import line_move
from robot_ik.motion.trajectory import Trajectory, joint_move
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.robot_file import find_robot
from robot_ik.solution import COLLIDING, Solution
from robot_ik.solvers import solver_name
from robot_ik.testbed.frontends.window import Solid, WindowSink

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance

# ------------------------------------------------------------------------------------------
# What a reach shall do.


@dataclass(frozen=True)
class ReachRequest(ArmRequest):
    """What ``run_reach`` shall do; every default is the embedded demonstration.

    Attributes:
        solver: Name of a method; empty: the robot's own, else ``auto``.
        goal: Instead of a marker.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file of a real camera.
        pose_world_camera: Where a real camera stands; None: where the scene's stands.
        marker_id, marker_size, dictionary: The target; None: the scene's.
        follow: Seconds to go on following the marker; 0: not at all.
        when_lost, lost_after: What to do (``hold``, ``park`` at home, ``stop``) after so many s without it.
        lead: Seconds to predict the marker beyond each tick.
        record: File of all commands and measurements, .csv or .mcap.
        scene: MJCF file of obstacles that the arm must not touch on its way to the goal.
        avoid: Plan a motion around the obstacles and the robot itself. Without ``scene`` the
            obstacles are those of the arm file, if it has any.
    """

    solver: str = ""
    goal: Goal | None = None
    camera: str = "synthetic"
    intrinsics: Path | None = None
    pose_world_camera: Pose | None = None
    marker_id: int | None = None
    marker_size: float | None = None
    dictionary: str | None = None
    bus: str = "pty"
    line: bool = False
    follow: float = 0.0
    when_lost: LostPolicy = "hold"
    lost_after: float = 2.0
    lead: float = 0.0
    record: Path | None = None
    scene: Path | None = None
    avoid: bool = False


# ------------------------------------------------------------------------------------------
# What happened in a reach, as far as it got.


@dataclass(eq=False)
class ReachReport:
    """What happened, as far as it got; fields stay None where it did not get.

    Attributes:
        robot: With the limits that were used.
        frame: What was to reach the goal.
        seen: The target marker in the first picture; None: the goal was given.
        q_start: (nq,) where the arm with torque stood before it moved.
        microseconds: Of a solve with loaded kernels.
        q_end: (nq,) where the servos say that the arm is.
        tolerance: What the solution's error may be; part of ``bound``.
        behind: While following: how far the tool was from the goal of the moment, median and largest, metres.
        problem: Why it ended early: an error that means "not achieved".
        read_back, by_camera: The two judgements.
        blind: Why no camera looked at the arm; empty: one looked.
        before, after: The camera's pictures.
    """

    request: ReachRequest
    robot: Robot
    frame: str
    setup: RobotSetup
    vision: Vision | None
    seen: SeenTarget | None = None
    goal: Goal | None = None
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
    blind: str = ""
    before: Any = None
    after: Any = None
    problem: RobotIkError | None = None
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def target(self) -> Pose | None:
        """The goal's pose in the world."""
        return None if self.goal is None else self.goal.target

    @property
    def decision(self) -> tuple[bool, str]:
        """Did it arrive, and why so; text and exit code are its."""
        if self.problem is not None or self.read_back is None:
            return False, ""
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
        return self.decision[0]

    @property
    def verdict(self) -> str:
        """One sentence on that; empty where ``problem`` says it."""
        return self.decision[1]

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
            f"{joint} is {math.degrees(abs(float(off[worst]))):.2f}° from its command by its registers: "
            "is it held, overloaded or too slow?"
        )


# How long the servos may take to arrive after the last command.
_SETTLE_SECONDS = 0.4


def run_reach(
    request: ReachRequest,
    progress: Progress = lambda phase, share: None,
    done: Callable[[ReachReport], None] = lambda report: None,
) -> ReachReport:
    """Looks, solves, moves, looks again; not reaching the goal is a result (``reached``, ``problem``).

    ``done`` is given the report when the arm has been left; with a window, before its user closes that.

    Raises:
        RobotIkError: Wrong input or environment; nothing was sent to a servo, or the arm was left as its
            exit policy says.
    """
    method = solver_name(request.solver, find_robot(request.robot)[1])
    if request.follow > 0.0 and request.goal is not None:
        raise ConfigError(
            "a goal that is given does not move, so there is nothing to follow",
            file="command line", key="--follow", allowed="without --goal, so that a marker is the goal",
        )  # fmt: skip
    with contextlib.ExitStack() as stack:
        compiling = stack.enter_context(Precompilation.solver(request.robot, method))
        setup = prepare_robot(request)
        if request.record is not None:
            setup.record(stack.enter_context(open_recording(request.record, column_names(setup.robot))))
        vision = open_vision(request, setup, stack)
        window = _window(request, setup, vision, stack)
        report = ReachReport(request, setup.robot, setup.frame, setup, vision)
        collisions = _collisions(request, setup)  # a wrong file is refused before anything moves
        with setup.connected():
            try:
                _Reach(report, window, method, progress, collisions).run(compiling)
            except NOT_ACHIEVED_ERRORS as problem:
                report.problem = problem
            report.counters = setup.counters()
        done(report)
        if window is not None:
            window.wait()
    return report


def _collisions(request: ReachRequest, setup: RobotSetup) -> CollisionAvoidance | None:
    """Return the condition on the motion to the goal; None if the request has none."""
    if request.scene is None and not request.avoid:
        return None
    # Here, because it loads the kernels of collision checks, 50 ms.
    from robot_ik.workcell.motion_condition import motion_condition

    return motion_condition(setup.robot, request.scene, request.avoid, setup.collisions)


def _window(
    request: ReachRequest, setup: RobotSetup, vision: Vision | None, stack: contextlib.ExitStack
) -> Any:
    if not request.view:
        return None
    scene = window_scene(setup.robot, setup.frame, None if vision is None else vision.scene)
    view: dict[str, Any] = {"solids": scene_solids(scene)}
    if scene is not None:
        marker = scene.pose_world_marker
        view["see"] = np.vstack([marker.position, marker.compose(scene.pose_marker_tool).position])
        view["viewpoint"] = scene.pose_world_camera.position
    return stack.enter_context(WindowSink(setup.robot, start=setup.q, **view))


@dataclass(frozen=True, eq=False)
class _Reach:
    """The phases of a reach; each fills in its part of the report."""

    report: ReachReport
    window: Any
    method: str
    progress: Progress
    collisions: CollisionAvoidance | None = None

    @property
    def camera(self) -> Vision:
        """The camera, which there is wherever no goal was given."""
        if self.report.vision is None:
            raise RuntimeError("no goal was given and no camera is open")
        return self.report.vision

    def run(self, compiling: Precompilation) -> None:
        """One phase after the other; what ended is in the report, whatever becomes of the next."""
        report = self.report
        try:
            goal = self.find_goal()
        finally:
            if report.vision is not None:
                report.before = report.vision.last_image
        compiling.wait()
        if self.window is not None:
            self.window.show_goal(goal.target)
        solution = self.solve(goal)
        report.tolerance = self.accept(solution)
        if report.setup.guard is not None:
            self.plan(goal, solution)  # a blocked motion is refused before torque comes on
        report.setup.enable_torque()
        self.move(self.plan(goal, solution))
        goal_sigma = EXACT
        if report.request.follow > 0.0:
            self.follow()
            # What counts is where the marker is now: measured as well as what was followed last.
            goal = self.keep_seen(self.camera.find_target_again())
            goal_sigma = self.known().combined(self.known())
        bound = self.judge_read_back(goal, goal_sigma)
        self.judge_by_camera(goal, bound, goal_sigma)

    def find_goal(self) -> Goal:
        """The goal as given, or of the marker that is seen."""
        goal, vision = self.report.request.goal, self.report.vision
        if goal is not None:
            if vision is not None:
                vision.picture()
            self.report.goal = goal
            return goal
        self.progress("looking", 0.0)
        return self.keep_seen(self.camera.find_target())

    def keep_seen(self, seen: SeenTarget) -> Goal:
        """The goal of a marker, which the report keeps."""
        self.report.seen, self.report.goal = seen, seen.goal
        return seen.goal

    def solve(self, goal: Goal) -> Solution:
        """Finds joint angles for the goal.  Nothing moves."""
        report = self.report
        report.q_start = q = report.setup.q.copy()
        self.progress("solving", 0.0)
        problem = Problem(
            report.robot,
            goal,
            solver=self.method,
            tolerance=SOLVE_TOLERANCE,
            seed=report.request.seed,
            collisions=report.setup.collisions,
        )
        report.solution = problem.solve(q)
        report.microseconds = 1e6 * problem.solve(q).seconds  # the caches are warm now
        return report.solution

    def accept(self, solution: Solution) -> Tolerance:
        """What the solution's error may be: the tolerance, or as much as is not known of a seen goal.

        An arm that moves in a plane cannot go to a marker that is seen some micrometres beside that plane.

        Raises:
            NotConvergedError: It misses both.
        """
        blocked = solution.status in COLLIDING
        if self.report.seen is not None and not solution.converged and not blocked:
            known, error = self.known(), solution.error
            if error.position <= SIGMAS * known.position and error.angle <= SIGMAS * known.angle:
                return Tolerance(
                    position=max(SOLVE_TOLERANCE.position, SIGMAS * known.position),
                    angle=max(SOLVE_TOLERANCE.angle, SIGMAS * known.angle),
                )
        solution.require()
        return SOLVE_TOLERANCE

    def known(self) -> Bound:
        """Standard deviation of a seen goal, as the last picture of the marker says it."""
        if self.report.seen is None:
            raise RuntimeError("no marker was seen")
        return self.report.seen.uncertainty(self.camera.scene.pose_marker_tool.position)

    def plan(self, goal: Goal, solution: Solution) -> Trajectory:
        """The way from where the arm with torque stands now."""
        report, setup = self.report, self.report.setup
        report.q_start = start = setup.q.copy()
        caps = setup.caps(report.request.speed)
        if self.collisions is not None:
            caps["collisions"] = self.collisions
        if report.request.avoid:
            # Here, because it loads the kernels of collision checks, 50 ms.
            from robot_ik.motion.plan import plan

            report.trajectory = plan(report.robot, start, solution.q, **caps).require()
            return report.trajectory
        if report.request.line:
            target = goal.target
            asks_angle = goal.weights[1] > 0.0
            if not asks_angle or getattr(goal, "free_axis", None) is not None:
                # Of the rotation nothing is said: the tool keeps its own; or in part: as the solution has it.
                q = solution.q if asks_angle else start
                target = Pose(target.position, report.robot.forward(q, report.frame).wxyz)
            trajectory = line_move(report.robot, start, target, frame=report.frame, **caps)
        else:
            trajectory = joint_move(report.robot, start, solution.q, **caps)
        report.trajectory = setup.checked(trajectory)
        return report.trajectory

    def move(self, trajectory: Trajectory) -> None:
        """Sends it, and gives the servos time to arrive."""
        setup, count = self.report.setup, max(1, len(trajectory))

        def show(tick: Any) -> None:
            self.show(tick.commanded if tick.measured is None else tick.measured, tick.time)
            self.progress("moving", min(1.0, tick.index / count))

        settle = _SETTLE_SECONDS if setup.arm is not None else 0.0
        self.report.execution = execute(
            trajectory, setup.sinks, source=setup.opened, clock=setup.clock, on_tick=show, settle=settle
        )

    def show(self, q: Array, time: float) -> None:
        """The arm at ``q`` (nq,), for camera and window."""
        self.report.setup.shown = q.copy()
        if self.window is not None:
            self.window.send(q, time)

    def follow(self) -> None:
        """Goes on after the marker for the time that was asked for."""
        report, request, setup = self.report, self.report.request, self.report.setup
        behind: list[float] = []

        def show(tick: Any) -> None:
            q = tick.q if tick.measured is None else tick.measured
            self.show(q, tick.time)
            if isinstance(tick.goal, PoseGoal | PositionGoal):  # not while parking
                position = report.robot.forward(q, report.frame).position
                behind.append(float(np.linalg.norm(position - tick.goal.target.position)))
            self.progress("following", min(1.0, tick.time / request.follow))

        with self.camera.following(setup.clock, request.follow) as goals:
            report.following = follow(
                report.robot, goals, sinks=setup.begin_stream(), solver=self.method, rate=setup.rate,
                clock=setup.clock, duration=request.follow, start=setup.commanded, tolerance=SOLVE_TOLERANCE,
                speed=request.speed, source=setup.opened, on_tick=show, collisions=setup.collisions,
            )  # fmt: skip
        setup.repeat(_SETTLE_SECONDS)
        report.behind = (float(np.median(behind)), max(behind)) if behind else None

    def judge_read_back(self, goal: Goal, goal_sigma: Bound) -> Bound:
        """Judges by the servos' own account; what they explain."""
        report, robot, q = self.report, self.report.robot, self.report.setup.q.copy()
        bound = quantisation(robot, q, report.setup.resolution, report.frame, report.tolerance)
        report.q_end, report.bound = q, bound
        report.read_back = judge_read_back(robot, q, goal, report.frame, bound, goal_sigma)
        return bound

    def judge_by_camera(self, goal: Goal, bound: Bound, goal_sigma: Bound) -> None:
        """The camera's view of the gripper."""
        self.progress("looking again", 0.0)
        report, vision = self.report, self.report.vision
        if vision is None or vision.why_blind:
            report.blind = "no camera watched the arm" if vision is None else vision.why_blind
            return
        body = vision.find_gripper()
        report.after = vision.last_image
        if body is not None:
            report.by_camera = judge_by_camera(
                report.robot, body, vision.scene.pose_world_camera,
                vision.pose_body_tool(report.setup.shown), goal, bound, goal_sigma,
            )  # fmt: skip


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
