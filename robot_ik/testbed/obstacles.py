"""Obstacles beside the robot, and the distances to them, measured by ``collision.Scene``.

The methods of the testbed do not avoid obstacles. Planned motions do (``testbed.planning``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from robot_ik.collision.obstacles import Box, Cylinder, Mesh, Obstacle, Sphere
from robot_ik.collision.pairs import Ints, part_name
from robot_ik.collision.scene import Clearance, Scene
from robot_ik.errors import CollisionError
from robot_ik.geometry import Pose
from robot_ik.kernels.tree import FREE
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.commands import Shape
from robot_ik.testbed.convex_hull import ConvexHull

ObstacleShape = Literal[Shape, "mesh"]

MAX_OBSTACLES = 8
"""Largest number of obstacles. Each costs about 0.2 ms a measurement."""

MAX_CONTACTS = 8
"""Largest number of contacts that are shown. The deepest ones are shown."""

_EDGE = 0.18
"""Edge length or diameter of a new obstacle, in extents of the model."""

_NEW_POSITION = np.array((0.45, 0.0, 0.30))
"""Position of a new obstacle, in extents of the model."""

_SPACING = 0.28
"""Distance between two new obstacles along y, in extents of the model."""


@dataclass(frozen=True, eq=False)
class PlacedObstacle:
    """An obstacle of a session.

    Attributes:
        name: Its name.
        shape: Its shape.
        size: Edge lengths of the box around it, m.
        position: (3,) its centre, world, m.
        hull: The solid of a mesh, of this size. None for the other shapes.
    """

    name: str
    shape: ObstacleShape
    size: tuple[float, float, float]
    position: Array
    hull: ConvexHull | None = None

    def obstacle(self) -> Obstacle:
        """Return it for ``Scene``."""
        pose = Pose(self.position)
        length_x, _, length_z = self.size
        if self.hull is not None:
            return Mesh(self.name, vertices=self.hull.vertices, pose=pose)
        if self.shape == "box":
            return Box(self.name, size=self.size, pose=pose)
        if self.shape == "sphere":
            return Sphere(self.name, radius=0.5 * length_x, pose=pose)
        return Cylinder(self.name, radius=0.5 * length_x, length=length_z, pose=pose)

    def resized(self, size: tuple[float, float, float]) -> PlacedObstacle:
        """Return it with other edge lengths (see ``ResizeObstacle``)."""
        length_x, _, length_z = size
        if self.shape == "sphere":
            size = (length_x, length_x, length_x)
        elif self.shape == "cylinder":
            size = (length_x, length_x, length_z)
        hull = None if self.hull is None else self.hull.resized(size)
        return replace(self, size=size, hull=hull)


@dataclass(frozen=True, eq=False)
class ObstacleView:
    """An obstacle and the part of the robot that is nearest to it.

    Attributes:
        placed: The obstacle.
        distance: m; negative: the depth of a contact. Infinite if nothing can touch it.
        part: The nearest part of the robot.
        points: (2, 3) nearest points on both, world, m. NaN if nothing can touch it.
    """

    placed: PlacedObstacle
    distance: float
    part: str
    points: Array


@dataclass(frozen=True, eq=False)
class ContactView:
    """Two parts that touch each other: of the robot, or a part and an obstacle.

    Attributes:
        parts: Their names.
        bodies: Ids of the two parts' bodies, as far as they are moving bodies of the robot.
        depth: m.
        point: (3,) the middle of the contact, world, m.
    """

    parts: tuple[str, str]
    bodies: tuple[int, ...]
    depth: float
    point: Array


class Obstacles:
    """The obstacles of one robot.

    Args:
        robot: The robot whose distances are measured.

    Attributes:
        placed: The obstacles.
    """

    def __init__(self, robot: Robot) -> None:
        self.placed: tuple[PlacedObstacle, ...] = ()
        self._robot = robot
        self._extent = float(robot.model.stat.extent)
        self._added = 0
        # Built at the first measurement: the scene of a large robot takes some 50 ms.
        self._scene: Scene | None = None
        self._is_built = False
        self._pairs: list[Ints] = []
        self._contact_pairs: Ints = np.zeros((0, 2), np.int64)
        self._bodies: dict[str, int] = {}
        self._clearances: list[Clearance] = []
        self._contacts: tuple[Clearance, ...] = ()

    def add(self, shape: Shape) -> None:
        """Add an obstacle beside the robot.

        Raises:
            CollisionError: There are ``MAX_OBSTACLES`` already.
            RobotIkError: As ``Scene``.
        """
        edge = _EDGE * self._extent
        self._append(shape, shape, (edge, edge, edge), None)

    def add_mesh(self, name: str, vertices: Array) -> None:
        """Add the convex hull of vertices (n, 3), m, beside the robot. Errors as for ``add``."""
        hull = ConvexHull.of_points(vertices).centred()
        x, y, z = hull.size.tolist()
        self._append(name, "mesh", (x, y, z), hull)

    def _append(
        self,
        title: str,
        shape: ObstacleShape,
        size: tuple[float, float, float],
        hull: ConvexHull | None,
    ) -> None:
        count = len(self.placed)
        if count >= MAX_OBSTACLES:
            raise CollisionError(
                f"a session has at most {MAX_OBSTACLES} obstacles; remove one first"
            )
        self._added += 1
        side = _SPACING * ((count + 1) // 2) * (-1.0) ** count
        position = (_NEW_POSITION + np.array((0.0, side, 0.0))) * self._extent
        name = f"{title} {self._added}"
        self._build((*self.placed, PlacedObstacle(name, shape, size, position, hull)))

    def move(self, index: int, position: Array) -> None:
        """Move an obstacle to a position (3,), m."""
        if index < len(self.placed) and self._scene is not None:
            moved = replace(self.placed[index], position=np.array(position, dtype=float))
            self.placed = (*self.placed[:index], moved, *self.placed[index + 1 :])
            self._scene.move(moved.name, Pose(moved.position))

    def resize(self, index: int, size: tuple[float, float, float]) -> None:
        """Give the box around an obstacle other edge lengths, m."""
        if index < len(self.placed):
            resized = self.placed[index].resized(size)
            self._build((*self.placed[:index], resized, *self.placed[index + 1 :]))

    def remove(self, index: int) -> None:
        """Remove an obstacle."""
        if index < len(self.placed):
            self._build(self.placed[:index] + self.placed[index + 1 :])

    def _build(self, placed: tuple[PlacedObstacle, ...]) -> None:
        scene = Scene(self._robot, [item.obstacle() for item in placed])
        self._scene = scene
        self._is_built = True
        self.placed = placed
        self._clearances = []
        self._contacts = ()
        model = scene.model
        geoms = [model.geom(item.name).id for item in placed]
        self._pairs = [scene.pairs[(scene.pairs == geom).any(axis=1)] for geom in geoms]
        is_fixed = model.body_weldid[model.geom_bodyid] == 0
        is_robot = model.geom_bodyid < self._robot.model.nbody  # the others are obstacles
        self._bodies = {
            part_name(model, geom): int(model.geom_bodyid[geom])
            for geom in np.flatnonzero(is_robot & ~is_fixed).tolist()
        }
        self._contact_pairs = self._pairs_for_contacts(scene, geoms, is_fixed)

    def _pairs_for_contacts(self, scene: Scene, obstacles: list[int], is_fixed: Array) -> Ints:
        """Return the pairs (p, 2) of geoms whose contacts are shown.

        Parts that touch by construction are left out, and a free robot may stand on its floor.
        """
        model = scene.model
        by_construction = {frozenset(touching.pair) for touching in scene.touching}
        kept = [
            frozenset(part_name(model, geom) for geom in pair) not in by_construction
            for pair in scene.pairs.tolist()
        ]
        shown = np.array(kept, bool)
        if (self._robot.tree.kind == FREE).any():
            has_obstacle = np.isin(scene.pairs, obstacles).any(axis=1)
            shown &= has_obstacle | ~is_fixed[scene.pairs].any(axis=1)
        return np.asarray(scene.pairs[shown])

    def measure(self, q: Array) -> None:
        """Measure all distances with the robot at ``q`` (nq,).

        Raises:
            RobotIkError: At the first measurement, as ``Scene``.
        """
        if not self._is_built:
            self._is_built = True
            self._build(())
        scene = self._scene
        if scene is None:
            return
        self._clearances = [scene.clearance(q, pairs) for pairs in self._pairs]
        self._contacts = scene.contacts(q, self._contact_pairs)

    def view(self) -> tuple[ObstacleView, ...]:
        """Return what a front end shows of the obstacles."""
        if len(self._clearances) != len(self.placed):
            unknown = Clearance(np.inf, None, np.full((2, 3), np.nan), np.full(3, np.nan))
            clearances = [unknown] * len(self.placed)
        else:
            clearances = self._clearances
        return tuple(
            ObstacleView(
                placed=placed,
                distance=clearance.distance,
                part=next((part for part in clearance.pair or () if part != placed.name), ""),
                points=clearance.points,
            )
            for placed, clearance in zip(self.placed, clearances, strict=True)
        )

    def contact_views(self) -> tuple[ContactView, ...]:
        """Return what a front end shows of the contacts, the deepest first."""
        return tuple(
            ContactView(
                parts=contact.pair,
                bodies=tuple(self._bodies[part] for part in contact.pair if part in self._bodies),
                depth=-contact.distance,
                point=contact.points.mean(axis=0),
            )
            for contact in self._contacts[:MAX_CONTACTS]
            if contact.pair is not None
        )
