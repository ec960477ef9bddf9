"""The step that follows a moving goal: a curve, or the printed marker."""

from __future__ import annotations

import contextlib
from typing import Any, Literal

import numpy as np
from pydantic import model_validator

from robot_ik.config import KeyProblem, Position, Positive, Wxyz
from robot_ik.errors import distinct_texts
from robot_ik.execution import FollowReport, follow
from robot_ik.motion.sources import CurveSource
from robot_ik.ports import Array
from robot_ik.script.state import RunState, StepFailed, StepResult
from robot_ik.script.steps.base import Action, Framed, NotNegative, Seconds, Share
from robot_ik.workcell.verdict import SOLVE_TOLERANCE

#: Time for the servos to arrive before the final error to the marker is measured, seconds.
SETTLING_TIME = 0.4
#: Normal of the plane of a curve if the script gives none: the world's z axis.
DEFAULT_NORMAL = (0.0, 0.0, 1.0)


class FollowStep(Framed, Action):
    """Follow a moving goal with the frame: a circle, a figure of eight, or the printed marker.

    Attributes:
        path: Kind of the goal.
        seconds: Duration of the step.
        center: Centre of the curve in the world frame, metres.
        radius: Radius of the curve, metres.
        period: Time of one round, seconds.
        normal: Normal of the curve's plane. None: the world's z axis.
        wxyz: Orientation of the frame, as a unit quaternion. None: any orientation.
        speed: Share of the speed limits. None: the script's speed.
        catch_up_s: Time at the start in which the error is not checked, seconds.
        tolerance_mm: Largest distance from the frame to the goal at each later tick, millimetres.
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
    def _check_path(self) -> FollowStep:
        if self.path == "marker":
            for key in ("center", "radius", "period", "normal", "wxyz", "frame"):
                if getattr(self, key) is not None:
                    problem = f'path = "marker" does not use {key}'
                    allowed = 'nothing, or path = "circle" or "eight"'
                    raise KeyProblem(problem, key, allowed)
            return self
        for key in ("center", "radius", "period"):
            if getattr(self, key) is None:
                allowed = f'a value, for path = "{self.path}"'
                raise KeyProblem("this key is missing", key, allowed)
        return self

    @property
    def needs_camera(self) -> bool:
        """Whether the step needs the synthetic camera."""
        return self.path == "marker"

    def run(self, state: RunState, result: StepResult) -> None:
        """Follow the goal and check the error at each tick after ``catch_up_s``.

        The error to a marker is that to its true pose in the scene at the time of the tick, not to
        the pose that the camera measured in an older picture. It is checked once more at the end.

        Raises:
            StepFailed: The error was too large, or there was no goal.
            RobotIkError: The arm or the camera failed.
        """
        frame = self.frame or state.robot.tool
        setup = state.setup
        errors_mm: list[float] = []

        def measure(tick: Any) -> None:
            if tick.time < self.catch_up_s:
                return
            if self.needs_camera:
                goal_position = _true_goal_position(state)
            elif tick.goal is not None:
                goal_position = tick.goal.target.position
            else:
                return
            position = state.robot.forward(tick.measured, frame).position
            errors_mm.append(1e3 * float(np.linalg.norm(position - goal_position)))

        with self._goals(state, frame) as goals:
            report = follow(
                state.robot,
                goals,
                sinks=setup.begin_stream(),
                solver=state.solver,
                rate=setup.rate,
                clock=setup.clock,
                duration=self.seconds,
                start=state.start(),
                tolerance=SOLVE_TOLERANCE,
                speed=self.speed or state.script.speed,
                source=setup.opened,
                on_tick=measure,
                collisions=setup.collisions,
            )
        self._report_errors(state, report, errors_mm, result)
        if self.needs_camera:
            self._report_final_error(state, result)

    def _goals(self, state: RunState, frame: str) -> contextlib.AbstractContextManager[Any]:
        """Return a context with the source of the goals."""
        if self.needs_camera:
            if state.vision is None:
                raise RuntimeError("this step needs a camera")
            return state.vision.following(state.setup.clock, self.seconds)
        if self.center is None or self.radius is None or self.period is None:
            raise RuntimeError("a curve needs center, radius and period")
        make_curve = CurveSource.circle if self.path == "circle" else CurveSource.lemniscate
        normal = self.normal or DEFAULT_NORMAL
        curve = make_curve(
            frame, self.center, self.radius, self.period, normal=normal, wxyz=self.wxyz
        )
        return contextlib.nullcontext(curve)

    def _report_errors(
        self, state: RunState, report: FollowReport, errors_mm: list[float], result: StepResult
    ) -> None:
        """Write the errors of the ticks into ``result``.

        Raises:
            StepFailed: An error was too large, or there was no goal.
        """
        state.status = "" if report.last is None else report.last.status.name
        result.numbers.update(ticks=report.ticks, held=report.held, solved=report.solved)
        if not errors_mm or not report.solved:
            raise StepFailed(f"no goal was seen after {self.catch_up_s:g} s")

        if state.vision is not None and state.vision.delays is not None:
            picture_age = state.vision.delays[1]
            if picture_age.count:
                result.numbers["picture_age_p95_s"] = round(picture_age.p95, 4)

        median = float(np.median(errors_mm))
        worst = max(errors_mm)
        result.numbers.update(behind_median_mm=round(median, 4), behind_worst_mm=round(worst, 4))
        largest, allowed = distinct_texts(worst, self.tolerance_mm, digits=2)
        result.found = f"median {median:.2f} mm, worst {largest} mm behind; allowed {allowed} mm"
        if worst > self.tolerance_mm:
            raise StepFailed(f"lost the goal: {result.found}")

    def _report_final_error(self, state: RunState, result: StepResult) -> None:
        """Let the servos arrive, and write the error to the true marker into ``result``.

        Raises:
            StepFailed: The error is too large.
        """
        state.setup.repeat(SETTLING_TIME)
        position = state.robot.measure(state.setup.q).position
        error_mm = 1e3 * float(np.linalg.norm(position - _true_goal_position(state)))
        result.numbers["off_mm"] = round(error_mm, 4)
        result.found += f"; {error_mm:.2f} mm from the true goal"
        if error_mm > self.tolerance_mm:
            raise StepFailed(result.found)


def _true_goal_position(state: RunState) -> Array:
    """Return the true position of the tool's goal above the marker, (3,) in metres.

    The scene gives it, so it has no error of the camera.
    """
    if state.vision is None:
        raise RuntimeError("this step needs a camera")
    marker = state.vision.true_target(state.setup.clock.now())
    if marker is None:
        raise RuntimeError("the camera of a script must be synthetic")
    return marker.compose(state.vision.scene.pose_marker_tool).position
