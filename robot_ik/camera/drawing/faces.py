"""Faces of a MuJoCo model in the picture of a calibrated camera: placed, lit, projected, clipped.

Vertices go through the lens model itself, so a drawing lies on the raw, distorted picture.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.meshes import ModelMesh, cached_mesh, scratch_data, segments_for
from robot_ik.camera.drawing.zbuffer import turn
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, distort_point, lens_vector
from robot_ik.geometry import Pose
from robot_ik.kernels.jit import kernel
from robot_ik.ports import Array, Mask

Index = NDArray[np.int64]

EMPTY: Box = (0, 0, 0, 0)
# Surfaces nearer to the lens than this are not drawn, metres.
NEAR = 0.02
# Faces beyond this part of the radius at which a lens model folds back are clipped.
_SAFE_RADIUS = 0.98
# Faces are clipped at this distance outside the view, as a part of the view. The lens model is
# still valid there.
_CLIP_MARGIN = 0.06
# Direction to the light in the camera frame (x right, y down, z forward): above, left, behind the
# lens. Every drawing is lit from the side of the viewer.
LIGHT = np.array([-0.45, -0.75, -0.55]) / np.linalg.norm([-0.45, -0.75, -0.55])
# Direction half way between the light and the viewer, for highlights (Blinn 1977).
_HALFWAY = (LIGHT - [0.0, 0.0, 1.0]) / np.linalg.norm(LIGHT - [0.0, 0.0, 1.0])
# Part of the light that reaches a surface turned away from the light.
_AMBIENT = 0.36
# The highlight is raised to the power 2 ** this: 32, the gloss of painted metal.
_GLOSS_SQUARINGS = 5


@dataclass(frozen=True)
class Faces:
    """Faces of a model in a picture.

    Attributes:
        points: (v, 3) vertices in the camera frame, metres.
        pixels: (v, 2) the same through the lens, px.
        inverse: (v,) one over their depth, 1 / m.
        faces: (f, 4) vertices of quadrilaterals. A triangle repeats its last vertex.
        chosen: (k,) the faces to fill.
        geom: (f,) geom id of each face in the model.
        lit: (f, 4, 2) diffuse light and highlight at the corners of faces that show their outside.
        within: (v,) whether the lens can see the vertex. The pixels of other vertices are invalid.
        mesh: The faces before clipping, in geom frames.
    """

    points: Array
    pixels: Array
    inverse: Array
    faces: Index
    chosen: Index
    geom: NDArray[np.int32]
    lit: Float32
    within: Mask
    mesh: ModelMesh


def geom_placement(
    model: mujoco.MjModel, qpos: ArrayLike, pose_world_camera: Pose
) -> tuple[Array, Array]:
    """Return rotations (ngeom, 3, 3) and positions (ngeom, 3) of the geoms in the camera frame."""
    data = scratch_data(model)
    data.qpos[:] = np.asarray(qpos, dtype=float)
    mujoco.mj_kinematics(model, data)
    camera = pose_world_camera.inverse()
    rotation = camera.rotation @ np.asarray(data.geom_xmat).reshape(-1, 3, 3)
    position = np.asarray(data.geom_xpos) @ camera.rotation.T + camera.position
    return rotation, position


def surface_points(model: mujoco.MjModel, qpos: ArrayLike) -> Array:
    """Return the vertices (v, 3) of the visible geoms in the model's world, metres."""
    rotation, position = geom_placement(model, qpos, Pose())
    mesh = cached_mesh(model)
    points = np.empty_like(mesh.vertices)
    transform_vertices(
        mesh.vertices, mesh.vertex_geom, rotation[mesh.geoms], position[mesh.geoms], points
    )
    return points


def project(points: Array, intrinsics: CameraIntrinsics) -> tuple[Array, Array, Mask]:
    """Project points (n, 3) of the camera frame.

    Returns:
        Pixels (n, 2), inverse depths (n,) in 1 / m, and whether the lens can see each point (n,).
    """
    pixels = np.empty((len(points), 2))
    inverse = np.empty(len(points))
    within = np.empty(len(points), dtype=bool)
    limit = _SAFE_RADIUS * intrinsics.radius_limit
    through_lens(points, lens_vector(intrinsics), NEAR, limit, pixels, inverse, within)
    return pixels, inverse, within


def light_on(normals: ArrayLike) -> Array:
    """Return the diffuse light (...), 0 to 1, on surfaces with unit normals (..., 3).

    The normals are in the camera frame.
    """
    wrapped = 0.5 + 0.5 * np.asarray(normals, dtype=float) @ LIGHT
    return np.asarray(_AMBIENT + (1.0 - _AMBIENT) * wrapped**2)


def faces_in_picture(
    model: mujoco.MjModel,
    qpos: ArrayLike,
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    *,
    planes: bool = False,
) -> Faces:
    """Return the faces of the model in the picture of a camera.

    Round geoms are cut so finely that their corners are not visible.

    Args:
        model: Any MuJoCo model. Geoms of the groups 0 to 2 are drawn unless fully transparent.
        qpos: (model.nq,) full configuration.
        intrinsics: Lens of the picture to draw on.
        pose_world_camera: OpenCV camera axes (x right, y down, z forward) seen from the world.
        planes: Also draw plane geoms (floors).
    """
    rotation, position = geom_placement(model, qpos, pose_world_camera)
    focal = max(intrinsics.fx, intrinsics.fy)
    segments = segments_for(model, rotation[:, :, 2], position, focal)
    mesh = cached_mesh(model, planes=planes, segments=segments)
    rotation = rotation[mesh.geoms]
    position = position[mesh.geoms]
    points = np.empty_like(mesh.vertices)
    transform_vertices(mesh.vertices, mesh.vertex_geom, rotation, position, points)
    pixels, inverse, within = project(points, intrinsics)
    inside = bool(within.all())
    lit = np.empty((len(mesh.faces), 4, 2), dtype=np.float32)
    light_corners(
        mesh.corner_normals,
        mesh.faces,
        mesh.face_geom,
        pixels,
        not inside,
        LIGHT @ rotation,
        _HALFWAY @ rotation,
        lit,
    )
    chosen = np.arange(len(mesh.faces))
    faces = Faces(points, pixels, inverse, mesh.faces, chosen, mesh.face_geom_id, lit, within, mesh)
    return faces if inside else _clipped(faces, intrinsics)


def bounding_box(faces: Faces, width: int, height: int, margin: int = 3) -> Box:
    """Return the columns and rows (x0, y0, x1, y1), half open, that the faces touch.

    The box is ``EMPTY`` if the faces are outside the picture.
    """
    pixels = faces.pixels if faces.within.all() else faces.pixels[faces.within]
    if not len(pixels) or not len(faces.chosen):
        return EMPTY
    lower = np.floor(pixels.min(axis=0)).clip(-margin, None).astype(int) - margin
    upper = np.ceil(pixels.max(axis=0)).clip(None, max(width, height)).astype(int) + margin + 1
    x0 = max(int(lower[0]), 0)
    y0 = max(int(lower[1]), 0)
    x1 = min(int(upper[0]), width)
    y1 = min(int(upper[1]), height)
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else EMPTY


def _clipped(faces: Faces, intrinsics: CameraIntrinsics) -> Faces:
    """Return the faces, with those clipped that leave the part of space that the lens can see."""
    planes = view_planes(intrinsics)
    inside = faces.points @ planes[:, :3].T + planes[:, 3] >= 0.0
    some_inside = np.logical_or.reduce(inside[faces.faces], axis=1)
    touching = np.logical_and.reduce(some_inside, axis=1)
    visible = faces.within[faces.faces].all(axis=1)
    added = [np.zeros((0, 3))]
    fans = [np.zeros((0, 4), dtype=np.int64)]
    origins = [np.zeros(0, dtype=np.int64)]
    count = len(faces.points)
    for f in np.flatnonzero(touching & ~visible):
        polygon = clip(faces.points[faces.faces[f]], planes)
        if len(polygon) >= 3:
            k = np.arange(1, len(polygon) - 1)
            fans.append(count + np.stack([0 * k, k, k + 1, k + 1], axis=1))
            added.append(polygon)
            origins.append(np.full(len(k), f))
            count += len(polygon)
    extra = np.concatenate(added)
    pixels, inverse, _ = project(extra, intrinsics)
    origin = np.concatenate(origins)
    fan = np.concatenate(fans)
    flat = np.repeat(faces.lit[origin].mean(axis=1, keepdims=True), 4, axis=1)
    unclipped = np.flatnonzero(touching & visible)
    return Faces(
        np.concatenate([faces.points, extra]),
        np.concatenate([faces.pixels, pixels]),
        np.concatenate([faces.inverse, inverse]),
        np.concatenate([faces.faces, fan]),
        np.concatenate([unclipped, len(faces.faces) + np.arange(len(fan))]),
        np.concatenate([faces.geom, faces.geom[origin]]),
        np.concatenate([faces.lit, flat]).astype(np.float32),
        np.concatenate([faces.within, np.ones(len(extra), dtype=bool)]),
        faces.mesh,
    )


@lru_cache(maxsize=16)
def view_planes(intrinsics: CameraIntrinsics) -> Array:
    """Return the planes (5, 4) around the view: near, left, right, top, bottom.

    A point p is inside where n . p + d >= 0 for each plane (n, d).
    """
    lower, upper = intrinsics.extent
    margin = _CLIP_MARGIN * (upper - lower)
    lower = lower - margin
    upper = upper + margin
    return np.array(
        [
            [0, 0, 1, -NEAR],
            [1, 0, -lower[0], 0],
            [-1, 0, upper[0], 0],
            [0, 1, -lower[1], 0],
            [0, -1, upper[1], 0],
        ],
        dtype=float,
    )


def clip(polygon: Array, planes: Array) -> Array:
    """Return the part (k, 3) of a convex polygon inside all planes (Sutherland, Hodgman 1974)."""
    for plane in planes:
        if len(polygon) < 3:
            break
        side = polygon @ plane[:3] + plane[3]
        kept: list[Array] = []
        for p, q, a, b in zip(
            polygon, np.roll(polygon, -1, axis=0), side, np.roll(side, -1), strict=True
        ):
            if a >= 0:
                kept.append(p)
            if (a >= 0) != (b >= 0):
                kept.append(p + (q - p) * (a / (a - b)))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon


@kernel
def transform_vertices(vertices, owner, rotation, position, placed):
    """Write the vertices (v, 3), turned and moved with their geom ``owner`` (v,), to ``placed``."""
    for k in range(len(vertices)):
        g = owner[k]
        x = vertices[k, 0]
        y = vertices[k, 1]
        z = vertices[k, 2]
        for i in range(3):
            turned = rotation[g, i, 0] * x + rotation[g, i, 1] * y + rotation[g, i, 2] * z
            placed[k, i] = turned + position[g, i]


@kernel
def through_lens(points, lens, near, limit, pixels, inverse, within):
    """Write ``pixels`` (v, 2), ``inverse`` (v,) depths and ``within`` (v,) of points (v, 3).

    Args:
        points: In the camera frame, metres.
        lens: The camera as a ``lens_vector``.
        near: Points nearer than this are not within the view, metres.
        limit: Points farther off the axis than this part of their depth are not within the view
            either. They are moved to this distance.
        pixels: Pixels of the points.
        inverse: One over their depth, 1 / m.
        within: Whether the lens can see them.
    """
    for k in range(len(points)):
        z = points[k, 2]
        w = 1.0 / max(z, 0.5 * near)
        x = points[k, 0] * w
        y = points[k, 1] * w
        r2 = x * x + y * y
        within[k] = z > near and r2 < limit * limit
        if r2 > limit * limit:
            shrink = limit / math.sqrt(r2)
            x *= shrink
            y *= shrink
        u, v, _, _, _ = distort_point(lens, x, y)
        pixels[k, 0] = lens[FX] * u + lens[CX]
        pixels[k, 1] = lens[FY] * v + lens[CY]
        inverse[k] = w


@kernel
def light_corners(normals, faces, owner, pixels, both_sides, light, half, lit):
    """Write diffuse light and highlight at the corners of faces to ``lit`` (f, 4, 2).

    Args:
        normals: (f, 4, 3) at the corners, in geom frames.
        faces: (f, 4) rows of ``pixels`` (v, 2).
        owner: (f,) geom of each face.
        pixels: (v, 2) vertices in the picture.
        both_sides: Whether to light also faces that show their inside.
        light: (g, 3) unit direction to the light in the frame of each geom.
        half: (g, 3) the direction half way between light and viewer.
        lit: Written. Faces that show their inside keep their old values.
    """
    for f in range(len(normals)):
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        d = faces[f, 3]
        if not both_sides and turn(pixels, a, b, c) >= 0.0 and turn(pixels, a, c, d) >= 0.0:
            continue
        g = owner[f]
        for k in range(4):
            n = normals[f, k]
            diffuse = n[0] * light[g, 0] + n[1] * light[g, 1] + n[2] * light[g, 2]
            shine = n[0] * half[g, 0] + n[1] * half[g, 1] + n[2] * half[g, 2]
            # The diffuse light wraps around the surface, so that the dark side has shading.
            wrapped = 0.5 + 0.5 * diffuse
            lit[f, k, 0] = _AMBIENT + (1.0 - _AMBIENT) * wrapped * wrapped
            power = max(shine, 0.0)
            for _ in range(_GLOSS_SQUARINGS):
                power *= power
            lit[f, k, 1] = power
