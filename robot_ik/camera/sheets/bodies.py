"""What a printed board or cube is to a tracker: a body, and the file that describes it."""

from __future__ import annotations

from robot_ik.camera.pose.bodies import MarkerBody, cube_body, grid_body
from robot_ik.camera.sheets.blocks import SheetWish
from robot_ik.errors import CameraError


def body_of(wish: SheetWish) -> MarkerBody:
    """The body on a sheet.

    Raises:
        CameraError: The sheet shows neither a board nor a cube.
    """
    size = wish.size / 1e3
    if wish.kind == "board":
        columns, rows = wish.counts
        return grid_body(columns, rows, size, wish.gap / 1e3, wish.marker_ids[0])
    if wish.kind == "cube":
        return cube_body(wish.marker_ids, size, wish.edge / 1e3)
    raise CameraError(f"a sheet of kind {wish.kind!r} is no body", hint="bodies are printed as board or cube")


def body_file(wish: SheetWish, name: str) -> str:
    """The text of a file for ``robot_ik.camera.pose.bodies.load_bodies``.

    Args:
        wish: The sheet.
        name: Of the body.
    """
    lines = ["# Metres; position and wxyz are the marker's pose in the body.", "[[body]]"]
    lines += [f'name = "{name}"', f'dictionary = "{wish.dictionary}"', "markers = ["]
    for marker, (size, pose) in body_of(wish).markers.items():
        position, wxyz = (", ".join(_number(v) for v in part) for part in (pose.position, pose.wxyz))
        lines.append(f"  {{id = {marker}, size = {size:.9g}, position = [{position}], wxyz = [{wxyz}]}},")
    return "\n".join([*lines, "]", ""])


def _number(value: float) -> str:
    """To a billionth; sines of quarter turns are then the 0 that they are meant to be."""
    return f"{round(float(value), 12) + 0.0:.12g}"
