"""The results of the phases of a reach, as tables and as ``summary.json``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from robot_ik.commands.tables import plural, table
from robot_ik.commands.terminal import Report
from robot_ik.errors import RobotIkError, distinct_texts
from robot_ik.files import plain, timestamp

if TYPE_CHECKING:
    from robot_ik.commands.reach import Reach
    from robot_ik.execution import Execution, FollowReport
    from robot_ik.geometry import Pose
    from robot_ik.goals import Goal, Tolerance
    from robot_ik.motion.trajectory import Trajectory
    from robot_ik.ports import Array
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution
    from robot_ik.workcell.marker_turn import AxisPrediction
    from robot_ik.workcell.robot_setup import JointLimits, RobotSetup
    from robot_ik.workcell.verdict import Bound, Judgement
    from robot_ik.workcell.vision import SeenTarget, Vision


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution, and the time of a solve with a loaded kernel."""

    solution: Solution
    microseconds: float


@dataclass(frozen=True, eq=False)
class Followed:
    """The result of ``--follow``.

    Attributes:
        ticks: Report of the ticks.
        median: Median distance of the tool from the goal, metres. None without a goal.
        largest: Largest distance, metres. None without a goal.
    """

    ticks: FollowReport
    median: float | None
    largest: float | None


@dataclass(frozen=True, eq=False)
class Judged:
    """Two measurements of the error: by the servos' positions and by the camera.

    Attributes:
        q: (nq,) joint angles read back.
        bound: Error that the servos' resolution and the solver explain.
        read_back: Measurement by the servos.
        by_camera: None if no picture shows the gripper.
        blind: Reason why no camera looked at the arm, empty if one did.
        image: The last picture.
    """

    q: Array
    bound: Bound
    read_back: Judgement
    by_camera: Judgement | None
    blind: str
    image: Any


@dataclass(eq=False)
class ReachReport(Report):
    """What happened, as far as the run got. The results of phases that did not run are None.

    Attributes:
        command: The options of the run.
        setup: Robot and servos.
        vision: Camera.
        goal: The goal. After ``--follow`` it is the last one.
        seen: The sighting of the target marker. None if the goal was given.
        q_start: (nq,) joint angles before the motion.
        solved: The solution.
        accepted: Error of the solution that is accepted. None if the error is larger.
        prediction: Predicted axis error of an arm with five joints.
        trajectory: The planned motion.
        execution: The motion.
        followed: What happened during ``--follow``.
        judged: Measurements of the error.
        before: The first picture.
        error: Error that means "tried and not achieved".
        counters: Totals of the bus.
        folder: Result folder. None if no files were written.
        files: The written files.
    """

    command: Reach
    setup: RobotSetup
    vision: Vision | None
    goal: Goal | None = None
    seen: SeenTarget | None = None
    q_start: Array | None = None
    solved: Solved | None = None
    accepted: Tolerance | None = None
    prediction: AxisPrediction | None = None
    trajectory: Trajectory | None = None
    execution: Execution | None = None
    followed: Followed | None = None
    judged: Judged | None = None
    before: Any = None
    error: RobotIkError | None = None
    counters: dict[str, int] = field(default_factory=dict)
    folder: Path | None = None
    files: list[Path] = field(default_factory=list)

    @property
    def robot(self) -> Robot:
        """The robot with the limits that were used."""
        return self.setup.robot

    @property
    def frame(self) -> str:
        """The frame that moves to the goal."""
        return self.setup.frame

    @property
    def solution(self) -> Solution | None:
        """The joint angles that were found. The goal may be out of their reach."""
        return None if self.solved is None else self.solved.solution

    @property
    def failure(self) -> RobotIkError | None:
        return self.error

    @property
    def ok(self) -> bool:
        return self.decision[0]

    @property
    def verdict(self) -> str:
        """One sentence on the result; empty if ``error`` describes it."""
        return self.decision[1]

    @property
    def decision(self) -> tuple[bool, str]:
        """Whether the goal is reached, and why."""
        from robot_ik.workcell.verdict import decide

        if self.error is not None or self.judged is None:
            return False, ""
        return decide(
            self.judged.read_back,
            self.judged.by_camera,
            servos=self.setup.arm is not None,
            blind=self.judged.blind,
            seen_goal=self.seen is not None,
            stopped_short=self._stopped_short(),
            followed=self.followed is not None,
        )

    def _stopped_short(self) -> str:
        """Return a sentence on the servo that is farthest from its command, empty if none is."""
        if self.execution is None or self.execution.final_error is None or self.followed:
            return ""
        error = self.execution.final_error
        worst = int(abs(error).argmax())
        if abs(error[worst]) <= self.setup.resolution[worst]:
            return ""
        degrees = math.degrees(abs(float(error[worst])))
        joint = self.execution.joints[worst]
        return (
            f"{joint} is {degrees:.2f}° from its command by its registers: "
            "is it held, overloaded or too slow?"
        )

    def save(self, folder: Path | None) -> None:
        """Write picture, trajectory and summary to the folder, and the video to its file."""
        from robot_ik.commands.reach_picture import save_files, save_video

        if folder is not None:
            self.folder = folder
            self.files = save_files(self, folder)
        if self.command.video is not None:
            save_video(self, self.command.video)

    def tables(self) -> Iterable[Any]:
        """Return the limits of the joints, and one row for each thing that happened."""
        limits = [(row.joint, _range(row), _narrowed(row)) for row in self.setup.limits]
        yield table("joint", "limits used", "narrowed by", rows=limits)
        title = self.robot.file.title or self.robot.name
        yield table("reach", title, rows=self._rows())
        if self.folder is not None:
            names = "  ".join(file.name for file in self.files)
            yield f"files in {self.folder}: {names}"

    def _rows(self) -> Iterator[tuple[str, str | Text]]:
        yield from self._goal_rows()
        yield from self._solution_rows()
        yield from self._motion_rows()
        yield from self._judgement_rows()
        outcome = ("REACHED", "bold green") if self.ok else ("NOT REACHED", "bold red")
        yield "result", Text.assemble(outcome, f"  {self.verdict}" if self.verdict else "")

    def _goal_rows(self) -> Iterator[tuple[str, str]]:
        seen = self.seen
        if seen is not None:
            position = _millimetres(seen.pose_world_marker)
            yield f"marker {seen.observation.ids[0]}", f"seen at {position} mm"
            if seen.true_pose is not None:
                metres, radians = seen.pose_world_marker.distance(seen.true_pose)
                error = f"{1e3 * metres:.2f} mm, {math.degrees(radians):.2f}°"
                yield "", f"true at {_millimetres(seen.true_pose)} mm; error {error}"
            else:
                pose = seen.observation.pose
                quaternion = " ".join(f"{value:z.4f}" for value in pose.wxyz)
                yield "", f"in the camera's frame {_millimetres(pose)} mm, wxyz {quaternion}"
        if self.goal is not None:
            axis = getattr(self.goal, "free_axis", None)
            free = f", {axis} axis as seen, free to turn about it" if axis else ""
            yield "goal", f"{self.frame} at {_millimetres(self.goal.target)} mm{free}"

    def _solution_rows(self) -> Iterator[tuple[str, str]]:
        if self.solved is None:
            return
        solution = self.solved.solution
        status = solution.status.name.lower()
        angle = math.degrees(solution.error.angle)
        error = f"{1e3 * solution.error.position:.4f} mm, {angle:.4f}°  (by MuJoCo)"
        if self.accepted is not None and not solution.converged:
            status = f"exact goal not met ({status})"
            allowed = f"{1e3 * self.accepted.position:.2f} mm"
            allowed += f", {math.degrees(self.accepted.angle):.2f}°"
            error += f"; allowed {allowed} (3 σ of the marker)"
        parts = [f"{solution.solver}: {status}"]
        parts.append(plural(solution.iterations, "iteration"))
        if solution.restarts:
            parts.append(plural(solution.restarts, "restart"))
        parts.append(f"{self.solved.microseconds:.0f} µs")
        yield "solver", ", ".join(parts)
        yield "error", error
        if self.prediction is not None and not self.prediction.is_met:
            yield "axis", self.prediction.sentence()

    def _motion_rows(self) -> Iterator[tuple[str, str]]:
        run = self.execution
        if run is not None:
            text = f"{run.duration:.2f} s at {run.rate:.1f} Hz"
            if run.tracking_error is not None:
                worst = int(run.tracking_error.argmax())
                error = math.degrees(float(run.tracking_error[worst]))
                text += f"; largest tracking error {error:.2f}° ({run.joints[worst]})"
            if self.trajectory is not None and self.trajectory.certified:
                text += "; proven free of collisions"
            yield "motion", text
        if self.followed is not None:
            ticks = self.followed.ticks
            text = f"{ticks.duration:.1f} s at {ticks.rate:.1f} Hz"
            yield "following", f"{text}; {ticks.held} of {ticks.ticks} ticks without a goal"
            if self.followed.median is not None and self.followed.largest is not None:
                median = 1e3 * self.followed.median
                largest = 1e3 * self.followed.largest
                text = f"median {median:.1f} mm, largest {largest:.1f} mm"
                yield "", f"distance of the tool from the goal: {text}"
        delays = None if self.vision is None else self.vision.delays
        if delays is not None and delays[1].count:
            ready = f"goal after {delays[0]}; " if delays[0].count else ""
            yield "delay", f"{ready}age of the picture at a tick {delays[1]}"
        if self.counters:
            names = ("cycles", "timeouts", "corrupt", "retries", "alerts")
            port = self.command.bus.rsplit("/", 1)[-1]
            yield f"bus {port}", ", ".join(f"{self.counters[name]} {name}" for name in names)

    def _judgement_rows(self) -> Iterator[tuple[str, str]]:
        if self.judged is None:
            return
        servos = self.setup.arm is not None
        read_back = self.judged.read_back
        by_camera = self.judged.by_camera
        allowed = "servo ticks" if servos else "tolerance of the solver"
        if read_back.sigma.position > 0.0:
            allowed = f"3 σ of the goal + {allowed}"
        yield "read back", f"{_error_text(read_back)} ({allowed})"
        if by_camera is not None:
            allowed = "ticks" if servos else "tolerance"
            angle = math.degrees(by_camera.sigma.angle)
            sigma = f"σ {1e3 * by_camera.sigma.position:.2f} mm {angle:.2f}°"
            yield "camera", f"{_error_text(by_camera)} (3 σ + {allowed}, {sigma})"

    def facts(self) -> dict[str, Any]:
        """Return the content of ``summary.json``: SI units, quaternions w x y z, world frame."""
        return {
            "job": "reach",
            "created": timestamp(),
            "reached": self.ok,
            "problem": None if self.error is None else str(self.error),
            "robot": {
                "name": self.robot.name,
                "joints": self.robot.joints,
                "frame": self.frame,
            },
            "bus": self.command.bus,
            "camera": None if self.vision is None else self.command.camera,
            "marker": self._marker_facts(),
            "goal": self._goal_facts(),
            "limits": [asdict(limit) for limit in self.setup.limits],
            "solution": self._solution_facts(),
            "motion": self._motion_facts(),
            "following": self._following_facts(),
            "q": None if self.judged is None else self.judged.q,
            "read_back": None if self.judged is None else judgement_facts(self.judged.read_back),
            "by_camera": None if self.judged is None else judgement_facts(self.judged.by_camera),
            "verdict": self.verdict,
            "bus_counters": self.counters,
            "folder": None if self.folder is None else str(self.folder),
        }

    def _marker_facts(self) -> dict[str, Any] | None:
        if self.seen is None:
            return None
        observation = self.seen.observation
        return {
            "id": observation.ids[0],
            "camera": observation.pose,
            "world": self.seen.pose_world_marker,
            "true_world": self.seen.true_pose,
            "corners_px": observation.pixels,
            "reprojection_error_px": observation.reprojection_error,
            "ambiguity": observation.ambiguity,
            "covariance": observation.covariance,
        }

    def _goal_facts(self) -> dict[str, Any] | None:
        if self.goal is None:
            return None
        return {
            **plain(self.goal.target),
            "position_asked": self.goal.weights[0] > 0.0,
            "angle_asked": self.goal.weights[1] > 0.0,
            "free_axis": getattr(self.goal, "free_axis", None),
            "orientation": getattr(self.goal, "orientation", None),
        }

    def _solution_facts(self) -> dict[str, Any] | None:
        if self.solved is None:
            return None
        solution = self.solved.solution
        return {
            "solver": solution.solver,
            "status": solution.status.name.lower(),
            "q": solution.q,
            "iterations": solution.iterations,
            "restarts": solution.restarts,
            "microseconds": self.solved.microseconds,
            "miss_position_m": solution.error.position,
            "miss_angle_rad": solution.error.angle,
            "angle_bound_rad": solution.angle_bound,
        }

    def _motion_facts(self) -> dict[str, Any] | None:
        run = self.execution
        if run is None:
            return None
        return {
            "duration_s": run.duration,
            "rate_hz": run.rate,
            "overruns": run.overruns,
            "tracking_error_rad": run.tracking_error,
            "samples": len(run.times),
        }

    def _following_facts(self) -> dict[str, Any] | None:
        if self.followed is None:
            return None
        ticks = self.followed.ticks
        facts = {
            "ticks": ticks.ticks,
            "solved": ticks.solved,
            "held": ticks.held,
            "capped": ticks.capped,
            "rate_hz": ticks.rate,
            "tracking_error_rad": ticks.tracking_error,
            "behind_median_m": self.followed.median,
            "behind_largest_m": self.followed.largest,
        }
        delays = None if self.vision is None else self.vision.delays
        for index, name in enumerate(("grab_to_goal", "picture_age")):
            delay = None if delays is None else delays[index]
            for part in ("p50", "p95"):
                seconds = getattr(delay, part) if delay is not None and delay.count else None
                facts[f"{name}_{part}_s"] = seconds
        return facts


def judgement_facts(judged: Judgement | None) -> dict[str, Any] | None:
    """Return one measurement of the error for ``summary.json``."""
    if judged is None:
        return None
    return {
        "passed": judged.passed,
        "position_m": judged.position,
        "angle_rad": judged.angle,
        "allowed_position_m": judged.allowed.position,
        "allowed_angle_rad": judged.allowed.angle,
        "sigma_position_m": judged.sigma.position,
        "sigma_angle_rad": judged.sigma.angle,
        "tool": judged.pose,
    }


def _range(row: JointLimits) -> str:
    return " … ".join(_limit(value, row.unit) for value in row.used)


def _narrowed(row: JointLimits) -> str:
    """Return which limit is narrower than the model's, and why."""
    file = row.arm_file or (math.nan, math.nan)
    parts = []
    for name, model, in_file, used in zip(
        ("lower", "upper"), row.model, file, row.used, strict=True
    ):
        if abs(model - used) > 1e-9:
            cause = "the arm file" if abs(in_file - used) < 1e-9 else "the servo's mode"
            parts.append(f"{name} end by {cause} (model: {_limit(model, row.unit)})")
    return ", ".join(parts) or ("-" if row.servo is not None else "")


def _limit(value: float, unit: str) -> str:
    if math.isinf(value):
        return "free"
    return f"{value:.3f} m" if unit == "m" else f"{math.degrees(value):.1f}°"


def _millimetres(pose: Pose) -> str:
    return " ".join(f"{1e3 * float(value):z.1f}" for value in pose.position)


def _error_text(judged: Judgement) -> str:
    """Return the error and the allowed error, with enough digits to distinguish them."""
    position, max_position = distinct_texts(
        1e3 * judged.position, 1e3 * judged.allowed.position, digits=2
    )
    angle, max_angle = distinct_texts(
        math.degrees(judged.angle), math.degrees(judged.allowed.angle), digits=2
    )
    return f"{position} mm, {angle}°; allowed {max_position} mm, {max_angle}°"
