"""Outlines of a drawn robot: silhouettes and sharp edges, those left out that something hides."""

from __future__ import annotations

import numpy as np

from robot_ik.camera.drawing import scanline
from robot_ik.camera.drawing.painter import Array, Faces, Samples

# Lines may lie this part of their distance behind the surface they belong to.
_LINE_SLACK = 0.01
# Points along a line at which it is asked whether something hides it, pixels.
_LINE_STEP, _LINE_PIECES = 2.0, 1000


def visible_lines(faces: Faces, samples: Samples) -> Array:
    """Silhouettes of each geom and sharp edges, (n, 2, 2) pixels, where nothing in ``samples`` hides them."""
    mesh = faces.mesh
    corners = faces.pixels[mesh.faces]
    across, along = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    front = across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0] < 0.0
    facing = front[mesh.edge_faces]
    worth = (facing[:, 0] != facing[:, 1]) | (mesh.crease & facing[:, 0])
    spots = faces.pixels[mesh.edges]
    x0, y0, x1, y1 = samples.box
    near = (spots.max(axis=1) > (x0, y0)).all(axis=1) & (spots.min(axis=1) < (x1, y1)).all(axis=1)
    ends = mesh.edges[worth & near & faces.within[mesh.edges].all(axis=1)]
    if not len(ends):
        return np.zeros((0, 2, 2))
    a, b = faces.pixels[ends[:, 0]], faces.pixels[ends[:, 1]]
    pieces = np.maximum(1, np.ceil(np.hypot(*(b - a).T) / _LINE_STEP)).astype(int)
    pieces = np.minimum(pieces, _LINE_PIECES)
    edge = np.repeat(np.arange(len(ends)), pieces)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[edge]
    step = 1.0 / pieces[edge]

    def at(shares: Array, first: Array, second: Array) -> Array:
        return first[edge] + (second - first)[edge] * (shares[:, None] if first.ndim == 2 else shares)

    middle = share + 0.5 * step
    seen = np.empty(len(edge), dtype=bool)
    depths = at(middle, faces.inverse[ends[:, 0]], faces.inverse[ends[:, 1]])
    scanline.hide_lines(
        at(middle, a, b), depths, _LINE_SLACK, samples.depth[..., 0], samples.box[0], samples.box[1], seen
    )
    return np.stack([at(share, a, b)[seen], at(share + step, a, b)[seen]], axis=1)
