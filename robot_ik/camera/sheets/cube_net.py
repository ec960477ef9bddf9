"""The net of a cube: lines to cut and to fold, and tabs to glue."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from robot_ik.ports import Array

Step = tuple[int, int]

#: Middles of the six faces of ``marker_cube``, in edges, y down: front, right, back, left, top,
#: bottom. All prints stand upright.
FACES: tuple[Step, ...] = ((0, 0), (1, 0), (2, 0), (-1, 0), (0, -1), (0, 1))

# Sides with a tab: face, and direction to the side. Each is glued behind a side without a tab.
_TABBED: tuple[tuple[Step, Step], ...] = (
    ((0, -1), (1, 0)),
    ((0, -1), (-1, 0)),
    ((0, -1), (0, -1)),
    ((0, 1), (1, 0)),
    ((0, 1), (-1, 0)),
    ((0, 1), (0, 1)),
    ((-1, 0), (-1, 0)),
)
# Depth of a tab, in edges, and its largest depth, mm.
_TAB = 0.2
_DEEPEST_TAB = 10.0
# A dash and the gap after it, mm.
_DASH = 2.0
_GAP = 1.5


def cube_paper(edge: float) -> tuple[Array, Array, Array]:
    """Return the net of a cube with tabs that hold it together.

    Args:
        edge: Of the cube, mm.

    Returns:
        Lines (n, 4) from x, y to x, y to cut along; lines (12, 4) to fold along, between two faces
        or a face and its tab; corners (7, 4, 2) of the tabs, the first and the last on the face.
        In mm, x right, y down, from the middle of the first face.
    """
    depth = min(_TAB * edge, _DEEPEST_TAB)
    cuts: list[list[Array]] = []
    folds: list[list[Array]] = []
    tabs: list[list[Array]] = []
    for face in FACES:
        for direction in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            start, end = _side(face, direction, edge)
            if (face, direction) in _TABBED:
                along = (end - start) / edge
                out = np.array(direction, dtype=float)
                # The ends are cut back at 45 degrees, so that two tabs in a corner do not meet.
                tab = [start, start + depth * (along + out), end + depth * (out - along), end]
                tabs.append(tab)
                folds.append([start, end])
                cuts += [[a, b] for a, b in pairwise(tab)]
            elif (face[0] + direction[0], face[1] + direction[1]) not in FACES:
                cuts.append([start, end])
            elif direction in ((1, 0), (0, 1)):
                # Two faces share a fold. It is drawn once.
                folds.append([start, end])
    return np.array(cuts).reshape(-1, 4), np.array(folds).reshape(-1, 4), np.array(tabs)


def dashed(lines: Array) -> Array:
    """Return the dashes (m, 4) of lines (n, 4), mm. Each line begins and ends with half a dash."""
    dashes = []
    part = _DASH / (_DASH + _GAP)
    for line in np.asarray(lines, dtype=float):
        start = line[:2]
        end = line[2:]
        length = float(np.linalg.norm(end - start))
        count = max(1, round(length / (_DASH + _GAP)))
        at = (np.arange(count + 1)[:, None] + 0.5 * part * np.array([-1.0, 1.0])) / count
        for first, last in np.clip(at, 0.0, 1.0):
            dashes.append([*(start + first * (end - start)), *(start + last * (end - start))])
    return np.array(dashes)


def _side(face: Step, direction: Step, edge: float) -> tuple[Array, Array]:
    """Return the two ends (2,) of the side of a face, mm."""
    out = np.array(direction, dtype=float)
    middle = edge * (np.array(face) + 0.5 * out)
    half = 0.5 * edge * np.array([-out[1], out[0]])
    return middle - half, middle + half
