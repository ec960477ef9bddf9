"""Obstacles in the 3D view, with a line to the nearest point of the robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from robot_ik.ports import Array
from robot_ik.testbed.arrangement import LIMIT_COLOUR, Colour
from robot_ik.testbed.obstacles import ObstacleView
from robot_ik.testbed.view import View

_FREE_COLOUR: Colour = (120, 132, 150)
_LINE_COLOUR: Colour = (245, 158, 11)
_OPACITY = 0.75
_LINE_WIDTH = 2.5
"""Pixels."""

_SPHERE_SUBDIVISIONS = 4

MoveObstacle = Callable[[int, Array], None]
"""Called with the number of an obstacle and its position (3,) in the scene, m."""


class ObstacleScene:
    """Draws the obstacles beside the first instance.

    Args:
        server: viser's server.
        move: Called when an obstacle is dragged.
    """

    def __init__(self, server: viser.ViserServer, move: MoveObstacle) -> None:
        self._server = server
        self._move = move
        self._drawn: tuple[tuple[str, float], ...] = ()
        self._shapes: list[Any] = []
        self._lines: Any = None

    def draw(self, view: View, offset: Array) -> None:
        """Show the obstacles of a view. ``offset`` (3,) is that of the first instance, m."""
        shapes = tuple((one.shape, one.size) for one in view.obstacles)
        if shapes != self._drawn:
            self._rebuild(view)
            self._drawn = shapes
        if not shapes:
            return
        ends = np.zeros((len(shapes), 2, 3), np.float32)
        for k, (one, handle) in enumerate(zip(view.obstacles, self._shapes, strict=True)):
            handle.position = one.position + offset
            handle.color = LIMIT_COLOUR if one.distance < 0.0 else _FREE_COLOUR
            if one.distance > 0.0 and np.isfinite(one.points).all():
                ends[k] = one.points + offset
        self._lines.points = ends

    def _rebuild(self, view: View) -> None:
        for handle in self._shapes:
            handle.remove()
        if self._lines is not None:
            self._lines.remove()
            self._lines = None
        self._shapes = [self._add(k, one) for k, one in enumerate(view.obstacles)]
        count = len(view.obstacles)
        if count:
            self._lines = self._server.scene.add_line_segments(
                "/obstacles/nearest",
                np.zeros((count, 2, 3), np.float32),
                np.full((count, 2, 3), _LINE_COLOUR, np.uint8),
                thickness=_LINE_WIDTH,
                thickness_units="screen",
            )

    def _add(self, k: int, one: ObstacleView) -> Any:
        scene = self._server.scene
        name = f"/obstacles/{k}"
        common: Any = {"color": _FREE_COLOUR, "opacity": _OPACITY, "position": one.position}
        handle: Any
        match one.shape:
            case "box":
                edges = (2.0 * one.size,) * 3
                handle = scene.add_box(name, dimensions=edges, **common)
            case "sphere":
                handle = scene.add_icosphere(
                    name, radius=one.size, subdivisions=_SPHERE_SUBDIVISIONS, **common
                )
            case "cylinder":
                handle = scene.add_cylinder(name, radius=one.size, height=2.0 * one.size, **common)

        async def dragged(event: Any) -> None:
            self._move(k, np.array(event.end_position))

        handle.on_drag("left")(dragged)
        return handle
