"""Table ``[gallery]`` of ``robot.toml``: a pose that shows what a robot can do."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from robot_ik.config import Pair, Position, Table, check_table
from robot_ik.robot import Robot

_PositionAndWxyz = Annotated[
    tuple[float, float, float, float, float, float, float], Field(strict=False)
]


class GalleryScene(Table):
    """The pose that ``docs/make/gallery.py`` draws beside the home pose.

    A goal is a position, or a position and a quaternion wxyz, in the world. ``view_deg`` is azimuth
    (from x to y) and elevation of the view.
    """

    about: str = "reaching"
    goals: dict[str, Position | _PositionAndWxyz] = Field(default={})
    view_deg: Pair = (-55.0, 16.0)


class _GalleryFile(Table):
    gallery: GalleryScene


def gallery_scene(robot: Robot) -> GalleryScene:
    """Return the table ``[gallery]`` of a robot, or the default scene without goals.

    Raises:
        ConfigError: A key is wrong.
    """
    file = robot.file
    if file.gallery is None:
        return GalleryScene()
    return check_table(_GalleryFile, {"gallery": file.gallery}, file.path or file.name).gallery
