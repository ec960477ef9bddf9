"""A sheet of paper as rectangles and text in millimetres, written as PDF."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_ik.errors import OutputError
from robot_ik.files import write_atomically
from robot_ik.ports import Array

#: Width of a letter of Courier, in heights of the letters. It gives the width of text without a
#: font.
LETTER_WIDTH = 0.6

_POINTS_PER_MM = 72.0 / 25.4
# Width of the strokes, mm, and their ink: enough to cut along, too light for a corner of a marker.
_STROKE = 0.2
_STROKE_INK = 0.4


@dataclass(frozen=True)
class TextLine:
    """One line of text.

    Attributes:
        x: Left end of the base line, mm from the left edge of the page.
        y: The base line, mm from the upper edge of the page.
        size: Height of the letters, mm.
        text: Printable ASCII.
    """

    x: float
    y: float
    size: float
    text: str


@dataclass(frozen=True, eq=False)
class PrintedPage:
    """Content of a printed page.

    Attributes:
        width: Of the paper, mm.
        height: Of the paper, mm.
        boxes: (n, 5) x, y, width, height in mm from the upper left corner, and ink from 0 to 1.
            They do not overlap.
        labels: Lines of text.
        about: Description for people.
        lines: (m, 4) thin grey strokes from x, y to x, y, mm.
    """

    width: float
    height: float
    boxes: Array
    labels: tuple[TextLine, ...]
    about: str
    lines: Array = field(default_factory=lambda: np.zeros((0, 4)))


def write_sheet(page: PrintedPage, path: Path) -> None:
    """Write the page as PDF, atomically.

    Raises:
        OutputError: The name does not end in .pdf, or the folder is missing.
    """
    if path.suffix.lower() != ".pdf":
        raise OutputError(f"cannot write {path}: a sheet is a .pdf", hint="--out sheet.pdf")
    write_atomically(path, pdf_bytes(page))


def pdf_bytes(page: PrintedPage) -> bytes:
    """Return a PDF 1.4 of one page.

    Its drawing is in millimetres. A viewer preference turns the scaling of the page off.
    """
    scale = f"{_POINTS_PER_MM:.9f} 0 0 -{_POINTS_PER_MM:.9f} 0 {page.height * _POINTS_PER_MM:.6f}"
    lines = [f"{scale} cm"]
    for ink in np.unique(page.boxes[:, 4]):
        lines.append(f"{_number(1.0 - ink)} g")
        # All boxes of one ink are one path. Viewers then show no seams between cells that touch.
        same = page.boxes[page.boxes[:, 4] == ink]
        lines += [" ".join(_number(v) for v in box[:4]) + " re" for box in same]
        lines.append("f")
    if len(page.lines):
        lines.append(f"{_STROKE} w {_number(1.0 - _STROKE_INK)} G")
        lines += ["{} {} m {} {} l S".format(*map(_number, line)) for line in page.lines]
    lines.append("0 g")
    for label in page.labels:
        text = label.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        position = f"{_number(label.x)} {_number(label.y)}"
        lines.append(f"BT /F1 {_number(label.size)} Tf 1 0 0 -1 {position} Tm ({text}) Tj ET")
    content = "\n".join(lines).encode("ascii", "replace")
    width = _number(page.width * _POINTS_PER_MM)
    height = _number(page.height * _POINTS_PER_MM)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width} {height}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Courier >>",
    ]
    return _pdf_file(objects)


def _number(value: float) -> str:
    """Return a number as PDF has it: without exponent and trailing zeros."""
    text = f"{value:.5f}".rstrip("0").rstrip(".")
    return "0" if text in ("", "-0") else text


def _pdf_file(objects: list[bytes]) -> bytes:
    """Return a file of objects with its table of offsets."""
    data = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(data))
        data += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    count = len(objects) + 1
    table = f"xref\n0 {count}\n0000000000 65535 f \n".encode()
    table += b"".join(f"{offset:010d} 00000 n \n".encode() for offset in offsets)
    trailer = f"trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    return data + table + trailer.encode()
