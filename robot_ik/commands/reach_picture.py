"""Files of a reach: the picture before and after, the trajectory, the summary, a video."""

from __future__ import annotations

import contextlib
import math
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
from robot_ik.files import write_atomically
from robot_ik.motion.joint_table import Moment, table_text
from robot_ik.testbed.frontends.scene_window import window_scene
from robot_ik.workcell.films import Film
from robot_ik.workcell.results import save_json

if TYPE_CHECKING:
    from robot_ik.commands.reach_report import ReachReport

AXES_PER_HOVER = 0.6
"""Length of the drawn goal axes, in distances of the tool from the marker."""

VIDEO_RATE_HZ = 25.0
"""Pictures a second of the video."""


def save_files(report: ReachReport, folder: Path) -> list[Path]:
    """Write the files of a report, and return their paths.

    Raises:
        OutputError: The folder cannot be written to.
    """
    written = []
    picture = draw_picture(report)
    if picture is not None:
        write_image(folder / "reach.png", picture)
        written.append(folder / "reach.png")
    if report.execution is not None:
        write_atomically(folder / "trajectory.csv", trajectory_table(report))
        written.append(folder / "trajectory.csv")
    return [*written, save_json(folder / "summary.json", report.json_object())]


def draw_picture(report: ReachReport) -> Any:
    """Return the pictures before and after with the robot drawn over them (BGR), or None."""
    if report.vision is None or report.before is None:
        return None
    start = report.robot.home if report.q_start is None else report.q_start
    before = draw_pose(report, report.before, start)
    if report.seen is not None:
        corners = report.seen.observation.pixels
        label = f"marker {report.seen.observation.ids[0]}"
        before = draw_marker_outline(before, corners, label=label)
    if report.judged is not None:
        q = report.judged.q
        image = report.judged.image
        heading = "After"
        angles = "read back, drawn over the camera's picture; axes: the goal"
    elif report.solution is not None:
        q = report.solution.q
        image = None
        heading = "Nearest found, not moved"
        angles = "before the move (left) and of the nearest solution (right)"
    else:
        return before
    after = draw_pose(report, report.before if image is None else image, q)
    return before_after(
        before,
        after,
        ["Before: " + marker_text(report), f"{heading}: {outcome_text(report)}"],
        title=f"{report.robot.file.title or report.robot.name}: {report.frame} to the goal",
        footer=f"blue: the robot's model at the joint angles {angles}",
        accents=(ORANGE, GREEN if report.ok else RED),
    )


def draw_pose(report: ReachReport, image: Any, q: Any) -> Any:
    """Return the picture with the robot at ``q`` and the goal's axes drawn over it."""
    vision = report.vision
    if vision is None:
        raise RuntimeError("a picture needs a camera")
    scene = vision.scene
    robot = report.robot
    drawn = draw_robot(
        image,
        robot.model,
        robot.qpos(q),
        scene.intrinsics,
        scene.pose_world_camera,
        alpha=0.22,
        tint=(240, 150, 30),
        style="registered",
        line_colour=(255, 190, 70),
    )
    if report.goal is None:
        return drawn
    pose = scene.pose_world_camera.inverse().compose(report.goal.target)
    if pose.position[2] <= 0.01:
        return drawn  # the goal is behind the camera
    length = AXES_PER_HOVER * scene.hover
    return draw_axes(drawn, pose, length, scene.intrinsics, label="goal")


def marker_text(report: ReachReport) -> str:
    """Return the caption of the first picture."""
    if report.seen is None:
        return "the marker was not found" if report.goal is None else "the goal was given"
    text = f"marker {report.seen.observation.ids[0]} seen"
    if report.seen.true_pose is None:
        return text
    metres, radians = report.seen.pose_world_marker.distance(report.seen.true_pose)
    return f"{text}\n{1e3 * metres:.2f} mm and {math.degrees(radians):.2f}° from its true pose"


def outcome_text(report: ReachReport) -> str:
    """Return the caption of the last picture."""
    outcome = "reached" if report.ok else "NOT reached"
    if report.judged is not None and report.judged.by_camera is not None:
        judged = report.judged.by_camera
        error, allowed = distinct_texts(
            1e3 * judged.position, 1e3 * judged.allowed.position, digits=2
        )
        distance = f"{error} mm from the goal, {allowed} mm allowed"
        return f"{outcome}\nthe camera sees {report.frame} {distance}"
    return outcome if report.error is not None else f"{outcome}\n{report.verdict}"


def trajectory_table(report: ReachReport) -> str:
    """Return the CSV table of commanded and measured joint positions."""
    run = report.execution
    if run is None:
        raise RuntimeError("nothing was executed")
    measured = repeat(None) if run.measured is None else iter(run.measured)
    rows = zip(run.times.tolist(), run.commanded, measured, strict=False)
    moments = (Moment(now, commanded=command, measured=reading) for now, command, reading in rows)
    return table_text(run.joints, moments)


def save_video(report: ReachReport, path: Path) -> Path | None:
    """Write the motion as the scene's camera sees it. Return None if nothing moved.

    Raises:
        MissingExtraError: The extra ``video`` is not installed.
        OutputError: The file cannot be written.
    """
    run = report.execution
    scene = None if report.vision is None else report.vision.scene
    scene = window_scene(report.robot, report.frame, scene)
    if run is None or scene is None:
        return None
    q = run.commanded if run.measured is None else run.measured
    shown = [q[0]]
    times = np.arange(run.times[0], run.times[-1] + 1.0 / VIDEO_RATE_HZ, 1.0 / VIDEO_RATE_HZ)
    synthetic = scene.synthetic(report.robot)
    source = SyntheticSource(synthetic, lambda: shown[0], seed=0)
    with contextlib.closing(Film(path, VIDEO_RATE_HZ)) as film:
        for time in times.tolist():
            shown[0] = q[min(int(np.searchsorted(run.times, time)), len(q) - 1)]
            film.write(source.read().image, time)
    return path
