"""The step that follows a goal which moves."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.execution import follow
from robot_ik.jobs.reach_report import SOLVE_TOLERANCE
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.situation import Situation, StepFailed
from robot_ik.jobs.script.steps import FollowStep
from robot_ik.motion.sources import CurveSource

if TYPE_CHECKING:
    from robot_ik.motion.reports import FollowReport

_ARRIVE = 0.4
"""s given to the servos at the end before the marker's true place judges them."""


def follow_goal(now: Situation, step: FollowStep, result: StepResult) -> None:
    """Follows for the time; judges every tick after ``catch_up_s``, and a marker's true place at the end.

    Raises:
        StepFailed: Farther off than allowed, or there never was a goal.
        RobotIkError: Of the arm or the camera.
    """
    frame = step.frame or now.robot.tool
    behind: list[float] = []

    def note(tick: Any) -> None:
        if tick.goal is not None and tick.time >= step.catch_up_s:
            place = now.robot.forward(tick.measured, frame).position
            behind.append(1e3 * float(np.linalg.norm(place - tick.goal.target.position)))

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


def _tell(
    now: Situation, step: FollowStep, report: FollowReport, behind: list[float], result: StepResult
) -> None:
    now.status = "" if report.last is None else report.last.status.name
    result.numbers.update(ticks=report.ticks, held=report.held, solved=report.solved)
    if not behind:
        raise StepFailed(f"no goal was seen after {step.catch_up_s:g} s")
    median, worst = float(np.median(behind)), max(behind)
    result.numbers.update(behind_median_mm=round(median, 4), behind_worst_mm=round(worst, 4))
    result.found = f"median {median:.2f} mm, worst {worst:.2f} mm behind; allowed {step.tolerance_mm:.2f} mm"
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
