"""Text on pictures: the built-in outline font where OpenCV has one (5.0 on), stroke letters otherwise."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

# Letters that the stroke font of OpenCV 4 lacks.
_PLAIN = str.maketrans(
    {"°": " deg", "–": "-", "—": "-", "≤": "<=", "µ": "u", "→": "->", "σ": "sigma", "·": "-", "±": "+-"}
)
_HERSHEY = cv2.FONT_HERSHEY_DUPLEX
# Height of a Hershey capital at scale 1, in pixels, over the em of the outline font.
_HERSHEY_EM = 30.0


@lru_cache(maxsize=1)
def _outline_font() -> Any | None:
    make = getattr(cv2, "FontFace", None)
    try:
        return None if make is None else make("sans")
    except cv2.error:
        return None


def text_size(text: str, size: int, *, bold: bool = False) -> tuple[int, int]:
    """Width and height of capitals, pixels, of ``text`` in letters of ``size`` px."""
    font = _outline_font()
    if font is None:
        (width, _), _ = cv2.getTextSize(text.translate(_PLAIN), _HERSHEY, size / _HERSHEY_EM, 1)
        return int(width), round(0.72 * size)
    box = cv2.getTextSize((4096, 4096), text, (0, 0), font, size, 700 if bold else 400)
    return int(box[2]), round(0.72 * size)


def write(
    image: Image,
    text: str,
    origin: tuple[int, int],
    size: int,
    colour: tuple[int, int, int],
    *,
    bold: bool = False,
) -> None:
    """Writes into ``image`` from ``origin`` (x, y) on the base line, in letters of ``size`` px."""
    font = _outline_font()
    if font is None:
        scale, width = size / _HERSHEY_EM, 2 if bold and size > 16 else 1
        cv2.putText(image, text.translate(_PLAIN), origin, _HERSHEY, scale, colour, width, cv2.LINE_AA)
        return
    cv2.putText(image, text, origin, colour, font, size, 700 if bold else 400)
