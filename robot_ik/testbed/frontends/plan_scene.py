"""A planned motion in the 3D view: the way of the tool, and postures along it."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from robot_ik.testbed.arrangement import Colour
from robot_ik.testbed.frontends.scene import BrowserScene, Ghosts
from robot_ik.testbed.planning import GHOSTS, PlanView
from robot_ik.testbed.view import View

_COLOUR: Colour = (22, 163, 74)
"""Green. No instance, goal or contact has it."""

_WIDTH = 4.0
"""Pixels."""


class PlanScene:
    """Draws the plan beside the first instance.

    Args:
        server: viser's server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._scene: BrowserScene | None = None
        self._ghosts: Ghosts | None = None
        self._line: Any = None
        self._drawn: PlanView | None = None

    def draw(self, view: View, scene: BrowserScene) -> None:
        """Show the plan of a view beside a drawing of its robot."""
        if scene is not self._scene:
            # Removing the drawing of the robot has removed line and ghosts too.
            self._scene = scene
            self._ghosts = None
            self._line = None
            self._drawn = None
        plan = view.plan
        drawn = self._drawn
        if drawn is not None and plan.path is drawn.path and plan.ghosts is drawn.ghosts:
            return
        self._drawn = plan
        offset = scene.arrangement.offsets[0]
        if plan.ghosts and self._ghosts is None:
            model = scene.robot.model
            self._ghosts = Ghosts(self._server, model, "plan", _COLOUR, GHOSTS)
        if self._ghosts is not None:
            self._ghosts.draw([(ghost.xpos, ghost.xquat) for ghost in plan.ghosts], offset)
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(plan.path):
            points = (plan.path + offset).astype(np.float32)
            self._line = self._server.scene.add_line_segments(
                "/robot/plan_path",
                np.stack([points[:-1], points[1:]], axis=1),
                np.full((len(points) - 1, 2, 3), _COLOUR, np.uint8),
                thickness=_WIDTH,
                thickness_units="screen",
            )
