"""Convex hulls of points on the floor: the area that supports a figure."""

from __future__ import annotations

import numpy as np

from robot_ik.ports import Array

_PARALLEL = 1e-12
"""Smallest cross product of two edges that turn, m². Smaller ones are in line."""

_INSET_ROUNDS = 20
"""Largest number of edges that move a point inside a hull."""

_INSET_ERROR = 1e-6
"""Metres. A smaller violation of the margin is accepted."""


def hull(points: Array) -> Array:
    """Return the corners (h, 2) of the convex hull of points (n, 2), counter-clockwise.

    The method is Andrew's monotone chain.
    """
    ordered = sorted(set(map(tuple, points.tolist())))
    if len(ordered) < 3:
        return np.array(ordered).reshape(-1, 2)
    return np.array(_half_hull(ordered) + _half_hull(ordered[::-1]))


def _half_hull(ordered: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Return the lower or the upper half of a hull without its last corner."""
    corners: list[tuple[float, ...]] = []
    for x, y in ordered:
        while len(corners) > 1:
            ax, ay = corners[-2]
            bx, by = corners[-1]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > _PARALLEL:
                break
            corners.pop()
        corners.append((x, y))
    return corners[:-1]


def hull_edges(corners: Array) -> tuple[Array, Array]:
    """Return the edges of a hull as inward normals (h, 2) and offsets (h,).

    A point p is inside where ``normal @ p >= offset``.
    """
    edges = np.concatenate([corners[1:], corners[:1]]) - corners
    lengths = np.linalg.norm(edges, axis=1)
    normal = np.column_stack([-edges[:, 1], edges[:, 0]]) / lengths[:, None]
    return normal, (normal * corners).sum(axis=1)


def hull_margin(points: Array, z: Array) -> float:
    """Return the distance of z (2,) to the border of the hull of points (n, 2).

    It is positive inside and negative outside.
    """
    corners = hull(points)
    if len(corners) == 1:
        return -float(np.linalg.norm(z - corners[0]))
    edges = np.concatenate([corners[1:], corners[:1]]) - corners
    offsets = z - corners
    shares = np.clip((offsets * edges).sum(1) / (edges * edges).sum(1), 0.0, 1.0)
    distance = float(np.sqrt(((offsets - shares[:, None] * edges) ** 2).sum(1).min()))
    turns = edges[:, 0] * offsets[:, 1] - edges[:, 1] * offsets[:, 0]
    is_inside = len(corners) > 2 and bool((turns >= 0).all())
    return distance if is_inside else -distance


def inset(normal: Array, offset: Array, point: Array, margin: float) -> Array:
    """Return a point (2,), moved until it is ``margin`` inside all edges of a hull.

    Args:
        normal: (h, 2) inward normals of the edges.
        offset: (h,) offsets of the edges, as ``hull_edges`` returns them.
        point: (2,) the point.
        margin: Smallest distance from every edge, m.
    """
    for _ in range(_INSET_ROUNDS):
        violations = margin + offset - normal @ point
        worst = int(violations.argmax())
        if violations[worst] <= _INSET_ERROR:
            break
        point = point + violations[worst] * normal[worst]
    return np.asarray(point)
