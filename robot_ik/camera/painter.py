"""Painter's algorithm: a MuJoCo model drawn into a camera picture without OpenGL.

All geometry is numpy on whole arrays; only the fills are a loop.  Vertices go through the lens model
themselves, so a drawing lies on the raw, distorted picture.  Faces are sorted one by one by distance:
right for geoms that do not pass through each other, nearly right where they do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.mesh import ModelMesh, cached_mesh, geom_rgba, scratch_data, segments_for
from robot_ik.geometry import Pose

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]

# Nothing nearer to the lens is drawn, metres.
NEAR = 0.02
# Faces are clipped this fraction of the view outside it, where the lens model still holds.
_MARGIN = 0.06
# cv2's anti-aliased fill reaches 0.67 px beyond its polygon (measured over random squares): outlines are
# drawn in by as much, along the vertex normals in the picture.
BLEED = 0.67
# cv2's fixed point coordinates: 1/256 px.
_SHIFT = 8
# Direction to the light in the camera frame (x right, y down, z forward): above, left, behind the lens.
_LIGHT = np.array([-0.35, -0.75, -0.55]) / np.linalg.norm([-0.35, -0.75, -0.55])
_AMBIENT = 0.45


@dataclass(frozen=True)
class Polygons:
    """Visible faces in drawing order, far to near.

    Attributes:
        quads: (n, 4, 2) int32 corners in 1/256 px; ``clipped`` replaces those that leave the view by
            polygons (k, 2), k = 0 when nothing is left.
        shade: (n,) brightness 0..1; ``geom`` (n,) model geom id.
        lines: For each polygon its outline edges (j, 2, 2) in 1/256 px; empty when not asked for.
    """

    quads: NDArray[np.int32]
    clipped: dict[int, NDArray[np.int32]]
    shade: Array
    geom: Index
    lines: list[NDArray[np.int32]]

    def moved(self, corner: tuple[int, int]) -> list[NDArray[np.int32]]:
        """The polygons in coordinates of a canvas whose pixel (0, 0) is ``corner`` of the picture."""
        offset = np.array(corner, dtype=np.int32) << _SHIFT
        points = list(self.quads - offset)
        for k, polygon in self.clipped.items():
            points[k] = polygon - offset
        return points


@lru_cache(maxsize=16)
def _view_planes(intrinsics: CameraIntrinsics) -> Array:
    """Inward planes (5, 4) round the view, n . p + d >= 0 inside: near, left, right, top, bottom."""
    x = np.linspace(-0.5, intrinsics.width - 0.5, 33)
    y = np.linspace(-0.5, intrinsics.height - 0.5, 33)
    edges = [(x, np.full(33, y[0])), (x, np.full(33, y[-1])), (np.full(33, x[0]), y), (np.full(33, x[-1]), y)]
    border = intrinsics.undistort(np.concatenate([np.stack(e, axis=1) for e in edges]))
    border = border[np.isfinite(border).all(axis=1)]
    low, high = border.min(axis=0), border.max(axis=0)
    low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    return np.array(
        [
            [0, 0, 1, -NEAR],
            [1, 0, -low[0], 0],
            [-1, 0, high[0], 0],
            [0, 1, -low[1], 0],
            [0, -1, high[1], 0],
        ],
        dtype=float,
    )


def _clip(polygon: Array, planes: Array) -> Array:
    """Part (k, 3) of a convex polygon inside all planes (Sutherland and Hodgman 1974)."""
    for plane in planes:
        if len(polygon) < 3:
            break
        side = polygon @ plane[:3] + plane[3]
        following, side_next = np.roll(polygon, -1, axis=0), np.roll(side, -1)
        kept: list[Array] = []
        for p, q, a, b in zip(polygon, following, side, side_next, strict=True):
            if a >= 0:
                kept.append(p)
            if (a >= 0) != (b >= 0):
                kept.append(p + (q - p) * (a / (a - b)))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon


def _fixed(pixels: Array) -> NDArray[np.int32]:
    # far outside the picture OpenCV's fixed point would overflow
    return np.rint(np.clip(pixels, -8000.0, 8000.0) * (1 << _SHIFT)).astype(np.int32)


def _project(points: Array, intrinsics: CameraIntrinsics) -> Array:
    z = np.maximum(points[:, 2:], NEAR * 0.5)
    ideal = points[:, :2] / z
    radius = np.hypot(ideal[:, 0], ideal[:, 1])
    # a lens model folds back beyond this radius; a clipped corner may lie just outside
    squeeze = np.minimum(1.0, 0.999 * intrinsics.radius_limit / np.maximum(radius, 1e-12))
    return intrinsics.distort(ideal * squeeze[:, None])


def geom_placement(model: mujoco.MjModel, qpos: ArrayLike, pose_world_camera: Pose) -> tuple[Array, Array]:
    """Rotations (ngeom, 3, 3) and positions (ngeom, 3) of the model's geoms in the camera frame."""
    data = scratch_data(model)
    data.qpos[:] = np.asarray(qpos, dtype=float)
    mujoco.mj_kinematics(model, data)
    camera = pose_world_camera.inverse()
    turn = camera.rotation
    rotation = turn @ np.asarray(data.geom_xmat).reshape(-1, 3, 3)
    return rotation, np.asarray(data.geom_xpos) @ turn.T + camera.position


def _turned(rotation: Array, vectors: Array, geom: Index) -> Array:
    """Vectors (n, 3), each turned by the rotation of its geom; ``geom`` (n,) ascends."""
    starts = np.searchsorted(geom, np.arange(len(rotation) + 1))
    result = np.empty_like(vectors)
    for turn, a, b in zip(rotation, starts[:-1], starts[1:], strict=True):
        np.matmul(vectors[a:b], turn.T, out=result[a:b])
    return result


def _outline(mesh: ModelMesh, front: Mask) -> tuple[Index, Index]:
    """Edges worth a line (silhouettes of each geom, creases) and the front face (e, 2) each belongs to."""
    facing = front[mesh.edge_faces]
    chosen = np.flatnonzero((facing[:, 0] != facing[:, 1]) | (mesh.crease & facing[:, 0]))
    faces = mesh.edge_faces[chosen]
    owner = np.where(front[faces], faces, faces[:, ::-1])
    return chosen, owner


def visible_polygons(
    model: mujoco.MjModel,
    qpos: ArrayLike,
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    *,
    lines: bool = False,
    planes: bool = False,
    inset: float = BLEED,
) -> Polygons:
    """Faces of the model that look towards the camera and touch its view, sorted far to near.

    Args:
        model: Any MuJoCo model; geoms of groups 0-2 with a colour that is not fully transparent.
        qpos: (model.nq,) full configuration.
        intrinsics: Lens of the picture to draw on.
        pose_world_camera: OpenCV camera axes (x right, y down, z forward) seen from the world.
        lines: Also give silhouette and crease edges with the faces they belong to.
        planes: Also draw plane geoms (floors).
        inset: Pixels by which outlines are drawn in, to make up for the fill's reach.
    """
    rotation, position = geom_placement(model, qpos, pose_world_camera)
    segments = segments_for(model, rotation[:, :, 2], position, max(intrinsics.fx, intrinsics.fy))
    mesh = cached_mesh(model, planes=planes, segments=segments)
    rotation, position = rotation[mesh.geoms], position[mesh.geoms]
    points = _turned(rotation, mesh.vertices, mesh.vertex_geom) + position[mesh.vertex_geom]
    normals = _turned(rotation, mesh.normals, mesh.face_geom)
    centres = _turned(rotation, mesh.centres, mesh.face_geom) + position[mesh.face_geom]
    front = np.einsum("fi,fi->f", normals, centres) < 0.0

    view = _view_planes(intrinsics)
    inside = points @ view[:, :3].T + view[:, 3] >= 0.0
    corners = inside[mesh.faces]
    touching = np.logical_and.reduce(np.logical_or.reduce(corners, axis=1), axis=1)
    drawn = np.flatnonzero(front & touching)
    distance = _drawing_distance(mesh, centres, front)
    order = drawn[np.argsort(-distance[drawn], kind="stable")]

    pixels = _project(points, intrinsics)
    slant = _turned(rotation, mesh.vertex_normals, mesh.vertex_geom)[:, :2]
    fixed = _fixed(pixels - inset * slant)
    clipped = {}
    within: Mask = np.logical_and.reduce(inside, axis=1)
    for k in np.flatnonzero(~np.logical_and.reduce(within[mesh.faces[order]], axis=1)):
        cut = _clip(points[mesh.faces[order[k]]], view)
        clipped[int(k)] = _fixed(_project(cut, intrinsics)) if len(cut) >= 3 else np.zeros((0, 2), np.int32)
    shade = _AMBIENT + (1.0 - _AMBIENT) * np.maximum(normals[order] @ _LIGHT, 0.0)
    outline = _face_lines(mesh, front, order, _fixed(pixels), within) if lines else []
    return Polygons(fixed[mesh.faces[order]], clipped, shade, mesh.geoms[mesh.face_geom[order]], outline)


def _drawing_distance(mesh: ModelMesh, centres: Array, front: Mask) -> Array:
    """Distance (f,) by which faces are sorted: lids and labels come just after what they lie on."""
    distance = np.sqrt(np.einsum("ij,ij->i", centres, centres))
    for above, below in mesh.overlays:
        base = below[front[below]]
        if len(base):
            limit = distance[base].min() - 1e-5
            distance[above] = np.minimum(distance[above], limit)
    return distance


def _face_lines(
    mesh: ModelMesh, front: Mask, order: Index, fixed: NDArray[np.int32], inside: Mask
) -> list[NDArray[np.int32]]:
    """Outline segments by polygon of ``order``; an edge goes with the nearer (later drawn) of its faces."""
    rank = np.full(len(mesh.faces), -1)
    rank[order] = np.arange(len(order))
    chosen, owner = _outline(mesh, front)
    keep = inside[mesh.edges[chosen]].all(axis=1)
    chosen, owner = chosen[keep], owner[keep]
    late = np.where(front[owner], rank[owner], -1).max(axis=1)
    result: list[NDArray[np.int32]] = [np.zeros((0, 2, 2), np.int32)] * len(order)
    if len(chosen):
        by_face = np.argsort(late, kind="stable")
        keys, starts = np.unique(late[by_face], return_index=True)
        groups = np.split(fixed[mesh.edges[chosen[by_face]]], starts[1:])
        for key, group in zip(keys, groups, strict=True):
            if key >= 0:
                result[int(key)] = group
    return result


def bounding_box(polygons: Polygons, width: int, height: int, margin: int = 3) -> tuple[int, int, int, int]:
    """Columns and rows (x0, y0, x1, y1), half open, that the polygons touch; empty box when none."""
    whole = np.ones(len(polygons.quads), dtype=bool)
    whole[list(polygons.clipped)] = False
    every = np.concatenate([polygons.quads[whole].reshape(-1, 2), *polygons.clipped.values()])
    if not len(every):
        return 0, 0, 0, 0
    low = (every.min(axis=0) >> _SHIFT) - margin
    high = (every.max(axis=0) >> _SHIFT) + margin + 1
    x0, y0 = np.clip(low, 0, (width, height))
    x1, y1 = np.clip(high, 0, (width, height))
    return (int(x0), int(y0), int(x1), int(y1)) if x1 > x0 and y1 > y0 else (0, 0, 0, 0)


def face_colours(model: mujoco.MjModel, polygons: Polygons, tint: tuple[float, float, float] | None) -> Array:
    """BGR (n, 3) in 0..255 of each polygon: the geom's own colour, or ``tint``, times the light on it."""
    if tint is None:
        base = geom_rgba(model)[polygons.geom][:, 2::-1] * 255.0
    else:
        base = np.broadcast_to(np.array(tint, dtype=float), (len(polygons.geom), 3))
    return np.clip(base * polygons.shade[:, None], 0.0, 255.0)


def paint(
    canvas: Image,
    polygons: Polygons,
    colours: Array,
    corner: tuple[int, int] = (0, 0),
    *,
    line_colour: tuple[int, ...] | None = None,
    line_width: int = 1,
) -> None:
    """Fills the polygons, far to near, into ``canvas``, whose pixel (0, 0) is ``corner`` of the picture.

    Lines are drawn right after the face they belong to, so that nearer faces hide them.

    Args:
        canvas: (h, w), (h, w, 3) or (h, w, 4) uint8, changed in place, anti-aliased.
        polygons: What to fill.
        colours: (n, channels) of each polygon.
        corner: (x, y) pixel of the picture at the canvas' (0, 0).
        line_colour: One value a channel; ``None`` draws no lines.
        line_width: Pixels.
    """
    offset = np.array(corner, dtype=np.int32) << _SHIFT
    fill, smooth, shift = cv2.fillConvexPoly, cv2.LINE_AA, _SHIFT
    rows = np.rint(colours).astype(int).tolist()
    for k, (points, colour) in enumerate(zip(polygons.moved(corner), rows, strict=True)):
        if len(points):
            fill(canvas, points, colour, smooth, shift)
        if line_colour is not None and len(polygons.lines[k]):
            segments = list(polygons.lines[k] - offset)
            cv2.polylines(canvas, segments, False, line_colour, line_width, smooth, shift)


def paint_mask(shape: tuple[int, int], polygons: Polygons, corner: tuple[int, int] = (0, 0)) -> Image:
    """Silhouette (h, w), 255 inside, anti-aliased."""
    mask = np.zeros(shape, dtype=np.uint8)
    paint(mask, polygons, np.full((len(polygons.quads), 1), 255.0), corner)
    return mask
