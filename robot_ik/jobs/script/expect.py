"""The step that says what must be true now."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.errors import apart
from robot_ik.jobs.script.file import error_classes
from robot_ik.jobs.script.gripping import width_mm
from robot_ik.jobs.script.moves import joints_miss, keyframes, pose_miss, with_joints
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.situation import Situation, StepFailed
from robot_ik.jobs.script.steps import ExpectStep

if TYPE_CHECKING:
    from robot_ik.ports import Array

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


def expect(now: Situation, step: ExpectStep, result: StepResult) -> None:
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


def _places(now: Situation, step: ExpectStep) -> Iterator[_Finding]:
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
    q = now.limbs.true_q() if step.shafts else now.arm.read().q
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


def _place_of(now: Situation, thing: str) -> Array:
    """(3,) m where a thing lies, which nobody measures: the world knows."""
    servos = now.arm.virtual_bus
    assert servos is not None and servos.world is not None
    with servos.lock:
        servos.advance()
        return np.array(servos.world.data.body(thing).xpos)


def _near(off: float, allowed: float, unit: str, what: str, key: str) -> _Finding:
    here, most = apart(off, allowed, digits=2)
    return _Finding(off <= allowed, f"{what} {here}{unit} off", f"at most {most}{unit}", {key: round(off, 4)})


def _error(now: Situation, step: ExpectStep) -> Iterator[_Finding]:
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


def _rest(now: Situation, step: ExpectStep) -> Iterator[_Finding]:
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
