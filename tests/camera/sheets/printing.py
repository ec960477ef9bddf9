"""Turn the PDF of a sheet into pixels, from the rectangles in the file."""

from __future__ import annotations

import re

import numpy as np

from robot_ik.camera.drawing.prints import Print
from robot_ik.camera.sheets.page import PrintedPage, pdf_bytes
from robot_ik.ports import Image

MM_PER_INCH = 25.4


def printed(page: PrintedPage, dpi: float) -> Image:
    """Return the page as grey pixels, each the exact mean of the rectangles on it."""
    content = pdf_bytes(page).split(b"stream\n")[1].decode("ascii")
    boxes = []
    ink = 0.0
    for line in content.splitlines():
        grey = re.fullmatch(r"([\d.]+) g", line)
        if grey is not None:
            ink = 1.0 - float(grey[1])
        rectangle = re.fullmatch(r"([\d.-]+) ([\d.-]+) ([\d.-]+) ([\d.-]+) re", line)
        if rectangle is not None:
            boxes.append([*map(float, rectangle.groups()), ink])
    scale = dpi / MM_PER_INCH
    width = round(page.width * scale)
    height = round(page.height * scale)
    table = np.array(boxes)
    paper = (0.0, 0.0, float(width), float(height))
    return Print.of_boxes(table[:, :4] * scale, paper, table[:, 4]).flat(width, height)
