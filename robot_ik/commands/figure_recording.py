"""The recording of ``robot-ik figure``: joint positions, contacts, and points of balance."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robot_ik import __version__
from robot_ik.figure.figure import RATE, SIDES, Figure
from robot_ik.figure.gait import AIR, CONTACTS, FLAT
from robot_ik.figure.session import FigureFrame
from robot_ik.figure.soles import lowest_points
from robot_ik.geometry import Pose
from robot_ik.motion.joint_table import Moment
from robot_ik.motion.keyframes import column_names, sign_continuous
from robot_ik.motion.recording import open_recording
from robot_ik.ports import Array
from robot_ik.robot import Robot

DECISION_COLUMNS = ("action", "phase", "hand", "decision")
"""Columns of the action, its progress from 0 to 1, the acting hand and the last decision."""

CONTACT_COLUMNS = tuple(f"{side}_contact" for side in SIDES)
"""Columns of the contacts that the frame claims."""

POINT_COLUMNS = (
    *(f"{side}_anchor_{axis}" for side in SIDES for axis in "xyz"),
    "com_x",
    "com_y",
    "com_z",
    "zmp_x",
    "zmp_y",
)
"""Columns of points in the world, m: anchors of the feet, centre of mass, planned ZMP."""


def save_recording(
    robot: Robot,
    figure: Figure | None,
    frames: Sequence[FigureFrame],
    path: Path,
    seed: int,
) -> None:
    """Write a row for each frame. The ball is the goal of the recording.

    The text of the first row names version, model, rate and seed, so that a judge can check the
    motion with the model only.

    Args:
        robot: The robot.
        figure: The humanoid. None: a robot without contacts.
        frames: The frames.
        path: File to write, .csv or .mcap.
        seed: Seed of the run.

    Raises:
        OutputError: The file cannot be written.
    """
    extra: tuple[str, ...] = DECISION_COLUMNS
    if figure is not None:
        extra = (*DECISION_COLUMNS, *CONTACT_COLUMNS, *POINT_COLUMNS)
    q = np.array([frame.q for frame in frames]).reshape(-1, robot.nq)
    rows = sign_continuous(robot, q)
    text = provenance(robot, seed)
    with open_recording(path, column_names(robot), extra) as recording:
        for row, frame in zip(rows, frames, strict=True):
            values = decision_values(frame)
            if figure is not None:
                values |= balance_values(figure, frame)
            goal = Pose(frame.ball) if np.isfinite(frame.ball).all() else None
            moment = Moment(frame.t, commanded=row, goal=goal, text=text, extra=values)
            recording.write(moment)
            text = ""


def provenance(robot: Robot, seed: int) -> str:
    """Return version, digest of the model, rate and seed of a recording."""
    path = robot.path
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else "unknown"
    return f"robot_ik {__version__}, {path.name} sha256 {digest}, {RATE:g} Hz, seed {seed}"


def decision_values(frame: FigureFrame) -> dict[str, object]:
    """Return the values of ``DECISION_COLUMNS``."""
    return {
        "action": frame.action,
        "phase": float(frame.phase),
        "hand": frame.decision.arm or "",
        "decision": frame.decision.action,
    }


def balance_values(figure: Figure, frame: FigureFrame) -> dict[str, object]:
    """Return the values of ``CONTACT_COLUMNS`` and ``POINT_COLUMNS``."""
    contacts = [CONTACTS[int(contact)] for contact in frame.contact]
    anchors = [anchor(figure, frame, side) for side in range(len(SIDES))]
    points = np.concatenate([*anchors, figure.center(frame.q), frame.zmp])
    cells = ["" if np.isnan(value) else value for value in points.tolist()]
    return {
        **dict(zip(CONTACT_COLUMNS, contacts, strict=True)),
        **dict(zip(POINT_COLUMNS, cells, strict=True)),
    }


def anchor(figure: Figure, frame: FigureFrame, side: int) -> Array:
    """Return the point (3,) of a foot that does not move in the world, m. NaN in the air.

    It is the origin of a flat foot, else the lowest point of the sole.
    """
    if frame.contact[side] == AIR:
        return np.full(3, np.nan)
    foot = figure.feet[SIDES[side]]
    if frame.contact[side] == FLAT:
        return figure.pose(frame.q, foot.frame)[0]
    data = figure.data_at(frame.q)
    lowest = np.array([0.0, 0.0, np.inf])
    for body, geoms in foot.parts:
        rotation = data.xmat[body].reshape(3, 3)
        heights, points = lowest_points(figure.model, list(geoms), rotation[2:3])
        point = data.xpos[body] + rotation @ points[0, int(heights[0].argmin())]
        if point[2] < lowest[2]:
            lowest = point
    return lowest
