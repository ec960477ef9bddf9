"""The sums of an error map: over all poses, and over the halves of the space they were in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.arm_zeros.errors import PoseError

_AXES = "xyz"


@dataclass(frozen=True)
class Region:
    """Some of the poses.

    Attributes:
        name: Which.
        count: How many.
        rms, median, largest: Of the distances, metres.
        angle: RMS, rad.
        sigma: RMS of the stated standard deviations, metres.
    """

    name: str
    count: int
    rms: float
    median: float
    largest: float
    angle: float
    sigma: float


def summary(errors: Sequence[PoseError], name: str = "all") -> Region:
    """Over some poses; at least one."""
    distances = np.array([one.distance for one in errors])
    return Region(
        name, len(errors),
        float(np.sqrt(np.mean(distances**2))), float(np.median(distances)), float(distances.max()),
        float(np.sqrt(np.mean([one.angle**2 for one in errors]))),
        float(np.sqrt(np.mean([one.sigma**2 for one in errors]))),
    )  # fmt: skip


def regions(errors: Sequence[PoseError]) -> tuple[Region, ...]:
    """All poses, then the lower and the upper half along each axis of the world, split in the middle."""
    places = np.array([one.place for one in errors])
    found = [summary(errors)]
    for k, axis in enumerate(_AXES):
        middle = 0.5 * float(places[:, k].min() + places[:, k].max())
        for sign, side in (("<", places[:, k] < middle), (">=", places[:, k] >= middle)):
            chosen = [one for one, inside in zip(errors, side, strict=True) if inside]
            if chosen and len(chosen) < len(errors):
                found.append(summary(chosen, f"{axis} {sign} {1e3 * middle:.0f} mm"))
    return tuple(found)
