"""Drawings that lie exactly on a camera picture: robot, axes, paths, marker outlines, captions.

All functions return a new picture and do not change their arguments. Coordinates are those of
OpenCV (camera x right, y down, z forward; pixel centres at integers). Colours are BGR, 0 to 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.faces import EMPTY, NEAR, bounding_box, faces_in_picture
from robot_ik.camera.drawing.outlines import visible_lines
from robot_ik.camera.drawing.painter import SurfaceBuffer, geom_paint
from robot_ik.camera.drawing.text import text_size, write
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

Colour = tuple[int, int, int]
Style = Literal["solid", "outline", "registered"]

GREEN: Colour = (90, 190, 60)
ORANGE: Colour = (30, 140, 250)
RED: Colour = (60, 60, 230)
WHITE: Colour = (255, 255, 255)
DARK: Colour = (38, 32, 28)
#: Of axes x, y and z.
AXIS_COLOURS: tuple[Colour, Colour, Colour] = ((60, 60, 235), (70, 190, 60), (240, 130, 40))

# OpenCV's drawing functions take coordinates in fixed point: 1/256 px.
_SHIFT = 8
# Coordinates beyond this do not fit into fixed point, px.
_LARGEST_PIXEL = 8000
# Points along a line that is drawn through a distorting lens.
_LINE_POINTS = 24
# Half side of the square at the first corner of a marker, px.
_CORNER_HALF = 3

# Of a caption's card: width of the bar at its left edge, px.
_BAR = 5
# Padding and distance of lines, in letter sizes.
_PADDING = 0.55
_LINE_DISTANCE = 1.35
# Part of the picture that shows through the card.
_TRANSPARENCY = 0.22

# Of a sheet with two views: the width of each view, px.
_VIEW_WIDTH = 960
# Space round the sheet and between the views, px.
_SHEET_MARGIN = 28
_VIEW_GAP = 20
# Height of title, of heading and accent, of each caption line, and of the footer, px.
_TITLE_HEIGHT = 48
_HEADING_HEIGHT = 58
_CAPTION_HEIGHT = 27
_FOOTER_HEIGHT = 34
_SHEET_GREY = 250
_CAPTION_COLOUR: Colour = (90, 84, 80)
_FOOTER_COLOUR: Colour = (120, 114, 110)


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
    """Draw the model as this camera would see it.

    Args:
        image: (height, width, 3) as the camera delivers it, with its distortion.
        model: Any MuJoCo model. Planes (floors) are not drawn.
        qpos: (model.nq,) full configuration.
        intrinsics: For pictures of this size.
        pose_world_camera: OpenCV camera axes seen from the world.
        alpha: Opacity of the robot, 0 to 1.
        tint: One colour for everything instead of the geoms' own.
        style: ``solid`` fills the robot. ``outline`` draws silhouettes and sharp edges, without
            hidden ones. ``registered`` does both, to show whether the drawing fits the picture.
        line_colour: Of the lines.

    Raises:
        CalibrationError: The calibration is for another picture size.
        ValueError: Unknown style.
    """
    if style not in get_args(Style):
        known = ", ".join(map(repr, get_args(Style)))
        raise ValueError(f"unknown style {style!r}; known: {known}")
    height, width = image.shape[:2]
    intrinsics.require_size(width, height)
    result = image.copy()
    faces = faces_in_picture(model, qpos, intrinsics, pose_world_camera)
    box = bounding_box(faces, width, height, margin=4)
    if box == EMPTY:
        return result
    buffer = SurfaceBuffer(box)
    buffer.fill(faces, geom_paint(model, tint))
    if style != "outline":
        buffer.layer().over(result, alpha)
    if style != "solid":
        x0, y0, x1, y1 = box
        mask = np.zeros((y1 - y0, x1 - x0), dtype=np.uint8)
        lines = _fixed(visible_lines(faces, buffer) - (x0, y0))
        cv2.polylines(mask, list(lines), False, 255, 1, cv2.LINE_AA, _SHIFT)
        region = result[y0:y1, x0:x1]
        where = np.nonzero(mask)
        share = mask[where][:, None] * np.float32(1 / 255)
        colour = np.array(line_colour, dtype=np.float32)
        region[where] = np.rint(region[where] * (1 - share) + colour * share)
    return result


def draw_axes(
    image: Image,
    pose_camera_x: Pose,
    length: float,
    intrinsics: CameraIntrinsics,
    *,
    width: int = 3,
    label: str = "",
) -> Image:
    """Draw the axes of a frame, x red, y green, z blue, the farthest first.

    Args:
        image: (height, width, 3).
        pose_camera_x: The frame seen from the camera.
        length: Of each axis, metres.
        intrinsics: For pictures of this size.
        width: Of the lines, px.
        label: Caption beside the origin.
    """
    result = image.copy()
    rotation = pose_camera_x.rotation
    origin = pose_camera_x.position
    steps = np.linspace(0.0, length, _LINE_POINTS)[:, None]
    for axis in np.argsort(-rotation[2]):
        runs = _visible_runs(origin + steps * rotation[:, axis], intrinsics)
        cv2.polylines(result, runs, False, WHITE, width + 2, cv2.LINE_AA, _SHIFT)
        cv2.polylines(result, runs, False, AXIS_COLOURS[axis], width, cv2.LINE_AA, _SHIFT)
    centre = _visible_runs(np.stack([origin, origin * 1.0001]), intrinsics)
    if centre:
        x, y = (int(v) for v in centre[0][0])
        radius = (width + 1) << _SHIFT
        cv2.circle(result, (x, y), radius, WHITE, -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(result, (x, y), radius - (1 << _SHIFT), DARK, -1, cv2.LINE_AA, _SHIFT)
        if label:
            result = put_label(result, label, (x / 256 + 14, y / 256 - 14))
    return result


def draw_marker_outline(image: Image, corners: ArrayLike, *, label: str = "") -> Image:
    """Draw a marker's border through its corners (4, 2) in pixels, with a square at the first."""
    points = np.asarray(corners, dtype=float).reshape(4, 2)
    result = image.copy()
    cv2.polylines(result, [_fixed(points)], True, GREEN, 2, cv2.LINE_AA, _SHIFT)
    square = points[0] + _CORNER_HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    cv2.fillConvexPoly(result, _fixed(square), RED, cv2.LINE_AA, _SHIFT)
    if label:
        anchor = (float(points[:, 0].max()) + 8, float(points[:, 1].mean()))
        result = put_label(result, label, anchor, accent=GREEN)
    return result


def put_label(
    image: Image,
    text: str,
    anchor: tuple[float, float],
    *,
    size: int = 17,
    accent: Colour | None = None,
) -> Image:
    """Write a caption on a dark translucent card.

    Args:
        image: (height, width, 3).
        text: One or more lines, separated by newlines.
        anchor: (x, y) of the left edge and the vertical middle of the card. The card is moved if
            it would leave the picture.
        size: Letter size, px.
        accent: Colour of a bar at the left edge of the card.
    """
    lines = text.split("\n")
    sizes = [text_size(line, size) for line in lines]
    bar = _BAR if accent else 0
    padding = round(_PADDING * size)
    step = round(_LINE_DISTANCE * size)
    width = max(w for w, _ in sizes) + 2 * padding + bar
    height = step * (len(lines) - 1) + sizes[0][1] + 2 * padding
    x = int(np.clip(round(anchor[0]), 0, max(0, image.shape[1] - width)))
    y = int(np.clip(round(anchor[1] - height / 2), 0, max(0, image.shape[0] - height)))
    result = image.copy()
    card = result[y : y + height, x : x + width]
    dark = np.full_like(card, DARK)
    cv2.addWeighted(card, _TRANSPARENCY, dark, 1.0 - _TRANSPARENCY, 0.0, dst=card)
    if accent:
        card[:, :_BAR] = accent
    for k, line in enumerate(lines):
        position = (x + padding + bar, y + padding + sizes[0][1] + k * step)
        write(result, line, position, size, WHITE)
    return result


def before_after(
    before: Image,
    after: Image,
    captions: Sequence[str],
    *,
    title: str,
    footer: str,
    accents: tuple[Colour, Colour],
) -> Image:
    """Put two views side by side on one sheet with captions below.

    Args:
        before: (h, w, 3), on the left.
        after: (h, w, 3) of any size, on the right.
        captions: One for each view. The first line is the heading, further lines are small.
        title: Headline.
        footer: One line below all.
        accents: Colour of the bar above each caption.
    """
    views = [_fitted(view, _VIEW_WIDTH) for view in (before, after)]
    margin = _SHEET_MARGIN
    top = margin + _TITLE_HEIGHT
    view_height = max(len(views[0]), len(views[1]))
    below = _HEADING_HEIGHT + _CAPTION_HEIGHT * max(text.count("\n") for text in captions)
    height = top + view_height + below + _FOOTER_HEIGHT + margin // 2
    width = 2 * margin + 2 * _VIEW_WIDTH + _VIEW_GAP
    sheet = np.full((height, width, 3), _SHEET_GREY, dtype=np.uint8)
    write(sheet, title, (margin, margin + 22), 28, DARK, bold=True)
    bottom = top + view_height
    for k, (view, text, accent) in enumerate(zip(views, captions, accents, strict=True)):
        x = margin + k * (_VIEW_WIDTH + _VIEW_GAP)
        sheet[top : top + len(view), x : x + _VIEW_WIDTH] = view
        sheet[bottom : bottom + 6, x : x + _VIEW_WIDTH] = accent
        heading, *lines = text.split("\n")
        write(sheet, heading, (x, bottom + 40), 24, DARK, bold=True)
        for j, line in enumerate(lines):
            y = bottom + 69 + _CAPTION_HEIGHT * j
            write(sheet, line, (x, y), 19, _CAPTION_COLOUR)
    write(sheet, footer, (margin, height - margin // 2 - 8), 17, _FOOTER_COLOUR)
    return sheet


def _fixed(pixels: Array) -> NDArray[np.int32]:
    """Return pixels in OpenCV's fixed point."""
    inside = np.clip(pixels, -_LARGEST_PIXEL, _LARGEST_PIXEL)
    return np.rint(inside * (1 << _SHIFT)).astype(np.int32)


def _visible_runs(points: Array, intrinsics: CameraIntrinsics) -> list[NDArray[np.int32]]:
    """Return the pieces of a polyline (n, 3) of the camera frame in view, in fixed point."""
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
    visible = (points[:, 2] > NEAR) & (radius < intrinsics.radius_limit)
    pixels = np.zeros((len(points), 2))
    if visible.any():
        pixels[visible] = intrinsics.project(points[visible])
    cuts = np.flatnonzero(np.diff(visible.astype(int))) + 1
    pieces = np.split(np.arange(len(points)), cuts)
    return [_fixed(pixels[piece]) for piece in pieces if visible[piece[0]] and len(piece) > 1]


def _fitted(view: Image, width: int) -> Image:
    """Return the view scaled to a width."""
    height = round(view.shape[0] * width / view.shape[1])
    interpolation = cv2.INTER_AREA if width < view.shape[1] else cv2.INTER_CUBIC
    return np.asarray(
        cv2.resize(view, (width, height), interpolation=interpolation), dtype=np.uint8
    )
