"""Table ``[figure]`` of ``robot.toml``: the frames that make a robot a figure."""

from __future__ import annotations

from pydantic import Field

from robot_ik.config import Several, Table, check_table
from robot_ik.robot import Robot


class FigureParts(Table):
    """Frames of a figure, by side if there are two. ``bend`` is a keyframe."""

    hands: dict[str, str] = Field(default={})
    feet: dict[str, str] = Field(default={})
    gaze: str | None = None
    neck: Several[str] = ()
    pelvis: str
    trunk: str
    bend: str | None = None


class _FigureFile(Table):
    figure: FigureParts


def figure_parts(robot: Robot) -> FigureParts | None:
    """Return the table ``[figure]`` of a robot, None without one.

    Raises:
        ConfigError: A key is wrong.
    """
    file = robot.file
    if file.figure is None:
        return None
    return check_table(_FigureFile, {"figure": file.figure}, file.path or file.name).figure
