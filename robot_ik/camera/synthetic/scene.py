"""The still surroundings of a synthetic photograph: a wooden table, a floor, a calm backdrop, light.

Everything here is computed once per camera and kept; the robot, its shadow and the markers are added to
each picture by ``photograph.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.raycast import Caster, RayField, ray_field, world_directions
from robot_ik.camera.image import Box, Float32
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array

Point = tuple[float, float, float]


def _point(values: Array) -> Point:
    x, y, z = values.tolist()
    return x, y, z


@dataclass(frozen=True)
class Lights:
    """One large lamp, a bright ceiling, a window behind the camera, and light from everywhere.

    Attributes:
        lamp: Position of the lamp, metres, world.
        lamp_radius: Its radius: how soft its shadows are.
        ceiling: Centre of the bright ceiling; ``ceiling_radius`` its radius.
        window: Where the window is; it throws no shadows.
        strength: Of lamp, ceiling, window, ambient from above, ambient from below; they add up to about 1
            on a level sheet of paper.
    """

    lamp: Point
    lamp_radius: float
    ceiling: Point
    ceiling_radius: float
    window: Point
    strength: tuple[float, float, float, float, float] = (0.25, 0.17, 0.33, 0.35, 0.28)

    @classmethod
    def beside(cls, pose_world_camera: Pose, distance: float) -> Lights:
        """A lamp above and to the left of the camera, a ceiling above what it looks at."""
        rotation, eye = pose_world_camera.rotation, pose_world_camera.position
        subject = eye + rotation[:, 2] * distance
        lamp = eye - 0.55 * distance * rotation[:, 0] + np.array([0.0, 0.0, 0.9 * distance])
        overhead = subject + np.array([0.0, 0.0, 1.6 * distance])
        return cls(_point(lamp), 0.10 * distance, _point(overhead), 0.8 * distance, _point(eye))

    def terms(self, points: Array, normals: Array) -> tuple[Array, Array, Array]:
        """Light (n,) that ``points`` (n, 3) with ``normals`` (n, 3) get: lamp, ceiling, ambient."""
        lamp, ceiling, window, above, below = self.strength

        def facing(source: Point) -> Array:
            to_light = source - points
            length = np.maximum(np.linalg.norm(to_light, axis=1), 1e-9)
            return np.asarray(np.maximum(np.einsum("ij,ij->i", to_light, normals) / length, 0.0))

        up = 0.5 + 0.5 * normals[:, 2]
        ambient = below + (above - below) * up + window * facing(self.window)
        return lamp * facing(self.lamp), ceiling * facing(self.ceiling), ambient

    def spots(self, source: str, count: int) -> Array:
        """``count`` points (count, 3) on the level disc of the ``"lamp"`` or the ``"ceiling"``."""
        centre, radius = (
            (self.lamp, self.lamp_radius) if source == "lamp" else (self.ceiling, self.ceiling_radius)
        )
        k = np.arange(count)
        # a sunflower fills a disc evenly with any number of points
        r, angle = radius * np.sqrt((k + 0.5) / count), k * np.pi * (3.0 - np.sqrt(5.0))
        return np.asarray(centre + np.stack([r * np.cos(angle), r * np.sin(angle), 0 * r], axis=1))


def lattice(field: RayField, box: Box, stride: int) -> tuple[Array, Array, Array]:
    """Normalized coordinates (rows, columns, 2) of blocks of ``stride`` pixels that fill ``box``.

    And the columns and rows of their centres in the picture.
    """
    x, y = (
        np.asarray(low + (np.arange(-(-(high - low) // stride)) + 0.5) * stride - 0.5, dtype=float)
        for low, high in ((box[0], box[2]), (box[1], box[3]))
    )
    if stride == 1:
        return field.box(*box), x, y
    centres = np.stack(np.meshgrid(x, y), axis=-1)
    return field.points(centres.reshape(-1, 2)).reshape(centres.shape), x, y


def enlarged(picture: ArrayLike, stride: int, size: tuple[int, int]) -> Float32:
    """Blocks of ``stride`` pixels blown up smoothly and cropped to ``size`` (rows, columns)."""
    small = np.ascontiguousarray(picture, dtype=np.float32)
    if stride == 1:
        return small
    large = cv2.resize(
        small, (small.shape[1] * stride, small.shape[0] * stride), interpolation=cv2.INTER_LINEAR
    )
    return np.ascontiguousarray(large[: size[0], : size[1]])


# ------------------------------------------------------------------------------------------
# Procedural surfaces: smooth noise, and a table top of wooden planks.


# BGR reflectance of wood between its rings and on them.
_WOOD_LIGHT, _WOOD_DARK = np.array([0.46, 0.62, 0.77]), np.array([0.29, 0.43, 0.58])
# Planks are so wide, and the groove between them so narrow, metres.
_PLANK, _GROOVE = 0.115, 0.0011


def noise(x: Array, y: Array, seed: int) -> Array:
    """Smooth noise in -1..1 with unit cells at (x, y): value noise on a hashed lattice."""
    table = np.random.default_rng(seed).uniform(-1.0, 1.0, (64, 64))
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    a, b = table[j & 63, i & 63], table[j & 63, (i + 1) & 63]
    c, d = table[(j + 1) & 63, i & 63], table[(j + 1) & 63, (i + 1) & 63]
    return np.asarray((a + (b - a) * u) * (1 - v) + (c + (d - c) * u) * v)


def wood(x: Array, y: Array) -> Array:
    """BGR reflectance (n, 3) of planks along y at positions (x, y) in metres."""
    plank = np.floor(x / _PLANK)
    across, along = x / _PLANK - plank, y + 0.37 * plank
    own = noise(plank * 7.3 + 0.5, plank * 0 + 0.5, 5)
    wave = noise(along * 2.2 + 13 * plank, across * 1.3 + 3 * plank, 1)
    rings = np.sin(2 * np.pi * (5.0 * across + 1.1 * wave + 0.5 * noise(along * 6, across * 5 + plank, 2)))
    fibre = noise(along * 14 + 31 * plank, x * 900, 3) + 0.6 * noise(along * 45, x * 1900, 4)
    dark = 0.42 + 0.17 * own + 0.16 * rings + 0.10 * fibre
    gap = np.minimum(across, 1 - across) * _PLANK
    tone = _WOOD_LIGHT + (_WOOD_DARK - _WOOD_LIGHT) * np.clip(dark, 0, 1)[:, None]
    return np.asarray(tone * (1 - 0.45 * np.exp(-((gap / _GROOVE) ** 2)))[:, None])


# Colours as BGR reflectance.
_LEG = np.array([0.20, 0.19, 0.18])
_FLOOR = np.array([0.60, 0.585, 0.57])
_BACKDROP_LOW, _BACKDROP_HIGH = np.array([0.54, 0.525, 0.51]), np.array([0.70, 0.675, 0.65])
# The floor fades into the backdrop between these distances from the subject, metres.
_FADE = (1.6, 4.2)
_TABLE_THICKNESS = 0.03
# Light on level planes is computed for blocks of so many pixels: shadows of a table are soft.
_LIGHT_STRIDE = 8


@dataclass(frozen=True)
class SceneTable:
    """A rectangular table on the floor; world frame, metres.

    Attributes:
        height: Of its top above the world's origin plane.
        x, y: Where its top begins and ends.
    """

    height: float = 0.0
    x: tuple[float, float] = (-0.6, 0.6)
    y: tuple[float, float] = (-0.6, 0.6)

    @property
    def floor_height(self) -> float:
        """The floor is at 0 below a raised table, 0.7 m below one whose top is the origin plane."""
        return 0.0 if self.height > 0.2 else self.height - 0.7


def _environment(table: SceneTable | None, floor: float) -> mujoco.MjModel:
    """Floor and table as a model of their own: geom 0 floor, 1 table top, then legs."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], pos=[0, 0, floor])
    if table is not None:
        (x0, x1), (y0, y1), z = table.x, table.y, table.height
        half = [(x1 - x0) / 2, (y1 - y0) / 2, _TABLE_THICKNESS / 2]
        centre = [(x0 + x1) / 2, (y0 + y1) / 2, z - half[2]]
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre)
        leg = (z - _TABLE_THICKNESS - floor) / 2
        for sx in (-1, 1):
            for sy in (-1, 1):
                position = [centre[0] + sx * (half[0] - 0.03), centre[1] + sy * (half[1] - 0.03), floor + leg]
                spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 0.02, leg], pos=position)
    return spec.compile()


@dataclass(frozen=True)
class StillPicture:
    """The empty scene on every pixel, split by light so that shadows can be taken out later.

    Attributes:
        ambient, lamp, ceiling: (h, w, 3) what each light contributes, 1 is white.
        depth: (h, w) along the optical axis, metres; inf at the backdrop.
    """

    ambient: Float32
    lamp: Float32
    ceiling: Float32
    depth: Float32


# A picture of 1280x720 takes 37 MB and half a second.
@lru_cache(maxsize=2)
def still_picture(
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    table: SceneTable | None,
    lights: Lights,
    subject: Point,
) -> StillPicture:
    """The (cached) empty scene that a camera sees; its arrays are not to be written to.

    ``subject`` is what the camera looks at, world: floor fades into backdrop around it.
    """
    return _StillScene(intrinsics, pose_world_camera, table, lights, subject).render()


@dataclass(eq=False)
class _StillScene:
    """Table, floor and backdrop seen by one camera."""

    intrinsics: CameraIntrinsics
    _camera: Pose
    table: SceneTable | None
    _lights: Lights
    _subject: Point

    def __post_init__(self) -> None:
        self._floor = self.table.floor_height if self.table is not None else 0.0
        self._top = self.table.height if self.table is not None else -np.inf
        self._caster = Caster(_environment(self.table, self._floor))
        self._caster.place(np.zeros(0))
        self._field = ray_field(self.intrinsics)

    def _backdrop(self, rays: Array) -> Array:
        rise = rays[:, 2] / np.linalg.norm(rays, axis=1)
        blend = np.clip(0.45 + 0.8 * rise, 0, 1)[:, None]
        return np.asarray(_BACKDROP_LOW + (_BACKDROP_HIGH - _BACKDROP_LOW) * blend)

    def _floor_albedo(self, points: Array, rays: Array) -> tuple[Array, Array]:
        """Reflectance (n, 3) of the floor, and the part of it (n,) that is backdrop and shines by itself."""
        far = np.linalg.norm(points[:, :2] - self._subject[:2], axis=1)
        t = np.clip((far - _FADE[0]) / (_FADE[1] - _FADE[0]), 0, 1)
        t = t * t * (3 - 2 * t)
        x, y = points[:, 0], points[:, 1]
        speck = 1 + 0.05 * noise(x * 3, y * 3, 8) + 0.03 * noise(x * 60, y * 60, 9)
        return _FLOOR * (speck * (1 - t))[:, None] + self._backdrop(rays) * t[:, None], t

    def _light(self, points: Array, normals: Array) -> Array:
        """Ambient, lamp and ceiling light (n, 3) with the table's own shadows."""
        lamp, ceiling, ambient = self._lights.terms(points, normals)
        return np.stack(
            [ambient, lamp * self._lit(points, "lamp", 8), ceiling * self._lit(points, "ceiling", 12)], 1
        )

    def _lit(self, points: Array, source: str, count: int) -> Array:
        """Part (n,) of a light that the table lets through to ``points`` (n, 3)."""
        spots = self._lights.spots(source, count)
        shares = np.ones(len(points))
        # A light above the table reaches all that is not below its top.
        below = (
            np.flatnonzero(points[:, 2] < self._top) if spots[0, 2] > self._top else np.arange(len(points))
        )
        if len(below):
            shares[below] = np.mean([self._caster.lit(spot, points[below]) for spot in spots], axis=0)
        return shares

    def _shade(self, normalized: Array) -> Array:
        """Light shares (n, 3 lights, 3 BGR) along any rays (n, 2): exact and slow."""
        rays = world_directions(self._camera, normalized)
        hits = self._caster.cast(self._camera.position, rays)
        points = self._camera.position + rays * np.where(np.isfinite(hits.depth), hits.depth, 0.0)[:, None]
        albedo, shine = self._backdrop(rays), np.ones(len(rays))
        floor, top, rest = hits.geom == 0, hits.geom == 1, hits.geom > 1
        albedo[floor], shine[floor] = self._floor_albedo(points[floor], rays[floor])
        albedo[top] = wood(points[top, 0], points[top, 1]) * np.where(hits.normal[top, 2:] > 0.5, 1.0, 0.8)
        albedo[rest] = _LEG
        shine[top | rest] = 0.0
        light = self._light(points, hits.normal) * (1 - shine)[:, None] + shine[:, None] * (1.0, 0.0, 0.0)
        return np.asarray(light[:, :, None] * albedo[:, None, :])

    def _level(self, normalized: Array, height: float) -> tuple[Array, Array]:
        """Points (n, 3) at which rays (n, 2) meet a level plane, far away where they do not; and the rays."""
        rays = world_directions(self._camera, normalized)
        drop = height - self._camera.position[2]
        with np.errstate(divide="ignore"):
            depth = drop / rays[:, 2]
        depth = np.where((depth > 0) & (depth < 50.0), depth, 50.0)
        points = self._camera.position + rays * depth[:, None]
        points[:, 2] = height
        return points, rays

    def _coarse(self, stride: int) -> tuple[Array, tuple[int, int]]:
        """Rays (n, 2) at the centres of blocks of ``stride`` pixels, and the (rows, columns) of blocks."""
        normalized, _, _ = lattice(self._field, (0, 0, *self._field.intrinsics.size), stride)
        return normalized.reshape(-1, 2), (normalized.shape[0], normalized.shape[1])

    def _enlarge(self, coarse: Array, shape: tuple[int, int], stride: int) -> Float32:
        return enlarged(coarse.reshape(*shape, -1), stride, self._field.intrinsics.size[::-1])

    def _smooth_light(self, height: float) -> Float32:
        """Light (h, w, 3) on a level plane: smooth, so computed for blocks of pixels."""
        normalized, shape = self._coarse(_LIGHT_STRIDE)
        points, _ = self._level(normalized, height)
        return self._enlarge(
            self._light(points, np.tile([0.0, 0.0, 1.0], (len(points), 1))), shape, _LIGHT_STRIDE
        )

    def render(self) -> StillPicture:
        w, h = self._field.intrinsics.size
        normalized, _ = self._coarse(1)
        rays = world_directions(self._camera, normalized)
        hits = self._caster.cast(self._camera.position, rays, normals=False)
        coarse, shape = self._coarse(2)
        points, rays = self._level(coarse, self._floor)
        albedo, shine = self._floor_albedo(points, rays)
        flat = self._enlarge(np.concatenate([albedo, shine[:, None]], axis=1), shape, 2)
        light = self._smooth_light(self._floor) * (1 - flat[..., 3:])
        light[..., 0] += flat[..., 3]
        parts = [flat[..., :3] * light[..., k : k + 1] for k in range(3)]

        geom = hits.geom.reshape(h, w)
        rows, columns = np.nonzero(geom == 1)
        if len(rows):
            points, _ = self._level(normalized.reshape(h, w, 2)[rows, columns], self._top)
            tone = wood(points[:, 0], points[:, 1]).astype(np.float32)
            light = self._smooth_light(self._top)[rows, columns]
            for k in range(3):
                parts[k][rows, columns] = tone * light[:, k : k + 1]
        self._exact_where(parts, geom, hits.depth.reshape(h, w))
        return StillPicture(parts[0], parts[1], parts[2], hits.depth.reshape(h, w).astype(np.float32))

    def _exact_where(self, parts: list[Float32], geom: NDArray[np.int32], depth: Array) -> None:
        """Legs and table sides pixel by pixel, and edges with four rays a pixel."""
        h, w = depth.shape
        inverse = 1.0 / np.where(np.isfinite(depth), depth, 1e3)
        # 1/depth is linear in the picture on a plane: its second difference shows edges only
        crease = np.zeros(depth.shape, dtype=bool)
        crease[1:-1] |= np.abs(np.diff(inverse, 2, axis=0)) > 1e-3
        crease[:, 1:-1] |= np.abs(np.diff(inverse, 2, axis=1)) > 1e-3
        crease |= cv2.morphologyEx(geom.astype(np.int16), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
        sides = geom > 1
        rows, columns = np.nonzero(geom == 1)
        rays = world_directions(self._camera, self._field.box(0, 0, w, h)[rows, columns])
        heights = self._camera.position[2] + depth[rows, columns] * rays[:, 2]
        sides[rows, columns] = np.abs(heights - self._top) > 1e-4
        one = np.array([[0.0, 0.0]])
        four = np.array([[-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])
        for chosen, shift in ((sides & ~crease, one), (crease & (geom >= 0), four)):
            rows, columns = np.nonzero(chosen)
            if len(rows):
                pixels = (np.stack([columns, rows], axis=1)[:, None, :] + shift).reshape(-1, 2)
                shares = self._shade(self._field.points(pixels)).reshape(-1, len(shift), 3, 3).mean(axis=1)
                for k in range(3):
                    parts[k][rows, columns] = shares[:, k]
