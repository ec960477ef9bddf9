"""What a library of the comparison gets and gives. It needs numpy only."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

Array = Any  # numpy.typing of old environments does not have NDArray
TWO_PI = 2.0 * np.pi

_ROUNDING = 1e-9
"""Radians by which rounding may exceed a joint limit."""


@dataclass(frozen=True)
class Task:
    """A robot and its problems, as every library gets them.

    Attributes:
        folder: Holds ``model.urdf`` and ``model.xml``, the same kinematics in both forms.
        robot: Name of the robot.
        joints: Names of the hinges in the order of solutions. A free base has seven numbers before.
        lower: (n,) lower limits of the hinges, rad.
        upper: (n,) upper limits of the hinges, rad.
        home: (nq,) joint values at home.
        sites: Frames with goals: one with a pose, or several with positions.
        free_base: Whether the robot has a free base.
        frames: (n + 1, 4, 4) constant transforms between the axes z of an arm. Empty for others.
        position: Position tolerance, m.
        angle: Angle tolerance, rad.
    """

    folder: Path
    robot: str
    joints: tuple[str, ...]
    lower: Array
    upper: Array
    home: Array
    sites: tuple[str, ...]
    free_base: bool
    frames: Array
    position: float
    angle: float

    @classmethod
    def load(cls, folder: Path) -> Task:
        """Read the task of a folder."""
        facts = json.loads((folder / "task.json").read_text(encoding="utf-8"))
        for key in ("lower", "upper", "home", "frames"):
            facts[key] = np.array(facts[key], dtype=float)
        for key in ("joints", "sites"):
            facts[key] = tuple(facts[key])
        return cls(folder=folder, **facts)

    @property
    def urdf(self) -> str:
        """Path of the URDF."""
        return str(self.folder / "model.urdf")

    @property
    def is_arm(self) -> bool:
        """Whether the task is the pose of one site of a robot on the ground."""
        return len(self.sites) == 1 and not self.free_base


@dataclass(frozen=True)
class Source:
    """A commit of a Git repository with a Python distribution in its folder ``src``."""

    url: str
    commit: str


class Library:
    """A library of the comparison.

    Attributes:
        needs: Distributions that pip installs.
        sources: Sources of distributions that the package index lacks, by name.
        settings: How the library is used, for the report.
    """

    needs: tuple[str, ...] = ()
    sources: Mapping[str, Source] = MappingProxyType({})
    settings = ""

    def setup(self, task: Task) -> bool:
        """Import the library and read the robot. Return False if it does not support the task."""
        raise NotImplementedError

    def solve(self, target: Array, start: Array) -> Array | None:
        """Return joint angles (nq,), or None.

        Args:
            target: (4, 4) pose, or (sites, 3) positions.
            start: (nq,) joint angles.
        """
        raise NotImplementedError

    def forward(self, q: Array) -> Array | None:
        """Return the pose (4, 4) of the only site by the library, or None.

        It shows that the library has read the same robot.
        """
        del q
        return None


def wxyz_of(rotation: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion of a rotation matrix (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        numbers = (1.0 + trace, h - f, c - g, d - b)
    elif largest == a:
        numbers = (h - f, 1.0 + a - e - i, b + d, c + g)
    elif largest == e:
        numbers = (c - g, b + d, 1.0 - a + e - i, f + h)
    else:
        numbers = (d - b, c + g, f + h, 1.0 - a - e + i)
    w, x, y, z = numbers
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


def nearest_branch(branches: Array, start: Array, task: Task) -> Array | None:
    """Return the branch inside the limits that is nearest to the start, modulo whole turns.

    Args:
        branches: (k, n) joint angles of the branches of a closed form.
        start: (n,) joint angles.
        task: The task with the limits.
    """
    if len(branches) == 0:
        return None
    changes = branches - start
    changes -= TWO_PI * np.rint(changes / TWO_PI)
    best = start + changes[np.abs(changes).max(axis=1).argmin()]
    if (best >= task.lower).all() and (best <= task.upper).all():  # usually the nearest of all
        return best
    candidates = into_limits(start + changes, task)
    distances = np.abs(candidates - start).max(axis=1)
    is_outside = (candidates < task.lower - _ROUNDING) | (candidates > task.upper + _ROUNDING)
    distances[is_outside.any(axis=1)] = np.inf
    nearest = int(distances.argmin())
    return None if distances[nearest] == np.inf else candidates[nearest]


def into_limits(q: Array, task: Task) -> Array:
    """Return angles moved by multiples of 2π into their range, where possible."""
    up = np.maximum(np.ceil((task.lower - q) / TWO_PI - 1e-12), 0.0)
    down = np.maximum(np.ceil((q - task.upper) / TWO_PI - 1e-12), 0.0)
    return q + TWO_PI * (up - down)
