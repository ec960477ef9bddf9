"""The step that checks conditions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from pydantic import model_validator

from robot_ik.config import KeyProblem, Position, Word, Wxyz
from robot_ik.geometry import Pose
from robot_ik.hardware import SIMULATED
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.script.state import RunState, StepResult, error_classes
from robot_ik.script.steps.base import ErrorClass, Framed, Span, require_known
from robot_ik.script.steps.findings import Finding, error_finding, report_findings
from robot_ik.script.steps.gripper import GripperWidth, width_mm
from robot_ik.script.steps.joints import JointValues, Tolerant, keyframes
from robot_ik.solution import Status

#: Tolerance of durations, seconds. Sums of control periods are not exact.
ROUNDING = 1e-9

#: Keys of the conditions on positions.
_POSE_KEYS = ("position", "wxyz", "joints_deg", "joints_mm", "keyframe", "width_mm")
#: Keys of all conditions.
_CONDITION_KEYS = (
    *_POSE_KEYS,
    "state",
    "error",
    "joint",
    "cause",
    "status",
    "step_seconds",
    "run_seconds",
)


class ExpectStep(Framed, JointValues, Tolerant, GripperWidth):
    """Check one or more conditions.

    Attributes:
        position: Position of the frame or of ``object``, metres.
        wxyz: Orientation of the frame, as a unit quaternion.
        keyframe: Keyframe of the model whose joint values are expected.
        shafts: Whether to measure the true simulated shafts instead of the servos' registers.
        object: Object of the script whose position is checked instead of the frame's.
        width_mm: Width between the fingers, within ``tolerance_mm``.
        state: State of the arm.
        error: Class of the last error.
        joint: Joint of the last error.
        cause: Cause that the last error reports.
        status: Status of the last solve.
        step_seconds: Shortest and longest duration of the last action, seconds.
        run_seconds: Shortest and longest duration of the run up to now, seconds.
    """

    title_keys = ("keyframe", "joint", "position", "joints_deg", "joints_mm", "width_mm")
    ignores_limits = True

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
    def _check_conditions(self) -> ExpectStep:
        if all(getattr(self, key) is None for key in _CONDITION_KEYS):
            allowed = f"one or more of {', '.join(_CONDITION_KEYS)}"
            raise KeyProblem("nothing is expected", allowed=allowed)
        if self.object is not None and self.position is None:
            raise KeyProblem("this key is missing", "position", "the position of the object")
        return self

    def check(self, state: RunState) -> None:
        """Check the names, and that the arm can measure the conditions."""
        super().check(state)
        if self.shafts and not state.simulated:
            problem = "the true positions of real shafts cannot be measured"
            raise KeyProblem(problem, "shafts", f"false, or {SIMULATED}")
        require_known("keyframe", self.keyframe, keyframes(state.robot), "keyframe")
        require_known("status", self.status, [status.name for status in Status], "status")
        require_known("joint", self.joint, state.robot.joints, "joint")
        if self.width_mm is not None:
            self.check_gripper(state)

    def run(self, state: RunState, result: StepResult) -> None:
        """Measure all conditions and report all of them.

        Raises:
            StepFailed: A condition does not hold.
            RobotIkError: The arm failed while it was read.
        """
        findings = [
            *self._position_findings(state),
            *self._error_findings(state),
            *self._state_findings(state),
            *self._time_findings(state),
        ]
        report_findings(findings, result)

    def _position_findings(self, state: RunState) -> Iterator[Finding]:
        """Yield the findings about the gripper, an object, the frame and the joints."""
        if self.width_mm is not None:
            error = abs(width_mm(state) - self.width_mm)
            yield error_finding(error, self.tolerance_mm, " mm", "gripper's width", "width_off_mm")
        if self.object is not None and self.position is not None:
            difference = _object_position(state, self.object) - self.position
            error = 1e3 * float(np.linalg.norm(difference))
            yield error_finding(error, self.tolerance_mm, " mm", self.object, "off_mm")
            return

        expects_pose = self.position is not None or self.wxyz is not None
        joint_values = (self.joints_deg, self.joints_mm, self.keyframe)
        expects_joints = any(value is not None for value in joint_values)
        if not expects_pose and not expects_joints:
            return
        q = state.setup.true_q() if self.shafts else state.setup.q
        if expects_pose:
            yield from self._pose_findings(state.robot, q)
        if expects_joints:
            base = q if self.keyframe is None else keyframes(state.robot)[self.keyframe]
            target = self.with_values(state.robot, base)
            yield self.farthest(state.robot, q, target, "joint_off")

    def _pose_findings(self, robot: Robot, q: Array) -> Iterator[Finding]:
        """Yield the errors of the frame at ``q``, (nq,) in rad and m, by MuJoCo's kinematics."""
        pose = robot.measure(q, self.frame)
        frame = self.frame or robot.tool
        if self.position is not None:
            error = 1e3 * float(np.linalg.norm(pose.position - np.asarray(self.position)))
            yield error_finding(error, self.tolerance_mm, " mm", frame, "off_mm")
        if self.wxyz is not None:
            _, angle = pose.distance(Pose(pose.position, self.wxyz))
            error = float(np.degrees(angle))
            yield error_finding(error, self.tolerance_deg, "°", frame, "off_deg")

    def _error_findings(self, state: RunState) -> Iterator[Finding]:
        """Yield the findings about the last error."""
        expected = [word for word in (self.error, self.joint, self.cause) if word is not None]
        if not expected:
            return
        error = state.error
        if error is None:
            yield Finding(False, "no error", ", ".join(expected))
            return
        if self.error is not None:
            ok = isinstance(error, error_classes()[self.error])
            yield Finding(ok, type(error).__name__, self.error)
        if self.joint is not None:
            joint = str(getattr(error, "joint", ""))
            yield Finding(joint == self.joint, joint or "no joint", self.joint)
        if self.cause is not None:
            causes = getattr(error, "status", ())
            yield Finding(self.cause in causes, ", ".join(causes) or "no cause", self.cause)

    def _state_findings(self, state: RunState) -> Iterator[Finding]:
        """Yield the findings about the state of the arm and the status of the solver."""
        if self.state is not None:
            arm_state = state.arm.state.value
            yield Finding(arm_state == self.state, f"state {arm_state}", self.state)
        if self.status is not None:
            measured = f"solver {state.status or 'not run'}"
            yield Finding(state.status == self.status, measured, self.status)

    def _time_findings(self, state: RunState) -> Iterator[Finding]:
        """Yield the findings about the durations of the last action and of the run."""
        rows = (
            ("last step", state.seconds, self.step_seconds),
            ("run", state.now(), self.run_seconds),
        )
        for what, seconds, span in rows:
            if span is None:
                continue
            shortest, longest = span
            ok = shortest - ROUNDING <= seconds <= longest + ROUNDING
            yield Finding(ok, f"{what} {seconds:.3f} s", f"{shortest:g} … {longest:g} s")


def _object_position(state: RunState, name: str) -> Array:
    """Return the true position of an object in the simulated world, (3,) in metres."""
    world = state.servos.world
    if world is None:
        raise RuntimeError("the simulated servos have no world")
    with state.servos.lock:
        state.servos.advance()
        return np.array(world.data.body(name).xpos)
