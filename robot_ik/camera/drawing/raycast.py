"""What each pixel of a calibrated camera sees of a MuJoCo model: exact, by rays, without OpenGL.

``RayField`` gives the ray of any point of a picture through the lens; ``Caster`` sends rays into a model
(``mj_multiRay``, analytic for primitives).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.meshes import VISIBLE_GROUPS, geom_rgba
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array

# Lens rays are computed at nodes this far apart and interpolated cubically: below 1e-3 px even for fisheyes.
_NODE_PX = 10.0
# Rays reach this far, metres; a surface does not shade itself from nearer than the second.
_CUTOFF, _OWN_SHADE = 50.0, 2e-3


def _cubic_weights(nodes: Array, at: Array) -> Array:
    """Matrix (m, n) that interpolates values at even ``nodes`` (n,) to ``at`` (m,): 4-point Lagrange."""
    step = nodes[1] - nodes[0]
    position = (at - nodes[0]) / step
    left = np.clip(np.floor(position).astype(int) - 1, 0, len(nodes) - 4)
    t = position - left
    weights = np.zeros((len(at), len(nodes)))
    rows = np.arange(len(at))
    for k in range(4):
        value = np.ones(len(at))
        for j in range(4):
            if j != k:
                value *= (t - j) / (k - j)
        weights[rows, left + k] = value
    return weights


class RayField:
    """Undistorted viewing rays of a camera at any point of its picture.

    Attributes:
        intrinsics: The camera.
    """

    def __init__(self, intrinsics: CameraIntrinsics) -> None:
        self.intrinsics = intrinsics
        w, h = intrinsics.size
        x = np.linspace(-1.0, w, max(4, int(np.ceil(w / _NODE_PX)) + 1))
        y = np.linspace(-1.0, h, max(4, int(np.ceil(h / _NODE_PX)) + 1))
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        # a corner beyond the lens model's range sees nothing sensible; straight ahead is harmless
        normalized = np.nan_to_num(intrinsics.undistort(grid.reshape(-1, 2))).reshape(*grid.shape)
        # (X/Z) + i (Y/Z) of every pixel centre, with one more pixel all round: one gather fetches both
        columns = _cubic_weights(x, np.arange(-1.0, w + 1)).T
        rows = _cubic_weights(y, np.arange(-1.0, h + 1))
        self._map = np.empty((h + 2, w + 2), dtype=np.complex128)
        self._map.real = rows @ (normalized[..., 0] @ columns)
        self._map.imag = rows @ (normalized[..., 1] @ columns)

    def box(self, x0: int, y0: int, x1: int, y1: int) -> Array:
        """Normalized coordinates (y1 - y0, x1 - x0, 2) of a block of pixel centres."""
        return _pairs(self._map[y0 + 1 : y1 + 1, x0 + 1 : x1 + 1])

    def points(self, pixels: Array) -> Array:
        """Normalized coordinates (n, 2) of pixels (n, 2) inside the picture, or a few pixels beside it.

        Linear between pixel centres: a lens bends by a few 1e-3 px within a pixel.
        """
        w, h = self.intrinsics.size
        left = np.clip(np.floor(pixels[:, 0]).astype(np.int64), -1, w - 1)
        top = np.clip(np.floor(pixels[:, 1]).astype(np.int64), -1, h - 1)
        u, v = pixels[:, 0] - left, pixels[:, 1] - top
        flat, width = self._map.reshape(-1), w + 2
        k = (top + 1) * width + left + 1
        upper = flat[k] * (1 - u) + flat[k + 1] * u
        lower = flat[k + width] * (1 - u) + flat[k + width + 1] * u
        return _pairs(upper * (1 - v) + lower * v)


def _pairs(values: NDArray[np.complex128]) -> Array:
    """Complex numbers (...) as pairs (..., 2)."""
    return np.ascontiguousarray(values).view(np.float64).reshape(*values.shape, 2)


@lru_cache(maxsize=4)
def ray_field(intrinsics: CameraIntrinsics) -> RayField:
    """The (cached) ray field of a camera."""
    return RayField(intrinsics)


def world_directions(pose_world_camera: Pose, normalized: Array) -> Array:
    """World directions (n, 3), unit along the optical axis, of normalized coordinates (n, 2).

    Column by column: OpenBLAS spreads so narrow a product over all cores and takes five times as long.
    """
    x, y = normalized[:, 0], normalized[:, 1]
    result = np.empty((len(normalized), 3))
    for row, (a, b, c) in enumerate(pose_world_camera.rotation):
        np.multiply(x, a, out=result[:, row])
        result[:, row] += b * y
        result[:, row] += c
    return result


@dataclass(frozen=True)
class Hits:
    """Where rays met the model.

    Attributes:
        depth: (n,) in lengths of the ray's direction vector; inf where nothing was hit.
        geom: (n,) geom id; -1 where nothing was hit.
        normal: (n, 3) unit, world axes, towards the viewer's side; zero where nothing was hit.
    """

    depth: Array
    geom: NDArray[np.int32]
    normal: Array


def _all_hit(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of which ``mj_multiRay`` loses nothing.

    It passes over a body whose bounding volume a ray misses, and that is made of the geoms that collide: one
    that is only to be seen and lies outside would not be seen (MuJoCo 4.0.0; ``mj_ray`` finds them all).
    Here that volume, of which it takes the circumscribed sphere, holds all geoms of its body.
    """
    model = copy.copy(model)
    body, root = model.geom_bodyid, model.body_bvhadr[model.geom_bodyid]
    # Planes have no bounding radius and no end.
    plane = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    radius = np.where(plane, mujoco.mjMAXVAL, model.geom_rbound)
    reach = np.linalg.norm(model.geom_pos - model.body_ipos[body], axis=1) + radius
    unfelt = (model.geom_contype == 0) & (model.geom_conaffinity == 0) & (root >= 0)
    for b in np.unique(body[unfelt]):
        model.bvh_aabb[model.body_bvhadr[b]] = 0, 0, 0, reach[body == b].max(), 0, 0
    return model


class Caster:
    """One model in one configuration, to be looked at along rays."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = _all_hit(model)
        self._data = mujoco.MjData(self.model)
        self._groups = np.array(VISIBLE_GROUPS, dtype=np.uint8)
        self.colours = geom_rgba(model)[:, 2::-1].copy()
        """(ngeom, 3) BGR in 0..1."""

    def place(self, qpos: ArrayLike) -> None:
        """Moves the model to ``qpos`` (model.nq,)."""
        self._data.qpos[:] = np.asarray(qpos, dtype=float)
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)

    def cast(self, origin: Array, directions: Array, *, normals: bool = True) -> Hits:
        """First hits of rays from ``origin`` (3,) along ``directions`` (n, 3), world frame."""
        n = len(directions)
        geom = np.full(n, -1, dtype=np.int32)
        depth = np.full(n, -1.0)
        normal = np.zeros((n, 3)) if normals else np.broadcast_to(0.0, (n, 3))
        if n and self.model.ngeom:
            mujoco.mj_multiRay(
                self.model,
                self._data,
                np.ascontiguousarray(origin, dtype=float),
                np.ascontiguousarray(directions, dtype=float).reshape(-1),
                self._groups,
                True,
                -1,
                geom,
                depth,
                normal.reshape(-1) if normals else None,
                n,
                _CUTOFF,
            )
        depth[geom < 0] = np.inf
        return Hits(depth, geom, normal)

    def lit(self, light: Array, points: Array) -> NDArray[np.bool_]:
        """Which ``points`` (n, 3) nothing shades from a light at ``light`` (3,)."""
        from_light = points - light
        reach = np.linalg.norm(from_light, axis=1)
        hits = self.cast(light, from_light, normals=False)
        return np.asarray(hits.depth * reach > reach - _OWN_SHADE, dtype=bool)
