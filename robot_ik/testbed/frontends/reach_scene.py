"""A reachability map in the 3D view, as a cloud or as a shell."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from robot_ik.ports import Array
from robot_ik.reachability.cloud import coloured
from robot_ik.reachability.reachability_map import ReachabilityMap
from robot_ik.testbed.frontends.actions import ReachPicture
from robot_ik.testbed.frontends.scene import BrowserScene, coloured_glb

_CELL_SHARE = 0.1
"""Size of a point of the cloud, as a share of the cell: the robot stays visible behind it."""

_NEIGHBOURS = np.array(
    [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=np.int64
)
"""(6, 3) steps to the neighbours of a cell, the normals of its faces."""

_FACE_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=float) / 2.0
"""(4, 2) corners of a face along its two axes, in cells."""


class ReachScene:
    """Draws the reachability map of the first instance.

    Args:
        server: viser's server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._handle: Any = None

    def draw(
        self, picture: ReachPicture, scene: BrowserScene, reach_map: ReachabilityMap | None
    ) -> None:
        """Show one of the pictures of a map, or none."""
        if self._handle is not None:
            self._handle.remove()
            self._handle = None
        offset = scene.arrangement.offsets[0]
        if reach_map is not None and picture == "cloud":
            cloud = reach_map.cloud()
            self._handle = self._server.scene.add_point_cloud(
                "/robot/reach_map",
                (cloud.points + offset).astype(np.float32),
                colors=cloud.colours,
                point_size=_CELL_SHARE * reach_map.grid.cell,
                point_shape="circle",
            )
        elif reach_map is not None and picture == "shell":
            forward = scene.arrangement.forward
            glb = shell_glb(reach_map, np.array((*forward, 0.0)), offset)
            if glb:
                self._handle = self._server.scene.add_glb(
                    "/robot/reach_map", glb, cast_shadow=False, receive_shadow=False
                )


def shell_glb(reach_map: ReachabilityMap, away: Array, offset: Array) -> bytes:
    """Return the surface of a map as a glTF file, cut open on the side of the camera.

    Args:
        reach_map: The map.
        away: (3,) unit vector away from the camera. Cells before the middle are left out.
        offset: (3,) added to all positions, m.

    Returns:
        The file; empty if no cell is reached.
    """
    centres, normals, values = shell_faces(reach_map, away)
    if not len(centres):
        return b""
    reached = reach_map.index[reach_map.index > 0.0]
    cloud = coloured(centres, values, (float(reached.min()), float(reached.max())))
    corners = np.empty((len(centres), 4, 3))
    for axis in range(3):
        on_axis = normals[:, axis] != 0
        # The order of the corners makes their faces look along the normal.
        square = np.zeros((4, 3))
        square[:, (axis + 1) % 3] = _FACE_CORNERS[:, 0]
        square[:, (axis + 2) % 3] = _FACE_CORNERS[:, 1]
        for sign in (1, -1):
            chosen = on_axis & (normals[:, axis] == sign)
            corners[chosen] = centres[chosen, None] + reach_map.grid.cell * square[::sign]
    vertices = (corners.reshape(-1, 3) + offset).astype(np.float32)
    colours = np.repeat(cloud.colours, 4, axis=0)
    opaque = np.full((len(colours), 1), 255, np.uint8)
    quads = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 4)
    faces = np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    directions = np.repeat(normals, 4, axis=0).astype(np.float32)
    return coloured_glb(vertices, directions, np.hstack([colours, opaque]), faces)


def shell_faces(
    reach_map: ReachabilityMap, away: Array
) -> tuple[Array, NDArray[np.int64], NDArray[np.float32]]:
    """Return the outer faces of the reached cells behind the middle of the map.

    Args:
        reach_map: The map.
        away: (3,) unit vector away from the camera.

    Returns:
        Centres (n, 3) of the faces, world, m; their normals (n, 3) outwards; the index (n,) of
        their cells.
    """
    grid = reach_map.grid
    index = reach_map.index
    shape = np.array(grid.shape)
    cells = np.argwhere(index > 0.0)
    centres = np.array(grid.corner) + grid.cell * (cells + 0.5)
    middle = np.array(grid.corner) + 0.5 * grid.cell * shape
    kept = (centres - middle) @ away >= 0.0
    is_shown = np.zeros(grid.shape, dtype=bool)
    is_shown[tuple(cells[kept].T)] = True
    shown = np.argwhere(is_shown)
    padded = np.pad(is_shown, 1)
    parts = []
    for normal in _NEIGHBOURS:
        is_outer = shown[~padded[tuple((shown + 1 + normal).T)]]
        places = np.array(grid.corner) + grid.cell * (is_outer + 0.5 + 0.5 * normal)
        parts.append((places, np.tile(normal, (len(is_outer), 1)), index[tuple(is_outer.T)]))
    positions, normals, values = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return positions, normals, values
