"""Sub-pixel marker corners: straight lines fitted to the marker's edges in undistorted coordinates.

A printed edge is straight in the world, bent in the picture and straight again after the lens has been
undone.  So each side of the black square is one line in undistorted coordinates; its place is fitted to the
pixels along the bent curve that this line makes in the picture; the corners are where neighbouring lines
meet.  Unlike corner operators, which look at the rounded corner itself, this has no inward bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.detect import Image, to_gray
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens_kernels import CX, CY, FX, FY, lens_vector
from robot_ik.camera.reduction import from_reduced, reduced, to_reduced
from robot_ik.camera.refine.kernel import refine_corners_of
from robot_ik.kernels.jit import announce

Array = NDArray[np.float64]

# What cannot be fitted may be too soft: it is tried in a smaller picture, while cells keep this width, px.
# With smaller cells it may be too sharp for its pixels: it is tried in a larger one.
_LEAST_CELL = 5.0
# Corners straight from the detector scatter by 0.8 px (measured on the standard set, all distances).
DETECTOR_SIGMA = 0.85


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Corners of one marker.

    Attributes:
        corners: (4, 2) distorted pixels.
        ideal: (4, 2) undistorted normalised coordinates.
        covariance: (8, 8) of the corners in px^2, order x0 y0 x1 y1 ….  Neighbours are correlated, for
            they share an edge.
        sigma: Root mean square of the standard deviations of the eight numbers, px.
        refined: False: the fit failed and these are the detector's corners with their large sigma.
    """

    corners: Array
    ideal: Array
    covariance: Array
    sigma: float
    refined: bool


def unrefined(
    corners: ArrayLike, intrinsics: CameraIntrinsics, sigma: float = DETECTOR_SIGMA
) -> RefinedCorners:
    """Corners (4, 2) in distorted pixels taken as they are, with the standard deviation ``sigma`` in px."""
    pixels = np.array(corners, dtype=float).reshape(4, 2)
    return RefinedCorners(pixels, intrinsics.undistort(pixels), np.eye(8) * sigma**2, sigma, False)


def refine_corners(
    gray: Image, corners: ArrayLike, intrinsics: CameraIntrinsics, *, cells: int = 8
) -> tuple[Array, float]:
    """Refines the corners of one marker.

    Args:
        gray: (h, w) or (h, w, 3) uint8, raw picture.
        corners: (4, 2) rough corners in distorted pixels, right to about 2 px.
        intrinsics: Of this picture's size.
        cells: Cells along a side with the black border, so that the next cell is not taken for the edge.

    Returns:
        Corners (4, 2) in distorted pixels and their standard deviation in px.  When the edges cannot be
        fitted, the rough corners and ``DETECTOR_SIGMA``.
    """
    result = refine_markers(gray, [corners], intrinsics, cells=cells)[0]
    return result.corners, result.sigma


def refine_markers(
    image: Image,
    markers: Sequence[ArrayLike],
    intrinsics: CameraIntrinsics,
    *,
    cells: int = 8,
    origin: tuple[int, int] = (0, 0),
) -> list[RefinedCorners]:
    """Refines the corners of several markers at once.

    Args:
        image: As in ``refine_corners``; or a part of the picture that holds the markers.
        markers: Rough corners (4, 2) of each, in distorted pixels of the whole picture.
        intrinsics: Of the whole picture.
        cells: As in ``refine_corners``.
        origin: Pixel (x, y) of the whole picture at which the part begins.
    """
    if not len(markers):
        return []
    announce(refine_corners_of, "the refinement of marker corners")
    gray = np.ascontiguousarray(to_gray(image))
    corners = np.array(markers, dtype=float).reshape(-1, 4, 2)
    ideal, covariance = np.empty_like(corners), np.empty((len(corners), 8, 8))
    good = np.zeros(len(corners), np.int64)
    lens = lens_vector(intrinsics)
    if origin != (0, 0):
        lens = lens.copy()
        lens[CX] -= origin[0]
        lens[CY] -= origin[1]
        corners -= origin
    refine_corners_of(gray, lens, cells, corners, ideal, covariance, good)
    for k in np.flatnonzero(good == 0):
        other = _refine_in_another_size(gray, lens, cells, corners[k])
        if other is not None:
            corners[k], ideal[k], covariance[k], good[k] = *other, 1
    corners += origin
    return [
        RefinedCorners(c, i, v, math.sqrt(v.trace() / 8), True) if fine else unrefined(c, intrinsics)
        for c, i, v, fine in zip(corners, ideal, covariance, good, strict=True)
    ]


def _refine_in_another_size(
    gray: Image, lens: Array, cells: int, corners: Array
) -> tuple[Array, Array, Array] | None:
    """Corners, their ideal ones and their covariance from a larger picture, or one reduced until it is sharp.

    Args:
        gray: (h, w).
        lens: As for the kernels, of this picture.
        cells: Along a side.
        corners: (4, 2) rough ones.
    """
    side = math.sqrt(abs(_area(corners)))
    sizes = [2.0**k for k in range(1, 8) if side / 2.0**k > _LEAST_CELL * cells]
    for reduction in sizes or [0.5]:
        # A part with the white round the marker is enough; it begins at a pixel of the smaller picture.
        grid = max(round(reduction), 1)
        low = np.maximum(np.floor((corners.min(axis=0) - 0.5 * side) / grid), 0.0).astype(int) * grid
        high = np.maximum(np.ceil(corners.max(axis=0) + 0.5 * side), -1.0).astype(int)
        if (np.minimum(high + 1, gray.shape[::-1]) - low < grid).any():
            return None  # none of it is in the picture
        part = gray[low[1] : high[1] + 1, low[0] : high[0] + 1]
        small = lens.copy()
        small[[FX, FY]] /= reduction
        small[[CX, CY]] = to_reduced(lens[[CX, CY]] - low, reduction)
        found = to_reduced(corners - low, reduction)[None]
        ideal, covariance = np.empty_like(found), np.empty((1, 8, 8))
        good = np.zeros(1, np.int64)
        refine_corners_of(_resized(part, reduction), small, cells, found, ideal, covariance, good)
        if good[0]:
            # Pixels between pixels know nothing new: the covariance stays that of as many as there are.
            known = max(reduction, 1.0)
            return from_reduced(found[0], reduction) + low, ideal[0], covariance[0] * known**2
    return None


def _resized(part: Image, reduction: float) -> Image:
    if reduction >= 1.0:
        return np.ascontiguousarray(reduced(part, round(reduction)))
    larger = cv2.resize(part, (0, 0), fx=1.0 / reduction, fy=1.0 / reduction, interpolation=cv2.INTER_CUBIC)
    return np.asarray(larger, dtype=np.uint8)


def _area(corners: Array) -> float:
    x, y = corners.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
