"""``Grid``: the poses of a reachability map, cells in space times orientations."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robot_ik.errors import OptionError
from robot_ik.geometry import INTEGER, Array, axis_rotations, is_real, rotation_z_to

BLOCK = 8
"""Cells along each edge of a block. A block is one task and one chunk of the file."""

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""rad. Turn between neighbours of the spiral of directions."""

MAX_DIRECTIONS = 10_000
"""Largest number of directions of the approach axis."""

MAX_ROLLS = 360
"""Largest number of rolls about the approach axis."""

MAX_POSES = 4_000_000_000
"""Largest number of poses of a map. The two tables of bytes of a larger map need more than 8 GB."""


def require_count(name: str, value: object, largest: int) -> None:
    """Raise ``OptionError`` unless a value is a whole number from 1 to ``largest``."""
    if not isinstance(value, INTEGER) or not 1 <= value <= largest:
        raise OptionError(name, f"{value!r}", f"a whole number from 1 to {largest}")


@dataclass(frozen=True)
class Grid:
    """Cells in space times orientations of the frame.

    Attributes:
        cell: Edge length of a cell, m.
        corner: Lowest corner of the first cell, world, m.
        shape: Number of cells along x, y and z.
        directions: Number of directions of the frame's z axis.
        rolls: Number of turns of the frame about each direction.
    """

    cell: float
    corner: tuple[float, float, float]
    shape: tuple[int, int, int]
    directions: int
    rolls: int

    @classmethod
    def around(cls, center: Array, radius: float, cell: float, directions: int, rolls: int) -> Grid:
        """Return the grid of the cells that overlap a ball. Corners are multiples of ``cell``.

        Raises:
            OptionError: A number out of its range, or a map that is too large.
        """
        if not is_real(cell, 1e-3, radius):
            raise OptionError("cell", f"{cell!r}", f"0.001 to {radius:.3g} m, the reach of the arm")
        require_count("directions", directions, MAX_DIRECTIONS)
        require_count("rolls", rolls, MAX_ROLLS)
        first = np.floor((center - radius) / cell).astype(int)
        end = np.ceil((center + radius) / cell).astype(int)
        shape = [int(n) for n in end - first]
        if math.prod(shape) * directions * rolls > MAX_POSES:
            raise OptionError(
                "cell",
                f"{cell!r} m with {directions} directions and {rolls} rolls: "
                f"{math.prod(shape) * directions * rolls:.2g} poses",
                f"at most {MAX_POSES:.2g} poses",
                hint="take larger cells or fewer orientations",
            )
        corner = [float(k * cell) for k in first]
        return cls(
            float(cell),
            (corner[0], corner[1], corner[2]),
            (shape[0], shape[1], shape[2]),
            int(directions),
            int(rolls),
        )

    @property
    def orientations(self) -> int:
        """Number of orientations: direction · rolls + roll."""
        return self.directions * self.rolls

    @property
    def poses(self) -> int:
        """Number of poses of all cells."""
        return math.prod(self.shape) * self.orientations

    @cached_property
    def axes(self) -> Array:
        """(directions, 3) unit directions of the frame's z axis, on a Fibonacci spiral."""
        k = np.arange(self.directions)
        z = 1.0 - (2.0 * k + 1.0) / self.directions
        radius = np.sqrt(1.0 - z * z)
        turn = GOLDEN_ANGLE * k
        return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])

    @cached_property
    def rotations(self) -> Array:
        """(orientations, 3, 3) rotation matrices of the frame."""
        turns = axis_rotations("z", 2.0 * math.pi * np.arange(self.rolls) / self.rolls)
        to_axes = np.array([rotation_z_to(axis) for axis in self.axes])
        return np.asarray((to_axes[:, None] @ turns[None]).reshape(-1, 3, 3))

    def centers(self, axis: int) -> Array:
        """Return the coordinate of the centres of the cells along one axis, m."""
        return np.asarray(self.corner[axis] + self.cell * (np.arange(self.shape[axis]) + 0.5))

    def cell_of(self, positions: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """Return the indices (n, 3) of the cells of positions (n, 3); they may be outside."""
        return np.floor((positions - np.array(self.corner)) / self.cell).astype(np.int64)

    def orientation_of(self, rotations: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Return the index (n,) of the orientation nearest to each rotation matrix (n, 3, 3)."""
        # The trace of Rᵀ S grows as the angle between R and S falls.
        traces = rotations.reshape(-1, 9) @ self.rotations.reshape(-1, 9).T
        return np.asarray(traces.argmax(axis=1))

    @cached_property
    def blocks(self) -> tuple[tuple[slice, slice, slice], ...]:
        """The cells of each block, as slices of the three axes."""
        parts = [
            [slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
            for count in self.shape
        ]
        return tuple(itertools.product(*parts))

    def block_positions(self, block: int) -> Array:
        """Return the centres (n, 3) of the cells of a block, x slowest."""
        x, y, z = (self.centers(axis)[part] for axis, part in enumerate(self.blocks[block]))
        return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
