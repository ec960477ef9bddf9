"""``PointCloud``: coloured points, for the page and for other programs."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_ik.files import write_atomically
from robot_ik.geometry import Array

_COLOURS = np.array(
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=float
)
"""Red, green and blue from the smallest to the largest value, 0 to 255. It is readable without
colour vision."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Coloured points.

    Attributes:
        points: (n, 3) world, m.
        values: (n,) the quantity that gives the colours.
        colours: (n, 3) red, green and blue, 0 to 255.
    """

    points: Array
    values: NDArray[np.float32]
    colours: NDArray[np.uint8]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the cloud as a binary PLY file, and return its path.

        Raises:
            OutputError: The file cannot be written.
        """
        kinds = [(axis, "<f4") for axis in "xyz"]
        kinds += [(colour, "u1") for colour in ("red", "green", "blue")]
        rows = np.zeros(len(self.points), dtype=[*kinds, ("value", "<f4")])
        for k, axis in enumerate("xyz"):
            rows[axis] = self.points[:, k]
        for k, colour in enumerate(("red", "green", "blue")):
            rows[colour] = self.colours[:, k]
        rows["value"] = self.values
        header = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(rows)}",
            *(f"property float {axis}" for axis in "xyz"),
            *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
            "property float value",
            "end_header\n",
        ]
        file = Path(path)
        write_atomically(file, "\n".join(header).encode() + rows.tobytes())
        return file


def coloured(
    points: Array, values: NDArray[np.float32], bounds: tuple[float, float] | None = None
) -> PointCloud:
    """Return points (n, 3) with the colours of their values (n,).

    Args:
        points: (n, 3) world, m.
        values: (n,) the quantity that gives the colours.
        bounds: Values of the first and the last colour. None for the smallest and the largest of
            the values.
    """
    finite = values[np.isfinite(values)]
    lowest, highest = bounds or (
        float(finite.min(initial=np.inf)),
        float(finite.max(initial=-np.inf)),
    )
    span = highest - lowest
    shares = (values - lowest) / span if span > 0.0 else np.ones(len(values))
    steps = np.linspace(0.0, 1.0, len(_COLOURS))
    channels = [np.interp(shares, steps, channel) for channel in _COLOURS.T]
    colours = np.rint(np.column_stack(channels)).astype(np.uint8)
    return PointCloud(points, np.asarray(values, dtype=np.float32), colours)
