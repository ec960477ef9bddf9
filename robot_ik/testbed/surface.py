"""A smooth surface around the filled cells of a grid (surface nets, Gibson 1998)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array

_LEVEL = 0.5
"""Value of the smoothed grid at the surface."""

_AROUND = ((-1, -1), (0, -1), (0, 0), (-1, 0))
"""Cells around an edge of the grid, in order, along the two other axes."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed triangle mesh.

    Attributes:
        vertices: (v, 3) m.
        faces: (f, 3) indices of vertices, counter-clockwise from outside.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


def surface_of(filled: NDArray[np.bool_], origin: Array, cell: float) -> Surface:
    """Return the surface around the filled points of a grid. It has no faces if none is filled.

    Args:
        filled: (i, j, k) whether the volume holds a point of the grid.
        origin: (3,) position of the first point, m.
        cell: Distance of neighbouring points, m.
    """
    values = _smoothed(np.pad(filled.astype(float), 2))
    inside = values > _LEVEL
    shape = tuple(n - 1 for n in values.shape)
    sums = np.zeros((*shape, 3))
    counts = np.zeros(shape)
    quads = [_add_edges(axis, values, inside, sums, counts) for axis in range(3)]
    used = counts > 0.0
    number = np.full(shape, -1)
    number[used] = np.arange(np.count_nonzero(used))
    vertices = origin + cell * (sums[used] / counts[used][:, None] - 2.0)
    corners = np.concatenate(quads)
    index = number[corners[..., 0], corners[..., 1], corners[..., 2]]
    faces = np.vstack([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])
    return Surface(vertices.astype(np.float32), faces.astype(np.uint32))


def _smoothed(values: Array) -> Array:
    """Return the mean of each point and its neighbours along each axis, weighted 1, 2, 1."""
    for axis in range(3):
        values = 0.5 * values + 0.25 * (np.roll(values, 1, axis) + np.roll(values, -1, axis))
    return values


def _add_edges(
    axis: int, values: Array, inside: NDArray[np.bool_], sums: Array, counts: Array
) -> NDArray[np.int64]:
    """Add the crossings of all edges along an axis to ``sums`` and ``counts`` of their cells.

    Args:
        axis: 0, 1 or 2.
        values: (i, j, k) values of the points.
        inside: (i, j, k) whether a point is inside.
        sums: (i - 1, j - 1, k - 1, 3) sum of the crossings of a cell, in cells.
        counts: (i - 1, j - 1, k - 1) number of crossings.

    Returns:
        (n, 4, 3) cells around each crossed edge, counter-clockwise from outside.
    """
    first = np.moveaxis(inside, axis, 0)
    crossed = np.argwhere(np.moveaxis(first[:-1] != first[1:], 0, axis))
    step = np.eye(3, dtype=int)[axis]
    a = values[tuple(crossed.T)]
    b = values[tuple((crossed + step).T)]
    points = crossed + ((_LEVEL - a) / (b - a))[:, None] * step
    others = [(axis + 1) % 3, (axis + 2) % 3]
    quads = np.repeat(crossed[:, None], 4, axis=1)
    for corner, (u, v) in enumerate(_AROUND):
        quads[:, corner, others[0]] += u
        quads[:, corner, others[1]] += v
        cells = tuple(quads[:, corner].T)
        np.add.at(counts, cells, 1.0)
        np.add.at(sums, cells, points)
    is_outwards = inside[tuple(crossed.T)]  # the edge begins in the volume and ends outside
    quads[~is_outwards] = quads[~is_outwards][:, ::-1]
    return quads


def grid_around(centre: Array, radius: float, cells: int) -> tuple[Array, Array, float]:
    """Return points of a cubic grid inside a ball, the first point of the grid, and the distance.

    Args:
        centre: (3,) centre of the ball, m.
        radius: Of the ball, m.
        cells: Points along each axis.

    Returns:
        All points (cells³, 3), the origin (3,) and the distance of neighbours, m.
    """
    cell = 2.0 * radius / (cells - 1)
    origin = centre - radius
    index = np.array(list(itertools.product(range(cells), repeat=3)))
    return origin + cell * index, origin, cell
