"""The step that moves the gripper."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from robot_ik.config import KeyProblem, Positive
from robot_ik.hardware.servo import GRIPPER, Joint
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array
from robot_ik.script.state import RunState, StepFailed, StepResult
from robot_ik.script.steps.gripper import (
    GripperWidth,
    current_for,
    fingers_on,
    gripper_joints,
    width_mm,
)
from robot_ik.script.steps.moves import Judge, Move


class GripStep(GripperWidth, Move):
    """Open or close the gripper, to a share of its range or to a width.

    Attributes:
        opening: Share of the range, from 0 (closed) to 1 (open).
        force_n: Force of each finger from this step on, newtons. It needs a servo with a current
            limit.
        held: Whether something must be between the fingers at the end. None: not checked.
    """

    title_keys = ("opening", "width_mm")
    by_opening = True

    do: Literal["grip"]
    opening: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    force_n: Positive | None = None
    held: bool | None = None

    @model_validator(mode="after")
    def _check_target(self) -> GripStep:
        if (self.opening is None) == (self.width_mm is None):
            problem = "a grip needs either an opening or a width"
            raise KeyProblem(problem, "opening", "opening or width_mm")
        return self

    def check(self, state: RunState) -> None:
        """Check that the arm has a gripper that can do the step."""
        super().check(state)
        self.check_gripper(state)

    def plan(self, state: RunState, start: Array, _result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan the motion of the gripper joints in q to a share of their range.

        The range is from 0 at the lower limits to 1 at the upper limits.
        """
        robot = state.robot
        q = start.copy()
        for name in gripper_joints(robot):
            index = robot.joints.index(name)
            joint_range = robot.upper[index] - robot.lower[index]
            q[index] = robot.lower[index] + (self.opening or 0.0) * joint_range
        return self.to_joints(state, start, q)

    def run(self, state: RunState, result: StepResult) -> None:
        """Move the fingers until they arrived or something stops them.

        Raises:
            StepFailed: Something is held that should not be, or nothing is held.
            RobotIkError: The arm failed.
        """
        joints = state.config.group(GRIPPER)
        if not joints:
            super().run(state, result)
            return
        for joint in joints:
            self._grip(state, joint, len(joints), result)

        numbers = result.numbers
        held = "something is held" if numbers["held"] else "nothing is held"
        result.found = f"{numbers['width_mm']:.1f} mm, {held}"
        if "current_ma" in numbers:
            result.found += f", {numbers['current_ma']:.0f} mA"
        if self.held is not None and self.held != numbers["held"]:
            raise StepFailed(result.found)

    def _grip(self, state: RunState, joint: Joint, joint_count: int, result: StepResult) -> None:
        """Move one of the gripper's joints and write what was measured into ``result``."""
        fingers = fingers_on(state.robot, joint)
        lower, upper = joint.limits
        if self.width_mm is None:
            goal = joint.at_opening(self.opening or 0.0)
        else:
            goal = max(lower, min(upper, 1e-3 * self.width_mm / fingers / joint_count))
        current = None if self.force_n is None else current_for(joint, self.force_n, fingers)

        goals = {joint.name: goal}
        (report,) = state.arm.grip(goals, current=current, timeout=self.time_limit_s)
        result.numbers.update(held=report.held, width_mm=round(width_mm(state), 4))
        if report.current is not None:
            result.numbers["current_ma"] = round(report.current, 1)
