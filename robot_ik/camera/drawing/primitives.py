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

    ``flat_ends`` closes first and last ring with level strips.
    """
    angle = np.append(np.arange(count) * (2.0 * np.pi / count), 0.0)
    radius, height = profile[:, :1], profile[:, 1:]
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


def _bulge(step: float) -> float:
    """Factor that widens a polygon of that step (radians): corners stand out as far as sides fall short."""
    return 1.0 + step**2 / 16.0


def _splits(length: float) -> int:
    return max(1, int(np.ceil(length / MAX_EDGE - 1e-9)))


def _arc(angles: Array, count: int) -> Array:
    """Profile (k, 2) of a ball of radius 1 at these latitudes, to be turned in ``count`` steps.

    Widened so that corners stand out by as much as the middles of faces fall short.
    """
    gaps = np.diff(angles)
    gap = np.maximum(np.append(gaps, gaps[-1]), np.append(gaps[0], gaps))
    around = np.cos(angles) * (2.0 * np.pi / count)
    out = 1.0 + (gap**2 + around**2) / 16.0
    return np.stack([out * np.cos(angles), out * np.sin(angles)], axis=1)


def _sphere(size: Array, count: int) -> GeomMesh:
    return _lathe(size[0] * _arc(np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 1), count), count)


def _density(long: float, wide: float) -> tuple[Array, Array]:
    """Latitudes (k,) and how many steps of a ball's outline are needed up to each, of those of one as wide.

    An outline falls short by its distance from the centre times the square of the step: steps are short where
    that is far.
    """
    t = np.linspace(-np.pi / 2, np.pi / 2, 181)
    distance = 1.0 / np.sqrt(np.cos(t) ** 2 + (np.sin(t) * wide / long) ** 2)
    need = np.sqrt(distance)
    return t, np.concatenate([[0.0], np.cumsum(0.5 * (need[1:] + need[:-1])) / 180.0])


def lathe_axis(size: Array) -> int:
    """Axis about which an ellipsoid is turned with the fewest faces."""
    wide = [max(size[(k + 1) % 3], size[(k + 2) % 3]) for k in range(3)]
    return int(np.argmin([w * _density(size[k], w)[1][-1] for k, w in enumerate(wide)]))


def _ellipsoid(size: Array, count: int) -> GeomMesh:
    axis = lathe_axis(size)
    turned = np.roll(size, -1 - axis)
    t, need = _density(turned[2], max(turned[0], turned[1]))
    rings = 2 * max(2, int(np.ceil(count / 4 * need[-1] - 1e-9)))
    angles = np.interp(np.linspace(0.0, need[-1], rings + 1), need, t)
    unit = _lathe(_arc(angles, count), count)
    return GeomMesh(np.roll(unit.vertices * turned, 1 + axis, axis=1), unit.faces)


def _capsule(size: Array, count: int) -> GeomMesh:
    radius, half = float(size[0]), float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)
    cap = radius * _arc(np.linspace(0.0, np.pi / 2, count // 4 + 1), count)[1:]
    parts = [
        np.stack([cap[::-1, 0], -half - cap[::-1, 1]], axis=1),
        np.stack([np.full(len(side), radius * _bulge(2.0 * np.pi / count)), side], axis=1),
        np.stack([cap[:, 0], half + cap[:, 1]], axis=1),
    ]
    return _lathe(np.concatenate(parts), count)


def _cylinder(size: Array, count: int) -> GeomMesh:
    radius, half = float(size[0]) * _bulge(2.0 * np.pi / count), float(size[1])
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
    """Radius in metres of a round primitive across the axis about which it is turned; 0 for all else."""
    kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom], dtype=float)
    if kind not in _ROUND:
        return 0.0
    if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return float(np.delete(size, lathe_axis(size)).max())
    return float(size[0])


def outline_error(model: mujoco.MjModel, geom: int) -> float:
    """Greatest error of a round outline, as part of the radius, over the square of the step in radians."""
    return 1.0 / 16.0 if int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_CYLINDER) else 1.0 / 8.0


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
