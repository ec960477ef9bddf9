"""Visible geoms of a MuJoCo model as faces: spheres, capsules, cylinders, boxes, ellipsoids, meshes.

The painter (``painter.py``) draws these without OpenGL.  Every round primitive is one *lathe*: a
profile turned about z; a box is six grids.  A face is a quad of vertex indices, seen
counter-clockwise from outside; a triangle repeats its last index.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Faces round a lathe by radius in metres: 24 keep a 100 px wide cylinder within 0.2 px of round.
_SEGMENTS = ((0.015, 12), (0.04, 16), (np.inf, 24))
# Longest face edge, metres.  Short faces follow the lens' curvature and sort well by depth.
MAX_EDGE = 0.13
# Faces of a mesh geom above which its vertices are clustered: the painter pays by the face.
MAX_MESH_FACES = 1500
# Edges whose faces meet at more than this are drawn in outline styles, radians (30 degrees).
CREASE = np.radians(30.0)
# A lid or label stands out of the face it lies on by at most _LID and sinks into it by at most _SINK, metres.
_LID, _SINK = 0.03, 0.004
# MuJoCo's viewer shows these geom groups unless told otherwise (mjvOption default).
VISIBLE_GROUPS = (1, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class GeomMesh:
    """Faces of one geom, in the geom's own frame, metres.

    Attributes:
        vertices: (v, 3).
        faces: (f, 4) vertex indices, counter-clockwise from outside.
    """

    vertices: Array
    faces: Index


@dataclass(frozen=True)
class ModelMesh:
    """Faces of all visible geoms of one model, stacked so that drawing needs no loop over geoms.

    Attributes:
        geoms: (g,) geom ids of the model, in the order of ``*_geom``.
        vertices: (v, 3) in geom frames, metres; ``vertex_geom`` (v,) which of ``geoms``.
        faces: (f, 4) into ``vertices``; ``face_geom`` (f,).
        vertex_normals: (v, 3) mean of the unit normals of the faces at a vertex, unit.
        normals: (f, 3) outward unit normals in geom frames; ``centres`` (f, 3).
        overlays: Things lying on a flat face of another geom of the same body (lids, labels): their faces
            and the faces below them, which are to be drawn first whenever they are seen.
        edges: (e, 2) into ``vertices``; ``edge_faces`` (e, 2) its two faces; ``crease`` (e,) sharp ones.
    """

    geoms: Index
    vertices: Array
    vertex_geom: Index
    vertex_normals: Array
    faces: Index
    face_geom: Index
    normals: Array
    centres: Array
    edges: Index
    edge_faces: Index
    crease: NDArray[np.bool_]
    overlays: tuple[tuple[Index, Index], ...]


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


def _segments(radius: float) -> int:
    return next(count for limit, count in _SEGMENTS if radius <= limit)


def _lathe(profile: Array, *, flat_ends: bool = False) -> GeomMesh:
    """Turns a profile (k, 2) of radius and height, from bottom to top, about z.

    The polygon of each ring gets the area of the circle, so that a drawn shape is as wide as the
    true one on average.  ``flat_ends`` closes first and last ring with level strips.
    """
    count = _segments(float(profile[:, 0].max()))
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
    """Profile of a round end; widened like the rings of ``_lathe``."""
    angle = np.linspace(start, stop, count + 1)
    step = (stop - start) / count
    radius *= np.sqrt(step / np.sin(step))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle) + lift], axis=1)


def _sphere(size: Array) -> GeomMesh:
    return _lathe(_arc(size[0], -np.pi / 2, np.pi / 2, _segments(size[0]) // 2, 0.0))


def _ellipsoid(size: Array) -> GeomMesh:
    unit = _sphere(np.ones(1))
    return GeomMesh(unit.vertices * size, unit.faces)


def _capsule(size: Array) -> GeomMesh:
    radius, half = float(size[0]), float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)[1:-1]
    parts = [
        _arc(radius, -np.pi / 2, 0.0, _segments(radius) // 4, -half),
        np.stack([np.full(len(side), radius), side], axis=1),
        _arc(radius, 0.0, np.pi / 2, _segments(radius) // 4, half),
    ]
    return _lathe(np.concatenate(parts))


def _cylinder(size: Array) -> GeomMesh:
    radius, half = float(size[0]), float(size[1])
    side = np.linspace(-half, half, _splits(2 * half) + 1)
    return _lathe(np.stack([np.full(len(side), radius), side], axis=1), flat_ends=True)


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


_PRIMITIVES: dict[int, Callable[[Array], GeomMesh]] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): _plane,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): _capsule,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _cylinder,
    int(mujoco.mjtGeom.mjGEOM_BOX): _box,
}


def triangulate(model: mujoco.MjModel, geom: int) -> GeomMesh | None:
    """Faces of one geom in its own frame; ``None`` for kinds without a surface here (height field, SDF)."""
    kind = int(model.geom_type[geom])
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        return _mesh(model, int(model.geom_dataid[geom]))
    make = _PRIMITIVES.get(kind)
    return None if make is None else make(np.array(model.geom_size[geom], dtype=float))


def geom_rgba(model: mujoco.MjModel) -> Array:
    """Colours (ngeom, 4) in 0..1 as drawn: a geom's material wins over its own rgba."""
    rgba = np.array(model.geom_rgba, dtype=float)
    material = np.array(model.geom_matid)
    rgba[material >= 0] = np.array(model.mat_rgba, dtype=float).reshape(-1, 4)[material[material >= 0]]
    return rgba


def visible_geoms(model: mujoco.MjModel, *, planes: bool = False) -> list[int]:
    """Ids of the geoms a camera sees: groups 0-2, not transparent; planes (floors) only if asked."""
    rgba = geom_rgba(model)
    flat = int(mujoco.mjtGeom.mjGEOM_PLANE)
    return [
        g
        for g in range(model.ngeom)
        if VISIBLE_GROUPS[min(max(int(model.geom_group[g]), 0), 5)]
        and rgba[g, 3] > 0.0
        and (planes or model.geom_type[g] != flat)
    ]


def _edges(faces: Index, normals: Array) -> tuple[Index, Index, NDArray[np.bool_]]:
    """Edges (e, 2), the two faces at each (e, 2; the same one twice at a border), and which are sharp."""
    pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    owner = np.repeat(np.arange(len(faces)), 4)
    real = pairs[:, 0] != pairs[:, 1]
    pairs, owner = np.sort(pairs[real], axis=1), owner[real]
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    counts = np.bincount(inverse.reshape(-1), minlength=len(edges))
    first = np.cumsum(counts) - counts
    edge_faces = np.stack([owner[order][first], owner[order][first + counts - 1]], axis=1)
    bend = np.einsum("ij,ij->i", normals[edge_faces[:, 0]], normals[edge_faces[:, 1]])
    return edges, edge_faces, bend < np.cos(CREASE)


def _vertex_normals(count: int, faces: Index, normals: Array) -> Array:
    total = np.zeros((count, 3))
    for k in range(4):
        np.add.at(total, faces[:, k], normals)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


def _overlays(
    model: mujoco.MjModel, geoms: Index, vertices: Array, vertex_geom: Index, faces: Index, normals: Array
) -> tuple[tuple[Index, Index], ...]:
    """Pairs (faces of a thing, faces it lies on) among geoms of one rigid body; see ``ModelMesh``.

    Sorting faces by distance goes wrong just there, where a small face lies close to a large one.
    """
    turn = np.empty((len(geoms), 9))
    for k, g in enumerate(geoms):
        mujoco.mju_quat2Mat(turn[k], model.geom_quat[g])
    rotation, origin = turn.reshape(-1, 3, 3), np.asarray(model.geom_pos)[geoms]
    points = np.einsum("vij,vj->vi", rotation[vertex_geom], vertices) + origin[vertex_geom]
    owner = vertex_geom[faces[:, 0]]
    normal = np.einsum("fij,fj->fi", rotation[owner], normals)
    centre = points[faces].mean(axis=1)
    radius = np.linalg.norm(points[faces] - centre[:, None], axis=2).max(axis=1, initial=0.0)
    found = []
    for k, g in enumerate(geoms):
        thing = points[vertex_geom == k]
        middle, reach = thing.mean(axis=0), np.linalg.norm(thing - thing.mean(axis=0), axis=1).max()
        same = np.asarray(model.geom_bodyid)[geoms[owner]] == model.geom_bodyid[g]
        close = np.linalg.norm(centre - middle, axis=1) < radius + reach
        below = np.flatnonzero(same & close & (owner != k))
        height = np.einsum("fj,fvj->fv", normal[below], thing[None] - centre[below][:, None])
        lies = (height.min(axis=1) > -_SINK) & (height.max(axis=1) < _LID) & (height.max(axis=1) > 1e-6)
        if lies.any():
            found.append((np.flatnonzero(owner == k), below[lies]))
    return tuple(found)


def build_mesh(model: mujoco.MjModel, *, planes: bool = False) -> ModelMesh:
    """Stacks the faces of all visible geoms of ``model``; see ``ModelMesh``."""
    parts = [(g, m) for g in visible_geoms(model, planes=planes) if (m := triangulate(model, g)) is not None]
    empty = GeomMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))
    meshes = [m for _, m in parts] or [empty]
    counts = [len(m.vertices) for m in meshes]
    offsets = np.cumsum([0, *counts[:-1]])
    vertices = np.concatenate([m.vertices for m in meshes])
    faces = np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)])
    corners = vertices[faces]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # diagonals of a triangle a b c c: (c - a) x (c - b) is its normal just as well
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges, edge_faces, crease = _edges(faces, normals)
    geom_ids = np.array([g for g, _ in parts], dtype=np.int64)
    vertex_geom = np.repeat(np.arange(len(meshes)), counts)
    return ModelMesh(
        geoms=geom_ids,
        vertices=vertices,
        vertex_geom=vertex_geom,
        vertex_normals=_vertex_normals(len(vertices), faces, normals),
        faces=faces,
        face_geom=np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes]),
        normals=normals,
        centres=corners.mean(axis=1),
        edges=edges,
        edge_faces=edge_faces,
        crease=crease,
        overlays=_overlays(model, geom_ids, vertices, vertex_geom, faces, normals) if parts else (),
    )


_CACHE: OrderedDict[tuple[int, bool], tuple[Any, ModelMesh, mujoco.MjData]] = OrderedDict()
_CACHE_SIZE = 8


def cached_mesh(model: mujoco.MjModel, *, planes: bool = False) -> tuple[ModelMesh, mujoco.MjData]:
    """The model's mesh and a scratch ``MjData`` for it, built once and kept for the last few models."""
    key = (id(model), planes)
    if key not in _CACHE:
        # the model is kept too: its id stays its own as long as the entry lives
        _CACHE[key] = (model, build_mesh(model, planes=planes), mujoco.MjData(model))
        while len(_CACHE) > _CACHE_SIZE:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(key)
    return _CACHE[key][1], _CACHE[key][2]
