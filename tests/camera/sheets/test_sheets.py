"""Printed sheets: parsed from the PDF, detected, rejected if they do not fit the page."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.patterns import PatternKind, PatternRequest
from robot_ik.camera.sheets.page import LETTER_WIDTH, pdf_bytes, write_sheet
from robot_ik.camera.sheets.sheets import (
    SheetKind,
    SheetRequest,
    body_file,
    body_of,
    make_sheet_page,
)
from robot_ik.camera.target_files import load_bodies, parse_target
from robot_ik.camera.targets import PatternTarget
from robot_ik.errors import CalibrationError, CameraError, OutputError
from tests.camera.sheets.printing import printed

DPI = 150.0


def pdf_boxes(data: bytes) -> tuple[tuple[float, float], np.ndarray]:
    """Return page size and black rectangles (n, 4), mm from the upper left corner."""
    text = data.decode("latin-1")
    box = re.search(r"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", text)
    matrix = re.search(r"([\d.]+) 0 0 -([\d.]+) 0 ([\d.]+) cm", text)
    assert box and matrix
    width, height = (float(v) * 25.4 / 72.0 for v in box.groups())
    across, down, top = map(float, matrix.groups())
    boxes = []
    ink = 0.0
    for line in text.splitlines():
        words = line.split()
        if words[1:] == ["g"]:
            ink = 1.0 - float(words[0])
        if words[4:] == ["re"] and ink == 1.0:
            x, y, w, h = map(float, words[:4])
            # The matrix of the PDF gives points, 72 an inch.
            left = across * x
            upper = float(box.group(2)) - (top - down * y)
            boxes.append(np.array([left, upper, across * w, down * h]) * 25.4 / 72.0)
    return (width, height), np.array(boxes)


def found(page_image: np.ndarray, dictionary: str = "DICT_5X5_50") -> dict[int, np.ndarray]:
    """Return the corners (4, 2) of each marker by id, mm on the paper."""
    detector = MarkerDetector(dictionary)
    return {m.id: (m.corners + 0.5) * 25.4 / DPI for m in detector.detect(page_image)}


@pytest.mark.parametrize("page", ["a4", "letter"])
@pytest.mark.parametrize("kind", ["marker", "board", "charuco", "chessboard"])
def test_sizes_in_the_pdf_are_right_to_a_hundredth_of_a_millimetre(
    kind: SheetKind, page: str
) -> None:
    request = SheetRequest(kind, id=(3, 4) if kind == "marker" else (), page=page)
    sheet = make_sheet_page(request)
    data = pdf_bytes(sheet)
    size, boxes = pdf_boxes(data)
    papers = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
    assert sorted(size) == pytest.approx(papers[page], abs=1e-3)
    assert b"/PrintScaling /None" in data
    rim = boxes[:, :2].min(), (np.array(size) - boxes[:, :2] - boxes[:, 2:]).min()
    assert min(rim) > 5.0, "no printer reaches the rim"
    # Only the two bars are 100 mm long.
    bars = boxes[np.isclose(boxes[:, 2:].max(axis=1), 100.0, atol=1e-3)]
    assert len(bars) == 2 and set(bars[:, 2:].argmax(axis=1)) == {0, 1}
    cells = boxes[boxes[:, 2:].min(axis=1) > 1.0]
    if kind in ("marker", "board"):
        assert cells[:, 2:] == pytest.approx(np.full((len(cells), 2), 50.0 / 7.0), abs=0.01)
        first = cells[np.lexsort((cells[:, 0], cells[:, 1]))][0]
        side = cells[np.abs(cells[:, 1] - first[1]) < 0.01]
        # The upper row of a marker is black: 7 cells without a gap.
        assert side[:, 0].max() + side[0, 2] - first[0] == pytest.approx(
            50.0 if len(side) == 7 else 50.0 + request.gap + 50.0, abs=0.01
        )
    else:
        square = request.size
        squares = cells[np.isclose(cells[:, 2], square, atol=0.01)]
        assert len(squares) == (24 if kind == "charuco" else 35)
        steps = np.diff(np.unique(squares[:, 0].round(3)))
        assert steps == pytest.approx(np.full(len(steps), square), abs=0.01)


def test_the_print_is_found_by_the_detector_at_the_right_size() -> None:
    request = SheetRequest("board", size_mm=42.0, columns=3, rows=2, id=(10,), gap_mm=11.0)
    corners = found(printed(make_sheet_page(request), DPI))
    assert set(corners) == {10, 11, 12, 13, 14, 15}
    centres = {k: c.mean(axis=0) for k, c in corners.items()}
    for corner in corners.values():
        sides = np.linalg.norm(np.roll(corner, -1, axis=0) - corner, axis=1)
        # The detector's integer corners are half a pixel inside, here 0.17 mm.
        assert sides == pytest.approx(np.full(4, 42.0), abs=0.3)
    # The markers are at their places on the body. Pictures have y down.
    body = body_of(request)
    middle = np.mean(list(centres.values()), axis=0)
    for marker, (size, pose) in body.markers.items():
        assert size == pytest.approx(0.042)
        expected = (centres[marker] - middle) * [1, -1] / 1e3
        assert expected == pytest.approx(pose.position[:2], abs=2e-4)


def test_a_cell_border_is_at_its_exact_position_in_the_print() -> None:
    """Accurate to 0.1 mm, by the grey values of the pixels on an edge."""
    request = SheetRequest("marker", size_mm=50.0)
    sheet = make_sheet_page(request)
    image = printed(sheet, DPI).astype(float)
    cells = sheet.boxes[np.isclose(sheet.boxes[:, 2], 50.0 / 7.0)]
    left, top = cells[:, :2].min(axis=0)
    row = image[round((top + 3.0) / 25.4 * DPI)]
    span = slice(round((left - 5.0) / 25.4 * DPI), round((left + 55.0) / 25.4 * DPI))
    ink = (255.0 - row[span]).sum() / 255.0 * 25.4 / DPI
    assert ink == pytest.approx(50.0, abs=0.02)


def test_a_printed_pattern_is_what_the_calibration_looks_for() -> None:
    for kind in ("charuco", "chessboard"):
        pattern = PatternRequest(kind).pattern()
        seen = pattern.find(printed(make_sheet_page(SheetRequest(kind)), 75.0))
        assert seen is not None and len(seen.ids) == pattern.corners[0] * pattern.corners[1]
        scale = np.ptp(seen.pixels[:, 0]) * 25.4 / 75.0 / np.ptp(seen.points_board[:, 0])
        assert scale == pytest.approx(1000.0, rel=1e-3)


def test_the_sheet_contains_its_command_and_its_name() -> None:
    text = " ".join(
        w.text for w in make_sheet_page(SheetRequest("charuco", size_mm=25.0, columns=9)).labels
    )
    for words in (
        "9x6 squares",
        "25 mm",
        "DICT_5X5_50",
        "print charuco --size-mm 25 --columns 9",
        "100.0 mm",
    ):
        assert words in text
    assert (
        "camera calibrate 0 --pattern charuco --columns 9 --rows 6 --square-mm 25 --marker-mm 18"
        in text
    )
    labels = [
        w.text for w in make_sheet_page(SheetRequest("marker", id=(4, 9), size_mm=33.5)).labels
    ]
    assert "4  33.5 mm" in labels and "9  33.5 mm" in labels


@pytest.mark.parametrize(
    "asked",
    [
        SheetRequest("board", 36.0, 3, 2),
        SheetRequest("charuco", 22.0, 7, 6),
        SheetRequest("chessboard", 18.0, 7, 5),
    ],
)
def test_the_sheet_contains_the_argument_for_other_commands(asked: SheetRequest) -> None:
    page = make_sheet_page(asked)
    (text,) = [w.text for w in page.labels if "--board" in w.text]
    board = parse_target(text.split("--board ")[1], asked.dictionary)
    if isinstance(board, PatternTarget):
        kind: PatternKind = "charuco" if asked.kind == "charuco" else "chessboard"
        true = PatternRequest(kind, asked.columns, asked.rows, asked.size).pattern()
        assert type(board.pattern) is type(true) and board.pattern.corners == true.corners
        assert board.pattern.black() == pytest.approx(true.black())
    else:
        markers = body_of(asked).markers
        assert list(board.squares) == list(markers)
        for marker, (size, pose) in markers.items():
            assert board.squares[marker][0] == pytest.approx(size)
            assert max(board.squares[marker][1].distance(pose)) < 1e-9
    assert all(w.x + LETTER_WIDTH * w.size * len(w.text) < page.width - 6.9 for w in page.labels)


@pytest.mark.parametrize("asked", [SheetRequest("board", columns=3, id=(5,)), SheetRequest("cube")])
def test_the_body_file_is_read_back(asked: SheetRequest, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(body_file(asked, 'my "own" \\ one'))
    body = load_bodies(path)['my "own" \\ one']
    true = body_of(asked)
    assert body.dictionary == asked.dictionary
    assert list(body.markers) == list(true.markers)
    for marker, (size, pose) in true.markers.items():
        assert body.markers[marker][0] == pytest.approx(size)
        assert max(body.markers[marker][1].distance(pose)) < 1e-8


@pytest.mark.parametrize(
    ("asked", "message", "hint"),
    [
        (
            SheetRequest("charuco", size_mm=40.0),
            "needs 320x240 mm; a4 has room for",
            "--size-mm 30 fits",
        ),
        (SheetRequest("board", columns=4, rows=4, size_mm=52.0), "needs 264x264 mm", "--page a3"),
        (
            SheetRequest("marker", id=tuple(range(20)), size_mm=60.0),
            "markers 0 to 19",
            "--size-mm",
        ),
        (SheetRequest("cube", size_mm=80.0), "cube of 100 mm", "--size-mm"),
        (SheetRequest("marker", gap_mm=2.0), "gap of 2 mm is too small", "at least 8.3 mm"),
        (
            SheetRequest("marker", size_mm=0.05),
            "a marker of 0.05 mm is not possible",
            "is 50 mm meant",
        ),
        (
            SheetRequest("chessboard", size_mm=0.025),
            "a square of 0.025 mm",
            "3 to 1000 mm: is 25 mm meant",
        ),
        (
            SheetRequest("cube", size_mm=-3.0),
            "a marker of -3 mm is not possible",
            "give 3 to 1000 mm",
        ),
        (SheetRequest("charuco", marker_mm=0.02), "a marker of 0.02 mm", "is 20 mm meant"),
        (SheetRequest("chessboard", rows=0), "9x0 inner corners is too small", "at least 3x3"),
        (SheetRequest("board", columns=0), "a board of 0 x 2 markers is not possible", "1 x 1"),
        (SheetRequest("marker", id=(50,)), "marker id 50 is not in DICT_5X5_50", "0 to 49"),
        (SheetRequest("marker", dictionary="DICT_5X5_51"), "unknown marker dictionary", ""),
        (SheetRequest("marker", page="a7"), "unknown paper 'a7'", "a4"),
    ],
)
def test_unprintable_boards_are_rejected(asked: SheetRequest, message: str, hint: str) -> None:
    with pytest.raises((CameraError, CalibrationError), match=message) as caught:
        make_sheet_page(asked)
    assert hint in caught.value.hint


def test_the_suggested_size_fits() -> None:
    request = SheetRequest("charuco", size_mm=55.0)
    with pytest.raises(CameraError) as caught:
        make_sheet_page(request)
    size = float(caught.value.hint.split()[1])
    make_sheet_page(SheetRequest("charuco", size_mm=size))
    with pytest.raises(CameraError):
        make_sheet_page(SheetRequest("charuco", size_mm=size + 0.5))


@pytest.mark.parametrize("name", ["sheet.svg", "sheet", "sheet.png"])
def test_other_files_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        write_sheet(make_sheet_page(SheetRequest("marker")), tmp_path / name)
    assert not list(tmp_path.iterdir())
