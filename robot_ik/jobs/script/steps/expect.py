"""The step that says what must be true now."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from pydantic import model_validator

from robot_ik.config import KeyProblem, Position, Word, Wxyz
from robot_ik.geometry import Pose
from robot_ik.hardware import SIMULATED
from robot_ik.jobs.script.state import RunState, StepResult, error_classes
from robot_ik.jobs.script.steps.base import (
    ErrorClass,
    Finding,
    Framed,
    GripperWidth,
    JointValues,
    Span,
    Tolerant,
    keyframes,
    near,
    report_findings,
    require_known,
    width_mm,
)
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.solution import Status

ROUNDING = 1e-9
"""s; sums of periods are not exact."""


_POSE_KEYS = ("position", "wxyz", "joints_deg", "joints_mm", "keyframe", "width_mm")
_REST = ("state", "error", "joint", "cause", "status", "step_seconds", "run_seconds")


class ExpectStep(Framed, JointValues, Tolerant, GripperWidth):
    """What must be true now; at least one condition.

    Attributes:
        shafts: Judge by where the simulated shafts really are, not by what the servos say.
        object: ``position`` is where this one of the script's objects lies, not the frame.
        width_mm: Between the fingers, within ``tolerance_mm``.
        state: Of the arm.
        error: Class of the last error; ``joint`` and ``cause``: what it says of them.
        status: Of the last solve.
        step_seconds, run_seconds: How long the last action, and the run, took: from, to.
    """

    title_keys = ("keyframe", "joint", "position", "joints_deg", "joints_mm", "width_mm")
    anywhere = True

    do: Literal["expect"]
    position: Position | None = None
    wxyz: Wxyz | None = None
    keyframe: Word | None = None
    shafts: bool = False
    object: Word | None = None
    state: Literal["connected", "enabled", "hold", "fault"] | None = None
    error: ErrorClass | None = None
    joint: Word | None = None
    cause: Word | None = None
    status: Word | None = None
    step_seconds: Span | None = None
    run_seconds: Span | None = None

    @model_validator(mode="after")
    def _something(self) -> ExpectStep:
        if all(getattr(self, key) is None for key in (*_POSE_KEYS, *_REST)):
            raise KeyProblem(
                "nothing is expected", allowed=f"one or more of {', '.join((*_POSE_KEYS, *_REST))}"
            )
        if self.object is not None and self.position is None:
            raise KeyProblem("this key is missing", "position", "where the object is to lie")
        return self

    def check(self, now: RunState) -> None:
        super().check(now)
        if self.shafts and not now.simulated:
            problem = "nobody knows where real shafts are"
            raise KeyProblem(problem, "shafts", f"false, or {SIMULATED}")
        require_known("keyframe", self.keyframe, keyframes(now.robot), "keyframe")
        require_known("status", self.status, [status.name for status in Status], "status")
        require_known("joint", self.joint, now.robot.joints, "joint")
        if self.width_mm is not None:
            self.check_gripper(now)

    def run(self, now: RunState, result: StepResult) -> None:
        """Looks at everything that is expected, and reports all of it.

        Raises:
            StepFailed: Something is otherwise.
            RobotIkError: Of the arm, while it is read.
        """
        report_findings([*self._poses(now), *self._error(now), *self._rest(now)], result)

    def _poses(self, now: RunState) -> Iterator[Finding]:
        if self.width_mm is not None:
            off = abs(width_mm(now) - self.width_mm)
            yield near(off, self.tolerance_mm, " mm", "gripper's width", "width_off_mm")
        if self.object is not None and self.position is not None:
            off = 1e3 * float(np.linalg.norm(_position_of(now, self.object) - self.position))
            yield near(off, self.tolerance_mm, " mm", self.object, "off_mm")
            return
        placed = self.position is not None or self.wxyz is not None
        jointwise = any(key is not None for key in (self.joints_deg, self.joints_mm, self.keyframe))
        if not placed and not jointwise:
            return
        q = now.setup.true_q() if self.shafts else now.setup.q
        if placed:
            yield from self._pose(now.robot, q)
        if jointwise:
            goal = q if self.keyframe is None else keyframes(now.robot)[self.keyframe]
            yield self.farthest(now.robot, q, self.placed(now.robot, goal), "joint_off")

    def _pose(self, robot: Robot, q: Array) -> Iterator[Finding]:
        """How far the frame at ``q`` is off, by MuJoCo."""
        at, what = robot.measure(q, self.frame), self.frame or robot.tool
        if self.position is not None:
            metres = float(np.linalg.norm(at.position - np.asarray(self.position)))
            yield near(1e3 * metres, self.tolerance_mm, " mm", what, "off_mm")
        if self.wxyz is not None:
            degrees = float(np.degrees(at.distance(Pose(at.position, self.wxyz))[1]))
            yield near(degrees, self.tolerance_deg, "°", what, "off_deg")

    def _error(self, now: RunState) -> Iterator[Finding]:
        wanted = [word for word in (self.error, self.joint, self.cause) if word is not None]
        if not wanted:
            return
        error = now.error
        if error is None:
            yield Finding(False, "no error", ", ".join(wanted))
            return
        if self.error is not None:
            right = isinstance(error, error_classes()[self.error])
            yield Finding(right, type(error).__name__, self.error)
        if self.joint is not None:
            joint = str(getattr(error, "joint", ""))
            yield Finding(joint == self.joint, joint or "no joint", self.joint)
        if self.cause is not None:
            causes = getattr(error, "status", ())
            yield Finding(self.cause in causes, ", ".join(causes) or "no cause", self.cause)

    def _rest(self, now: RunState) -> Iterator[Finding]:
        if self.state is not None:
            state = now.arm.state.value
            yield Finding(state == self.state, f"state {state}", self.state)
        if self.status is not None:
            yield Finding(now.status == self.status, f"solver {now.status or 'not asked'}", self.status)
        for what, seconds, span in (
            ("last step", now.seconds, self.step_seconds),
            ("run", now.now(), self.run_seconds),
        ):
            if span is not None:
                inside = span[0] - ROUNDING <= seconds <= span[1] + ROUNDING
                yield Finding(inside, f"{what} {seconds:.3f} s", f"{span[0]:g} … {span[1]:g} s")


def _position_of(now: RunState, name: str) -> Array:
    """(3,) m where an object lies, as the world has it; it is not measured."""
    if now.servos.world is None:
        raise RuntimeError("the simulated servos move in no world")
    with now.servos.lock:
        now.servos.advance()
        return np.array(now.servos.world.data.body(name).xpos)
