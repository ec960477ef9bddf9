"""``robot-ik reach``: detect a marker, reach it, and verify the result with a camera.

The phases are functions: prepare, look, solve, move, follow, judge. Each returns its result, and
the report (``reach_report``) keeps the results. It shows how far a run got.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from cyclopts import Group, Parameter
from cyclopts.validators import Number

from robot_ik.commands.arms import default_robot
from robot_ik.commands.options import (
    BUS_HELP,
    BUS_METAVAR,
    DICTIONARY_HELP,
    NO_BUS,
    ArmName,
    BaseName,
    CameraSource,
    ExtrinsicsFile,
    FolderOption,
    FrameName,
    GoalNumbers,
    IntrinsicsFile,
    JointNames,
    JsonOption,
    MarkerSize,
    RecordFile,
    RobotName,
    SceneFile,
    Seconds,
    Seed,
    SolverName,
    Speed,
    VideoFile,
    parse_goal,
    parse_pairs,
)
from robot_ik.commands.reach_report import Followed, Judged, ReachReport, Solved
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import NOT_ACHIEVED_ERRORS, OptionError

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.execution import Execution
    from robot_ik.geometry import Pose
    from robot_ik.goals import Goal, Tolerance
    from robot_ik.motion.trajectory import Trajectory
    from robot_ik.ports import Array
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution
    from robot_ik.workcell.marker_turn import AxisPrediction
    from robot_ik.workcell.robot_setup import Rehearsal, RobotSetup
    from robot_ik.workcell.verdict import Bound
    from robot_ik.workcell.vision import SeenTarget, Vision

# The phases import MuJoCo, Numba and OpenCV: 1.1 s of CPU time. --help takes 0.1 s without them.

SETTLE_SECONDS = 0.4
"""Time for the servos to arrive after the last command."""

FAULTS = ("zero-offset:JOINT=DEG", "stuck:JOINT", "cover-gripper", "blank-marker")
"""The forms of ``--fault``."""

_CAMERA = Group("Camera and marker", sort_key=2)
_ARM = Group("Arm", sort_key=3)
_SIMULATION = Group("Simulation", sort_key=4)


@dataclass(frozen=True, kw_only=True)
class Reach(FolderOption, JsonOption):
    """Detect a marker, move the tool in front of it, and verify the result with a camera.

    By default everything is simulated, but the real driver code runs: a synthetic camera, the PUMA
    560, and six virtual servos behind a serial line (a pty).

    Exit code 0: servos and camera agree that the goal is reached. 1: it is not reached, or the
    result is not verified. 2: wrong input, and nothing was sent to a servo.
    """

    FILES: ClassVar[tuple[str, ...]] = ("reach.png", "trajectory.csv", "summary.json")

    robot: RobotName = ""
    goal: GoalNumbers = ()
    frame: FrameName = None
    base: BaseName = None
    joints: JointNames = ()
    solver: SolverName = ""
    line: bool = False
    """Move the tool on a straight line."""
    scene: SceneFile = None
    avoid: bool = False
    """Plan a motion around the robot itself and the obstacles of --scene, or of the arm file."""
    follow: Annotated[Seconds | None, Parameter(metavar="S")] = None
    """Follow the marker for this time after reaching it, in seconds."""
    max_angle_deg: Annotated[
        float | None, Parameter(metavar="DEG", validator=Number(gte=0.0, lte=180.0))
    ] = None
    """Largest angle that an arm with five joints may leave to the axis of the marker, in degrees.
    With a larger angle nothing moves. Default: any angle."""
    when_lost: Literal["hold", "park", "stop"] = "hold"
    """What to do if the marker is lost for 2 s while following."""

    camera: Annotated[CameraSource, Parameter(group=_CAMERA)] = "synthetic"
    intrinsics: Annotated[IntrinsicsFile, Parameter(group=_CAMERA)] = None
    extrinsics: Annotated[ExtrinsicsFile, Parameter(group=_CAMERA)] = None
    marker: Annotated[int | None, Parameter(metavar="ID", group=_CAMERA)] = None
    """Id of the target marker. All others are ignored. Default: the scene's."""
    marker_size: Annotated[MarkerSize, Parameter(group=_CAMERA)] = None
    dictionary: Annotated[
        str | None,
        Parameter(
            metavar="NAME", group=_CAMERA, help=f"{DICTIONARY_HELP} Default: that of the scene."
        ),
    ] = None

    bus: Annotated[
        str,
        Parameter(
            alias="--port",
            metavar=f"{BUS_METAVAR}|{NO_BUS}",
            group=_ARM,
            help=f"Servo bus. {BUS_HELP}; none: no servos.",
        ),
    ] = "pty"
    arm: Annotated[ArmName, Parameter(group=_ARM)] = ""
    speed: Annotated[Speed, Parameter(group=_ARM)] = 1.0

    fault: Annotated[
        tuple[str, ...],
        Parameter(
            metavar="KIND[:JOINT[=DEG]] …",
            consume_multiple=True,
            allow_repeating=True,
            group=_SIMULATION,
        ),
    ] = ()
    """Faults to inject. For example stuck:joint3, zero-offset:joint2=2, or cover-gripper."""
    marker_at: Annotated[
        tuple[float, ...],
        Parameter(metavar="X Y Z [YAW_DEG]", consume_multiple=True, group=_SIMULATION),
    ] = ()
    """Position of the printed marker in metres, and its rotation about the vertical in degrees."""
    seed: Annotated[Seed, Parameter(group=_SIMULATION)] = 0

    viewer: bool = False
    """Show the motion live. A MuJoCo window, which stays open until you close it."""
    video: VideoFile = None
    record: RecordFile = None

    @property
    def robot_name(self) -> str:
        """Robot of the options, else of the arm file, else of the bus."""
        return self.robot or default_robot(self.arm, self.bus)

    def run(self, terminal: Terminal = QUIET) -> ReachReport:
        """Run all phases, write the files, and report.

        Raises:
            RobotIkError: The input or the environment is wrong. Nothing was sent to a servo, or the
                arm was left by its exit policy.
        """
        folder = self.result_folder(terminal)
        with ExitStack() as stack:
            cell = prepare(self, stack)
            report = ReachReport(self, cell.setup, cell.vision)
            with cell.setup.connected():
                try:
                    carry_out(cell, report, terminal)
                except NOT_ACHIEVED_ERRORS as error:
                    report.error = error
                report.counters = cell.setup.counters()
            terminal.progress("writing files")
            report.save(folder)
            terminal.show(report)
            if cell.window is not None:
                terminal.say("close the window to end", "dim")
                cell.window.wait()
        return report


@dataclass(frozen=True, eq=False)
class Cell:
    """Everything that is open during a run.

    Attributes:
        command: The options.
        solver: Name of the solver.
        setup: Robot and servos.
        vision: Camera. None if a goal is given and no camera can watch.
        window: Window of ``--viewer``, or None.
        compilation: Compiles the solver in another process meanwhile.
        collisions: Condition on the motion to the goal, from ``--scene`` and ``--avoid``.
    """

    command: Reach
    solver: str
    setup: RobotSetup
    vision: Vision | None
    window: Any
    compilation: Any
    collisions: CollisionAvoidance | None

    @property
    def camera(self) -> Vision:
        """The camera, which exists if no goal is given."""
        if self.vision is None:
            raise RuntimeError("no goal is given and no camera is open")
        return self.vision


def prepare(command: Reach, stack: ExitStack) -> Cell:
    """Open robot, servos, camera and window. Nothing moves.

    Raises:
        RobotIkError: An option, a file or a device is wrong.
    """
    from robot_ik.motion.keyframes import column_names
    from robot_ik.motion.recording import open_recording
    from robot_ik.robot_file import find_robot
    from robot_ik.solvers import solver_name
    from robot_ik.workcell.films import require_films
    from robot_ik.workcell.precompile import precompile_solver
    from robot_ik.workcell.robot_setup import ArmRequest, prepare_robot
    from robot_ik.workcell.vision import CameraRequest, open_vision

    goal = parse_goal(command.goal, command.frame) if command.goal else None
    faults = parse_faults(command.fault, command.marker_at)
    pose_world_camera = load_camera_pose(command)
    require_possible(command)
    if command.video is not None:
        require_films("a video of the reach")

    robot = command.robot_name
    solver = solver_name(command.solver, find_robot(robot)[1])
    compilation = stack.enter_context(precompile_solver(robot, solver))
    setup = prepare_robot(
        ArmRequest(
            robot=robot,
            frame=command.frame,
            bus=command.bus,
            arm_file=Path(command.arm) if command.arm else None,
            speed=command.speed,
            seed=command.seed,
            view=command.viewer,
            rehearsal=faults,
        )
    )
    if command.record is not None:
        recording = open_recording(command.record, column_names(setup.robot))
        setup.record(stack.enter_context(recording))
    vision = open_vision(
        CameraRequest(
            rehearsal=faults,
            camera=command.camera,
            goal=goal,
            intrinsics=command.intrinsics,
            pose_world_camera=pose_world_camera,
            marker_id=command.marker,
            marker_size=command.marker_size,
            dictionary=command.dictionary,
            follow=command.follow or 0.0,
            when_lost=command.when_lost,
            seed=command.seed,
        ),
        setup,
        stack,
    )
    window = open_window(setup, vision, stack) if command.viewer else None
    collisions = None
    if command.scene is not None or command.avoid:
        from robot_ik.workcell.motion_condition import motion_condition  # kernels: 50 ms

        arm_condition = setup.collisions
        collisions = motion_condition(setup.robot, command.scene, command.avoid, arm_condition)
    return Cell(command, solver, setup, vision, window, compilation, collisions)


def require_possible(command: Reach) -> None:
    """Check the options that exclude each other.

    Raises:
        OptionError: Two options cannot be used together.
    """
    if command.follow is not None and command.goal:
        raise OptionError("--follow", "a given goal does not move", "without --goal")
    if command.follow is not None and command.video is not None:
        raise OptionError("--video", "it shows the motion to a fixed goal", "without --follow")
    if command.follow is not None and (command.scene or command.avoid):
        problem = "the obstacles of --scene are not used while following"
        raise OptionError("--follow", problem, "without --scene and --avoid")
    if command.joints or command.base:
        others = ("follow", "line", "scene", "avoid")
        used = next((name for name in others if getattr(command, name)), None)
        if used is not None:
            problem = "held joints are supported for one motion to a goal only"
            raise OptionError("--joints", problem, f"without --{used}")
    if command.avoid and command.line:
        raise OptionError("--line", "a planned motion is not straight", "without --avoid")


def carry_out(cell: Cell, report: ReachReport, terminal: Terminal) -> None:
    """Run the phases one after the other, and keep each result in the report."""
    from robot_ik.workcell.verdict import EXACT

    setup = cell.setup
    try:
        report.goal, report.seen = look(cell, terminal)
    finally:
        report.before = None if cell.vision is None else cell.vision.last_image
    cell.compilation.wait()
    if cell.window is not None:
        cell.window.show_goal(report.goal.target)

    terminal.progress("solving")
    report.q_start = setup.q.copy()
    report.solved = solve(cell, report.goal)
    solution = report.solved.solution
    tolerance = accepted_error(cell, report.seen, solution)
    report.accepted = tolerance
    report.prediction = predict(cell, report.goal, report.seen, solution, terminal)
    if setup.guard is not None:
        plan_motion(cell, report.goal, solution)  # a blocked motion is refused before torque is on

    setup.enable_torque()
    report.q_start = setup.q.copy()
    report.trajectory = plan_motion(cell, report.goal, solution)
    report.execution = move(cell, report.trajectory, terminal)
    sigma = EXACT
    if cell.command.follow is not None:
        report.followed = follow(cell, cell.command.follow, terminal)
        # The verdict is about the marker's last position, measured as well as the goal before.
        report.seen = cell.camera.find_target_again()
        report.goal = report.seen.goal
        sigma = goal_sigma(cell, report.seen).combined(goal_sigma(cell, report.seen))

    terminal.progress("looking again")
    best_angle = 0.0
    if report.prediction is not None:
        best_angle = report.prediction.angle
        if report.followed is not None:
            best_angle = solve(cell, report.goal).solution.error.angle
    report.judged = judge(cell, report.goal, tolerance, sigma, best_angle)


def look(cell: Cell, terminal: Terminal) -> tuple[Goal, SeenTarget | None]:
    """Return the given goal, or the goal of the marker in the next pictures and its sighting.

    Raises:
        MarkerNotFoundError: The marker is not in view, or its orientation is ambiguous.
    """
    if cell.command.goal:
        if cell.vision is not None:
            cell.vision.picture()
        return parse_goal(cell.command.goal, cell.command.frame), None
    terminal.progress("looking")
    seen = cell.camera.find_target()
    return seen.goal, seen


def solve(cell: Cell, goal: Goal) -> Solved:
    """Find joint angles for the goal. Nothing moves."""
    from robot_ik.problem import Problem
    from robot_ik.workcell.verdict import SOLVE_TOLERANCE

    problem = Problem(
        moving_robot(cell),
        goal,
        solver=cell.solver,
        tolerance=SOLVE_TOLERANCE,
        seed=cell.command.seed,
        collisions=cell.setup.collisions,
    )
    q = cell.setup.q.copy()
    solution = problem.solve(q)
    # The first solve of a process loads or compiles the kernel. The second is timed.
    return Solved(solution, 1e6 * problem.solve(q).seconds)


def moving_robot(cell: Cell) -> Robot:
    """Return the robot, with the joints held that --base and --joints do not name.

    Raises:
        RobotIkError: There is no such frame or joint, or no joint would move the frame.
    """
    robot = cell.setup.robot
    command = cell.command
    if not command.base and not command.joints:
        return robot
    chosen = robot.with_parts(tool=cell.setup.frame, base=command.base, joints=command.joints)
    held = [joint for joint in robot.joints if joint not in chosen.joints]
    return robot.with_held(held, cell.setup.q)


def accepted_error(cell: Cell, seen: SeenTarget | None, solution: Solution) -> Tolerance:
    """Return the error that is accepted: the tolerance, or the uncertainty of a seen goal.

    A planar arm cannot go to a marker that is measured some micrometres beside its plane.

    Raises:
        NotConvergedError: The error of the solution is larger than both.
    """
    from robot_ik.goals import Tolerance
    from robot_ik.solution import COLLIDING
    from robot_ik.workcell.verdict import SIGMAS, SOLVE_TOLERANCE

    if seen is not None and not solution.converged and solution.status not in COLLIDING:
        sigma = goal_sigma(cell, seen)
        position = SIGMAS * sigma.position
        angle = SIGMAS * sigma.angle
        if solution.error.position <= position and solution.error.angle <= angle:
            return Tolerance(
                position=max(SOLVE_TOLERANCE.position, position),
                angle=max(SOLVE_TOLERANCE.angle, angle),
            )
    solution.require()
    return SOLVE_TOLERANCE


def predict(
    cell: Cell, goal: Goal, seen: SeenTarget | None, solution: Solution, terminal: Terminal
) -> AxisPrediction | None:
    """Return the predicted axis error, and print it if the axis is not met.

    Raises:
        NotConvergedError: The angle is larger than ``--max-angle-deg``.
    """
    from robot_ik.workcell.marker_turn import predict_axis, require_angle

    marker = None if seen is None else seen.pose_world_marker
    axis = predict_axis(cell.setup.robot, goal, solution, marker)
    limit = cell.command.max_angle_deg
    require_angle(axis, None if limit is None else math.radians(limit), solution)
    if axis is not None and not axis.is_met:
        terminal.say(axis.sentence())
    return axis


def goal_sigma(cell: Cell, seen: SeenTarget) -> Bound:
    """Return the standard deviation of the goal of a seen marker."""
    return seen.uncertainty(cell.camera.scene.pose_marker_tool.position)


def plan_motion(cell: Cell, goal: Goal, solution: Solution) -> Trajectory:
    """Return the motion from the present pose to the solution.

    Raises:
        MotionBlockedError: It would touch an obstacle, or come too near.
        PlanningError: No motion around the obstacles was found.
    """
    from robot_ik.motion.line import line_move
    from robot_ik.motion.trajectory import joint_move

    setup = cell.setup
    start = setup.q.copy()
    limits = setup.caps(cell.command.speed)
    if cell.collisions is not None:
        limits["collisions"] = cell.collisions
    if cell.command.avoid:
        from robot_ik.motion.plan import plan  # collision kernels: 50 ms

        return plan(setup.robot, start, solution.q, **limits).require()
    if cell.command.line:
        pose = line_target(cell, goal, solution, start)
        trajectory = line_move(setup.robot, start, pose, frame=setup.frame, **limits)
    else:
        trajectory = joint_move(setup.robot, start, solution.q, **limits)
    return setup.checked(trajectory)


def move(cell: Cell, trajectory: Trajectory, terminal: Terminal) -> Execution:
    """Send the trajectory, and let the servos arrive."""
    from robot_ik.execution import execute

    setup = cell.setup
    ticks = max(1, len(trajectory))

    def on_tick(tick: Any) -> None:
        show_pose(cell, tick.commanded if tick.measured is None else tick.measured, tick.time)
        terminal.progress("moving", min(1.0, tick.index / ticks))

    return execute(
        trajectory,
        setup.sinks,
        source=setup.opened,
        clock=setup.clock,
        on_tick=on_tick,
        settle=0.0 if setup.arm is None else SETTLE_SECONDS,
    )


def line_target(cell: Cell, goal: Goal, solution: Solution, start: Array) -> Pose:
    """Return the end of a straight line: a full pose, also where the goal leaves rotation free."""
    from robot_ik.geometry import Pose

    has_angle = goal.weights[1] > 0.0
    if has_angle and getattr(goal, "free_axis", None) is None:
        return goal.target
    # Without an angle the tool keeps its orientation; with a free axis it takes the solution's.
    q = solution.q if has_angle else start
    return Pose(goal.target.position, cell.setup.robot.forward(q, cell.setup.frame).wxyz)


def follow(cell: Cell, seconds: float, terminal: Terminal) -> Followed:
    """Follow the marker for some time."""
    import numpy as np

    from robot_ik.execution import follow as follow_goals
    from robot_ik.goals import PoseGoal, PositionGoal
    from robot_ik.workcell.verdict import SOLVE_TOLERANCE

    setup = cell.setup
    distances: list[float] = []

    def on_tick(tick: Any) -> None:
        q = tick.q if tick.measured is None else tick.measured
        show_pose(cell, q, tick.time)
        if isinstance(tick.goal, PoseGoal | PositionGoal):  # another kind while parking
            position = setup.robot.forward(q, setup.frame).position
            distances.append(float(np.linalg.norm(position - tick.goal.target.position)))
        terminal.progress("following", min(1.0, tick.time / seconds))

    with cell.camera.following(setup.clock, seconds) as goals:
        ticks = follow_goals(
            setup.robot,
            goals,
            sinks=setup.begin_stream(),
            solver=cell.solver,
            rate=setup.rate,
            clock=setup.clock,
            duration=seconds,
            start=setup.commanded,
            tolerance=SOLVE_TOLERANCE,
            speed=cell.command.speed,
            source=setup.opened,
            on_tick=on_tick,
            collisions=setup.collisions,
        )
    setup.repeat(SETTLE_SECONDS)
    median = float(np.median(distances)) if distances else None
    return Followed(ticks, median, max(distances, default=None))


def judge(
    cell: Cell, goal: Goal, tolerance: Tolerance, sigma: Bound, best_angle: float = 0.0
) -> Judged:
    """Measure the error by the servos' positions and, independently, by the camera.

    Args:
        cell: Everything that is open.
        goal: The goal.
        tolerance: Accepted error of the solution.
        sigma: Standard deviation of the goal.
        best_angle: Predicted angle between both axes, rad.
    """
    from robot_ik.workcell.verdict import judge_by_camera, judge_read_back, quantisation

    setup = cell.setup
    vision = cell.vision
    q = setup.q.copy()
    bound = quantisation(setup.robot, q, setup.resolution, setup.frame, tolerance)
    read_back = judge_read_back(setup.robot, q, goal, setup.frame, bound, sigma, best_angle)
    if vision is None or vision.why_blind:
        blind = "no camera watched the arm" if vision is None else vision.why_blind
        return Judged(q, bound, read_back, None, blind, None)
    body = vision.find_gripper()
    by_camera = None
    if body is not None:
        pose_body_tool = vision.pose_body_tool(setup.shown)
        camera = vision.scene.pose_world_camera
        by_camera = judge_by_camera(
            setup.robot, body, camera, pose_body_tool, goal, bound, sigma, best_angle
        )
    return Judged(q, bound, read_back, by_camera, "", vision.last_image)


def show_pose(cell: Cell, q: Array, time: float) -> None:
    """Show the arm at ``q`` (nq,) to the synthetic camera and in the window."""
    cell.setup.shown = q.copy()
    if cell.window is not None:
        cell.window.send(q, time)


def open_window(setup: RobotSetup, vision: Vision | None, stack: ExitStack) -> Any:
    """Open a MuJoCo window with the robot and its scene."""
    import numpy as np

    from robot_ik.testbed.frontends.scene_window import scene_solids, window_scene
    from robot_ik.testbed.frontends.window import WindowSink

    scene = window_scene(setup.robot, setup.frame, None if vision is None else vision.scene)
    view: dict[str, Any] = {"solids": scene_solids(scene)}
    if scene is not None:
        marker = scene.pose_world_marker
        tool = marker.compose(scene.pose_marker_tool)
        view["see"] = np.vstack([marker.position, tool.position])
        view["viewpoint"] = scene.pose_world_camera.position
    return stack.enter_context(WindowSink(setup.robot, start=setup.q, **view))


def parse_faults(items: Iterable[str], marker_at: tuple[float, ...]) -> Rehearsal:
    """Return the faults of ``--fault`` and the marker pose of ``--marker-at``.

    Raises:
        OptionError: An item has another form.
    """
    from robot_ik.workcell.robot_setup import Rehearsal

    offsets: list[str] = []
    stuck: list[str] = []
    conditions: set[str] = set()
    for item in items:
        kind, _, rest = item.replace("_", "-").partition(":")
        target = item[len(kind) + 1 :]
        if kind == "zero-offset":
            offsets.append(target)
        elif kind == "stuck" and rest:
            stuck.append(target)
        elif kind in ("cover-gripper", "blank-marker") and not rest:
            conditions.add(kind)
        else:
            raise OptionError("--fault", f"cannot read {item!r}", ", ".join(FAULTS))
    if len(marker_at) not in (0, 3, 4) or not all(map(math.isfinite, marker_at)):
        given = " ".join(f"{number:g}" for number in marker_at)
        raise OptionError("--marker-at", f"cannot use {given}", "X Y Z in metres [YAW in degrees]")
    return Rehearsal(
        zero_offset_deg=parse_pairs("--fault", offsets, "zero-offset:JOINT=DEG"),
        stuck=tuple(stuck),
        cover_gripper="cover-gripper" in conditions,
        blank_marker="blank-marker" in conditions,
        marker_at=marker_at or None,
    )


def load_camera_pose(command: Reach) -> Pose | None:
    """Return the pose of a real camera from ``--extrinsics``.

    Raises:
        OptionError: The camera is synthetic, or there is no calibration for the file.
    """
    for name in ("intrinsics", "extrinsics"):
        if command.camera == "synthetic" and getattr(command, name) is not None:
            raise OptionError(
                f"--{name}", "the synthetic camera uses the robot's scene", "with a real --camera"
            )
    if command.extrinsics is None:
        return None
    if command.intrinsics is None:
        raise OptionError("--extrinsics", "the calibration is missing", "with --intrinsics FILE")

    from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
    from robot_ik.camera.intrinsics import CameraIntrinsics

    intrinsics = CameraIntrinsics.load(command.intrinsics)
    extrinsics = CameraExtrinsics.load(command.extrinsics, intrinsics)
    extrinsics.require_parent("world")
    return extrinsics.pose_parent_camera
