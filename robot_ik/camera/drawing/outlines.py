"""Outlines of a drawn model: silhouettes and sharp edges, without the hidden ones."""

from __future__ import annotations

import cv2
import numpy as np

from robot_ik.camera.drawing.faces import Faces
from robot_ik.camera.drawing.painter import SurfaceBuffer
from robot_ik.ports import Array

# Lines may lie this part of their distance behind the surface they belong to.
_DEPTH_SLACK = 0.01
# Distance of the points along a line whose visibility is tested, px.
_STEP = 2.0
# Largest number of pieces of one line.
_MOST_PIECES = 1000


def visible_lines(faces: Faces, buffer: SurfaceBuffer) -> Array:
    """Return silhouettes of each geom and sharp edges, (n, 2, 2) pixels, where they are visible.

    Args:
        faces: Of the model.
        buffer: Filled with the faces and with all surfaces that may hide their edges.
    """
    mesh = faces.mesh
    corners = faces.pixels[mesh.faces]
    across = corners[:, 2] - corners[:, 0]
    along = corners[:, 3] - corners[:, 1]
    front = across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0] < 0.0
    facing = front[mesh.edge_faces]
    wanted = (facing[:, 0] != facing[:, 1]) | (mesh.crease & facing[:, 0])
    ends = faces.pixels[mesh.edges]
    x0, y0, x1, y1 = buffer.box
    near = (ends.max(axis=1) > (x0, y0)).all(axis=1) & (ends.min(axis=1) < (x1, y1)).all(axis=1)
    edges = mesh.edges[wanted & near & faces.within[mesh.edges].all(axis=1)]
    if not len(edges):
        return np.zeros((0, 2, 2))

    # Cut every edge into pieces whose middles are tested.
    a = faces.pixels[edges[:, 0]]
    b = faces.pixels[edges[:, 1]]
    pieces = np.maximum(1, np.ceil(np.hypot(*(b - a).T) / _STEP)).astype(int)
    pieces = np.minimum(pieces, _MOST_PIECES)
    edge = np.repeat(np.arange(len(edges)), pieces)
    start = (np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[edge]
    step = 1.0 / pieces[edge]
    direction = (b - a)[edge]
    middle = start + 0.5 * step
    pixels = a[edge] + direction * middle[:, None]
    inverse = faces.inverse[edges]
    depths = inverse[edge, 0] + (inverse[edge, 1] - inverse[edge, 0]) * middle

    # A point on an outline is visible if one of the pixels around it does not hide it.
    nearest = buffer.depth[:: buffer.samples, :: buffer.samples]
    farthest = cv2.erode(np.pad(nearest, 2, constant_values=np.inf), np.ones((3, 3)))
    column, row = (np.floor(pixels + 0.5).astype(int) - (x0, y0)).T + 2
    column = np.clip(column, 0, farthest.shape[1] - 1)
    row = np.clip(row, 0, farthest.shape[0] - 1)
    visible = farthest[row, column] <= depths * (1.0 + _DEPTH_SLACK)
    first = a[edge] + direction * start[:, None]
    last = a[edge] + direction * (start + step)[:, None]
    return np.stack([first[visible], last[visible]], axis=1)
