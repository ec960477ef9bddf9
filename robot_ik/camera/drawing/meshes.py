"""Visible geoms of a MuJoCo model as one stack of faces.

Every round primitive is a lathe: a profile turned about z. A box is six grids. A face is a
quadrilateral of vertex indices, counter-clockwise seen from outside. A triangle repeats its last
index.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array

Index = NDArray[np.int64]
Segments = tuple[int, ...]

#: Possible numbers of faces round a lathe, multiples of 4.
SEGMENTS = (8, 12, 16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96)
#: Longest edge of a face, metres. Short faces follow the curvature of the lens.
MAX_EDGE = 0.13
#: Edges whose faces meet at more than this angle are drawn in outline styles, rad (30 degrees).
CREASE = np.radians(30.0)
#: Vertices of a mesh with more faces are clustered. The time of a drawing grows with the faces.
MAX_MESH_FACES = 1500
#: Largest error of round outlines, px.
ROUND_PX = 0.25
#: Geom groups that MuJoCo's viewer shows by default (mjvOption).
VISIBLE_GROUPS = (1, 1, 1, 0, 0, 0)

# Faces round a geom if the size in the picture is unknown, by its largest radius in metres.
_USUAL_SEGMENTS = ((0.015, 12), (0.04, 16), (np.inf, 24))
# Half side of an endless plane (size 0), metres, and the most faces along a side of a plane.
_ENDLESS_HALF = 2.0
_MOST_PLANE_FACES = 24
# Vertices closer together than this part of the size of a mesh are merged.
_WELD = 1e-7
# Clustering begins with cells of this part of a mesh, and stops at the second number.
_FINEST_CELLS = 64
_COARSEST_CELLS = 8
_CELL_STEP = 1.4
# Latitudes at which the outline of an ellipsoid is measured.
_LATITUDES = 181


@dataclass(frozen=True)
class GeomMesh:
    """Faces of one geom, in the geom's own frame.

    Attributes:
        vertices: (v, 3), metres.
        faces: (f, 4) vertex indices, counter-clockwise from outside.
    """

    vertices: Array
    faces: Index

    @cached_property
    def normals(self) -> Array:
        """(f, 3) outward unit normals."""
        corners = self.vertices[self.faces]
        # For a triangle a b c c the product of its diagonals, (c - a) x (c - b), is normal too.
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.maximum(length, 1e-300))

    @cached_property
    def corner_normals(self) -> Array:
        """(f, 4, 3) mean normals over the faces at a corner that bend by less than ``CREASE``."""
        corner = self.faces.reshape(-1)
        face = np.repeat(np.arange(len(self.faces)), 4)
        distinct = np.ones(self.faces.shape, dtype=bool)
        distinct[:, 3] = self.faces[:, 2] != self.faces[:, 3]
        # Corners sorted by vertex: the faces round a vertex are neighbours in this order.
        order = np.flatnonzero(distinct.reshape(-1))
        order = order[np.argsort(corner[order], kind="stable")]
        starts = np.searchsorted(corner[order], corner)
        counts = np.searchsorted(corner[order], corner, side="right") - starts
        row = np.repeat(np.arange(len(corner)), counts)
        step = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
        other = face[order[np.repeat(starts, counts) + step]]
        cosine = np.einsum("ij,ij->i", self.normals[face[row]], self.normals[other])
        smooth = cosine > np.cos(CREASE)
        total = np.stack(
            [
                np.bincount(row[smooth], self.normals[other[smooth], k], len(corner))
                for k in range(3)
            ],
            axis=1,
        )
        length = np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        return np.asarray(total / length).reshape(-1, 4, 3)

    @cached_property
    def edges(self) -> tuple[Index, Index, NDArray[np.bool_]]:
        """Edges (e, 2) of vertices, the two faces (e, 2) at each, and (e,) whether it is sharp.

        An edge at a border has one face twice.
        """
        pairs = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        owner = np.repeat(np.arange(len(self.faces)), 4)
        distinct = pairs[:, 0] != pairs[:, 1]
        pairs = np.sort(pairs[distinct], axis=1)
        owner = owner[distinct]
        edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
        order = np.argsort(inverse.reshape(-1), kind="stable")
        counts = np.bincount(inverse.reshape(-1), minlength=len(edges))
        first = np.cumsum(counts) - counts
        edge_faces = np.stack([owner[order][first], owner[order][first + counts - 1]], axis=1)
        first_normals = self.normals[edge_faces[:, 0]]
        cosine = np.einsum("ij,ij->i", first_normals, self.normals[edge_faces[:, 1]])
        return edges, edge_faces, cosine < np.cos(CREASE)


@dataclass(frozen=True)
class ModelMesh:
    """Faces of all visible geoms of one model, stacked so that drawing needs no loop over geoms.

    Attributes:
        vertices: (v, 3), of each geom in its own frame, metres.
        faces: (f, 4) rows of ``vertices``. A triangle repeats its last corner.
        corner_normals: (f, 4, 3) as in ``GeomMesh``.
        edges: (e, 2) rows of ``vertices``.
        edge_faces: (e, 2) rows of ``faces``.
        crease: (e,) whether the edge is sharp.
        geoms: (g,) geom ids of the model.
        vertex_geom: (v,) which of ``geoms`` a vertex belongs to.
        face_geom: (f,) which of ``geoms`` a face belongs to.
        face_geom_id: (f,) the geom id of it.
    """

    vertices: Array
    faces: Index
    corner_normals: Array
    edges: Index
    edge_faces: Index
    crease: NDArray[np.bool_]
    geoms: Index
    vertex_geom: Index
    face_geom: Index
    face_geom_id: NDArray[np.int32]


@dataclass(frozen=True)
class _ModelCache:
    """Cached data of a model for drawing.

    Attributes:
        data: Scratch memory for MuJoCo.
        segments: (ngeom,) faces round a round geom at a scale of 1 px per metre; 0 for other geoms.
        radius: (ngeom,) extent of round geoms across their z axis, metres.
        reach: (ngeom,) extent of long round geoms along it, metres.
        parts: Faces by geom and number of segments.
    """

    data: mujoco.MjData
    segments: Array
    radius: Array
    reach: Array
    parts: dict[tuple[int, int], GeomMesh]


# One model has a stack for each combination of segments that was needed.
@lru_cache(maxsize=64)
def cached_mesh(
    model: mujoco.MjModel, *, planes: bool = False, segments: Segments = ()
) -> ModelMesh:
    """Return the faces of all visible geoms of ``model``.

    Args:
        model: Any MuJoCo model.
        planes: Whether planes (floors) are included.
        segments: (ngeom,) faces round each round geom. Default: usual numbers for their radius.
    """
    counts = segments or (0,) * model.ngeom
    known = _model_cache(model).parts
    geoms = visible_geoms(model, planes=planes)
    empty = GeomMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))
    for g in geoms:
        if (g, counts[g]) not in known:
            known[g, counts[g]] = triangulate(model, g, counts[g]) or empty
    parts = [known[g, counts[g]] for g in geoms] or [empty]
    vertex_counts = [len(part.vertices) for part in parts]
    face_counts = [len(part.faces) for part in parts]
    first_vertex = np.cumsum([0, *vertex_counts[:-1]])
    first_face = np.cumsum([0, *face_counts[:-1]])
    return ModelMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + v for p, v in zip(parts, first_vertex, strict=True)]),
        corner_normals=np.concatenate([p.corner_normals for p in parts]),
        edges=np.concatenate([p.edges[0] + v for p, v in zip(parts, first_vertex, strict=True)]),
        edge_faces=np.concatenate([p.edges[1] + f for p, f in zip(parts, first_face, strict=True)]),
        crease=np.concatenate([p.edges[2] for p in parts]),
        geoms=np.array(geoms, dtype=np.int64),
        vertex_geom=np.repeat(np.arange(len(parts)), vertex_counts),
        face_geom=np.repeat(np.arange(len(parts)), face_counts),
        face_geom_id=np.repeat(np.array(geoms, dtype=np.int32), face_counts),
    )


def geom_rgba(model: mujoco.MjModel) -> Array:
    """Return the colours (ngeom, 4), 0 to 1. The material of a geom overrides its rgba."""
    rgba = np.array(model.geom_rgba, dtype=float)
    material = np.array(model.geom_matid)
    colours = np.array(model.mat_rgba, dtype=float).reshape(-1, 4)
    rgba[material >= 0] = colours[material[material >= 0]]
    return rgba


def visible_geoms(model: mujoco.MjModel, *, planes: bool = False) -> list[int]:
    """Return the ids of the visible geoms.

    These are the geoms of the groups 0 to 2 that are not fully transparent. Planes (floors) are
    included if ``planes`` is set.
    """
    rgba = geom_rgba(model)
    plane = int(mujoco.mjtGeom.mjGEOM_PLANE)
    last = len(VISIBLE_GROUPS) - 1
    return [
        g
        for g in range(model.ngeom)
        if VISIBLE_GROUPS[min(max(int(model.geom_group[g]), 0), last)]
        and rgba[g, 3] > 0.0
        and (planes or model.geom_type[g] != plane)
    ]


def scratch_data(model: mujoco.MjModel) -> mujoco.MjData:
    """Return a ``MjData`` that is kept with the model for drawing."""
    return _model_cache(model).data


def segments_for(model: mujoco.MjModel, axes: Array, centres: Array, focal: float) -> Segments:
    """Return the numbers of faces round each geom (one of ``SEGMENTS``, 0 for geoms not round).

    The error of an outline is then at most ``ROUND_PX`` at the nearest point of the geom: inwards
    at the middles of faces, outwards at corners.

    Args:
        model: Any MuJoCo model.
        axes: (ngeom, 3) z axes of the geoms in the camera frame.
        centres: (ngeom, 3) their origins in the camera frame, metres.
        focal: Focal length, px.
    """
    cache = _model_cache(model)
    nearest = centres[:, 2] - cache.reach * np.abs(axes[:, 2]) - cache.radius
    # A geom at the lens or behind it is treated as if it were at half its radius.
    scale = focal / np.maximum(nearest, 0.5 * np.maximum(cache.radius, 1e-9))
    levels = np.array(SEGMENTS)
    level = np.searchsorted(levels, cache.segments * np.sqrt(scale))
    chosen = levels[np.minimum(level, len(levels) - 1)]
    return tuple(np.where(cache.segments > 0, chosen, 0).tolist())


def triangulate(model: mujoco.MjModel, geom: int, segments: int = 0) -> GeomMesh | None:
    """Return the faces of one geom in its own frame.

    Args:
        model: Any MuJoCo model.
        geom: Geom id.
        segments: Faces round a round geom, one of ``SEGMENTS``. 0: the usual number for its radius.

    Returns:
        None for kinds without a surface here (height field, signed distance field).
    """
    kind = int(model.geom_type[geom])
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind in _ROUND:
        radius = round_radius(model, geom)
        segments = segments or next(count for limit, count in _USUAL_SEGMENTS if radius <= limit)
    return _primitive(kind, tuple(model.geom_size[geom].tolist()), segments)


def round_radius(model: mujoco.MjModel, geom: int) -> float:
    """Return the radius of a round geom across its axis of rotation, metres; 0 for other geoms."""
    kind = int(model.geom_type[geom])
    size = np.array(model.geom_size[geom], dtype=float)
    if kind not in _ROUND:
        return 0.0
    if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return float(np.delete(size, lathe_axis(size)).max())
    return float(size[0])


def sphere(size: Array, count: int) -> GeomMesh:
    """Return a ball of radius ``size[0]`` with ``count`` faces round it."""
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 1)
    return _lathe(size[0] * _arc(latitudes, count), count)


def lathe_axis(size: Array) -> int:
    """Return the axis about which an ellipsoid is turned with the fewest faces."""
    widths = [max(size[(k + 1) % 3], size[(k + 2) % 3]) for k in range(3)]
    return int(np.argmin([w * _density(size[k], w)[1][-1] for k, w in enumerate(widths)]))


@lru_cache(maxsize=8)
def _model_cache(model: mujoco.MjModel) -> _ModelCache:
    size = np.asarray(model.geom_size).reshape(-1, 3)
    kind = np.asarray(model.geom_type)
    # The error of an outline is this part of the radius times the square of the step in radians.
    part = np.where(kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER), 1 / 16, 1 / 8)
    error = part * [round_radius(model, g) for g in range(model.ngeom)]
    segments = 2.0 * np.pi * np.sqrt(error / ROUND_PX)
    long_kinds = [int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)]
    ellipsoid = kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    radius = np.where(ellipsoid, size.max(axis=1), size[:, 0]) * (error > 0)
    reach = np.where(np.isin(kind, long_kinds), size[:, 1], 0.0)
    return _ModelCache(mujoco.MjData(model), segments, radius, reach, {})


# Several models contain the same robot: loaded again, with markers, on a table.
@lru_cache(maxsize=512)
def _primitive(kind: int, size: tuple[float, ...], segments: int) -> GeomMesh | None:
    if kind in _FLAT:
        return _FLAT[kind](np.array(size))
    return _ROUND[kind](np.array(size), segments) if kind in _ROUND else None


def _weld(vertices: Array, faces: Index) -> GeomMesh:
    """Merge equal vertices, drop faces without area, put repeated corners of a face last."""
    scale = max(float(np.abs(vertices).max(initial=0.0)), 1e-9)
    key = np.round(vertices / (scale * _WELD)).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    vertices = vertices[first]
    faces = inverse.reshape(-1)[faces]
    # Roll each triangle until its double corner is the last pair.
    for shift in range(4):
        triangle = faces[:, 2] != faces[:, 3]
        double = triangle & (faces[:, shift] == faces[:, (shift + 1) % 4])
        faces[double] = np.stack([faces[double, (shift + 2 + k) % 4] for k in range(4)], axis=1)
    # A face with fewer than three distinct corners has no area.
    a = faces[:, 0]
    b = faces[:, 1]
    c = faces[:, 2]
    return GeomMesh(vertices, faces[(a != b) & (b != c) & (a != c)])


def _grid(points: Array) -> tuple[Array, Index]:
    """Return vertices (m*n, 3) and quadrilaterals of a net of points (m, n, 3)."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    faces = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1)
    return points.reshape(-1, 3), faces.reshape(-1, 4)


def _lathe(profile: Array, count: int, *, flat_ends: bool = False) -> GeomMesh:
    """Turn a profile (k, 2) of radius and height, from bottom to top, about z in ``count`` steps.

    ``flat_ends`` closes the first and the last ring with level strips.
    """
    angle = np.append(np.arange(count) * (2.0 * np.pi / count), 0.0)
    radius = profile[:, :1]
    height = np.broadcast_to(profile[:, 1:], (len(profile), len(angle)))
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    vertices, faces = _grid(ring.transpose(1, 0, 2))
    if flat_ends:
        k = np.arange(count // 2)
        strip = np.stack([k, k + 1, count - k - 1, (count - k) % count], axis=1) * len(profile)
        faces = np.concatenate([faces, strip + len(profile) - 1, strip[:, ::-1]])
    return _weld(vertices, faces)


def _bulge(step: float) -> float:
    """Return the factor that widens a polygon of a step in radians.

    Its corners then stand out as far as the middles of its sides fall short.
    """
    return 1.0 + step**2 / 16.0


def _splits(length: float) -> int:
    """Return the number of faces along a length in metres."""
    return max(1, int(np.ceil(length / MAX_EDGE - 1e-9)))


def _arc(angles: Array, count: int) -> Array:
    """Return the profile (k, 2) of a ball of radius 1 at these latitudes, for ``count`` steps.

    It is widened so that corners stand out as far as the middles of faces fall short.
    """
    gaps = np.diff(angles)
    gap = np.maximum(np.append(gaps, gaps[-1]), np.append(gaps[0], gaps))
    around = np.cos(angles) * (2.0 * np.pi / count)
    radius = 1.0 + (gap**2 + around**2) / 16.0
    return np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)


def _density(length: float, width: float) -> tuple[Array, Array]:
    """Return latitudes (k,) of an ellipsoid and the steps that its outline needs up to each.

    The steps are a part of those of a ball of the same width. The error of an outline is its
    distance from the centre times the square of the step, so steps are short far from the centre.
    """
    t = np.linspace(-np.pi / 2, np.pi / 2, _LATITUDES)
    distance = 1.0 / np.sqrt(np.cos(t) ** 2 + (np.sin(t) * width / length) ** 2)
    need = np.sqrt(distance)
    middle = 0.5 * (need[1:] + need[:-1])
    return t, np.concatenate([[0.0], np.cumsum(middle) / (_LATITUDES - 1)])


def _ellipsoid(size: Array, count: int) -> GeomMesh:
    axis = lathe_axis(size)
    rolled = np.roll(size, -1 - axis)
    t, need = _density(rolled[2], max(rolled[0], rolled[1]))
    rings = 2 * max(2, int(np.ceil(count / 4 * need[-1] - 1e-9)))
    angles = np.interp(np.linspace(0.0, need[-1], rings + 1), need, t)
    ball = _lathe(_arc(angles, count), count)
    return GeomMesh(np.roll(ball.vertices * rolled, 1 + axis, axis=1), ball.faces)


def _capsule(size: Array, count: int) -> GeomMesh:
    radius = float(size[0])
    half = float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)
    side_radius = np.full(len(side), radius * _bulge(2.0 * np.pi / count))
    cap = radius * _arc(np.linspace(0.0, np.pi / 2, count // 4 + 1), count)[1:]
    parts = [
        np.stack([cap[::-1, 0], -half - cap[::-1, 1]], axis=1),
        np.stack([side_radius, side], axis=1),
        np.stack([cap[:, 0], half + cap[:, 1]], axis=1),
    ]
    return _lathe(np.concatenate(parts), count)


def _cylinder(size: Array, count: int) -> GeomMesh:
    radius = float(size[0]) * _bulge(2.0 * np.pi / count)
    half = float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)
    profile = np.stack([np.full(len(side), radius), side], axis=1)
    return _lathe(profile, count, flat_ends=True)


def _box(size: Array) -> GeomMesh:
    vertices: list[Array] = []
    faces: list[Index] = []
    count = 0
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u = (axis + 1) % 3
            v = (axis + 2) % 3
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
    """Return the top of a plane as one net."""
    half = np.where(size[:2] > 0, size[:2], _ENDLESS_HALF)
    counts = [max(2, min(_splits(2 * h), _MOST_PLANE_FACES) + 1) for h in half]
    x = np.linspace(-half[0], half[0], counts[0])
    y = np.linspace(-half[1], half[1], counts[1])
    level = np.zeros((len(x), len(y)))
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), level], axis=-1)
    return _weld(*_grid(points))


def _mesh(model: mujoco.MjModel, mesh: int) -> GeomMesh:
    """Return the triangles of a mesh asset.

    The vertices of a fine mesh are merged in ever larger cells until it has few enough faces.
    """
    v0 = model.mesh_vertadr[mesh]
    f0 = model.mesh_faceadr[mesh]
    vertices = np.array(model.mesh_vert[v0 : v0 + model.mesh_vertnum[mesh]], dtype=float)
    triangles = np.array(model.mesh_face[f0 : f0 + model.mesh_facenum[mesh]], dtype=np.int64)
    quads = np.concatenate([triangles, triangles[:, 2:]], axis=1)
    result = _weld(vertices, quads)
    cells = _FINEST_CELLS
    while len(result.faces) > MAX_MESH_FACES and cells >= _COARSEST_CELLS:
        cell = float(np.ptp(vertices, axis=0).max()) / cells
        key = np.round(vertices / cell).astype(np.int64)
        _, inverse, counts = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        group = inverse.reshape(-1)
        merged = np.stack([np.bincount(group, vertices[:, k]) / counts for k in range(3)], axis=1)
        result = _weld(merged, group[quads])
        cells = int(cells / _CELL_STEP)
    return result


_FLAT: dict[int, Callable[[Array], GeomMesh]] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): _plane,
    int(mujoco.mjtGeom.mjGEOM_BOX): _box,
}
_ROUND: dict[int, Callable[[Array, int], GeomMesh]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _cylinder,
}
