"""The scene of a reach in MuJoCo's window: floor, table and printed marker."""

from __future__ import annotations

import numpy as np

from robot_ik.camera.image import marker_bits
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.robot import Robot
from robot_ik.testbed.frontends.window import Solid
from robot_ik.workcell.scene import Scene, scene_for

_FLOOR = (0.82, 0.83, 0.85, 1.0)
_TABLE = (0.62, 0.52, 0.42, 1.0)
_WHITE = (0.97, 0.97, 0.97, 1.0)
_BLACK = (0.03, 0.03, 0.03, 1.0)
"""Colours, RGBA."""

FLOOR_HALF_WIDTH = 8.0
"""Half the side of the floor, metres."""

TABLE_THICKNESS = 0.03
"""Thickness of the table top, metres."""

PAPER_THICKNESS = 2e-4
"""Distance of the layers of a marker, metres. Layers at the same height would flicker."""


def scene_solids(scene: Scene | None) -> list[Solid]:
    """Return floor, table and printed marker for the window."""
    table = None if scene is None else scene.table
    floor = 0.0 if table is None else table.floor_height
    solids = [
        Solid(Pose((0.0, 0.0, floor - 0.01)), (FLOOR_HALF_WIDTH, FLOOR_HALF_WIDTH, 0.01), _FLOOR)
    ]
    if table is not None:
        middle = (0.5 * sum(table.x), 0.5 * sum(table.y), table.height - 0.5 * TABLE_THICKNESS)
        half = (
            0.5 * (table.x[1] - table.x[0]),
            0.5 * (table.y[1] - table.y[0]),
            0.5 * TABLE_THICKNESS,
        )
        solids.append(Solid(Pose(middle), half, _TABLE))
    return solids if scene is None else [*solids, *_marker(scene)]


def _marker(scene: Scene) -> list[Solid]:
    """Return the white paper, the black square on it, and the white cells on the square."""
    bits = marker_bits(scene.dictionary, scene.marker_id)
    cell = scene.marker_size / len(bits)
    h = 0.5 * scene.marker_size
    at = scene.pose_world_marker

    def sheet(x: float, y: float, half: float, layer: int, colour: tuple[float, ...]) -> Solid:
        return Solid(
            at.compose(Pose((x, y, layer * PAPER_THICKNESS))),
            (half, half, 0.5 * PAPER_THICKNESS),
            colour,
        )

    cells = [
        sheet(-h + (column + 0.5) * cell, h - (row + 0.5) * cell, 0.5 * cell, 3, _WHITE)
        for row, column in np.argwhere(bits > 0).tolist()
    ]
    return [sheet(0.0, 0.0, h + cell, 1, _WHITE), sheet(0.0, 0.0, h, 2, _BLACK), *cells]


def window_scene(robot: Robot, frame: str, scene: Scene | None) -> Scene | None:
    """Return the scene to show: the camera's, else the robot's own, else None."""
    if scene is not None:
        return scene
    try:
        return scene_for(robot, frame)
    except CameraError:
        return None
