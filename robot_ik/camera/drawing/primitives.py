"""Surfaces of MuJoCo's geom kinds as faces: sphere, capsule, cylinder, box, ellipsoid, plane, mesh.

Every round primitive is one *lathe*: a profile turned about z; a box is six grids.  A face is a quad of
vertex indices, seen counter-clockwise from outside; a triangle repeats its last index.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Faces round a lathe, multiples of 4: by radius in metres for those who do not know how large it is seen.
SEGMENTS = (8, 12, 16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96)
_USUAL = ((0.015, 12), (0.04, 16), (np.inf, 24))
# Longest face edge, metres.  Short faces follow the lens' curvature and sort well by depth.
MAX_EDGE = 0.13
# Faces of a mesh geom above which its vertices are clustered: the painter pays by the face.
MAX_MESH_FACES = 1500


@dataclass(frozen=True)
class GeomMesh:
    """Faces of one geom, in the geom's own frame, metres.

    Attributes:
        vertices: (v, 3).
        faces: (f, 4) vertex indices, counter-clockwise from outside.
    """

    vertices: Array
    faces: Index


def _weld(vertices: Array, faces: Index) -> GeomMesh:
    """Merges equal vertices, drops faces without area, puts repeated corners of a face last."""
    scale = max(float(np.abs(vertices).max(initial=0.0)), 1e-9)
    key = np.round(vertices / scale * 1e7).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], inverse.reshape(-1)[faces]
    for shift in range(4):  # roll each triangle until its double corner is the last pair
        double = (faces[:, 2] != faces[:, 3]) & (faces[:, shift] == faces[:, (shift + 1) % 4])
        faces[double] = np.stack([faces[double, (shift + 2 + k) % 4] for k in range(4)], axis=1)
    # a rolled triangle a b c c keeps its three corners; fewer distinct corners have no area
    a, b, c = faces[:, 0], faces[:, 1], faces[:, 2]
    return GeomMesh(vertices, faces[(a != b) & (b != c) & (a != c)])


def _grid(points: Array) -> tuple[Array, Index]:
    """Vertices (m*n, 3) and quads of a net of points (m, n, 3)."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1)
    return points.reshape(-1, 3), quads.reshape(-1, 4)


def usual_segments(radius: float) -> int:
    """Faces round a lathe of this radius in metres, when nobody knows how large it is seen."""
    return next(count for limit, count in _USUAL if radius <= limit)


def _lathe(profile: Array, count: int, *, flat_ends: bool = False) -> GeomMesh:
    """Turns a profile (k, 2) of radius and height, from bottom to top, about z in ``count`` steps.

    The polygon of each ring gets the area of the circle, so that a drawn shape is as wide as the
    true one on average.  ``flat_ends`` closes first and last ring with level strips.
    """
    step = 2.0 * np.pi / count
    widen = np.sqrt(step / np.sin(step))
    angle = np.append(np.arange(count) * step, 0.0)
    radius, height = profile[:, :1] * widen, profile[:, 1:]
    ring = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(height, (len(profile), len(angle)))],
        axis=-1,
    )
    vertices, faces = _grid(ring.transpose(1, 0, 2))
    if flat_ends:
        k = np.arange(count // 2)
        strip = np.stack([k, k + 1, count - k - 1, (count - k) % count], axis=1) * len(profile)
        faces = np.concatenate([faces, strip + len(profile) - 1, strip[:, ::-1]])
    return _weld(vertices, faces)


def _splits(length: float) -> int:
    return max(1, int(np.ceil(length / MAX_EDGE - 1e-9)))


def _arc(radius: float, start: float, stop: float, count: int, lift: float) -> Array:
    """Profile of a round end; widened so that corners stand out by as much as faces, turned, fall short."""
    angle = np.linspace(start, stop, count + 1)
    step = (stop - start) / count
    radius *= 1.0 + step**2 / 24.0
    return np.stack([radius * np.cos(angle), radius * np.sin(angle) + lift], axis=1)


def _sphere(size: Array, count: int) -> GeomMesh:
    return _lathe(_arc(size[0], -np.pi / 2, np.pi / 2, count // 2, 0.0), count)


def _ellipsoid(size: Array, count: int) -> GeomMesh:
    unit = _sphere(np.ones(1), count)
    return GeomMesh(unit.vertices * size, unit.faces)


def _capsule(size: Array, count: int) -> GeomMesh:
    radius, half = float(size[0]), float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)[1:-1]
    parts = [
        _arc(radius, -np.pi / 2, 0.0, count // 4, -half),
        np.stack([np.full(len(side), radius), side], axis=1),
        _arc(radius, 0.0, np.pi / 2, count // 4, half),
    ]
    return _lathe(np.concatenate(parts), count)


def _cylinder(size: Array, count: int) -> GeomMesh:
    radius, half = float(size[0]), float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)
    return _lathe(np.stack([np.full(len(side), radius), side], axis=1), count, flat_ends=True)


def _box(size: Array) -> GeomMesh:
    vertices: list[Array] = []
    faces: list[Index] = []
    count = 0
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            points = np.empty((_splits(2 * size[u]) + 1, _splits(2 * size[v]) + 1, 3))
            points[..., axis] = sign * size[axis]
            points[..., u] = np.linspace(-size[u], size[u], points.shape[0])[:, None] * sign
            points[..., v] = np.linspace(-size[v], size[v], points.shape[1])[None, :]
            net, quads = _grid(points)
            vertices.append(net)
            faces.append(quads + count)
            count += len(net)
    return _weld(np.concatenate(vertices), np.concatenate(faces))


def _plane(size: Array) -> GeomMesh:
    """One net of the plane's top; an endless plane (size 0) is drawn 4 m wide."""
    half = np.where(size[:2] > 0, size[:2], 2.0)
    x, y = (np.linspace(-h, h, max(2, min(_splits(2 * h), 24) + 1)) for h in half)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1)
    return _weld(*_grid(points))


def _mesh(model: mujoco.MjModel, mesh: int) -> GeomMesh:
    """Triangles of a mesh asset; a fine one is thinned by merging vertices in ever larger cells."""
    v0, f0 = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = np.array(model.mesh_vert[v0 : v0 + model.mesh_vertnum[mesh]], dtype=float)
    triangles = np.array(model.mesh_face[f0 : f0 + model.mesh_facenum[mesh]], dtype=np.int64)
    quads = np.concatenate([triangles, triangles[:, 2:]], axis=1)
    result = _weld(vertices, quads)
    cells = 64
    while len(result.faces) > MAX_MESH_FACES and cells >= 8:
        cell = float(np.ptp(vertices, axis=0).max()) / cells
        key = np.round(vertices / cell).astype(np.int64)
        _, inverse, counts = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        merged = np.stack(
            [np.bincount(inverse.reshape(-1), vertices[:, k]) / counts for k in range(3)], axis=1
        )
        result = _weld(merged, inverse.reshape(-1)[quads])
        cells = int(cells / 1.4)
    return result


_FLAT: dict[int, Callable[[Array], GeomMesh]] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): _plane,
    int(mujoco.mjtGeom.mjGEOM_BOX): _box,
}
_ROUND: dict[int, Callable[[Array, int], GeomMesh]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _cylinder,
}


def round_radius(model: mujoco.MjModel, geom: int) -> float:
    """Radius in metres of a round primitive's widest part; 0 for everything else."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind not in _ROUND:
        return 0.0
    return float(size.max() if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID) else size[0])


def triangulate(model: mujoco.MjModel, geom: int, segments: int = 0) -> GeomMesh | None:
    """Faces of one geom in its own frame; ``None`` for kinds without a surface here (height field, SDF).

    ``segments``: faces round a round primitive, one of ``SEGMENTS``; 0 takes the usual number for its radius.
    """
    kind = int(model.geom_type[geom])
    size = np.array(model.geom_size[geom], dtype=float)
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind in _FLAT:
        return _FLAT[kind](size)
    if kind in _ROUND:
        return _ROUND[kind](size, segments or usual_segments(round_radius(model, geom)))
    return None
