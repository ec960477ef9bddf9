"""A home pose that ``robot.toml`` lists as numbers; most robots name a keyframe of the model instead."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import ConfigError, apart
from robot_ik.robot_file import RobotFile

# rad, m: a limit that was written with few digits is meant, and the pose is moved inside.
_ROUNDED = 1e-3


def checked_home(
    model: mujoco.MjModel, names: Sequence[str], file: RobotFile, home: tuple[float, ...]
) -> NDArray[np.float64]:
    """The numbers as qpos (model.nq,); ``names`` of all joints.

    Raises:
        ConfigError: Another count, or a hinge or slide outside its limits.
    """
    where = file.path or file.name
    if len(home) != model.nq:
        allowed = f"{model.nq}, rad and m, for the joints {', '.join(names)}"
        raise ConfigError(f"it has {len(home)} numbers", file=where, key="home", allowed=allowed)
    units = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}
    for joint, name in enumerate(names):
        unit = units.get(int(model.jnt_type[joint]))
        value, (low, high) = home[model.jnt_qposadr[joint]], model.jnt_range[joint].tolist()
        if unit and model.jnt_limited[joint] and not low - _ROUNDED <= value <= high + _ROUNDED:
            asked, lower, upper = apart(value, low, high, digits=4, form="g")
            raise ConfigError(
                f"joint {name!r} at {asked} {unit} is outside its limits", file=where, key="home",
                allowed=f"{lower} to {upper} {unit}",
                hint=f"{asked} degrees are {math.radians(value):.4g} rad" if unit == "rad" else "",
            )  # fmt: skip
    return np.array(home, dtype=float)
