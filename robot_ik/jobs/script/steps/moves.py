"""Steps that move the arm, or its gripper, to a place until the servos have arrived, or along with a goal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from robot_ik.config import KeyProblem, Position, Positive, Word, Wxyz
from robot_ik.errors import distinct_texts
from robot_ik.execution import FollowReport, follow
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.hardware.servo import GRIPPER, Joint
from robot_ik.jobs.script.state import RunState, StepFailed, StepResult
from robot_ik.jobs.script.steps.base import (
    Action,
    Finding,
    Framed,
    GripperWidth,
    JointValues,
    NotNegative,
    Seconds,
    Share,
    Tolerant,
    current_for,
    fingers_on,
    gripper_joints,
    keyframes,
    near,
    report_findings,
    require_known,
    width_mm,
)
from robot_ik.jobs.verdict import SOLVE_TOLERANCE
from robot_ik.motion.line import line_move
from robot_ik.motion.sources import CurveSource
from robot_ik.motion.trajectory import Trajectory, joint_move
from robot_ik.ports import Array
from robot_ik.problem import Problem

Judge = Callable[[], list[Finding]]
"""How far off it is: once all of that is right it has arrived."""


class Move(Tolerant, Action):
    """A planned motion; it is over when the servos have arrived within the tolerance."""

    speed: Share | None = None

    def run(self, now: RunState, result: StepResult) -> None:
        """Plans, sends, and waits until the servos have arrived.

        Raises:
            StepFailed: They did not, or not in time.
            NotConvergedError, TrajectoryError: There is no path; nothing was sent.
            RobotIkError: Of the arm or the camera.
        """
        trajectory, judge = self.plan(now, now.start(), result)
        now.play(trajectory, self.time_limit_s, lambda: all(finding.right for finding in judge()), result)
        report_findings(judge(), result, "not arrived: ")

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """The path from ``start`` (nq,), and who says whether the arm is at its end."""
        raise NotImplementedError

    def caps(self, now: RunState) -> dict[str, Any]:
        """Speed limits, as ``joint_move`` takes them."""
        return now.setup.caps(self.speed or now.script.speed)

    def by_goal(self, now: RunState, goal: Goal) -> Judge:
        """Judges by MuJoCo where the goal's frame is."""

        def judge() -> list[Finding]:
            metres, radians = goal.error(now.robot, now.setup.q)
            what = goal.frame or now.robot.tool
            found = [near(1e3 * metres, self.tolerance_mm, " mm", what, "off_mm")]
            if goal.weights[1] > 0.0:
                degrees = float(np.degrees(radians))
                found.append(near(degrees, self.tolerance_deg, "°", what, "off_deg"))
            return found

        return judge

    def to_goal(self, now: RunState, start: Array, goal: Goal, wanted: Goal) -> tuple[Trajectory, Judge]:
        """Straight in joint space to what meets ``goal``; judged by ``wanted``."""
        q = solve_for(now, goal, start)
        trajectory = joint_move(now.robot, start, q, **self.caps(now))
        return now.setup.checked(trajectory), self.by_goal(now, wanted)

    def to_joints(self, now: RunState, start: Array, q: Array) -> tuple[Trajectory, Judge]:
        """Straight in joint space; judged by the joint that is farthest off."""

        def judge() -> list[Finding]:
            return [self.farthest(now.robot, now.setup.q, q)]

        return now.setup.checked(joint_move(now.robot, start, q, **self.caps(now))), judge


def solve_for(now: RunState, goal: Goal, start: Array) -> Array:
    """(nq,) that meets the goal.

    Raises:
        NotConvergedError: None was found.
    """
    problem = Problem(
        now.robot,
        goal,
        solver=now.solver,
        tolerance=SOLVE_TOLERANCE,
        seed=now.seed,
        collisions=now.setup.collisions,
    )
    solution = problem.solve(start)
    now.status = solution.status.name
    q = np.array(solution.require().q)
    fingers = [k for k, name in enumerate(now.robot.joints) if name in gripper_joints(now.robot)]
    q[fingers] = start[fingers]  # what is in the gripper stays there
    return q


class PositionStep(Framed, Move):
    """The frame's origin goes to a position, whatever its orientation."""

    title_keys = ("position",)

    do: Literal["position"]
    position: Position

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        goal = PositionGoal(self.frame or now.robot.tool, self.position)
        return self.to_goal(now, start, goal, goal)


class PoseStep(Framed, Move):
    """The frame goes to a position and an orientation, straight in joint space."""

    title_keys = ("position",)

    do: Literal["pose"]
    position: Position
    wxyz: Wxyz

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        goal = PoseGoal(self.frame or now.robot.tool, self.position, self.wxyz)
        return self.to_goal(now, start, goal, goal)


class MarkerStep(Move):
    """The synthetic camera looks for the printed marker, and the tool goes above it."""

    do: Literal["marker"]

    @property
    def needs_camera(self) -> bool:
        return True

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """To where it was seen; judged by where it truly is."""
        if now.vision is None:
            raise RuntimeError("this step needs a camera")
        seen = now.vision.find_target()
        if seen.true_pose is None:
            raise RuntimeError("the camera of a script must be synthetic")
        true = seen.true_pose.compose(now.vision.scene.pose_marker_tool)
        off = float(np.linalg.norm(seen.goal.target.position - true.position))
        result.numbers["seen_off_mm"] = round(1e3 * off, 4)
        goal = seen.goal
        if isinstance(goal, PoseGoal) and goal.free_axis is not None:
            # Five joints point the axis within a plane, and it is seen a little beside that.
            angle = 0.5 * float(np.radians(self.tolerance_deg))
            goal = replace(goal, tolerance=Tolerance(SOLVE_TOLERANCE.position, angle))
        return self.to_goal(now, start, goal, seen.goal.moved_to(true))


class LineStep(Framed, Move):
    """The frame goes straight to a position or by a vector, and keeps its rotation unless asked."""

    title_keys = ("position", "by")

    do: Literal["line"]
    position: Position | None = None
    by: Position | None = None
    wxyz: Wxyz | None = None
    linear_speed: Positive = 0.25

    @model_validator(mode="after")
    def _one_end(self) -> LineStep:
        if (self.position is None) == (self.by is None):
            raise KeyProblem("a line goes to a position or by a vector", "position", "position or by")
        return self

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        begin = now.robot.forward(start, self.frame)
        position = (
            begin.position + np.asarray(self.by) if self.position is None else np.asarray(self.position)
        )
        target = Pose(position, begin.wxyz if self.wxyz is None else self.wxyz)
        trajectory = line_move(
            now.robot, start, target, frame=self.frame, linear_speed=self.linear_speed, **self.caps(now)
        )
        return now.setup.checked(trajectory), self.by_goal(now, PoseGoal.at(self.frame, target))


class JointsStep(JointValues, Move):
    """Joints go to angles, slides to millimetres; those that are not named stay."""

    title_keys = ("joints_deg", "joints_mm")

    do: Literal["joints"]

    @model_validator(mode="after")
    def _some(self) -> JointsStep:
        if self.joints_deg is None and self.joints_mm is None:
            raise KeyProblem("no joint is named", "joints_deg", "joints_deg, joints_mm (slides) or both")
        return self

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        return self.to_joints(now, start, self.placed(now.robot, start))


class KeyframeStep(Move):
    """All joints go to a keyframe of the model."""

    title_keys = ("keyframe",)

    do: Literal["keyframe"]
    keyframe: Word = "home"

    def check(self, now: RunState) -> None:
        super().check(now)
        require_known("keyframe", self.keyframe, keyframes(now.robot), "keyframe")

    def plan(self, now: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        return self.to_joints(now, start, keyframes(now.robot)[self.keyframe])


class GripStep(GripperWidth, Move):
    """The gripper opens or closes: to a share of its range, or to a width.

    Attributes:
        opening: 0 closed, 1 open; ``width_mm``: instead, between two fingers that slide.
        force_n: How hard each finger presses from here on, where the servo can be asked.
        held: Whether something must be between the fingers then; without it, either is right.
    """

    title_keys = ("opening", "width_mm")
    by_opening = True

    do: Literal["grip"]
    opening: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    force_n: Positive | None = None
    held: bool | None = None

    @model_validator(mode="after")
    def _one_width(self) -> GripStep:
        if (self.opening is None) == (self.width_mm is None):
            raise KeyProblem("a grip is to an opening or to a width", "opening", "opening or width_mm")
        return self

    def check(self, now: RunState) -> None:
        super().check(now)
        self.check_gripper(now)

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
        joints = now.config.group(GRIPPER)
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

    def _move(self, now: RunState, joint: Joint, of: int, result: StepResult) -> None:
        """One of so many joints."""
        fingers = fingers_on(now.robot, joint)
        lower, upper = joint.limits
        goal = joint.at_opening(self.opening or 0.0)
        if self.width_mm is not None:
            goal = max(lower, min(upper, 1e-3 * self.width_mm / fingers / of))
        current = None if self.force_n is None else current_for(joint, self.force_n, fingers)
        (report,) = now.arm.grip({joint.name: goal}, current=current, timeout=self.time_limit_s)
        result.numbers.update(held=report.held, width_mm=round(width_mm(now), 4))
        if report.current is not None:
            result.numbers["current_ma"] = round(report.current, 1)


# ------------------------------------------------------------------------------------------
# The step that follows a goal which moves: a curve, or the printed marker.


_ARRIVE = 0.4
"""s given to the servos at the end before the marker's true place judges them."""


class FollowStep(Framed, Action):
    """The frame follows a goal that moves: round a circle, an eight, or the printed marker.

    Attributes:
        catch_up_s: From here on the frame must be within ``tolerance_mm`` of the goal at every tick.
    """

    title_keys = ("path", "seconds")

    do: Literal["follow"]
    path: Literal["circle", "eight", "marker"]
    seconds: Seconds
    center: Position | None = None
    radius: Positive | None = None
    period: Positive | None = None
    normal: Position | None = None
    wxyz: Wxyz | None = None
    speed: Share | None = None
    catch_up_s: NotNegative = 1.0
    tolerance_mm: Positive = 10.0

    @model_validator(mode="after")
    def _curve(self) -> FollowStep:
        if self.path == "marker":
            for key in ("center", "radius", "period", "normal", "wxyz", "frame"):
                if getattr(self, key) is not None:
                    problem = f"a marker goes its own way, so {key} means nothing"
                    raise KeyProblem(problem, key, 'nothing, or path = "circle" or "eight"')
            return self
        for key in ("center", "radius", "period"):
            if getattr(self, key) is None:
                raise KeyProblem("this key is missing", key, f'a value, for path = "{self.path}"')
        return self

    @property
    def needs_camera(self) -> bool:
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
            if tick.time < self.catch_up_s or (tick.goal is None and not self.needs_camera):
                return
            place = now.robot.forward(tick.measured, frame).position
            true = _marked_place(now) if self.needs_camera else tick.goal.target.position
            behind.append(1e3 * float(np.linalg.norm(place - true)))

        setup = now.setup
        with self._goals(now, frame) as goals:
            report = follow(
                now.robot, goals, sinks=setup.begin_stream(), solver=now.solver, rate=setup.rate,
                clock=setup.clock, duration=self.seconds, start=now.start(), tolerance=SOLVE_TOLERANCE,
                speed=self.speed or now.script.speed, source=now.setup.opened, on_tick=note,
                collisions=now.setup.collisions,
            )  # fmt: skip
        self._judge(now, report, behind, result)
        if not self.needs_camera:
            return
        setup.repeat(_ARRIVE)
        off = 1e3 * float(np.linalg.norm(now.robot.measure(now.setup.q).position - _marked_place(now)))
        result.numbers["off_mm"] = round(off, 4)
        result.found += f"; {off:.2f} mm from where it truly lies"
        if off > self.tolerance_mm:
            raise StepFailed(result.found)

    def _goals(self, now: RunState, frame: str) -> contextlib.AbstractContextManager[Any]:
        if self.needs_camera:
            if now.vision is None:
                raise RuntimeError("this step needs a camera")
            return now.vision.following(now.setup.clock, self.seconds)
        if self.center is None or self.radius is None or self.period is None:
            raise RuntimeError("a curve needs center, radius and period")
        make = CurveSource.circle if self.path == "circle" else CurveSource.lemniscate
        normal = self.normal or (0.0, 0.0, 1.0)
        curve = make(frame, self.center, self.radius, self.period, normal=normal, wxyz=self.wxyz)
        return contextlib.nullcontext(curve)

    def _judge(self, now: RunState, report: FollowReport, behind: list[float], result: StepResult) -> None:
        now.status = "" if report.last is None else report.last.status.name
        result.numbers.update(ticks=report.ticks, held=report.held, solved=report.solved)
        if not (behind and report.solved):
            raise StepFailed(f"no goal was seen after {self.catch_up_s:g} s")
        if now.vision is not None and now.vision.delays is not None and now.vision.delays[1].count:
            result.numbers["picture_age_p95_s"] = round(now.vision.delays[1].p95, 4)
        median, worst = float(np.median(behind)), max(behind)
        result.numbers.update(behind_median_mm=round(median, 4), behind_worst_mm=round(worst, 4))
        most, allowed = distinct_texts(worst, self.tolerance_mm, digits=2)
        result.found = f"median {median:.2f} mm, worst {most} mm behind; allowed {allowed} mm"
        if worst > self.tolerance_mm:
            raise StepFailed(f"lost the goal: {result.found}")


def _marked_place(now: RunState) -> Array:
    """(3,) m where the tool should be above the marker that is followed; only the scene knows."""
    if now.vision is None:
        raise RuntimeError("this step needs a camera")
    marker = now.vision.true_target(now.setup.clock.now())
    if marker is None:
        raise RuntimeError("the camera of a script must be synthetic")
    return marker.compose(now.vision.scene.pose_marker_tool).position
