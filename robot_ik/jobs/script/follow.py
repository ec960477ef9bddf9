"""The step that follows a goal which moves."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.errors import apart
from robot_ik.execution import follow
from robot_ik.jobs.reach_report import SOLVE_TOLERANCE
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.situation import Situation, StepFailed
from robot_ik.jobs.script.steps import FollowStep
from robot_ik.motion.sources import CurveSource

if TYPE_CHECKING:
    from robot_ik.motion.reports import FollowReport
    from robot_ik.ports import Array

_ARRIVE = 0.4
"""s given to the servos at the end before the marker's true place judges them."""


def follow_goal(now: Situation, step: FollowStep, result: StepResult) -> None:
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
            clock=now.limbs.clock,
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
def _goals(now: Situation, step: FollowStep, frame: str) -> Iterator[Any]:
    if step.path == "marker":
        assert now.eyes is not None
        with now.eyes.following(now.limbs.clock, step.seconds) as goals:
            yield goals
        return
    assert step.center is not None and step.radius is not None and step.period is not None
    make = CurveSource.circle if step.path == "circle" else CurveSource.lemniscate
    normal = step.normal or (0.0, 0.0, 1.0)
    yield make(frame, step.center, step.radius, step.period, normal=normal, wxyz=step.wxyz)


def _true_goal(now: Situation) -> Array:
    """(3,) where the tool belongs at this moment, which only the scene knows."""
    assert now.eyes is not None and now.eyes.path is not None
    marker = now.eyes.path(now.limbs.clock.now())
    return marker.compose(now.eyes.stage.pose_marker_tool).position


def _tell(
    now: Situation, step: FollowStep, report: FollowReport, behind: list[float], result: StepResult
) -> None:
    now.status = "" if report.last is None else report.last.status.name
    result.numbers.update(ticks=report.ticks, held=report.held, solved=report.solved)
    if not (behind and report.solved):
        raise StepFailed(f"no goal was seen after {step.catch_up_s:g} s")
    if now.eyes is not None and now.eyes.delays is not None and now.eyes.delays[1].count:
        result.numbers["picture_age_p95_s"] = round(now.eyes.delays[1].p95, 4)
    median, worst = float(np.median(behind)), max(behind)
    result.numbers.update(behind_median_mm=round(median, 4), behind_worst_mm=round(worst, 4))
    most, allowed = apart(worst, step.tolerance_mm, digits=2)
    result.found = f"median {median:.2f} mm, worst {most} mm behind; allowed {allowed} mm"
    if worst > step.tolerance_mm:
        raise StepFailed(f"lost the goal: {result.found}")


def _judge_by_truth(now: Situation, step: FollowStep, result: StepResult) -> None:
    """Where the marker really lies in the end, which only the scene knows."""
    assert now.eyes is not None
    now.repeat(_ARRIVE)
    seen = now.eyes.find_target_again()
    assert seen.true_pose is not None
    true = seen.true_pose.compose(now.eyes.stage.pose_marker_tool)
    at = now.robot.measure(now.arm.read().q, now.limbs.frame)
    off = 1e3 * float(np.linalg.norm(at.position - true.position))
    result.numbers["off_mm"] = round(off, 4)
    result.found += f"; {off:.2f} mm from where it truly lies"
    if off > step.tolerance_mm:
        raise StepFailed(result.found)
