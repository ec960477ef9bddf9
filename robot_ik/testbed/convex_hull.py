"""``ConvexHull``: the shape that MuJoCo gives to a mesh, for obstacles that a page uploads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidObstacleError
from robot_ik.geometry import Array
from robot_ik.testbed.commands import MAX_MESH_VERTICES
from robot_ik.testbed.problem_text import problem_text

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Mesh files that MuJoCo reads."""

_GRAPH_HEAD = 2
"""Numbers of ``mesh_graph`` before its lists: the counts of vertices and faces of the hull."""


@dataclass(frozen=True, eq=False)
class ConvexHull:
    """A convex solid.

    Attributes:
        vertices: (v, 3) m.
        faces: (f, 3) indices of vertices, counter-clockwise from outside.
    """

    vertices: Array
    faces: NDArray[np.int64]

    @classmethod
    def of_points(cls, points: ArrayLike) -> ConvexHull:
        """Return the convex hull of points (n, 3), m.

        Raises:
            InvalidObstacleError: The points are no solid.
        """
        spec = mujoco.MjSpec()
        mesh = spec.add_mesh(name="hull")
        mesh.uservert = np.asarray(points, dtype=float).ravel()
        return _hull_of(spec, "points")

    @classmethod
    def of_file(cls, name: str, content: bytes) -> ConvexHull:
        """Return the convex hull of a mesh file, its lengths in metres.

        Args:
            name: Name of the file. Its suffix says how the file is coded.
            content: Content of the file.

        Raises:
            InvalidObstacleError: Another kind of file, or MuJoCo cannot read it, or its hull has
                too many vertices.
        """
        suffix = PurePath(name).suffix.lower()
        if suffix not in MESH_SUFFIXES:
            raise InvalidObstacleError(
                f"{name!r} is not a mesh file", hint=f"allowed: {', '.join(MESH_SUFFIXES)}"
            )
        spec = mujoco.MjSpec()
        file = f"upload{suffix}"
        spec.assets = {file: content}
        spec.add_mesh(name="hull", file=file)
        hull = _hull_of(spec, name)
        if len(hull.vertices) > MAX_MESH_VERTICES:
            raise InvalidObstacleError(
                f"the hull of {name} has {len(hull.vertices)} vertices",
                hint=f"simplify the mesh: at most {MAX_MESH_VERTICES} are allowed",
            )
        return hull

    @property
    def size(self) -> Array:
        """(3,) edge lengths of the box around it, m."""
        return np.asarray(np.ptp(self.vertices, axis=0))

    def centred(self) -> ConvexHull:
        """Return the same hull with the centre of the box around it at the origin."""
        middle = 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))
        return ConvexHull(self.vertices - middle, self.faces)

    def resized(self, size: ArrayLike) -> ConvexHull:
        """Return the hull stretched so that the box around it has edge lengths (3,), m."""
        return ConvexHull(self.vertices * (np.asarray(size) / self.size), self.faces)


def _hull_of(spec: mujoco.MjSpec, what: str) -> ConvexHull:
    """Return the hull of the only mesh of a spec."""
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
    try:
        model = spec.compile()
    except ValueError as error:
        reason = problem_text(error)
        raise InvalidObstacleError(
            f"{what} cannot be an obstacle: {reason}", hint="give a mesh of a solid"
        ) from None
    # MuJoCo moves a mesh to its centre of mass and turns it to its axes of inertia.
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.mesh_quat[0])
    corners = model.mesh_vert.astype(float) @ matrix.reshape(3, 3).T + model.mesh_pos[0]
    graph = model.mesh_graph
    vertex_count, face_count = graph[:_GRAPH_HEAD].tolist()
    ids_start = _GRAPH_HEAD + vertex_count
    ids = graph[ids_start : ids_start + vertex_count]
    faces = graph[len(graph) - 3 * face_count :].reshape(-1, 3)
    number = np.full(len(corners), -1)
    number[ids] = np.arange(vertex_count)
    return ConvexHull(corners[ids], number[faces])
