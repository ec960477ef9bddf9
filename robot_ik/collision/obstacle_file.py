"""``read_obstacles``: the obstacles of an MJCF file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_ik import model as mjcf
from robot_ik.collision.obstacles import Box, Capsule, Cylinder, Mesh, Obstacle, Plane, Sphere
from robot_ik.errors import InvalidObstacleError
from robot_ik.geometry import Array, Pose, matrix_to_quat

_PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_MESH = mujoco.mjtGeom.mjGEOM_MESH


def read_obstacles(path: str | os.PathLike[str]) -> list[Obstacle]:
    """Return the geoms of an MJCF file as obstacles, where they stand with all joints at zero.

    Geoms that collide with nothing are left out. A geom without a name is named by its number.

    Raises:
        ModelError: The file is missing or cannot be read. The message has MuJoCo's reason.
        InvalidObstacleError: A geom has a shape that no obstacle has.
    """
    file = Path(path)
    model, _, _ = mjcf.read_model(file, file)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    obstacles = []
    for geom in range(model.ngeom):
        if not model.geom_contype[geom] and not model.geom_conaffinity[geom]:
            continue
        name = model.geom(geom).name or f"geom {geom} of {file.name}"
        rotation = data.geom_xmat[geom].reshape(3, 3)
        pose = Pose(data.geom_xpos[geom].copy(), matrix_to_quat(rotation))
        obstacles.append(_obstacle(model, geom, name, pose))
    return obstacles


def _obstacle(model: mujoco.MjModel, geom: int, name: str, pose: Pose) -> Obstacle:
    """Return the obstacle of a geom."""
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    size = model.geom_size[geom].tolist()
    if kind == _PLANE:
        return Plane(name, pose=pose)
    if kind == _SPHERE:
        return Sphere(name, radius=size[0], pose=pose)
    if kind == _CAPSULE:
        return Capsule(name, radius=size[0], length=2.0 * size[1], pose=pose)
    if kind == _CYLINDER:
        return Cylinder(name, radius=size[0], length=2.0 * size[1], pose=pose)
    if kind == _BOX:
        return Box(name, size=(2.0 * size[0], 2.0 * size[1], 2.0 * size[2]), pose=pose)
    if kind == _MESH:
        return _mesh(model, geom, name, pose)
    raise InvalidObstacleError(
        f"geom {name!r} is of type {kind.name.removeprefix('mjGEOM_').lower()}",
        hint="obstacles are planes, spheres, capsules, cylinders, boxes and meshes",
    )


def _mesh(model: mujoco.MjModel, geom: int, name: str, pose: Pose) -> Obstacle:
    """Return the obstacle of a mesh geom. MuJoCo turns the mesh into its own principal axes."""
    mesh: Any = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    vertices: Array = np.array(model.mesh_vert[first : first + model.mesh_vertnum[mesh]])
    # A mesh of vertices is turned into its principal axes again, so the world is its frame.
    return Mesh(name, vertices=pose.apply(vertices.astype(float)))
