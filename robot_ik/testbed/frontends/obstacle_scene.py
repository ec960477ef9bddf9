"""Obstacles in the 3D view, with a line to the nearest point of the robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from robot_ik.ports import Array
from robot_ik.testbed.arrangement import LIMIT_COLOUR, Colour
from robot_ik.testbed.obstacles import PlacedObstacle
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
        self._drawn: list[tuple[str, tuple[float, float, float]]] = []
        self._shapes: list[Any] = []
        self._lines: Any = None

    def draw(self, view: View, offset: Array) -> None:
        """Show the obstacles of a view. ``offset`` (3,) is that of the first instance, m."""
        placed = [one.placed for one in view.obstacles]
        shapes = [(one.name, one.size) for one in placed]
        if shapes != self._drawn:
            self._rebuild(placed)
            self._drawn = shapes
        if not shapes:
            return
        touching = {part for contact in view.contacts for part in contact.parts}
        ends = np.zeros((len(shapes), 2, 3), np.float32)
        for k, (one, handle) in enumerate(zip(view.obstacles, self._shapes, strict=True)):
            handle.position = one.placed.position + offset
            is_touched = one.distance < 0.0 or one.placed.name in touching
            handle.color = LIMIT_COLOUR if is_touched else _FREE_COLOUR
            if one.distance > 0.0 and np.isfinite(one.points).all():
                ends[k] = one.points + offset
        self._lines.points = ends

    def _rebuild(self, placed: list[PlacedObstacle]) -> None:
        for handle in self._shapes:
            handle.remove()
        if self._lines is not None:
            self._lines.remove()
            self._lines = None
        self._shapes = [self._add(k, one) for k, one in enumerate(placed)]
        count = len(placed)
        if count:
            self._lines = self._server.scene.add_line_segments(
                "/obstacles/nearest",
                np.zeros((count, 2, 3), np.float32),
                np.full((count, 2, 3), _LINE_COLOUR, np.uint8),
                thickness=_LINE_WIDTH,
                thickness_units="screen",
            )

    def _add(self, k: int, one: PlacedObstacle) -> Any:
        scene = self._server.scene
        name = f"/obstacles/{k}"
        common: Any = {"color": _FREE_COLOUR, "opacity": _OPACITY, "position": one.position}
        length_x, _, length_z = one.size
        handle: Any
        if one.hull is not None:
            vertices = one.hull.vertices.astype(np.float32)
            faces = one.hull.faces.astype(np.uint32)
            handle = scene.add_mesh_simple(name, vertices, faces, flat_shading=True, **common)
        elif one.shape == "box":
            handle = scene.add_box(name, dimensions=one.size, **common)
        elif one.shape == "sphere":
            handle = scene.add_icosphere(
                name, radius=0.5 * length_x, subdivisions=_SPHERE_SUBDIVISIONS, **common
            )
        else:
            handle = scene.add_cylinder(name, radius=0.5 * length_x, height=length_z, **common)

        async def dragged(event: Any) -> None:
            self._move(k, np.array(event.end_position))

        handle.on_drag("left")(dragged)
        return handle
