"""A sheet of paper as rectangles and text in millimetres, written as PDF or PNG from the same list."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from robot_ik.camera.drawing.prints import Print
from robot_ik.errors import OutputError
from robot_ik.files import write_atomically
from robot_ik.ports import Array, Image

MM_PER_INCH = 25.4
_POINTS_PER_MM = 72.0 / MM_PER_INCH
#: Width of a letter of Courier, in heights of the letters: what text takes can be told without a font.
LETTER_WIDTH = 0.6
# Width, mm, and ink of the strokes: enough to cut along, too light for a corner of a marker.
_STROKE, _STROKE_INK = 0.2, 0.4
# Bits of a pixel in OpenCV's drawing.
_SUBPIXEL = 4


@dataclass(frozen=True)
class TextLine:
    """One line of text.

    Attributes:
        x, y: Left end of the base line, mm from the page's upper left corner.
        size: Height of the letters, mm.
        text: Printable ASCII.
    """

    x: float
    y: float
    size: float
    text: str


@dataclass(frozen=True, eq=False)
class PrintedPage:
    """What is printed.

    Attributes:
        width, height: Of the paper, mm.
        boxes: (n, 5) x, y, width, height in mm from the upper left corner, and ink from 0 to 1; none overlap.
        labels: Lines of text.
        about: What it is, for people.
        lines: (m, 4) thin grey strokes from x, y to x, y, mm.
    """

    width: float
    height: float
    boxes: Array
    labels: tuple[TextLine, ...]
    about: str
    lines: Array = field(default_factory=lambda: np.zeros((0, 4)))


def write_sheet(page: PrintedPage, path: Path, *, dpi: int = 300) -> None:
    """Writes the page, whole or not at all; the suffix says how.

    Args:
        page: The page.
        path: Ends in .pdf or .png.
        dpi: Pixels per inch of a PNG.

    Raises:
        OutputError: Another suffix, a resolution that cannot be meant, or a folder that is missing.
    """
    suffix = path.suffix.lower()
    if suffix == ".pdf":
        write_atomically(path, pdf_bytes(page))
    elif suffix == ".png":
        if not 50 <= dpi <= 2400:
            raise OutputError(f"{dpi} pixels per inch are not possible", hint="give 50 to 2400; 300 is usual")
        write_atomically(path, png_bytes(page, dpi))
    else:
        raise OutputError(f"cannot write {path}: a sheet is a .pdf or a .png", hint="--out sheet.pdf")


# ---------------------------------------------------------------------------------------- PDF


def _number(value: float) -> str:
    text = f"{value:.5f}".rstrip("0").rstrip(".")
    return "0" if text in ("", "-0") else text


def pdf_bytes(page: PrintedPage) -> bytes:
    """A PDF 1.4 of one page; its drawing is in millimetres and its viewer is asked not to scale."""
    lines = [f"{_POINTS_PER_MM:.9f} 0 0 -{_POINTS_PER_MM:.9f} 0 {page.height * _POINTS_PER_MM:.6f} cm"]
    for ink in np.unique(page.boxes[:, 4]):
        lines.append(f"{_number(1.0 - ink)} g")
        # One path for all: cells that touch are filled as one, and no viewer shows a seam.
        some = page.boxes[page.boxes[:, 4] == ink]
        lines += [" ".join(_number(v) for v in box[:4]) + " re" for box in some]
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
    box = f"0 0 {_number(page.width * _POINTS_PER_MM)} {_number(page.height * _POINTS_PER_MM)}"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Courier >>",
    ]
    return _pdf_file(objects)


def _pdf_file(objects: list[bytes]) -> bytes:
    data = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(data))
        data += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    table = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    table += b"".join(f"{offset:010d} 00000 n \n".encode() for offset in offsets)
    trailer = f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    return data + table + trailer.encode()


# ---------------------------------------------------------------------------------------- PNG


def rasterize(page: PrintedPage, dpi: float) -> Image:
    """The page as grey pixels, each the exact mean of what is printed on it (text aside)."""
    scale = dpi / MM_PER_INCH
    width, height = round(page.width * scale), round(page.height * scale)
    paper = (0.0, 0.0, float(width), float(height))
    image = Print.of_boxes(page.boxes[:, :4] * scale, paper, page.boxes[:, 4]).flat(width, height)
    _draw_lines(image, page.lines * scale, max(1, round(_STROKE * scale)))
    for label in page.labels:
        _draw_label(image, label, scale)
    return image


def _draw_lines(image: Image, lines: Array, thickness: int) -> None:
    """Strokes in pixels, the upper left corner of the page at 0; OpenCV counts from the first centre."""
    ink = round(255 * (1.0 - _STROKE_INK))
    for line in np.rint((lines - 0.5) * (1 << _SUBPIXEL)).astype(int).tolist():
        cv2.line(image, tuple(line[:2]), tuple(line[2:]), ink, thickness, cv2.LINE_AA, _SUBPIXEL)


def _draw_label(image: Image, label: TextLine, scale: float) -> None:
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(0.08 * label.size * scale))
    (wide, tall), _ = cv2.getTextSize(label.text, font, 1.0, thickness)
    # As wide as Courier would be, unless the letters would grow too tall.
    ratio = LETTER_WIDTH * label.size * len(label.text) * scale / max(wide, 1)
    ratio = min(ratio, 0.75 * label.size * scale / max(tall, 1))
    position = (round(label.x * scale), round(label.y * scale))
    cv2.putText(image, label.text, position, font, ratio, 0, thickness, cv2.LINE_AA)


def png_bytes(page: PrintedPage, dpi: int) -> bytes:
    """A grey PNG that knows its resolution (chunk pHYs, pixels per metre)."""
    good, data = cv2.imencode(".png", rasterize(page, dpi), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not good:
        raise OutputError("OpenCV could not code the page as a PNG")
    coded = np.asarray(data, dtype=np.uint8).tobytes()
    per_metre = round(dpi / MM_PER_INCH * 1e3)
    body = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    end_of_header = 8 + 25  # signature; IHDR is always 25 bytes long
    return coded[:end_of_header] + chunk + coded[end_of_header:]
