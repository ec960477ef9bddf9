"""The main job: a marker is seen, the arm reaches it, a camera says how far it really is from the goal."""

from __future__ import annotations

import contextlib
import importlib.util
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.image import marker_bits
from robot_ik.camera.marker_goals import LostPolicy
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.errors import (
    CameraError,
    ConfigError,
    MarkerNotFoundError,
    MissingExtraError,
    MotorFaultError,
    NotConvergedError,
    RobotIkError,
    TrajectoryError,
)
from robot_ik.execution import Execution, FollowReport, execute
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.jobs.ar.output import Film
from robot_ik.jobs.precompile import CompiledAhead
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


Progress = Callable[[str, float], None]


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
        ahead = stack.enter_context(CompiledAhead.solver(request.robot, method))
        setup = prepare_robot(request)
        frame = setup.frame
        if request.record is not None:
            setup.record(stack.enter_context(open_recording(request.record, setup.robot.joints)))
        vision = open_vision(request, setup, frame, stack)
        window = _window(request, setup, vision, stack)
        report = ReachReport(request, setup.robot, frame, setup, vision)
        with setup.connected():
            try:
                _look(report, progress)
                ahead.wait()
                if window is not None and report.target is not None:
                    window.show_goal(report.target)
                _solve(report, method, progress)
                setup.energise()
                _reach(report, window, progress)
            except _NOT_ACHIEVED as problem:
                report.problem = problem
            report.counters = setup.counters()
        done(report)
        if window is not None:
            window.wait()
    return report


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
        view["eye"] = scene.pose_world_camera.position
    return stack.enter_context(WindowSink(setup.robot, start=setup.q, **view))


def _look(report: ReachReport, progress: Progress) -> None:
    """Finds the goal, by eye or as given."""
    request, vision = report.request, report.vision
    if request.goal is not None:
        report.goal = request.goal
        if vision is not None:
            report.before = vision.picture()
    else:
        assert vision is not None  # open_vision made some, because there is no other goal
        progress("looking", 0.0)
        try:
            report.seen = vision.find_target()
        finally:
            report.before = vision.last_image
        report.goal = report.seen.goal
        if request.follow > 0.0:
            vision.get_ready_to_follow()
    report.target = report.goal.target


def _solve(report: ReachReport, method: str, progress: Progress) -> None:
    """Finds joint angles for the goal.  Nothing moves."""
    assert report.goal is not None
    report.q_start = report.setup.q.copy()
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
    assert report.seen is not None and report.vision is not None
    return report.seen.uncertainty(report.vision.scene.pose_marker_tool.position)


def _reach(report: ReachReport, window: Any, progress: Progress) -> None:
    """Moves there, follows if asked to, and judges."""
    request, robot, setup = report.request, report.robot, report.setup
    assert report.solution is not None and report.goal is not None and report.target is not None
    report.q_start = setup.q.copy()
    report.trajectory = _plan(report)
    count = len(report.trajectory)

    def show(tick: Any) -> None:
        setup.scene.send(tick.commanded if tick.measured is None else tick.measured, tick.time)
        if window is not None:
            window.send(setup.scene.q, tick.time)
        progress("moving", min(1.0, tick.index / max(1, count)))

    report.execution = execute(
        report.trajectory,
        setup.sinks,
        source=setup.source,
        clock=setup.clock,
        on_tick=show,
        settle=_SETTLE_SECONDS if setup.source is not None else 0.0,
    )
    if request.follow > 0.0:
        _follow(report, window, progress)
    report.q_end = setup.q.copy()
    report.bound = quantisation(robot, report.q_end, setup.resolution, report.frame, report.tolerance)
    report.read_back = judge_read_back(
        robot, report.q_end, report.goal, report.target, report.frame, report.bound, report.goal_sigma
    )
    progress("looking again", 0.0)
    _judge(report)


def _plan(report: ReachReport) -> Trajectory:
    request, setup = report.request, report.setup
    assert report.solution is not None and report.target is not None and report.q_start is not None
    caps: dict[str, Any] = {
        "velocity": setup.velocity,
        "acceleration": setup.acceleration,
        "rate": setup.rate,
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

    request, setup, vision = report.request, report.setup, report.vision
    assert vision is not None  # without a goal there is a camera

    behind: list[float] = []

    def show(tick: Any) -> None:
        q = tick.q if tick.measured is None else tick.measured
        setup.scene.send(q, tick.time)
        if isinstance(tick.goal, PoseGoal | PositionGoal):  # not while parking
            place = report.robot.forward(q, report.frame).position
            behind.append(float(np.linalg.norm(place - tick.goal.target.position)))
        if window is not None:
            window.send(setup.scene.q, tick.time)
        progress("following", min(1.0, tick.time / request.follow))

    with vision.following(setup.clock, request.follow) as goals:
        report.following = follow(
            goals,
            report.robot,
            request.solver or report.robot.file.solver or "auto",
            setup.sinks,
            rate=setup.rate,
            clock=setup.clock,
            duration=request.follow,
            start=setup.commanded,
            tolerance=SOLVE_TOLERANCE,
            speed=request.speed,
            source=setup.source,
            on_tick=show,
        )
    if behind:
        report.behind = float(np.median(behind)), float(np.max(behind))
    setup.settle(_SETTLE_SECONDS)
    # What counts in the end is where the marker is now.
    report.seen = vision.find_target_again()
    report.goal, report.target = report.seen.goal, report.seen.goal.target
    # Two measurements of the marker: the one that was followed last, no better than this, and this one.
    report.goal_sigma = _known(report).combined(_known(report))


def _judge(report: ReachReport) -> None:
    """The camera's look at the gripper."""
    vision, setup = report.vision, report.setup
    if vision is None or not vision.sees_arm:
        report.blind = "no camera watched the arm" if vision is None else vision.why_blind
        return
    body = vision.find_gripper()
    report.after = vision.last_image
    if body is None:
        return
    assert report.goal is not None and report.target is not None and report.bound is not None
    report.by_camera = judge_by_camera(
        body, vision.pose_world_camera, vision.pose_body_tool(setup.scene.q), report.goal, report.target,
        report.bound, report.goal_sigma,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------
# What is seen of a reach while it runs: the window with its scene, and the film.


FILM_RATE_HZ = 25.0
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


def require_films() -> None:
    """Raises ``MissingExtraError`` where no film can be written."""
    if importlib.util.find_spec("av") is None:
        raise MissingExtraError("av", "video", "a film of the reach")


def save_film(report: ReachReport, path: Path) -> Path | None:
    """The motion as the scene's camera sees it; None where nothing moved.

    Raises:
        MissingExtraError: The extra ``video`` is not installed.
        OutputError: It cannot be written.
    """
    run = report.execution
    scene = window_scene(report.robot, report.frame, None if report.vision is None else report.vision.scene)
    if run is None or scene is None:
        return None
    q = run.commanded if run.measured is None else run.measured
    shown = [q[0]]
    times = np.arange(run.times[0], run.times[-1] + 1.0 / FILM_RATE_HZ, 1.0 / FILM_RATE_HZ)
    source = SyntheticSource(scene.synthetic(report.robot), lambda: shown[0], seed=0, quality="fast")
    with Film(path, FILM_RATE_HZ) as film:
        for time in times.tolist():
            shown[0] = q[min(int(np.searchsorted(run.times, time)), len(q) - 1)]
            film.write(source.read().image, time)
    return path
