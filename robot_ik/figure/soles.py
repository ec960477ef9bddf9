"""Soles: the lowest points of a foot's shapes, and how the foot rolls on a floor."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ModelError
from robot_ik.ports import Array

_PITCHES = np.radians(np.arange(-60.0, 90.01, 0.25))
"""Pitches at which a sole is tabulated, rad; toes down is positive."""

_END_STEPS = 8
"""Steps of the table, 2 degrees, beside flat at which the sole stands on one of its ends."""

_GEOM = mujoco.mjtGeom


def shape_points(model: mujoco.MjModel, geom: int, up: Array) -> Array:
    """Return points (k, a, 3) of a geom in its body's frame. One of the k is its lowest.

    A shape that lies on the floor touches it with all of them.

    Args:
        model: The model.
        geom: A sphere, capsule, ellipsoid, box or cylinder.
        up: (a, 3) direction upwards, in the frame of the body.

    Raises:
        ModelError: The geom is of another kind. The lowest point of a mesh is not computed.
    """
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
    axes = matrix.reshape(3, 3)
    size = model.geom_size[geom]
    kind = model.geom_type[geom]
    down = -up @ axes
    ends = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])[:, None]
    if kind == _GEOM.mjGEOM_SPHERE:
        local = size[0] * down[None]
    elif kind == _GEOM.mjGEOM_CAPSULE:
        local = size[0] * down + ends
    elif kind == _GEOM.mjGEOM_ELLIPSOID:
        local = (size**2 * down / np.linalg.norm(size * down, axis=1, keepdims=True))[None]
    elif kind == _GEOM.mjGEOM_BOX:
        corners = size * (2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0)
        local = np.broadcast_to(corners[:, None], (8, len(up), 3))
    elif kind == _GEOM.mjGEOM_CYLINDER:
        across = down * [1.0, 1.0, 0.0]
        length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        local = size[0] * across / length + ends
    else:
        raise ModelError(
            f"the foot's shape {model.geom(geom).name!r} is not a sphere, capsule, ellipsoid, box "
            "or cylinder",
            hint="give the foot simple collision shapes, and its mesh contype=0 conaffinity=0",
        )
    return np.asarray(model.geom_pos[geom] + local @ axes.T)


def lowest_points(model: mujoco.MjModel, geoms: list[int], up: Array) -> tuple[Array, Array]:
    """Return heights (a, g) and positions (a, g, 3) of the lowest points of geoms.

    Arguments and errors are those of ``shape_points``.
    """
    heights = np.empty((len(up), len(geoms)))
    positions = np.empty((len(up), len(geoms), 3))
    rows = np.arange(len(up))
    for index, geom in enumerate(geoms):
        points = shape_points(model, geom, up)
        point_heights = np.einsum("kai,ai->ka", points, up)
        lowest = point_heights.argmin(axis=0)
        heights[:, index] = point_heights[lowest, rows]
        positions[:, index] = points[lowest, rows]
    return heights, positions


@dataclass(frozen=True)
class Sole:
    """How a foot rolls on a floor: the pose of its frame when it stands on its lowest point.

    Attributes:
        pitch: (a,) pitches of the table, rad; toes down is positive.
        height: (a,) height of the foot's frame above the floor, m.
        rolled: (a,) distance forward from flat, m. Rolling without slip moves the frame by
            dx = h dθ.
        front: x of the front end of the flat part, in the foot's frame, m.
        rear: x of the rear end of the flat part, in the foot's frame, m.
    """

    pitch: Array
    height: Array
    rolled: Array
    front: float
    rear: float

    def stand(self, pitch: ArrayLike) -> tuple[Array, Array]:
        """Return the distance forward and the height of the foot's frame at pitches."""
        pitches = np.asarray(pitch, dtype=float)
        return (
            np.interp(pitches, self.pitch, self.rolled),
            np.interp(pitches, self.pitch, self.height),
        )


def rolling_sole(
    model: mujoco.MjModel, geoms: tuple[int, ...], position: Array, rotation: Array
) -> Sole:
    """Return the sole of a foot.

    Args:
        model: The model.
        geoms: Collision geoms of the foot.
        position: (3,) origin of the foot's frame in its body.
        rotation: (3, 3) axes of the foot's frame in its body.
    """
    up = np.column_stack([-np.sin(_PITCHES), 0.0 * _PITCHES, np.cos(_PITCHES)]) @ rotation.T
    lowest, points = lowest_points(model, list(geoms), up)
    height = up @ position - lowest.min(axis=1)
    steps = (height[1:] + height[:-1]) / 2 * np.diff(_PITCHES)
    rolled = np.concatenate([[0.0], np.cumsum(steps)])
    flat = int(np.abs(_PITCHES).argmin())

    # The ends of the sole are its lowest points when it is pitched a little.
    ends = [
        float(((points[i, lowest[i].argmin()] - position) @ rotation)[0])
        for i in (flat - _END_STEPS, flat + _END_STEPS)
    ]
    return Sole(_PITCHES, height, rolled - rolled[flat], front=ends[1], rear=ends[0])
