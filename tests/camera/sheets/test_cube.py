"""The cube's sheet: cut out, folded and glued by numbers, it is the body that is tracked."""

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

DPI, EDGE = 150.0, 50.0
#: Faces on the net: front, right, back, left, top, bottom; x right, y down.
PLACES = ((0, 0), (1, 0), (2, 0), (-1, 0), (0, -1), (0, 1))


def found(sheet: SheetRequest) -> dict[int, np.ndarray]:
    """Id -> corners (4, 2) in mm of paper, by a detector."""
    image = printed(make_sheet_page(sheet), DPI)
    return {m.id: (m.corners + 0.5) * 25.4 / DPI for m in MarkerDetector("DICT_5X5_50").detect(image)}


def folded_at(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Paper (n, 3) folded back by a right angle along a line; what is to the right of the way is folded.

    x right, y down, z towards the reader, so "right of the way" is (-y, x) of the way.
    """
    way = (end - start) / np.linalg.norm(end - start)
    right = np.array([-way[1], way[0], 0.0])
    off = points - start
    # what pointed to the right now points away from the reader, what pointed at him points to the right
    return np.asarray(
        start + np.outer(off @ way, way) - np.outer(off @ right, [0, 0, 1.0]) + np.outer(off[:, 2], right)
    )


def folded(points: np.ndarray, position: tuple[int, int], edge: float) -> np.ndarray:
    """Points (n, 3) of the face at this place, from the middle of the cube; the front face stays."""
    e = edge / 2
    right = np.array([[e, e, 0], [e, -e, 0]])
    beyond = np.array([[3 * e, e, 0], [3 * e, -e, 0]])
    left, top, bottom = np.array(
        [[[-e, -e, 0], [-e, e, 0]], [[e, -e, 0], [-e, -e, 0]], [[-e, e, 0], [e, e, 0]]]
    )
    ways = {(1, 0): [right], (2, 0): [beyond, right], (-1, 0): [left], (0, -1): [top], (0, 1): [bottom]}
    for start, end in ways.get(position, []):
        points = folded_at(points, start, end)
    return points + np.array([0, 0, e])


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Area that two convex polygons share."""
    return float(cv2.intersectConvexConvex(a.astype(np.float32), b.astype(np.float32))[0])


@pytest.mark.parametrize("ids", [(20, 21, 22, 23, 24, 25), (7, 3, 11)])
def test_the_folded_sheet_is_the_body_that_is_tracked(ids: tuple[int, ...]) -> None:
    """Folded here along the net's lines alone, with the markers where a detector sees them."""
    sheet = SheetRequest("cube", ids=ids)
    corners = found(sheet)
    middle = corners[ids[0]].mean(axis=0)
    assert set(corners) == set(ids)
    for marker, (size, pose) in body_of(sheet).markers.items():
        flat = corners[marker] - middle
        x, y = np.rint(flat.mean(axis=0) / EDGE).astype(int)
        cube = folded(np.column_stack([flat, np.zeros(4)]), (x, y), EDGE)
        assert cube * [1, -1, 1] / 1e3 == pytest.approx(pose.apply(marker_points(size)), abs=4e-4), marker


@pytest.mark.parametrize("edge", [25.0, 70.0])
def test_tabs_hold_the_cube_and_are_in_nobodys_way(edge: float) -> None:
    (cuts, folds, every), e = cube_paper(edge), edge / 2
    assert len(every) == 7 and len(folds) == 12
    square = np.array([[-e, -e], [e, -e], [e, e], [-e, e]])
    faces = {position: square + edge * np.array(position) for position in PLACES}
    glued: dict[tuple[int, int], list[np.ndarray]] = {}
    for k, tab in enumerate(every):
        # flat: beside all faces, so beside the white of every marker, and beside all other tabs
        assert all(overlap(tab, face) < 1e-3 for face in faces.values())
        assert all(overlap(tab, other) < 1e-3 for other in every[:k])
        ends = tab[[0, 3]]
        (position,) = [
            position for position, face in faces.items()
            if all(np.linalg.norm(face - end, axis=1).min() < 1e-9 for end in ends)
        ]  # fmt: skip
        start, end = np.column_stack([ends, np.zeros(2)])
        way, out = end - start, tab[1] - tab[0]
        if way[0] * out[1] - way[1] * out[0] < 0:  # the tab is to the left
            start, end = end, start
        cube = folded(folded_at(np.column_stack([tab, np.zeros(4)]), start, end), position, edge)
        # folded: in the plane of one of the six sides, inside it, apart from the other tabs there
        (axis,) = [a for a in range(3) if np.ptp(cube[:, a]) < 1e-9]
        assert abs(cube[0, axis]) == pytest.approx(e) and np.abs(cube).max() < e + 1e-9
        there = glued.setdefault((axis, int(np.sign(cube[0, axis]))), [])
        lies = np.delete(cube, axis, axis=1)
        assert all(overlap(lies, other) < 1e-3 for other in there)
        there.append(lies)
    assert sorted(len(tabs) for tabs in glued.values()) == [2, 2, 3]
    # each of the seven tabs has a seam to lie behind: a cut that is no rim of a tab
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
    sheet = SheetRequest("cube", ids=(20, 21, 22, 23, 24, 25))
    # Front in the middle, its neighbours round it, the back beyond the right side; all prints upright.
    net_positions = {20: (0, 0), 21: (1, 0), 22: (2, 0), 23: (-1, 0), 24: (0, -1), 25: (0, 1)}
    corners = found(sheet)
    middle = corners[20].mean(axis=0)
    for marker, corner in corners.items():
        assert (corner.mean(axis=0) - middle) / 50.0 == pytest.approx(net_positions[marker], abs=0.01)
        across = corner[1] - corner[0]
        assert across[0] > 0 and abs(across[1]) < 0.01 * across[0], "upright"
    assert set(corners) == set(net_positions)
