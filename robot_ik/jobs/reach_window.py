"""What is seen of a reach while it runs: the window with its stage, and the film."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.made_up.synthetic import SyntheticSource
from robot_ik.camera.opencv import marker_bits
from robot_ik.errors import CameraError, MissingExtraError
from robot_ik.geometry import Pose
from robot_ik.jobs.ar_files import Film
from robot_ik.jobs.stage import Stage, stage_for
from robot_ik.testbed.frontends.window import Solid

if TYPE_CHECKING:
    from robot_ik.jobs.reach_report import ReachReport
    from robot_ik.robot import Robot

Array = NDArray[np.float64]

FILM_RATE_HZ = 25.0
_FLOOR, _TABLE = (0.82, 0.83, 0.85, 1.0), (0.62, 0.52, 0.42, 1.0)
_WHITE, _BLACK = (0.97, 0.97, 0.97, 1.0), (0.03, 0.03, 0.03, 1.0)
_FLOOR_HALF = 8.0  # metres
_TOP = 0.03  # of the table, metres
_PAPER = 2e-4  # metres, so that what lies on it is not lost in it


def stage_solids(stage: Stage | None) -> list[Solid]:
    """Floor, table and printed marker for the window."""
    table = None if stage is None else stage.table
    floor = 0.0 if table is None else table.floor_height
    found = [Solid(Pose((0.0, 0.0, floor - 0.01)), (_FLOOR_HALF, _FLOOR_HALF, 0.01), _FLOOR)]
    if table is not None:
        middle = (0.5 * sum(table.x), 0.5 * sum(table.y), table.height - 0.5 * _TOP)
        half = (0.5 * (table.x[1] - table.x[0]), 0.5 * (table.y[1] - table.y[0]), 0.5 * _TOP)
        found.append(Solid(Pose(middle), half, _TABLE))
    return found if stage is None else [*found, *_marker(stage)]


def _marker(stage: Stage) -> list[Solid]:
    """White paper, the black square on it, and its white cells on that."""
    bits = marker_bits(stage.dictionary, stage.marker_id)
    cell, h = stage.marker_size / len(bits), 0.5 * stage.marker_size
    at = stage.pose_world_marker

    def sheet(x: float, y: float, half: float, layer: int, colour: tuple[float, ...]) -> Solid:
        return Solid(at.compose(Pose((x, y, layer * _PAPER))), (half, half, 0.5 * _PAPER), colour)

    cells = [
        sheet(-h + (column + 0.5) * cell, h - (row + 0.5) * cell, 0.5 * cell, 3, _WHITE)
        for row, column in np.argwhere(bits > 0).tolist()
    ]
    return [sheet(0.0, 0.0, h + cell, 1, _WHITE), sheet(0.0, 0.0, h, 2, _BLACK), *cells]


def window_stage(robot: Robot, frame: str, stage: Stage | None) -> Stage | None:
    """The stage to show: the camera's, else the robot's own; None where there is none."""
    if stage is not None:
        return stage
    try:
        return stage_for(robot, frame)
    except CameraError:
        return None


def require_films() -> None:
    """Raises ``MissingExtraError`` where no film can be written."""
    if importlib.util.find_spec("av") is None:
        raise MissingExtraError("av", "video", "a film of the reach")


def save_film(report: ReachReport, path: Path) -> Path | None:
    """The motion as the stage's camera sees it; None where nothing moved.

    Raises:
        MissingExtraError: The extra ``video`` is not installed.
        OutputError: It cannot be written.
    """
    run = report.execution
    stage = window_stage(report.robot, report.frame, None if report.eyes is None else report.eyes.stage)
    if run is None or stage is None:
        return None
    q = run.commanded if run.measured is None else run.measured
    shown = [q[0]]
    times = np.arange(run.times[0], run.times[-1] + 1.0 / FILM_RATE_HZ, 1.0 / FILM_RATE_HZ)
    source = SyntheticSource(stage.scene(report.robot), lambda: shown[0], seed=0, quality="fast")
    with Film(path, FILM_RATE_HZ) as film:
        for time in times.tolist():
            shown[0] = q[min(int(np.searchsorted(run.times, time)), len(q) - 1)]
            film.write(source.read().image, time)
    return path
