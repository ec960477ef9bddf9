"""Real things that hide the drawn robot: geoms that are drawn to depth only.

They come from a MuJoCo model, or from a TOML file of boxes::

    [[box]]
    position = [0.10, 0.05, 0.04]   # its middle, metres, in the frame of the board
    size = [0.06, 0.06, 0.08]       # its edges, metres
    yaw_deg = 20.0                  # about the vertical, 0 when not given
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_ik.errors import ConfigError, ModelError
from robot_ik.files import read_toml, shown
from robot_ik.geometry import rotation_exp
from robot_ik.model_file import read_model

_KEYS = {"position": 3, "size": 3, "yaw_deg": 1}


def load_phantoms(path: Path | str) -> mujoco.MjModel:
    """The things in a file, as a model whose world is the frame of the board.

    Raises:
        ConfigError: The file is missing, is no such file, or a box cannot be.
    """
    file = Path(path)
    if not file.is_file():
        raise ConfigError("there is no such file", file=file, allowed="boxes in TOML, or a MuJoCo model")
    if file.suffix.lower() != ".toml":
        try:
            return read_model(file, file)[0]
        except ModelError as error:
            raise ConfigError(f"is not a MuJoCo model: {error.reason or error}", file=file) from error
    data = read_toml(file, "the file of boxes")
    boxes = data.get("box")
    if not isinstance(boxes, list) or not boxes or set(data) != {"box"}:
        raise ConfigError("holds no boxes", file=file, key="box", allowed="[[box]] with position and size")
    return phantom_boxes([_box(box, file, k) for k, box in enumerate(boxes)])


def phantom_boxes(boxes: list[dict[str, list[float]]]) -> mujoco.MjModel:
    """A model of boxes, each with ``position``, ``size`` and ``yaw_deg`` as in the file."""
    spec = mujoco.MjSpec()
    for box in boxes:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box["position"],
            size=[0.5 * edge for edge in box["size"]],
            quat=rotation_exp([0.0, 0.0, np.deg2rad(box.get("yaw_deg", [0.0])[0])]).tolist(),
        )
    return spec.compile()


def _box(box: Any, file: Path, number: int) -> dict[str, list[float]]:
    key = f"box {number + 1}"
    if not isinstance(box, Mapping) or not {"position", "size"} <= set(box) <= set(_KEYS):
        raise ConfigError("is no box", file=file, key=key, allowed=", ".join(_KEYS))
    found = {}
    for name, value in box.items():
        numbers = value if isinstance(value, list) else [value]
        good = all(isinstance(v, (int, float)) and np.isfinite(v) for v in numbers)
        if not good or len(numbers) != _KEYS[name]:
            raise ConfigError(
                f"{shown(value)} is no {name}", file=file, key=key, allowed=f"{_KEYS[name]} finite numbers"
            )
        found[name] = [float(v) for v in numbers]
    if min(found["size"]) <= 0:
        raise ConfigError(f"{found['size']} is no size", file=file, key=key, allowed="edges above 0, metres")
    return found
