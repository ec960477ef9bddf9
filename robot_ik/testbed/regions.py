"""The space that a tool reaches, and where a figure reaches, bends and jumps, as surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_ik.batch import solve_batch
from robot_ik.budget import Budget
from robot_ik.figure import abilities
from robot_ik.figure.figure import load_figure
from robot_ik.kernels.tree import FREE
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.surface import Surface, grid_around, surface_of

CELLS = 19
"""Points of the grid of a shell along each axis."""

_BUDGET = Budget(iterations=200, restarts=2)
"""Of the test whether the tool reaches a point. A point that is missed leaves a dent."""

_FARTHEST = 1.05
"""Size of the grid in distances that the tool cannot exceed."""

_JUMP_SIDE = 3
"""Points of the grid to each side of the shoulder that a jump is tried at."""


@dataclass(frozen=True, eq=False)
class Region:
    """A surface with its name: ``shell``, ``reach``, ``bend`` or ``jump``."""

    name: str
    surface: Surface


def reach_shell(robot: Robot) -> Iterator[Region]:
    """Yield the surface around all points that the tool reaches.

    Inverse kinematics decides for each point of a grid. A floating base stays at home.
    """
    kinds = zip(robot.joints, robot.tree.kind.tolist(), strict=True)
    standing = robot.with_joints([joint for joint, kind in kinds if kind != FREE])
    ball = standing.reach()
    if ball is None:
        return
    centre, radius = ball
    points, origin, cell = grid_around(centre, _FARTHEST * radius, CELLS)
    near = np.linalg.norm(points - centre, axis=1) <= radius
    solved = solve_batch(standing, points[near], solver="lm", budget=_BUDGET)
    filled = np.zeros(len(points), bool)
    filled[near] = solved.converged
    surface = surface_of(filled.reshape((CELLS,) * 3), origin, cell)
    yield Region("shell", surface)


def figure_regions(robot: Robot) -> Iterator[Region]:
    """Yield where a figure reaches, where it bends to reach, and where it jumps, at home."""
    found = abilities.load_abilities(load_figure(robot))
    cell = float(abilities.POINTS[1, 2] - abilities.POINTS[0, 2])
    taken = np.zeros(abilities.SHAPE, bool)
    for kind in ("reach", "bend"):
        filled = np.zeros(abilities.SHAPE, bool)
        for arm in found.figure.hands:
            filled |= found.maps[kind, arm].error == 0.0
        surface = surface_of(filled & ~taken, abilities.ORIGIN, cell)
        yield Region(kind, surface)
        taken |= filled
    jumps = np.zeros(len(abilities.POINTS), bool)
    for index in np.flatnonzero(~taken.reshape(-1)):
        point = abilities.POINTS[index]
        jumps[index] = any(_jumps(found, point, arm, cell) for arm in found.figure.hands)
    surface = surface_of(jumps.reshape(abilities.SHAPE), abilities.ORIGIN, cell)
    yield Region("jump", surface)


def _jumps(found: abilities.Abilities, point: Array, arm: str, cell: float) -> bool:
    """Return whether a jump brings a palm to a point."""
    beside = np.abs(point[:2] - found.under(arm)).max() > _JUMP_SIDE * cell
    if beside or point[2] > found.top(arm):
        return False
    return found.take_off(point, arm) is not None
