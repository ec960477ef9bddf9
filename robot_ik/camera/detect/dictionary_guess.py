"""Which dictionary the markers in pictures are of, when they are not of the one that was said."""

from __future__ import annotations

import re
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect.detector import MarkerDetector, to_gray
from robot_ik.camera.opencv import dictionary_names, dictionary_size

Image = NDArray[np.uint8]

# Pictures are looked at in about this size, px: some 20 dictionaries want patience otherwise.
_LONGER_SIDE = 1280


def guess_dictionary(images: Sequence[Image], least: int = 1) -> str | None:
    """Name of the dictionary that knows most markers in the pictures, None when none knows any.

    Of a family in which each dictionary contains the smaller ones, the largest is tried, and the smallest
    that has the ids is named.  Coarse codes see a marker now and then where there is none: of dictionaries
    that find equally many, the one whose chance finds are rarest (fewest codes among most bits) is taken.

    Args:
        images: (h, w) or (h, w, 3) uint8 each.
        least: So many markers are wanted in all of them: a single one may be a chance find.
    """
    pictures = [_shrunk(to_gray(image)) for image in images]
    best, name = (0, 0.0), None
    for family in _families():
        detector = MarkerDetector(family[-1])
        ids = [one.id for picture in pictures for one in detector.detect(picture)]
        if len(ids) < max(least, 1):
            continue
        smallest = next(one for one in family if dictionary_size(one) > max(ids))
        bits = (detector.cells - 2) ** 2 - float(np.log2(dictionary_size(smallest)))
        if (len(ids), bits) > best:
            best, name = (len(ids), bits), smallest
    return name


def _families() -> list[list[str]]:
    """Dictionaries that contain each other together, the smallest first."""
    groups: dict[str, list[str]] = {}
    for name in dictionary_names():
        groups.setdefault(re.sub(r"(DICT_\dX\d)_\d+", r"\1", name), []).append(name)
    return [sorted(group, key=dictionary_size) for group in groups.values()]


def _shrunk(gray: Image) -> Image:
    factor = _LONGER_SIDE / max(gray.shape)
    if factor >= 1.0:
        return gray
    small = cv2.resize(gray, (0, 0), fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)
