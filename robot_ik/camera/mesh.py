"""Visible geoms of a MuJoCo model as one stack of faces, for drawing without OpenGL (``painter.py``)."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.primitives import SEGMENTS, Array, GeomMesh, Index, round_radius, triangulate

Segments = tuple[int, ...]

# Edges whose faces meet at more than this are drawn in outline styles, radians (30 degrees).
CREASE = np.radians(30.0)
# Round outlines are drawn true to this, pixels.
ROUND_PX = 0.3
# A lid or label stands out of the face it lies on by at most _LID and sinks into it by at most _SINK, metres.
_LID, _SINK = 0.03, 0.004
# MuJoCo's viewer shows these geom groups unless told otherwise (mjvOption default).
VISIBLE_GROUPS = (1, 1, 1, 0, 0, 0)


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


def build_mesh(model: mujoco.MjModel, *, planes: bool = False, segments: Segments = ()) -> ModelMesh:
    """Stacks the faces of all visible geoms of ``model``; see ``ModelMesh``.

    ``segments``: of each geom of the model, faces round a round one; usual numbers when not given.
    """
    counts_round = segments or (0,) * model.ngeom
    parts = [
        (g, m)
        for g in visible_geoms(model, planes=planes)
        if (m := triangulate(model, g, counts_round[g])) is not None
    ]
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


@dataclass(frozen=True)
class _Kept:
    """What is kept of a model; the model too, so that its id stays its own as long as this lives."""

    model: Any
    data: mujoco.MjData
    radius: Array
    reach: Array
    meshes: OrderedDict[tuple[bool, Segments], ModelMesh]


_CACHE: OrderedDict[int, _Kept] = OrderedDict()
# Models, and levels of detail of each.
_MODELS, _LEVELS = 8, 24


def _kept(model: mujoco.MjModel) -> _Kept:
    if id(model) not in _CACHE:
        radius = np.array([round_radius(model, g) for g in range(model.ngeom)])
        long = np.isin(
            model.geom_type, [int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)]
        )
        reach = np.where(long, np.asarray(model.geom_size)[:, 1], 0.0)
        _CACHE[id(model)] = _Kept(model, mujoco.MjData(model), radius, reach, OrderedDict())
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

    A sphere of n segments, whose faces are widened to the true area, leaves its outline by at most
    (2 pi / n)^2 / 6 of its radius; that shall be ``ROUND_PX`` in the picture at its nearest point.

    Args:
        model: The model; geoms that are not round get 0.
        axes: (ngeom, 3) each geom's z axis in the camera frame.
        centres: (ngeom, 3) in the camera frame.
        focal: Pixels.
    """
    kept = _kept(model)
    nearest = centres[:, 2] - kept.reach * np.abs(axes[:, 2]) - kept.radius
    # a thing at the lens or behind it is cut as one at half its radius
    seen = focal * kept.radius / np.maximum(nearest, 0.5 * np.maximum(kept.radius, 1e-9))
    needed = np.sqrt((2.0 * np.pi) ** 2 / 6.0 * seen / ROUND_PX)
    levels = np.array(SEGMENTS)
    chosen = levels[np.minimum(np.searchsorted(levels, needed), len(levels) - 1)]
    return tuple(np.where(kept.radius > 0, chosen, 0).tolist())
