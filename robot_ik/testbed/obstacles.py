"""Obstacles beside the robot, and how near the robot is to them. ``collision.Scene`` judges.

No method of the testbed avoids them: they show distances and contacts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_ik.collision.obstacles import Box, Cylinder, Obstacle, Sphere
from robot_ik.collision.pairs import Ints, part_name
from robot_ik.collision.scene import Clearance, Scene
from robot_ik.errors import CollisionError
from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.commands import Shape

MAX_OBSTACLES = 8
"""Obstacles of a session. Each costs about 0.2 ms a measurement."""

_SIZE = 0.09
"""Half an edge, or the radius, in extents of the model."""

_PLACE = np.array((0.45, 0.0, 0.30))
"""Position of a new obstacle, in extents of the model."""

_BESIDE = 0.28
"""Distance between two new obstacles along y, in extents of the model."""


@dataclass(frozen=True, eq=False)
class ObstacleView:
    """An obstacle and the part of the robot that is nearest to it.

    Attributes:
        shape: Its shape.
        size: Half an edge, or the radius and half the height, m.
        position: (3,) its centre, world, m.
        distance: m; negative: the depth of a contact. Infinite if nothing can touch it.
        part: The nearest part of the robot.
        points: (2, 3) nearest points on both, world, m. NaN if nothing can touch it.
    """

    shape: Shape
    size: float
    position: Array
    distance: float
    part: str
    points: Array


@dataclass(frozen=True)
class ContactView:
    """Two parts of the robot that touch each other.

    Attributes:
        parts: Their names.
        depth: m.
    """

    parts: tuple[str, str]
    depth: float


class Obstacles:
    """The obstacles of one robot.

    Args:
        robot: The robot whose distances are measured.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._extent = float(robot.model.stat.extent)
        self._shapes: list[tuple[str, Shape]] = []
        self._positions: list[Array] = []
        self._added = 0
        self._scene: Scene | None = None
        self._pairs: list[Ints] = []
        self._own_pairs: Ints = np.zeros((0, 2), np.int64)
        self._clearances: list[Clearance] = []
        self._contact: ContactView | None = None

    @property
    def size(self) -> float:
        """Half an edge, or the radius, m."""
        return _SIZE * self._extent

    def add(self, shape: Shape) -> None:
        """Add an obstacle beside the robot.

        Raises:
            CollisionError: There are too many.
            RobotIkError: As ``Scene``.
        """
        if len(self._shapes) >= MAX_OBSTACLES:
            raise CollisionError(
                f"there are {MAX_OBSTACLES} obstacles, the largest number; remove one first"
            )
        self._added += 1
        side = _BESIDE * ((len(self._shapes) + 1) // 2) * (-1.0) ** len(self._shapes)
        position = (_PLACE + np.array((0.0, side, 0.0))) * self._extent
        name = f"{shape} {self._added}"
        self._build([*self._shapes, (name, shape)], [*self._positions, position])

    def move(self, index: int, position: Array) -> None:
        """Move an obstacle to a position (3,), m."""
        if index < len(self._shapes) and self._scene is not None:
            self._positions[index] = np.array(position, dtype=float)
            self._scene.move(self._shapes[index][0], Pose(self._positions[index]))

    def remove(self, index: int) -> None:
        """Remove an obstacle."""
        if index < len(self._shapes):
            shapes = self._shapes[:index] + self._shapes[index + 1 :]
            self._build(shapes, self._positions[:index] + self._positions[index + 1 :])

    def _build(self, shapes: list[tuple[str, Shape]], positions: list[Array]) -> None:
        obstacles = [
            self._obstacle(name, shape, position)
            for (name, shape), position in zip(shapes, positions, strict=True)
        ]
        scene = Scene(self._robot, obstacles) if obstacles else None
        self._scene = scene
        self._shapes = shapes
        self._positions = positions
        self._clearances = []
        self._contact = None
        if scene is None:
            return
        geoms = [scene.model.geom(name).id for name, _ in shapes]
        self._pairs = [scene.pairs[(scene.pairs == geom).any(axis=1)] for geom in geoms]
        always = {frozenset(touching.pair) for touching in scene.touching}
        is_fixed = scene.model.body_weldid[scene.model.geom_bodyid] == 0
        is_other = np.isin(scene.pairs, geoms) | is_fixed[scene.pairs]
        own = scene.pairs[~is_other.any(axis=1)]
        kept = [
            frozenset((part_name(scene.model, a), part_name(scene.model, b))) not in always
            for a, b in own.tolist()
        ]
        self._own_pairs = own[np.array(kept, bool)]

    def _obstacle(self, name: str, shape: Shape, position: Array) -> Obstacle:
        pose = Pose(position)
        size = self.size
        match shape:
            case "box":
                return Box(name, size=(2.0 * size,) * 3, pose=pose)
            case "sphere":
                return Sphere(name, radius=size, pose=pose)
            case "cylinder":
                return Cylinder(name, radius=size, length=2.0 * size, pose=pose)

    def measure(self, q: Array) -> None:
        """Measure all distances with the robot at ``q`` (nq,)."""
        scene = self._scene
        if scene is None:
            return
        self._clearances = [scene.clearance(q, pairs) for pairs in self._pairs]
        own = scene.clearance(q, self._own_pairs) if len(self._own_pairs) else None
        self._contact = None
        if own is not None and own.pair is not None and own.distance < 0.0:
            self._contact = ContactView(own.pair, -own.distance)

    def view(self) -> tuple[ObstacleView, ...]:
        """Return what a front end shows of the obstacles."""
        if len(self._clearances) != len(self._shapes):
            unknown = Clearance(np.inf, None, np.full((2, 3), np.nan), np.full(3, np.nan))
            clearances = [unknown] * len(self._shapes)
        else:
            clearances = self._clearances
        rows = zip(self._shapes, self._positions, clearances, strict=True)
        return tuple(
            ObstacleView(
                shape=shape,
                size=self.size,
                position=position.copy(),
                distance=clearance.distance,
                part=next((part for part in clearance.pair or () if part != name), ""),
                points=clearance.points,
            )
            for (name, shape), position, clearance in rows
        )

    @property
    def contact(self) -> ContactView | None:
        """The deepest contact between two parts of the robot, which is measured with obstacles."""
        return self._contact
