"""The test environment of thesis A00: a cube whose edges show where ball and tool are.

A cube of lines surrounds the robot. The positions of ball and tool are projected onto three of its
edges. The axes at the origin are red, green and blue for x, y and z (Aho 2000, 7.1.3).
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import viser

from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import GOAL_COLOUR, INSTANCE_COLOURS, arranged
from robot_ik.testbed.view import View

_HALF = 0.75
"""Half an edge in extents of the model."""

_EDGE_COLOUR = (140, 148, 160)
_LINE_WIDTH = 1.5
"""Pixels."""

_MARK_SIZE = 0.03
"""Of the projections, in extents of the model."""

_AXIS_LENGTH = 0.2
"""In extents of the model."""

_AXIS_RADIUS = 0.006
"""Likewise."""


class CubeScene:
    """Draws the cube around the first instance, or none.

    Args:
        server: viser's server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._robot: Robot | None = None
        self._count = 0
        self._root: Any = None
        self._marks: Any = None
        self._lower = np.zeros(3)

    def draw(self, view: View, robot: Robot, *, on: bool) -> None:
        """Show the cube with the projections of the ball and of the first tool, or none."""
        if not on:
            self._remove()
            return
        if self._robot is not robot or self._count != view.count:
            self._remove()
            self._build(robot, view.count)
        ball = view.ball.position
        tool = view.instances[0].trail[-1] if len(view.instances[0].trail) else ball
        points = [self._on_edge(axis, place) for place in (ball, tool) for axis in range(3)]
        self._marks.points = np.array(points, np.float32)

    def _on_edge(self, axis: int, place: Array) -> Array:
        """Return the projection of a place onto the edge of the cube along an axis."""
        point = self._lower.copy()
        point[axis] = place[axis]
        return point

    def _build(self, robot: Robot, count: int) -> None:
        self._robot = robot
        self._count = count
        arrangement = arranged(robot, count)
        offset = arrangement.offsets[0]
        extent = arrangement.extent
        centre = robot.model.stat.center
        self._lower = centre - _HALF * extent
        corners = centre + _HALF * extent * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        pairs = [
            (a, b)
            for a, b in itertools.combinations(corners, 2)
            if np.count_nonzero(np.abs(a - b) > 1e-9) == 1
        ]
        scene = self._server.scene
        self._root = scene.add_frame("/cube", show_axes=False, position=offset)
        scene.add_line_segments(
            "/cube/edges",
            np.array(pairs, np.float32),
            np.full((len(pairs), 2, 3), _EDGE_COLOUR, np.uint8),
            thickness=_LINE_WIDTH,
            thickness_units="screen",
        )
        scene.add_frame(
            "/cube/axes", axes_length=_AXIS_LENGTH * extent, axes_radius=_AXIS_RADIUS * extent
        )
        colours = np.repeat([GOAL_COLOUR, INSTANCE_COLOURS[0]], 3, axis=0)
        self._marks = scene.add_point_cloud(
            "/cube/marks",
            np.tile(self._lower, (6, 1)).astype(np.float32),
            colors=colours.astype(np.uint8),
            point_size=_MARK_SIZE * extent,
            point_shape="circle",
        )

    def _remove(self) -> None:
        if self._root is not None:
            self._root.remove()
        self._root = None
        self._marks = None
        self._robot = None
