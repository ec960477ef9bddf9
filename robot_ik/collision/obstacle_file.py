"""``load_obstacles``: the obstacles of an MJCF file."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np

from robot_ik import model as mjcf
from robot_ik.collision.obstacles import (
    Box,
    Capsule,
    Cylinder,
    Mesh,
    Obstacle,
    Plane,
    Sphere,
)
from robot_ik.collision.pairs import part_name
from robot_ik.errors import InvalidObstacleError, ModelError
from robot_ik.geometry import Pose

_ALLOWED = "boxes, spheres, capsules, cylinders, planes and meshes"


def load_obstacles(path: str | os.PathLike[str]) -> tuple[Obstacle, ...]:
    """Return the obstacles of an MJCF file, such as the furniture around an arm.

    Each geom that can collide is an obstacle, at its pose in the world of the file. Geoms whose
    ``contype`` and ``conaffinity`` are 0 are left out. The name of an obstacle is that of its geom,
    else that of its body.

    Args:
        path: MJCF file without joints.

    Raises:
        ModelError: The file cannot be read or compiled.
        InvalidObstacleError: A body has a joint, a geom is of another kind, or the file has no
            obstacle.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise ModelError(f"there is no scene file {file}", path=file, reason="it does not exist")
    model, _, _ = mjcf.read_model(file, file)
    if model.njnt:
        body = model.body(int(model.jnt_bodyid[0])).name
        raise InvalidObstacleError(
            f"body {body!r} of {file} has a joint, so it is not an obstacle",
            hint="a scene file has obstacles only; leave out the robot and everything that moves",
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    obstacles: dict[str, Obstacle] = {}
    for geom in np.flatnonzero(solid).tolist():
        obstacle = _obstacle(model, data, geom, _free_name(model, geom, obstacles), file)
        obstacles[obstacle.name] = obstacle
    if not obstacles:
        raise InvalidObstacleError(
            f"{file} has no geom that can collide", hint=f"add {_ALLOWED} to its worldbody"
        )
    return tuple(obstacles.values())


def _free_name(model: mujoco.MjModel, geom: int, taken: dict[str, Obstacle]) -> str:
    """Return the name of a geom, else of its body, with a number if the name is taken."""
    name = model.geom(geom).name or part_name(model, geom)
    numbered = name
    count = 1
    while numbered in taken:
        count += 1
        numbered = f"{name} {count}"
    return numbered


def _obstacle(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, name: str, file: Path
) -> Obstacle:
    """Return the obstacle of a geom."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, data.geom_xmat[geom])
    pose = Pose(data.geom_xpos[geom], wxyz)
    first, second, third = model.geom_size[geom].tolist()
    kind = int(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return Box(name, size=(2.0 * first, 2.0 * second, 2.0 * third), pose=pose)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return Sphere(name, radius=first, pose=pose)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return Capsule(name, radius=first, length=2.0 * second, pose=pose)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return Cylinder(name, radius=first, length=2.0 * second, pose=pose)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return Plane(name, pose=pose)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start = int(model.mesh_vertadr[mesh])
        vertices = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])]
        return Mesh(name, vertices=np.array(vertices, dtype=float), pose=pose)
    type_name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
    raise InvalidObstacleError(
        f"geom {name!r} of {file} is of the type {type_name}", hint=f"allowed: {_ALLOWED}"
    )
