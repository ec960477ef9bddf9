"""Drawings that lie exactly on a camera picture: robot, axes, paths, marker outlines, captions.

No OpenGL.  All functions return a new picture and leave their argument alone; coordinates are those of
OpenCV (camera x right, y down, z forward; pixel centres at integers), colours are BGR, 0..255.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.painter import (
    EMPTY,
    NEAR,
    Faces,
    SurfaceSamples,
    base_colours,
    bounding_box,
    faces_in_picture,
)
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

Colour = tuple[int, int, int]

# ------------------------------------------------------------------------------------------
# Text on pictures: the built-in outline font where OpenCV has one (5.0 on), stroke letters otherwise.


# Letters that the stroke font of OpenCV 4 lacks.
_PLAIN = str.maketrans(
    {"°": " deg", "–": "-", "—": "-", "≤": "<=", "µ": "u", "→": "->", "σ": "sigma", "·": "-", "±": "+-"}
)
_HERSHEY = cv2.FONT_HERSHEY_DUPLEX
# Height of a Hershey capital at scale 1, in pixels, over the em of the outline font.
_HERSHEY_EM = 30.0


@lru_cache(maxsize=1)
def _outline_font() -> Any | None:
    make = getattr(cv2, "FontFace", None)
    try:
        return None if make is None else make("sans")
    except cv2.error:
        return None


def text_size(text: str, size: int) -> tuple[int, int]:
    """Width and height of capitals, pixels, of ``text`` in letters of ``size`` px."""
    font = _outline_font()
    if font is None:
        (width, _), _ = cv2.getTextSize(text.translate(_PLAIN), _HERSHEY, size / _HERSHEY_EM, 1)
        return int(width), round(0.72 * size)
    box = cv2.getTextSize((4096, 4096), text, (0, 0), font, size, 400)
    return int(box[2]), round(0.72 * size)


def write(
    image: Image,
    text: str,
    origin: tuple[int, int],
    size: int,
    colour: tuple[int, int, int],
    *,
    bold: bool = False,
) -> None:
    """Writes into ``image`` from ``origin`` (x, y) on the base line, in letters of ``size`` px."""
    font = _outline_font()
    if font is None:
        scale, width = size / _HERSHEY_EM, 2 if bold and size > 16 else 1
        cv2.putText(image, text.translate(_PLAIN), origin, _HERSHEY, scale, colour, width, cv2.LINE_AA)
        return
    cv2.putText(image, text, origin, colour, font, size, 700 if bold else 400)


# ------------------------------------------------------------------------------------------
# Outlines of a drawn robot: silhouettes and sharp edges, those left out that something hides.


# Lines may lie this part of their distance behind the surface they belong to.
_LINE_SLACK = 0.01
# Points along a line at which it is asked whether something hides it, pixels.
_LINE_STEP, _LINE_PIECES = 2.0, 1000


def visible_lines(faces: Faces, samples: SurfaceSamples) -> Array:
    """Silhouettes of each geom and sharp edges, (n, 2, 2) pixels, where nothing in ``samples`` hides them."""
    mesh = faces.mesh
    corners = faces.pixels[mesh.faces]
    across, along = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    front = across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0] < 0.0
    facing = front[mesh.edge_faces]
    worth = (facing[:, 0] != facing[:, 1]) | (mesh.crease & facing[:, 0])
    spots = faces.pixels[mesh.edges]
    x0, y0, x1, y1 = samples.box
    near = (spots.max(axis=1) > (x0, y0)).all(axis=1) & (spots.min(axis=1) < (x1, y1)).all(axis=1)
    ends = mesh.edges[worth & near & faces.within[mesh.edges].all(axis=1)]
    if not len(ends):
        return np.zeros((0, 2, 2))
    a, b = faces.pixels[ends[:, 0]], faces.pixels[ends[:, 1]]
    pieces = np.maximum(1, np.ceil(np.hypot(*(b - a).T) / _LINE_STEP)).astype(int)
    pieces = np.minimum(pieces, _LINE_PIECES)
    edge = np.repeat(np.arange(len(ends)), pieces)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[edge]
    step = 1.0 / pieces[edge]

    def at(shares: Array, first: Array, second: Array) -> Array:
        return first[edge] + (second - first)[edge] * (shares[:, None] if first.ndim == 2 else shares)

    middle = share + 0.5 * step
    # A point on an outline is seen if one of the nine pixels around it lets it through.
    least = cv2.erode(np.pad(samples.depth[..., 0], 2, constant_values=np.inf), np.ones((3, 3)))
    column, row = (np.floor(at(middle, a, b) + 0.5).astype(int) - samples.box[:2]).T + 2
    column, row = np.clip(column, 0, least.shape[1] - 1), np.clip(row, 0, least.shape[0] - 1)
    depths = at(middle, faces.inverse[ends[:, 0]], faces.inverse[ends[:, 1]])
    seen = least[row, column] <= depths * (1.0 + _LINE_SLACK)
    return np.stack([at(share, a, b)[seen], at(share + step, a, b)[seen]], axis=1)


Style = Literal["solid", "outline", "registered"]

GREEN: Colour = (90, 190, 60)
ORANGE: Colour = (30, 140, 250)
RED: Colour = (60, 60, 230)
WHITE: Colour = (255, 255, 255)
DARK: Colour = (38, 32, 28)

_AXIS_COLOURS: tuple[Colour, Colour, Colour] = ((60, 60, 235), (70, 190, 60), (240, 130, 40))
# cv2's fixed point coordinates: 1/256 px.
_SHIFT = 8
# Points along a line drawn through a distorting lens.
_LINE_POINTS = 24


def draw_robot(
    image: Image,
    model: mujoco.MjModel,
    qpos: ArrayLike,
    intrinsics: CameraIntrinsics,
    pose_world_camera: Pose,
    *,
    alpha: float = 0.6,
    tint: Colour | None = None,
    style: Style = "solid",
    line_colour: Colour = WHITE,
) -> Image:
    """Draws the model where this camera would see it.

    Args:
        image: (height, width, 3) as the camera delivers it, with its distortion.
        model: Any MuJoCo model; planes (floors) are left out.
        qpos: (model.nq,) full configuration.
        intrinsics: For pictures of this size.
        pose_world_camera: OpenCV camera axes seen from the world.
        alpha: 0 leaves the picture, 1 hides it.
        tint: One colour for everything instead of the geoms' own.
        style: ``solid`` fills, ``outline`` draws silhouettes and sharp edges, hidden ones left out,
            ``registered`` does both, so that one can see whether the drawing fits the picture.
        line_colour: Of the lines.

    Raises:
        CalibrationError: The calibration is for another picture size.
        ValueError: Unknown style.
    """
    if style not in ("solid", "outline", "registered"):
        raise ValueError(f"unknown style {style!r}; known: 'solid', 'outline', 'registered'")
    height, width = image.shape[:2]
    intrinsics.require_size(width, height)
    result = image.copy()
    faces = faces_in_picture(model, qpos, intrinsics, pose_world_camera)
    box = bounding_box(faces, width, height, margin=4)
    if box == EMPTY:
        return result
    samples = SurfaceSamples(box)
    samples.fill(faces)
    if style != "outline":
        samples.layer(base_colours(model, tint)).over(result, alpha)
    if style != "solid":
        mask = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.uint8)
        lines = _fixed(visible_lines(faces, samples) - box[:2])
        cv2.polylines(mask, list(lines), False, 255, 1, cv2.LINE_AA, _SHIFT)
        region, where = result[box[1] : box[3], box[0] : box[2]], np.nonzero(mask)
        share, colour = mask[where][:, None] * np.float32(1 / 255), np.array(line_colour, dtype=np.float32)
        region[where] = np.rint(region[where] * (1 - share) + colour * share)
    return result


def _fixed(pixels: Array) -> NDArray[np.int32]:
    return np.rint(np.clip(pixels, -8000, 8000) * (1 << _SHIFT)).astype(np.int32)


def _runs(points: Array, intrinsics: CameraIntrinsics) -> list[NDArray[np.int32]]:
    """Polyline (n, 3) in the camera frame as pieces in fixed point that are in front of the lens."""
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
    good = (points[:, 2] > NEAR) & (radius < intrinsics.radius_limit)
    pixels = np.zeros((len(points), 2))
    if good.any():
        pixels[good] = intrinsics.project(points[good])
    cuts = np.flatnonzero(np.diff(good.astype(int))) + 1
    pieces = np.split(np.arange(len(points)), cuts)
    return [_fixed(pixels[piece]) for piece in pieces if good[piece[0]] and len(piece) > 1]


def draw_axes(
    image: Image,
    pose_camera_x: Pose,
    length: float,
    intrinsics: CameraIntrinsics,
    *,
    width: int = 3,
    label: str = "",
) -> Image:
    """Draws a frame's axes, x red, y green, z blue, the farthest first.

    Args:
        image: (height, width, 3).
        pose_camera_x: The frame seen from the camera.
        length: Of each axis, metres.
        intrinsics: For pictures of this size.
        width: Pixels.
        label: Caption beside the origin.
    """
    result = image.copy()
    rotation, origin = pose_camera_x.rotation, pose_camera_x.position
    steps = np.linspace(0.0, length, _LINE_POINTS)[:, None]
    for axis in np.argsort(-rotation[2]):
        runs = _runs(origin + steps * rotation[:, axis], intrinsics)
        cv2.polylines(result, runs, False, WHITE, width + 2, cv2.LINE_AA, _SHIFT)
        cv2.polylines(result, runs, False, _AXIS_COLOURS[axis], width, cv2.LINE_AA, _SHIFT)
    centre = _runs(np.stack([origin, origin * 1.0001]), intrinsics)
    if centre:
        x, y = (int(v) for v in centre[0][0])
        radius = (width + 1) << _SHIFT
        cv2.circle(result, (x, y), radius, WHITE, -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(result, (x, y), radius - (1 << _SHIFT), DARK, -1, cv2.LINE_AA, _SHIFT)
        if label:
            result = put_label(result, label, (x / 256 + 14, y / 256 - 14))
    return result


def draw_marker_outline(image: Image, corners: ArrayLike, *, label: str = "") -> Image:
    """Draws a seen marker's border through its corners (4, 2) in pixels, with a square at the first one."""
    points = np.asarray(corners, dtype=float).reshape(4, 2)
    result = image.copy()
    cv2.polylines(result, [_fixed(points)], True, GREEN, 2, cv2.LINE_AA, _SHIFT)
    square = points[0] + np.array([[-3, -3], [3, -3], [3, 3], [-3, 3]])
    cv2.fillConvexPoly(result, _fixed(square), RED, cv2.LINE_AA, _SHIFT)
    if label:
        result = put_label(
            result, label, (float(points[:, 0].max()) + 8, float(points[:, 1].mean())), accent=GREEN
        )
    return result


def put_label(
    image: Image,
    text: str,
    anchor: tuple[float, float],
    *,
    size: int = 17,
    accent: Colour | None = None,
) -> Image:
    """Writes a caption on a dark translucent card; lines are separated by newlines.

    Args:
        image: (height, width, 3).
        text: One or more lines.
        anchor: (x, y) of the card's left edge and vertical middle; moved so that the card stays inside.
        size: Letter size in pixels.
        accent: A bar at the card's left edge.
    """
    lines = text.split("\n")
    sizes = [text_size(line, size) for line in lines]
    pad, step = round(0.55 * size), round(1.35 * size)
    width = max(w for w, _ in sizes) + 2 * pad + (5 if accent else 0)
    height = step * (len(lines) - 1) + sizes[0][1] + 2 * pad
    x = int(np.clip(round(anchor[0]), 0, max(0, image.shape[1] - width)))
    y = int(np.clip(round(anchor[1] - height / 2), 0, max(0, image.shape[0] - height)))
    result = image.copy()
    card = result[y : y + height, x : x + width]
    cv2.addWeighted(card, 0.22, np.full_like(card, DARK), 0.78, 0.0, dst=card)
    if accent:
        card[:, :5] = accent
    for k, line in enumerate(lines):
        position = (x + pad + (5 if accent else 0), y + pad + sizes[0][1] + k * step)
        write(result, line, position, size, WHITE)
    return result


# Width of each of two views on a sheet, pixels.
_VIEW_WIDTH = 960


def before_after(
    before: Image,
    after: Image,
    captions: Sequence[str],
    *,
    title: str,
    footer: str,
    accents: tuple[Colour, Colour],
) -> Image:
    """Puts two views side by side on one sheet with captions below.

    Args:
        before: (h, w, 3), left; ``after`` right, of any size.
        after: See ``before``.
        captions: One for each; the first line is the heading, further lines are small.
        title: Headline; ``footer``: one line below all.
        footer: See ``title``.
        accents: Colour of the bar above each caption.
    """
    views = [_fitted(view, _VIEW_WIDTH) for view in (before, after)]
    margin, gap = 28, 20
    top = margin + 48
    high = max(len(views[0]), len(views[1]))
    lines = max(text.count("\n") for text in captions)
    below = 58 + 27 * lines
    total = (top + high + below + 34 + margin // 2, 2 * margin + 2 * _VIEW_WIDTH + gap)
    sheet = np.full((*total, 3), 250, dtype=np.uint8)
    write(sheet, title, (margin, margin + 22), 28, DARK, bold=True)
    for k, (view, text, accent) in enumerate(zip(views, captions, accents, strict=True)):
        x = margin + k * (_VIEW_WIDTH + gap)
        sheet[top : top + len(view), x : x + _VIEW_WIDTH] = view
        sheet[top + high : top + high + 6, x : x + _VIEW_WIDTH] = accent
        heading, *rest = text.split("\n")
        write(sheet, heading, (x, top + high + 40), 24, DARK, bold=True)
        for j, line in enumerate(rest):
            write(sheet, line, (x, top + high + 69 + 27 * j), 19, (90, 84, 80))
    write(sheet, footer, (margin, total[0] - margin // 2 - 8), 17, (120, 114, 110))
    return sheet


def _fitted(view: Image, width: int) -> Image:
    height = round(view.shape[0] * width / view.shape[1])
    interpolation = cv2.INTER_AREA if width < view.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(view, (width, height), interpolation=interpolation), dtype=np.uint8)
