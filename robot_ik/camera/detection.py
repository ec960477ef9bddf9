"""Finds markers in a picture, to about a pixel: ``corner_refinement`` makes that a tenth.

OpenCV's own refinement pulls corners inwards by up to a pixel: it only makes up for a reduced picture.
Also where to look in the next picture, and which dictionary markers are of when it is not the one given.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from robot_ik.camera.image import (
    Box,
    dictionary_names,
    dictionary_size,
    from_reduced,
    marker_dictionary,
    reduced,
    times_smaller,
    to_gray,
)
from robot_ik.errors import CameraError
from robot_ik.ports import Array, Image

# Cells narrower than this (px) cannot be read, only guessed: noise now and then looks like a code.
_LEAST_CELL = 1.2
# A thorough search: thresholds look at so many pixels around, and an outline may leave its polygon by so much
# of its length.  A wide view in a bent lens is less square than OpenCV's 3 % allows; of a strongly tilted
# marker 5 % is more than its short side.  Wider windows find no more, and take twice the time.  The second
# search is of a picture smoothed a little: most outlines are noise, and cost two thirds of the time.
# The first one is for cells as small as what that takes away.
_SEARCHES = ((5, 0.05), (13, 0.02))
# What is smoothed away, px: a kernel of (1, 2, 1) / 4 each way.
_SMOOTHED = (3, 3)
# Where a marker is expected it is looked for down to this part of its size.
_SHRINK = 0.6
# Thresholds of the quick search look at so many pixels around, px: fine enough for a cell of 2 px.
_QUICK_WINDOW = 13
# So many of the bits that a dictionary can correct may be wrong.  In small cells black looks narrower than it
# is (tone curve), and bits are misread: with all of them, a quarter more small markers are found, and now and
# then one that is none.  The tracker asks afterwards whether the picture shows the print
# (``corner_refinement``); without that, fewer are corrected.
_CORRECTED, _CORRECTED_STRICTLY = 1.0, 0.6
# OpenCV reads a cell from so many samples squared, taken without interpolation.  With its usual 4, cells of
# 2 px are often misread.
_CELL_SAMPLES = 8
# A part with cells smaller than this (px) is searched in twice its size: OpenCV's corners are whole pixels,
# which is too coarse for such cells.
_SMALL_CELL = 4.0
# A part with cells larger than this (px) is searched in half its size: a fifth of the work, most of which is
# outlines of noise.  OpenCV's refinement, in a window of this half width, gives the lost half pixel back.
_LARGE_CELL = 8.0
_CORNER_WINDOW, _CORNER_STEPS = 3, 5


@lru_cache(maxsize=64)
def correctable(dictionary: str) -> int:
    """How many bits of a marker may be misread where its print is known."""
    return int(marker_dictionary(dictionary).maxCorrectionBits * _CORRECTED_STRICTLY)


@dataclass(frozen=True, eq=False)
class Detection:
    """A marker in a picture.

    Attributes:
        id: Its number in the dictionary.
        corners: (4, 2) distorted pixels, clockwise in the picture, starting at the printed marker's upper
            left: (-,+) (+,+) (+,-) (-,-) in the marker's frame.
    """

    id: int
    corners: Array


class MarkerDetector:
    """Finds the markers of one dictionary.

    Args:
        dictionary: Name as in OpenCV, for example ``DICT_5X5_50`` (the default of this package: no false
            finds in our trials, where 4X4_250 and 16h5 had some).
        ids: Only these are reported; None for all.
        strict: For finds that are not verified by their print.

    Raises:
        CameraError: Unknown dictionary (close names are listed) or an id beyond it.
    """

    def __init__(
        self, dictionary: str = "DICT_5X5_50", ids: Iterable[int] | None = None, *, strict: bool = False
    ) -> None:
        table = marker_dictionary(dictionary)
        self.dictionary = dictionary
        self.ids = None if ids is None else frozenset(int(i) for i in ids)
        self.cells = int(table.markerSize) + 2
        count = dictionary_size(dictionary)
        beyond = sorted(i for i in self.ids or () if not 0 <= i < count)
        if beyond:
            raise CameraError(
                f"marker ids {', '.join(map(str, beyond))} are not in {dictionary}",
                hint=f"its ids are 0 to {count - 1}",
            )
        rate = _CORRECTED_STRICTLY if strict else _CORRECTED
        self._thorough = [cv2.aruco.ArucoDetector(table, _parameters(*one, rate)) for one in _SEARCHES]
        self._quick_parameters = _parameters(_QUICK_WINDOW, _SEARCHES[0][1], rate)
        self._quick = cv2.aruco.ArucoDetector(table, self._quick_parameters)

    def detect(self, image: Image) -> list[Detection]:
        """Markers in a picture (h, w) or (h, w, 3) uint8, sorted by id.

        The same id may come twice when two copies of a marker are in view.  A large picture is searched in a
        smaller size too: its edges may be too soft for the thresholds.  Where some of the named ids are
        found, and small, the others are searched round them in a larger size.
        """
        gray = to_gray(image)
        found = self._wanted(self._search(gray))
        if times_smaller(gray) > 1:
            found = _sorted(found + [one for one in self.detect_quickly(gray) if not _among(one, found)])
        if self.ids is None or {one.id for one in found} >= self.ids:
            return found
        window = SearchWindow()
        window.remember(found)
        box = window.around(gray.shape[1], gray.shape[0], wide=True)
        if box is None or window.side > _SMALL_CELL * self.cells:
            return found
        x0, y0, x1, y1 = box
        more = self.detect_part(gray[y0:y1, x0:x1], window.side, origin=(x0, y0), thorough=True)
        return _sorted(found + [one for one in more if not _among(one, found)])

    def detect_part(
        self, image: Image, side: float, *, origin: tuple[int, int] = (0, 0), thorough: bool = False
    ) -> list[Detection]:
        """Markers in a small part of a picture, which is enlarged where their cells are small.

        Where they are large it is reduced, unless the search is to be thorough.

        Args:
            image: (h, w) or (h, w, 3) uint8, with the markers and the white round them.
            side: The shortest one that is expected, px.
            origin: Pixel (x, y) of the whole picture at which the part begins.
            thorough: With all thresholds, as in ``detect``.
        """
        times, cell = 1.0, side / self.cells
        if cell < _SMALL_CELL:
            times = 0.5
        elif cell > _LARGE_CELL and not thorough:
            times = 2.0
        gray = reduced(to_gray(image), times)
        found = self._search(gray) if thorough else self._search_quickly(gray, times, 4.0 * side)
        shift = np.array(origin, dtype=float)
        return self._wanted([Detection(d.id, from_reduced(d.corners, times) + shift) for d in found])

    def detect_quickly(self, image: Image) -> list[Detection]:
        """As ``detect``, two times faster, with one threshold: enough for markers that are easily seen.

        A large picture is searched in a smaller size only.
        """
        times = times_smaller(image)
        found = self._search_quickly(reduced(to_gray(image), times), times)
        return self._wanted([Detection(d.id, from_reduced(d.corners, times)) for d in found], times)

    def _search(self, gray: Image) -> list[Detection]:
        """By all thresholds; what several of them find is there once."""
        found: list[Detection] = []
        for detector, picture in zip(self._thorough, (gray, _smooth(gray)), strict=True):
            found += [one for one in _detected(detector, picture) if not _among(one, found)]
        return found

    def _search_quickly(self, gray: Image, times: float, perimeter: float = 0.0) -> list[Detection]:
        """By one threshold in a picture that is ``times`` smaller, for markers of ``perimeter`` px there."""
        how = cv2.aruco.CORNER_REFINE_SUBPIX if times > 1 else cv2.aruco.CORNER_REFINE_NONE
        least = max(4 * _LEAST_CELL * self.cells, _SHRINK * perimeter / times)
        # In steps of a fifth, so that the detector is not told something new with every picture.
        rate = 1.2 ** math.floor(math.log(least / max(gray.shape)) / math.log(1.2))
        p = self._quick_parameters
        if (rate, how) != (p.minMarkerPerimeterRate, p.cornerRefinementMethod):
            p.minMarkerPerimeterRate, p.cornerRefinementMethod = rate, how
            self._quick.setDetectorParameters(p)
        # Noise is gone from what is reduced, and small cells want all there is.
        return _detected(self._quick, _smooth(gray) if times == 1 else gray)

    def _wanted(self, found: list[Detection], times: int = 1) -> list[Detection]:
        least = _LEAST_CELL * self.cells * times
        ids = self.ids
        return _sorted(
            [d for d in found if (ids is None or d.id in ids) and shortest_side(d.corners) >= least]
        )


def _detected(detector: Any, gray: Image) -> list[Detection]:
    corners, ids, _ = detector.detectMarkers(gray)
    if ids is None:
        return []
    numbers = np.asarray(ids).reshape(-1)
    return [
        Detection(int(i), np.asarray(c, dtype=float).reshape(4, 2))
        for i, c in zip(numbers, corners, strict=True)
    ]


def _smooth(gray: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(gray, _SMOOTHED, 0.0), dtype=np.uint8)


def _sorted(found: list[Detection]) -> list[Detection]:
    return sorted(found, key=lambda d: (d.id, *d.corners[0]))


def _among(one: Detection, others: list[Detection]) -> bool:
    """Whether a marker has been found already."""
    centre, near = one.corners.mean(axis=0), 0.5 * shortest_side(one.corners)
    return any(
        d.id == one.id and float(np.linalg.norm(d.corners.mean(axis=0) - centre)) < near for d in others
    )


def shortest_side(corners: Array) -> float:
    """Length of the shortest side of a quadrilateral (4, 2)."""
    c = corners.tolist()
    return min(math.hypot(c[k][0] - c[k - 1][0], c[k][1] - c[k - 1][1]) for k in range(4))


def _parameters(window: int, accuracy: float, corrected: float) -> cv2.aruco.DetectorParameters:
    """All that matters is set, because the defaults differ between OpenCV releases.

    The threshold looks at a ``window`` of pixels, an outline may leave its polygon by ``accuracy`` of its
    length, ``corrected`` of the bits that a dictionary can correct may be wrong.
    """
    p = cv2.aruco.DetectorParameters()
    p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    p.cornerRefinementWinSize, p.cornerRefinementMaxIterations = _CORNER_WINDOW, _CORNER_STEPS
    p.adaptiveThreshWinSizeMin = p.adaptiveThreshWinSizeMax = window
    # 3 % of the picture's longer side round the marker: cells of one pixel at 640 px.
    p.minMarkerPerimeterRate = 0.03
    p.polygonalApproxAccuracyRate = accuracy
    p.minMarkerDistanceRate = 0.05
    p.errorCorrectionRate = corrected
    p.perspectiveRemovePixelPerCell = _CELL_SAMPLES
    p.detectInvertedMarker = False
    p.useAruco3Detection = False
    return p


# ------------------------------------------------------------------------------------------
# Which dictionary the markers in pictures are of, when they are not of the one that was said.


# Pictures are reduced to this size and more, px: some 20 dictionaries want patience otherwise.
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
    grays = [to_gray(image) for image in images]
    pictures = [reduced(gray, max(1, max(gray.shape) // _LONGER_SIDE)) for gray in grays]
    best, name = (0, 0.0), None
    for family in _families():
        detector = MarkerDetector(family[-1], strict=True)
        ids = [one.id for picture in pictures for one in detector.detect(picture)]
        if len(ids) < max(least, 1):
            continue
        smallest = next(one for one in family if dictionary_size(one) > max(ids))
        bits = (detector.cells - 2) ** 2 - float(np.log2(dictionary_size(smallest)))
        if (len(ids), bits) > best:
            best, name = (len(ids), bits), smallest
    return name


def largest_dictionaries() -> list[str]:
    """Names of the dictionaries that no other one contains."""
    return [family[-1] for family in _families()]


def _families() -> list[list[str]]:
    """Dictionaries that contain each other together, the smallest first."""
    groups: dict[str, list[str]] = {}
    for name in dictionary_names():
        groups.setdefault(re.sub(r"(DICT_\dX\d)_\d+", r"\1", name), []).append(name)
    return [sorted(group, key=dictionary_size) for group in groups.values()]


# ------------------------------------------------------------------------------------------
# Where in the next picture the markers of the last ones will be.


# The x of the four corners and their y, as plain numbers: quicker than arrays of four.
_Corners = tuple[list[float], ...]

# The window for a marker: its box and so much of its size on each side, for its white margin (a cell) and
# for what it moves otherwise than in the last picture; and when it was not there.
_MARGIN, _WIDE_MARGIN = 0.5, 1.5
# The whole picture is searched every so many pictures all the same: for markers that come into view.
_WHOLE_EVERY = 10
# A window of more than this part of the picture saves nothing.
_LARGEST_PART = 0.5


class SearchWindow:
    """Remembers the corners of the last two pictures.

    Attributes:
        side: The shortest one in the last picture, px; 0 when there was none.
    """

    def __init__(self) -> None:
        self.side = 0.0
        self._last: dict[int, _Corners] = {}
        self._before: dict[int, _Corners] = {}
        self._since_whole = 0

    @property
    def due(self) -> bool:
        """Whether it is time to search the whole picture, or there is nothing to search round."""
        return not self._last or self._since_whole + 1 >= _WHOLE_EVERY

    def around(self, width: int, height: int, *, wide: bool = False) -> Box | None:
        """Part of the picture (x0, y0, x1, y1), half open, for the last markers; None: search all of it."""
        x0, y0, x1, y1 = math.inf, math.inf, -math.inf, -math.inf
        margin = _WIDE_MARGIN if wide else _MARGIN
        for i, corners in self._last.items():
            (xs, ys), (old_xs, old_ys) = corners, self._before.get(i, corners)
            left, right, top, bottom = min(xs), max(xs), min(ys), max(ys)
            dx, dy = margin * (right - left), margin * (bottom - top)
            # Where it is if it stays, and if it goes on as it did.
            step_x, step_y = 0.25 * (sum(xs) - sum(old_xs)), 0.25 * (sum(ys) - sum(old_ys))
            x0, x1 = min(x0, left - dx + min(step_x, 0.0)), max(x1, right + dx + max(step_x, 0.0))
            y0, y1 = min(y0, top - dy + min(step_y, 0.0)), max(y1, bottom + dy + max(step_y, 0.0))
        if not self._last:
            return None
        left, right = max(math.floor(x0), 0), min(math.ceil(x1) + 1, width)
        top, bottom = max(math.floor(y0), 0), min(math.ceil(y1) + 1, height)
        if right <= left or bottom <= top or (right - left) * (bottom - top) > _LARGEST_PART * width * height:
            return None
        return left, top, right, bottom

    def holds(self, found: Sequence[Detection]) -> bool:
        """Whether all markers of the last picture are among these."""
        return {d.id for d in found} >= self._last.keys()

    def remember(self, found: Sequence[Detection], *, whole: bool = False) -> None:
        """Takes in what was found; ``whole``: in all of the picture."""
        self._since_whole = 0 if whole else self._since_whole + 1
        self._before, self._last = self._last, {d.id: tuple(d.corners.T.tolist()) for d in found}
        self.side = min((shortest_side(d.corners) for d in found), default=0.0)
