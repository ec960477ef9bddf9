"""Pictures in a whole part of their size: a large or soft picture is searched there, and loses nothing.

A reduced pixel is the mean of ``times`` x ``times`` pixels, so that noise and the place of edges are kept.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Detectors look at so many pixels round a pixel as suits pictures of up to this longer side, px.
LARGE = 3000
_WANTED = 2000


def reduction_for(image: Image) -> int:
    """How many times smaller a picture (h, w, …) is to be searched; 1: as it is."""
    longer = max(image.shape[:2])
    return 1 if longer <= LARGE else -(-longer // _WANTED)


def reduced(gray: Image, times: int) -> Image:
    """The picture (h, w) so many times smaller, without the last columns and rows that fill no pixel."""
    if times == 1:
        return gray
    height, width = (n // times for n in gray.shape)
    whole = gray[: height * times, : width * times]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def to_reduced(pixels: Array, times: float) -> Array:
    """Places (…, 2) of a picture in the one that is so many times smaller, pixel centres being whole."""
    return (pixels + 0.5) / times - 0.5


def from_reduced(pixels: Array, times: float) -> Array:
    """The way back."""
    return (pixels + 0.5) * times - 0.5
