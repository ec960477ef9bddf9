"""Visible geoms of a MuJoCo model as one stack of faces, for drawing without OpenGL (``painter.py``)."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.primitives import (
    SEGMENTS,
    Array,
    GeomMesh,
    Index,
    outline_error,
    round_radius,
    triangulate,
)

Segments = tuple[int, ...]

# Edges whose faces meet at more than this are drawn in outline styles, radians (30 degrees).
CREASE = np.radians(30.0)
# Round outlines are drawn true to this, pixels.
ROUND_PX = 0.25
# MuJoCo's viewer shows these geom groups unless told otherwise (mjvOption default).
VISIBLE_GROUPS = (1, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Part:
    """Faces of one geom with what drawing wants to know of them; geom frame, metres.

    Attributes:
        vertices: (v, 3); ``faces`` (f, 4) into them, a triangle repeats its last corner.
        faces: See ``vertices``.
        normals: (f, 3) outward, unit; ``corner_normals`` (f, 4, 3) the same smoothed over round surfaces.
        corner_normals: See ``normals``.
        edges: (e, 2) into ``vertices``; ``edge_faces`` (e, 2) its two faces; ``crease`` (e,) sharp ones.
        edge_faces: See ``edges``.
        crease: See ``edges``.
    """

    vertices: Array
    faces: Index
    normals: Array
    corner_normals: Array
    edges: Index
    edge_faces: Index
    crease: NDArray[np.bool_]


@dataclass(frozen=True)
class ModelMesh(Part):
    """Faces of all visible geoms of one model, stacked so that drawing needs no loop over geoms.

    Attributes:
        geoms: (g,) geom ids of the model, in the order of ``*_geom``.
        vertex_geom: (v,) which of ``geoms``; ``face_geom`` (f,), and ``face_geom_id`` (f,): its id.
        face_geom: See ``vertex_geom``.
        face_geom_id: See ``vertex_geom``.
    """

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


def _corner_normals(faces: Index, normals: Array) -> Array:
    """Normals (f, 4, 3) at the corners: the mean over the faces there that bend by less than ``CREASE``."""
    corner = faces.reshape(-1)
    face = np.repeat(np.arange(len(faces)), 4)
    real = np.ones(faces.shape, dtype=bool)
    real[:, 3] = faces[:, 2] != faces[:, 3]
    there = np.flatnonzero(real.reshape(-1))
    there = there[np.argsort(corner[there], kind="stable")]
    starts = np.searchsorted(corner[there], corner)
    counts = np.searchsorted(corner[there], corner, side="right") - starts
    asking = np.repeat(np.arange(len(corner)), counts)
    step = np.arange(len(asking)) - np.repeat(np.cumsum(counts) - counts, counts)
    other = face[there[np.repeat(starts, counts) + step]]
    own = face[asking]
    smooth = np.einsum("ij,ij->i", normals[own], normals[other]) > np.cos(CREASE)
    total = np.stack(
        [np.bincount(asking[smooth], normals[other[smooth], k], len(corner)) for k in range(3)], axis=1
    )
    length = np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return np.asarray(total / length).reshape(-1, 4, 3)


def _part(mesh: GeomMesh) -> Part:
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    # diagonals of a triangle a b c c: (c - a) x (c - b) is its normal just as well
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges = _edges(mesh.faces, normals)
    return Part(mesh.vertices, mesh.faces, normals, _corner_normals(mesh.faces, normals), *edges)


_NOTHING = GeomMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))


def build_mesh(model: mujoco.MjModel, *, planes: bool = False, segments: Segments = ()) -> ModelMesh:
    """Stacks the faces of all visible geoms of ``model``; see ``ModelMesh``.

    ``segments``: of each geom of the model, faces round a round one; usual numbers when not given.
    """
    counts_round = segments or (0,) * model.ngeom
    known = _kept(model).parts
    geoms = visible_geoms(model, planes=planes)
    for g in geoms:
        if (g, counts_round[g]) not in known:
            known[g, counts_round[g]] = _part(triangulate(model, g, counts_round[g]) or _NOTHING)
    parts = [known[g, counts_round[g]] for g in geoms] or [_part(_NOTHING)]
    vertex_counts, face_counts = [len(p.vertices) for p in parts], [len(p.faces) for p in parts]
    first_vertex = np.cumsum([0, *vertex_counts[:-1]])
    first_face = np.cumsum([0, *face_counts[:-1]])
    return ModelMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + o for p, o in zip(parts, first_vertex, strict=True)]),
        normals=np.concatenate([p.normals for p in parts]),
        corner_normals=np.concatenate([p.corner_normals for p in parts]),
        edges=np.concatenate([p.edges + o for p, o in zip(parts, first_vertex, strict=True)]),
        edge_faces=np.concatenate([p.edge_faces + o for p, o in zip(parts, first_face, strict=True)]),
        crease=np.concatenate([p.crease for p in parts]),
        geoms=np.array(geoms, dtype=np.int64),
        vertex_geom=np.repeat(np.arange(len(parts)), vertex_counts),
        face_geom=np.repeat(np.arange(len(parts)), face_counts),
        face_geom_id=np.repeat(np.array(geoms, dtype=np.int32), face_counts),
    )


@dataclass(frozen=True)
class _Kept:
    """What is kept of a model; the model too, so that its id stays its own as long as this lives."""

    model: Any
    data: mujoco.MjData
    # segments of each geom where a metre is a pixel, its extents across its z axis and along it
    needed: Array
    radius: Array
    reach: Array
    parts: dict[tuple[int, int], Part]
    meshes: OrderedDict[tuple[bool, Segments], ModelMesh]


_CACHE: OrderedDict[int, _Kept] = OrderedDict()
# Models, and levels of detail of each.
_MODELS, _LEVELS = 8, 24


def _kept(model: mujoco.MjModel) -> _Kept:
    if id(model) not in _CACHE:
        geoms = range(model.ngeom)
        error = np.array([round_radius(model, g) * outline_error(model, g) for g in geoms])
        needed = 2.0 * np.pi * np.sqrt(error / ROUND_PX)
        size, kind = np.asarray(model.geom_size).reshape(-1, 3), np.asarray(model.geom_type)
        long = np.isin(kind, [int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)])
        ball = kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
        radius = np.where(ball, size.max(axis=1), size[:, 0]) * (error > 0)
        reach = np.where(long, size[:, 1], 0.0)
        _CACHE[id(model)] = _Kept(model, mujoco.MjData(model), needed, radius, reach, {}, OrderedDict())
        while len(_CACHE) > _MODELS:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(id(model))
    return _CACHE[id(model)]


def scratch_data(model: mujoco.MjModel) -> mujoco.MjData:
    """A ``MjData`` kept with the model for drawing."""
    return _kept(model).data


def cached_mesh(model: mujoco.MjModel, *, planes: bool = False, segments: Segments = ()) -> ModelMesh:
    """``build_mesh``, kept for the last few models and levels of detail."""
    meshes, key = _kept(model).meshes, (planes, segments)
    if key not in meshes:
        meshes[key] = build_mesh(model, planes=planes, segments=segments)
        while len(meshes) > _LEVELS:
            meshes.popitem(last=False)
    meshes.move_to_end(key)
    return meshes[key]


def segments_for(model: mujoco.MjModel, axes: Array, centres: Array, focal: float) -> Segments:
    """How finely each round geom must be cut so that nobody sees corners: one of ``SEGMENTS`` each.

    Cut so, an outline is off by at most ``ROUND_PX`` in the picture, at the geom's nearest point: inwards at
    the middles of faces, outwards at corners.

    Args:
        model: The model; geoms that are not round get 0.
        axes: (ngeom, 3) each geom's z axis in the camera frame.
        centres: (ngeom, 3) in the camera frame.
        focal: Pixels.
    """
    kept = _kept(model)
    nearest = centres[:, 2] - kept.reach * np.abs(axes[:, 2]) - kept.radius
    # a thing at the lens or behind it is cut as one at half its radius
    scale = focal / np.maximum(nearest, 0.5 * np.maximum(kept.radius, 1e-9))
    levels = np.array(SEGMENTS)
    chosen = levels[np.minimum(np.searchsorted(levels, kept.needed * np.sqrt(scale)), len(levels) - 1)]
    return tuple(np.where(kept.needed > 0, chosen, 0).tolist())
