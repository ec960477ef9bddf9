"""Real objects that hide a drawn robot, from a MuJoCo model or from a TOML file of boxes.

A file of boxes::

    [[box]]
    position = [0.10, 0.05, 0.04]   # the middle of the box, metres, in the frame of the board
    size = [0.06, 0.06, 0.08]       # its edges, metres
    yaw_deg = 20.0                  # rotation about the vertical, default 0
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
from pydantic import Field

from robot_ik.config import Position, Positive, Several, Table, read_table
from robot_ik.errors import ConfigError, ModelError
from robot_ik.geometry import rotation_exp
from robot_ik.model import read_model

Edges = Annotated[
    tuple[Positive, Positive, Positive],
    Field(strict=False, description="three edges above 0, metres"),
]


class BoxTable(Table):
    """A box: its middle and its edges in metres, and its rotation about the vertical."""

    position: Position
    size: Edges
    yaw_deg: float = 0.0


class _BoxesFile(Table):
    box: Annotated[
        Several[BoxTable], Field(min_length=1, description="[[box]] with position and size")
    ]


def load_occluders(path: Path | str) -> mujoco.MjModel:
    """Load the objects in a file as a model whose world is the frame of the board.

    Raises:
        ConfigError: The file is missing, has another format, or describes an impossible box.
    """
    file = Path(path)
    if not file.is_file():
        allowed = "boxes in TOML, or a MuJoCo model"
        raise ConfigError("there is no such file", file=file, allowed=allowed)
    if file.suffix.lower() != ".toml":
        try:
            return read_model(file, file)[0]
        except ModelError as error:
            problem = f"is not a MuJoCo model: {error.reason or error}"
            raise ConfigError(problem, file=file) from error
    return occluder_boxes(read_table(_BoxesFile, file, "the file of boxes").box)


def occluder_boxes(boxes: Iterable[BoxTable]) -> mujoco.MjModel:
    """Return a model of boxes."""
    spec = mujoco.MjSpec()
    for box in boxes:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.position,
            size=[0.5 * edge for edge in box.size],
            quat=rotation_exp([0.0, 0.0, np.deg2rad(box.yaw_deg)]).tolist(),
        )
    return spec.compile()
