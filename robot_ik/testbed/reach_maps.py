"""``ReachMaps``: reachability maps for the page, computed on a thread."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.obstacles import Obstacle
from robot_ik.collision.scene import Scene
from robot_ik.errors import RobotIkError
from robot_ik.kernels import jit
from robot_ik.kernels.precompile import Precompilation
from robot_ik.reachability import cells
from robot_ik.reachability.reachability_map import ReachabilityMap, map_reachability
from robot_ik.reachability.sweep import METHODS
from robot_ik.robot import Robot, load_robot

CELLS_ACROSS = 22
"""Cells along the diameter of the arm's reach."""

DIRECTIONS = 24
"""Directions of the tool's z axis."""

ROLLS = 4
"""Rotations of the tool about each direction."""

THREADS = 1
"""Threads of a sweep: the session's loop needs the other cores."""

_NICENESS = 10
"""Of the process that compiles the sweep: the page comes first."""


@dataclass(frozen=True, eq=False)
class ReachState:
    """What the page shows of a map.

    Attributes:
        text: Description for people. Empty without a map.
        reach_map: The map. None until it is ready.
        smallest_index: Smallest index of a reached cell.
        largest_index: Largest index of a cell.
    """

    text: str = ""
    reach_map: ReachabilityMap | None = None
    smallest_index: float = 0.0
    largest_index: float = 0.0


class _Cancelled(Exception):
    """The map was cancelled or replaced."""


class ReachMaps:
    """Computes one map at a time. A new map cancels the one before.

    Args:
        changed: Called with each new state, from the thread of the map.
    """

    def __init__(self, changed: Callable[[ReachState], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._number = 0
        self._compiler: Precompilation | None = None

    def ask(self, robot: Robot, obstacles: tuple[Obstacle, ...]) -> None:
        """Compute the map of a robot among obstacles."""
        number = self.cancel()
        arguments = (number, robot, obstacles)
        threading.Thread(target=self._work, args=arguments, name="reach-map", daemon=True).start()

    def cancel(self) -> int:
        """End the present map, and return the number of the next."""
        with self._lock:
            self._number += 1
            if self._compiler is not None:
                self._compiler.close()
            return self._number

    def _say(self, number: int, state: ReachState) -> None:
        """Report a state, unless the map was cancelled or replaced."""
        with self._lock:
            if number != self._number:
                raise _Cancelled
            self._changed(state)

    def _work(self, number: int, robot: Robot, obstacles: tuple[Obstacle, ...]) -> None:
        with contextlib.suppress(_Cancelled):
            try:
                self._compute(number, robot, obstacles)
            except RobotIkError as error:
                self._say(number, ReachState(f"no map: {str(error).splitlines()[0]}"))

    def _compute(self, number: int, robot: Robot, obstacles: tuple[Obstacle, ...]) -> None:
        self._say(number, ReachState("preparing the map …"))
        scene = Scene(robot, obstacles)
        touching = [item.pair for item in scene.touching]
        avoid = CollisionAvoidance(scene, margin=0.0, ignore=touching)
        self._compile(robot)

        def progress(done: int, blocks: int) -> None:
            self._say(number, ReachState(f"sweeping the space: {100 * done // blocks} %"))

        ball = robot.reach(robot.tool)
        reach_map = map_reachability(
            robot,
            cell=0.05 if ball is None else 2.0 * ball[1] / CELLS_ACROSS,
            directions=DIRECTIONS,
            rolls=ROLLS,
            collisions=avoid,
            threads=THREADS,
            progress=progress,
        )
        around = f"among {len(obstacles)} obstacles" if obstacles else "without obstacles"
        text = (
            f"{1e3 * reach_map.grid.cell:.0f} mm cells, {reach_map.grid.orientations} "
            f"orientations each, {around}; {METHODS[reach_map.method]}"
        )
        reached = reach_map.index[reach_map.index > 0.0]
        smallest = float(reached.min(initial=1.0))
        largest = float(reached.max(initial=0.0))
        self._say(number, ReachState(text, reach_map, smallest, largest))

    def _compile(self, robot: Robot) -> None:
        """Compile the sweep in another process: a compiler here would hold up the page."""
        if jit.compiled(cells.sweep_cells) or robot.source is None:
            return
        function = f"{__name__}:compile_sweep"
        self._compiler = Precompilation(function, str(robot.source), niceness=_NICENESS)
        self._compiler.wait()


def compile_sweep(source: str) -> None:
    """Compile the sweep with a map of one orientation: of a name, a path or a model as text."""
    robot = load_robot(source)
    avoid = CollisionAvoidance(Scene(robot))
    ball = robot.reach(robot.tool)
    cell = 1.0 if ball is None else ball[1]
    map_reachability(robot, cell=cell, directions=1, rolls=1, collisions=avoid)
