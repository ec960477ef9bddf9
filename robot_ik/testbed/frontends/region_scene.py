"""Draws the space that a tool reaches as a shell, and the regions of a figure.

Both take up to some seconds. They are computed on a thread, and drawn when they are ready.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator

import viser

from robot_ik.errors import RobotIkError
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import Colour
from robot_ik.testbed.problem_text import problem_text
from robot_ik.testbed.regions import Region

LOG = logging.getLogger(__name__)

_OPACITY = 0.22

_COLOURS: dict[str, Colour] = {
    "shell": (96, 140, 200),
    "reach": (34, 160, 90),
    "bend": (217, 140, 20),
    "jump": (150, 80, 200),
}
"""Colours of the surfaces by name."""


class RegionScene:
    """Draws the regions of one kind beside the first instance, or none.

    Args:
        server: viser's server.
        name: Name of the node.
        make: Returns the regions of a robot. It is called on a thread.
        report: Called with a sentence if there are none.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        make: Callable[[Robot], Iterator[Region]],
        report: Callable[[str], None],
    ) -> None:
        self._server = server
        self._name = name
        self._make = make
        self._report = report
        self._shown: Robot | None = None
        self._handles: list[viser.SceneNodeHandle] = []
        self._lock = threading.Lock()

    def draw(self, robot: Robot, offset: Array, *, on: bool) -> None:
        """Show the regions of a robot whose first instance is at ``offset`` (3,), or none."""
        wanted = robot if on else None
        if wanted is self._shown:
            return
        self._shown = wanted
        self._clear()
        if wanted is not None:
            thread = threading.Thread(
                target=self._work, args=(wanted, offset), name="testbed-regions", daemon=True
            )
            thread.start()

    def _clear(self) -> None:
        with self._lock:
            for handle in self._handles:
                handle.remove()
            self._handles = []

    def _work(self, robot: Robot, offset: Array) -> None:
        """Compute the regions and draw each as soon as it is known."""
        count = 0
        try:
            for region in self._make(robot):
                if self._shown is not robot:
                    return  # another robot, or switched off
                count += len(region.surface.faces)
                self._add(robot, region, offset)
        except RobotIkError as error:
            self._report(problem_text(error))
            return
        except Exception:
            LOG.exception("no regions")
        if not count:
            self._report(f"there is nothing to show of {robot.name}")

    def _add(self, robot: Robot, region: Region, offset: Array) -> None:
        if not len(region.surface.faces):
            return
        handle = self._server.scene.add_mesh_simple(
            f"/regions/{self._name}/{region.name}",
            region.surface.vertices,
            region.surface.faces,
            color=_COLOURS[region.name],
            opacity=_OPACITY,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            position=offset,
        )
        with self._lock:
            if self._shown is robot:
                self._handles.append(handle)
                return
        handle.remove()
