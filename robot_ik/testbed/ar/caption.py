"""A card with text on a picture. It is drawn again only when its text changes."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.text import text_size, write
from robot_ik.ports import Image

_LETTER = 15
"""Size of the letters, pixels."""

_LINE = 21
"""Distance of two lines, pixels."""

_PADDING = 9
"""Pixels between the edge of the card and the text."""

_MARGIN = 8
"""Pixels between the card and the edge of the picture."""

_LETTER_WIDTH = 0.52
"""Mean width of a letter, in letter sizes."""

_TRANSPARENCY = 0.25
"""Part of the picture that shows through the card."""

_DARK = (38, 32, 28)
_WHITE = (255, 255, 255)


class Caption:
    """Lines of text at the lower left of pictures."""

    def __init__(self) -> None:
        self._content: tuple[tuple[str, ...], int] = ((), 0)
        self._card: Image = np.zeros((0, 0, 3), np.uint8)

    def write(self, image: NDArray[np.uint8], lines: Sequence[str]) -> None:
        """Write lines into ``image`` (h, w, 3). Long lines are broken."""
        content = (tuple(lines), int(image.shape[1]))
        if content != self._content:
            self._content = content
            self._card = _card(lines, content[1])
        height, width = self._card.shape[:2]
        bottom = image.shape[0] - _MARGIN
        if not height or height > bottom:
            return
        region = image[bottom - height : bottom, _MARGIN : _MARGIN + width]
        blended = cv2.addWeighted(region, _TRANSPARENCY, self._card, 1.0 - _TRANSPARENCY, 0.0)
        is_text = self._card > _DARK
        region[:] = np.where(is_text, self._card, blended)


def _card(lines: Sequence[str], picture_width: int) -> Image:
    """Return the card (h, w, 3) with white text on a dark ground."""
    room = picture_width - 2 * (_MARGIN + _PADDING)
    letters = max(10, int(room / (_LETTER_WIDTH * _LETTER)))
    broken = [row for line in lines for row in textwrap.wrap(line, letters)]
    if not broken:
        return np.zeros((0, 0, 3), np.uint8)
    sizes = [text_size(row, _LETTER) for row in broken]
    width = min(max(size[0] for size in sizes), room) + 2 * _PADDING
    height = _LINE * (len(broken) - 1) + sizes[0][1] + 2 * _PADDING
    card = np.empty((height, width, 3), np.uint8)
    card[:] = _DARK
    for k, row in enumerate(broken):
        write(card, row, (_PADDING, _PADDING + sizes[0][1] + k * _LINE), _LETTER, _WHITE)
    return card
