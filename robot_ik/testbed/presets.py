"""Presets: named starts of a session, such as the programs of the theses."""

from __future__ import annotations

from dataclasses import dataclass

from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.testbed.commands import Command, SetFigure


@dataclass(frozen=True)
class Preset:
    """How a session begins.

    Attributes:
        about: What it shows, in one line.
        robot: Name of the robot.
        commands: First commands of the session.
        ar: Whether the robot is drawn into the pictures of the synthetic camera.
    """

    about: str
    robot: str
    commands: tuple[Command, ...] = ()
    ar: bool = False


PRESETS: dict[str, Preset] = {
    "arkineman": Preset(
        "thesis P11: a figure that decides, a virtual ball, in the picture of a camera",
        "humanoid",
        (SetFigure("active"),),
        ar=True,
    ),
}
"""Presets by name."""


def preset(name: str) -> Preset:
    """Return a preset. Capital letters make no difference.

    Raises:
        ConfigError: There is no preset of that name.
    """
    if name.lower() not in PRESETS:
        raise ConfigError(
            f"there is no preset {name!r}",
            file="command line",
            key="--preset",
            allowed=", ".join(PRESETS),
            hint=did_you_mean(name, PRESETS),
        )
    return PRESETS[name.lower()]
