"""Marker corners from all of the print, in the picture's own grey values, whatever the camera did to them.

The borders between the black and white cells of a marker are as sharp as its sides, and there are many more
of them.  ``corner_refinement`` takes the place where grey is half way between black and white for an edge.
That is right for a camera whose grey values are proportional to light.  Webcams, telephones and JPEG files
have a tone curve; bloom and ink that bleeds do the same: the half way moves, mostly into the black, by a part
of the blur, and every marker looks smaller than it is.  Since the print has black cells in white and white
cells in black, it says by how much: the shift is one more unknown of the fit
(``photometric_equations`` has the model).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.corner_refinement import RefinedCorners
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
    CORNERS,
    COVARIANCE,
    EDGE_BLUR,
    FIT_ROWS,
    FROM_PRINT,
    LEAST_EXPLAINED,
    LEAST_SIGMA,
    MODEL,
    MODEL_NUMBERS,
    NO_PRINT,
    NOT_FITTED,
    REPORT,
    REPORT_NUMBERS,
    SEEN,
    fit_photometric,
)
from robot_ik.kernels.jit import announce
from robot_ik.ports import Array, Image

# White round the black square that is looked at, in cells.
_MARGIN = 0.45
# Blur of an edge, px, and what it is believed to be before it is measured, as ln.
_BLUR, _BLUR_SPREAD = 0.8, 0.6
#: Edge shift and its spread for a camera of which nothing is known: none for a linear one, 0.5 for sRGB.
UNKNOWN_SHIFT = (0.25, 0.35)
# Pixels of a print that are looked at, about, and of those near an edge that are fitted, at most: of a
# picture alone, where more make no marker better than the model is; and in films: the next one comes soon.
_SINGLE, _FILM = (9000, 2200), (2500, 1000)
# Spread of the edge shift between the markers of a picture (light, printing).
_SHIFT_ALIKE = 0.08
# Standard deviation of the edge shift by side lines, as a part of it.
_SHIFT_PART = 0.05


@dataclass(frozen=True)
class EdgeShift:
    """How far edges seem to lie in the black, in sigmas of the blur: what a camera's tone curve does.

    Attributes:
        value: 0 for a camera whose grey values are proportional to light, about 0.5 for sRGB.
        sigma: Standard deviation.
    """

    value: float = UNKNOWN_SHIFT[0]
    sigma: float = UNKNOWN_SHIFT[1]

    @classmethod
    def of(cls, intrinsics: CameraIntrinsics) -> EdgeShift:
        """What is known of a camera beforehand: by its calibration, if that has measured it."""
        if intrinsics.edge_shift is None:
            return cls()
        return cls(intrinsics.edge_shift, max(intrinsics.edge_shift_sigma or 0.0, _SHIFT_ALIKE))


def refine_prints(
    image: Image,
    sides: Sequence[RefinedCorners],
    ids: Sequence[int],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    *,
    origin: tuple[int, int] = (0, 0),
    film: bool = False,
    before: Mapping[int, RefinedCorners] = MappingProxyType({}),
) -> list[RefinedCorners]:
    """Corners of several markers by all of their prints.

    Where a print cannot be fitted its side lines are moved outwards by the edge shift of the others, or by
    what is known of the camera's, and are as uncertain as that.

    Args:
        image: (h, w) or (h, w, 3) uint8; or a part of the picture that holds the markers.
        sides: Corners by ``refine_markers``, to start from.
        ids: Of the markers.
        dictionary: Of all of them.
        intrinsics: Of the whole picture.
        origin: Pixel (x, y) of the whole picture at which the part begins.
        film: The next picture comes soon: a fit uses fewer pixels.
        before: Of the last picture, by id: a fit starts from what was found there.
    """
    if not len(sides):
        return []
    announce(fit_photometric, "the fit of the markers' prints")
    gray, expected = to_gray(image), EdgeShift.of(intrinsics)
    lens = lens_vector(intrinsics).copy()
    lens[CX] -= origin[0]
    lens[CY] -= origin[1]
    fits = []
    for i, start in zip(ids, sides, strict=True):
        black, last = marker_black(dictionary, i), before.get(i)
        one = _fitted(gray, lens, black, start, origin, expected, film, last)
        if last is not None and not one.by_print:
            one = _fitted(gray, lens, black, start, origin, expected, film, None)
        fits.append(one)
    allowed = correctable(dictionary)
    fits = [replace(one, misread=max(0, one.misread - allowed)) if one.misread else one for one in fits]
    if all(one.by_print or not one.refined for one in fits):
        return fits
    shift = _common_shift([one for one in fits if one.by_print], expected)
    return [
        one if one.by_print or not one.refined else moved_outwards(one, shift, intrinsics) for one in fits
    ]


def is_print(corners: RefinedCorners) -> bool:
    """Whether the picture shows the marker's print there, and not something with a like code."""
    return corners.misread == 0 and not corners.explained < LEAST_EXPLAINED


def _common_shift(fitted: Sequence[RefinedCorners], expected: EdgeShift) -> EdgeShift:
    """The edge shift of a picture from that of its prints."""
    values = [(expected.value, expected.sigma), *((f.edge_shift, f.edge_shift_sigma) for f in fitted)]
    weights = np.array([1.0 / (sigma**2 + _SHIFT_ALIKE**2) for _, sigma in values])
    mean = float(weights @ [value for value, _ in values] / weights.sum())
    return EdgeShift(mean, math.sqrt(1.0 / weights.sum() + (_SHIFT_ALIKE**2 if fitted else 0.0)))


def moved_outwards(sides: RefinedCorners, shift: EdgeShift, intrinsics: CameraIntrinsics) -> RefinedCorners:
    """Corners whose side lines lie where the edges are: outwards by the edge shift."""
    along = np.roll(sides.corners, -1, axis=0) - sides.corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    orientation = np.sign(along[0, 0] * along[1, 1] - along[0, 1] * along[1, 0])
    normals = orientation * np.stack([along[:, 1], -along[:, 0]], axis=1)
    both = np.stack([normals, np.roll(normals, 1, axis=0)], axis=1)
    by_push = np.linalg.solve(both, np.ones((4, 2, 1)))[..., 0]
    corners = sides.corners + shift.value * sides.blur * by_push
    far = sides.blur * math.hypot(shift.sigma, _SHIFT_PART * shift.value)
    wide = sides.covariance + (far**2 + LEAST_SIGMA**2) * np.outer(by_push, by_push)
    return replace(
        sides, corners=corners, normalized=intrinsics.undistort(corners), covariance=wide,
        sigma=math.sqrt(wide.trace() / 8), edge_shift=shift.value, edge_shift_sigma=shift.sigma,
    )  # fmt: skip


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
    expected: EdgeShift,
    film: bool,
    before: RefinedCorners | None,
) -> RefinedCorners:
    """Corners by one print; where that fails those of the sides, with how much the print explains."""
    blur, push = (start.blur, start.blur * expected.value) if start.refined else (_BLUR, 0.0)
    from_print, seen = _homography(start.normalized), _homography(start.corners - origin)
    reach, (sampled, most) = 0.5 + _MARGIN / len(black), _FILM if film else _SINGLE
    found = None if from_print is None or seen is None else _box(seen, gray.shape, reach, sampled)
    if found is None:
        return replace(start, explained=math.nan, misread=0)
    box, capacity = found
    fit, pixels, residuals = (
        np.zeros((FIT_ROWS, BLOCK)),
        np.empty((PIXEL_ROWS, capacity)),
        np.empty((RESIDUAL_ROWS, capacity)),
    )
    fit[FROM_PRINT, :9], fit[SEEN, :9] = from_print, seen
    fit[CORNERS : CORNERS + 4, :2] = start.corners - origin
    fit[PRIOR_MEAN, BLUR], fit[PRIOR_MEAN, SHIFT] = math.log(blur), expected.value
    fit[PRIOR_INFORMATION, BLUR], fit[PRIOR_INFORMATION, SHIFT], fit[PRIOR_INFORMATION, HALO] = (
        1.0 / _BLUR_SPREAD**2,
        1.0 / expected.sigma**2,
        FIXED_INFORMATION,
    )
    if before is not None and before.model is not None:
        push = before.blur * before.edge_shift if start.refined else push
        fit[MODEL, :MODEL_NUMBERS] = before.model
        fit[REPORT, EDGE_BLUR:REPORT_NUMBERS] = before.blur, before.edge_shift, before.edge_shift_sigma
    state = fit_photometric(gray, lens, box, reach, push, black, fit, pixels, residuals, most)
    if state == NO_PRINT:
        return replace(start, explained=math.nan, misread=0)
    explained, misread, *edges = fit[REPORT, :REPORT_NUMBERS].tolist()
    if state == NOT_FITTED:
        return replace(start, explained=explained, misread=int(misread))
    corners, covariance = fit[CORNERS : CORNERS + 4], fit[COVARIANCE : COVARIANCE + 8, :8].copy()
    return RefinedCorners(
        corners[:, :2] + origin, corners[:, 2:4].copy(), covariance, math.sqrt(covariance.trace() / 8), True,
        blur=edges[0], edge_shift=edges[1], edge_shift_sigma=edges[2], explained=explained,
        misread=int(misread), by_print=True, model=tuple(fit[MODEL, :MODEL_NUMBERS].tolist()),
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
