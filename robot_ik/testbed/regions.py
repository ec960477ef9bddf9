"""The space that a tool reaches, and where a figure reaches, bends and jumps, as surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_ik.batch import solve_batch
from robot_ik.budget import Budget
from robot_ik.figure import reach_map
from robot_ik.figure.abilities import Abilities, load_abilities
from robot_ik.figure.figure import load_figure
from robot_ik.kernels.tree import FREE
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.surface import Surface, grid_around, surface_of

CELLS = 19
"""Points of the grid of a shell along each axis."""

_BUDGET = Budget(iterations=200, restarts=2)
"""Budget of the test of a point. A reachable point without a solution leaves a dent."""

_GRID_RADIUS = 1.05
"""Radius of the grid, as a multiple of the reach of the tool."""

_JUMP_SIDE = 3
"""Grid points to each side of the shoulder at which a jump is tried."""


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
    points, origin, cell = grid_around(centre, _GRID_RADIUS * radius, CELLS)
    near = np.linalg.norm(points - centre, axis=1) <= radius
    solved = solve_batch(standing, points[near], solver="lm", budget=_BUDGET)
    filled = np.zeros(len(points), bool)
    filled[near] = solved.converged
    surface = surface_of(filled.reshape((CELLS,) * 3), origin, cell)
    yield Region("shell", surface)


def figure_regions(robot: Robot) -> Iterator[Region]:
    """Yield the regions that a figure at home reaches standing, bending and jumping."""
    abilities = load_abilities(load_figure(robot))
    taken = np.zeros(reach_map.SHAPE, bool)
    for kind in ("reach", "bend"):
        filled = np.zeros(reach_map.SHAPE, bool)
        for arm in abilities.figure.hands:
            filled |= abilities.maps[kind, arm].error == 0.0
        surface = surface_of(filled & ~taken, reach_map.ORIGIN, reach_map.GRID)
        yield Region(kind, surface)
        taken |= filled
    jumps = np.zeros(len(reach_map.POINTS), bool)
    for index in np.flatnonzero(~taken.reshape(-1)):
        point = reach_map.POINTS[index]
        jumps[index] = any(_jumps(abilities, point, arm) for arm in abilities.figure.hands)
    surface = surface_of(jumps.reshape(reach_map.SHAPE), reach_map.ORIGIN, reach_map.GRID)
    yield Region("jump", surface)


def _jumps(abilities: Abilities, point: Array, arm: str) -> bool:
    """Return whether a jump brings a palm to a point."""
    beside = np.abs(point[:2] - abilities.highest_at(arm)).max()
    if beside > _JUMP_SIDE * reach_map.GRID or point[2] > abilities.highest_palm(arm):
        return False
    return abilities.take_off(point, arm) is not None
