"""What each pixel of a calibrated camera sees of a MuJoCo model: exact, by rays, without OpenGL.

``RayField`` gives the ray of any point of a picture through the lens; ``Caster`` sends rays into a model
(``mj_multiRay``, analytic for primitives).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.mesh import VISIBLE_GROUPS, geom_rgba

Array = NDArray[np.float64]

# Lens rays are computed at nodes this far apart and interpolated cubically: below 1e-4 px for real lenses.
_NODE_PX = 16.0
# Rays reach this far, metres.
_CUTOFF = 50.0


def _cubic_weights(nodes: Array, at: Array) -> Array:
    """Matrix (m, n) that interpolates values at even ``nodes`` (n,) to ``at`` (m,): 4-point Lagrange."""
    step = nodes[1] - nodes[0]
    place = (at - nodes[0]) / step
    left = np.clip(np.floor(place).astype(int) - 1, 0, len(nodes) - 4)
    t = place - left
    weights = np.zeros((len(at), len(nodes)))
    rows = np.arange(len(at))
    for k in range(4):
        others = [j for j in range(4) if j != k]
        value = np.ones(len(at))
        for j in others:
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
        self._x = np.linspace(-0.5, w - 0.5, max(4, int(np.ceil(w / _NODE_PX)) + 1))
        self._y = np.linspace(-0.5, h - 0.5, max(4, int(np.ceil(h / _NODE_PX)) + 1))
        grid = np.stack(np.meshgrid(self._x, self._y), axis=-1)
        ideal = intrinsics.undistort(grid.reshape(-1, 2))
        # a corner beyond the lens model's range sees nothing sensible; straight ahead is harmless
        self._ideal = np.nan_to_num(ideal).reshape(*grid.shape)

    def grid(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Ideal coordinates (len(y), len(x), 2) = (X/Z, Y/Z) of all crossings of pixel columns and rows."""
        columns = _cubic_weights(self._x, np.asarray(x, dtype=float))
        rows = _cubic_weights(self._y, np.asarray(y, dtype=float))
        return np.stack([rows @ self._ideal[..., k] @ columns.T for k in range(2)], axis=-1)

    def points(self, pixels: Array) -> Array:
        """Ideal coordinates (n, 2) of scattered pixels (n, 2)."""
        columns = _sparse(self._x, pixels[:, 0])
        rows = _sparse(self._y, pixels[:, 1])
        total = np.zeros((len(pixels), 2))
        for row, row_weight in zip(*rows, strict=True):
            for column, column_weight in zip(*columns, strict=True):
                total += self._ideal[row, column] * (row_weight * column_weight)[:, None]
        return total


def _sparse(nodes: Array, at: Array) -> tuple[list[NDArray[np.int64]], list[Array]]:
    """The four node indices and weights of ``_cubic_weights``, each (m,)."""
    place = (at - nodes[0]) / (nodes[1] - nodes[0])
    left = np.clip(np.floor(place).astype(np.int64) - 1, 0, len(nodes) - 4)
    t = place - left
    weights = [
        t * 0 + (t - 1) * (t - 2) * (t - 3) / -6,
        t * (t - 2) * (t - 3) / 2,
        t * (t - 1) * (t - 3) / -2,
        t * (t - 1) * (t - 2) / 6,
    ]
    return [left + k for k in range(4)], weights


@lru_cache(maxsize=4)
def ray_field(intrinsics: CameraIntrinsics) -> RayField:
    """The (cached) ray field of a camera."""
    return RayField(intrinsics)


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


class Caster:
    """One model in one configuration, to be looked at along rays."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self._data = mujoco.MjData(model)
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
        normal = np.zeros((n, 3))
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

    def top(self, geom: int) -> float:
        """World height of the upper face of a level box geom; -inf when there is no such geom."""
        if geom >= self.model.ngeom:
            return -np.inf
        return float(self._data.geom_xpos[geom, 2] + self.model.geom_size[geom, 2])

    def lit(self, light: Array, points: Array, slack: float = 2e-3) -> NDArray[np.bool_]:
        """Which ``points`` (n, 3) nothing shades from a light at ``light`` (3,).

        ``slack`` (m) lets a surface not shade itself.
        """
        way = points - light
        reach = np.linalg.norm(way, axis=1)
        hits = self.cast(light, way, normals=False)
        return np.asarray(hits.depth * reach > reach - slack, dtype=bool)
