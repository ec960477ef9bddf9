"""The sheet of the cube: the folded net is the body that is tracked."""

from __future__ import annotations

import re
from itertools import pairwise

import cv2
import numpy as np
import pytest

from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.sheets.cube_net import cube_paper
from robot_ik.camera.sheets.page import pdf_bytes
from robot_ik.camera.sheets.sheets import SheetRequest, body_of, make_sheet_page
from robot_ik.camera.targets import marker_points
from tests.camera.sheets.printing import printed

DPI = 150.0
EDGE = 50.0
#: Faces on the net: front, right, back, left, top, bottom; x right, y down.
PLACES = ((0, 0), (1, 0), (2, 0), (-1, 0), (0, -1), (0, 1))


def found(sheet: SheetRequest) -> dict[int, np.ndarray]:
    """Return the corners (4, 2) of each marker by id, mm on the paper, by a detector."""
    image = printed(make_sheet_page(sheet), DPI)
    return {
        m.id: (m.corners + 0.5) * 25.4 / DPI for m in MarkerDetector("DICT_5X5_50").detect(image)
    }


def folded_at(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of paper after a fold of 90 degrees along a line, away from the reader.

    x right, y down, z towards the reader. The paper to the right of the line is folded. The
    direction to the right of a direction (x, y) is (-y, x).
    """
    direction = (end - start) / np.linalg.norm(end - start)
    right = np.array([-direction[1], direction[0], 0.0])
    offset = points - start
    # "Right" becomes "away from the reader", and "towards the reader" becomes "right".
    return np.asarray(
        start
        + np.outer(offset @ direction, direction)
        - np.outer(offset @ right, [0, 0, 1.0])
        + np.outer(offset[:, 2], right)
    )


def folded(points: np.ndarray, position: tuple[int, int], edge: float) -> np.ndarray:
    """Return points (n, 3) of a face after folding, relative to the centre of the cube."""
    e = edge / 2
    right = np.array([[e, e, 0], [e, -e, 0]])
    beyond = np.array([[3 * e, e, 0], [3 * e, -e, 0]])
    left, top, bottom = np.array(
        [[[-e, -e, 0], [-e, e, 0]], [[e, -e, 0], [-e, -e, 0]], [[-e, e, 0], [e, e, 0]]]
    )
    ways = {
        (1, 0): [right],
        (2, 0): [beyond, right],
        (-1, 0): [left],
        (0, -1): [top],
        (0, 1): [bottom],
    }
    for start, end in ways.get(position, []):
        points = folded_at(points, start, end)
    return points + np.array([0, 0, e])


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Return the area of the intersection of two convex polygons."""
    return float(cv2.intersectConvexConvex(a.astype(np.float32), b.astype(np.float32))[0])


@pytest.mark.parametrize("ids", [(20, 21, 22, 23, 24, 25), (7, 3, 11)])
def test_the_folded_sheet_is_the_body_that_is_tracked(ids: tuple[int, ...]) -> None:
    """The test folds along the lines of the net, with the markers where a detector finds them."""
    sheet = SheetRequest("cube", id=ids)
    corners = found(sheet)
    middle = corners[ids[0]].mean(axis=0)
    assert set(corners) == set(ids)
    for marker, (size, pose) in body_of(sheet).markers.items():
        flat = corners[marker] - middle
        x, y = np.rint(flat.mean(axis=0) / EDGE).astype(int)
        cube = folded(np.column_stack([flat, np.zeros(4)]), (x, y), EDGE)
        assert cube * [1, -1, 1] / 1e3 == pytest.approx(
            pose.apply(marker_points(size)), abs=4e-4
        ), marker


@pytest.mark.parametrize("edge", [25.0, 70.0])
def test_tabs_connect_the_faces_of_the_cube_without_overlap(edge: float) -> None:
    (cuts, folds, every) = cube_paper(edge)
    e = edge / 2
    assert len(every) == 7 and len(folds) == 12
    square = np.array([[-e, -e], [e, -e], [e, e], [-e, e]])
    faces = {position: square + edge * np.array(position) for position in PLACES}
    glued: dict[tuple[int, int], list[np.ndarray]] = {}
    for k, tab in enumerate(every):
        # Flat: outside all faces, so outside the white of every marker, and outside all other tabs.
        assert all(overlap(tab, face) < 1e-3 for face in faces.values())
        assert all(overlap(tab, other) < 1e-3 for other in every[:k])
        ends = tab[[0, 3]]
        (position,) = [
            position
            for position, face in faces.items()
            if all(np.linalg.norm(face - end, axis=1).min() < 1e-9 for end in ends)
        ]
        start, end = np.column_stack([ends, np.zeros(2)])
        way = end - start
        out = tab[1] - tab[0]
        if way[0] * out[1] - way[1] * out[0] < 0:  # the tab is to the left
            start, end = end, start
        cube = folded(folded_at(np.column_stack([tab, np.zeros(4)]), start, end), position, edge)
        # Folded: in the plane of one side, inside it, apart from the other tabs there.
        (axis,) = [a for a in range(3) if np.ptp(cube[:, a]) < 1e-9]
        assert abs(cube[0, axis]) == pytest.approx(e) and np.abs(cube).max() < e + 1e-9
        there = glued.setdefault((axis, int(np.sign(cube[0, axis]))), [])
        lies = np.delete(cube, axis, axis=1)
        assert all(overlap(lies, other) < 1e-3 for other in there)
        there.append(lies)
    assert sorted(len(tabs) for tabs in glued.values()) == [2, 2, 3]
    # Each of the seven tabs lies behind a seam: a cut that is no rim of a tab.
    rims = {tuple(np.ravel([a, b]).round(6)) for tab in every for a, b in pairwise(tab)}
    seams = {tuple(cut.round(6)) for cut in cuts} - rims
    assert len(seams) == 7


def test_the_lines_are_in_the_pdf_at_true_scale() -> None:
    sheet = SheetRequest("cube")
    text = pdf_bytes(make_sheet_page(sheet)).decode("latin-1")
    strokes = re.findall(r"^([\d.]+) ([\d.]+) m ([\d.]+) ([\d.]+) l S$", text, re.MULTILINE)
    drawn = np.array(strokes, dtype=float)
    cuts = cube_paper(EDGE)[0] + np.tile(found(sheet)[0].mean(axis=0), 2)
    assert all(np.abs(drawn - cut).max(axis=1).min() < 0.05 for cut in cuts)
    lengths = np.linalg.norm(drawn[:, 2:] - drawn[:, :2], axis=1)
    assert (lengths < 2.5).sum() == len(drawn) - len(cuts)  # the rest are dashes


def test_a_cube_is_printed_as_the_body_that_is_tracked() -> None:
    sheet = SheetRequest("cube", id=(20, 21, 22, 23, 24, 25))
    # Front in the middle, its neighbours around it, the back to the right; all prints upright.
    net_positions = {20: (0, 0), 21: (1, 0), 22: (2, 0), 23: (-1, 0), 24: (0, -1), 25: (0, 1)}
    corners = found(sheet)
    middle = corners[20].mean(axis=0)
    for marker, corner in corners.items():
        assert (corner.mean(axis=0) - middle) / 50.0 == pytest.approx(
            net_positions[marker], abs=0.01
        )
        across = corner[1] - corner[0]
        assert across[0] > 0 and abs(across[1]) < 0.01 * across[0], "upright"
    assert set(corners) == set(net_positions)
