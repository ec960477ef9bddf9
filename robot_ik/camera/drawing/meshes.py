"""Visible geoms of a MuJoCo model as one stack of faces, for drawing without OpenGL (``painter.py``)."""

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

# ------------------------------------------------------------------------------------------
# Surfaces of MuJoCo's geom kinds as faces: sphere, capsule, cylinder, box, ellipsoid, plane, mesh.
#
# Every round primitive is one *lathe*: a profile turned about z; a box is six grids.  A face is a quad of
# vertex indices, seen counter-clockwise from outside; a triangle repeats its last index.


# Faces round a lathe, multiples of 4: by radius in metres for those who do not know how large it is seen.
SEGMENTS = (8, 12, 16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96)
_USUAL = ((0.015, 12), (0.04, 16), (np.inf, 24))
# Longest face edge, metres.  Short faces follow the lens' curvature and sort well by depth.
MAX_EDGE = 0.13
# Edges whose faces meet at more than this are drawn in outline styles, radians (30 degrees).
CREASE = np.radians(30.0)
# Faces of a mesh geom above which its vertices are clustered: the painter pays by the face.
MAX_MESH_FACES = 1500


@dataclass(frozen=True)
class GeomMesh:
    """Faces of one geom, in the geom's own frame, metres; what drawing wants to know of them is kept.

    Attributes:
        vertices: (v, 3).
        faces: (f, 4) vertex indices, counter-clockwise from outside.
    """

    vertices: Array
    faces: Index

    @cached_property
    def normals(self) -> Array:
        """(f, 3) outward, unit."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        # diagonals of a triangle a b c c: (c - a) x (c - b) is its normal just as well
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))

    @cached_property
    def corner_normals(self) -> Array:
        """(f, 4, 3) at the corners: the mean over the faces there that bend by less than ``CREASE``."""
        corner = self.faces.reshape(-1)
        face = np.repeat(np.arange(len(self.faces)), 4)
        real = np.ones(self.faces.shape, dtype=bool)
        real[:, 3] = self.faces[:, 2] != self.faces[:, 3]
        there = np.flatnonzero(real.reshape(-1))
        there = there[np.argsort(corner[there], kind="stable")]
        starts = np.searchsorted(corner[there], corner)
        counts = np.searchsorted(corner[there], corner, side="right") - starts
        asking = np.repeat(np.arange(len(corner)), counts)
        step = np.arange(len(asking)) - np.repeat(np.cumsum(counts) - counts, counts)
        other = face[there[np.repeat(starts, counts) + step]]
        own = face[asking]
        smooth = np.einsum("ij,ij->i", self.normals[own], self.normals[other]) > np.cos(CREASE)
        total = np.stack(
            [np.bincount(asking[smooth], self.normals[other[smooth], k], len(corner)) for k in range(3)],
            axis=1,
        )
        length = np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        return np.asarray(total / length).reshape(-1, 4, 3)

    @cached_property
    def edges(self) -> tuple[Index, Index, NDArray[np.bool_]]:
        """(e, 2) into ``vertices``; (e, 2) the faces at each, one twice at a border; (e,) which are sharp."""
        pairs = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        owner = np.repeat(np.arange(len(self.faces)), 4)
        real = pairs[:, 0] != pairs[:, 1]
        pairs, owner = np.sort(pairs[real], axis=1), owner[real]
        edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
        order = np.argsort(inverse.reshape(-1), kind="stable")
        counts = np.bincount(inverse.reshape(-1), minlength=len(edges))
        first = np.cumsum(counts) - counts
        edge_faces = np.stack([owner[order][first], owner[order][first + counts - 1]], axis=1)
        cosine = np.einsum("ij,ij->i", self.normals[edge_faces[:, 0]], self.normals[edge_faces[:, 1]])
        return edges, edge_faces, cosine < np.cos(CREASE)


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


def sphere(size: Array, count: int) -> GeomMesh:
    """A ball of radius ``size[0]`` with ``count`` faces round it."""
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
    rolled = np.roll(size, -1 - axis)
    t, need = _density(rolled[2], max(rolled[0], rolled[1]))
    rings = 2 * max(2, int(np.ceil(count / 4 * need[-1] - 1e-9)))
    angles = np.interp(np.linspace(0.0, need[-1], rings + 1), need, t)
    unit = _lathe(_arc(angles, count), count)
    return GeomMesh(np.roll(unit.vertices * rolled, 1 + axis, axis=1), unit.faces)


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
    int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere,
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


def triangulate(model: mujoco.MjModel, geom: int, segments: int = 0) -> GeomMesh | None:
    """Faces of one geom in its own frame; ``None`` for kinds without a surface here (height field, SDF).

    ``segments``: faces round a round primitive, one of ``SEGMENTS``; 0 takes the usual number for its radius.
    """
    kind = int(model.geom_type[geom])
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind in _ROUND:
        radius = round_radius(model, geom)
        segments = segments or next(count for limit, count in _USUAL if radius <= limit)
    return _primitive(kind, tuple(model.geom_size[geom].tolist()), segments)


# The same robot comes as many models: loaded anew, with markers, on a table.
@lru_cache(maxsize=512)
def _primitive(kind: int, size: tuple[float, ...], segments: int) -> GeomMesh | None:
    if kind in _FLAT:
        return _FLAT[kind](np.array(size))
    return _ROUND[kind](np.array(size), segments) if kind in _ROUND else None


# Round outlines are drawn true to this, pixels.
ROUND_PX = 0.25
# MuJoCo's viewer shows these geom groups unless told otherwise (mjvOption default).
VISIBLE_GROUPS = (1, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class ModelMesh:
    """Faces of all visible geoms of one model, stacked so that drawing needs no loop over geoms.

    Attributes:
        vertices: (v, 3), of each geom in its own frame, metres.
        faces: (f, 4) into ``vertices``; a triangle repeats its last corner.
        corner_normals: (f, 4, 3) as of ``GeomMesh``.
        edges, edge_faces, crease: (e, 2), (e, 2) and (e,) as its ``edges``.
        geoms: (g,) geom ids of the model, in the order of ``*_geom``.
        vertex_geom: (v,) which of ``geoms``; ``face_geom`` (f,), and ``face_geom_id`` (f,): its id.
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


_NOTHING = GeomMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))


# Of several models, with several levels of detail.
@lru_cache(maxsize=64)
def cached_mesh(model: mujoco.MjModel, *, planes: bool = False, segments: Segments = ()) -> ModelMesh:
    """Stacks the faces of all visible geoms of ``model``; see ``ModelMesh``.

    ``segments``: of each geom of the model, faces round a round one; usual numbers when not given.
    """
    counts_round = segments or (0,) * model.ngeom
    known = _kept(model).parts
    geoms = visible_geoms(model, planes=planes)
    for g in geoms:
        if (g, counts_round[g]) not in known:
            known[g, counts_round[g]] = triangulate(model, g, counts_round[g]) or _NOTHING
    parts = [known[g, counts_round[g]] for g in geoms] or [_NOTHING]
    vertex_counts, face_counts = [len(p.vertices) for p in parts], [len(p.faces) for p in parts]
    first_vertex = np.cumsum([0, *vertex_counts[:-1]])
    first_face = np.cumsum([0, *face_counts[:-1]])
    return ModelMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + o for p, o in zip(parts, first_vertex, strict=True)]),
        corner_normals=np.concatenate([p.corner_normals for p in parts]),
        edges=np.concatenate([p.edges[0] + o for p, o in zip(parts, first_vertex, strict=True)]),
        edge_faces=np.concatenate([p.edges[1] + o for p, o in zip(parts, first_face, strict=True)]),
        crease=np.concatenate([p.edges[2] for p in parts]),
        geoms=np.array(geoms, dtype=np.int64),
        vertex_geom=np.repeat(np.arange(len(parts)), vertex_counts),
        face_geom=np.repeat(np.arange(len(parts)), face_counts),
        face_geom_id=np.repeat(np.array(geoms, dtype=np.int32), face_counts),
    )


@dataclass(frozen=True)
class _Kept:
    """What is kept of a model for drawing."""

    data: mujoco.MjData
    # segments of each geom where a metre is a pixel, its extents across its z axis and along it
    needed: Array
    radius: Array
    reach: Array
    parts: dict[tuple[int, int], GeomMesh]


@lru_cache(maxsize=8)
def _kept(model: mujoco.MjModel) -> _Kept:
    geoms = range(model.ngeom)
    size, kind = np.asarray(model.geom_size).reshape(-1, 3), np.asarray(model.geom_type)
    # An outline is off by so much of the radius times the square of the step in radians.
    share = np.where(kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER), 1 / 16, 1 / 8)
    error = share * [round_radius(model, g) for g in geoms]
    needed = 2.0 * np.pi * np.sqrt(error / ROUND_PX)
    long = np.isin(kind, [int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)])
    ball = kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    radius = np.where(ball, size.max(axis=1), size[:, 0]) * (error > 0)
    reach = np.where(long, size[:, 1], 0.0)
    return _Kept(mujoco.MjData(model), needed, radius, reach, {})


def scratch_data(model: mujoco.MjModel) -> mujoco.MjData:
    """A ``MjData`` kept with the model for drawing."""
    return _kept(model).data


def segments_for(model: mujoco.MjModel, axes: Array, centres: Array, focal: float) -> Segments:
    """How finely each round geom must be cut so that no corners are seen: one of ``SEGMENTS``, 0 for others.

    Cut so, an outline is off by at most ``ROUND_PX`` in the picture, at the geom's nearest point: inwards at
    the middles of faces, outwards at corners.  ``axes`` and ``centres`` (ngeom, 3) are the geoms' z axes and
    origins in the camera frame, ``focal`` is in pixels.
    """
    kept = _kept(model)
    nearest = centres[:, 2] - kept.reach * np.abs(axes[:, 2]) - kept.radius
    # an object at the lens or behind it is cut as one at half its radius
    scale = focal / np.maximum(nearest, 0.5 * np.maximum(kept.radius, 1e-9))
    levels = np.array(SEGMENTS)
    chosen = levels[np.minimum(np.searchsorted(levels, kept.needed * np.sqrt(scale)), len(levels) - 1)]
    return tuple(np.where(kept.needed > 0, chosen, 0).tolist())
