"""Finds square markers in a picture: ids and rough corners.

The corners are OpenCV's unrefined ones, good to about a pixel; ``robot_ik.camera.refine`` makes them good to
a tenth.  OpenCV's own refinement pulls them inwards by up to a pixel: it only makes up for a reduced picture.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.opencv import detect_markers, dictionary_size, marker_dictionary
from robot_ik.camera.reduction import from_reduced, reduced, reduction_for
from robot_ik.errors import CameraError

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Cells narrower than this (px) cannot be read, only guessed: noise now and then looks like a code.
_LEAST_CELL = 1.5
# Where a marker is expected it is looked for down to this part of its size.
_SHRINK = 0.6
# Thresholds of the quick search look at so many pixels around, px: fine enough for a cell of 2 px.
_QUICK_WINDOW = 13
# OpenCV reads a cell from so many samples squared, taken without interpolation.  With its usual 4, cells of
# 2 px are often misread.
_CELL_SAMPLES = 8
# A part with cells smaller than this (px) is enlarged before it is searched: OpenCV's corners are whole
# pixels, which is too coarse for such cells.
_SMALL_CELL, _ENLARGE = 4.0, 2.0
# A part with cells larger than this (px) is searched in half its size: a fifth of the work, most of which is
# outlines of noise.  OpenCV's refinement, in a window of this half width, gives the lost half pixel back.
_LARGE_CELL, _REDUCE = 8.0, 0.5
_CORNER_WINDOW, _CORNER_STEPS = 3, 5


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


def to_gray(image: Image) -> Image:
    """Grey (h, w) of a BGR (h, w, 3) or grey (h, w) picture."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


class MarkerDetector:
    """Finds the markers of one dictionary.

    Args:
        dictionary: Name as in OpenCV, for example ``DICT_5X5_50`` (the default of this package: no false
            finds in our trials, where 4X4_250 and 16h5 had some).
        ids: Only these are reported; None for all.

    Raises:
        CameraError: Unknown dictionary (close names are listed) or an id beyond it.
    """

    def __init__(self, dictionary: str = "DICT_5X5_50", ids: Iterable[int] | None = None) -> None:
        table = marker_dictionary(dictionary)
        self.dictionary = dictionary
        self.ids = None if ids is None else frozenset(int(i) for i in ids)
        self.cells = int(table.markerSize) + 2
        count = dictionary_size(dictionary)
        beyond = sorted(i for i in self.ids or () if not 0 <= i < count)
        if beyond:
            raise CameraError(
                f"marker ids {beyond} are not in {dictionary}", hint=f"its ids are 0 to {count - 1}"
            )
        self._detector = cv2.aruco.ArucoDetector(table, _parameters())
        self._quick_parameters = _parameters()
        self._quick_parameters.adaptiveThreshWinSizeMin = _QUICK_WINDOW
        self._quick_parameters.adaptiveThreshWinSizeMax = _QUICK_WINDOW
        self._quick = cv2.aruco.ArucoDetector(table, self._quick_parameters)

    def detect(self, image: Image) -> list[Detection]:
        """Markers in a picture (h, w) or (h, w, 3) uint8, sorted by id.

        The same id may come twice when two copies of a marker are in view.  A large picture is searched in a
        smaller size too: its edges may be too soft for the thresholds.
        """
        gray = to_gray(image)
        found = self._wanted(detect_markers(self._detector, gray))
        if reduction_for(gray) == 1:
            return found
        return _sorted(found + [one for one in self.detect_quickly(gray) if not _among(one, found)])

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
        gray = to_gray(image)
        zoom, cell = 1.0, side / self.cells
        if cell < _SMALL_CELL or (cell > _LARGE_CELL and not thorough):
            zoom = _ENLARGE if cell < _SMALL_CELL else _REDUCE
            gray = _zoomed(gray, zoom)
        detector = self._detector
        if not thorough:
            self._expect(4.0 * zoom * side, gray.shape, reduced=zoom < 1.0)
            detector = self._quick
        shift = np.array(origin, dtype=float)
        return self._wanted(
            [(i, (corners + 0.5) / zoom - 0.5 + shift) for i, corners in detect_markers(detector, gray)]
        )

    def detect_quickly(self, image: Image) -> list[Detection]:
        """As ``detect``, two times faster, with one threshold: enough for markers that are easily seen.

        A large picture is searched in a smaller size only.

        Args:
            image: (h, w) or (h, w, 3) uint8.
        """
        times = reduction_for(image)
        gray = reduced(to_gray(image), times)
        self._expect(0.0, gray.shape, reduced=times > 1)
        found = detect_markers(self._quick, gray)
        return self._wanted([(i, from_reduced(corners, times)) for i, corners in found], times)

    def _expect(self, perimeter: float, shape: tuple[int, ...], *, reduced: bool = False) -> None:
        """Tells the quick detector how small a marker may be in a picture of this shape."""
        how = cv2.aruco.CORNER_REFINE_SUBPIX if reduced else cv2.aruco.CORNER_REFINE_NONE
        least = max(4 * _LEAST_CELL * self.cells, _SHRINK * perimeter)
        # In steps of a fifth, so that the detector is not told something new with every picture.
        rate = 1.2 ** math.floor(math.log(least / max(shape)) / math.log(1.2))
        p = self._quick_parameters
        if (rate, how) != (p.minMarkerPerimeterRate, p.cornerRefinementMethod):
            p.minMarkerPerimeterRate, p.cornerRefinementMethod = rate, how
            self._quick.setDetectorParameters(p)

    def _wanted(self, found: list[tuple[int, Array]], times: int = 1) -> list[Detection]:
        least = _LEAST_CELL * self.cells * times
        wanted = [
            Detection(i, corners)
            for i, corners in found
            if (self.ids is None or i in self.ids) and shortest_side(corners) >= least
        ]
        return _sorted(wanted)


def _sorted(found: list[Detection]) -> list[Detection]:
    return sorted(found, key=lambda d: (d.id, *d.corners[0]))


def _among(one: Detection, others: list[Detection]) -> bool:
    """Whether a marker has been found already."""
    centre, near = one.corners.mean(axis=0), 0.5 * shortest_side(one.corners)
    return any(
        d.id == one.id and float(np.linalg.norm(d.corners.mean(axis=0) - centre)) < near for d in others
    )


def _zoomed(gray: Image, zoom: float) -> Image:
    """The picture so many times larger, without the last column or row where that leaves half a pixel."""
    height, width = (int(zoom * n) for n in gray.shape)
    whole = gray[: round(height / zoom), : round(width / zoom)]
    how = cv2.INTER_CUBIC if zoom > 1.0 else cv2.INTER_AREA
    return np.asarray(cv2.resize(whole, (width, height), interpolation=how), dtype=np.uint8)


def shortest_side(corners: Array) -> float:
    """Length of the shortest side of a quadrilateral (4, 2)."""
    c = corners.tolist()
    return min(math.hypot(c[k][0] - c[k - 1][0], c[k][1] - c[k - 1][1]) for k in range(4))


def _parameters() -> cv2.aruco.DetectorParameters:
    """All that matters is set, because the defaults differ between OpenCV releases."""
    p = cv2.aruco.DetectorParameters()
    p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    p.cornerRefinementWinSize, p.cornerRefinementMaxIterations = _CORNER_WINDOW, _CORNER_STEPS
    # Three windows: fine for small and blurred markers, coarse for uneven light.
    p.adaptiveThreshWinSizeMin, p.adaptiveThreshWinSizeMax, p.adaptiveThreshWinSizeStep = 3, 23, 10
    # 3 % of the picture's longer side round the marker: cells of one pixel at 640 px.
    p.minMarkerPerimeterRate = 0.03
    # A steep view in a bent lens is less square than OpenCV's 3 % allows.
    p.polygonalApproxAccuracyRate = 0.05
    p.minMarkerDistanceRate = 0.05
    p.errorCorrectionRate = 0.6
    p.perspectiveRemovePixelPerCell = _CELL_SAMPLES
    p.detectInvertedMarker = False
    p.useAruco3Detection = False
    return p
