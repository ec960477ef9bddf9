"""Marker corners from all of the print, in the picture's own grey values, whatever the camera did to them.

The borders between the black and white cells of a marker are as sharp as its sides, and there are many more
of them.  An edge seems to be where grey is half way between black and white.  That is right for a camera
whose grey values are proportional to light.  Webcams, telephones and JPEG files have a tone curve; bloom and
ink that bleeds do the same: the half way moves, mostly into the black, by a part of the blur, and every
marker looks smaller than it is.  Since the print has black cells in white and white cells in black, it says
by how much: the shift is one more unknown of the fit (``photometric_equations`` has the model).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.detection import correctable
from robot_ik.camera.image import marker_bits, to_gray
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, lens_vector
from robot_ik.camera.photometric_equations import (
    BLOCK,
    BLUR,
    FIXED_INFORMATION,
    HALO,
    PIXEL_ROWS,
    PRIOR_INFORMATION,
    PRIOR_MEAN,
    RESIDUAL_ROWS,
    SHIFT,
)
from robot_ik.camera.photometric_fit import (
    BY_PRINT,
    CORNERS,
    COVARIANCE,
    EXPLAINED,
    FIT_ROWS,
    FROM_PRINT,
    LEAST_EXPLAINED,
    MISREAD,
    MODEL,
    MODEL_NUMBERS,
    NO_PRINT,
    REPORT,
    SEEN,
    fit_photometric,
)
from robot_ik.kernels.jit import announce
from robot_ik.ports import Array, Image

# Corners straight from the detector scatter by 0.8 px (measured on the standard set, all distances).
DETECTOR_SIGMA = 0.85
# White round the black square that is looked at, in cells.
_MARGIN = 0.45
# Blur of an edge, px, and what it is believed to be before it is measured, as ln.
_BLUR, _BLUR_SPREAD = 0.8, 0.6
# Edge shift and its spread for a camera of which nothing is known: none for a linear one, 0.5 for sRGB.
_UNKNOWN_SHIFT = (0.25, 0.35)
# Spread of the edge shift between the markers of a picture (light, printing).
_SHIFT_ALIKE = 0.08
# Pixels of a print that are looked at, about, and of those near an edge that are fitted, at most: of a
# picture alone, where more make no marker better than the model is; and in films: the next one comes soon.
_SINGLE, _FILM = (9000, 2200), (2500, 1000)


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Corners of one marker.

    Attributes:
        corners: (4, 2) distorted pixels.
        normalized: (4, 2) undistorted normalised coordinates.
        covariance: (8, 8) of the corners in px^2, order x0 y0 x1 y1 ….
        sigma: Root mean square of the standard deviations of the eight numbers, px.
        refined: False: the fit failed and these are the detector's corners with their large sigma.
        explained: Part of the variance of the grey values that the marker's print explains; NaN: not asked.
        misread: Cells that the picture shows otherwise than the print, beyond what its dictionary allows.
        model: Numbers of the fit of the print, for that of the next picture to start from.
    """

    corners: Array
    normalized: Array
    covariance: Array
    sigma: float
    refined: bool
    explained: float = float("nan")
    misread: int = 0
    model: tuple[float, ...] = ()


def unrefined(
    corners: ArrayLike, intrinsics: CameraIntrinsics, sigma: float = DETECTOR_SIGMA
) -> RefinedCorners:
    """Corners (4, 2) in distorted pixels taken as they are, with the standard deviation ``sigma`` in px."""
    pixels = np.array(corners, dtype=float).reshape(4, 2)
    return RefinedCorners(pixels, intrinsics.undistort(pixels), np.eye(8) * sigma**2, sigma, False)


def refine_markers(
    image: Image,
    markers: Sequence[ArrayLike],
    ids: Sequence[int],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    *,
    origin: tuple[int, int] = (0, 0),
    film: bool = False,
    before: Mapping[int, RefinedCorners] = MappingProxyType({}),
) -> list[RefinedCorners]:
    """Corners of several markers by all of their prints; where a print cannot be fitted, ``unrefined`` ones.

    Args:
        image: (h, w) or (h, w, 3) uint8, raw; or a part of the picture that holds the markers.
        markers: Rough corners (4, 2) of each, in distorted pixels of the whole picture, right to about 2 px.
        ids: Of the markers.
        dictionary: Of all of them.
        intrinsics: Of the whole picture.
        origin: Pixel (x, y) of the whole picture at which the part begins.
        film: The next picture comes soon: a fit uses fewer pixels.
        before: Of the last picture, by id: a fit starts from what was found there.
    """
    if not len(markers):
        return []
    announce(fit_photometric, "the fit of the markers' prints")
    gray, shift = to_gray(image), expected_shift(intrinsics)
    lens = lens_vector(intrinsics).copy()
    lens[CX] -= origin[0]
    lens[CY] -= origin[1]
    allowed, refined = correctable(dictionary), []
    for marker_id, corners in zip(ids, markers, strict=True):
        black, last = marker_black(dictionary, marker_id), before.get(marker_id)
        start, model = unrefined(corners, intrinsics), last.model if last is not None else ()
        one = _fitted(gray, lens, black, start, origin, shift, film, model, allowed)
        if model and not one.refined:
            one = _fitted(gray, lens, black, start, origin, shift, film, (), allowed)
        refined.append(one)
    return refined


def is_print(corners: RefinedCorners) -> bool:
    """Whether the picture shows the marker's print there, and not something with a like code."""
    return corners.misread == 0 and not corners.explained < LEAST_EXPLAINED


def expected_shift(intrinsics: CameraIntrinsics) -> tuple[float, float]:
    """How far edges seem to lie in the black, in sigmas of the blur, and how sure that is before a picture.

    By the camera's calibration, if that has measured it: 0 for a camera whose grey values are proportional to
    light, about 0.5 for sRGB.
    """
    if intrinsics.edge_shift is None:
        return _UNKNOWN_SHIFT
    return intrinsics.edge_shift, max(intrinsics.edge_shift_sigma or 0.0, _SHIFT_ALIKE)


@lru_cache(maxsize=256)
def marker_black(dictionary: str, marker_id: int) -> Array:
    """(n, n) cells of a marker with its border, 1 where they are black."""
    return np.ascontiguousarray(marker_bits(dictionary, marker_id) == 0, dtype=float)


def _fitted(
    gray: Image,
    lens: Array,
    black: Array,
    start: RefinedCorners,
    origin: tuple[int, int],
    shift: tuple[float, float],
    film: bool,
    model: tuple[float, ...],
    allowed: int,
) -> RefinedCorners:
    """Corners by one print; where that fails those of the start, with how much the print explains.

    ``model`` is what a fit of the last picture found; so many cells that are ``allowed`` count as read.
    """
    from_print, seen = _homography(start.normalized), _homography(start.corners - origin)
    reach, (sampled, most) = 0.5 + _MARGIN / len(black), _FILM if film else _SINGLE
    found = None if from_print is None or seen is None else _box(seen, gray.shape, reach, sampled)
    if found is None:
        return start
    box, capacity = found
    fit = np.zeros((FIT_ROWS, BLOCK))
    pixels, residuals = np.empty((PIXEL_ROWS, capacity)), np.empty((RESIDUAL_ROWS, capacity))
    fit[FROM_PRINT, :9], fit[SEEN, :9] = from_print, seen
    fit[CORNERS : CORNERS + 4, :2] = start.corners - origin
    fit[MODEL, : len(model)] = model
    fit[PRIOR_MEAN, BLUR], fit[PRIOR_MEAN, SHIFT] = math.log(_BLUR), shift[0]
    fit[PRIOR_INFORMATION, BLUR], fit[PRIOR_INFORMATION, SHIFT] = 1.0 / _BLUR_SPREAD**2, 1.0 / shift[1] ** 2
    fit[PRIOR_INFORMATION, HALO] = FIXED_INFORMATION
    state = fit_photometric(gray, lens, box, reach, black, fit, pixels, residuals, most)
    if state == NO_PRINT:
        return start
    explained, misread = float(fit[REPORT, EXPLAINED]), max(0, int(fit[REPORT, MISREAD]) - allowed)
    if state != BY_PRINT:
        return replace(start, explained=explained, misread=misread)
    corners, covariance = fit[CORNERS : CORNERS + 4], fit[COVARIANCE : COVARIANCE + 8, :8].copy()
    return RefinedCorners(
        corners[:, :2] + origin, corners[:, 2:4].copy(), covariance, math.sqrt(covariance.trace() / 8), True,
        explained, misread, tuple(fit[MODEL, :MODEL_NUMBERS].tolist()),
    )  # fmt: skip


def _homography(corners: Array) -> tuple[float, ...] | None:
    """(9,) from the print to its corners (4, 2) (Heckbert, 1989); None where these are on one line."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners.tolist()
    ax, ay, bx, by = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    sx, sy, area = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3, (x1 - x2) * (y3 - y2) - (y1 - y2) * (x3 - x2)
    if not abs(area) > 0.0:
        return None
    g, h = (sx * by - bx * sy) / area, (ax * sy - sx * ay) / area
    a, b, d, e = x1 - x0 + g * x1, x3 - x0 + h * x3, y1 - y0 + g * y1, y3 - y0 + h * y3
    return a, b, x0 + 0.5 * (a + b), d, e, y0 + 0.5 * (d + e), g, h, 1.0 + 0.5 * (g + h)


def _box(
    seen: Sequence[float], shape: tuple[int, ...], reach: float, most: int
) -> tuple[NDArray[np.int64], int] | None:
    """Whole pixels (x0, y0, x1, y1) round a print and one in how many is looked at; how many that may be.

    ``seen`` (9,) is from the print to pixels, ``reach`` of the print u and v to each side, ``most`` about
    enough pixels.  None where the print is not in the picture of this ``shape``.
    """
    a, b, c, d, e, f, g, h, i = seen
    xs, ys, least = [], [], math.inf
    for u, v in ((-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)):
        depth = g * u + h * v + i
        least = min(least, depth)
        xs.append((a * u + b * v + c) / depth)
        ys.append((d * u + e * v + f) / depth)
    x0, y0, x1, y1 = min(xs), min(ys), max(xs), max(ys)
    height, width = shape
    if not (least > 0.0 and x1 > 0.0 and y1 > 0.0 and x0 < width - 1.0 and y0 < height - 1.0):
        return None
    share = 0.5 * abs((xs[2] - xs[0]) * (ys[3] - ys[1]) - (ys[2] - ys[0]) * (xs[3] - xs[1])) / most
    every = max(int(share + 0.5), 1) if share < 2.5 else 2 * int(0.5 * share) + 1
    left, top = max(math.floor(x0), 0), max(math.floor(y0), 0)
    right, bottom = min(math.ceil(x1) + 1, width), min(math.ceil(y1) + 1, height)
    return np.array((left, top, right, bottom, every)), ((right - left) // every + 1) * (bottom - top)
