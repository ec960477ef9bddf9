"""What a step of a script may say: one class a kind, all of them in ``STEPS``.

Lengths are metres, angles degrees (``_deg``), tolerances millimetres and degrees, times seconds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import mujoco
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from robot_ik.errors import apart
from robot_ik.execution import follow
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.hardware.arm import ArmState
from robot_ik.jobs.reach import SOLVE_TOLERANCE
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.state import RunState, Script, StepFailed, error_classes
from robot_ik.motion.line import line_move
from robot_ik.motion.sources import CurveSource
from robot_ik.motion.trajectory import joint_move
from robot_ik.problem import Problem
from robot_ik.solvers import make_solver

if TYPE_CHECKING:
    from robot_ik.execution import FollowReport
    from robot_ik.hardware.joint_map import JointMap
    from robot_ik.jobs.robot_setup import RobotSetup
    from robot_ik.ports import Array
    from robot_ik.robot import Robot


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
# A day: a script that waits longer waits for something else.
_LONGEST = 86_400.0
_Seconds = Annotated[float, Field(gt=0.0, le=_LONGEST, allow_inf_nan=False)]
_Place = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Turn = Annotated[list[_Number], Field(min_length=4, max_length=4)]
_Span = Annotated[list[_NotNegative], Field(min_length=2, max_length=2)]
_Share = Annotated[float, Field(gt=0.0, le=1.0)]
_Word = Annotated[str, Field(min_length=1)]


class Table(BaseModel):
    """A table of a script: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Step(Table):
    """What every step has.

    Attributes:
        name: For the report; by default what the step does.
    """

    name: str = ""


class Action(Step):
    """A step that takes time.

    Attributes:
        time_limit_s: The step fails when it takes longer.
        raises: Class of the error with which it must end; without it, an error is a failure.
    """

    time_limit_s: _Seconds | None = None
    raises: _Word | None = None


class _Move(Action):
    """A planned motion; it is over when the servos have arrived within the tolerance.

    Attributes:
        speed: Share of the speed limits.
        tolerance_mm, tolerance_deg: Of the frame; or of each slide, and of each other joint.
    """

    speed: _Share | None = None
    tolerance_mm: _Positive = 2.0
    tolerance_deg: _Positive = 0.5


class PoseStep(_Move):
    """The frame goes to a position and an orientation, straight in joint space."""

    do: Literal["pose"]
    position: _Place
    wxyz: _Turn
    frame: str | None = None


class PositionStep(_Move):
    """The frame's origin goes to a position, however it is turned."""

    do: Literal["position"]
    position: _Place
    frame: str | None = None


class LineStep(_Move):
    """The frame moves on a straight line, to a position or by a vector, and keeps its turn unless told."""

    do: Literal["line"]
    position: _Place | None = None
    by: _Place | None = None
    wxyz: _Turn | None = None
    frame: str | None = None
    linear_speed: _Positive = 0.25


class JointsStep(_Move):
    """Joints go to angles, slides to millimetres; those that are not named stay."""

    do: Literal["joints"]
    joints_deg: Annotated[dict[str, _Number], Field(min_length=1)] | None = None
    joints_mm: Annotated[dict[str, _Number], Field(min_length=1)] | None = None


class KeyframeStep(_Move):
    """All joints go to a keyframe of the model."""

    do: Literal["keyframe"]
    keyframe: _Word = "home"


class MarkerStep(_Move):
    """The synthetic camera looks for the printed marker, and the tool goes above it."""

    do: Literal["marker"]


class GripStep(_Move):
    """The gripper opens or closes: to a share of its range, or to a width.

    Attributes:
        opening: 0 closed, 1 open; ``width_mm``: instead, between two fingers that slide.
        force_n: How hard each finger presses from here on, where the servo can be told.
        held: Whether something must be between the fingers then; without it, either is right.
    """

    do: Literal["grip"]
    opening: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    width_mm: _NotNegative | None = None
    force_n: _Positive | None = None
    held: bool | None = None


class FollowStep(Action):
    """The frame follows a goal that moves: round a circle, an eight, or the printed marker.

    Attributes:
        catch_up_s: From here on the frame must be within ``tolerance_mm`` of the goal at every tick.
    """

    do: Literal["follow"]
    path: Literal["circle", "eight", "marker"]
    seconds: _Seconds
    center: _Place | None = None
    radius: _Positive | None = None
    period: _Positive | None = None
    normal: _Place | None = None
    wxyz: _Turn | None = None
    frame: str | None = None
    speed: _Share | None = None
    catch_up_s: _NotNegative = 1.0
    tolerance_mm: _Positive = 10.0


class WaitStep(Action):
    """The arm stays where it was sent to."""

    do: Literal["wait"]
    seconds: Annotated[float, Field(ge=0.0, le=_LONGEST, allow_inf_nan=False)]


class HoldStep(Action):
    """The arm holds where it is."""

    do: Literal["hold"]


class RecoverStep(Action):
    """Out of a fault: port opened, servos restarted, everything verified anew; then torque again."""

    do: Literal["recover"]


class InjectStep(Step):
    """Lets a fault of the virtual bus happen.

    Attributes:
        kind: A name of ``fault_kinds.KINDS``; ``joint`` or ``id`` and ``value`` as it wants them.
        in_s: So much later; ``for_s``: until it is taken back, else for good or until ``clear``.
    """

    do: Literal["inject"]
    kind: _Word
    joint: str | None = None
    id: Annotated[int | None, Field(ge=0, le=252)] = None
    value: _Number | None = None
    in_s: _NotNegative = 0.0
    for_s: _NotNegative | None = None


class ClearStep(Step):
    """Takes back the faults that were injected, all or those of one kind; restarts servos that shut down."""

    do: Literal["clear"]
    kind: str | None = None


class ExpectStep(Step):
    """What must be true now; at least one thing.

    Attributes:
        shafts: Judge by where the simulated shafts really are, not by what the servos say.
        thing: ``position`` is where this one of the script's things lies, not the frame.
        width_mm: Between the fingers, within ``tolerance_mm``.
        state: Of the arm.
        error: Class of the last error; ``joint`` and ``cause``: what it says of them.
        status: Of the last solve.
        step_seconds, run_seconds: How long the last action, and the run, took: from, to.
    """

    do: Literal["expect"]
    position: _Place | None = None
    wxyz: _Turn | None = None
    frame: str | None = None
    joints_deg: dict[str, _Number] | None = None
    joints_mm: dict[str, _Number] | None = None
    keyframe: _Word | None = None
    tolerance_mm: _Positive = 2.0
    tolerance_deg: _Positive = 0.5
    shafts: bool = False
    thing: _Word | None = None
    width_mm: _NotNegative | None = None
    state: Literal["connected", "enabled", "hold", "fault"] | None = None
    error: _Word | None = None
    joint: _Word | None = None
    cause: _Word | None = None
    status: _Word | None = None
    step_seconds: _Span | None = None
    run_seconds: _Span | None = None


AnyStep = (
    PoseStep | PositionStep | LineStep | JointsStep | KeyframeStep | MarkerStep | GripStep | FollowStep
    | WaitStep | HoldStep | RecoverStep | InjectStep | ClearStep | ExpectStep
)  # fmt: skip

STEPS: Mapping[str, type[Step]] = MappingProxyType(
    {
        "pose": PoseStep,
        "position": PositionStep,
        "line": LineStep,
        "joints": JointsStep,
        "keyframe": KeyframeStep,
        "marker": MarkerStep,
        "grip": GripStep,
        "follow": FollowStep,
        "wait": WaitStep,
        "hold": HoldStep,
        "inject": InjectStep,
        "clear": ClearStep,
        "recover": RecoverStep,
        "expect": ExpectStep,
    }
)
"""Every kind of step by the value of ``do``."""


class ThingTable(Table):
    """A box that lies about and can be gripped, in a world with ``physics``.

    Attributes:
        position: Of its centre, m; ``yaw_deg``: turned about the vertical.
    """

    name: _Word
    position: _Place
    yaw_deg: _Number = 0.0
    size_mm: Annotated[list[_Positive], Field(min_length=3, max_length=3)]
    mass_g: _Positive = 50.0


class ScriptFile(Table):
    """A whole script.

    Attributes:
        version: ``schema`` in the file (the name is taken in pydantic's base class).
        robot: Catalogue name, or a path seen from the script.
        arm: Path of an arm file, likewise; by default the one beside the model.
        seed: Of the dice of faults, restarts and the synthetic camera's noise.
        speed: Share of the speed limits of all moves that do not say it themselves.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker; by default the stage's own.
        physics: The robot's MuJoCo model moves the simulated shafts.
        things: What lies on the plane z = 0 of that world.
    """

    version: Annotated[int, Field(alias="schema", ge=1, le=1)]
    name: _Word
    about: str = ""
    robot: _Word = "tabletop_puma"
    arm: str | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    speed: _Share = 0.5
    marker_at: Annotated[list[_Number], Field(min_length=3, max_length=4)] | None = None
    physics: bool = False
    things: list[ThingTable] = []
    steps: Annotated[list[Annotated[AnyStep, Field(discriminator="do")]], Field(min_length=1)]


# ------------------------------------------------------------------------------------------
# The step that grips: by a servo of the arm's q, or by one that is aside and only told how hard to press.


GRIPPER = "gripper"
"""Group of ``robot.toml`` and of the arm file."""


def gripper_joints(robot: Robot) -> list[str]:
    """The joints of the group ``gripper`` that are part of q and have servos."""
    return [name for name in robot.file.groups.get(GRIPPER, ()) if name in robot.joints]


def gripper_angles(robot: Robot, q: Array, opening: float) -> Array:
    """``q`` (nq,) with the gripper at a share of its range: 0 at the lower limits, 1 at the upper."""
    wanted = q.copy()
    for name in gripper_joints(robot):
        k = robot.joints.index(name)
        wanted[k] = robot.lower[k] + opening * (robot.upper[k] - robot.lower[k])
    return wanted


def fingers_on(robot: Robot, joint: JointMap) -> int:
    """How many fingers one servo moves: its own, and those that a coupling of the model makes follow it."""
    model = robot.model
    leader = next((k for k in range(model.njnt) if model.joint(k).name == joint.name), -1)
    return 1 + sum(coupling.leader == leader for coupling in robot.couplings)


def check_grip(script: Script, setup: RobotSetup, step: GripStep | ExpectStep, at: str) -> None:
    """Whether there is a gripper, and one that can do this.

    Raises:
        ConfigError: There is none, or it opens no width, or cannot be told how hard to press.
    """
    assert setup.config is not None
    aside = setup.config.aside_of(GRIPPER)
    if not aside and (isinstance(step, ExpectStep) or not gripper_joints(setup.robot)):
        raise script.wrong(
            f"the arm of {setup.robot.name!r} has no gripper",
            f"{at}.do",
            "an arm file with a servo for a joint of the group gripper (robot.toml)",
        )
    slides = bool(aside) and all(joint.slides for joint in aside)
    for key, able in (("width_mm", slides), ("force_n", bool(aside)), ("held", bool(aside))):
        if getattr(step, key, None) is not None and not able:
            problem = (
                f"that needs a {'slide' if key == 'width_mm' else 'joint'} of the arm file's group gripper"
            )
            raise script.wrong(problem, f"{at}.{key}", "opening alone")
    if step.width_mm is not None:
        most = sum(1e3 * joint.limits[1] * fingers_on(setup.robot, joint) for joint in aside)
        if step.width_mm > most + 1e-9:
            asked, widest = apart(step.width_mm, most, digits=6, form="g")
            raise script.wrong(f"{asked} mm is too wide", f"{at}.width_mm", f"0 to {widest}")


def width_mm(now: RunState) -> float:
    """Millimetres between the fingers, measured."""
    at = now.arm.positions()
    joints = now.config.aside_of(GRIPPER)
    return sum(1e3 * at[joint.name] * fingers_on(now.robot, joint) for joint in joints)


def grip(now: RunState, step: GripStep, result: StepResult) -> None:
    """Moves the fingers until they are there or something stops them.

    Raises:
        StepFailed: Something is between them that should not be, or nothing that should.
        RobotIkError: Of the arm.
    """
    joints = now.config.aside_of(GRIPPER)
    if not joints:
        go(now, step, result)
        return
    for joint in joints:
        fingers = fingers_on(now.robot, joint)
        lower, upper = joint.limits
        goal = lower + (step.opening or 0.0) * (upper - lower)
        if step.width_mm is not None:
            goal = max(lower, min(upper, 1e-3 * step.width_mm / fingers / len(joints)))
        current = None if step.force_n is None else current_for(joint, step.force_n, fingers)
        (report,) = now.arm.grip({joint.name: goal}, current=current, timeout=step.time_limit_s)
        result.numbers.update(held=report.held, width_mm=round(width_mm(now), 4))
        if report.current is not None:
            result.numbers["current_ma"] = round(report.current, 1)
    held = "something is held" if result.numbers["held"] else "nothing is held"
    result.found = f"{result.numbers['width_mm']:.1f} mm, {held}"
    if "current_ma" in result.numbers:
        result.found += f", {result.numbers['current_ma']:.0f} mA"
    if step.held is not None and step.held != result.numbers["held"]:
        raise StepFailed(result.found)


def current_for(joint: JointMap, newtons: float, fingers: int) -> float:
    """mA with which each finger presses so hard, friction not counted; at most ``current_ma``.

    Where a horn is near a dead centre a torque presses harder: nowhere harder than asked.
    """
    torque = newtons * fingers * joint.levers[0] / joint.ratio
    wanted = 1e3 * torque / joint.table.motor.torque_per_ampere
    return wanted if joint.current is None else min(wanted, joint.current)


# ------------------------------------------------------------------------------------------
# The steps that move the arm.


Move = PoseStep | PositionStep | LineStep | JointsStep | KeyframeStep | MarkerStep | GripStep


# -------------------------------------------------------------------------------------- where to


def keyframes(robot: Robot) -> dict[str, Array]:
    """Name -> (nq,) of the model's keyframes, and ``home``."""
    model = robot.model
    places = model.jnt_qposadr[list(robot.tree.joint_ids)]  # a servo's joint is a hinge: one number
    found = {model.key(k).name: np.array(model.key_qpos[k][places]) for k in range(model.nkey)}
    return {**found, "home": robot.home}


def slides(robot: Robot, joint: str) -> bool:
    """Whether a joint slides: then it counts in millimetres, else in degrees."""
    return int(robot.model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)


def per_unit(robot: Robot, joint: str) -> float:
    """One degree in rad; one millimetre in m of a slide."""
    return 1e-3 if slides(robot, joint) else float(np.radians(1.0))


def with_joints(robot: Robot, q: Array, step: JointsStep | ExpectStep) -> Array:
    """``q`` (nq,) with the joints that a step names at its degrees and millimetres."""
    wanted = q.copy()
    for name, number in {**(step.joints_deg or {}), **(step.joints_mm or {})}.items():
        wanted[robot.joints.index(name)] = number * per_unit(robot, name)
    return wanted


# --------------------------------------------------------------------------------------- how far


def off_text(millimetres: float, degrees: float | None, step: Move) -> str:
    """How far off the frame is, and how far it may be, for people."""
    pairs = [apart(millimetres, step.tolerance_mm, digits=2)]
    pairs += [] if degrees is None else [apart(degrees, step.tolerance_deg, digits=2)]
    off, allowed = (
        ", ".join(f"{text}{unit}" for text, unit in zip(texts, (" mm", "°"), strict=False))
        for texts in zip(*pairs, strict=True)
    )
    return f"{off} off; allowed {allowed}"


def pose_miss(
    robot: Robot, q: Array, frame: str | None, position: Any, wxyz: Any
) -> tuple[float | None, float | None]:
    """Millimetres and degrees by which the frame at ``q`` misses, by MuJoCo; None where nothing was asked."""
    at = robot.measure(q, frame)
    metres = None if position is None else float(np.linalg.norm(at.position - np.asarray(position)))
    angle = None if wxyz is None else at.distance(Pose(at.position, wxyz))[1]
    return None if metres is None else 1e3 * metres, None if angle is None else float(np.degrees(angle))


def joints_miss(
    robot: Robot, q: Array, wanted: Array, step: Move | ExpectStep
) -> tuple[str, float, float, str]:
    """The joint that is farthest off: its name, by how much, what the step allows, and the unit of both."""
    rows = []
    for joint, off in zip(robot.joints, np.abs(q - wanted).tolist(), strict=True):
        allowed, unit = (step.tolerance_mm, " mm") if slides(robot, joint) else (step.tolerance_deg, "°")
        rows.append((joint, off / per_unit(robot, joint), allowed, unit))
    return max(rows, key=lambda row: row[1] / row[2])


# --------------------------------------------------------------------------------------- the steps


def go(now: RunState, step: Move, result: StepResult) -> None:
    """Plans, sends, and waits until the servos have arrived.

    Raises:
        StepFailed: They did not, or not in time.
        NotConvergedError, TrajectoryError: There is no way; nothing was sent.
        RobotIkError: Of the arm or the camera.
    """
    start = now.start()
    caps: dict[str, Any] = {
        "velocity": now.config.velocity,
        "acceleration": now.config.acceleration,
        "rate": now.config.rate_hz,
        "speed": step.speed or now.script.content.speed,
    }
    if isinstance(step, LineStep):
        target = line_target(now.robot, start, step)
        trajectory = line_move(
            now.robot, start, target, frame=step.frame, linear_speed=step.linear_speed, **caps
        )
        judge = _by_pose(now, step, PoseGoal.at(step.frame, target))
    elif isinstance(step, PoseStep | PositionStep | MarkerStep):
        goal, wanted = _goal(now, step, result)
        trajectory = joint_move(now.robot, start, solve_for(now, goal, start), **caps)
        judge = _by_pose(now, step, wanted)
    else:
        angles = _angles(now.robot, start, step)
        trajectory = joint_move(now.robot, start, angles, **caps)
        judge = _by_joints(now, step, angles)
    now.play(trajectory, step.time_limit_s, lambda: judge()[0], result)
    there, result.found, numbers = judge()
    result.numbers.update(numbers)
    if not there:
        raise StepFailed(f"not arrived: {result.found}")


def line_target(robot: Robot, start: Array, step: LineStep) -> Pose:
    """Where the line ends, world."""
    begin = robot.forward(start, step.frame)
    position = begin.position + np.asarray(step.by) if step.position is None else np.asarray(step.position)
    return Pose(position, begin.wxyz if step.wxyz is None else step.wxyz)


def solve_for(now: RunState, goal: Goal, start: Array) -> Array:
    """(nq,) that meets the goal.

    Raises:
        NotConvergedError: None was found.
    """
    problem = Problem(now.robot, goal, tolerance=SOLVE_TOLERANCE, seed=now.seed)
    solution = make_solver(now.solver).solve(problem, start)
    now.status = solution.status.name
    q = np.array(solution.require().q)
    aside = [k for k, name in enumerate(now.robot.joints) if name in gripper_joints(now.robot)]
    q[aside] = start[aside]  # what is in the gripper stays there
    return q


def _goal(now: RunState, step: PoseStep | PositionStep | MarkerStep, result: StepResult) -> tuple[Goal, Goal]:
    """The goal to solve for, and the one by which the arm is judged: at the marker's true place."""
    if not isinstance(step, MarkerStep):
        frame = step.frame or now.robot.tool
        given = (
            PoseGoal(frame, step.position, step.wxyz)
            if isinstance(step, PoseStep)
            else PositionGoal(frame, step.position)
        )
        return given, given
    assert now.vision is not None
    seen = now.vision.find_target()
    assert seen.true_pose is not None  # the camera is synthetic
    true = seen.true_pose.compose(now.vision.stage.pose_marker_tool)
    off = float(np.linalg.norm(seen.goal.target.position - true.position))
    result.numbers["seen_off_mm"] = round(1e3 * off, 4)
    goal = seen.goal
    if isinstance(goal, PoseGoal) and goal.free_axis is not None:
        # Five joints point the axis within a plane, and it is seen a little beside that.
        near = Tolerance(SOLVE_TOLERANCE.position, 0.5 * float(np.radians(step.tolerance_deg)))
        return replace(goal, tolerance=near), goal.moved_to(true)
    return goal, goal.moved_to(true)


def _angles(robot: Robot, start: Array, step: JointsStep | KeyframeStep | GripStep) -> Array:
    if isinstance(step, JointsStep):
        return with_joints(robot, start, step)
    if isinstance(step, KeyframeStep):
        return keyframes(robot)[step.keyframe]
    return gripper_angles(robot, start, step.opening or 0.0)


Judge = Callable[[], tuple[bool, str, dict[str, float]]]


def _by_pose(now: RunState, step: Move, goal: Goal) -> Judge:
    def judge() -> tuple[bool, str, dict[str, float]]:
        metres, radians = goal.off(now.robot.measure(now.arm.read().q, goal.frame), goal.target)
        mm, deg = 1e3 * metres, float(np.degrees(radians)) if goal.has_angle else None
        numbers = {"off_mm": round(mm, 4)} | ({} if deg is None else {"off_deg": round(deg, 4)})
        inside = mm <= step.tolerance_mm and (deg is None or deg <= step.tolerance_deg)
        return inside, off_text(mm, deg, step), numbers

    return judge


def _by_joints(now: RunState, step: Move, wanted: Array) -> Judge:
    def judge() -> tuple[bool, str, dict[str, float]]:
        joint, off, allowed, unit = joints_miss(now.robot, now.arm.read().q, wanted, step)
        here, most = apart(off, allowed, digits=2)
        text = f"{joint} {here}{unit} off; allowed {most}{unit}"
        return off <= allowed, text, {"off_deg" if unit == "°" else "off_mm": round(off, 4)}

    return judge


# ------------------------------------------------------------------------------------------
# The step that follows a goal which moves.


_ARRIVE = 0.4
"""s given to the servos at the end before the marker's true place judges them."""


def follow_goal(now: RunState, step: FollowStep, result: StepResult) -> None:
    """Follows for the time; judges every tick after ``catch_up_s``, and a marker once more at the end.

    A marker is where the scene has it at that time: what the camera makes of late pictures judges nothing.

    Raises:
        StepFailed: Farther off than allowed, or there never was a goal.
        RobotIkError: Of the arm or the camera.
    """
    frame = step.frame or now.robot.tool
    behind: list[float] = []

    def note(tick: Any) -> None:
        if tick.time < step.catch_up_s or (tick.goal is None and step.path != "marker"):
            return
        place = now.robot.forward(tick.measured, frame).position
        true = _true_goal(now) if step.path == "marker" else tick.goal.target.position
        behind.append(1e3 * float(np.linalg.norm(place - true)))

    with _goals(now, step, frame) as goals:
        report = follow(
            goals,
            now.robot,
            now.solver,
            [now.arm, now.command],
            rate=now.config.rate_hz,
            clock=now.setup.clock,
            duration=step.seconds,
            start=now.start(),
            tolerance=SOLVE_TOLERANCE,
            speed=step.speed or now.script.content.speed,
            source=now.arm,
            on_tick=note,
        )
    _tell(now, step, report, behind, result)
    if step.path == "marker":
        _judge_by_truth(now, step, result)


@contextlib.contextmanager
def _goals(now: RunState, step: FollowStep, frame: str) -> Iterator[Any]:
    if step.path == "marker":
        assert now.vision is not None
        with now.vision.following(now.setup.clock, step.seconds) as goals:
            yield goals
        return
    assert step.center is not None and step.radius is not None and step.period is not None
    make = CurveSource.circle if step.path == "circle" else CurveSource.lemniscate
    normal = step.normal or (0.0, 0.0, 1.0)
    yield make(frame, step.center, step.radius, step.period, normal=normal, wxyz=step.wxyz)


def _true_goal(now: RunState) -> Array:
    """(3,) where the tool belongs at this moment, which only the scene knows."""
    assert now.vision is not None and now.vision.path is not None
    marker = now.vision.path(now.setup.clock.now())
    return marker.compose(now.vision.stage.pose_marker_tool).position


def _tell(
    now: RunState, step: FollowStep, report: FollowReport, behind: list[float], result: StepResult
) -> None:
    now.status = "" if report.last is None else report.last.status.name
    result.numbers.update(ticks=report.ticks, held=report.held, solved=report.solved)
    if not (behind and report.solved):
        raise StepFailed(f"no goal was seen after {step.catch_up_s:g} s")
    if now.vision is not None and now.vision.delays is not None and now.vision.delays[1].count:
        result.numbers["picture_age_p95_s"] = round(now.vision.delays[1].p95, 4)
    median, worst = float(np.median(behind)), max(behind)
    result.numbers.update(behind_median_mm=round(median, 4), behind_worst_mm=round(worst, 4))
    most, allowed = apart(worst, step.tolerance_mm, digits=2)
    result.found = f"median {median:.2f} mm, worst {most} mm behind; allowed {allowed} mm"
    if worst > step.tolerance_mm:
        raise StepFailed(f"lost the goal: {result.found}")


def _judge_by_truth(now: RunState, step: FollowStep, result: StepResult) -> None:
    """Where the marker really lies in the end, which only the scene knows."""
    assert now.vision is not None
    now.repeat(_ARRIVE)
    seen = now.vision.find_target_again()
    assert seen.true_pose is not None
    true = seen.true_pose.compose(now.vision.stage.pose_marker_tool)
    at = now.robot.measure(now.arm.read().q, now.setup.frame)
    off = 1e3 * float(np.linalg.norm(at.position - true.position))
    result.numbers["off_mm"] = round(off, 4)
    result.found += f"; {off:.2f} mm from where it truly lies"
    if off > step.tolerance_mm:
        raise StepFailed(result.found)


# ------------------------------------------------------------------------------------------
# The step that says what must be true now.


ROUNDING = 1e-9
"""s; sums of periods are not exact."""


@dataclass(frozen=True)
class _Finding:
    """One thing that was looked at: what it is, and what it should be."""

    right: bool
    found: str
    wanted: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.found if self.right else f"{self.found} instead of {self.wanted}"


def expect(now: RunState, step: ExpectStep, result: StepResult) -> None:
    """Looks at everything that is expected, and tells all of it.

    Raises:
        StepFailed: Something is otherwise.
        RobotIkError: Of the arm, while it is read.
    """
    findings = [*_places(now, step), *_error(now, step), *_rest(now, step)]
    for finding in findings:
        result.numbers.update(finding.numbers)
    result.found = "; ".join(str(finding) for finding in findings)
    if not all(finding.right for finding in findings):
        raise StepFailed("; ".join(str(finding) for finding in findings if not finding.right))


def _places(now: RunState, step: ExpectStep) -> Iterator[_Finding]:
    robot = now.robot
    placed = step.position is not None or step.wxyz is not None
    if step.width_mm is not None:
        width = width_mm(now)
        yield _near(abs(width - step.width_mm), step.tolerance_mm, " mm", "gripper's width", "width_off_mm")
    if step.thing is not None and step.position is not None:
        off = 1e3 * float(np.linalg.norm(_place_of(now, step.thing) - step.position))
        yield _near(off, step.tolerance_mm, " mm", step.thing, "off_mm")
        return
    jointwise = any(key is not None for key in (step.joints_deg, step.joints_mm, step.keyframe))
    if not placed and not jointwise:
        return
    q = now.setup.true_q() if step.shafts else now.arm.read().q
    if placed:
        mm, deg = pose_miss(robot, q, step.frame, step.position, step.wxyz)
        if mm is not None:
            yield _near(mm, step.tolerance_mm, " mm", step.frame or robot.tool, "off_mm")
        if deg is not None:
            yield _near(deg, step.tolerance_deg, "°", step.frame or robot.tool, "off_deg")
    if jointwise:
        goal = q if step.keyframe is None else keyframes(robot)[step.keyframe]
        joint, off, allowed, unit = joints_miss(robot, q, with_joints(robot, goal, step), step)
        yield _near(off, allowed, unit, joint, "joint_off_deg" if unit == "°" else "joint_off_mm")


def _place_of(now: RunState, thing: str) -> Array:
    """(3,) m where a thing lies, which nobody measures: the world knows."""
    servos = now.arm.virtual_bus
    assert servos is not None and servos.world is not None
    with servos.lock:
        servos.advance()
        return np.array(servos.world.data.body(thing).xpos)


def _near(off: float, allowed: float, unit: str, what: str, key: str) -> _Finding:
    here, most = apart(off, allowed, digits=2)
    return _Finding(off <= allowed, f"{what} {here}{unit} off", f"at most {most}{unit}", {key: round(off, 4)})


def _error(now: RunState, step: ExpectStep) -> Iterator[_Finding]:
    wanted = [word for word in (step.error, step.joint, step.cause) if word is not None]
    if not wanted:
        return
    error = now.error
    if error is None:
        yield _Finding(False, "no error", ", ".join(wanted))
        return
    if step.error is not None:
        right = isinstance(error, error_classes()[step.error])
        yield _Finding(right, type(error).__name__, step.error)
    if step.joint is not None:
        joint = str(getattr(error, "joint", ""))
        yield _Finding(joint == step.joint, joint or "no joint", step.joint)
    if step.cause is not None:
        causes = getattr(error, "status", ())
        yield _Finding(step.cause in causes, ", ".join(causes) or "no cause", step.cause)


def _rest(now: RunState, step: ExpectStep) -> Iterator[_Finding]:
    if step.state is not None:
        state = now.arm.state.value
        yield _Finding(state == step.state, f"state {state}", step.state)
    if step.status is not None:
        yield _Finding(now.status == step.status, f"solver {now.status or 'not asked'}", step.status)
    for what, seconds, span in (
        ("last step", now.seconds, step.step_seconds),
        ("run", now.now(), step.run_seconds),
    ):
        if span is not None:
            inside = span[0] - ROUNDING <= seconds <= span[1] + ROUNDING
            yield _Finding(inside, f"{what} {seconds:.3f} s", f"{span[0]:g} … {span[1]:g} s")


# ------------------------------------------------------------------------------------------
# The step that gets an arm out of a fault.


PATIENCE = 2.0
"""s to wait for a port that has gone."""


def recover(now: RunState, step: RecoverStep, result: StepResult) -> None:
    """Opens a port that had gone, or restarts what has shut down; then torque where the arm stands.

    Raises:
        StepFailed: There is no fault.
        HardwareError: The cause is still there; the fault stays.
    """
    arm = now.arm
    if arm.state is not ArmState.FAULT:
        raise StepFailed(f"there is no fault: the arm is {arm.state.value}")
    if not arm.bus.is_open:
        arm.reconnect(PATIENCE if step.time_limit_s is None else step.time_limit_s)
    else:
        restarted = arm.reset_fault()
        result.numbers["restarted"] = list(restarted)
        result.found = f"restarted: {', '.join(restarted)}" if restarted else ""
    arm.enable()
    now.stand()
