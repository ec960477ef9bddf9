"""Text on pictures: the outline font of OpenCV 5, or the stroke font of OpenCV 4."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2

from robot_ik.ports import Image

# Replacements for the letters that the stroke font lacks.
_PLAIN = str.maketrans(
    {
        "°": " deg",
        "–": "-",
        "—": "-",
        "≤": "<=",
        "µ": "u",
        "→": "->",
        "σ": "sigma",
        "·": "-",
        "±": "+-",
    }
)
_STROKE_FONT = cv2.FONT_HERSHEY_DUPLEX
# Letter size of the outline font, px, that looks like the stroke font at scale 1.
_STROKE_SIZE = 30.0
# Height of capitals in letter sizes.
_CAPITALS = 0.72
# Weights of the outline font.
_REGULAR = 400
_BOLD = 700
# Smallest size of bold letters, px. Bold strokes of smaller letters run into each other.
_SMALLEST_BOLD = 16


@lru_cache(maxsize=1)
def _outline_font() -> Any | None:
    make = getattr(cv2, "FontFace", None)
    try:
        return None if make is None else make("sans")
    except cv2.error:
        return None


def text_size(text: str, size: int) -> tuple[int, int]:
    """Return the width of text in letters of ``size`` px, and the height of its capitals, px."""
    height = round(_CAPITALS * size)
    font = _outline_font()
    if font is None:
        scale = size / _STROKE_SIZE
        (width, _), _ = cv2.getTextSize(text.translate(_PLAIN), _STROKE_FONT, scale, 1)
        return int(width), height
    box = cv2.getTextSize((4096, 4096), text, (0, 0), font, size, _REGULAR)
    return int(box[2]), height


def write(
    image: Image,
    text: str,
    origin: tuple[int, int],
    size: int,
    colour: tuple[int, int, int],
    *,
    bold: bool = False,
) -> None:
    """Write into ``image`` from ``origin`` (x, y) on the base line, in letters of ``size`` px."""
    font = _outline_font()
    if font is None:
        width = 2 if bold and size > _SMALLEST_BOLD else 1
        plain = text.translate(_PLAIN)
        scale = size / _STROKE_SIZE
        cv2.putText(image, plain, origin, _STROKE_FONT, scale, colour, width, cv2.LINE_AA)
        return
    cv2.putText(image, text, origin, colour, font, size, _BOLD if bold else _REGULAR)
