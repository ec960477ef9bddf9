"""What a reach leaves behind in one folder: ``reach.png``, ``trajectory.csv``, ``summary.json``, a film."""

from __future__ import annotations

import contextlib
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera.delays import Delays
from robot_ik.camera.drawing.overlay import (
    GREEN,
    ORANGE,
    RED,
    before_after,
    draw_axes,
    draw_marker_outline,
    draw_robot,
)
from robot_ik.camera.image import write_image
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.errors import distinct_texts
from robot_ik.files import plain, timestamp, write_atomically
from robot_ik.jobs.films import Film
from robot_ik.jobs.reach import ReachReport, window_scene
from robot_ik.jobs.results import save_json
from robot_ik.jobs.verdict import Judgement
from robot_ik.motion.trajectory import csv_table

#: Version of summary.json; raised when a field changes its meaning.
SCHEMA = 1
#: What a reach may leave behind.
FILES = ("reach.png", "trajectory.csv", "summary.json", "reach.mp4")
_AXES_PER_HOVER = 0.6
FILM_RATE_HZ = 25.0


def save_reach(report: ReachReport, folder: Path) -> list[Path]:
    """Writes what there is of a report; returns the files.

    Raises:
        OutputError: The folder went away or is full.
    """
    written = []
    picture = reach_picture(report)
    if picture is not None:
        write_image(folder / "reach.png", picture)
        written.append(folder / "reach.png")
    if report.execution is not None:
        write_atomically(folder / "trajectory.csv", _table(report))
        written.append(folder / "trajectory.csv")
    return [*written, save_json(folder / "summary.json", reach_summary(report))]


def reach_picture(report: ReachReport) -> Any:
    """The camera's views before and after with the robot drawn registered over them (BGR), or None."""
    vision = report.vision
    if vision is None or report.before is None:
        return None
    start = report.robot.home if report.q_start is None else report.q_start
    before = _drawn(report, report.before, start)
    if report.seen is not None:
        label = f"marker {report.seen.observation.ids[0]}"
        before = draw_marker_outline(before, report.seen.observation.pixels, label=label)
    captions = ["Before: " + _seen_text(report)]
    end, heading, angles = report.q_end, "After", "read back, drawn over the camera's picture; axes: the goal"
    if end is None and report.solution is not None:
        end, heading = report.solution.q, "Nearest found, not moved"
        angles = "before the move (left) and of the nearest solution (right)"
    if end is None:
        return before
    after = _drawn(report, report.before if report.after is None else report.after, end)
    captions.append(f"{heading}: {_outcome(report)}")
    return before_after(
        before, after, captions,
        title=f"{report.robot.file.title or report.robot.name}: {report.frame} to the goal",
        footer=f"blue: the robot's model at the joint angles {angles}",
        accents=(ORANGE, GREEN if report.reached else RED),
    )  # fmt: skip


def _drawn(report: ReachReport, image: Any, q: Any) -> Any:
    vision, robot = report.vision, report.robot
    if vision is None:
        raise RuntimeError("a picture needs a camera")
    drawn = draw_robot(
        image, robot.model, robot.qpos(q), vision.scene.intrinsics, vision.scene.pose_world_camera,
        alpha=0.22, tint=(240, 150, 30), style="registered", line_colour=(255, 190, 70),
    )  # fmt: skip
    if report.target is None:
        return drawn
    pose = vision.scene.pose_world_camera.inverse().compose(report.target)
    if pose.position[2] <= 0.01:
        return drawn  # the goal is behind the camera
    return draw_axes(drawn, pose, _AXES_PER_HOVER * vision.scene.hover, vision.scene.intrinsics, label="goal")


def _seen_text(report: ReachReport) -> str:
    if report.seen is None:
        return "the marker was not found" if report.goal is None else "the goal was given"
    text = f"marker {report.seen.observation.ids[0]} seen"
    if report.seen.true_pose is not None:
        metres, radians = report.seen.pose_world_marker.distance(report.seen.true_pose)
        text += f"\n{1e3 * metres:.2f} mm and {math.degrees(radians):.2f}° from where it truly is"
    return text


def _outcome(report: ReachReport) -> str:
    if report.by_camera is not None:
        judged = report.by_camera
        off, allowed = distinct_texts(1e3 * judged.position, 1e3 * judged.allowed.position, digits=2)
        return (
            f"{'reached' if report.reached else 'NOT reached'}\nthe camera sees the {report.frame} "
            f"{off} mm from the goal, {allowed} mm allowed"
        )
    if report.problem is not None:
        return "NOT reached"
    return f"{'reached' if report.reached else 'NOT reached'}\n{report.verdict}"


def _table(report: ReachReport) -> str:
    run = report.execution
    if run is None:
        raise RuntimeError("nothing was executed")
    head = ["time_s", *(f"{joint}_commanded" for joint in run.joints)]
    columns = [run.times[:, None], run.commanded]
    if run.measured is not None:
        head += [f"{joint}_measured" for joint in run.joints]
        columns.append(run.measured)
    return csv_table(head, np.hstack(columns).tolist())


def reach_summary(report: ReachReport) -> dict[str, Any]:
    """The content of ``summary.json``: SI units, quaternions wxyz, world frame unless a key says more."""
    request, setup, run, following = report.request, report.setup, report.execution, report.following
    seen, solution = report.seen, report.solution
    return {
        "schema": SCHEMA,
        "job": "reach",
        "created": timestamp(),
        "reached": report.reached,
        "problem": None if report.problem is None else str(report.problem),
        "robot": {"name": report.robot.name, "joints": report.robot.joints, "frame": report.frame},
        "bus": request.bus,
        "camera": request.camera if report.vision is not None else None,
        "marker": None if seen is None else {
            "id": seen.observation.ids[0],
            "camera": seen.observation.pose,
            "world": seen.pose_world_marker,
            "true_world": seen.true_pose,
            "corners_px": seen.observation.pixels,
            "reprojection_error_px": seen.observation.reprojection_error,
            "ambiguity": seen.observation.ambiguity,
            "covariance": seen.observation.covariance,
        },
        "goal": None if report.target is None or report.goal is None else {
            **plain(report.target),
            "position_asked": report.goal.weights[0] > 0.0,
            "angle_asked": report.goal.weights[1] > 0.0,
            "free_axis": getattr(report.goal, "free_axis", None),
        },
        "limits": [asdict(limit) for limit in setup.limits],
        "solution": None if solution is None else {
            "solver": solution.solver,
            "status": solution.status.name.lower(),
            "q": solution.q,
            "iterations": solution.iterations,
            "restarts": solution.restarts,
            "microseconds": report.microseconds,
            "miss_position_m": solution.error.position,
            "miss_angle_rad": solution.error.angle,
        },
        "motion": None if run is None else {
            "duration_s": run.duration,
            "rate_hz": run.rate,
            "overruns": run.overruns,
            "tracking_error_rad": run.tracking_error,
            "samples": len(run.times),
        },
        "following": None if following is None else {
            "ticks": following.ticks,
            "solved": following.solved,
            "held": following.held,
            "capped": following.capped,
            "rate_hz": following.rate,
            "tracking_error_rad": following.tracking_error,
            "behind_median_m": None if report.behind is None else report.behind[0],
            "behind_largest_m": None if report.behind is None else report.behind[1],
            **_delays(report),
        },
        "q": report.q_end,
        "read_back": _judgement(report.read_back),
        "by_camera": _judgement(report.by_camera),
        "verdict": report.verdict,
        "bus_counters": report.counters,
    }  # fmt: skip


def _delays(report: ReachReport) -> dict[str, Any]:
    """Seconds from grab to goal, and age of the picture at each tick; None where nothing was measured."""
    pair = None if report.vision is None else report.vision.delays
    facts: dict[str, Any] = {}
    for name, delays in zip(("grab_to_goal", "picture_age"), pair or (Delays(), Delays()), strict=True):
        for part in ("p50", "p95"):
            facts[f"{name}_{part}_s"] = getattr(delays, part) if delays.count else None
    return facts


def _judgement(judged: Judgement | None) -> dict[str, Any] | None:
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


def save_film(report: ReachReport, path: Path) -> Path | None:
    """The motion as the scene's camera sees it; None where nothing moved.

    Raises:
        MissingExtraError: The extra ``video`` is not installed.
        OutputError: It cannot be written.
    """
    run = report.execution
    scene = window_scene(report.robot, report.frame, None if report.vision is None else report.vision.scene)
    if run is None or scene is None:
        return None
    q = run.commanded if run.measured is None else run.measured
    shown = [q[0]]
    times = np.arange(run.times[0], run.times[-1] + 1.0 / FILM_RATE_HZ, 1.0 / FILM_RATE_HZ)
    source = SyntheticSource(scene.synthetic(report.robot), lambda: shown[0], seed=0)
    with contextlib.closing(Film(path, FILM_RATE_HZ)) as film:
        for time in times.tolist():
            shown[0] = q[min(int(np.searchsorted(run.times, time)), len(q) - 1)]
            film.write(source.read().image, time)
    return path
