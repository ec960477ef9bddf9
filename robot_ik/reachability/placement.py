"""Base placement: the pose of the base from which a robot reaches given poses.

For each direction that the robot may face, the places are a grid with the step of the map's cells.
The cells of a pose relative to all places are one layer of the map, mirrored and shifted. So the
votes of a pose for all places are one sum of two tables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.batch import solve_batch
from robot_ik.errors import OptionError, ReachabilityMapError
from robot_ik.geometry import Array, Pose, is_real
from robot_ik.reachability import cells
from robot_ik.reachability.grid import require_count
from robot_ik.reachability.numeric_sweep import has_free_roll

if TYPE_CHECKING:
    from robot_ik.reachability.grid import Grid
    from robot_ik.reachability.reachability_map import ReachabilityMap

MAX_YAWS = 720
"""Largest number of directions that the robot may face: steps of half a degree."""

MAX_PLACES = 20_000_000
"""Largest number of places of one direction. Poses that need more are hundreds of metres apart."""

MAX_TRIES = 10_000
"""Largest number of places that inverse kinematics checks."""


@dataclass(frozen=True, eq=False)
class BasePlacement:
    """The pose of a base from which a robot reaches poses.

    Attributes:
        base: Pose of the robot's model in the room.
        votes: Number of poses that are reached from this base according to the map.
        solved: (n,) whether inverse kinematics solves each pose, with the condition of the map.
        q: (n, nq) its solutions.
    """

    base: Pose
    votes: int
    solved: NDArray[np.bool_]
    q: Array

    def __repr__(self) -> str:
        x, y, z = self.base.position
        count = int(self.solved.sum())
        return f"BasePlacement(({x:.3f}, {y:.3f}, {z:.3f}), {count} of {len(self.solved)} poses)"


def place_base(
    reach_map: ReachabilityMap, poses: Sequence[Pose], height: float, yaws: int, tries: int
) -> BasePlacement:
    """Return a place for the robot's base, see ``ReachabilityMap.best_base``."""
    given: Any = poses
    if isinstance(given, Pose) or not all(isinstance(pose, Pose) for pose in given) or not given:
        raise OptionError("poses", f"{poses!r}", "a list of at least one Pose")
    if not is_real(height):
        raise OptionError("height", f"{height!r}", "a finite number, m")
    require_count("yaws", yaws, MAX_YAWS)
    require_count("tries", tries, MAX_TRIES)
    if has_free_roll(reach_map.robot, reach_map.frame):
        raise ReachabilityMapError(
            f"{reach_map.robot.name!r} has too few joints to reach any pose",
            hint="a place for the base needs an arm of six joints or more",
        )
    if reach_map.collisions is None and np.isfinite(reach_map.clearance).any():
        raise ReachabilityMapError(
            "this map was computed with a condition on collisions, and loaded without it",
            hint="load it with the same condition: ReachabilityMap.load(path, collisions=…)",
        )
    proposals = _proposals(reach_map, poses, height, yaws, tries)
    best = _confirmed(reach_map, poses, *proposals[0])
    for votes, base in proposals[1:]:
        if best.solved.all():
            break
        placement = _confirmed(reach_map, poses, votes, base)
        if placement.solved.sum() > best.solved.sum():
            best = placement
    return best


def _proposals(
    reach_map: ReachabilityMap, poses: Sequence[Pose], height: float, yaws: int, tries: int
) -> list[tuple[int, Pose]]:
    """Return the ``tries`` places with the most votes, best first, and their votes."""
    scores = []
    bases = []
    for turn in range(yaws):
        yaw = 2.0 * math.pi * turn / yaws
        unturned = Pose((0.0, 0.0, -height)).compose(_facing(-yaw))
        targets = [unturned.compose(pose) for pose in poses]
        table, first = _votes(reach_map, targets)
        # Only the best of each table can be among the best of all.
        chosen = np.argsort(table, axis=None)[::-1][:tries]
        for index in chosen.tolist():
            i, j = np.unravel_index(index, table.shape)
            shift = reach_map.grid.cell * (first + np.array([i, j]))
            place = _facing(yaw).apply(np.array([shift[0], shift[1], 0.0]))
            scores.append(float(table[i, j]))
            bases.append(Pose((place[0], place[1], height), _facing(yaw).wxyz))
    order = np.argsort(-np.array(scores), kind="stable")[:tries]
    weight = len(poses) + 1
    return [(int(scores[k] // weight), bases[k]) for k in order.tolist()]


def _facing(yaw: float) -> Pose:
    """Return the pose of a robot at the origin that faces a direction."""
    return Pose((0.0, 0.0, 0.0), (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)))


def _votes(reach_map: ReachabilityMap, targets: Sequence[Pose]) -> tuple[Array, NDArray[np.int64]]:
    """Return the votes of poses for places whose robot faces along x.

    Args:
        reach_map: The map.
        targets: The poses, in the axes of the robot.

    Returns:
        The score (a, b) of each place, votes · (poses + 1) + sum of the indices of the cells, and
        the coordinates (2,) of the first place in cells.
    """
    grid: Grid = reach_map.grid
    rotations = np.array([pose.rotation for pose in targets])
    positions = np.array([pose.position for pose in targets])
    orientations = grid.orientation_of(rotations)
    # Cells of the poses for a robot at the origin.
    at_origin = grid.cell_of(positions)
    # For a robot at (x, y) cells, a pose is in the cell at_origin - (x, y), which must be in the
    # grid.
    width = np.array(grid.shape[:2])
    first = at_origin[:, :2].min(axis=0) - width + 1
    last = at_origin[:, :2].max(axis=0)
    count = int(np.prod(last - first + 1))
    if count > MAX_PLACES:
        raise OptionError(
            "poses",
            f"they are up to {np.ptp(positions[:, :2], axis=0).max():.3g} m apart",
            hint="give poses that one robot can reach from one place",
        )
    table = np.zeros(last - first + 1)
    for cell, orientation in zip(at_origin, orientations.tolist(), strict=True):
        layer = int(cell[2])
        if not 0 <= layer < grid.shape[2]:
            continue
        reached = reach_map.status[:, :, layer, orientation] == cells.REACHED
        value = (len(targets) + 1.0 + reach_map.index[:, :, layer]) * reached
        # Cell 0 of the layer belongs to the place farthest along x and y.
        i, j = cell[:2] - width + 1 - first
        table[i : i + width[0], j : j + width[1]] += value[::-1, ::-1]
    return table, first


def _confirmed(
    reach_map: ReachabilityMap, poses: Sequence[Pose], votes: int, base: Pose
) -> BasePlacement:
    """Return the placement at a base, with all poses solved by inverse kinematics."""
    targets = [base.inverse().compose(pose) for pose in poses]
    solution = solve_batch(
        reach_map.robot, targets, frame=reach_map.frame, collisions=reach_map.collisions
    )
    return BasePlacement(base, votes, solution.converged, solution.q)
