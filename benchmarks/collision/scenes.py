"""Obstacles of the planning benchmark and of its pictures, and postures among them."""

from __future__ import annotations

import mujoco
import numpy as np

import robot_ik as rik

BOARD = 0.02
"""m. Thickness of the boards of a shelf."""

SHELF_SIZE = (0.3, 0.8, 0.8)
"""m. Depth, width and height of the shelf."""

FLOORS = 2
"""Compartments of the shelf above each other, and beside each other."""

BOXES = 10
"""Boxes around a robot."""

SCATTER = 0.04
"""m. The tool is at most this far from the middle of a compartment, along each axis."""

INSIDE = 0.06
"""m. The tool is this far before the middle of the shelf."""

INTO_SHELF = (0.5, 0.5, 0.5, 0.5)
"""Orientation (w x y z) of a tool whose z axis points along x."""


def shelf(middle: tuple[float, float, float]) -> list[rik.Box]:
    """Return the boards of a shelf that is open towards -x.

    Args:
        middle: Its middle in the world, m.
    """
    depth, width, height = SHELF_SIZE
    boards = [rik.Box("shelf back", size=(BOARD, width, height), pose=_moved(middle, x=depth / 2))]
    for k in range(FLOORS + 1):
        share = k / FLOORS - 0.5
        floor = _moved(middle, z=share * height)
        side = _moved(middle, y=share * width)
        boards.append(rik.Box(f"shelf floor {k}", size=(depth, width, BOARD), pose=floor))
        boards.append(rik.Box(f"shelf side {k}", size=(depth, BOARD, height), pose=side))
    return boards


def _moved(
    middle: tuple[float, float, float], x: float = 0.0, y: float = 0.0, z: float = 0.0
) -> rik.Pose:
    return rik.Pose((middle[0] + x, middle[1] + y, middle[2] + z))


def boxes(robot: rik.Robot, seed: int) -> list[rik.Box]:
    """Return boxes around a robot, none of which touches it at home."""
    rng = np.random.default_rng(seed)
    placed: list[rik.Box] = []
    while len(placed) < BOXES:
        direction = rng.normal(size=3)
        position = rng.uniform(0.4, 0.8) * direction / np.linalg.norm(direction) + (0.0, 0.0, 0.4)
        size = tuple(rng.uniform(0.05, 0.3, 3).tolist())
        box = rik.Box(f"box {len(placed)}", size=size, pose=rik.Pose(position, rng.normal(size=4)))
        if rik.Scene(robot, [box]).free(robot.home):
            placed.append(box)
    return placed


def free_postures(avoid: rik.CollisionAvoidance, count: int, seed: int) -> np.ndarray:
    """Return random postures (count, nq) of hinges that keep twice the margin."""
    rng = np.random.default_rng(seed)
    tree = avoid.scene.robot.tree
    kept = np.empty((0, tree.nq))
    while len(kept) < count:
        rows = rng.uniform(tree.sample_lower, tree.sample_upper, (2 * count, tree.nq))
        kept = np.vstack([kept, rows[avoid.scene.free(rows, 2.0 * avoid.margin)]])
    return kept[:count]


def postures_in_shelf(
    avoid: rik.CollisionAvoidance, middle: tuple[float, float, float], count: int, seed: int
) -> np.ndarray:
    """Return free postures (count, nq) that point into the compartments of a shelf, in turn."""
    rng = np.random.default_rng(seed)
    robot = avoid.scene.robot
    problem = rik.Problem(robot, into_shelf(middle, 0, rng), collisions=avoid)
    kept: list[np.ndarray] = []
    while len(kept) < count:
        target = into_shelf(middle, len(kept), rng)
        start = rng.uniform(robot.tree.sample_lower, robot.tree.sample_upper)
        solution = problem.solve(start, target=target)
        if solution.converged and avoid.scene.free(solution.q, 1.5 * avoid.margin):
            kept.append(solution.q)
    return np.array(kept)


def into_shelf(
    middle: tuple[float, float, float], number: int, rng: np.random.Generator
) -> rik.Pose:
    """Return a pose of the tool that points into a compartment, given by its number, along x."""
    _, width, height = SHELF_SIZE
    side = number % FLOORS - 0.5 * (FLOORS - 1)
    floor = number // FLOORS % FLOORS - 0.5 * (FLOORS - 1)
    centre = (middle[0], middle[1] + side * width / FLOORS, middle[2] + floor * height / FLOORS)
    position = np.array(centre) + rng.uniform(-SCATTER, SCATTER, 3) - (INSIDE, 0.0, 0.0)
    return rik.Pose(position, INTO_SHELF)


def pairs_of(scene: rik.Scene) -> set[tuple[int, int]]:
    """Return the pairs of geoms that a scene compares, the smaller id first."""
    return {(min(pair), max(pair)) for pair in scene.pairs.tolist()}


def has_contact(scene: rik.Scene, pairs: set[tuple[int, int]], q: np.ndarray) -> bool:
    """Return whether MuJoCo finds two parts of a pair in contact."""
    data = scene.data_at(q)
    mujoco.mj_comPos(scene.model, data)
    mujoco.mj_collision(scene.model, data)
    for contact in data.contact[: data.ncon]:
        pair = tuple(sorted((int(contact.geom1), int(contact.geom2))))
        if contact.dist < 0.0 and pair in pairs:
            return True
    return False
