"""Obstacles: shapes with a name and a pose in the world.

They are plain data. ``Scene`` compiles them into its MuJoCo model.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidObstacleError
from robot_ik.geometry import Array, Pose, is_real

LARGEST_SIZE = 1e6
"""m. Largest size of an obstacle: larger numbers lose millimetres to rounding."""

EVERY_BIT = 0x7FFFFFFF
"""``contype`` and ``conaffinity`` of an obstacle: it collides with every geom that can collide."""

FEWEST_VERTICES = 4
"""Vertices of the simplest solid."""


@dataclass(frozen=True)
class Obstacle(ABC):
    """A shape with a name.

    Attributes:
        name: Name of the obstacle, unique in its scene.
        pose: Pose of its centre in the world. Of an attached part: in the frame that carries it.
    """

    name: str
    _: KW_ONLY
    pose: Pose = Pose()

    def __post_init__(self) -> None:
        given: Any = self.name
        if not isinstance(given, str) or not given:
            raise InvalidObstacleError(f"the name of an obstacle is a text, not {given!r}")
        pose: Any = self.pose
        if not isinstance(pose, Pose):
            raise InvalidObstacleError(
                f"the pose of obstacle {self.name!r} is {pose!r}", hint="give a Pose"
            )
        self.check_size()

    @abstractmethod
    def check_size(self) -> None:
        """Raise ``InvalidObstacleError`` for a size that is not finite and positive."""

    @abstractmethod
    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        """Return MuJoCo's type of this shape, and its ``geom_size``."""

    def add_to(self, _spec: mujoco.MjSpec, body: Any) -> Any:
        """Add this shape to a body of a spec, at its origin, and return the geom."""
        kind, size = self.shape()
        return body.add_geom(
            name=self.name, type=kind, size=size, contype=EVERY_BIT, conaffinity=EVERY_BIT
        )

    def _require_positive(self, what: str, value: object) -> None:
        if not is_real(value, 0.0, LARGEST_SIZE) or not value:
            raise InvalidObstacleError(
                f"the {what} of obstacle {self.name!r} is {value!r}",
                hint=f"give a number above 0 and up to {LARGEST_SIZE:g} m",
            )


@dataclass(frozen=True)
class Box(Obstacle):
    """A box.

    Attributes:
        size: Lengths of its edges along x, y and z, m.
    """

    size: tuple[float, float, float] = (0.1, 0.1, 0.1)

    def check_size(self) -> None:
        if not np.iterable(self.size) or len(self.size) != 3:
            raise InvalidObstacleError(
                f"the size of box {self.name!r} is {self.size!r}", hint="give three edge lengths"
            )
        for value in self.size:
            self._require_positive("edge length", value)

    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        return mujoco.mjtGeom.mjGEOM_BOX, [0.5 * float(length) for length in self.size]


@dataclass(frozen=True)
class Sphere(Obstacle):
    """A ball.

    Attributes:
        radius: m.
    """

    radius: float = 0.05

    def check_size(self) -> None:
        self._require_positive("radius", self.radius)

    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        return mujoco.mjtGeom.mjGEOM_SPHERE, [float(self.radius), 0.0, 0.0]


@dataclass(frozen=True)
class _Round(Obstacle):
    """A shape about its z axis.

    Attributes:
        radius: m.
        length: Length along z, m. That of a capsule is without its half balls.
    """

    radius: float = 0.05
    length: float = 0.1

    def check_size(self) -> None:
        self._require_positive("radius", self.radius)
        self._require_positive("length", self.length)

    @property
    def _half(self) -> list[float]:
        return [float(self.radius), 0.5 * float(self.length), 0.0]


@dataclass(frozen=True)
class Capsule(_Round):
    """A cylinder with half balls at its ends."""

    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        return mujoco.mjtGeom.mjGEOM_CAPSULE, self._half


@dataclass(frozen=True)
class Cylinder(_Round):
    """A cylinder."""

    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        return mujoco.mjtGeom.mjGEOM_CYLINDER, self._half


@dataclass(frozen=True)
class Plane(Obstacle):
    """The half space below the xy plane of its pose. It has no edges."""

    def check_size(self) -> None:
        """Do nothing: a plane has no size."""

    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        # This is the size of the drawn part.
        return mujoco.mjtGeom.mjGEOM_PLANE, [1.0, 1.0, 0.01]


@dataclass(frozen=True, eq=False)
class Mesh(Obstacle):
    """The convex hull of a mesh. Split a hollow object into convex parts.

    Attributes:
        file: A mesh file that MuJoCo reads: STL, OBJ or MSH. Give this or ``vertices``.
        vertices: Points (n, 3), m.
        scale: Factor on all lengths; 0.001 for a file in millimetres.
    """

    file: str | os.PathLike[str] | None = None
    vertices: ArrayLike | None = None
    scale: float = 1.0

    def check_size(self) -> None:
        self._require_positive("scale", self.scale)
        if (self.file is None) == (self.vertices is None):
            raise InvalidObstacleError(f"mesh {self.name!r} needs a file or vertices, not both")
        if self.vertices is not None:
            points = self._points()
            span = np.linalg.matrix_rank(points - points[0], tol=1e-9)
            if len(points) < FEWEST_VERTICES or span < 3:
                raise InvalidObstacleError(
                    f"the vertices of mesh {self.name!r} lie in a plane",
                    hint="give at least four points of a solid",
                )

    def _points(self) -> Array:
        try:
            points = np.asarray(self.vertices, dtype=float)
        except (TypeError, ValueError):
            points = np.empty(0)
        if points.ndim != 2 or points.shape[1:] != (3,) or not np.isfinite(points).all():
            raise InvalidObstacleError(
                f"the vertices of mesh {self.name!r} are not finite numbers of shape (n, 3)"
            )
        return points

    def shape(self) -> tuple[mujoco.mjtGeom, list[float]]:
        return mujoco.mjtGeom.mjGEOM_MESH, [0.0, 0.0, 0.0]

    def add_to(self, spec: mujoco.MjSpec, body: Any) -> Any:
        mesh = spec.add_mesh(name=f"{self.name} of the scene", scale=[float(self.scale)] * 3)
        if self.file is not None:
            mesh.file = os.path.abspath(self.file)
        else:
            mesh.uservert = self._points().ravel()
        geom = super().add_to(spec, body)
        geom.meshname = mesh.name
        return geom
