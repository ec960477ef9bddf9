"""The pose of a marked body from all of its print, not only from the sides of its markers.

The borders between the black and white cells of a marker are as sharp as its sides.  Starting from the pose
that the corners give, the print is fitted to the pixels directly: Gauss and Newton's method over the pose,
with light and blur of each marker as further unknowns.  What is best seen so is the tilt of a board that
faces the camera, which the corners know worst.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect import Image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens_kernels import lens_vector
from robot_ik.camera.opencv import marker_bits
from robot_ik.camera.pose.branches import SAME_ANGLE
from robot_ik.camera.pose.cells_kernel import PIXEL_ROWS, TWIST, UNKNOWNS, print_equations, take_print
from robot_ik.camera.pose.marker import MarkerObservation, marker_points
from robot_ik.geometry import Pose, quat_multiply, rotation_exp, rotation_log
from robot_ik.kernels.jit import announce

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


def fit_print(
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
        fit_print(gray, layout, [seen.id], dictionary, intrinsics, start, look=seen.pose) for start in starts
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
