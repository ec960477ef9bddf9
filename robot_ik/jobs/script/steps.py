"""The steps of a script: one class a kind, with its keys, what it asks of an arm, and what it does.

A subclass of ``Step`` that has a key ``do`` is a kind of step, and nothing else lists them.  Lengths are
metres, angles degrees (``_deg``), tolerances millimetres and degrees, times seconds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

import mujoco
import numpy as np
from pydantic import AfterValidator, Field, model_validator

from robot_ik.errors import apart
from robot_ik.execution import follow
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.jobs.reach import SOLVE_TOLERANCE
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.state import Context, RunState, StepFailed, error_classes
from robot_ik.motion.line import line_move
from robot_ik.motion.sources import CurveSource
from robot_ik.motion.trajectory import joint_move
from robot_ik.problem import Problem
from robot_ik.solution import Status
from robot_ik.solvers import make_solver
from robot_ik.tables import Pair, Place, Table, WrongKey, Wxyz

if TYPE_CHECKING:
    from robot_ik.execution import FollowReport
    from robot_ik.hardware.joint_map import JointMap
    from robot_ik.motion.trajectory import Trajectory
    from robot_ik.ports import Array
    from robot_ik.robot import Robot


def _error_class(name: str) -> str:
    if name not in error_classes():
        raise WrongKey.unknown("error", name, error_classes())
    return name


def _rising(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise WrongKey(f"{list(span)} is empty", allowed="[from, to]")
    return span


# A day: a script that waits longer waits for something else.
_LONGEST = 86_400.0
_Positive = Annotated[float, Field(gt=0.0)]
_NotNegative = Annotated[float, Field(ge=0.0)]
_Seconds = Annotated[float, Field(gt=0.0, le=_LONGEST)]
_Span = Annotated[Pair, AfterValidator(_rising)]
_Share = Annotated[float, Field(gt=0.0, le=1.0)]
_Word = Annotated[str, Field(min_length=1)]
_ErrorClass = Annotated[_Word, AfterValidator(_error_class)]


STEPS: dict[str, type[Step]] = {}
"""Every kind of step by the value of ``do``; classes enter themselves."""


class Step(Table):
    """What every step has.

    Attributes:
        name: For the report; by default what the step does.
    """

    words: ClassVar[tuple[str, ...]] = ()
    """Keys that, with ``do``, say what a step without a name is called."""
    simulated_only: ClassVar[bool] = False
    """On a real port nothing is broken on purpose, and nothing that shut down is switched on by itself."""

    do: str
    name: str = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        STEPS.update(dict.fromkeys(get_args(cls.model_fields["do"].annotation), cls))

    @property
    def looks(self) -> bool:
        """Whether it needs the synthetic camera."""
        return False

    @property
    def title(self) -> str:
        """What it is called in the report."""
        if self.name:
            return self.name
        found = [self.do]
        for key in self.words:
            value = getattr(self, key)
            if isinstance(value, dict):
                unit = " mm" if key == "joints_mm" else "°"
                found += [f"{joint} {number:g}{unit}" for joint, number in value.items()]
            elif isinstance(value, tuple):
                found += [f"{number:g}" for number in value]
            elif value is not None:
                found.append(f"{value:g} s" if key == "seconds" else str(value))
        return " ".join(found)

    def check(self, context: Context) -> None:
        """Whether this robot, arm and bus can do it; before anything is opened or moves.

        Raises:
            WrongKey: They cannot.
        """
        if not context.simulated and self.simulated_only:
            problem = f"{self.do!r} is for simulated servos, and this is a real port"
            raise WrongKey(problem, "do", "--bus sim or pty")
        if not context.simulated and self.looks:
            problem = "the synthetic camera does not see a real desk"
            raise WrongKey(problem, "do", "other steps, or robot-ik reach")

    def run(self, now: RunState, result: StepResult) -> None:
        """Does it; what was found goes into ``result``.

        Raises:
            StepFailed: It did not do what it should.
            RobotIkError: Of the arm, the camera or the solver.
        """
        raise NotImplementedError


def step_class(table: Mapping[str, Any]) -> type[Step]:
    """The class of a step by what stands in its table.

    Raises:
        WrongKey: There is no such step.
    """
    if "do" not in table:
        raise WrongKey("this key is missing", "do", ", ".join(STEPS))
    if not isinstance(table["do"], str) or table["do"] not in STEPS:
        raise WrongKey.unknown("step", table["do"], STEPS, "do")
    return STEPS[table["do"]]


class Action(Step):
    """A step that takes time.

    Attributes:
        time_limit_s: The step fails when it takes longer.
        raises: Class of the error with which it must end; without it, an error is a failure.
    """

    time_limit_s: _Seconds | None = None
    raises: _ErrorClass | None = None


# ------------------------------------------------------------------------------------------
# Joints and frames by name, and how far off they are.


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


class _Framed(Step):
    """A step for a frame of the robot; by default its tool."""

    frame: str | None = None

    def check(self, context: Context) -> None:
        """Whether the robot has it."""
        super().check(context)
        if self.frame is not None and self.frame not in context.robot.frames:
            raise WrongKey.unknown("frame", self.frame, context.robot.frames, "frame")


def _check_keyframe(robot: Robot, keyframe: str | None) -> None:
    if keyframe is not None and keyframe not in (known := keyframes(robot)):
        raise WrongKey.unknown("keyframe", keyframe, known, "keyframe")


class _JointValues(Step):
    """Joints at angles, slides at millimetres."""

    joints_deg: Annotated[dict[str, float], Field(min_length=1)] | None = None
    joints_mm: Annotated[dict[str, float], Field(min_length=1)] | None = None

    anywhere: ClassVar[bool] = False
    """Whether the joints may be named outside their limits."""

    def placed(self, robot: Robot, q: Array) -> Array:
        """``q`` (nq,) with the joints that are named at their degrees and millimetres."""
        wanted = q.copy()
        for name, number in {**(self.joints_deg or {}), **(self.joints_mm or {})}.items():
            wanted[robot.joints.index(name)] = number * per_unit(robot, name)
        return wanted

    def check(self, context: Context) -> None:
        """Names and kinds of the joints, and whether they can go there."""
        super().check(context)
        robot = context.robot
        for key in ("joints_deg", "joints_mm"):
            for joint, number in (getattr(self, key) or {}).items():
                at = f"{key}.{joint}"
                if joint not in robot.joints:
                    raise WrongKey.unknown("joint", joint, robot.joints, at)
                right, unit = ("joints_mm", " mm") if slides(robot, joint) else ("joints_deg", "°")
                if key != right:
                    counts = "a slide counts in millimetres" if unit == " mm" else "a hinge counts in degrees"
                    raise WrongKey(counts, at, right)
                k, one = robot.joints.index(joint), per_unit(robot, joint)
                low, high = float(robot.lower[k]) / one, float(robot.upper[k]) / one
                if not self.anywhere and not low - 1e-9 <= number <= high + 1e-9:
                    asked, lowest, highest = apart(number, low, high)
                    raise WrongKey(f"{asked}{unit} is outside the limits", at, f"{lowest} … {highest}")


class _Tolerant(Step):
    """A step that judges where something is.

    Attributes:
        tolerance_mm, tolerance_deg: Of the frame; or of each slide, and of each other joint.
    """

    tolerance_mm: _Positive = 2.0
    tolerance_deg: _Positive = 0.5

    def farthest(self, robot: Robot, q: Array, wanted: Array) -> tuple[str, float, float, str]:
        """The joint that is farthest off: its name, by how much, what is allowed, and the unit of both."""
        rows = []
        for joint, off in zip(robot.joints, np.abs(q - wanted).tolist(), strict=True):
            allowed, unit = (self.tolerance_mm, " mm") if slides(robot, joint) else (self.tolerance_deg, "°")
            rows.append((joint, off / per_unit(robot, joint), allowed, unit))
        return max(rows, key=lambda row: row[1] / row[2])


# ------------------------------------------------------------------------------------------
# The steps that move the arm.


Judge = Callable[[], tuple[bool, str, dict[str, float]]]
"""Whether it has arrived, what was found, and its numbers."""


class _Move(_Tolerant, Action):
    """A planned motion; it is over when the servos have arrived within the tolerance.

    Attributes:
        speed: Share of the speed limits.
    """

    speed: _Share | None = None

    def run(self, now: RunState, result: StepResult) -> None:
        """Plans, sends, and waits until the servos have arrived.

        Raises:
            StepFailed: They did not, or not in time.
            NotConvergedError, TrajectoryError: There is no way; nothing was sent.
            RobotIkError: Of the arm or the camera.
        """
        trajectory, judge = self.plan(now, now.start(), result)
        now.play(trajectory, self.time_limit_s, lambda: judge()[0], result)
        there, result.found, numbers = judge()
        result.numbers.update(numbers)
        if not there:
            raise StepFailed(f"not arrived: {result.found}")

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """The way from ``start`` (nq,), and who says whether the arm is at its end."""
        raise NotImplementedError

    def caps(self, now: RunState) -> dict[str, Any]:
        """Speed limits, as ``joint_move`` takes them."""
        return {
            "velocity": now.config.velocity,
            "acceleration": now.config.acceleration,
            "rate": now.config.rate_hz,
            "speed": self.speed or now.script.content.speed,
        }

    def by_goal(self, now: RunState, goal: Goal) -> Judge:
        """Judges by MuJoCo where the goal's frame is."""

        def judge() -> tuple[bool, str, dict[str, float]]:
            metres, radians = goal.off(now.robot.measure(now.arm.read().q, goal.frame), goal.target)
            rows = [("off_mm", 1e3 * metres, self.tolerance_mm, " mm")]
            if goal.has_angle:
                rows.append(("off_deg", float(np.degrees(radians)), self.tolerance_deg, "°"))
            texts = [[text + row[3] for text in apart(row[1], row[2], digits=2)] for row in rows]
            off, allowed = (", ".join(column) for column in zip(*texts, strict=True))
            inside = all(row[1] <= row[2] for row in rows)
            return inside, f"{off} off; allowed {allowed}", {row[0]: round(row[1], 4) for row in rows}

        return judge

    def by_joints(self, now: RunState, wanted: Array) -> Judge:
        """Judges by the joint that is farthest off."""

        def judge() -> tuple[bool, str, dict[str, float]]:
            joint, off, allowed, unit = self.farthest(now.robot, now.arm.read().q, wanted)
            here, most = apart(off, allowed, digits=2)
            text = f"{joint} {here}{unit} off; allowed {most}{unit}"
            return off <= allowed, text, {"off_deg" if unit == "°" else "off_mm": round(off, 4)}

        return judge

    def to_goal(self, now: RunState, start: Array, goal: Goal, wanted: Goal) -> tuple[Trajectory, Judge]:
        """Straight in joint space to what meets ``goal``; judged by ``wanted``."""
        q = solve_for(now, goal, start)
        return joint_move(now.robot, start, q, **self.caps(now)), self.by_goal(now, wanted)

    def to_joints(self, now: RunState, start: Array, q: Array) -> tuple[Trajectory, Judge]:
        """Straight in joint space; judged joint by joint."""
        return joint_move(now.robot, start, q, **self.caps(now)), self.by_joints(now, q)


def solve_for(now: RunState, goal: Goal, start: Array) -> Array:
    """(nq,) that meets the goal.

    Raises:
        NotConvergedError: None was found.
    """
    problem = Problem(now.robot, goal, tolerance=SOLVE_TOLERANCE, seed=now.seed)
    solution = make_solver(now.solver).solve(problem, start)
    now.status = solution.status.name
    q = np.array(solution.require().q)
    fingers = [k for k, name in enumerate(now.robot.joints) if name in gripper_joints(now.robot)]
    q[fingers] = start[fingers]  # what is in the gripper stays there
    return q


class PositionStep(_Framed, _Move):
    """The frame's origin goes to a position, however it is turned."""

    words = ("position",)

    do: Literal["position"]
    position: Place

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """See ``_Move``."""
        goal = PositionGoal(self.frame or now.robot.tool, self.position)
        return self.to_goal(now, start, goal, goal)


class PoseStep(_Framed, _Move):
    """The frame goes to a position and an orientation, straight in joint space."""

    words = ("position",)

    do: Literal["pose"]
    position: Place
    wxyz: Wxyz

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """See ``_Move``."""
        goal = PoseGoal(self.frame or now.robot.tool, self.position, self.wxyz)
        return self.to_goal(now, start, goal, goal)


class MarkerStep(_Move):
    """The synthetic camera looks for the printed marker, and the tool goes above it."""

    do: Literal["marker"]

    @property
    def looks(self) -> bool:
        """See ``Step``."""
        return True

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """To where it was seen; judged by where it truly is."""
        assert now.vision is not None
        seen = now.vision.find_target()
        assert seen.true_pose is not None  # the camera is synthetic
        true = seen.true_pose.compose(now.vision.scene.pose_marker_tool)
        off = float(np.linalg.norm(seen.goal.target.position - true.position))
        result.numbers["seen_off_mm"] = round(1e3 * off, 4)
        goal = seen.goal
        if isinstance(goal, PoseGoal) and goal.free_axis is not None:
            # Five joints point the axis within a plane, and it is seen a little beside that.
            near = Tolerance(SOLVE_TOLERANCE.position, 0.5 * float(np.radians(self.tolerance_deg)))
            return self.to_goal(now, start, replace(goal, tolerance=near), goal.moved_to(true))
        return self.to_goal(now, start, goal, goal.moved_to(true))


class LineStep(_Framed, _Move):
    """The frame moves on a straight line, to a position or by a vector, and keeps its turn unless told."""

    words = ("position", "by")

    do: Literal["line"]
    position: Place | None = None
    by: Place | None = None
    wxyz: Wxyz | None = None
    linear_speed: _Positive = 0.25

    @model_validator(mode="after")
    def _one_end(self) -> LineStep:
        if (self.position is None) == (self.by is None):
            raise WrongKey("a line goes to a position or by a vector", "position", "position or by")
        return self

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """See ``_Move``."""
        begin = now.robot.forward(start, self.frame)
        position = (
            begin.position + np.asarray(self.by) if self.position is None else np.asarray(self.position)
        )
        target = Pose(position, begin.wxyz if self.wxyz is None else self.wxyz)
        trajectory = line_move(
            now.robot, start, target, frame=self.frame, linear_speed=self.linear_speed, **self.caps(now)
        )
        return trajectory, self.by_goal(now, PoseGoal.at(self.frame, target))


class JointsStep(_JointValues, _Move):
    """Joints go to angles, slides to millimetres; those that are not named stay."""

    words = ("joints_deg", "joints_mm")

    do: Literal["joints"]

    @model_validator(mode="after")
    def _some(self) -> JointsStep:
        if self.joints_deg is None and self.joints_mm is None:
            raise WrongKey("no joint is named", "joints_deg", "joints_deg, joints_mm (slides) or both")
        return self

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """See ``_Move``."""
        return self.to_joints(now, start, self.placed(now.robot, start))


class KeyframeStep(_Move):
    """All joints go to a keyframe of the model."""

    words = ("keyframe",)

    do: Literal["keyframe"]
    keyframe: _Word = "home"

    def check(self, context: Context) -> None:
        """See ``Step``."""
        super().check(context)
        _check_keyframe(context.robot, self.keyframe)

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """See ``_Move``."""
        return self.to_joints(now, start, keyframes(now.robot)[self.keyframe])


# ------------------------------------------------------------------------------------------
# The step that grips: by a servo of the arm's q, or by an auxiliary one that is told how hard to press.


GRIPPER = "gripper"
"""Group of ``robot.toml`` and of the arm file."""


def gripper_joints(robot: Robot) -> list[str]:
    """The joints of the group ``gripper`` that are part of q and have servos."""
    return [name for name in robot.file.groups.get(GRIPPER, ()) if name in robot.joints]


def fingers_on(robot: Robot, joint: JointMap) -> int:
    """How many fingers one servo moves: its own, and those that a coupling of the model makes follow it."""
    model = robot.model
    leader = next((k for k in range(model.njnt) if model.joint(k).name == joint.name), -1)
    return 1 + sum(coupling.leader == leader for coupling in robot.couplings)


def width_mm(now: RunState) -> float:
    """Millimetres between the fingers, measured."""
    at = now.arm.positions()
    joints = now.config.auxiliary_of(GRIPPER)
    return sum(1e3 * at[joint.name] * fingers_on(now.robot, joint) for joint in joints)


def current_for(joint: JointMap, newtons: float, fingers: int) -> float:
    """mA with which each finger presses so hard, friction not counted; at most ``current_ma``.

    Where a horn is near a dead centre a torque presses harder: nowhere harder than asked.
    """
    torque = newtons * fingers * joint.levers[0] / joint.ratio
    wanted = 1e3 * torque / joint.table.motor.torque_per_ampere
    return wanted if joint.current is None else min(wanted, joint.current)


class _Width(Step):
    """Something about the width between fingers that slide."""

    width_mm: _NotNegative | None = None

    def check_gripper(self, context: Context) -> None:
        """Whether there is a gripper, and one that can do this.

        Raises:
            WrongKey: There is none, or it opens no width, or cannot be told how hard to press.
        """
        joints = context.config.auxiliary_of(GRIPPER)
        if not joints and (not isinstance(self, GripStep) or not gripper_joints(context.robot)):
            problem = f"the arm of {context.robot.name!r} has no gripper"
            allowed = "an arm file with a servo for a joint of the group gripper (robot.toml)"
            raise WrongKey(problem, "do", allowed)
        sliding = bool(joints) and all(joint.slides for joint in joints)
        for key, able in (("width_mm", sliding), ("force_n", bool(joints)), ("held", bool(joints))):
            if getattr(self, key, None) is not None and not able:
                what = "slide" if key == "width_mm" else "joint"
                problem = f"that needs a {what} of the arm file's group gripper"
                raise WrongKey(problem, key, "opening alone")
        if self.width_mm is not None:
            most = sum(1e3 * joint.limits[1] * fingers_on(context.robot, joint) for joint in joints)
            if self.width_mm > most + 1e-9:
                asked, widest = apart(self.width_mm, most, digits=6, form="g")
                raise WrongKey(f"{asked} mm is too wide", "width_mm", f"0 to {widest}")


class GripStep(_Width, _Move):
    """The gripper opens or closes: to a share of its range, or to a width.

    Attributes:
        opening: 0 closed, 1 open; ``width_mm``: instead, between two fingers that slide.
        force_n: How hard each finger presses from here on, where the servo can be told.
        held: Whether something must be between the fingers then; without it, either is right.
    """

    words = ("opening", "width_mm")

    do: Literal["grip"]
    opening: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    force_n: _Positive | None = None
    held: bool | None = None

    @model_validator(mode="after")
    def _one_width(self) -> GripStep:
        if (self.opening is None) == (self.width_mm is None):
            raise WrongKey("a grip is to an opening or to a width", "opening", "opening or width_mm")
        return self

    def check(self, context: Context) -> None:
        """See ``Step``."""
        super().check(context)
        self.check_gripper(context)

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """The gripper to a share of its range: 0 at the lower limits, 1 at the upper."""
        robot, q = now.robot, start.copy()
        for name in gripper_joints(robot):
            k = robot.joints.index(name)
            q[k] = robot.lower[k] + (self.opening or 0.0) * (robot.upper[k] - robot.lower[k])
        return self.to_joints(now, start, q)

    def run(self, now: RunState, result: StepResult) -> None:
        """Moves the fingers until they are there or something stops them.

        Raises:
            StepFailed: Something is between them that should not be, or nothing that should.
            RobotIkError: Of the arm.
        """
        joints = now.config.auxiliary_of(GRIPPER)
        if not joints:
            super().run(now, result)
            return
        for joint in joints:
            self._move(now, joint, len(joints), result)
        held = "something is held" if result.numbers["held"] else "nothing is held"
        result.found = f"{result.numbers['width_mm']:.1f} mm, {held}"
        if "current_ma" in result.numbers:
            result.found += f", {result.numbers['current_ma']:.0f} mA"
        if self.held is not None and self.held != result.numbers["held"]:
            raise StepFailed(result.found)

    def _move(self, now: RunState, joint: JointMap, of: int, result: StepResult) -> None:
        """One of so many joints."""
        fingers = fingers_on(now.robot, joint)
        lower, upper = joint.limits
        goal = lower + (self.opening or 0.0) * (upper - lower)
        if self.width_mm is not None:
            goal = max(lower, min(upper, 1e-3 * self.width_mm / fingers / of))
        current = None if self.force_n is None else current_for(joint, self.force_n, fingers)
        (report,) = now.arm.grip({joint.name: goal}, current=current, timeout=self.time_limit_s)
        result.numbers.update(held=report.held, width_mm=round(width_mm(now), 4))
        if report.current is not None:
            result.numbers["current_ma"] = round(report.current, 1)


# ------------------------------------------------------------------------------------------
# The step that follows a goal which moves.


_ARRIVE = 0.4
"""s given to the servos at the end before the marker's true place judges them."""


class FollowStep(_Framed, Action):
    """The frame follows a goal that moves: round a circle, an eight, or the printed marker.

    Attributes:
        catch_up_s: From here on the frame must be within ``tolerance_mm`` of the goal at every tick.
    """

    words = ("path", "seconds")

    do: Literal["follow"]
    path: Literal["circle", "eight", "marker"]
    seconds: _Seconds
    center: Place | None = None
    radius: _Positive | None = None
    period: _Positive | None = None
    normal: Place | None = None
    wxyz: Wxyz | None = None
    speed: _Share | None = None
    catch_up_s: _NotNegative = 1.0
    tolerance_mm: _Positive = 10.0

    @model_validator(mode="after")
    def _curve(self) -> FollowStep:
        if self.path == "marker":
            for key in ("center", "radius", "period", "normal", "wxyz", "frame"):
                if getattr(self, key) is not None:
                    problem = f"a marker goes its own way, so {key} means nothing"
                    raise WrongKey(problem, key, 'nothing, or path = "circle" or "eight"')
            return self
        for key in ("center", "radius", "period"):
            if getattr(self, key) is None:
                raise WrongKey("this key is missing", key, f'a value, for path = "{self.path}"')
        return self

    @property
    def looks(self) -> bool:
        """See ``Step``."""
        return self.path == "marker"

    def run(self, now: RunState, result: StepResult) -> None:
        """Follows for the time; judges every tick after ``catch_up_s``, and a marker once more at the end.

        A marker is where the scene has it at that time; what the camera makes of late pictures is no judge.

        Raises:
            StepFailed: Farther off than allowed, or there never was a goal.
            RobotIkError: Of the arm or the camera.
        """
        frame = self.frame or now.robot.tool
        behind: list[float] = []

        def note(tick: Any) -> None:
            if tick.time < self.catch_up_s or (tick.goal is None and not self.looks):
                return
            place = now.robot.forward(tick.measured, frame).position
            true = _true_goal(now) if self.looks else tick.goal.target.position
            behind.append(1e3 * float(np.linalg.norm(place - true)))

        with self._goals(now, frame) as goals:
            report = follow(
                goals,
                now.robot,
                now.solver,
                now.sinks,
                rate=now.config.rate_hz,
                clock=now.setup.clock,
                duration=self.seconds,
                start=now.start(),
                tolerance=SOLVE_TOLERANCE,
                speed=self.speed or now.script.content.speed,
                source=now.arm,
                on_tick=note,
            )
        self._judge(now, report, behind, result)
        if self.looks:
            self._judge_at_end(now, result)

    @contextlib.contextmanager
    def _goals(self, now: RunState, frame: str) -> Iterator[Any]:
        if self.looks:
            assert now.vision is not None
            with now.vision.following(now.setup.clock, self.seconds) as goals:
                yield goals
            return
        assert self.center is not None and self.radius is not None and self.period is not None
        make = CurveSource.circle if self.path == "circle" else CurveSource.lemniscate
        normal = self.normal or (0.0, 0.0, 1.0)
        yield make(frame, self.center, self.radius, self.period, normal=normal, wxyz=self.wxyz)

    def _judge(self, now: RunState, report: FollowReport, behind: list[float], result: StepResult) -> None:
        now.status = "" if report.last is None else report.last.status.name
        result.numbers.update(ticks=report.ticks, held=report.held, solved=report.solved)
        if not (behind and report.solved):
            raise StepFailed(f"no goal was seen after {self.catch_up_s:g} s")
        if now.vision is not None and now.vision.delays is not None and now.vision.delays[1].count:
            result.numbers["picture_age_p95_s"] = round(now.vision.delays[1].p95, 4)
        median, worst = float(np.median(behind)), max(behind)
        result.numbers.update(behind_median_mm=round(median, 4), behind_worst_mm=round(worst, 4))
        most, allowed = apart(worst, self.tolerance_mm, digits=2)
        result.found = f"median {median:.2f} mm, worst {most} mm behind; allowed {allowed} mm"
        if worst > self.tolerance_mm:
            raise StepFailed(f"lost the goal: {result.found}")

    def _judge_at_end(self, now: RunState, result: StepResult) -> None:
        """Where the marker really lies in the end, which only the scene knows."""
        assert now.vision is not None
        now.repeat(_ARRIVE)
        seen = now.vision.find_target_again()
        assert seen.true_pose is not None
        true = seen.true_pose.compose(now.vision.scene.pose_marker_tool)
        at = now.robot.measure(now.arm.read().q, now.setup.frame)
        off = 1e3 * float(np.linalg.norm(at.position - true.position))
        result.numbers["off_mm"] = round(off, 4)
        result.found += f"; {off:.2f} mm from where it truly lies"
        if off > self.tolerance_mm:
            raise StepFailed(result.found)


def _true_goal(now: RunState) -> Array:
    """(3,) where the tool belongs at this moment, which only the scene knows."""
    assert now.vision is not None and now.vision.path is not None
    marker = now.vision.path(now.setup.clock.now())
    return marker.compose(now.vision.scene.pose_marker_tool).position


# ------------------------------------------------------------------------------------------
# Waiting, holding; faults, and the way out of one.


PATIENCE = 2.0
"""s to wait for a port that has gone."""


class WaitStep(Action):
    """The arm stays where it was sent to."""

    words = ("seconds",)

    do: Literal["wait"]
    seconds: Annotated[float, Field(ge=0.0, le=_LONGEST)]

    def run(self, now: RunState, result: StepResult) -> None:
        """See ``Step``."""
        if now.movable:
            now.repeat(self.seconds)
        else:
            now.setup.clock.sleep_until(now.setup.clock.now() + self.seconds)


class HoldStep(Action):
    """The arm holds where it is."""

    do: Literal["hold"]

    def run(self, now: RunState, result: StepResult) -> None:
        """See ``Step``."""
        now.arm.hold()
        now.stand()


class InjectStep(Step):
    """Lets a fault of the virtual bus happen.

    Attributes:
        kind: A name of ``FAULTS``; ``joint`` or ``id`` and ``value`` as it wants them.
        in_s: So much later; ``for_s``: until it is taken back, else for good or until ``clear``.
    """

    words = ("kind", "joint")
    simulated_only = True

    do: Literal["inject"]
    kind: _Word
    joint: str | None = None
    id: Annotated[int | None, Field(ge=0, le=252)] = None
    value: float | None = None
    in_s: _NotNegative = 0.0
    for_s: _NotNegative | None = None

    @property
    def fault(self) -> Fault:
        """What it injects.

        Raises:
            WrongKey: There is no such kind, or not with such a value.
        """
        return Fault(self.kind, self.id, self.value, joint=self.joint, at_s=self.in_s, for_s=self.for_s)

    def check(self, context: Context) -> None:
        """See ``Step``."""
        super().check(context)
        self.fault.require_servo(context.config)

    def run(self, now: RunState, result: StepResult) -> None:
        """See ``Step``."""
        now.servos.inject(self.fault)


class ClearStep(Step):
    """Takes back the faults that were injected, all or those of one kind; restarts servos that shut down."""

    words = ("kind",)
    simulated_only = True

    do: Literal["clear"]
    kind: str | None = None

    def run(self, now: RunState, result: StepResult) -> None:
        """See ``Step``."""
        result.numbers["cleared"] = now.servos.clear(self.kind)


class RecoverStep(Action):
    """Out of a fault: port opened, servos restarted, everything verified anew; then torque again."""

    simulated_only = True

    do: Literal["recover"]

    def run(self, now: RunState, result: StepResult) -> None:
        """Opens a port that had gone, or restarts what has shut down; then torque where the arm stands.

        Raises:
            StepFailed: There is no fault.
            HardwareError: The cause is still there; the fault stays.
        """
        arm = now.arm
        if arm.state is not ArmState.FAULT:
            raise StepFailed(f"there is no fault: the arm is {arm.state.value}")
        if not arm.bus.is_open:
            arm.reconnect(PATIENCE if self.time_limit_s is None else self.time_limit_s)
        else:
            restarted = arm.reset_fault()
            result.numbers["restarted"] = list(restarted)
            result.found = f"restarted: {', '.join(restarted)}" if restarted else ""
        arm.enable()
        now.stand()


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


def _near(off: float, allowed: float, unit: str, what: str, key: str) -> _Finding:
    here, most = apart(off, allowed, digits=2)
    return _Finding(off <= allowed, f"{what} {here}{unit} off", f"at most {most}{unit}", {key: round(off, 4)})


_PLACES = ("position", "wxyz", "joints_deg", "joints_mm", "keyframe", "width_mm")
_REST = ("state", "error", "joint", "cause", "status", "step_seconds", "run_seconds")


class ExpectStep(_Framed, _JointValues, _Tolerant, _Width):
    """What must be true now; at least one thing.

    Attributes:
        shafts: Judge by where the simulated shafts really are, not by what the servos say.
        object: ``position`` is where this one of the script's objects lies, not the frame.
        width_mm: Between the fingers, within ``tolerance_mm``.
        state: Of the arm.
        error: Class of the last error; ``joint`` and ``cause``: what it says of them.
        status: Of the last solve.
        step_seconds, run_seconds: How long the last action, and the run, took: from, to.
    """

    words = ("keyframe", "joint", "position", "joints_deg", "joints_mm", "width_mm")
    anywhere = True

    do: Literal["expect"]
    position: Place | None = None
    wxyz: Wxyz | None = None
    keyframe: _Word | None = None
    shafts: bool = False
    object: _Word | None = None
    state: Literal["connected", "enabled", "hold", "fault"] | None = None
    error: _ErrorClass | None = None
    joint: _Word | None = None
    cause: _Word | None = None
    status: _Word | None = None
    step_seconds: _Span | None = None
    run_seconds: _Span | None = None

    @model_validator(mode="after")
    def _something(self) -> ExpectStep:
        if all(getattr(self, key) is None for key in (*_PLACES, *_REST)):
            raise WrongKey("nothing is expected", allowed=f"one or more of {', '.join((*_PLACES, *_REST))}")
        if self.object is not None and self.position is None:
            raise WrongKey("this key is missing", "position", "where the object is to lie")
        return self

    def check(self, context: Context) -> None:
        """See ``Step``."""
        super().check(context)
        robot = context.robot
        if self.shafts and not context.simulated:
            problem = "nobody knows where real shafts are"
            raise WrongKey(problem, "shafts", "false, or --bus sim or pty")
        _check_keyframe(robot, self.keyframe)
        if self.status is not None and self.status not in (names := [s.name for s in Status]):
            raise WrongKey.unknown("status", self.status, names, "status")
        if self.joint is not None and self.joint not in robot.joints:
            raise WrongKey.unknown("joint", self.joint, robot.joints, "joint")
        if self.width_mm is not None:
            self.check_gripper(context)

    def run(self, now: RunState, result: StepResult) -> None:
        """Looks at everything that is expected, and reports all of it.

        Raises:
            StepFailed: Something is otherwise.
            RobotIkError: Of the arm, while it is read.
        """
        findings = [*self._places(now), *self._error(now), *self._rest(now)]
        for finding in findings:
            result.numbers.update(finding.numbers)
        result.found = "; ".join(str(finding) for finding in findings)
        if not all(finding.right for finding in findings):
            raise StepFailed("; ".join(str(finding) for finding in findings if not finding.right))

    def _places(self, now: RunState) -> Iterator[_Finding]:
        if self.width_mm is not None:
            off = abs(width_mm(now) - self.width_mm)
            yield _near(off, self.tolerance_mm, " mm", "gripper's width", "width_off_mm")
        if self.object is not None and self.position is not None:
            off = 1e3 * float(np.linalg.norm(_place_of(now, self.object) - self.position))
            yield _near(off, self.tolerance_mm, " mm", self.object, "off_mm")
            return
        placed = self.position is not None or self.wxyz is not None
        jointwise = any(key is not None for key in (self.joints_deg, self.joints_mm, self.keyframe))
        if not placed and not jointwise:
            return
        q = now.setup.true_q() if self.shafts else now.arm.read().q
        if placed:
            yield from self._pose(now.robot, q)
        if jointwise:
            goal = q if self.keyframe is None else keyframes(now.robot)[self.keyframe]
            joint, off, allowed, unit = self.farthest(now.robot, q, self.placed(now.robot, goal))
            yield _near(off, allowed, unit, joint, "joint_off_deg" if unit == "°" else "joint_off_mm")

    def _pose(self, robot: Robot, q: Array) -> Iterator[_Finding]:
        """How far the frame at ``q`` is off, by MuJoCo."""
        at, what = robot.measure(q, self.frame), self.frame or robot.tool
        if self.position is not None:
            metres = float(np.linalg.norm(at.position - np.asarray(self.position)))
            yield _near(1e3 * metres, self.tolerance_mm, " mm", what, "off_mm")
        if self.wxyz is not None:
            degrees = float(np.degrees(at.distance(Pose(at.position, self.wxyz))[1]))
            yield _near(degrees, self.tolerance_deg, "°", what, "off_deg")

    def _error(self, now: RunState) -> Iterator[_Finding]:
        wanted = [word for word in (self.error, self.joint, self.cause) if word is not None]
        if not wanted:
            return
        error = now.error
        if error is None:
            yield _Finding(False, "no error", ", ".join(wanted))
            return
        if self.error is not None:
            right = isinstance(error, error_classes()[self.error])
            yield _Finding(right, type(error).__name__, self.error)
        if self.joint is not None:
            joint = str(getattr(error, "joint", ""))
            yield _Finding(joint == self.joint, joint or "no joint", self.joint)
        if self.cause is not None:
            causes = getattr(error, "status", ())
            yield _Finding(self.cause in causes, ", ".join(causes) or "no cause", self.cause)

    def _rest(self, now: RunState) -> Iterator[_Finding]:
        if self.state is not None:
            state = now.arm.state.value
            yield _Finding(state == self.state, f"state {state}", self.state)
        if self.status is not None:
            yield _Finding(now.status == self.status, f"solver {now.status or 'not asked'}", self.status)
        for what, seconds, span in (
            ("last step", now.seconds, self.step_seconds),
            ("run", now.now(), self.run_seconds),
        ):
            if span is not None:
                inside = span[0] - ROUNDING <= seconds <= span[1] + ROUNDING
                yield _Finding(inside, f"{what} {seconds:.3f} s", f"{span[0]:g} … {span[1]:g} s")


def _place_of(now: RunState, name: str) -> Array:
    """(3,) m where an object lies, which nobody measures: the world knows."""
    assert now.servos.world is not None
    with now.servos.lock:
        now.servos.advance()
        return np.array(now.servos.world.data.body(name).xpos)
