"""Intrinsics from views of a flat pattern: OpenCV's bundle adjustment, and its uncertainty.

The formal standard deviations of a bundle adjustment assume independent errors of the corners. They
are about half of the real error: boards are bent, and no lens fits its model exactly. The views are
therefore also divided into groups, and the calibration is repeated without each of them. The spread
of the results is the delete-a-group jackknife (Kott 2001), and the left-out views give the error on
pictures that were not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from robot_ik.camera.calibration.coverage import Coverage, cover
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import FoundPattern
from robot_ik.errors import CalibrationError
from robot_ik.ports import Array

#: With fewer views the principal point is off by some pixels.
ENOUGH_VIEWS = 15
#: Smallest number of views. A homography gives two equations for the five unknowns of a pinhole;
#: lens and noise need many more.
FEWEST_VIEWS = 6

# A result is doubtful above these standard deviations: parts of the focal length, and of the width.
_FOCAL_DOUBT = 0.003
_CENTRE_DOUBT = 0.004
# A result is doubtful above this reprojection error, px.
_FAIR_RMS = 0.5
# A result is doubtful if left-out views fit worse by this factor and by this error, px.
_HOLD_OUT_RATIO = 1.6
_HOLD_OUT_PIXELS = 0.05
# Reprojection error beyond which a calibration is refused, px.
_MAX_RMS = 1.0
# Smallest tilt of a board, degrees. Without tilt, focal length and distance cannot be separated.
_MIN_TILT_DEG = 12.0
# Number of groups of the jackknife.
_GROUPS = 5
# A view is left out if it is worse than the median view by this factor, and worse than this, px.
_OUTLIER_RATIO = 3.0
_OUTLIER_PIXELS = 0.25
# A picture was moved if its edges are wider than the median by this factor, and than this, px.
_BLUR_RATIO = 1.8
_BLUR_PIXELS = 2.0
# Three coefficients that lower the error by less than this factor describe noise.
_MIN_GAIN = 1.03
# Three coefficients that lower the error of the median view by this factor describe the lens.
_CLEAR_GAIN = 1.5
# Largest number of iterations of OpenCV's bundle adjustment. OpenCV 4 stops after 30 by default,
# where the fit of a lens of 94 degrees has not converged. 200 were enough for 60 sets of views of
# each of three lenses in both versions.
_ITERATIONS = 300
# Relative change at which the bundle adjustment stops: as by default, the rounding of a double.
_SMALLEST_CHANGE = float(np.finfo(float).eps)
_MODELS = {5: "plumb_bob", 8: "rational_polynomial"}
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, _ITERATIONS, _SMALLEST_CHANGE)
# OpenCV accepts None for a missing guess, but its type stubs do not.
_NO_GUESS: Any = None


def _focal_share(camera: CameraIntrinsics) -> float:
    """Return the standard deviation of the focal length, and of every distance, as a part of it."""
    return max(camera.std[0] / camera.fx, camera.std[1] / camera.fy)


def _doubts(camera: CameraIntrinsics, rms: float, hold_out: float, coverage: Coverage) -> list[str]:
    """Return the doubts about a calibration.

    Args:
        camera: The result.
        rms: Reprojection error of the views used, px.
        hold_out: Reprojection error of views that were not used, px.
        coverage: Coverage by the views.
    """
    views = len(coverage.tilts)
    doubts = []
    if views < ENOUGH_VIEWS:
        doubts.append(f"only {views} views: take {ENOUGH_VIEWS} or more")
    if _focal_share(camera) > _FOCAL_DOUBT:
        doubts.append(
            f"the focal length is only known to {100 * _focal_share(camera):.1f} %: tilt the board "
            "more"
        )
    centre = max(camera.std[2:4])
    if centre > _CENTRE_DOUBT * camera.width:
        doubts.append(
            f"the principal point is only known to {centre:.1f} px: tilt the board "
            "more, also in the corners of the picture"
        )
    if rms > _FAIR_RMS:
        doubts.append(
            f"{rms:.2f} px RMS is high: a bent board, a moved camera, or motion in the pictures"
        )
    if hold_out > max(_HOLD_OUT_RATIO * rms, rms + _HOLD_OUT_PIXELS):
        doubts.append(
            f"left-out views fit worse ({hold_out:.2f} px): take more views of each distance "
            "and tilt"
        )
    return doubts + [f"missing: {what}" for what in coverage.missing]


def _verdict(camera: CameraIntrinsics, rms: float, hold_out: float, doubtful: bool) -> str:
    """Return the verdict in one sentence."""
    share = _focal_share(camera)
    errors = f"{rms:.2f} px on the used views, {hold_out:.2f} px on left-out views"
    accuracy = f"distances are accurate to {100 * share:.2f} % ({1e3 * share:.1f} mm in a metre)"
    return f"{'usable, with doubts' if doubtful else 'good'}: {errors}; {accuracy}"


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The corners of one picture, and its name."""

    name: str
    found: FoundPattern


@dataclass(frozen=True)
class ViewReport:
    """Use of one view.

    Attributes:
        name: Name of the picture.
        corners: Number of corners.
        rms: Reprojection error, px; None if it was left out before the calibration.
        left_out: Why it was left out; empty if it was used.
    """

    name: str
    corners: int
    rms: float | None
    left_out: str = ""


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration and its uncertainty.

    Attributes:
        intrinsics: With ``rms`` (over all used corners), ``views``, and ``std`` (the larger of the
            formal one and that of the jackknife).
        per_view: One report for each view, in order.
        hold_out_rms: Reprojection error of views that were not used, px.
        coverage: Coverage of the picture and of the tilts.
        verdict: One sentence.
        doubts: Doubts about the calibration.
    """

    intrinsics: CameraIntrinsics
    per_view: tuple[ViewReport, ...]
    hold_out_rms: float
    coverage: Coverage
    verdict: str
    doubts: tuple[str, ...]


def calibrate(
    views: Sequence[CalibrationView | FoundPattern],
    size: tuple[int, int],
    *,
    coefficients: Literal[5, 8] | None = 5,
    name: str = "camera",
) -> CalibrationResult:
    """Calibrate a camera.

    Args:
        views: The pattern in each picture.
        size: (width, height) of the pictures, px.
        coefficients: 5 (plumb_bob), or 8 (rational_polynomial) for a wide lens. None: 8 if they
            fit clearly better.
        name: Name of the camera.

    Raises:
        CalibrationError: Too few views, no tilt among them, or a fit worse than 1 px.
    """
    named = [
        v if isinstance(v, CalibrationView) else CalibrationView(f"view {k + 1}", v)
        for k, v in enumerate(views)
    ]
    left_out = _blurred(named)
    if coefficients is None:
        coefficients = _coefficients_for([v.found for v in named], size)
    for last in (False, True):
        used = [k for k in range(len(named)) if k not in left_out]
        _require_views(len(used), len(named))
        fit = _fit([named[k].found for k in used], size, coefficients)
        _require_tilt(fit.rotations)
        worst = max(_OUTLIER_PIXELS, _OUTLIER_RATIO * float(np.median(fit.per_view)))
        if last or fit.per_view.max() <= worst:
            break
        for k, error in zip(used, fit.per_view, strict=True):
            if error > worst:
                left_out[k] = (
                    f"{error:.2f} px: does not fit the other views (moved, bent, or a wrong corner)"
                )
    if fit.rms > _MAX_RMS:
        raise CalibrationError(
            f"the calibration leaves {fit.rms:.2f} px RMS; at most {_MAX_RMS:g} px are accepted",
            hint="is the board flat, and every picture from one camera with fixed focus? A wide "
            "lens may need 8 coefficients",
        )
    found = [named[k].found for k in used]
    jackknife, hold_out = _without_each_group(found, size, coefficients, fit)
    std = tuple(float(v) for v in np.maximum(jackknife, fit.std))
    fx, fy, cx, cy = map(float, fit.numbers[:4])
    intrinsics = CameraIntrinsics(
        *size,
        fx,
        fy,
        cx,
        cy,
        tuple(fit.numbers[4:]),
        _MODELS[coefficients],
        rms=fit.rms,
        std=std,
        views=len(used),
        name=name,
    )
    intrinsics.require_plausible()
    coverage = cover(found, fit.rotations, size)
    doubts = _doubts(intrinsics, fit.rms, hold_out, coverage)
    if coefficients == 8 and _fit(found, size, 5).rms < _MIN_GAIN * fit.rms:
        doubts.append(
            "8 coefficients fit no better than 5: take 5, which extrapolate better to the rim"
        )
    return CalibrationResult(
        intrinsics,
        _reports(named, used, fit, left_out),
        hold_out,
        coverage,
        _verdict(intrinsics, fit.rms, hold_out, bool(doubts)),
        tuple(doubts),
    )


def _coefficients_for(found: Sequence[FoundPattern], size: tuple[int, int]) -> Literal[5, 8]:
    """Return 8 if eight coefficients fit the median view clearly better than five, else 5."""
    if len(found) < FEWEST_VIEWS:
        return 5
    five, eight = (float(np.median(_fit(found, size, count).per_view)) for count in (5, 8))
    return 8 if five > _CLEAR_GAIN * eight else 5


@dataclass(frozen=True, eq=False)
class _Fit:
    """Result of OpenCV's calibration.

    Attributes:
        rms: Reprojection error, px.
        numbers: fx, fy, cx, cy, then the coefficients.
        std: Their formal standard deviations.
        per_view: Reprojection error of each view, px.
        rotations: ``rotation_camera_board`` (3, 3) of each view.
    """

    rms: float
    numbers: Array
    std: Array
    per_view: Array
    rotations: list[Array]


def _fit(
    found: Sequence[FoundPattern],
    size: tuple[int, int],
    coefficients: int,
    start: Array | None = None,
) -> _Fit:
    """Run OpenCV's calibration.

    Args:
        found: The pattern in each view.
        size: (width, height) of the pictures, px.
        coefficients: 5 or 8.
        start: Start of the fit: fx, fy, cx, cy, then the coefficients. By default 8 coefficients
            start from the fit of 5: from OpenCV's start, a camera without distortion, the fit of a
            wide lens needs several times the iterations.

    Raises:
        CalibrationError: No camera fits the views.
    """
    if start is None and coefficients == 8:
        start = np.concatenate([_fit(found, size, 5).numbers, np.zeros(3)])
    flags = cv2.CALIB_RATIONAL_MODEL if coefficients == 8 else 0
    matrix = _NO_GUESS
    lens = _NO_GUESS
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix = _matrix(start)
        lens = start[4:].copy()
    try:
        result: Any = cv2.calibrateCameraExtended(
            [f.points_board.astype(np.float32) for f in found],
            [f.pixels.astype(np.float32) for f in found],
            size,
            matrix,
            lens,
            flags=flags,
            criteria=_CRITERIA,
        )
    except cv2.error as error:
        raise CalibrationError(
            f"OpenCV cannot calibrate from these views: {error.err}",
            hint="take views that differ more: near and far, tilted to each side",
        ) from None
    rms, matrix, lens, rotation_vectors, _, spread, _, per_view = result
    k = np.asarray(matrix, dtype=float)
    numbers = np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], np.ravel(lens)[:coefficients]])
    if not np.isfinite(numbers).all():
        raise CalibrationError(
            "the calibration found no camera that fits these views",
            hint="take views that differ more: near and far, tilted to each side",
        )
    std = np.ravel(np.asarray(spread, dtype=float))[: 4 + coefficients]
    vectors = [np.asarray(t, dtype=float).reshape(3) for t in rotation_vectors]
    rotations = [np.asarray(cv2.Rodrigues(v)[0], dtype=float) for v in vectors]
    return _Fit(float(rms), numbers, std, np.ravel(np.asarray(per_view, dtype=float)), rotations)


def _matrix(numbers: Array) -> Array:
    return np.array([[numbers[0], 0, numbers[2]], [0, numbers[1], numbers[3]], [0, 0, 1.0]])


def _without_each_group(
    found: Sequence[FoundPattern], size: tuple[int, int], coefficients: int, full: _Fit
) -> tuple[Array, float]:
    """Return the jackknife standard deviations, and the RMS of the left-out views, px."""
    groups = min(_GROUPS, len(found) // 2)
    results = []
    squares = 0.0
    count = 0
    for group in range(groups):
        kept = [f for k, f in enumerate(found) if k % groups != group]
        fit = _fit(kept, size, coefficients, full.numbers)
        results.append(fit.numbers)
        for view in [f for k, f in enumerate(found) if k % groups == group]:
            error = _view_error(view, fit.numbers)
            squares += float((error**2).sum())
            count += len(error)
    deviations = np.array(results) - np.mean(results, axis=0)
    spread = np.sqrt((groups - 1) / groups * (deviations**2).sum(axis=0))
    return spread, float(np.sqrt(squares / count))


def _view_error(view: FoundPattern, numbers: Array) -> Array:
    """Return projected minus measured corners (n, 2), px, at the best pose of the board."""
    k = _matrix(numbers)
    success, rotation_vector, shift = cv2.solvePnP(view.points_board, view.pixels, k, numbers[4:])
    if not success:
        raise CalibrationError("a view has no pose under the calibration of the others")
    projected, _ = cv2.projectPoints(view.points_board, rotation_vector, shift, k, numbers[4:])
    return np.asarray(projected, dtype=float).reshape(-1, 2) - view.pixels


def _blurred(views: Sequence[CalibrationView]) -> dict[int, str]:
    widths = np.array([v.found.blur for v in views])
    usual = float(np.median(widths)) if len(widths) else 0.0
    return {
        k: f"blurred: edges {width:.1f} px wide, {usual:.1f} px in the others"
        for k, width in enumerate(widths)
        if width > max(_BLUR_RATIO * usual, _BLUR_PIXELS)
    }


def _require_views(used: int, given: int) -> None:
    if used < FEWEST_VIEWS:
        reason = "" if used == given else f" of {given}; the others were blurred or did not fit"
        views = "view" if used == 1 else "views"
        raise CalibrationError(
            f"{used} usable {views}{reason}: too few, at least {FEWEST_VIEWS} are needed",
            hint=f"take {ENOUGH_VIEWS} to 25: near and far, in every corner, tilted to each side "
            "by 20 to 40 degrees",
        )


def _require_tilt(rotations: Sequence[Array]) -> None:
    """Check the angles between board and picture plane."""
    tilt = np.degrees(np.arccos(min(1.0, *(abs(r[2, 2]) for r in rotations))))
    if tilt < _MIN_TILT_DEG:
        raise CalibrationError(
            f"the board was held square to the camera in all views (tilt at most {tilt:.0f} "
            "degrees): focal length and distance cannot be told apart",
            hint="tilt the board by 20 to 40 degrees, to the left, right, up and down",
        )


def _reports(
    views: Sequence[CalibrationView], used: Sequence[int], fit: _Fit, left_out: dict[int, str]
) -> tuple[ViewReport, ...]:
    errors = dict(zip(used, fit.per_view, strict=True))
    return tuple(
        ViewReport(
            v.name, len(v.found.ids), float(errors[k]) if k in errors else None, left_out.get(k, "")
        )
        for k, v in enumerate(views)
    )
