"""Detect markers: ids and corners, accurate to about a pixel.

``corners.py`` refines the corners. OpenCV's own refinement would pull them inwards by up to a
pixel. It is used in reduced pictures only, where it recovers half a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from robot_ik.camera.image import (
    dictionary_names,
    dictionary_size,
    from_reduced,
    marker_dictionary,
    reduced,
    reduction_factor,
    to_gray,
)
from robot_ik.errors import CameraError
from robot_ik.ports import Array, Image

# Width of the smallest cell that can be read, px. Noise sometimes looks like a code of smaller
# cells.
_MIN_CELL = 1.2
# Side of the window of the adaptive threshold, px: in the picture itself, and in a picture that is
# smoothed first. The first one finds the smallest cells. Smoothing removes most outlines of noise.
_THRESHOLD_WINDOW = 5
_SMOOTHED_THRESHOLD_WINDOW = 13
# An outline may deviate from its quadrilateral by this part of its length. OpenCV's 3 % is too
# little for a wide view through a distorting lens. For strongly tilted markers 5 % is more than
# their short side.
_OUTLINE_TOLERANCE = 0.05
_SMOOTHED_OUTLINE_TOLERANCE = 0.02
# Kernel of the smoothing, px: (1, 2, 1) / 4 along each axis.
_SMOOTHING_KERNEL = (3, 3)
# Part of the correctable bits that may be wrong. In small cells black looks narrower than it is,
# and bits are misread. With all of them, a quarter more small markers are found, and a few false
# ones, which ``corners.py`` removes. Without that check, fewer bits are corrected.
_CORRECTION_RATE = 1.0
_STRICT_CORRECTION_RATE = 0.6
# Samples of a cell along each axis. With OpenCV's 4, cells of 2 px are often misread.
_CELL_SAMPLES = 8
# Smallest perimeter of a marker as a part of the longer side of the picture: cells of 1 px at 640.
_MIN_PERIMETER = 0.03
# Two candidates nearer than this part of their perimeter are the same marker.
_MIN_MARKER_DISTANCE = 0.05
# Refinement in reduced pictures: half of the window, px, and iterations.
_REFINEMENT_WINDOW = 3
_REFINEMENT_STEPS = 5
# Number of ids that a sentence names.
_NAMED_IDS = 8
# Longer side of the pictures in which all dictionaries are tried, px.
_GUESS_SIZE = 1280


@lru_cache(maxsize=64)
def correctable(dictionary: str) -> int:
    """Return the number of bits that may be misread in a marker whose print is known."""
    return int(marker_dictionary(dictionary).maxCorrectionBits * _STRICT_CORRECTION_RATE)


@dataclass(frozen=True, eq=False)
class Detection:
    """A marker in a picture.

    Attributes:
        id: Id in the dictionary.
        corners: (4, 2) distorted pixels, clockwise in the picture. They start at the upper left
            corner of the print: (-,+) (+,+) (+,-) (-,-) in the marker's frame.
    """

    id: int
    corners: Array


class MarkerDetector:
    """Detects the markers of one dictionary.

    Args:
        dictionary: OpenCV's name. ``DICT_5X5_50`` had no false detections in our trials, 4X4_250
            and 16h5 had some.
        ids: Only these are reported; None for all.
        strict: Correct fewer bits. For detections that are not verified by their print.

    Raises:
        CameraError: Unknown dictionary (close names are listed), or an id that it does not have.
    """

    def __init__(
        self,
        dictionary: str = "DICT_5X5_50",
        ids: Iterable[int] | None = None,
        *,
        strict: bool = False,
    ) -> None:
        table = marker_dictionary(dictionary)
        self.dictionary = dictionary
        self.ids = None if ids is None else frozenset(int(i) for i in ids)
        self.cells = int(table.markerSize) + 2
        check_ids(self.ids or (), dictionary)

        self._table = table
        self._rate = _STRICT_CORRECTION_RATE if strict else _CORRECTION_RATE
        plain = _parameters(_THRESHOLD_WINDOW, _OUTLINE_TOLERANCE, self._rate)
        smoothed = _parameters(_SMOOTHED_THRESHOLD_WINDOW, _SMOOTHED_OUTLINE_TOLERANCE, self._rate)
        self._plain = cv2.aruco.ArucoDetector(table, plain)
        self._smoothed = cv2.aruco.ArucoDetector(table, smoothed)
        # Detectors of ``detect_quickly`` by the size of the picture and whether it is reduced.
        self._quick: dict[tuple[int, bool], Any] = {}

    def detect(self, image: Image) -> list[Detection]:
        """Return the markers in a picture (h, w) or (h, w, 3) uint8, sorted by id.

        An id appears twice if two copies of the marker are visible. A large picture is also
        searched at a smaller size, because its edges may be too soft for the thresholds.
        """
        gray = to_gray(image)
        found = self._wanted(_detect(self._plain, gray))
        found += _new(self._wanted(_detect(self._smoothed, _smooth(gray))), found)
        if reduction_factor(gray) > 1:
            found += _new(self.detect_quickly(gray), found)
        return _sorted(found)

    def detect_quickly(self, image: Image) -> list[Detection]:
        """Return the markers that one threshold finds, in a third of the time of ``detect``.

        It finds markers that are easily visible. A large picture is searched at a smaller size
        only.
        """
        times = reduction_factor(image)
        gray = reduced(to_gray(image), times)
        # A reduced picture has little noise.
        searched = _smooth(gray) if times == 1 else gray
        detector = self._quick_detector(max(gray.shape), is_reduced=times > 1)
        found = [
            Detection(d.id, from_reduced(d.corners, times)) for d in _detect(detector, searched)
        ]
        return _sorted(self._wanted(found, times))

    def _quick_detector(self, size: int, *, is_reduced: bool) -> Any:
        """Return the detector for pictures with a longer side of ``size`` px."""
        key = size, is_reduced
        if key not in self._quick:
            p = _parameters(_SMOOTHED_THRESHOLD_WINDOW, _OUTLINE_TOLERANCE, self._rate)
            p.minMarkerPerimeterRate = 4.0 * _MIN_CELL * self.cells / size
            if is_reduced:
                p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
            self._quick[key] = cv2.aruco.ArucoDetector(self._table, p)
        return self._quick[key]

    def _wanted(self, detections: list[Detection], times: int = 1) -> list[Detection]:
        """Return the detections with a searched id and with cells large enough to be read."""
        min_side = _MIN_CELL * self.cells * times
        return [
            d
            for d in detections
            if (self.ids is None or d.id in self.ids) and shortest_side(d.corners) >= min_side
        ]


def check_ids(ids: Iterable[int], dictionary: str) -> None:
    """Check that a dictionary has these ids.

    Raises:
        CameraError: Unknown dictionary, or an id that it does not have.
    """
    count = dictionary_size(dictionary)
    unknown = sorted(i for i in ids if not 0 <= i < count)
    if unknown:
        raise CameraError(
            f"{dictionary} has no marker {', '.join(map(str, unknown))}",
            hint=f"its ids are 0 to {count - 1}",
        )


def guess_dictionary(
    images: Sequence[Image], min_count: int = 1
) -> tuple[str, tuple[int, ...]] | None:
    """Return the dictionary with most markers in some pictures, and their ids.

    Of dictionaries with equally many markers, the one with the fewest false detections by chance is
    returned: few codes of many bits.

    Args:
        images: (h, w) or (h, w, 3) uint8 each.
        min_count: Smallest number of markers in all pictures. A single marker may be a false
            detection.
    """
    pictures = []
    for image in images:
        gray = to_gray(image)
        pictures.append(reduced(gray, max(1, max(gray.shape) // _GUESS_SIZE)))
    best: list[int] = []
    best_name = ""
    for name in sorted(dictionary_names(), key=_chance):
        detector = MarkerDetector(name, strict=True)
        ids = [d.id for picture in pictures for d in detector.detect(picture)]
        if len(ids) > len(best):
            best = ids
            best_name = name
    if len(best) < max(min_count, 1):
        return None
    return best_name, tuple(sorted(set(best)))


def ids_text(dictionary: str, ids: Sequence[int]) -> str:
    """Return a sentence with the dictionary of the ids in a picture."""
    shown = ", ".join(map(str, ids[:_NAMED_IDS]))
    if len(ids) > _NAMED_IDS:
        shown += ", …"
    return f"these ids exist in {dictionary}: {shown}"


def _chance(dictionary: str) -> float:
    """Return the logarithm of the part of all codes that are in a dictionary."""
    bits = int(marker_dictionary(dictionary).markerSize) ** 2
    return math.log(dictionary_size(dictionary)) - bits * math.log(2.0)


def shortest_side(corners: Array) -> float:
    """Return the length of the shortest side of a quadrilateral (4, 2)."""
    c = corners.tolist()
    return min(math.hypot(c[k][0] - c[k - 1][0], c[k][1] - c[k - 1][1]) for k in range(4))


def _detect(detector: Any, gray: Image) -> list[Detection]:
    corners, ids, _ = detector.detectMarkers(gray)
    if ids is None:
        return []
    return [
        Detection(int(i), np.asarray(c, dtype=float).reshape(4, 2))
        for i, c in zip(np.asarray(ids).reshape(-1), corners, strict=True)
    ]


def _smooth(gray: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(gray, _SMOOTHING_KERNEL, 0.0), dtype=np.uint8)


def _sorted(detections: list[Detection]) -> list[Detection]:
    return sorted(detections, key=lambda d: (d.id, *d.corners[0]))


def _new(detections: list[Detection], known: list[Detection]) -> list[Detection]:
    """Return the detections of markers that are not among ``known``."""
    return [d for d in detections if not any(_same_marker(d, other) for other in known)]


def _same_marker(first: Detection, second: Detection) -> bool:
    distance = np.linalg.norm(first.corners.mean(axis=0) - second.corners.mean(axis=0))
    return first.id == second.id and float(distance) < 0.5 * shortest_side(first.corners)


def _parameters(window: int, tolerance: float, rate: float) -> cv2.aruco.DetectorParameters:
    """Return the parameters of a detector. Defaults differ between OpenCV releases.

    Args:
        window: Side of the window of the threshold, px.
        tolerance: Deviation of an outline from its quadrilateral, part of its length.
        rate: Part of the correctable bits that may be wrong.
    """
    p = cv2.aruco.DetectorParameters()
    p.adaptiveThreshWinSizeMin = window
    p.adaptiveThreshWinSizeMax = window
    p.polygonalApproxAccuracyRate = tolerance
    p.errorCorrectionRate = rate
    p.minMarkerPerimeterRate = _MIN_PERIMETER
    p.minMarkerDistanceRate = _MIN_MARKER_DISTANCE
    p.perspectiveRemovePixelPerCell = _CELL_SAMPLES
    p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    p.cornerRefinementWinSize = _REFINEMENT_WINDOW
    p.cornerRefinementMaxIterations = _REFINEMENT_STEPS
    p.detectInvertedMarker = False
    p.useAruco3Detection = False
    return p
