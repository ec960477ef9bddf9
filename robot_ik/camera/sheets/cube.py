"""The net of a cube with a marker on each face: how the folded faces lie when the cube is laid out flat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class NetFace:
    """One face, laid flat.

    Attributes:
        marker: Its id.
        centre: (2,) x right, y down, from the centre of the first face, in the unit of the edge.
        quarter_turns: Quarter turns to the left of its print.
    """

    marker: int
    centre: Array
    quarter_turns: int


def unfold(poses: Mapping[int, Pose], edge: float) -> list[NetFace]:
    """Lays a cube out as a cross round its first face.

    Args:
        poses: ``pose_body_marker`` (x right, y up, z out of the print) by id; the axes of any two are
            parallel or at right angles.
        edge: Of the cube, in the unit that the net shall have.
    """
    first = next(iter(poses.values())).rotation
    x, y, z = first.T
    # Where a face with this normal goes, in edges, and its rotation into the plane of the first.
    net_positions = [(z, (0, 0), np.eye(3)), (x, (1, 0), _fold(x, z)), (-x, (-1, 0), _fold(-x, z))]
    net_positions += [
        (y, (0, 1), _fold(y, z)),
        (-y, (0, -1), _fold(-y, z)),
        (-z, (2, 0), _fold(x, z) @ _fold(-z, x)),
    ]
    net = []
    for marker, pose in poses.items():
        normal = pose.rotation[:, 2]
        _, position, rotation = max(net_positions, key=lambda row: float(row[0] @ normal))
        right = rotation @ pose.rotation[:, 0]
        angle = np.arctan2(right @ y, right @ x)
        net.append(
            NetFace(
                marker,
                edge * np.array([position[0], -position[1]], dtype=float),
                round(angle / (np.pi / 2)) % 4,
            )
        )
    return net


def _fold(towards: Array, normal: Array) -> Array:
    """Turns the neighbour over the edge in direction ``towards`` into the plane with this normal."""
    axis = np.cross(towards, normal)
    # towards -> normal, -normal -> towards, the edge stays.
    before = np.column_stack([towards, -normal, axis])
    after = np.column_stack([normal, towards, axis])
    return np.asarray(after @ before.T)


def cube_net(ids: Sequence[int], size: float, edge: float) -> list[NetFace]:
    """The net of ``robot_ik.camera.bodies.cube_body``, lengths in mm.

    Raises:
        CameraError: Not five or six different ids, or markers larger than the faces.
    """
    from robot_ik.camera.bodies import cube_body

    body = cube_body(ids, size / 1e3, edge / 1e3)
    return unfold({marker: pose for marker, (_, pose) in body.markers.items()}, edge)


# ------------------------------------------------------------------------------------- the paper

# Depth of a tab in edges, and at most, mm.
_TAB, _TAB_MOST = 0.2, 10.0
# A dash and the gap after it, mm.
_DASH, _GAP = 2.0, 1.5
# Middles of the six faces, in edges, y down: front, right, back, left, top, bottom.
_FACES = ((0, 0), (1, 0), (2, 0), (-1, 0), (0, -1), (0, 1))
# Their sides that have a tab (face, way to the side); each is glued behind a side that has none.
_TABBED = (
    ((0, -1), (1, 0)), ((0, -1), (-1, 0)), ((0, -1), (0, -1)),
    ((0, 1), (1, 0)), ((0, 1), (-1, 0)), ((0, 1), (0, 1)),
    ((-1, 0), (-1, 0)),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CubePaper:
    """What is cut and folded; x right, y down, from the centre of the first face, in the unit of the edge.

    Attributes:
        cuts: (n, 4) from x, y to x, y.
        folds: (12, 4) between the faces, and between a face and its tab.
        tabs: (7, 4, 2) corners; the first and the last are on the face.
    """

    cuts: Array
    folds: Array
    tabs: Array


def cube_paper(edge: float) -> CubePaper:
    """The outline of a cube's net with all six faces, and tabs that hold it together.

    Args:
        edge: Of the cube, mm.
    """
    depth = min(_TAB * edge, _TAB_MOST)
    cuts, folds, tabs = [], [], []
    for face in _FACES:
        for direction in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            start, end = _side(face, direction, edge)
            if (face, direction) in _TABBED:
                along = (end - start) / edge
                out = np.array(direction, dtype=float)
                # Its ends are cut back at 45 degrees: two tabs in one corner then do not meet.
                tab = [start, start + depth * (along + out), end + depth * (out - along), end]
                tabs.append(tab)
                folds.append([start, end])
                cuts += [[a, b] for a, b in pairwise(tab)]
            elif (face[0] + direction[0], face[1] + direction[1]) not in _FACES:
                cuts.append([start, end])
            elif direction in ((1, 0), (0, 1)):  # a fold has two sides
                folds.append([start, end])
    return CubePaper(
        np.array(cuts).reshape(-1, 4), np.array(folds).reshape(-1, 4), np.array(tabs, dtype=float)
    )


def _side(face: tuple[int, int], direction: tuple[int, int], edge: float) -> tuple[Array, Array]:
    """The two ends of a face's side."""
    out = np.array(direction, dtype=float)
    middle, half = edge * (np.array(face) + 0.5 * out), 0.5 * edge * np.array([-out[1], out[0]])
    return middle - half, middle + half


def dashed(lines: Array) -> Array:
    """The dashes (m, 4) of lines (n, 4) in mm; each line begins and ends with half a dash."""
    dashes = []
    for line in np.asarray(lines, dtype=float):
        start, end = line[:2], line[2:]
        length = float(np.linalg.norm(end - start))
        count = max(1, round(length / (_DASH + _GAP)))
        share = _DASH / (_DASH + _GAP)
        at = (np.arange(count + 1)[:, None] + 0.5 * share * np.array([-1.0, 1.0])) / count
        for low, high in np.clip(at, 0.0, 1.0):
            dashes.append([*(start + low * (end - start)), *(start + high * (end - start))])
    return np.array(dashes)
