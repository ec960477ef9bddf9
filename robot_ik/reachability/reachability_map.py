"""``ReachabilityMap``, and ``map_reachability`` that computes it.

    reach_map = rik.map_reachability(robot, cell=0.05, out="puma.zarr")
    reach_map.index                  # (x, y, z) share of the directions that the tool can reach
    reach_map.best_base(poses).base  # pose of the base from which the robot reaches all poses

The map is a sample: a pose between two entries may differ from both. Solve it to be certain.
"""

from __future__ import annotations

import enum
import os
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.batch import usable_cores
from robot_ik.errors import OptionError, ReachabilityMapError
from robot_ik.geometry import Pose, vector
from robot_ik.reachability import cells
from robot_ik.reachability.cloud import PointCloud, coloured
from robot_ik.reachability.grid import MAX_ROLLS, Grid, require_count
from robot_ik.reachability.numeric_sweep import has_free_roll
from robot_ik.reachability.placement import BasePlacement, place_base
from robot_ik.reachability.store import MapStore
from robot_ik.reachability.sweep import BlockResult, Sweep, arm_form, run_pickled
from robot_ik.robot import Robot, load_robot, require_robot

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance

DEFAULT_CELL = 0.05
"""m. Edge length of a cell."""

DEFAULT_DIRECTIONS = 60
"""Directions of the approach axis: neighbours are about 26 degrees apart."""

DEFAULT_ROLLS = 6
"""Turns about the approach axis: steps of 60 degrees."""

MAX_THREADS = 1024
"""Largest number of threads of one process."""

QUANTITIES = {
    "index": "share of the directions that are reached",
    "branches": "free branches of a reached pose, mean",
    "manipulability": "largest manipulability",
    "clearance": "largest clearance, m",
}
"""Quantities of a cell, with their titles."""


class ReachStatus(enum.IntEnum):
    """Status of a pose in a map."""

    UNREACHABLE = cells.UNREACHABLE
    NOT_FOUND = cells.NOT_FOUND
    TOUCHING = cells.TOUCHING
    REACHED = cells.REACHED

    @property
    def meaning(self) -> str:
        """Description for messages."""
        return _MEANING[self]


_MEANING = {
    ReachStatus.UNREACHABLE: "proven out of reach",
    ReachStatus.NOT_FOUND: "not found, and not proven out of reach",
    ReachStatus.TOUCHING: "reached only with a collision",
    ReachStatus.REACHED: "reached",
}


@dataclass(frozen=True, eq=False, repr=False)
class ReachabilityMap:
    """Which poses a frame of an arm can reach, cell by cell.

    All values are measured at the centres of the cells. Joint limits count. Collisions count if the
    map was computed with a condition on collisions.

    Attributes:
        robot: The arm.
        frame: Name of the frame that should reach the poses.
        grid: The poses: cells in space times orientations.
        collisions: Condition that a branch must keep to be free; None for no condition.
        status: (x, y, z, o) number of ``ReachStatus`` of each pose.
        branches: (x, y, z, o) number of free branches of each pose, at most 255; for an arm of
            seven joints the sum over the values of its swept joint. 1 if ``method`` is "lm".
        manipulability: (x, y, z) largest √det(J Jᵀ) of the free branches, metres and radians; for
            fewer than six joints √det(Jᵀ J).
        clearance: (x, y, z) largest clearance of the free branches, up to 0.1 m; NaN without one,
            and without a condition on collisions.
        is_complete: Whether all blocks of the map have been swept.
        method: How the poses were solved: "closed form", "swept joint" or "lm", see
            ``sweep.METHODS``. Only a closed form proves that a pose is out of reach.
    """

    robot: Robot
    frame: str
    grid: Grid
    collisions: CollisionAvoidance | None
    status: NDArray[np.uint8]
    branches: NDArray[np.uint8]
    manipulability: NDArray[np.float32]
    clearance: NDArray[np.float32]
    is_complete: bool
    method: str

    def __repr__(self) -> str:
        cells_text = " x ".join(map(str, self.grid.shape))
        return (
            f"ReachabilityMap({self.robot.name!r}, {self.frame!r}, {cells_text} cells of "
            f"{1e3 * self.grid.cell:g} mm, {self.grid.orientations} orientations)"
        )

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        robot: Robot | None = None,
        *,
        collisions: CollisionAvoidance | None = None,
    ) -> ReachabilityMap:
        """Load a map from its zarr folder.

        Args:
            path: The folder.
            robot: The robot of the map. None loads it from the source stored in the map.
            collisions: The condition of the map. Only ``best_base`` needs it.

        Raises:
            MissingExtraError: zarr is not installed.
            ReachabilityMapError: The folder holds no map, or the map of another robot or condition.
        """
        store = MapStore.open(path)
        facts = store.facts
        if robot is None:
            robot = load_robot(facts["source"], joints=facts["joints"])
        sweep = Sweep(
            robot, facts["frame"], store.grid, arm_form(robot, facts["frame"]), collisions
        )
        skips_check = facts["checked"] and collisions is None
        if not skips_check and sweep.fingerprint() != facts["fingerprint"]:
            raise ReachabilityMapError(
                f"{store.path} is the map of another robot or scene",
                hint="give the robot and the condition on collisions with which it was computed",
            )
        return _map_of(sweep, store.read(), bool(store.done.all()))

    @cached_property
    def direction_reached(self) -> NDArray[np.bool_]:
        """(x, y, z, directions) whether a direction is reached, with any roll."""
        reached = self.status == ReachStatus.REACHED
        return np.asarray(
            reached.reshape(*self.grid.shape, self.grid.directions, self.grid.rolls).any(axis=-1)
        )

    @cached_property
    def index(self) -> NDArray[np.float32]:
        """(x, y, z) share of the directions that are reached, with any roll.

        It is the reachability index of Zacharias, Borst & Hirzinger, 2007.
        """
        return self.direction_reached.mean(axis=-1, dtype=np.float32)

    def quantity(self, name: str) -> NDArray[np.float32]:
        """Return one of ``QUANTITIES`` (x, y, z); NaN where no pose is reached.

        Raises:
            OptionError: There is no such quantity.
        """
        if name not in QUANTITIES:
            raise OptionError("quantity", f"{name!r}", ", ".join(QUANTITIES))
        is_reached = self.index > 0.0
        if name == "branches":
            counts = (self.status == ReachStatus.REACHED).sum(axis=-1)
            values = self.branches.sum(axis=-1) / np.maximum(counts, 1)
        else:
            values = getattr(self, name)
        return np.where(is_reached, values, np.nan).astype(np.float32)

    def index_at(self, position: ArrayLike) -> float:
        """Return the index of the cell of a position (3,), world; 0 outside the map."""
        point = vector(position, 3, "position", OptionError)
        cell = self.grid.cell_of(point[None])[0]
        if (cell < 0).any() or (cell >= self.grid.shape).any():
            return 0.0
        return float(self.index[tuple(cell)])

    def reach_at(self, pose: Pose) -> ReachStatus:
        """Return the status of the entry nearest to a pose of the frame, world."""
        cell = self.grid.cell_of(np.array(pose.position)[None])[0]
        if (cell < 0).any() or (cell >= self.grid.shape).any():
            return ReachStatus.UNREACHABLE
        orientation = self.grid.orientation_of(pose.rotation[None])[0]
        return ReachStatus(int(self.status[(*cell, orientation)]))

    def cloud(self, quantity: str = "index", above: float = 0.0) -> PointCloud:
        """Return the centres of the reached cells, coloured by a quantity.

        Args:
            quantity: One of ``QUANTITIES``.
            above: Only cells whose quantity is above this.
        """
        values = self.quantity(quantity)
        chosen = np.argwhere(values > above)
        points = np.array(self.grid.corner) + self.grid.cell * (chosen + 0.5)
        return coloured(points, values[tuple(chosen.T)])

    def best_base(
        self,
        poses: Sequence[Pose],
        *,
        height: float = 0.0,
        yaws: int = 24,
        tries: int = 50,
    ) -> BasePlacement:
        """Return the pose of the base from which the robot reaches poses of the frame.

        The map is inverted: each pose votes for the places from which it is reached (Vahrenkamp,
        Asfour & Dillmann, 2013). Inverse kinematics then solves all poses from the places with the
        most votes. The first place from which it solves all of them is returned, else the place
        from which it solves the largest number. Obstacles of the map move with the robot.

        Args:
            poses: Poses of the frame in the room.
            height: Height of the robot's model in the room, m. It stands upright.
            yaws: Directions that the robot may face.
            tries: Places that inverse kinematics checks.

        Raises:
            OptionError: There is no pose, or a number out of its range.
            ReachabilityMapError: The map was computed with a condition on collisions, and was
                loaded without it.
        """
        return place_base(self, poses, height, yaws, tries)


def map_reachability(
    robot: Robot,
    *,
    frame: str | None = None,
    cell: float = DEFAULT_CELL,
    directions: int = DEFAULT_DIRECTIONS,
    rolls: int = DEFAULT_ROLLS,
    collisions: CollisionAvoidance | None = None,
    out: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ReachabilityMap:
    """Compute which poses a frame of an arm can reach.

    An arm of six hinges of a known geometry is swept by its closed form: a pose that is not reached
    is proven out of reach. For an arm of seven hinges one joint is swept over 24 values. Other arms
    are solved by ``lm`` from several starts, which takes much longer. An arm of fewer than six
    joints cannot choose its roll: its map has one roll, and a solution with any roll counts.

    Args:
        robot: The arm.
        frame: Frame that should reach the poses; default the tool.
        cell: Edge length of a cell, m.
        directions: Number of directions of the frame's z axis.
        rolls: Number of turns of the frame about each direction; 1 for fewer than six joints.
        collisions: Condition that a branch must keep to be free; None for no condition.
        out: Folder for the map, written block by block (extra ``maps``). If it holds a part of this
            map already, only the missing blocks are computed.
        threads: Default: one for each core that this process may use.
        executor: Executor that sweeps the blocks instead of threads, such as
            ``distributed.Client(…).get_executor()`` for a cluster. The files of the robot must be
            at the same places there.
        progress: Called with the number of finished blocks and the number of all blocks.

    Raises:
        OptionError: A number out of its range.
        UnknownFrameError: The robot has no such frame.
        OutputError: The folder holds something else, or it cannot be written.
        MissingExtraError: ``out`` is given and zarr is not installed.
    """
    require_robot(robot)
    if collisions is not None:
        # Imported here, because it loads the kernels of collision checks: 50 ms.
        from robot_ik.collision.avoidance import require_same_robot

        require_same_robot(robot, collisions)
    if threads is not None:
        require_count("threads", threads, MAX_THREADS)
    name = robot.frame(frame).name
    arm = arm_form(robot, name)
    ball = robot.reach(name)
    if ball is None:
        raise ReachabilityMapError(f"the reach of {robot.name!r} is not bounded")
    require_count("rolls", rolls, MAX_ROLLS)
    if has_free_roll(robot, name):
        rolls = 1
    grid = Grid.around(*ball, cell, directions, rolls)
    sweep = Sweep(robot, name, grid, arm, collisions)
    target = _Arrays(grid) if out is None else MapStore.create(out, grid, _facts(sweep))
    blocks = np.flatnonzero(~target.done).tolist()
    before = len(grid.blocks) - len(blocks)
    if progress is not None:
        progress(before, len(grid.blocks))
    if executor is None:
        results = _on_threads(sweep, blocks, threads or usable_cores())
    else:
        results = _on_executor(sweep, blocks, executor)
    for count, result in enumerate(results, before + 1):
        target.write(result)
        if progress is not None:
            progress(count, len(grid.blocks))
    return _map_of(sweep, target.read(), True)


class _Arrays:
    """The arrays of a map in memory."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self.done = np.zeros(len(grid.blocks), dtype=bool)
        poses = (*grid.shape, grid.orientations)
        self._arrays: dict[str, NDArray[Any]] = {
            "status": np.zeros(poses, dtype=np.uint8),
            "branches": np.zeros(poses, dtype=np.uint8),
            "manipulability": np.zeros(grid.shape, dtype=np.float32),
            "clearance": np.zeros(grid.shape, dtype=np.float32),
        }

    def write(self, result: BlockResult) -> None:
        """Store the arrays of a block."""
        for name, array in self._arrays.items():
            array[self._grid.blocks[result.block]] = getattr(result, name)

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by name."""
        return self._arrays


def _facts(sweep: Sweep) -> dict[str, Any]:
    """Return the entries of the file beside the grid."""
    robot = sweep.robot
    collisions = sweep.collisions
    return {
        "robot": robot.name,
        "source": None if robot.source is None else str(robot.source),
        "joints": list(robot.joints),
        "frame": sweep.frame,
        "checked": collisions is not None,
        "margin": None if collisions is None else collisions.margin,
        "swept": None if sweep.arm is None else sweep.arm.swept,
        "method": sweep.method,
        "fingerprint": sweep.fingerprint(),
    }


def _map_of(sweep: Sweep, arrays: dict[str, NDArray[Any]], is_complete: bool) -> ReachabilityMap:
    return ReachabilityMap(
        robot=sweep.robot,
        frame=sweep.robot.frame(sweep.frame).name,
        grid=sweep.grid,
        collisions=sweep.collisions,
        is_complete=is_complete,
        method=sweep.method,
        **arrays,
    )


def _on_threads(sweep: Sweep, blocks: Sequence[int], threads: int) -> Iterator[BlockResult]:
    """Yield each result when its block is finished. An exception of the caller ends the threads."""
    stop = threading.Event()
    with ThreadPoolExecutor(threads) as pool:
        try:
            yield from _in_turn([pool.submit(sweep.run, block, stop) for block in blocks])
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def _on_executor(sweep: Sweep, blocks: Sequence[int], executor: Executor) -> Iterator[BlockResult]:
    """Yield each result when its block is finished. An exception of the caller cancels the rest."""
    data = pickle.dumps(sweep)
    futures = [executor.submit(run_pickled, data, block) for block in blocks]
    try:
        yield from _in_turn(futures)
    finally:
        for future in futures:
            future.cancel()


def _in_turn(futures: Sequence[Future[BlockResult | None]]) -> Iterator[BlockResult]:
    """Yield results in the order in which they are ready."""
    pending = set(futures)
    while pending:
        ready, pending = wait(pending, return_when=FIRST_COMPLETED)
        for future in ready:
            result = future.result()
            if result is not None:
                yield result
