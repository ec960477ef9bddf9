"""The net of a cube with a marker on each face: how the folded faces lie when the cube is laid out flat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
        turns: Quarter turns to the left of its print.
    """

    marker: int
    centre: Array
    turns: int


def unfold(poses: Mapping[int, Pose], edge: float) -> list[NetFace]:
    """Lays a cube out as a cross round its first face.

    Args:
        poses: ``pose_body_marker`` (x right, y up, z out of the print) by id; the axes of any two are
            parallel or at right angles.
        edge: Of the cube, in the unit that the net shall have.
    """
    first = next(iter(poses.values())).rotation
    x, y, z = first.T
    # Where a face with this normal goes, in edges, and the turns that bring it into the first one's plane.
    places = [(z, (0, 0), np.eye(3)), (x, (1, 0), _fold(x, z)), (-x, (-1, 0), _fold(-x, z))]
    places += [
        (y, (0, 1), _fold(y, z)),
        (-y, (0, -1), _fold(-y, z)),
        (-z, (2, 0), _fold(x, z) @ _fold(-z, x)),
    ]
    net = []
    for marker, pose in poses.items():
        normal = pose.rotation[:, 2]
        _, place, turn = max(places, key=lambda row: float(row[0] @ normal))
        right = turn @ pose.rotation[:, 0]
        angle = np.arctan2(right @ y, right @ x)
        net.append(
            NetFace(
                marker, edge * np.array([place[0], -place[1]], dtype=float), round(angle / (np.pi / 2)) % 4
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
    """The net of ``robot_ik.camera.pose.bodies.cube_body``, lengths in mm.

    Raises:
        CameraError: Not five or six different ids, or markers larger than the faces.
    """
    from robot_ik.camera.pose.bodies import cube_body

    body = cube_body(ids, size / 1e3, edge / 1e3)
    return unfold({marker: pose for marker, (_, pose) in body.markers.items()}, edge)
