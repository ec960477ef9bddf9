"""The pose of a marked body from all of its print, not only from the sides of its markers.

The borders between the black and white cells of a marker are as sharp as its sides.  Starting from the pose
that the corners give, the print is fitted to the pixels directly: Gauss and Newton's method over the pose,
with light and blur of each marker as further unknowns.  What is best seen so is the tilt of a board that
faces the camera, which the corners know worst.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detection import Image
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, distort_point, from_pixel, lens_vector
from robot_ik.camera.observations import MarkerObservation, marker_points
from robot_ik.camera.pose_fit import SAME_ANGLE
from robot_ik.geometry import Pose, quat_multiply, rotation_exp, rotation_log
from robot_ik.kernels.jit import announce, kernel, outlined

# ------------------------------------------------------------------------------------------
# Normal equations of a marker's whole print, compiled: every border between its cells says where it is.
#
# Model of the grey value at a pixel that sees the print at (u, v), in sides of the marker, rows downwards:
#
#     I = dark(u, v) + contrast(u, v) * S(u, v)
#
# S is the print, 0 black and 1 white, blurred by a Gaussian of the picture; ``dark`` and ``contrast`` are
# linear.  A cell's share of S is an integral of a Gaussian over a rectangle.  Seen aslant, the Gaussian's
# u and
# v are correlated; the integral is then a series in the correlation r, whose terms are products of
# differences
# along u and v: of error functions, of r times bells, of r^2 / 2 times bells times their places, ….
# Source: Pearson, Mathematical contributions to the theory of evolution VII, Phil. Trans. R. Soc. A 195,
# 1900.


#: Unknowns: twist of the body (translation, rotation about its origin, camera axes), ln blur, dark and
#: contrast with their slopes along u and v.
UNKNOWNS = 13
TWIST = 6
# What is kept of a pixel: undistorted coordinates, their derivative by pixels (symmetric but for the focal
# lengths), grey value.
PIXEL_ROWS = 7
# Beyond so many standard deviations an edge is no longer felt.
_FAR = 3.2
_BELL, _ROOT_HALF = 1.0 / math.sqrt(2.0 * math.pi), math.sqrt(0.5)
# Residuals beyond this many standard deviations lose weight (Cauchy's function).
_CAUCHY = 4.0
# Where hardly anything changes (parts of the contrast a pixel), light is all there is to see: of such pixels
# one in so many is enough.
_FLAT, _SLOPE = 6, 0.02


@outlined
def cell_shares(place, width, count, shares):
    """Differences over the cells that are felt: of the normal distribution, its bell, and bell times place.

    Returns:
        The first of those cells and the one after the last.
    """
    inverse = 1.0 / width
    at, room = (place + 0.5) * count, _FAR * width * count
    first, last = max(math.floor(at - room), 0), min(math.floor(at + room) + 1, count)
    before, before_bell, before_z = 0.0, 0.0, 0.0
    for i in range(first, last + 1):
        z = (place + 0.5 - i / count) * inverse
        below, bell = (1.0 if z > 0.0 else 0.0), 0.0
        if abs(z) < _FAR:
            below, bell = 0.5 + 0.5 * math.erf(z * _ROOT_HALF), _BELL * math.exp(-0.5 * z * z)
        if i > first:
            shares[0, i - 1] = before - below
            shares[1, i - 1] = before_bell - bell
            shares[2, i - 1] = before_z * before_bell - z * bell
        before, before_bell, before_z = below, bell, z
    return first, last


@kernel
def take_print(gray, lens, box, to_print, reach, pixels):
    """Collects the pixels of a box (x0, y0, x1, y1) that see the print; how many.

    Args:
        gray: (h, w) uint8.
        lens: ``lens_vector``.
        box: Of whole pixels.
        to_print: (3, 3) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        reach: Pixels beyond ± this (u and v) are not taken.
        pixels: (7, k) out, with room for all of the box.
    """
    count = 0
    for py in range(box[1], box[3]):
        by = (py - lens[CY]) / lens[FY]
        x, y = from_pixel(lens, box[0], py)
        for px in range(box[0], box[2]):
            # One step of Newton's method from the pixel beside it is exact to 1e-9.
            tx, ty, xx, xy, yy = distort_point(lens, x, y)
            area = 1.0 / (xx * yy - xy * xy)
            ex, ey = tx - (px - lens[CX]) / lens[FX], ty - by
            x, y = x - (yy * ex - xy * ey) * area, y - (xx * ey - xy * ex) * area
            w = to_print[2, 0] * x + to_print[2, 1] * y + to_print[2, 2]
            u = (to_print[0, 0] * x + to_print[0, 1] * y + to_print[0, 2]) / w
            v = (to_print[1, 0] * x + to_print[1, 1] * y + to_print[1, 2]) / w
            if abs(u) < reach and abs(v) < reach and w > 0.0:
                pixels[0, count], pixels[1, count] = x, y
                pixels[2, count], pixels[3, count] = yy * area / lens[FX], -xy * area / lens[FY]
                pixels[4, count], pixels[5, count] = -xy * area / lens[FX], xx * area / lens[FY]
                pixels[6, count] = gray[py, px]
                count += 1
            x, y = x + yy * area / lens[FX], y - xy * area / lens[FX]
    return count


@kernel
def print_equations(pixels, count, black, to_print, origin, x, noise, work, normal, misses):
    """Sums the normal equations of one marker.

    Args:
        pixels: (7, k) of ``take_print``.  Those that tell nothing are left out when ``noise`` is 0.
        count: How many of them.
        black: (n, n) 1 where the print is black.
        to_print: As in ``take_print``.
        origin: (3,) of the body in the camera's frame, metres.
        x: (7,) blur in px, then dark and contrast with their slopes.
        noise: Standard deviation of a pixel, grey levels; 0: all weigh the same.
        work: (7, 13 or n) work space.
        normal: (13, 14) out: lower triangle, and the right side in the last column.
        misses: (k,) out: residuals of the pixels that were used.

    Returns:
        How many pixels were used.
    """
    n = black.shape[0]
    along, down, row = work[0:3], work[3:6], work[6]
    cauchy = 1.0 / (_CAUCHY * noise) ** 2 if noise > 0.0 else 0.0
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS + 1):
            normal[i, j] = 0.0
    used = 0
    for p in range(count):
        ix, iy = pixels[0, p], pixels[1, p]
        w = to_print[2, 0] * ix + to_print[2, 1] * iy + to_print[2, 2]
        u = (to_print[0, 0] * ix + to_print[0, 1] * iy + to_print[0, 2]) / w
        v = (to_print[1, 0] * ix + to_print[1, 1] * iy + to_print[1, 2]) / w
        # (u, v) by undistorted coordinates, then by pixels.
        ux, uy = (to_print[0, 0] - u * to_print[2, 0]) / w, (to_print[0, 1] - u * to_print[2, 1]) / w
        vx, vy = (to_print[1, 0] - v * to_print[2, 0]) / w, (to_print[1, 1] - v * to_print[2, 1]) / w
        gux, guy = ux * pixels[2, p] + uy * pixels[4, p], ux * pixels[3, p] + uy * pixels[5, p]
        gvx, gvy = vx * pixels[2, p] + vy * pixels[4, p], vx * pixels[3, p] + vy * pixels[5, p]
        wide, high = math.hypot(gux, guy), math.hypot(gvx, gvy)
        r = (gux * gvx + guy * gvy) / (wide * high)
        wide, high = wide * x[0], high * x[0]
        left, right = cell_shares(u, wide, n, along)
        top, bottom = cell_shares(v, high, n, down)
        light, by_u, by_v, by_blur = 1.0, 0.0, 0.0, 0.0
        for j in range(top, bottom):
            d0, d1, d2 = down[0, j], down[1, j], down[2, j]
            for i in range(left, right):
                if black[j, i] == 0.0:
                    continue
                a0, a1, a2 = along[0, i], along[1, i], along[2, i]
                light -= a0 * d0 + r * (a1 * d1 + 0.5 * r * a2 * d2)
                by_u -= a1 * d0 - r * a2 * d1
                by_v -= a0 * d1 - r * a1 * d2
                by_blur += a2 * d0 + a0 * d2
        by_u, by_v = by_u / wide, by_v / high
        flat = abs(by_u * gux + by_v * gvx) + abs(by_u * guy + by_v * gvy) < _SLOPE
        if flat and noise == 0.0 and p % _FLAT:
            continue
        first = TWIST if flat else 0
        contrast = x[4] + x[5] * u + x[6] * v
        miss = pixels[6, p] - (x[1] + x[2] * u + x[3] * v) - contrast * light
        # The print moves by a twist of the body: the pixel sees what was behind it.
        a, b = -contrast * (by_u * ux + by_v * vx) * w, -contrast * (by_u * uy + by_v * vy) * w
        c = -(a * ix + b * iy)
        rx, ry, rz = ix / w - origin[0], iy / w - origin[1], 1.0 / w - origin[2]
        row[0], row[1], row[2] = a, b, c
        row[3], row[4], row[5] = ry * c - rz * b, rz * a - rx * c, rx * b - ry * a
        row[6] = contrast * by_blur
        row[7], row[8], row[9] = 1.0, u, v
        row[10], row[11], row[12] = light, light * u, light * v
        weight = 1.0 / (1.0 + cauchy * miss * miss)
        for i in range(first, UNKNOWNS):
            share = weight * row[i]
            for j in range(first, i + 1):
                normal[i, j] += share * row[j]
            normal[i, UNKNOWNS] += share * miss
        misses[used] = miss
        if noise == 0.0:
            for i in range(PIXEL_ROWS):
                pixels[i, used] = pixels[i, p]
        used += 1
    return used


Array = NDArray[np.float64]

# White round the black square that is looked at, in cells.
_ROUND = 0.45
# Rounds: the first finds the light only.  A step so small, in standard deviations, is the last one.
_ROUNDS, _DONE = 8, 0.1
# The pose from the corners is left by no more than this many of its own standard deviations: of paper that
# ends near the print the corners are off by ten.
_FARTHEST = 20.0
# Blur to start from, px, and what it can be.
_BLUR, _SHARPEST, _SOFTEST = 0.8, 0.3, 4.0
# Keeps light and blur solvable, in parts of their own weight.
_RIDGE = 1e-9
# Noise of a print that can be believed, in parts of its contrast; grey levels of quantisation.
_NOISIEST, _LEAST_NOISE = 0.2, 0.3
# What print, paper and lens leave, as a part of the standard deviation from noise alone.
_MODEL = 0.25


# A marker's print is asked where its corners leave doubt: beyond this ambiguity, or this orientation, rad.
_AMBIGUOUS, _LOOSE = 0.25, float(np.deg2rad(0.5))


@dataclass(frozen=True, eq=False)
class PrintFit:
    """A pose fitted to pixels.

    Attributes:
        pose: ``pose_camera_body``.
        covariance: (6, 6) of it.
        squares: Mean square of the residuals, grey levels^2; what is far off counts as four sigmas.
        pixels: How many there were.
    """

    pose: Pose
    covariance: Array
    squares: float
    pixels: int

    def ahead_of(self, other: PrintFit) -> float:
        """By how much minus twice the log-likelihood is smaller than another's, the noise being unknown."""
        return min(self.pixels, other.pixels) * float(np.log(other.squares / self.squares))


@lru_cache(maxsize=256)
def _black(dictionary: str, marker_id: int) -> Array:
    return np.ascontiguousarray(marker_bits(dictionary, marker_id) == 0, dtype=float)


def fit_photometric_pose(
    gray: Image,
    layout: Mapping[int, tuple[float, Pose]],
    ids: Sequence[int],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    start: Pose,
    covariance: Array | None = None,
    look: Pose | None = None,
) -> PrintFit | None:
    """A better pose than ``start``; None where the print does not agree with it.

    Args:
        gray: (h, w) uint8, the whole picture.
        layout: Marker id -> (side in metres, ``pose_body_marker``).
        ids: The markers that were seen.
        dictionary: Of the markers.
        intrinsics: Of the picture.
        start: ``pose_camera_body`` from the corners.
        covariance: (6, 6) of it: what is found far beyond that is not believed.
        look: Pose by which pixels are chosen; None: ``start``.  Fits that are compared need the same pixels:
            a tenth of other ones makes as much noise as there is between a pose and its mirror image.
    """
    announce(print_equations, "the fit of the markers' prints")
    prints = [_Print(gray, _black(dictionary, i), *layout[i], intrinsics) for i in ids]
    pose = start
    for turn in range(_ROUNDS):
        # A print that is covered or spoilt says nothing; its corners have had their say.
        at = (look or start) if turn == 0 else pose
        prints = [one for one in prints if one.take(at, light_only=turn == 0)]
        if turn == 0:
            continue
        information = sum((one.information for one in prints), np.zeros((TWIST, TWIST)))
        right = sum((one.right for one in prints), np.zeros(TWIST))
        try:
            step = np.linalg.solve(information, right)
        except np.linalg.LinAlgError:
            return None
        pose = Pose(pose.position + step[:3], quat_multiply(rotation_exp(step[3:]), pose.wxyz))
        if step @ information @ step < _DONE**2:
            break
    else:
        return None
    if covariance is not None:
        off = np.concatenate([pose.position - start.position, _turn(start, pose)])
        if not off @ np.linalg.solve(covariance, off) < _FARTHEST**2:
            return None
    wide = np.asarray(np.linalg.inv(information) * (1.0 + _MODEL) ** 2, dtype=float)
    squares = np.concatenate([one.squares for one in prints])
    return PrintFit(pose, wide, float(np.mean(squares)), len(squares))


def _turn(start: Pose, pose: Pose) -> Array:
    return np.asarray(rotation_log(pose.compose(start.inverse()).wxyz), dtype=float)


def doubtful(seen: MarkerObservation) -> bool:
    """Whether the corners of a marker leave doubt about its orientation."""
    return seen.refined and (
        seen.ambiguity > _AMBIGUOUS or float(np.trace(seen.covariance[3:, 3:])) > _LOOSE**2
    )


def seen_by_print(
    gray: Image, seen: MarkerObservation, size: float, dictionary: str, intrinsics: CameraIntrinsics
) -> MarkerObservation:
    """A single marker with the one of its two poses that its print agrees with, or as it was.

    Args:
        gray: (h, w) uint8, the whole picture.
        seen: By its corners.
        size: Side of the black square, metres.
        dictionary: Of the marker.
        intrinsics: Of the picture.
    """
    starts = [seen.pose] if seen.alternative is None else [seen.pose, seen.alternative]
    layout = {seen.id: (size, Pose())}
    found = [
        fit_photometric_pose(gray, layout, [seen.id], dictionary, intrinsics, start, look=seen.pose)
        for start in starts
    ]
    fits = sorted((one for one in found if one is not None), key=lambda one: one.squares)
    if not fits:
        return seen
    best, others = fits[0], [one for one in fits[1:] if one.pose.distance(fits[0].pose)[1] > SAME_ANGLE]
    off = intrinsics.project(best.pose.apply(marker_points(size))) - seen.corners
    # As of the corners: the expected cost, of two degrees of freedom, is added to both.
    ambiguity = float(np.sqrt(2.0 / (2.0 + best.ahead_of(others[0])))) if others else 0.0
    return replace(
        seen, pose=best.pose, covariance=best.covariance, ambiguity=ambiguity,
        alternative=others[0].pose if others else None,
        reprojection_error=float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    )  # fmt: skip


class _Print:
    """One marker of the body in the picture: its light and blur, and what it says of the body's pose."""

    def __init__(
        self, gray: Image, black: Array, size: float, pose: Pose, intrinsics: CameraIntrinsics
    ) -> None:
        self._gray, self._black, self._size, self._pose = gray, black, size, pose
        self._intrinsics = intrinsics
        self._reach = 0.5 + _ROUND / len(black)
        self._x = np.array([_BLUR, *[0.0] * 6])
        self._noise, self._first = 0.0, True
        self._work, self._normal = (
            np.empty((7, max(UNKNOWNS, len(black)))),
            np.empty((UNKNOWNS, UNKNOWNS + 1)),
        )
        self._pixels, self._misses, self._count = np.empty((PIXEL_ROWS, 0)), np.empty(0), 0
        self.information, self.right = np.zeros((TWIST, TWIST)), np.zeros(TWIST)

    def take(self, pose: Pose, *, light_only: bool) -> bool:
        """Linear at a pose of the body; light and blur take their own step.  False: this is no such print."""
        to_print = self._to_print(pose)
        if light_only and not self._collect(pose, to_print):
            return False
        used = print_equations(
            self._pixels, self._count, self._black, to_print, pose.position, self._x, self._noise,
            self._work, self._normal, self._misses,
        )  # fmt: skip
        if used < 2 * UNKNOWNS:
            return False
        self._count = used
        matrix = np.tril(self._normal[:, :UNKNOWNS])
        matrix = matrix + np.tril(matrix, -1).T
        right = self._normal[:, UNKNOWNS]
        own = slice(TWIST + 1 if light_only else TWIST, UNKNOWNS)
        scale = np.sqrt(np.maximum(np.diag(matrix)[own], 1e-12))
        outer = np.outer(scale, scale)
        inverse = np.linalg.inv(matrix[own, own] / outer + _RIDGE * np.eye(len(scale))) / outer
        if light_only or self._first:
            self._noise = max(1.4826 * float(np.median(np.abs(self._misses[:used]))), _LEAST_NOISE)
            self._first = light_only
        step = inverse @ right[own]
        self._x[1:] += step[-6:]
        if light_only:
            return True
        self._x[0] = min(max(self._x[0] * np.exp(min(max(step[0], -0.4), 0.4)), _SHARPEST), _SOFTEST)
        along = matrix[:TWIST, own] @ inverse
        self.information = (matrix[:TWIST, :TWIST] - along @ matrix[own, :TWIST]) / self._noise**2
        self.right = (right[:TWIST] - along @ right[own]) / self._noise**2
        return self._noise < _NOISIEST * float(self._x[4])

    @property
    def squares(self) -> Array:
        """(k,) squares of the residuals; what is far off counts as four standard deviations."""
        return np.asarray(np.minimum(self._misses[: self._count] ** 2, (4.0 * self._noise) ** 2), dtype=float)

    def _to_print(self, pose: Pose) -> Array:
        at = pose.compose(self._pose)
        axes = self._size * at.rotation
        return np.asarray(np.linalg.inv(np.column_stack([axes[:, 0], -axes[:, 1], at.position])))

    def _collect(self, pose: Pose, to_print: Array) -> bool:
        """The pixels, chosen once; False when the print is not in the picture."""
        corners = pose.compose(self._pose).apply(marker_points(2.0 * self._reach * self._size))
        if not corners[:, 2].min() > 0.0:
            return False
        outline = self._intrinsics.project(corners)
        size = np.array(self._intrinsics.size)
        low = np.clip(np.floor(outline.min(axis=0)), 0, size).astype(np.int64)
        high = np.clip(np.ceil(outline.max(axis=0)) + 1, 0, size).astype(np.int64)
        room = int(np.prod(high - low))
        self._pixels, self._misses = np.empty((PIXEL_ROWS, room)), np.empty(room)
        self._count = take_print(
            self._gray, lens_vector(self._intrinsics), np.concatenate([low, high]), to_print, self._reach,
            self._pixels,
        )  # fmt: skip
        return self._count > 0
