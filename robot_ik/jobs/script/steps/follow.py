"""The step that follows a goal which moves: a curve, or the printed marker."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import model_validator

from robot_ik.errors import apart
from robot_ik.execution import follow
from robot_ik.jobs.reach import SOLVE_TOLERANCE
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.state import RunState, StepFailed
from robot_ik.jobs.script.steps.base import Action, Framed, NotNegative, Positive, Seconds, Share
from robot_ik.motion.sources import CurveSource
from robot_ik.tables import Position, WrongKey, Wxyz

if TYPE_CHECKING:
    from robot_ik.execution import FollowReport
    from robot_ik.ports import Array


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
                    raise WrongKey(problem, key, 'nothing, or path = "circle" or "eight"')
            return self
        for key in ("center", "radius", "period"):
            if getattr(self, key) is None:
                raise WrongKey("this key is missing", key, f'a value, for path = "{self.path}"')
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
            true = _true_goal(now) if self.needs_camera else tick.goal.target.position
            behind.append(1e3 * float(np.linalg.norm(place - true)))

        with self._goals(now, frame) as goals:
            report = follow(
                goals,
                now.robot,
                now.solver,
                now.setup.sinks,
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
        if self.needs_camera:
            self._judge_at_end(now, result)

    @contextlib.contextmanager
    def _goals(self, now: RunState, frame: str) -> Iterator[Any]:
        if self.needs_camera:
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
        now.setup.repeat(_ARRIVE)
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
