"""The standard marker set: synthetic pictures of one marker with exact truth, to measure accuracy with.

A flat printed marker before a blotchy wall, 640x480 px, f = 800 px, lens distortion, blur, noise and a light
gradient.  Each pixel is the mean of many rays traced back through the lens to the paper (inverse mapping),
so the truth does not depend on any drawing routine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.board import BoardView
from robot_ik.camera.boards.patterns import Pattern
from robot_ik.camera.calibration.handeye import HandEyeSample, Mount, Mounting
from robot_ik.camera.drawing.rasteriser import paint_boxes
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.observations import marker_points
from robot_ik.camera.synthetic.sensor import LINEAR, SensorModel
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.kernels.jit import kernel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

STANDARD_CAMERA = CameraIntrinsics(
    640, 480, 800.0, 800.0, 322.3, 236.8, (-0.18, 0.05, 0.0005, -0.0003, 0.0), name="standard set"
)
STANDARD_SIZE = 0.05
STANDARD_DISTANCES = (0.3, 0.6, 1.0)

# White paper reaches this far beyond the black square, in marker sizes.
_PAPER_MARGIN = 0.25
# Rays per pixel, on a Fibonacci lattice: 233 different columns and rows, so that an edge along the pixel grid
# is told to 1/233 px (a square grid of 15 x 15 would tell it to 1/15).  With 55, all pixels of such an edge
# can be off by the same 1/100 px: a tenth of a degree in the tilt of a board that faces the camera.
_RAYS = 233
_LATTICE = np.stack([np.arange(_RAYS), np.arange(_RAYS) * 144 % _RAYS], axis=1) / _RAYS + 0.5 / _RAYS - 0.5


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A picture and its truth.

    Attributes:
        image: (height, width) uint8.
        corners: (4, 2) true corners in distorted pixels, in the order of the detector.
        pose: True ``pose_camera_marker``.
        tilt: Angle in rad between the marker's z axis and the way to the camera.
    """

    image: Image
    corners: Array
    pose: Pose
    tilt: float


@lru_cache(maxsize=2)
def undistorted_grid(camera: CameraIntrinsics) -> tuple[Array, Array]:
    """Undistorted coordinates (h, w, 2) of all pixel centres and their derivative (h, w, 2, 2) by pixels."""
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    normalized = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
    slope = np.asarray(np.linalg.inv(camera.pixel_jacobian(normalized)), dtype=float)
    return normalized.reshape(*x.shape, 2), slope.reshape(*x.shape, 2, 2)


def render_marker(
    camera: CameraIntrinsics,
    pose: Pose,
    rng: np.random.Generator,
    *,
    size: float = STANDARD_SIZE,
    dictionary: str = "DICT_4X4_50",
    marker_id: int = 0,
    look: SensorModel | None = None,
) -> Image:
    """One picture (height, width) uint8 of a printed marker at ``pose`` (``pose_camera_marker``)."""
    return render_markers(camera, {marker_id: (size, pose)}, rng, dictionary=dictionary, look=look)


def render_markers(
    camera: CameraIntrinsics,
    markers: Mapping[int, tuple[float, Pose]],
    rng: np.random.Generator,
    *,
    dictionary: str = "DICT_4X4_50",
    look: SensorModel | None = None,
    margin: float = _PAPER_MARGIN,
    cover: Array | None = None,
) -> Image:
    """One picture (height, width) uint8 of printed markers: a board, or the faces of a cube that show.

    Args:
        camera: The optics.
        markers: Id -> (side in metres, ``pose_camera_marker``); they must not overlap.
        rng: Of wall, light and noise.
        dictionary: Of all markers.
        look: Blur, noise, light.
        margin: White paper round each marker, in its size; at most the gap to the next marker's ink.
        cover: (k, 2) pixels: the outline of something grey that hides what is behind it.
    """
    look = look or LINEAR
    light = marker_light(camera, markers, rng, dictionary=dictionary, look=look, margin=margin, cover=cover)
    return photograph(light, markers_centre(camera, markers), rng, look)


def marker_light(
    camera: CameraIntrinsics,
    markers: Mapping[int, tuple[float, Pose]],
    rng: np.random.Generator,
    *,
    dictionary: str = "DICT_4X4_50",
    look: SensorModel = LINEAR,
    margin: float = _PAPER_MARGIN,
    cover: Array | None = None,
) -> Array:
    """Light (h, w) before the lens, 0 to 255; arguments as in ``render_markers``."""
    canvas = _wall(camera, rng, look)
    prints = {i: marker_bits(dictionary, i) for i in markers}
    # All of the paper before any ink: one marker's paper must not bleach the edge of the next.
    layers = [(prints, margin)]
    if len(markers) > 1:
        layers = [({i: np.full((1, 1), 255, np.uint8) for i in markers}, margin), (prints, 0.0)]
    for bits, white in layers:
        for marker_id, (size, pose) in markers.items():
            box = _paper_box(camera, pose, size)
            if box[2] > box[0] and box[3] > box[1]:
                _paint_paper(
                    canvas, box, camera, pose, _Paper(size, bits[marker_id], white, look.bleed), look
                )
    if cover is not None:
        cv2.fillPoly(canvas, [np.rint(cover).astype(np.int32)], 0.5 * (look.black + look.white))
    return canvas


def markers_centre(camera: CameraIntrinsics, markers: Mapping[int, tuple[float, Pose]]) -> Array:
    """Pixel (2,) in the middle of markers; of the picture where there are none."""
    if not markers:
        return np.array([0.5 * camera.width, 0.5 * camera.height])
    return np.asarray(np.mean([camera.project(pose.position) for _, pose in markers.values()], axis=0))


def photograph(canvas: Array, centre: Array, rng: np.random.Generator, look: SensorModel) -> Image:
    """The light of a scene, unevenly lit and developed; a shadow's edge goes by ``centre``."""
    height, width = canvas.shape
    way = rng.uniform(0, 2 * np.pi)
    across = np.array([np.cos(way), np.sin(way)])
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height))
    along = (x * across[0] + y * across[1]) / np.abs(across).sum() + 0.5
    light = look.scattered(canvas) * (1.0 - look.gradient * along)
    if look.shadow > 0.0:
        away = (np.arange(width) - centre[0]) * across[0] + ((np.arange(height) - centre[1]) * across[1])[
            :, None
        ]
        light = light * (1.0 - 0.5 * look.shadow * (1.0 + np.tanh(0.5 * away / look.shadow_edge)))
    return look.developed(light, rng.normal(0.0, 1.0, light.shape))


@dataclass(frozen=True, eq=False)
class _Paper:
    size: float
    bits: Image
    margin: float
    bleed: float


def _wall(camera: CameraIntrinsics, rng: np.random.Generator, look: SensorModel) -> Array:
    """Background of soft blotches, so that the paper has an edge of its own and the threshold some work."""
    coarse = rng.uniform(0.25, 0.75, (camera.height // 24 + 2, camera.width // 24 + 2))
    blotches = cv2.resize(coarse, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(look.black + (look.white - look.black) * blotches, dtype=float)


def _paper_box(camera: CameraIntrinsics, pose: Pose, size: float) -> tuple[int, int, int, int]:
    outline = camera.project(pose.apply(marker_points(size * (1 + 2 * _PAPER_MARGIN) * 1.02)))
    low = np.floor(outline.min(axis=0)).astype(int) - 2
    high = np.ceil(outline.max(axis=0)).astype(int) + 3
    return max(low[0], 0), max(low[1], 0), min(high[0], camera.width), min(high[1], camera.height)


def _paint_paper(
    canvas: Array,
    box: tuple[int, int, int, int],
    camera: CameraIntrinsics,
    pose: Pose,
    paper: _Paper,
    look: SensorModel,
) -> None:
    x0, y0, x1, y1 = box
    centres, slopes = (grid[y0:y1, x0:x1] for grid in undistorted_grid(camera))
    axes = paper.size * pose.rotation
    plane = np.column_stack([axes[:, 0], axes[:, 1], pose.position])
    to_paper = np.linalg.inv(plane)
    # A ring of paper round the cells, so that every place on the paper is in the table.
    table = np.pad(np.where(paper.bits > 0, look.white, look.black), 1, constant_values=look.white)
    edge, bleed = 0.5 + paper.margin, paper.bleed / paper.size
    x, y = centres[..., 0], centres[..., 1]
    rays = np.stack([a * x + b * y + c for a, b, c in to_paper], axis=-1)
    wall = canvas[y0:y1, x0:x1].copy()
    one_ray = np.empty(wall.shape)
    still = np.zeros((wall.size, 3, 2))
    paper_light(
        rays.reshape(-1, 3),
        still,
        np.full(wall.size, -1.0),
        table,
        edge,
        bleed,
        _LATTICE[:1],
        one_ray.ravel(),
    )
    # Many rays only where two of them can differ; everywhere else the first one has said it all.
    around = np.ones((5, 5), np.uint8)
    mixed = cv2.dilate(one_ray, around) - cv2.erode(one_ray, around) > 0
    one_ray = np.where(one_ray < 0, wall, one_ray)
    total = np.empty(int(mixed.sum()))
    # First order inside one pixel is exact to about 1e-4 px for any sensible lens.
    paper_light(
        rays[mixed], to_paper[:, :2] @ slopes[mixed], wall[mixed], table, edge, bleed, _LATTICE, total
    )
    one_ray[mixed] = total
    canvas[y0:y1, x0:x1] = one_ray


@kernel
def paper_light(
    rays: Any, by_pixel: Any, wall: Any, table: Any, edge: float, bleed: float, lattice: Any, light: Any
) -> None:
    """Mean light of n pixels over their rays, in place.

    Ink bleeds: what lies within ``bleed`` of a black cell, along either side, is as dark.

    Args:
        rays: (n, 3) of the pixels' centres, homogeneous coordinates in the marker's plane in marker sizes.
        by_pixel: (n, 3, 2) their derivative by pixels.
        wall: (n,) light of what is behind the paper.
        table: (k, k) light of the cells with a ring of paper.
        edge: Half the paper's side, marker sizes.
        bleed: In marker sizes.
        lattice: (m, 2) where in a pixel its rays are, pixels from its centre.
        light: (n,) out.
    """
    width = len(table)
    cells = width - 2
    for n in range(len(rays)):
        total = 0.0
        for m in range(len(lattice)):
            across, down = lattice[m, 0], lattice[m, 1]
            scale = 1.0 / (rays[n, 2] + across * by_pixel[n, 2, 0] + down * by_pixel[n, 2, 1])
            u = (rays[n, 0] + across * by_pixel[n, 0, 0] + down * by_pixel[n, 0, 1]) * scale
            v = (rays[n, 1] + across * by_pixel[n, 1, 0] + down * by_pixel[n, 1, 1]) * scale
            darkest = math.inf
            for corner in range(5 if bleed > 0.0 else 1):  # the ray itself, then four beside it
                du = 0.0 if corner == 0 else (bleed if corner % 2 else -bleed)
                dv = 0.0 if corner == 0 else (bleed if corner < 3 else -bleed)
                one = wall[n]
                if abs(u + du) <= edge and abs(v + dv) <= edge:
                    column = int(min(max((u + du + 0.5) * cells + 1.0, 0.0), cells + 1.0))
                    row = int(min(max((0.5 - v - dv) * cells + 1.0, 0.0), cells + 1.0))
                    one = table[row, column]
                darkest = min(darkest, one)
            total += darkest
        light[n] = total / len(lattice)


def random_pose(
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    distance: float,
    *,
    size: float = STANDARD_SIZE,
    tilt_deg: tuple[float, float] = (0.0, 60.0),
) -> tuple[Pose, float]:
    """Random ``pose_camera_marker`` at depth ``distance``, all of its paper in view; and its tilt in rad."""
    margin = 4.0
    while True:
        tilt = np.deg2rad(rng.uniform(*tilt_deg))
        place = rng.uniform((0, 0), (camera.width, camera.height))
        position = camera.unproject(place) * distance
        # Facing the camera: the marker's z axis points back along the line of sight, its y axis up.
        back = -position / np.linalg.norm(position)
        right = np.cross((0.0, -1.0, 0.0), back)
        right /= np.linalg.norm(right)
        facing = Pose.from_rotation(np.column_stack([right, np.cross(back, right), back]))
        azimuth, roll = rng.uniform(0, 2 * np.pi, 2)
        lean = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        turn = facing.compose(lean).compose(Pose(wxyz=rotation_exp([0.0, 0.0, roll])))
        pose = Pose(position, turn.wxyz)
        outline = camera.project(pose.apply(marker_points(size * (1 + 2 * _PAPER_MARGIN))))
        if (outline > margin).all() and (outline < np.array(camera.size) - 1 - margin).all():
            return pose, float(tilt)


def standard_set(
    distance: float,
    count: int = 100,
    *,
    seed: int = 0,
    dictionary: str = "DICT_4X4_50",
    marker_id: int = 7,
    size: float = STANDARD_SIZE,
    camera: CameraIntrinsics = STANDARD_CAMERA,
    look: SensorModel | None = None,
    tilt_deg: tuple[float, float] = (0.0, 60.0),
) -> Iterator[MarkerView]:
    """The pictures of the standard set at one distance; the same seed gives the same pictures.

    Args:
        distance: Depth of the marker's centre in metres; the set has 0.3, 0.6 and 1.0.
        count: Number of pictures.
        seed: Of the random generator.
        dictionary: Of the marker.
        marker_id: Of the marker.
        size: Side of the black square, metres.
        camera: The optics.
        look: Blur, noise, light.
        tilt_deg: Range of tilts in degrees.
    """
    rng = np.random.default_rng([seed, round(distance * 1000)])
    for _ in range(count):
        pose, tilt = random_pose(camera, rng, distance, size=size, tilt_deg=tilt_deg)
        image = render_marker(
            camera, pose, rng, size=size, dictionary=dictionary, marker_id=marker_id, look=look
        )
        yield MarkerView(image, camera.project(pose.apply(marker_points(size))), pose, tilt)


# ------------------------------------------------------------------------------------------
# Synthetic pictures of calibration patterns with exact truth, to measure a calibration with.
#
# As in ``standard_set``, each pixel is the mean of many rays traced back through the lens to the paper; the
# paper is a fine drawing of the pattern's own black rectangles.


# Rays per pixel, on a lattice with as many different columns and rows.
_PATTERN_RAYS = 16
_PATTERN_LATTICE = (
    np.stack([np.arange(_PATTERN_RAYS), np.arange(_PATTERN_RAYS) * 7 % _PATTERN_RAYS], axis=1) / _PATTERN_RAYS
    + 0.5 / _PATTERN_RAYS
    - 0.5
)
# remap takes both coordinates in one array; its type says nothing of that.
_NO_MAP: Any = None
# Of the paper's drawing, pixels along its longer side: several to each pixel of the picture.
_PAPER_PIXELS = 3000
# White round the print, in squares.
_MARGIN = 0.5


@dataclass(frozen=True, eq=False)
class PatternView:
    """A picture and its truth.

    Attributes:
        image: (height, width) uint8.
        pose: True ``pose_camera_board``.
    """

    image: Image
    pose: Pose


@lru_cache(maxsize=4)
def _paper(pattern: Pattern) -> tuple[Image, Array]:
    """The print (h, w) and the (3, 3) map from board metres to its pixels."""
    margin = _MARGIN * pattern.square
    width, height = (length + 2 * margin for length in pattern.size)
    scale = _PAPER_PIXELS / max(width, height)
    corner = np.array(pattern.origin) - margin
    boxes = pattern.black().copy()
    boxes[:, :2] -= corner
    drawn = paint_boxes(boxes * scale, round(width * scale), round(height * scale))
    to_pixels = np.array(
        [[scale, 0, -corner[0] * scale - 0.5], [0, scale, -corner[1] * scale - 0.5], [0, 0, 1]]
    )
    return drawn, to_pixels


@lru_cache(maxsize=1)
def _rays(camera: CameraIntrinsics) -> tuple[NDArray[np.float32], ...]:
    """For each ray of the lattice the undistorted coordinates (h, w, 2) of all pixels."""
    centres, slopes = undistorted_grid(camera)
    return tuple(
        np.asarray(centres + slopes[..., 0] * x + slopes[..., 1] * y, dtype=np.float32)
        for x, y in _PATTERN_LATTICE
    )


def render_pattern(
    pattern: Pattern,
    camera: CameraIntrinsics,
    pose: Pose,
    rng: np.random.Generator,
    look: SensorModel | None = None,
) -> Image:
    """One picture (height, width) uint8 of the pattern at ``pose`` (``pose_camera_board``)."""
    look = look or LINEAR
    paper, to_pixels = _paper(pattern)
    plane = np.column_stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.position])
    to_paper = to_pixels @ np.linalg.inv(plane)
    total = np.zeros((camera.height, camera.width), dtype=np.float32)
    for rays in _rays(camera):
        at = cv2.perspectiveTransform(rays, to_paper)
        # 128 beyond the paper: a grey wall.
        total += cv2.remap(
            paper, at, _NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128
        )
    canvas = look.black + (look.white - look.black) * (total.astype(float) / (255.0 * _PATTERN_RAYS))
    return photograph(canvas, camera.project(pose.position), rng, look)


def pattern_pose(
    pattern: Pattern,
    camera: CameraIntrinsics,
    rng: np.random.Generator,
    *,
    tilt_deg: tuple[float, float] = (10.0, 45.0),
    fill: tuple[float, float] = (0.4, 1.0),
) -> Pose:
    """A ``pose_camera_board`` as a person holds a board: tilted any way, here and there in the picture.

    Args:
        pattern: The board.
        camera: The optics.
        rng: Source of chance.
        tilt_deg: Range of the angle between board and picture plane.
        fill: Range of the print's width in the picture, in picture widths, were it not tilted.
    """
    centre = np.array([*(np.array(pattern.origin) + np.array(pattern.size) / 2), 0.0])
    while True:
        depth = camera.fx * pattern.size[0] / (camera.width * rng.uniform(*fill))
        place = rng.uniform((0, 0), camera.size)
        tilt, azimuth = np.deg2rad(rng.uniform(*tilt_deg)), rng.uniform(0, 2 * np.pi)
        lean = Pose(wxyz=rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0]))
        turn = lean.compose(Pose(wxyz=rotation_exp([0.0, 0.0, rng.normal(0.0, 0.15)])))
        position = camera.unproject(place) * depth - turn.rotation @ centre
        pose = Pose(position, turn.wxyz)
        if _in_view(pattern, camera, pose):
            return pose


def _in_view(pattern: Pattern, camera: CameraIntrinsics, pose: Pose) -> bool:
    """Whether all inner corners are in the picture, with room for their patches."""
    columns, rows = pattern.corners
    start = np.array(pattern.origin) + pattern.square
    ends = [(start[0] + c * pattern.square, start[1] + r * pattern.square, 0.0)
            for c in (0, columns - 1) for r in (0, rows - 1)]  # fmt: skip
    pixels = camera.project(pose.apply(np.array(ends)))
    return bool((pixels > 12).all() and (pixels < np.array(camera.size) - 13).all())


def pattern_set(
    pattern: Pattern, camera: CameraIntrinsics, count: int, *, seed: int = 0, look: SensorModel | None = None
) -> Iterator[PatternView]:
    """Pictures as a calibration wants them; the same seed gives the same ones."""
    rng = np.random.default_rng([seed, count])
    for _ in range(count):
        pose = pattern_pose(pattern, camera, rng)
        yield PatternView(render_pattern(pattern, camera, pose, rng, look), pose)


# ------------------------------------------------------------------------------------------
# The standard set of hand-eye calibration: views of one small marker with exact truth, to measure with.
#
# The hardest usual case: a marker of 50 mm, 0.5 to 0.9 m away, whose pose is known to about 0.5 mm
# across, 1 mm
# along the view and 0.3 degrees.


#: Standard deviation of corners (px) and of the arm's poses, each axis: metres, rad.
PIXEL, ARM = 0.1, (3e-4, float(np.deg2rad(0.05)))
# A pose estimated from four corners with 1 px of noise is off by about this: metres, rad.
_ROUGH = np.repeat((2.5e-3, 0.02), 3)


def handeye_set(
    count: int = 15,
    *,
    mounting: Mounting = "eye_in_hand",
    seed: int = 0,
    pixel: float = PIXEL,
    arm: tuple[float, float] = ARM,
    spread_deg: float = 25.0,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Mount, list[HandEyeSample]]:
    """The truth, and what an arm and a camera would say; the same seed gives the same.

    Args:
        count: Number of views.
        mounting: Who is carried.
        seed: Of everything.
        pixel: Standard deviation of the corners, px.
        arm: Standard deviation of the hand's pose, each axis: metres, rad.
        spread_deg: Standard deviation of the rotations about each axis of the camera.
        axes: Shares of it, by axis.
    """
    rng = np.random.default_rng(seed)
    points = marker_points(STANDARD_SIZE)
    truth = Mount(
        Pose(rng.normal(0, 0.05, 3), rotation_exp(rng.normal(0, 1, 3))),
        Pose(rng.normal(0, 0.3, 3), rotation_exp(rng.normal(0, 1, 3))),
        mounting,
    )
    samples = []
    for _ in range(count):
        turn = rotation_exp(np.deg2rad(spread_deg) * rng.normal(0, 1, 3) * axes)
        place = (*rng.normal(0, 0.04, 2), rng.uniform(0.5, 0.9))
        seen = Pose(place, (0, 1, 0, 0)).compose(Pose(wxyz=turn))  # facing the camera, then turned
        chain = truth.pose_parent_camera.compose(seen).compose(truth.pose_other_board.inverse())
        hand = chain if mounting == "eye_to_hand" else chain.inverse()
        pixels = STANDARD_CAMERA.project(seen.apply(points)) + rng.normal(0, 1, (4, 2)) * pixel
        said = Pose.exp(rng.normal(0, 1, 6) * np.repeat(arm, 3))
        rough = Pose.exp(rng.normal(0, pixel, 6) * _ROUGH)
        view = BoardView(points, pixels, seen.compose(rough), max(pixel, 0.01))
        samples.append(HandEyeSample(hand.compose(said), view))
    return truth, samples
